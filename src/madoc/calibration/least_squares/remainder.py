"""What predictions of a filter leave at its end: whether that is noise, and how large random forces are beside it."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from madoc.calibration.least_squares.filter_state import MEMBERS, NEAR, FilterState
from madoc.calibration.least_squares.instruments import over_windows, surprises
from madoc.calibration.least_squares.statistics import LONG_TAILS
from madoc.identification.ensembles import FilteredWindows, with_noise
from madoc.identification.innovations import Innovations
from madoc.identification.losses import Loss
from madoc.identification.noise import WHITE
from madoc.identification.random_forces import largest

LARGE, LARGE_ROUNDS, LARGER = 64, 2, 4
"""Number of states that tell at the end whether what is left is noise, as few leave errors that are alike, and how
often noise is estimated by them. Windows that such an ensemble loses are given to one so many times as large."""
LASTING = WHITE / 2.0
"""Correlation of prediction errors with the next ones that is certain (`Innovations.alike`), from which on random
forces are looked for; of noise alone it is that of a value beyond four standard errors."""
SIZES, SIZE_ROUNDS = 8, 3
"""Number of sizes of random forces that are tried, and how often noise is estimated for each."""
SMALLEST_SIZE = -3.0
"""Power of ten of the smallest size that is tried, in that of the largest."""
BETTER = 2.0
"""Standard errors of the windows' mean by which random forces make readings likelier, as chance does not."""


def with_what_is_left(
    windows: FilteredWindows,
    state: FilterState,
    rounding: Float[np.ndarray, " channels"],
    loss: Loss,
    random: np.random.Generator,
) -> FilterState:
    """The state with the noise that large ensembles find in some windows, and what errors there have that it has not.

    Spends `LARGE_ROUNDS` · windows · `LARGE` · steps control steps, and those of larger ensembles in windows lost.
    """
    found, noise = with_noise(windows, state.point, state.noise, rounding, LARGE, LARGE_ROUNDS, random, state.force)
    costs = surprises(found, loss)
    if (lost := np.flatnonzero(costs > LONG_TAILS)).size:
        # An ensemble may lose what it follows by chance. What the model lacks surprises a larger one as well.
        again, count = windows.of(lost), LARGER * LARGE
        larger, _ = with_noise(again, state.point, found.noise, rounding, count, 1, random, state.force)
        costs[lost] = np.minimum(costs[lost], surprises(larger, loss))
    known = found.explained_by(windows.readings.actions)
    return replace(state, noise=noise, cost=over_windows(costs), alike=found.alike(), known=known)


def may_be_pushed(state: FilterState) -> bool:
    """Whether errors at the end may be those of a filter that does not know random forces, and none were tried."""
    return state.settled and state.forces == 0 and (state.found.unlike_noise or state.alike > LASTING)


def size_steps(windows: int, horizon: int) -> int:
    """Control steps of `with_random_forces`."""
    return (1 + SIZES) * SIZE_ROUNDS * MEMBERS * windows * horizon


def with_random_forces(
    windows: FilteredWindows, state: FilterState, rounding: Float[np.ndarray, " channels"]
) -> FilterState:
    """The state with random forces of the size that makes readings likeliest, and its search to go on with them.

    Where none make them certainly likelier the search is at its end as it was. Every size is tried on the same numbers.
    """
    most, tried = largest(windows.dataset, windows.logged, windows.simulator), dict[float, Innovations]()

    def misfit(power: float) -> float:
        random, force = np.random.default_rng([state.seed, state.epochs]), most * 10.0**power
        tried[power], _ = with_noise(windows, state.point, state.noise, rounding, MEMBERS, SIZE_ROUNDS, random, force)
        return float(np.nanmean(tried[power].misfit()))

    minimize_scalar(misfit, bounds=(SMALLEST_SIZE, 0.0), method="bounded", options={"maxiter": SIZES})
    misfit(-np.inf)
    best = min(tried, key=lambda power: float(np.nanmean(tried[power].misfit())))
    change = tried[best].misfit() - tried[-np.inf].misfit()
    change = change[np.isfinite(change)]
    following = replace(state, forces=2, epochs=state.epochs + 1)
    if not change.mean() < -BETTER * change.std() / np.sqrt(max(1, len(change))):
        return following
    return replace(
        following,
        force=float(most * 10.0**best),
        noise=tried[best].noise,
        gradients=np.zeros_like(state.gradients),
        products=np.zeros_like(state.products),
        squares=np.zeros_like(state.squares),
        apart=np.zeros_like(state.apart),
        chance=np.zeros_like(state.chance),
        compared=0,
        moved=NEAR,
        quiet=0,
        halved=0,
        together=0,
    )
