"""The behaviour policies of `madoc record`: SAC at several stages of its training in each target, shipped as float16.

`benchmarks/behaviours.py` trained them and chose the stages. A quality is
one stage or several in equal shares: D4RL's `medium` (a third of expert), `medium-replay` (the way up to it),
`medium-expert` (half and half); NeoRL's `neorl-low`, `neorl-medium`, `neorl-high` (25, 50, 75 % of expert).
"""

import importlib.resources
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.data import Dataset
from madoc.data.dataset import join
from madoc.data.record import record
from madoc.data.targets import paper_truth
from madoc.errors import MadocError, unknown_name
from madoc.numpy_policy import NumpyPolicy
from madoc.policies.learn import policy_of
from madoc.simulation.base import Simulator

QUALITIES = ("medium", "medium-replay", "medium-expert", "neorl-low", "neorl-medium", "neorl-high")


@dataclass(frozen=True)
class Ladder:
    """The shipped policies of a robot, the least trained first.

    Attributes:
        saved: The policies.
        qualities: By quality, the indices of its policies.
    """

    saved: tuple[NumpyPolicy, ...]
    qualities: dict[str, list[int]]


def ladder(task_name: str) -> Ladder:
    """All shipped policies of a robot; MadocError if there are none."""
    file = importlib.resources.files(__package__) / f"{task_name}.npz"
    if not file.is_file():
        raise MadocError(f"no behaviour policies are shipped for {task_name!r}")
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        about = json.loads(str(arrays["about"]))
        weights = [arrays[f"weight_{layer}"].astype(np.float32) for layer in range(about["layers"])]
        biases = [arrays[f"bias_{layer}"].astype(np.float32) for layer in range(about["layers"])]
    size = weights[0].shape[1]
    networks = zip(zip(*weights, strict=True), zip(*biases, strict=True), strict=True)
    saved = tuple(NumpyPolicy(task_name, *network, np.zeros(size), np.ones(size)) for network in networks)
    return Ladder(saved, about["qualities"])


def record_quality(
    simulator: Simulator,
    quality: str,
    *,
    transitions: int,
    key: PRNGKeyArray,
    truth: Mapping[str, float] | None = None,
    advance: Callable[[int], None] = lambda rows: None,
) -> Dataset:
    """Record one of the paper's datasets, of one of the `QUALITIES`, in the target.

    `truth` is what its parameters truly are, physical values by name, by default the paper's. `advance` is called with
    the number of further rows.

    Raises:
        MadocError: The quality is unknown, or nothing is shipped for the robot.
    """
    task = simulator.task
    if quality not in QUALITIES:
        raise unknown_name("quality", quality, QUALITIES)
    rungs = ladder(task.name)
    chosen = rungs.qualities[quality]
    origin = f"madoc record {task.name}-{quality} ({task.physics} physics)"
    counts = np.diff(np.linspace(0, transitions, len(chosen) + 1).astype(int))
    parts = [
        record(
            policy_of(rungs.saved[index]),
            simulator,
            paper_truth(task.name) if truth is None else dict(truth),
            transitions=int(count),
            key=jax.random.fold_in(key, index),
            origin=origin,
            advance=advance,
        )
        for index, count in zip(chosen, counts, strict=True)
        if count
    ]
    return join(parts, origin)
