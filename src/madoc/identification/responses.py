"""What small forces do to simulated windows, to first order along their motion.

Derivatives of single control steps are simulated once, by the state before and by a force all the while; the effect of
any force over a window then is a product of matrices. That takes 2 + 3 n simulations of every window for n degrees of
freedom, however many forces are tried.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from madoc.identification.replay import Readings
from madoc.simulation.attitudes import Tangent, differences
from madoc.simulation.base import Simulator

_WIDTH = 1e-3
"""Difference of a velocity relative to its root mean square, by which derivatives are taken; that of a position is what
it moves in a control step at such a velocity, that of a force what leads to it."""
_SLOWEST = 1e-3
"""Root mean square of a velocity, rad/s or m/s, that counts at least."""


@dataclass(frozen=True)
class Responses:
    """Windows that are simulated, and derivatives along them.

    Attributes:
        motion: The state before each action; NaN in windows that do not count.
        drives: What each actuator exerts there on every degree of freedom, in N or N·m; NaN in the same windows.
        carried: Derivatives of (positions, velocities) after a control step by those before it.
        pushed: The same by a force on each degree of freedom, in N or N·m.
        seen: Derivatives of each reading, over the typical changes of its channels, by (positions, velocities).
    """

    motion: Float[np.ndarray, "windows steps state"]
    drives: Float[np.ndarray, "windows steps actuator dof"]
    carried: Float[np.ndarray, "windows steps both both"]
    pushed: Float[np.ndarray, "windows steps both dof"]
    seen: Float[np.ndarray, "windows readings channels both"]

    def effects(
        self, forces: Float[np.ndarray, "windows steps dof terms"]
    ) -> Float[np.ndarray, "windows values terms"]:
        """Derivatives of the residuals by the size of each force, which has these values during each control step.

        A force whose effect is not finite has none.
        """
        windows, steps, _, terms = forces.shape
        change = np.zeros((windows, self.carried.shape[-1], terms))
        found = np.zeros((windows, steps + 1, self.seen.shape[2], terms))
        given = np.where(np.isfinite(self.motion[:, :1, :1, None]), forces, 0.0)
        with np.errstate(over="ignore", invalid="ignore"):
            for step in range(steps):
                change = self.carried[:, step] @ change + self.pushed[:, step] @ given[:, step]
                found[:, step + 1] = self.seen[:, step + 1] @ change
        found[..., ~np.isfinite(found).all((0, 1, 2))] = 0.0
        return found.reshape(windows, -1, terms)


def responses_of(
    simulator: Simulator,
    readings: Readings,
    point: Float[np.ndarray, " d"],
    states: Float[np.ndarray, "windows state"],
    whole: Bool[np.ndarray, " windows"],
) -> Responses:
    """The windows simulated at a point in [-1, 1] from given states; only the `whole` ones count."""
    model, tangent = simulator.task.model, Tangent.of(simulator.task.model)
    motion, drives = readings.trajectories(simulator, point, states)
    motion[~whole], drives[~whole] = np.nan, np.nan
    rows = int(whole.sum()) * readings.steps
    start, actions = (each[whole].reshape(rows, each.shape[-1]) for each in (motion, readings.actions))
    system = simulator.bind(simulator.parameters.to_physical(np.clip(point, -1.0, 1.0))[None])
    speed = np.sqrt((start[:, model.nq : model.nq + model.nv] ** 2).mean(0)) if len(start) else np.zeros(model.nv)
    by_speed = _WIDTH * np.maximum(speed, _SLOWEST)
    widths, by_force = (
        np.append(simulator.control_step * by_speed, by_speed),
        model.dof_M0 * by_speed / simulator.control_step,
    )

    def after(states: np.ndarray, force: np.ndarray) -> np.ndarray:
        return system.step(states[None], actions[None], np.tile(force, (1, len(states), 1)))[0]

    def around(states: np.ndarray) -> list[np.ndarray]:
        return [tangent.moved(states, change) for change in np.diag(widths)]

    nothing = np.zeros(model.nv)
    base, neighbours = after(start, nothing), around(start)
    carried = [tangent.differences(after(each, nothing), base) for each in neighbours]
    pushed = [tangent.differences(after(start, force), base) for force in np.diag(by_force)]
    last = base.reshape(-1, readings.steps, base.shape[-1])[:, -1:]
    shown = np.concatenate([motion[whole], last], axis=1).reshape(-1, base.shape[-1])
    here = system.observe(shown[None])[0]
    changes = (differences(simulator.task.attitudes, system.observe(each[None])[0], here) for each in around(shown))
    seen = [change[:, : len(readings.scale)] / readings.scale for change in changes]

    def by_window(found: list[np.ndarray], over: np.ndarray, rows: int) -> np.ndarray:
        slopes = np.stack(found, axis=-1) / over
        every = np.zeros((len(whole), rows, *slopes.shape[1:]))
        every[whole] = np.where(np.isfinite(slopes), slopes, 0.0).reshape(-1, rows, *slopes.shape[1:])
        return every

    return Responses(
        motion,
        drives,
        by_window(carried, widths, readings.steps),
        by_window(pushed, by_force, readings.steps),
        by_window(seen, widths, readings.steps + 1),
    )
