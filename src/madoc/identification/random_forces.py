"""Random forces on a machine, as turbulence, a rough floor and vibration make: what no sensor's noise explains.

A filter that does not know them believes its own predictions too much. Its errors then last over several readings, and
parameters take what forces have done. Their size is what makes readings likeliest, beside that of the sensors' noise
(Mehra 1970). It is one number s for the whole machine: in each control step a force on each degree of freedom, of
inertia J, is normal with a standard deviation of s √J, and so changes the kinetic energy of all of them by as much.
"""

import numpy as np
from jaxtyping import Float

from madoc.data.dataset import Dataset, stride
from madoc.identification.states import LoggedStates
from madoc.simulation.base import Simulator


def by_dof(simulator: Simulator, size: float) -> Float[np.ndarray, " dof"]:
    """Standard deviations of forces of size s, in N/√kg, on each degree of freedom, in N or N·m; empty where s is 0."""
    return np.asarray(size * np.sqrt(simulator.task.model.dof_M0)) if size else np.zeros(0)


def forces(
    deviations: Float[np.ndarray, " dof"], shape: tuple[int, ...], random: np.random.Generator
) -> Float[np.ndarray, "*shape dof"] | None:
    """Forces that are independent of each other; None, and no number drawn, where none act."""
    return deviations * random.standard_normal((*shape, len(deviations))) if deviations.any() else None


def opposed(
    deviations: Float[np.ndarray, " dof"], windows: int, members: int, steps: int, random: np.random.Generator
) -> Float[np.ndarray, "windows members steps dof"] | None:
    """Forces on an even number of members in pairs of opposite ones, so that their mean is 0; None where none act."""
    half = forces(deviations, (windows, members // 2, steps), random)
    return None if half is None else np.concatenate([half, -half], axis=1)


def largest(dataset: Dataset, logged: LoggedStates, simulator: Simulator) -> float:
    """The size s in N/√kg of forces that alone would make typical changes of speeds; the largest of those of each.

    Changes are over a stride, in which more than noise moves; the speed that forces make grows with the root of it.
    """
    steps, rows = stride(dataset), logged.rows
    ends = dataset.episode_ends[dataset.episode_of(rows)]
    first = np.flatnonzero(rows[:-steps] + steps == rows[steps:])
    first = first[rows[first] + steps < ends[first]]
    speeds = logged.states[:, simulator.task.model.nq : logged.physical_size]
    changes = np.abs(speeds[first + steps] - speeds[first]).mean(0) if len(first) else np.zeros(speeds.shape[1])
    return float((np.sqrt(simulator.task.model.dof_M0) * changes).max() / (np.sqrt(steps) * simulator.control_step))
