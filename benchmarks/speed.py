"""How fast, against the floor, all in one run: updates against their matrix products, steps against bare MuJoCo.

    python benchmarks/speed.py            # prints, and adds a row to results/speed.jsonl

Single-core figures pin the process to one core (`taskset -c 0`), as the row says.
"""

import json
import time
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from kept import RESULTS, Study

from madoc import tasks
from madoc.calibration import CalibrationProblem, LeastSquares, Madoc, calibrate
from madoc.data.targets import paper_truth
from madoc.learning import replay
from madoc.learning.cloning import continue_cloning
from madoc.policies import LEARNERS, FastSAC, PolicyProblem
from madoc.policies.behaviours import record_quality
from madoc.runs.machine import usable_cores
from madoc.simulation.cpu import CpuSimulator

STUDY = Study(RESULTS / "speed.jsonl", ())
SYSTEMS, ROWS, STEPS = 10, 100, 50
EPOCHS = 10
"""Of a calibration, that are timed."""
PRODUCTS = 300 * 2 * 256**3
"""Floating point operations of a run of `products`."""


def main() -> None:
    rows = {"cores": usable_cores()}
    rows["calibration_epoch"] = calibration_epoch(Madoc())
    rows["learner_updates"] = {name: learner_updates(name) for name in FLOPS}
    rows["least_squares_hopper_1000_rows"] = least_squares(1000)
    rows["control_steps"] = {robot: stepping(robot) for robot in tasks.TASKS}
    print(json.dumps(rows, indent=1))
    STUDY.add(rows)


def best_of(*runs: Callable[[], object], times: int = 3) -> list[float]:
    """Seconds of the fastest of several runs of each, taken in turns, the first (compilation) not counted."""
    seconds = []
    for turn in range(times + 1):
        for run in runs:
            started = time.perf_counter()
            run()
            seconds.append((turn, run, time.perf_counter() - started))
    return [min(spent for turn, other, spent in seconds if turn and other is run) for run in runs]


def products() -> Callable[[], object]:
    """A run of `PRODUCTS` floating point operations in matrix products of an update's size."""
    square = jnp.ones((256, 256)) * 1e-3

    @jax.jit
    def chain(rows: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda rows, _: (jnp.tanh(rows @ square), None), rows, None, length=300)[0]

    return lambda: chain(square).block_until_ready()


def against_floor(run: Callable[[], object], count: int, flops: float) -> dict[str, float]:
    """Milliseconds of an update, updates a second, and how many times the time of its products, measured in turns."""
    together, floor = best_of(run, products(), times=7)
    seconds, speed = together / count, PRODUCTS / floor
    return {
        "ms": round(seconds * 1e3, 3),
        "per_second": round(1.0 / seconds, 1),
        "gflops": round(speed / 1e9, 1),
        "times_floor": round(seconds * speed / flops, 2),
    }


def sac_flops(width: int, observation: int, action: int, batch: int = 256) -> float:
    """Operations of a SAC update: 8 passes of two critics' layers, 4 of the policy's (forward 1, backward 2)."""
    pair = observation + action
    critic = 2.0 * (pair * width + width * width + width)
    policy = 2.0 * (observation * width + width * width + 2 * width * action)
    return batch * (2 * (1 + 3 + 2) * critic + 4 * policy)


def fast_sac_flops(width: int, observation: int, action: int, batch: int = 256) -> float:
    """SAC's, with the policy's part in every `policy_delay`-th update only."""
    critic, policy = mlp(observation + action, width, 1), mlp(observation, width, 2 * action)
    return batch * (2 * (1 + 3) * critic + policy + (2 * 2 * critic + 3 * policy) / FastSAC().policy_delay)


def mlp(inputs: int, width: int, outputs: int, layers: int = 2) -> float:
    """Operations of one pass of a network over one row."""
    return 2.0 * (inputs * width + (layers - 1) * width * width + width * outputs)


def bc_flops(width: int, observation: int, action: int, batch: int = 256) -> float:
    """Operations of a cloning update: forward 1, backward 2."""
    return batch * 3 * mlp(observation, width, 2 * action)


def h2o_flops(width: int, observation: int, action: int, batch: int = 256) -> float:
    """SAC's, and two discriminators: one update, one ratio, and ten draws of the gap, on half the rows."""
    pair = observation + action
    both = mlp(pair, width, 2) + mlp(pair + observation, width, 2)
    return sac_flops(width, observation, action, batch) + batch * 3 * both + batch / 2 * (1 + 10) * both


def cql_flops(width: int, observation: int, action: int, batch: int = 256) -> float:
    """SAC's of three layers, the twins on 30 more actions a row, forward and backward, and the policy for 2 more."""
    critic = mlp(observation + action, width, 1, layers=3)
    policy = mlp(observation, width, 2 * action, layers=3)
    return batch * (2 * (1 + 3 + 2 + 30 * 3) * critic + (4 + 2) * policy)


FLOPS = {
    "bc": bc_flops,
    "sac": sac_flops,
    "fast-sac": fast_sac_flops,
    "sac-bc": sac_flops,
    "h2o": h2o_flops,
    "cql": cql_flops,
    "morec": sac_flops,
}
"""Of one update of a learner. Those of SAC+BC's cloning and of MOREC's imagined steps are left out."""


def learner_updates(name: str) -> dict[str, dict[str, float]]:
    """Updates a second on HalfCheetah's data at batch 256, by width, and how many times the time of its products."""
    simulator = CpuSimulator(tasks.half_cheetah())
    dataset = record_quality(simulator, "medium", transitions=5000, key=jax.random.key(0))
    problem = PolicyProblem(simulator, simulator.parameters.middle, dataset)
    found = {}
    for width in (256, 128):
        found[f"{width}"] = against_floor(*learner_update(name, problem, width), FLOPS[name](width, 17, 6))
    return found


def learner_update(name: str, problem: PolicyProblem, width: int) -> tuple[Callable[[], object], int]:
    """An epoch's updates without acting, and their number."""
    count = 10 if name == "cql" else 50
    hidden = {"hidden": (width, width)}
    if name == "cql":
        hidden = {"hidden": (width,) * 3, "critic_hidden": (width,) * 3, "cloning_updates": 0}
    if name == "fast-sac":
        count = 256
    if name in ("sac", "fast-sac", "sac-bc", "h2o"):
        method = LEARNERS[name].make(**hidden, replay_capacity=50_000)
    else:
        method = LEARNERS[name].make(**hidden, epoch_updates=count)
    state, key = method.init(problem, jax.random.key(0)), jax.random.key(1)
    if name == "bc":
        pairs = problem.logged["observation"], problem.logged["action"]
        chosen = {"learning_rate": method.learning_rate, "batch": method.batch, "updates": count}
        run = lambda: continue_cloning(state.clone, pairs, key, **chosen)  # noqa: E731
    elif name == "cql":
        run = lambda: method._update(state.learner, problem.logged, key, False, count)  # noqa: E731
    elif name == "morec":
        # adding to the replay consumes it, so every run starts at a copy
        ring = state.replay
        run = lambda: method._learn(problem, replace(state, replay=jax.tree.map(jnp.copy, ring)))[1]  # noqa: E731
    else:
        rows = {name: np.asarray(problem.logged[name]) for name in state.interaction.replay.rows}
        seen = replay.add(state.interaction.replay, rows, np.ones(len(rows["reward"]), bool))
        if name == "h2o":
            run = lambda: method._update(  # noqa: E731
                state.learning, seen, problem.logged, problem.features, key, count
            )
        elif name == "fast-sac":
            run = lambda: method._descend(state.learner, seen, None, key)  # noqa: E731
        else:
            logged = problem.logged if method.cloning is not None else None
            run = lambda: method._update(state.learner, seen, logged, key, count)  # noqa: E731
    return lambda: jax.block_until_ready([leaf for leaf in jax.tree.leaves(run()) if eqx.is_array(leaf)]), count


def calibration_epoch(method: Madoc) -> dict[str, float]:
    """Median cost of an epoch of calibrating to HalfCheetah's data: seconds and control steps."""
    simulator = CpuSimulator(tasks.half_cheetah())
    dataset = record_quality(simulator, "medium", transitions=5000, key=jax.random.key(0))
    problem = CalibrationProblem(dataset, simulator)
    state, epochs = method.init(problem, jax.random.key(0)), []
    while len(epochs) <= EPOCHS:
        started = time.perf_counter()
        state, epoch = method.step(problem, state)
        if epoch.stage == "calibrating":
            epochs.append((time.perf_counter() - started, epoch.control_steps))
    seconds, steps = np.median(epochs[1:], axis=0).tolist()  # the first compiles
    return {"seconds": round(seconds, 3), "control_steps": steps}


def least_squares(transitions: int) -> dict[str, float]:
    """Least squares of Hopper's eight parameters from so many exact transitions, recording not counted."""
    simulator = CpuSimulator(tasks.hopper())
    dataset = record_quality(simulator, "medium", transitions=transitions, key=jax.random.key(0))
    key, budget = jax.random.key(1), 1_000_000
    started = time.perf_counter()
    result = calibrate(
        LeastSquares(), CalibrationProblem(dataset, simulator), key=key, budget=budget, truth=dataset.true_parameters
    )
    seconds = round(time.perf_counter() - started, 2)
    return {"seconds": seconds, "control_steps": result.control_steps, "error": result.error["mean_absolute"]}


def stepping(robot: str) -> dict[str, float]:
    """Control steps a second through `System.step`, closed loop, and through bare `mujoco.rollout`, open loop."""
    simulator = CpuSimulator(tasks.make(robot))
    truth = simulator.parameters.vector(paper_truth(robot))
    system = simulator.bind(np.repeat(truth[None], SYSTEMS, 0))
    model, skip = system.models[0], simulator.task.frame_skip
    start = np.broadcast_to(simulator.initial_state, (SYSTEMS, ROWS, len(simulator.initial_state)))
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (STEPS, SYSTEMS, ROWS, simulator.action_size))

    def through_system() -> None:
        state = start
        for action in actions:
            state = system.step(state, action)

    data = [mujoco.MjData(model) for _ in range(simulator.threads)]
    repeated = [one for one in system.models for _ in range(ROWS)]
    initial = np.concatenate([np.zeros((SYSTEMS * ROWS, 1)), start.reshape(SYSTEMS * ROWS, -1)], axis=1)
    control = np.repeat(actions.reshape(STEPS, SYSTEMS * ROWS, -1).transpose(1, 0, 2), skip, axis=1)
    with mujoco.rollout.Rollout(nthread=simulator.threads) as pool:
        bare, stepped = best_of(lambda: pool.rollout(repeated, data, initial, control), through_system, times=7)
    total = STEPS * SYSTEMS * ROWS
    return {"system_step": round(total / stepped), "bare": round(total / bare), "ratio": round(bare / stepped, 3)}


if __name__ == "__main__":
    main()
