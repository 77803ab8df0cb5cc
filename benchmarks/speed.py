"""How fast, against the floor, all in one run: updates against their matrix products, steps against bare MuJoCo.

    python benchmarks/speed.py            # prints, and writes results/speed.json

Single-core figures pin the process to one core (`taskset -c 0`), as the row says.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from madoc import tasks
from madoc.calibration import CalibrationProblem, CalibrationResult, LeastSquares, Madoc, calibrate
from madoc.calibration.madoc import grouping
from madoc.data.targets import paper_truth
from madoc.policies import SAC, PolicyProblem
from madoc.policies.behaviours import record_quality
from madoc.simulation.cpu import CpuSimulator

RESULTS = Path(__file__).parent / "results"
SYSTEMS, ROWS, STEPS = 10, 100, 50


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=RESULTS / "speed.json")
    arguments = parser.parse_args()
    rows = {"cores": len(os.sched_getaffinity(0)), "gflops": round(gflops(), 1)}
    rows["calibration_update_ms"] = {
        name: round(calibration_update(method) * 1e3, 3)
        for name, method in {"paper": Madoc.paper(), "default": Madoc()}.items()
    }
    rows["sac_updates_per_second"] = {f"{width}x2": round(1.0 / sac_update(width), 1) for width in (256, 128)}
    rows["sac_update_floor_ms"] = round(sac_flops(256, 17, 6) / rows["gflops"] / 1e6, 3)
    rows["least_squares_hopper_1000_rows"] = least_squares(1000)
    rows["control_steps"] = {robot: stepping(robot) for robot in tasks.TASKS}
    text = json.dumps(rows, indent=1)
    print(text)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(text + "\n")


def best_of(run: Callable[[], object], times: int = 3) -> float:
    """Seconds of the fastest of several runs, the first (compilation) not counted."""
    run()
    seconds = []
    for _ in range(times):
        started = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def gflops() -> float:
    """Matrix products of an update's size, in 1e9 floating point operations a second."""
    square = jnp.ones((256, 256)) * 1e-3

    @jax.jit
    def chain(rows: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda rows, _: (jnp.tanh(rows @ square), None), rows, None, length=1000)[0]

    return 1000 * 2 * 256**3 / best_of(lambda: chain(square).block_until_ready()) / 1e9


def sac_flops(width: int, observation: int, action: int, batch: int = 256) -> float:
    """Operations of a SAC update: 8 passes of two critics' layers, 4 of the policy's (forward 1, backward 2)."""
    pair = observation + action
    critic = 2.0 * (pair * width + width * width + width)
    policy = 2.0 * (observation * width + width * width + 2 * width * action)
    return batch * (2 * (1 + 3 + 2) * critic + 4 * policy)


def calibration_update(method: Madoc) -> float:
    """Seconds a calibration update of HalfCheetah takes."""
    simulator = CpuSimulator(tasks.half_cheetah())
    dataset = record_quality(simulator, "medium", transitions=5000, key=jax.random.key(0))
    problem = CalibrationProblem(dataset, simulator)
    state = method.init(problem, jax.random.key(0))
    features = problem.raw_features if method.features == "raw" else problem.standardised_features
    members = jnp.asarray(grouping.members(np.arange(14) % 6, 6))
    count = 50

    def run() -> object:
        return jax.block_until_ready(
            method.agents.update(
                state.agents,
                state.rows,
                features,
                members,
                jax.random.key(1),
                mixing="dop",
                count=count,
            )[1]
        )

    return best_of(run) / count


def sac_update(width: int) -> float:
    """Seconds a SAC update of HalfCheetah takes."""
    simulator = CpuSimulator(tasks.half_cheetah())
    learner = SAC(hidden=(width, width), replay_capacity=50_000)
    problem = PolicyProblem(simulator, simulator.parameters.middle)
    state = learner.init(problem, jax.random.key(0))
    count = 50

    def run() -> object:
        return jax.block_until_ready(learner._update(state.learner, state.replay, None, jax.random.key(1), count)[1])

    return best_of(run) / count


def least_squares(rows: int) -> dict[str, float]:
    """Hopper's 8 parameters from that many clean transitions: seconds, control steps and the error."""
    simulator = CpuSimulator(tasks.hopper())
    dataset = record_quality(simulator, "medium", transitions=rows, key=jax.random.key(0))
    problem = CalibrationProblem(dataset, simulator)

    def run() -> CalibrationResult:
        return calibrate(
            LeastSquares(), problem, key=jax.random.key(0), budget=1_000_000, truth=dataset.true_parameters
        )

    result = run()
    return {
        "seconds": round(best_of(run), 2),
        "control_steps": result.control_steps,
        "mean_absolute_error": result.error["mean_absolute"],
    }


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
        bare = best_of(lambda: pool.rollout(repeated, data, initial, control))
    stepped = best_of(through_system)
    total = STEPS * SYSTEMS * ROWS
    return {"system_step": round(total / stepped), "bare": round(total / bare), "ratio": round(bare / stepped, 3)}


if __name__ == "__main__":
    main()
