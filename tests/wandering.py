"""A tiny method for the tests of the loop: a jitted random walk, after a stage without control steps."""

import functools
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from madoc.runs.loop import run
from madoc.runs.run_folder import RunFolder
from madoc.types import Epoch

BUDGET = 600
SPEC = {"method": "wander", "hyperparameters": {"scale": 1.0}, "seed": 0, "budget": BUDGET}


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["position", "sum", "buffer", "key", "epoch", "function"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Walk:
    position: jax.Array
    sum: np.ndarray
    buffer: np.ndarray
    key: jax.Array
    epoch: int
    function: object


@jax.jit
def move(position, key):
    return position + jax.random.normal(key, position.shape)


@dataclass(frozen=True)
class Wander:
    cloning: int = 3
    seconds: float = 0.0
    bad_epoch: int = -1
    bad_place: str = "metric"
    converged_epoch: int = 10**9
    following: int | None = None

    def init(self, problem, key):
        return Walk(jnp.zeros(4), np.zeros(4), np.zeros((64, 4), np.float32), key, 0, jnp.tanh)

    def step(self, problem, state):
        time.sleep(self.seconds)
        key, use = jax.random.split(state.key)
        position = move(state.position, use)
        mean = float(position.mean())
        state.buffer[state.epoch % 64] = position  # in place, as a replay buffer does
        clones = state.epoch < self.cloning
        bad = state.epoch == self.bad_epoch
        if bad and self.bad_place == "state":
            position = position * jnp.nan
        state = replace(
            state,
            position=position,
            sum=state.sum + np.asarray(position, np.float64),
            key=key,
            epoch=state.epoch + 1,
        )
        shown = float("nan") if bad and self.bad_place == "metric" else mean
        return state, Epoch(
            {"mean": shown, "epoch": state.epoch},
            control_steps=0 if clones else 10,
            stage="cloning" if clones else "learning",
            fraction=state.epoch / self.cloning if clones else None,
            converged="it stood still" if state.epoch >= self.converged_epoch else None,
            following=self.following,
        )


def bits(state):
    """Everything in a state, comparable."""
    leaves = [jax.random.key_data(x) if x is state.key else x for x in jax.tree.leaves(state)]
    return [leaf if callable(leaf) else np.asarray(leaf).tobytes() for leaf in leaves]


def main(path: str, seconds: str) -> None:
    """Run, or go on, in a process of its own; the tests kill it."""
    resume = (Path(path) / "spec.json").exists()
    with RunFolder.open(path, SPEC) if resume else RunFolder.create(path, SPEC) as folder:
        finished = run(
            Wander(seconds=float(seconds)), None, key=jax.random.key(0), budget=BUDGET, folder=folder,
            resume=resume, checkpoint_every=0.05,
        )  # fmt: skip
    print(finished.status)


if __name__ == "__main__":
    main(*sys.argv[1:])
