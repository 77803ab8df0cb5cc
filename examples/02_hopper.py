"""The main job on Hopper, small: record, calibrate, learn in the calibrated simulator, try it in the target."""

import jax

import madoc


def main() -> None:
    """Do it, with progress."""
    task = madoc.tasks.hopper()
    simulator = madoc.simulation.make(task)
    dataset = madoc.record(simulator, "medium", transitions=20_000, key=jax.random.key(0))
    problem = madoc.CalibrationProblem(dataset, simulator)
    result = madoc.calibrate(
        madoc.Madoc(), problem, key=jax.random.key(1), budget=100_000, truth=dataset.true_parameters, quiet=False
    )
    print(result)

    learnt = madoc.learn_policy(
        madoc.SAC(hidden=(128, 128)),
        madoc.PolicyProblem(simulator, result.mean),
        key=jax.random.key(2),
        budget=50_000,
        quiet=False,
    )
    target = simulator.parameters.vector(dataset.true_parameters)
    print(madoc.evaluate(learnt.policy, simulator, target, key=jax.random.key(3), episodes=10).summary())


if __name__ == "__main__":
    main()
