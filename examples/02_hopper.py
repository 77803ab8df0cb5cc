"""The main job on Hopper, small: record, calibrate, learn in the calibrated simulator, try it in the target."""

import jax

import madoc


def main() -> None:
    """Do it, with progress."""
    simulator = madoc.simulation.make(madoc.tasks.hopper())
    dataset = madoc.record(simulator, "medium", transitions=20_000, key=jax.random.key(0))
    train, held_out = dataset.split(0.2)
    problem = madoc.CalibrationProblem(train, simulator)
    result = madoc.calibrate(
        madoc.Madoc(), problem, key=jax.random.key(1), budget=100_000, truth=dataset.true_parameters
    )
    print(result)
    print(madoc.assess(result, held_out))

    learnt = madoc.learn_policy(
        madoc.SAC(hidden=(128, 128)),
        madoc.PolicyProblem(simulator, result.mean),
        key=jax.random.key(2),
        budget=50_000,
    )
    print(madoc.evaluate(learnt.policy, simulator, dataset.true_parameters, key=jax.random.key(3)).summary())


if __name__ == "__main__":
    main()
