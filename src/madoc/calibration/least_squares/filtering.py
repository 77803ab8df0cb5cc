"""The search where bodies touch: prediction errors of an ensemble filter instead of fitted starts.

Every reading of a window is predicted from those before it (`identification.ensembles`), so nothing but the parameters
is unknown, and each prediction error depends on no later noise: at the right parameters errors are uncorrelated with
anything known before them (prediction error method, Ljung 1999, chapter 7).

Errors and derivatives are those of two ensembles (`instruments`).
"""

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares import instruments, left_over
from madoc.calibration.least_squares.instruments import LIKE_CHANCE, NEAR, FilterState, Side
from madoc.calibration.least_squares.plan import FEWEST, touched
from madoc.data import stride
from madoc.identification.ensembles import SPOILT, FilteredWindows, next_noise, with_noise
from madoc.identification.gauss_newton import TRIALS, damped_step
from madoc.identification.information import sandwich
from madoc.identification.innovations import innovations
from madoc.identification.losses import Loss
from madoc.identification.replay import Readings
from madoc.identification.settling import FAILED_WINDOW
from madoc.identification.windows import disjoint_windows, interleaved, rows_that_fit
from madoc.types import Epoch, generator

STRIDES = 20
"""Length of a window in strides: after a few of them the filter knows the state as well as it ever does."""
LONGEST_WINDOW = 30
"""Largest length of a window in control steps, each of which is a step of the filter, however little moves in it."""
BLOCK, MOST_BLOCKS = 32, 8
"""Least number of windows of an epoch, of which the first ones, where steps are large, take half, and largest number of
such blocks."""
EARLY_EPOCHS = 8
"""Largest number of the first epochs, which end once the noise is known and steps are below `NEAR`."""
WIDTH = 0.1
"""Width of a difference in [-1, 1] to either side at first; later it is by what is known of parameters, `axes_of`."""
DAMPED = 10.0
"""Factor of the damping where no step helps."""
WORSE = 2.0
"""Mean change of the windows' surprise in its standard errors; above it a step certainly makes it worse."""
DAMPING = (1e-4, 1e2)
"""Smallest and largest damping of a step, relative to the columns' squared lengths."""
USUAL_EPOCHS = (2, 8)
"""Numbers of first and later epochs that most searches take, for the time that is told to be left; ensembles of half
the size take about half an epoch."""
FIRST_NOISE = 0.1
"""Smallest noise of a channel in its typical changes at the start: differences of rows may hide it."""
NOISE_SETTLED = 0.4
"""Relative change of noise variances, root of the mean square, below which they are as good as known."""
NOISE_ROUNDS = 3
"""Number of runs of an ensemble in each of the first epochs, which tell the noise better at little cost."""
TOUCHING = 0.05
"""Share in [0, 1] of windows in which bodies touch, from which on the log is one of contacts."""
FEW_TOUCH = (0.25, 0.5)
"""Shares in [0, 1] of windows in which bodies touch: below the first, others are left out; below the second, epochs
have twice as many windows, so that enough of them touch."""
FIRST_SEEN, MOST_SEEN = 64, 512
"""Number of windows of which it is asked first whether bodies touch in any, and largest number of which it is asked."""
MOST_TOLD = 0.9
"""Share in (0, 1) that counts of what a window tells where no other one tells of a direction."""


def horizon_of(problem: CalibrationProblem) -> int:
    """Length of the windows in control steps, short enough for twice as many of them as are needed."""
    fewest = 2 * (FEWEST + len(problem.simulator.parameters))
    return max(1, min(STRIDES * stride(problem.dataset), LONGEST_WINDOW, len(problem.dataset) // fewest - 1))


def of_contacts(
    problem: CalibrationProblem, key: PRNGKeyArray, horizon: int | None = None, windows: int | None = None
) -> FilterState | None:
    """The search before it has begun; None where few windows show contacts or are long, or states are unknown.

    `horizon` is the length of windows in control steps, `horizon_of` the problem by default, `windows` their largest
    number.
    """
    states, count = problem.states, len(problem.simulator.parameters)
    horizon, fewest = horizon or horizon_of(problem), FEWEST + count
    short = horizon < SPOILT + 2 or not len(rows_that_fit(problem.dataset, states.rows, horizon))
    if short or not states.starts_known:
        return None
    rows = states.rows[disjoint_windows(problem.dataset, states.rows, horizon)]
    if min(len(rows), windows or len(rows)) < fewest:
        return None
    rows = generator(key).permutation(rows)[:MOST_SEEN]
    if not touched(problem, rows[:FIRST_SEEN], horizon).any():
        return None
    touching = touched(problem, rows, horizon)
    if touching.sum() < max(TOUCHING * len(rows), fewest):
        return None
    size = max(BLOCK, 2 * fewest) * (1 if touching.mean() >= FEW_TOUCH[1] else 2)
    alone = max(size, int(touching.sum() / FEW_TOUCH[0] - touching.sum()))
    most = min(windows or len(rows), size * MOST_BLOCKS)
    rows = interleaved(rows[touching], rows[~touching][:alone])[:most]
    by_differences = (problem.noise_by_differences / problem.typical_change)[: states.measured]
    return FilterState(
        point=np.zeros(count),
        horizon=horizon,
        rows=rows,
        size=size,
        spread=WIDTH * np.eye(count),
        noise=np.maximum(by_differences, FIRST_NOISE),
        seed=int(np.asarray(jax.random.key_data(key))[-1]),
        gradients=np.zeros((len(rows), count)),
        products=np.zeros((len(rows), count, count)),
        squares=np.zeros((len(rows), count, count)),
        meat=np.zeros((count, count)),
        apart=np.zeros(count),
        chance=np.zeros((count, count)),
        shorter_steps=np.zeros(count),
    )


def epoch_steps(problem: CalibrationProblem, state: FilterState) -> int:
    """Control steps of the next epoch, but for windows lost in the last one; at rest no step is tried."""
    if members := left_over.members_for(state):
        return members * min(state.size, len(state.rows)) * state.horizon
    tried, rounds = 0 if state.at_rest else 1 + len(TRIALS), 1 if state.wide else NOISE_ROUNDS
    systems = rounds * state.members + (2 * 2 * len(problem.simulator.parameters) + tried) * instruments.FEW
    windows = len(state.rows[state.block])
    large = (
        left_over.LARGE_ROUNDS * left_over.LARGE * min(windows, state.size)
        if state.at_rest and state.to_compare == 1
        else 0
    )
    return (systems * windows + large) * state.horizon


def whole_run(problem: CalibrationProblem, state: FilterState) -> int:
    """About how many control steps a whole search takes, with the questions at its end, if no random forces act."""
    search = sum(USUAL_EPOCHS[wide] * epoch_steps(problem, replace(state, wide=wide)) for wide in (0, 1))
    return search + sum(epoch_steps(problem, replace(state, asked=each)) for each in ("shorter", "trial"))


def step(problem: CalibrationProblem, state: FilterState, loss: Loss) -> tuple[FilterState, Epoch]:
    """One step of the parameters, and the noise of every channel by how large its prediction errors were.

    Once the noise is known and the end is near both are by all epochs since, each of which has other windows, or the
    same ones once more where the log has no others, so that the chance of windows and of ensembles averages out.
    Gradients of earlier windows follow the parameters by what those tell of them.
    """
    block, count = state.block, state.members
    rows = state.rows[block]
    readings = Readings.at(problem.dataset, problem.states, rows, state.horizon, problem.typical_change)
    rounding = (problem.rounding / problem.typical_change)[: len(state.noise)]
    random = [np.random.default_rng([state.seed, state.epochs, number]) for number in range(3)]
    windows = FilteredWindows(problem.dataset, problem.states, problem.simulator, readings, rows)
    some = windows.of(np.arange(min(state.size, len(rows))))
    if left_over.members_for(state):
        return left_over.with_answer(some, state, rounding, loss), Epoch({"moved": state.moved})
    rounds = 1 if state.wide else NOISE_ROUNDS
    found, _ = with_noise(windows, state.point, state.noise, rounding, count, rounds, random[2], state.force)
    state = replace(state, noise=found.noise)
    given = windows, found, state.point, state.spread, count
    sides = [Side.of(*given, each, state.force) for each in random[:2]]
    whole = found.whole[0] & sides[0].ends.whole.all(0) & sides[1].ends.whole.all(0)
    fresh = instruments.products_of(sides[0], sides[1], whole, loss)
    if state.at_rest:
        # Errors of ensembles are in inverse proportion to their size: half errs by as much again.
        both = whole & state.squares[block].any((1, 2))
        differences = (fresh[0] - state.gradients[block])[both]
        failures = state.failures + int((~whole).sum())
        following = replace(
            state,
            apart=state.apart + differences.sum(0),
            chance=state.chance + differences.T @ differences,
            compared=state.compared + len(differences),
            halved=state.halved + 1,
            epochs=state.epochs + 1,
            failures=failures,
        )
        if following.settled:
            following = left_over.with_what_is_left(some, following, rounding, loss, random[2])
        return following, Epoch({"moved": state.moved})
    together = state.together + 1 if state.near else 0
    gradients, products, squares = (
        _counted(kept if together > 1 else np.zeros_like(kept), each, block, 1 + max(0, together - 1) // state.blocks)
        for kept, each in zip((state.gradients, state.products, state.squares), fresh, strict=True)
    )
    bread = instruments.agreed(products.sum(0), squares.sum(0))
    factor = np.linalg.cholesky(bread).T
    target = np.linalg.solve(factor.T, gradients.sum(0))
    undamped = damped_step(factor, target, state.point, 0.0)
    taken, damping = _taken(problem, state, readings, sides[0], factor, target, loss)
    told, seen = instruments.shares_of(squares), int(squares.any((1, 2)).sum())
    left_out = np.linalg.inv(np.eye(len(bread)) - MOST_TOLD * told)
    scores = (left_out @ gradients[..., None])[..., 0]  # about what leaving the window out would change
    meat = scores.T @ scores * seen / max(1, seen - len(state.point))
    covariance = sandwich(bread, meat).covariance
    error = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    noise = next_noise(state.noise, 1.0 + (found.noise_ratio() - 1.0) / max(1, together), rounding)
    moved, pull = instruments.moved_by(undamped, error), bread @ undamped
    quiet = bool((((noise / state.noise) ** 2 - 1.0) ** 2).mean() < NOISE_SETTLED**2)
    refused = not np.array_equal(taken, np.clip(undamped, -instruments.LONGEST, instruments.LONGEST))
    following = replace(
        state,
        point=state.point + taken,
        damping=damping,
        spread=instruments.axes_of(covariance),
        noise=noise,
        gradients=gradients + told @ (bread @ taken),
        products=products,
        squares=squares,
        meat=meat + np.outer(pull, pull),
        moved=max(moved, LIKE_CHANCE) if refused else moved,
        cost=instruments.over_windows(instruments.surprises(found, loss)),
        wide=state.wide + 1 if state.wide else int(state.epochs + 1 >= EARLY_EPOCHS or (quiet and moved < NEAR)),
        quiet=int(quiet),
        together=together,
        epochs=state.epochs + 1,
        failures=state.failures + int((~whole).sum()),
    )
    metrics = {"residual": following.cost**0.5, "moved": following.moved, "noise": float(np.median(noise))}
    return following, Epoch(metrics)


def _counted(
    kept: Float[np.ndarray, "*windows"], fresh: Float[np.ndarray, "*some"], block: slice, times: int
) -> Float[np.ndarray, "*windows"]:
    """The windows' values with those of a block, which is counted for so many times: the mean of all of them."""
    counted = kept.copy()
    counted[block] += (fresh - kept[block]) / times
    return counted


def _taken(
    problem: CalibrationProblem,
    state: FilterState,
    readings: Readings,
    side: Side,
    factor: Float[np.ndarray, "d d"],
    target: Float[np.ndarray, " d"],
    loss: Loss,
) -> tuple[Float[np.ndarray, " d"], float]:
    """The step after which one of the ensembles is surprised least by the readings, and the damping of the next one.

    Near the end chance decides which that is, so the whole step is taken there unless it certainly makes it worse.
    There is none, and the next is damped more, where none helps.
    """
    damping = state.damping * np.array(TRIALS) * [not state.near, True, True]
    tried = np.clip(
        [damped_step(factor, target, state.point, each) for each in damping], -instruments.LONGEST, instruments.LONGEST
    )
    points = np.concatenate([state.point[None], state.point + tried])
    given = problem.simulator, readings, points, side.few, state.noise
    surprise = innovations(*given, like=side.found, forces=side.forces).surprise(loss)
    change = surprise[1:] - surprise[0]
    fails = ((surprise[1:] == FAILED_WINDOW) & (surprise[0] < FAILED_WINDOW)).any(1)
    best = int(np.argmin(np.where(fails, np.inf, change.mean(1))))
    if state.near and not fails[0] and change[0].mean() <= WORSE * change[0].std() / np.sqrt(len(change[0])):
        best = 0
    elif fails[best] or not change[best].mean() < 0.0:
        return np.zeros_like(target), min(state.damping * DAMPED, DAMPING[1])
    return tried[best], float(np.clip(damping[best], *DAMPING))
