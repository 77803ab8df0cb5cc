"""A tiny calibration of the spring in a process of its own; tests kill it, or give it fewer cores."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import jax

from madoc import simulation
from madoc.calibration import CalibrationProblem, Madoc, calibrate
from madoc.runs.run_folder import RunFolder
from robots import SPRING_TRUTH, recorded, spring

KEY = jax.random.key(0)
SPEC = {"method": "madoc", "seed": 0}


def madoc(**changes) -> Madoc:
    """Every stage, in epochs of milliseconds; each epoch is one checkpoint."""
    method = Madoc()
    agents = replace(method.agents, hidden=(16,), critic_hidden=(16,), batch=32, actor_batch=16)
    tiny = {"hidden": (16,), "cloning_epochs": 5, "cloning_updates": 5, "grouping_epochs": 5, "grouping_updates": 5}
    tiny |= {"regression_hidden": (16,), "regression_epochs": 5, "regression_updates": 5}
    tiny |= {"epoch_steps": 100, "updates": 5, "draws": 5, "batch": 32, "replay_capacity": 500, "agents": agents}
    return replace(method, **(tiny | changes))


def problem(threads: int | None = None) -> CalibrationProblem:
    task = spring()
    return CalibrationProblem(
        recorded(task, SPRING_TRUTH, 500, jax.random.key(100)), simulation.make(task, threads=threads)
    )


def go_on(path: str, budget: int):
    """Calibrate in a folder, from the start or from where it was killed."""
    resume = (Path(path) / "spec.json").exists()
    with RunFolder.open(path, SPEC) if resume else RunFolder.create(path, SPEC) as folder:
        return calibrate(
            madoc(), problem(1), key=KEY, budget=budget, folder=folder, resume=resume, checkpoint_every=0.0
        )


def wide() -> dict:
    """Layers and batches as large as the defaults, so that XLA and MuJoCo would share the work among cores."""
    settings = Madoc()
    names = ("hidden", "regression_hidden", "batch", "epoch_steps", "agents")
    method = madoc(**{name: getattr(settings, name) for name in names}, draws=None, replay_capacity=5000)
    seen = problem()
    result = calibrate(method, seen, key=KEY, budget=6000)
    return {"threads": seen.simulator.threads, "mean": [value.hex() for value in result.mean.tolist()]}


if __name__ == "__main__":
    jax.config.update("jax_numpy_rank_promotion", "raise")
    if sys.argv[1] == "wide":
        print(json.dumps(wide()))
    else:
        go_on(sys.argv[1], int(sys.argv[2]))
