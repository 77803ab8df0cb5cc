"""What the filter's search leaves at its end: noise, the error of a timestep that is too long, or what forces make."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from madoc import simulation
from madoc.calibration.least_squares import instruments
from madoc.calibration.least_squares.instruments import MEMBERS, NEAR, FilterState, Side
from madoc.calibration.least_squares.plan import FEWEST, LONG_TAILS
from madoc.identification.ensembles import FilteredWindows, with_noise
from madoc.identification.innovations import Innovations
from madoc.identification.losses import Loss
from madoc.identification.random_forces import largest
from madoc.simulation import FINER
from madoc.simulation.base import counted_as

LARGE, LARGE_ROUNDS, LARGER = 64, 2, 4
"""Number of states that tell at the end whether what is left is noise, as few leave errors that are alike, and how
often noise is estimated by them. Windows that such an ensemble loses are given to one so many times as large."""
TRIAL, SIZE_ROUNDS = -1.5, 2
"""Power of ten of the size of random forces, in the largest one, with which it is asked whether any act, and how often
noise is estimated for a size, and with a shorter timestep."""
SIZES, SMALLEST_SIZE = 8, -3.0
"""Number of sizes that are tried then, and power of ten of the smallest, in the largest."""
BETTER = 2.0
"""Standard errors of the windows' mean by which another model makes readings likelier, as chance does not."""
WHOLE = FINER / (FINER - 1)
"""What the whole error of a timestep changes, over what a timestep `FINER` times as short does: the error is in
proportion to the timestep."""
STEPS = 3
"""Largest number of steps of the parameters with the shorter timestep, before it is compared with the model's own."""
LEAST_CURVED = 0.1
"""Least curvature along a step, in that before it, that is believed: what is less is chance."""


def members_for(state: FilterState) -> int:
    """Number of states that the question asked takes of each window; with a shorter timestep one counts as `FINER`."""
    pull = MEMBERS + 2 * 2 * len(state.point) * instruments.FEW
    misfit = SIZE_ROUNDS * MEMBERS
    shorter = pull + misfit + FINER * (STEPS * pull + misfit)
    shorter = shorter + FINER * LARGE if state.unlike_noise else shorter // 2
    return {"shorter": shorter, "trial": 2 * SIZE_ROUNDS * MEMBERS, "size": (1 + SIZES) * SIZE_ROUNDS * MEMBERS}.get(
        state.asked, 0
    )


def with_answer(
    windows: FilteredWindows, state: FilterState, rounding: Float[np.ndarray, " channels"], loss: Loss
) -> FilterState:
    """The state with the answer to what is asked, and what is asked next.

    Spends `members_for` · windows · steps control steps, where a shorter timestep counts as often as there are more.
    """
    if state.asked == "shorter":
        return with_shorter_steps(windows, state, rounding, loss)
    return (with_trial if state.asked == "trial" else with_random_forces)(windows, state, rounding)


def with_what_is_left(
    windows: FilteredWindows,
    state: FilterState,
    rounding: Float[np.ndarray, " channels"],
    loss: Loss,
    random: np.random.Generator,
    rounds: int = LARGE_ROUNDS,
) -> FilterState:
    """The state with the noise that large ensembles find in some windows, and what errors there have that it has not.

    Spends `rounds` · windows · `LARGE` · steps control steps, and those of larger ensembles in windows lost.
    """
    found, noise = with_noise(windows, state.point, state.noise, rounding, LARGE, rounds, random, state.force)
    costs = instruments.surprises(found, loss)
    followed = costs <= LONG_TAILS
    if (lost := np.flatnonzero(~followed)).size:
        # An ensemble may lose what it follows by chance. What the model lacks surprises a larger one as well.
        again, count = windows.of(lost), LARGER * LARGE
        larger, _ = with_noise(again, state.point, found.noise, rounding, count, 1, random, state.force)
        costs[lost] = np.minimum(costs[lost], instruments.surprises(larger, loss))
    share = found.explained_by(windows.readings.actions, followed)
    return replace(state, noise=noise, cost=instruments.over_windows(costs), alike=found.alike(), explained_share=share)


def with_shorter_steps(
    windows: FilteredWindows, state: FilterState, rounding: Float[np.ndarray, " channels"], loss: Loss
) -> FilterState:
    """The state with what a shorter timestep changes, unless the own one is certainly likelier, and what is asked next.

    A machine has no timesteps, and parameters make up for the error of the model's. Without it they would have other
    values, by `shorter_steps`: so far they must move until the same windows pull them no more than they do at the
    search's end. The curvature is at first what all windows tell, and then corrected along each step by how much that
    changed the pull. Errors that are unlike noise and stay so have another cause.
    """
    following = replace(state, asked="size" if state.unlike_noise else "trial", epochs=state.epochs + 1)
    if not state.unlike_noise:  # less is at stake then
        all_windows, fewest = np.arange(len(windows.rows)), FEWEST + len(state.point)
        windows = windows.of(all_windows[: max(fewest, len(all_windows) // 2)])
    own = _pull(windows, state, loss)
    if own is None:
        return following
    shorter = windows._replace(simulator=simulation.with_shorter_timestep(windows.simulator))
    error = np.sqrt(np.maximum(np.diag(state.found.uncertainty.covariance), np.finfo(float).tiny))
    seen = state.squares.any((1, 2)).sum()
    curvature = instruments.agreed(state.products.sum(0), state.squares.sum(0)) / seen
    finer, moved, before = state, np.zeros_like(state.point), own
    with counted_as(FINER):
        for _ in range(STEPS):
            pull = _pull(shorter, finer, loss)
            if pull is None:
                return following
            curvature = curvature_after(curvature, moved, pull - before)
            step = np.clip(np.linalg.solve(curvature, own - pull), -instruments.LONGEST, instruments.LONGEST)
            point = np.clip(finer.point + step, -1.0, 1.0)
            finer, moved, before = replace(finer, point=point), point - finer.point, pull
            if instruments.moved_by(moved, error) < instruments.LIKE_CHANCE:
                break
        of_shorter, noise = _misfit(shorter, finer, rounding)
    of_own, _ = _misfit(windows, state, rounding)
    enough = np.isfinite(of_own - of_shorter).sum() >= FEWEST + len(state.point)
    if not enough or likelier(of_own, of_shorter, len(state.point)):
        return following
    finer = replace(finer, noise=noise)
    following = replace(following, shorter_steps=WHOLE * (finer.point - state.point))
    if not state.unlike_noise:
        return following
    random = np.random.default_rng([state.seed, state.epochs, 3])
    with counted_as(FINER):
        left = with_what_is_left(shorter, finer, rounding, loss, random, rounds=1)
    if left.unlike_noise:
        return replace(following, shorter_steps=np.zeros_like(state.point))
    return replace(following, asked="known", cost=left.cost, alike=left.alike, explained_share=left.explained_share)


def curvature_after(
    curvature: Float[np.ndarray, "d d"], step: Float[np.ndarray, " d"], change: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "d d"]:
    """The curvature by which a step changes the gradient as it did (Broyden, Fletcher, Goldfarb, Shanno 1970).

    It stays as it is after no step, and where the change is not certainly that of a minimum.
    """
    expected = curvature @ step
    if not step @ change > LEAST_CURVED * (step @ expected):
        return curvature
    return curvature + np.outer(change, change) / (step @ change) - np.outer(expected, expected) / (step @ expected)


def _misfit(
    windows: FilteredWindows, state: FilterState, rounding: Float[np.ndarray, " channels"]
) -> tuple[Float[np.ndarray, " windows"], Float[np.ndarray, " channels"]]:
    """Misfit of each window's readings, and the noise at this point."""
    random = np.random.default_rng([state.seed, state.epochs, 4])
    found, noise = with_noise(windows, state.point, state.noise, rounding, MEMBERS, SIZE_ROUNDS, random)
    return found.misfit(), noise


def _pull(windows: FilteredWindows, state: FilterState, loss: Loss) -> Float[np.ndarray, " d"] | None:
    """The mean gradient of windows' cost, by the same random numbers for all; None where too few are simulated whole.

    Errors count in units of the noise at the search's end, as they do in its curvature.
    """
    random = [np.random.default_rng([state.seed, state.epochs, number]) for number in range(3)]
    found, _ = with_noise(windows, state.point, state.noise, np.zeros_like(state.noise), MEMBERS, 1, random[2])
    sides = [Side.of(windows, found, state.point, state.spread, MEMBERS, each) for each in random[:2]]
    whole = found.whole[0] & sides[0].ends.whole.all(0) & sides[1].ends.whole.all(0)
    if whole.sum() < FEWEST + len(state.point):
        return None
    gradients, _, _ = instruments.products_of(sides[0], sides[1], whole, loss)
    return np.asarray(gradients.sum(0) / whole.sum())


def with_trial(windows: FilteredWindows, state: FilterState, rounding: Float[np.ndarray, " channels"]) -> FilterState:
    """The state at its end, or with the size of random forces asked for, where some make readings likelier."""
    size = 10.0**TRIAL * largest(windows.dataset, windows.logged, windows.simulator)
    none, some = (_tried(windows, state, rounding, each) for each in (0.0, size))
    pushed = likelier(some.misfit(), none.misfit(), len(state.point))
    return replace(state, asked="size" if pushed else "known", epochs=state.epochs + 1)


def with_random_forces(
    windows: FilteredWindows, state: FilterState, rounding: Float[np.ndarray, " channels"]
) -> FilterState:
    """The state with random forces of the size that makes readings likeliest, and its search to go on with them.

    Where none make them certainly likelier the search is at its end as it was. Every size is tried on the same members;
    one that makes a simulation fail which does not without forces is too large.
    """
    most, tried = largest(windows.dataset, windows.logged, windows.simulator), dict[float, Innovations]()
    tried[0.0] = _tried(windows, state, rounding, 0.0)
    without, done = tried[0.0].misfit(), replace(state, asked="known", epochs=state.epochs + 1)
    whole = np.isfinite(without)
    if not whole.any():
        return done
    costs = {0.0: float(without[whole].mean())}

    def cost(power: float) -> float:
        size = float(most * 10.0**power)
        tried[size] = _tried(windows, state, rounding, size)
        each = tried[size].misfit()[whole]
        costs[size] = float(each.mean()) if np.isfinite(each).all() else np.inf
        return costs[size]

    minimize_scalar(cost, bounds=(SMALLEST_SIZE, 0.0), method="bounded", options={"maxiter": SIZES})
    best = min(costs, key=costs.__getitem__)
    if not likelier(tried[best].misfit(), without, len(state.point)):
        return done
    return replace(
        done,
        force=best,
        noise=tried[best].noise,
        apart=np.zeros_like(state.apart),
        chance=np.zeros_like(state.chance),
        compared=0,
        moved=NEAR,
        quiet=0,
        halved=0,
        together=0,
        cost=0.0,
        alike=0.0,
        explained_share=0.0,
    )


def _tried(
    windows: FilteredWindows, state: FilterState, rounding: Float[np.ndarray, " channels"], size: float
) -> Innovations:
    """Prediction errors with random forces of a size in N/√kg, and with noise as it then is."""
    random = np.random.default_rng([state.seed, state.epochs])
    return with_noise(windows, state.point, state.noise, rounding, MEMBERS, SIZE_ROUNDS, random, size)[0]


def likelier(misfits: Float[np.ndarray, " windows"], without: Float[np.ndarray, " windows"], parameters: int) -> bool:
    """Whether windows' readings are certainly likelier than without a change; not where too few are whole to tell."""
    change = misfits - without
    change = change[np.isfinite(change)]
    enough = len(change) >= FEWEST + parameters
    return enough and bool(change.mean() < -BETTER * change.std(ddof=1) / np.sqrt(len(change)))
