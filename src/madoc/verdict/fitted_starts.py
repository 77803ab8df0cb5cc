"""Prediction error on the hold-out from initial states that are fitted to a window's first steps.

They are where velocities are hidden or readings very noisy. The hidden part of a state shows in the observations that
follow it. The first steps of each window serve to fit its initial state, for every estimate alike. Errors are those of
the steps after them, which no fit has used.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from madoc.data import Dataset
from madoc.identification.ensembles import likely_states
from madoc.identification.replay import Readings
from madoc.identification.settling import FIT_STEPS, fitted_states
from madoc.identification.states import LoggedStates, states_of
from madoc.identification.windows import evenly, rows_that_fit
from madoc.simulation.base import Simulator
from madoc.verdict.prediction import FEWEST_WINDOWS

FITTED = 10
"""Number of strides at the beginning of a window to whose observations its initial state is fitted."""
AHEAD = (1, 5, 10)
"""Numbers of strides after the fitted ones at which errors are taken."""
MOST = 150
"""Largest number of windows."""
_POINTS, _NEARBY_STEPS = 5, 6
"""Number of points at which starts are fitted, and of Gauss-Newton steps of the parameters beside them."""


@dataclass(frozen=True)
class FittedReplays:
    """Windows of the hold-out whose initial states are unknown: `near` are first guesses of them, at their `rows`.

    `ahead` are the numbers of control steps after the fitted ones at which errors are taken, and `most_steps` the
    largest number of steps of an initial state.
    """

    held: Dataset
    logged: LoggedStates
    simulator: Simulator
    readings: Readings
    near: Float[np.ndarray, "windows state"]
    rows: Int[np.ndarray, " windows"]
    episodes: Int[np.ndarray, " windows"]
    stride: int
    ahead: tuple[int, ...]
    most_steps: int = FIT_STEPS

    @property
    def fitted(self) -> int:
        """Number of control steps to whose observations an initial state is fitted."""
        return FITTED * self.stride

    def of(self, kept: Int[np.ndarray, " some"]) -> "FittedReplays":
        """These windows alone."""
        parts = {"near": self.near[kept], "rows": self.rows[kept], "episodes": self.episodes[kept]}
        return replace(self, readings=self.readings.of(kept), **parts)

    def at_horizons(
        self, residuals: Float[np.ndarray, "systems windows readings channels"]
    ) -> Float[np.ndarray, "systems windows horizons channels"]:
        """The residuals at the readings at which errors are taken."""
        return residuals[:, :, self.fitted + np.array(self.ahead)]

    def residuals(
        self, points: Float[np.ndarray, "systems d"], near: Float[np.ndarray, "windows state"] | None = None
    ) -> Float[np.ndarray, "systems windows readings channels"]:
        """Simulated minus measured observations of whole windows.

        They are in typical changes of a stride; NaN in a window whose simulation failed. Initial states are `starts`.
        """
        return self.residuals_from(points, self.starts(points, near))

    def residuals_from(
        self,
        points: Float[np.ndarray, "systems d"],
        states: Float[np.ndarray, "systems windows state"],
        forces: Float[np.ndarray, "systems windows steps dof"] | None = None,
    ) -> Float[np.ndarray, "systems windows readings channels"]:
        """The residuals from given initial states, with `forces` from outside, in N or N·m."""
        flat = self.readings.residuals(self.simulator, points, states, forces)[:, 0]
        return flat.reshape(*flat.shape[:2], *self.readings.observed.shape[1:])

    def starts(
        self, points: Float[np.ndarray, "systems d"], near: Float[np.ndarray, "windows state"] | None = None
    ) -> Float[np.ndarray, "systems windows state"]:
        """The initial states from which each system comes nearest to the observations of the fitted steps.

        They are looked for around what an ensemble finds likely, or around those of a system that hardly differs, where
        these are given as `near`: unless steps were too few to find them, so that none has more steps than another.
        """
        whole = self.readings
        first = replace(whole, actions=whole.actions[:, : self.fitted], observed=whole.observed[:, : self.fitted + 1])
        if near is None or self.most_steps < FIT_STEPS:
            log = self.held, self.logged, self.simulator, first, self.rows
            likely = likely_states(*log, points, self.near)
        else:
            likely = np.repeat(near[None], len(points), axis=0)
        pairs = zip(points, likely, strict=True)
        return np.stack([fitted_states(self.simulator, first, *each, "linear", self.most_steps) for each in pairs])


def replay_steps(logged: LoggedStates, stride: int, parameters: int) -> int:
    """About how many control steps a window takes until it is judged: at four points, with noise, and nearby."""
    values, fitted, ahead = logged.physical_size, FITTED * stride, AHEAD[-1] * stride
    starts = _POINTS * FIT_STEPS * (4 + values) * fitted
    return starts + _NEARBY_STEPS * (1 + 2 * parameters + values) * (fitted + ahead)


def fitted_replays_of(
    held: Dataset,
    simulator: Simulator,
    scale: Float[np.ndarray, " channels"],
    stride: int,
    *,
    ahead: tuple[int, ...] = (),
    fewest: int = FEWEST_WINDOWS,
    most: int | None = None,
) -> FittedReplays | None:
    """Windows spread evenly over the hold-out; None where fewer than `fewest` are long enough.

    They are at most `most`; without that `MOST`, and as many as share no row on average, or the fewest.

    `stride` is the number of control steps between readings at which the robot has moved, `data.dataset.stride`.
    `ahead` are control steps after the fitted ones, `AHEAD` strides where none are given.
    """
    logged = states_of(held, simulator)
    near, rows = logged.guesses()
    ahead = ahead or tuple(stride * strides for strides in AHEAD)
    steps = FITTED * stride + ahead[-1]
    possible = rows_that_fit(held, rows, steps)
    if len(possible) < fewest:
        return None
    most = most or min(MOST, max(fewest, len(possible) // steps))
    chosen = evenly(possible, most)
    readings = Readings.at(held, logged, rows[chosen], steps, scale)
    episodes = held.episode_of(rows[chosen])
    return FittedReplays(held, logged, simulator, readings, near[chosen], rows[chosen], episodes, stride, ahead)
