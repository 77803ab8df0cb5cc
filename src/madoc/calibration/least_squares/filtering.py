"""The search where bodies touch and the log is noisy: prediction errors of an ensemble filter instead of fitted starts.

Every reading of a window is predicted from those before it (`identification.ensembles`), so nothing but the parameters
is unknown, and each prediction error depends on no later noise: at the right parameters errors are uncorrelated with
anything known before them (prediction error method, Ljung 1999, chapter 7).

Where bodies strike each other the cost is rough: it goes up and down with what strikes a step sooner, within a small
part of a standard error, and there a derivative does not tell where the minimum is. So errors and derivatives are means
and differences over points as far apart as parameters are uncertain (statistical linearisation, Gelb 1974, 6.2).

A finite ensemble leaves chance in them, by which a least-squares step would be biased and too short, as both share it.
So there are two independent ensembles a and b, whose derivatives are instruments for the other (Reiersol 1941):

    (Jaᵀ W Jb + Jbᵀ W Ja) p = -(Jbᵀ ψ(ra) + Jaᵀ ψ(rb)),

gives the step p, with ψ the slope of the robust loss and W its weights, and the same products give its covariance.
"""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.plan import FEWEST, FIRST_DAMPING, TRIALS, Found
from madoc.calibration.least_squares.statistics import LONG_TAILS, touched
from madoc.data import stride
from madoc.identification import ensembles
from madoc.identification.ensembles import Innovations, agreed, innovations, members_at
from madoc.identification.gauss_newton import damped_step
from madoc.identification.information import sandwich
from madoc.identification.linearisation import LEAST_CURVATURE
from madoc.identification.losses import TUNING, Loss, curvature_share, loss_slope
from madoc.identification.noise import WHITE
from madoc.identification.replay import Readings
from madoc.identification.settling import FAILED_WINDOW, window_costs
from madoc.identification.windows import disjoint_windows, rows_that_fit
from madoc.types import Epoch, generator

STRIDES = 20
"""Length of a window in strides: after a few of them the filter knows the state as well as it ever does."""
LONGEST_WINDOW = 30
"""Largest length of a window in control steps, each of which is a step of the filter, however little moves in it."""
MOST, EARLY = 32, 16
"""Largest number of windows, and in the first epochs, in which steps are large."""
EARLY_EPOCHS = 10
"""Largest number of the first epochs, which end once the noise is known and steps are below `NEAR`."""
MEMBERS = 16
"""Number of states in an ensemble; the last epoch, with half as many, tells what a finite one errs."""
WIDTH, WIDTHS = 0.1, (0.005, 0.4)
"""Width of a difference in [-1, 1] to either side at first, and its smallest and largest later, see `_axes`."""
LONGEST = 0.5
"""Largest change of a parameter in an epoch, in [-1, 1]."""
DAMPED = 10.0
"""Factor of the damping where no step helps."""
WORSE = 2.0
"""Mean change of the windows' surprise in its standard errors; above it a step certainly makes it worse."""
DAMPING = (1e-4, 1e2)
"""Smallest and largest damping of a step, relative to the columns' squared lengths."""
LARGEST_SHARE = 0.1
"""Largest share in [0, 1] of the squares of all windows, mean over all directions, that a window counts with."""
NEAR, LIKE_CHANCE = 2.5, 1.0
"""Steps in standard errors, below which epochs are averaged, and below which the mean is at its end."""
USUAL_EPOCHS = (8, 3)
"""Numbers of first and later epochs that most searches take, for the time that is told to be left."""
NOISE_SETTLED = 0.4
"""Relative change of a noise variance, below which it is as good as known."""
MOSTLY = 0.5
"""Share in [0, 1] of the windows in which bodies touch, from which on the log is one of contacts."""
MOST_TOLD = 0.9
"""Share in (0, 1) that counts of what a window tells where no other one tells of a direction."""
ROUNDS = 10  # of weighting windows of too large a share less


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FilterState:
    """The state of the search.

    Attributes:
        point: The parameters, in [-1, 1].
        rows: First rows of the windows, in random order.
        spread: Differences along each axis of the parameters' covariance, in [-1, 1], in columns.
        noise: Noise of each channel in its typical changes.
        seed: Seed of the ensembles' random numbers.
        gradients: Each window's gradient of the cost, the mean of the epochs that are averaged.
        products: Of both ensembles' derivatives, the curvature of the cost, as a mean as well.
        squares: Of each ensemble's own, which chance makes larger.
        meat: Scatter of the gradients before the last step, which counts as an error.
        moved: The largest component of the last step in its standard errors.
        damping: λ of the next step.
        cost: Mean loss of a whitened prediction error before it, in squared standard deviations.
        alike: The largest correlation of a channel's whitened error with that of the next reading, as noise has none.
        explained: Number of windows in which no simulation failed.
        wide: 0 in the first epochs, then 1 and the number of epochs on all windows.
        quiet: 1 once no noise has changed much from one epoch to the next.
        halved: 1 once half as many states have told the error of finite ensembles.
        averaged: Number of epochs whose mean with the one before them the last step was by.
        epochs: Number of epochs.
        failures: Number of windows whose simulation failed.
    """

    point: Float[np.ndarray, " d"]
    rows: Int[np.ndarray, " windows"]
    spread: Float[np.ndarray, "d d"]
    noise: Float[np.ndarray, " channels"]
    seed: int
    gradients: Float[np.ndarray, "windows d"]
    products: Float[np.ndarray, "d d"]
    squares: Float[np.ndarray, "d d"]
    meat: Float[np.ndarray, "d d"]
    moved: float
    damping: float
    cost: float
    alike: float
    explained: int
    wide: int
    quiet: int
    halved: int
    averaged: int
    epochs: int
    failures: int

    @property
    def in_use(self) -> tuple[Int[np.ndarray, " some"], int]:
        """First rows of the windows of the next epoch, and the number of states in its ensembles."""
        rows = self.rows if self.wide else self.rows[:EARLY]
        return rows, MEMBERS // 2 if self.at_rest else MEMBERS

    @property
    def at_rest(self) -> bool:
        """Whether the last step, on all windows and in known noise, may be chance."""
        enough = self.explained >= FEWEST + len(self.point)
        return enough and bool(self.averaged and self.quiet) and self.moved < LIKE_CHANCE

    @property
    def settled(self) -> bool:
        """Whether the search is at its end, and the error of finite ensembles is known."""
        return self.at_rest and bool(self.halved)

    @property
    def near(self) -> bool:
        """Whether the next step is to be by the mean of this epoch and those that follow."""
        return self.wide > 1 and bool(self.quiet) and self.moved < NEAR

    @property
    def found(self) -> Found:
        """The point, with its uncertainty by the last epoch."""
        told = np.diag(self.squares) > 0.0
        bread = agreed(self.products, self.squares) * np.outer(told, told)
        unlike_noise = self.settled and (self.cost > LONG_TAILS or self.alike > WHITE)
        return Found(self.point, sandwich(bread, self.meat), self.explained, self.settled, unlike_noise)


def horizon_of(problem: CalibrationProblem) -> int:
    """Length of the windows in control steps, short enough for twice as many of them as are needed."""
    fewest = 2 * (FEWEST + len(problem.simulator.parameters))
    return max(1, min(STRIDES * stride(problem.dataset), LONGEST_WINDOW, len(problem.dataset) // fewest - 1))


def of_contacts(problem: CalibrationProblem, key: PRNGKeyArray) -> FilterState | None:
    """The search before it has begun; None where few windows show contacts, or sensors do not show all positions."""
    states, count = problem.states, len(problem.simulator.parameters)
    if not states.starts_known or states.placed.any() or not ensembles.can_be_drawn(states, problem.simulator):
        return None
    horizon = horizon_of(problem)
    if not len(rows_that_fit(problem.dataset, states.rows, horizon)):
        return None
    rows = states.rows[disjoint_windows(problem.dataset, states.rows, horizon)]
    if len(rows) < FEWEST + count:
        return None
    rows = generator(key).permutation(rows)[: max(MOST, 2 * (FEWEST + count))]
    if touched(problem, *states.guesses(), rows, horizon).mean() < MOSTLY:
        return None
    by_differences = (problem.noise_by_differences / problem.typical_change)[: states.measured]
    return FilterState(
        point=np.zeros(count),
        rows=rows,
        spread=WIDTH * np.eye(count),
        noise=np.maximum(by_differences, ensembles.LEAST_NOISE),
        seed=int(np.asarray(jax.random.key_data(key))[-1]),
        gradients=np.zeros((len(rows), count)),
        products=np.zeros((count, count)),
        squares=np.zeros((count, count)),
        meat=np.zeros((count, count)),
        moved=0.0,
        damping=FIRST_DAMPING,
        cost=0.0,
        alike=0.0,
        explained=0,
        wide=0,
        quiet=0,
        halved=0,
        averaged=0,
        epochs=0,
        failures=0,
    )


def epoch_steps(problem: CalibrationProblem, state: FilterState) -> int:
    """Control steps of the next epoch; where the search is at rest no step is tried."""
    (rows, members), tried = state.in_use, 0 if state.at_rest else 1 + len(TRIALS)
    return (2 * (1 + 2 * len(problem.simulator.parameters)) + tried) * len(rows) * members * horizon_of(problem)


def whole_run(problem: CalibrationProblem, state: FilterState) -> int:
    """About how many control steps a whole search takes."""
    return sum(USUAL_EPOCHS[wide] * epoch_steps(problem, replace(state, wide=wide)) for wide in (0, 1))


def step(problem: CalibrationProblem, state: FilterState, loss: Loss) -> tuple[FilterState, Epoch]:
    """One step of the parameters, and the noise of every channel by how large its prediction errors were.

    Once the noise is known and the end is near it is by the mean of all epochs since, so that the chance of ensembles
    averages out.
    """
    rows = state.in_use[0]
    readings = Readings.at(problem.dataset, problem.states, rows, horizon_of(problem), problem.typical_change)
    sides = [_Side.of(problem, state, readings, number) for number in (0, 1)]
    whole = np.asarray(sides[0].found.whole.all(0) & sides[1].found.whole.all(0))
    pulls, products, squares, shares = _products(sides[0], sides[1], whole, loss)
    if state.at_rest:
        pull = pulls.sum(0)  # errors of ensembles are in inverse proportion to their size: half errs by as much again
        following = replace(state, meat=state.meat + np.outer(pull, pull), halved=1, epochs=state.epochs + 1)
        return following, Epoch({"moved": state.moved}, epoch_steps(problem, state))
    gradients, told = np.zeros_like(state.gradients), np.zeros((len(state.rows), *products.shape))
    gradients[np.flatnonzero(whole)], told[np.flatnonzero(whole)] = pulls, shares
    averaged = state.averaged + 1 if state.near else 0
    if averaged:
        share = 1.0 / (averaged + 1)
        gradients = state.gradients + share * (gradients - state.gradients)
        products = state.products + share * (products - state.products)
        squares = state.squares + share * (squares - state.squares)
    bread = agreed(products, squares)
    factor = np.linalg.cholesky(bread).T
    target = np.linalg.solve(factor.T, gradients.sum(0))
    undamped = damped_step(factor, target, state.point, 0.0)
    taken, damping = _taken(problem, state, readings, sides[0], factor, target, loss)
    left_out = np.linalg.inv(np.eye(len(bread)) - MOST_TOLD * told)
    scores = (left_out @ gradients[..., None])[..., 0]  # about what leaving the window out would change
    meat = scores.T @ scores * len(rows) / max(1, len(rows) - len(state.point))
    covariance = sandwich(bread, meat).covariance
    error = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    ratio = np.mean([each.found.noise_ratio(each.first) for each in sides], axis=0)
    noise = state.noise * np.sqrt(np.clip(ratio, *ensembles.NOISE_CHANGE))
    rounding = (problem.rounding / problem.typical_change)[: len(noise)]
    noise = np.maximum(noise, np.maximum(rounding, ensembles.LEAST_NOISE * noise.max()))
    moved, pull = float((np.abs(undamped) / error).max()), bread @ undamped
    quiet = bool((np.abs((noise / state.noise) ** 2 - 1.0) < NOISE_SETTLED).all())
    refused = not np.array_equal(taken, np.clip(undamped, -LONGEST, LONGEST))
    following = replace(
        state,
        point=state.point + taken,
        damping=damping,
        spread=_axes(covariance),
        noise=noise,
        gradients=gradients + told @ (bread @ taken),
        products=products,
        squares=squares,
        meat=meat + np.outer(pull, pull),
        moved=max(moved, LIKE_CHANCE) if refused else moved,
        cost=float(np.mean([window_costs(each.at_point(), loss)[whole] for each in sides])) if whole.any() else 0.0,
        alike=float(np.mean([each.found.alike(each.first) for each in sides])),
        explained=int(whole.sum()),
        wide=state.wide + 1 if state.wide else int(state.epochs + 1 >= EARLY_EPOCHS or (quiet and moved < NEAR)),
        quiet=int(quiet),
        averaged=averaged,
        epochs=state.epochs + 1,
        failures=state.failures + int((~whole).sum()),
    )
    metrics = {"residual": following.cost**0.5, "moved": following.moved, "noise": float(np.median(noise))}
    return following, Epoch(metrics, epoch_steps(problem, state))


def _taken(
    problem: CalibrationProblem,
    state: FilterState,
    readings: Readings,
    side: "_Side",
    factor: Float[np.ndarray, "d d"],
    target: Float[np.ndarray, " d"],
    loss: Loss,
) -> tuple[Float[np.ndarray, " d"], float]:
    """The step after which one of the ensembles is surprised least by the readings, and the damping of the next one.

    Near the end chance decides which that is, so the whole step is taken there unless it certainly makes it worse.
    There is none, and the next is damped more, where none helps.
    """
    damping = state.damping * np.array(TRIALS) * [not state.near, True, True]
    tried = np.clip([damped_step(factor, target, state.point, each) for each in damping], -LONGEST, LONGEST)
    points = np.concatenate([state.point[None], state.point + tried])
    surprise = innovations(problem.simulator, readings, points, side.members, state.noise).surprise(loss)
    change = surprise[1:] - surprise[0]
    fails = ((surprise[1:] == FAILED_WINDOW) & (surprise[0] < FAILED_WINDOW)).any(1)
    best = int(np.argmin(np.where(fails, np.inf, change.mean(1))))
    if state.near and not fails[0] and change[0].mean() <= WORSE * change[0].std() / np.sqrt(len(change[0])):
        best = 0
    elif fails[best] or not change[best].mean() < 0.0:
        return np.zeros_like(target), min(state.damping * DAMPED, DAMPING[1])
    return tried[best], float(np.clip(damping[best], *DAMPING))


@dataclass(frozen=True)
class _Side:
    """What one of the two ensembles says.

    Attributes:
        members: Its states at the first readings.
        found: Prediction errors at the point and at its neighbours.
        apart: The parameters' change in each difference, in rows.
        aside: How far the mean of its ends is from the point.
        first: The first step whose errors count.
    """

    members: Float[np.ndarray, "windows members state"]
    found: Innovations
    apart: Float[np.ndarray, "d d"]
    aside: Float[np.ndarray, " d"]
    first: int

    @classmethod
    def of(
        cls,
        problem: CalibrationProblem,
        state: FilterState,
        readings: Readings,
        number: int,
    ) -> "_Side":
        """One ensemble, and differences to either side of the point, not out of a range."""
        random = np.random.default_rng([state.seed, state.epochs, number])
        noise = state.noise * readings.scale
        rows, count = state.in_use
        members = members_at(problem.dataset, problem.states, problem.simulator, rows, noise, count, random)
        above, below = (np.clip(state.point + sign * state.spread.T, -1.0, 1.0) for sign in (1, -1))
        points, aside = np.concatenate([state.point[None], above, below]), (above + below).mean(0) / 2.0 - state.point
        found = innovations(problem.simulator, readings, points, members, state.noise)
        return cls(members, found, above - below, aside, 0 if problem.states.kind == "exact" else ensembles.SPOILT)

    def errors(self) -> Float[np.ndarray, "windows values"]:
        """Whitened prediction errors at the point: the mean over the differences' ends, led back from theirs to it."""
        return self._told(self.found.whitened[1:].mean(0)) - self.slopes() @ self.aside

    def at_point(self) -> Float[np.ndarray, "windows values"]:
        """Whitened prediction errors simulated at the point itself."""
        return self._told(self.found.whitened[0])

    def slopes(self) -> Float[np.ndarray, "windows values d"]:
        """The derivatives of these by the parameters."""
        above, below = np.split(self.found.whitened[1:], 2)
        change = np.stack([self._told(each) for each in above - below])
        return np.moveaxis(np.linalg.solve(self.apart, change.reshape(len(change), -1)).reshape(change.shape), 0, -1)

    def _told(self, errors: Float[np.ndarray, "windows steps channels"]) -> Float[np.ndarray, "windows values"]:
        """The errors that count, of all channels but those that never differ."""
        kept = (self.found.whitened[0, :, self.first :] != 0.0).any((0, 1))
        return errors[:, self.first :, kept].reshape(len(errors), -1)


def _products(
    first: _Side, second: _Side, whole: Bool[np.ndarray, " windows"], loss: Loss
) -> tuple[
    Float[np.ndarray, "windows d"],
    Float[np.ndarray, "d d"],
    Float[np.ndarray, "d d"],
    Float[np.ndarray, "windows d d"],
]:
    """The gradient of each window's cost, products of both ensembles' derivatives and squares of each's own.

    Last each window's squares over those of all. An ensemble's errors are weighted by their own size alone, so that the
    other's derivatives share no chance with them.
    """
    errors, slopes = (first.errors()[whole], second.errors()[whole]), (first.slopes()[whole], second.slopes()[whole])
    z = [(each / TUNING[loss]) ** 2 for each in errors]
    weights = [loss_slope(each, loss) for each in z]
    both, counted = np.sqrt(weights[0] * weights[1]), np.ones(len(errors[0]))
    own = sum(np.einsum("wv,wvd,wve->wde", both, each, each) for each in slopes) / 2.0
    most = max(LARGEST_SHARE, 2.0 / max(1, len(own)))
    for _ in range(ROUNDS):
        squares = own.sum(0)
        shares = own @ np.linalg.inv(squares + np.diag(1e-9 * np.diag(squares) + np.finfo(float).tiny))
        less = 1.0 / np.maximum(1.0, np.trace(shares, axis1=1, axis2=2) / len(squares) / most)
        counted, own = counted * less, own * less[:, None, None]
    pulls = sum(
        np.einsum("wv,wvd->wd", weight * mine, other)
        for weight, mine, other in zip(weights, errors, reversed(slopes), strict=True)
    )
    products = np.einsum("w,wv,wvd,wve->de", counted, both, *slopes)
    curvature = max(curvature_share(np.stack(z), loss), LEAST_CURVATURE)
    return counted[:, None] * pulls / 2.0, curvature * (products + products.T) / 2.0, curvature * own.sum(0), shares


def _axes(covariance: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """√d standard errors along each axis of a covariance of d parameters, within `WIDTHS`, in columns.

    Means over the ends are those of cubic functions over its normal distribution (Arasaratnam and Haykin 2009).
    """
    variances, axes = np.linalg.eigh(covariance)
    return axes * np.clip(np.sqrt(len(axes) * np.maximum(variances, 0.0)), *WIDTHS)
