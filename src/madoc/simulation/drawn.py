"""Many parameter vectors as the numbers of a model that they change, for those who draw models elsewhere."""

from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float, Int, Num

from madoc.simulation.base import Simulator
from madoc.simulation.mjcf import NOT_COMPARED
from madoc.simulation.write import write_parameters

Numbers = Mapping[str, tuple[Int[np.ndarray, " numbers"], Num[np.ndarray, "draws numbers"]]]
"""For each array of `mujoco.MjModel` the places in it that change, of its values in a row, and what they are."""
BOXES = "bvh_aabb"
"""Boxes about geoms, by which MuJoCo finds contacts faster."""
GRAVITY = "opt.gravity"
"""The one array of a model's options that a parameter writes."""


def numbers_of_draws(simulator: Simulator, values: Float[np.ndarray, "draws parameters"]) -> Numbers:
    """Every number in which a draw differs from the robot's own model, constants derived by `mj_setConst` included."""
    task, rows = simulator.task, []
    own = _arrays(task.compile())
    for draw in values:
        model = task.compile()
        write_parameters(model, mujoco.MjData(model), simulator.parameters.parameters, draw)
        rows.append({name: part for name, part in _arrays(model).items() if not np.array_equal(part, own[name])})
    changed = dict.fromkeys(name for row in rows for name in row)
    stacked = {name: np.stack([row.get(name, own[name]) for row in rows]) for name in changed}
    varied = {name: np.flatnonzero((part != own[name]).any(0)) for name, part in stacked.items()}
    return {name: (places, stacked[name][:, places]) for name, places in varied.items()}


def _arrays(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Copies of a model's arrays of numbers that matter for its motion, each in a row.

    Boxes about geoms are among them: they lie in the frame of a body's centre of mass, and contacts are sought by them.
    """
    found = {GRAVITY: np.array(model.opt.gravity)}
    for name in dir(model):
        part = None if name.startswith(NOT_COMPARED) and name != BOXES else getattr(model, name)
        if isinstance(part, np.ndarray) and part.dtype.kind in "fiu":
            found[name] = np.array(part).reshape(-1)
    return found
