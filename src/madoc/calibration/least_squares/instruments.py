"""Errors and derivatives of a filter's predictions by two independent ensembles, each an instrument for the other.

Where bodies strike each other the cost is rough: it goes up and down with what strikes a step sooner, within a small
part of a standard error, and there a derivative does not tell where the minimum is. So errors and derivatives are means
and differences over points as far apart as parameters are uncertain (statistical linearisation, Gelb 1974, 6.2).

A prediction that is not linear between these points, as where something is just missed, tells little of where the
minimum is, and its derivatives are the largest. So how far it is off a line counts as noise of that reading (posterior
linearisation, García-Fernández et al. 2015).

A finite ensemble leaves chance in them, by which a least-squares step would be biased and too short, as both share it.
So there are two ensembles a and b, drawn independently, and the derivatives of each are instruments for the other
(Reiersol 1941):

    (Jaᵀ W Jb + Jbᵀ W Ja) p = -(Jbᵀ ψ(ra) + Jaᵀ ψ(rb)),

gives the step p, with ψ the slope of the robust loss and W its weights, and the same products give its covariance.
The state of the search that takes these steps is here too.
"""

from dataclasses import dataclass
from typing import Literal

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import ndtri

from madoc.calibration.least_squares.plan import FEWEST, LONG_TAILS, Found
from madoc.identification.ensembles import FilteredWindows, few_of, members_at
from madoc.identification.gauss_newton import FIRST_DAMPING
from madoc.identification.information import sandwich
from madoc.identification.innovations import Innovations, innovations
from madoc.identification.linearisation import LEAST_CURVATURE
from madoc.identification.losses import TUNING, Loss, curvature_share, loss_slope
from madoc.identification.noise import WHITE
from madoc.identification.random_forces import by_dof, opposed
from madoc.identification.settling import window_costs
from madoc.identification.systematic import EXPLAINED

FEW = 2
"""Even number of states at the ends of differences and after steps that are tried; time is better spent on windows."""
WIDTHS = (0.005, 0.4)
"""Smallest and largest width of a difference in [-1, 1] to either side."""
WIDER, WIDE = 3.0, 0.02
"""Factor by which differences are wider, up to the second, in [-1, 1]: so near the point predictions are as good as
linear, and there is less of the ensembles' chance in wider ones."""
OFF_LINE = 3.0
"""Standard deviations of noise that a prediction counts with for each that it is off a line: the minimum is farther
away than the ends of the differences are."""
LONGEST = 0.5
"""Largest change of a parameter in an epoch, in [-1, 1]."""
LARGEST_SHARE = 0.1
"""Largest share in [0, 1] of the squares of all windows, mean over all directions, that a window counts with."""
ROUNDS = 10  # of weighting windows of too large a share less
AGREEING = 1e-3
"""Smallest share in [0, 1] of the squares of an ensemble's derivatives that the other counts as agreeing on."""
_SMALLEST, _ROUNDING = 1e-100, 1e-12
MEMBERS = 32
"""Number of states in an ensemble; the last epochs, with half as many, tell what a finite one errs."""
NEAR, LIKE_CHANCE = 2.5, 1.0
"""Steps in what chance usually makes (`moved_by`), below which the first epochs end and later ones count together, and
below which the search ends."""
TOGETHER = 3
"""Least number of epochs that count together in the end."""


@dataclass(frozen=True)
class Side:
    """What one of the two ensembles says.

    Attributes:
        few: Some of its states at the first readings, with the mean and variance of all.
        found: Prediction errors at the point, of the states whose gains both ensembles follow readings by.
        ends: Those of few states at the ends of differences to either side of it.
        apart: The parameters' change in each difference, in rows.
        aside: How far the mean of its ends is from the point.
        forces: Random forces on the few states, in N or N·m; None where there are none.
    """

    few: Float[np.ndarray, "windows few state"]
    found: Innovations
    ends: Innovations
    apart: Float[np.ndarray, "d d"]
    aside: Float[np.ndarray, " d"]
    forces: Float[np.ndarray, "windows few steps dof"] | None

    @classmethod
    def of(
        cls,
        windows: FilteredWindows,
        found: Innovations,
        point: Float[np.ndarray, " d"],
        spread: Float[np.ndarray, "d d"],
        count: int,
        random: np.random.Generator,
        force: float = 0.0,
    ) -> "Side":
        """An ensemble of so many states, and differences to either side of the point, not out of a range.

        Its few states follow readings as those of `found` did. `spread` are the differences in columns, in [-1, 1].
        Random forces of size `force` (`random_forces`) act in pairs of opposite ones, so that their mean is 0.
        """
        dataset, states, simulator, readings, rows = windows
        members = members_at(dataset, states, simulator, rows, found.noise * readings.scale, count, random)
        few = few_of(members, FEW, states.physical_size)
        forces = opposed(by_dof(simulator, force), len(rows), FEW, readings.steps, random)
        above, below = (np.clip(point + sign * spread.T, -1.0, 1.0) for sign in (1, -1))
        both = np.concatenate([above, below])
        ends = innovations(simulator, readings, both, few, found.noise, like=found, forces=forces)
        return cls(few, found, ends, above - below, (above + below).mean(0) / 2.0 - point, forces)

    def errors(self) -> Float[np.ndarray, "windows values"]:
        """Whitened prediction errors at the point: the mean over the differences' ends, led back from theirs to it."""
        return self.found.counted(self.ends.whitened.mean(0)) - self.slopes() @ self.aside

    def off_line(self) -> Float[np.ndarray, "windows values"]:
        """Mean square over the differences of how far the mean of their ends is from the error at the point."""
        above, below = np.split(self.ends.whitened, 2)
        return self.found.counted((((above + below) / 2.0 - self.found.whitened[0]) ** 2).mean(0))

    def slopes(self) -> Float[np.ndarray, "windows values d"]:
        """The derivatives of these by the parameters."""
        above, below = np.split(self.ends.whitened, 2)
        change = np.stack([self.found.counted(each) for each in above - below])
        return np.moveaxis(np.linalg.solve(self.apart, change.reshape(len(change), -1)).reshape(change.shape), 0, -1)


def products_of(
    first: Side, second: Side, whole: Bool[np.ndarray, " windows"], loss: Loss
) -> tuple[
    Float[np.ndarray, "windows d"],
    Float[np.ndarray, "windows d d"],
    Float[np.ndarray, "windows d d"],
]:
    """Each window's gradient of the cost, products of both ensembles' derivatives, and squares of each's own.

    They are 0 in a window in which a simulation failed. An ensemble's errors are weighted by their own size alone, so
    that the other's derivatives share no chance with them. Predictions that are off a line have the noise `OFF_LINE`.
    """
    sides = first, second
    noise = np.sqrt(1.0 + OFF_LINE**2 * (first.off_line() + second.off_line())[whole] / 2.0)
    errors = [each.errors()[whole] / noise for each in sides]
    slopes = [each.slopes()[whole] / noise[..., None] for each in sides]
    z = [(each / TUNING[loss]) ** 2 for each in errors]
    weights = [loss_slope(each, loss) for each in z]
    both, counted = np.sqrt(weights[0] * weights[1]), np.ones(len(errors[0]))
    own = sum(np.einsum("wv,wvd,wve->wde", both, each, each) for each in slopes) / 2.0
    most = max(LARGEST_SHARE, 2.0 / max(1, len(own)))
    for _ in range(ROUNDS):
        shares = np.trace(shares_of(counted[:, None, None] * own), axis1=1, axis2=2) / own.shape[-1]
        counted = counted / np.maximum(1.0, shares / most)
    pulls = sum(
        np.einsum("wv,wvd->wd", weight * mine, other)
        for weight, mine, other in zip(weights, errors, reversed(slopes), strict=True)
    )
    products = np.einsum("wv,wvd,wve->wde", both, *slopes)
    curvature = max(curvature_share(np.stack(z), loss), LEAST_CURVATURE)
    gradients, all_products, squares = (np.zeros((len(whole), *each.shape[1:])) for each in (pulls, products, own))
    gradients[whole] = counted[:, None] * pulls / 2.0
    all_products[whole] = counted[:, None, None] * curvature * (products + np.swapaxes(products, 1, 2)) / 2.0
    squares[whole] = counted[:, None, None] * curvature * own
    return gradients, all_products, squares


def shares_of(squares: Float[np.ndarray, "windows d d"]) -> Float[np.ndarray, "windows d d"]:
    """Each window's squares over those of all."""
    total = squares.sum(0)
    return np.asarray(squares @ np.linalg.inv(total + np.diag(1e-9 * np.diag(total) + np.finfo(float).tiny)))


def agreed(products: Float[np.ndarray, "d d"], squares: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """The products, in no direction less than `AGREEING` of the squares: by chance they may be negative."""
    size = np.sqrt(np.maximum(np.diag(squares), _SMALLEST))
    relative = [each / np.outer(size, size) for each in (products, squares)]
    values, vectors = np.linalg.eigh(relative[1])
    root = vectors * np.sqrt(np.maximum(values, _ROUNDING))
    inverse = np.linalg.inv(root)
    shares, axes = np.linalg.eigh(inverse @ relative[0] @ inverse.T)
    whole = size[:, None] * (root @ axes * np.sqrt(np.maximum(shares, AGREEING)))
    return whole @ whole.T


def axes_of(covariance: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """√d standard errors along each axis of a covariance of d parameters, within `WIDTHS`, in columns.

    Means over the ends are those of cubic functions over its normal distribution (Arasaratnam and Haykin 2009). Where
    that is less than `WIDE` they are `WIDER`.
    """
    variances, axes = np.linalg.eigh(covariance)
    width = np.sqrt(len(axes) * np.maximum(variances, 0.0))
    return axes * np.clip(np.maximum(width, np.minimum(WIDER * width, WIDE)), *WIDTHS)


def moved_by(step: Float[np.ndarray, " d"], error: Float[np.ndarray, " d"]) -> float:
    """The largest component of a step in its standard errors, over the median of that of as many normal values."""
    usual = ndtri((1.0 + 0.5 ** (1.0 / len(step))) / 2.0)
    return float((np.abs(step) / error).max() / usual)


def beyond_chance(
    total: Float[np.ndarray, " d"], squares: Float[np.ndarray, "d d"], count: int
) -> Float[np.ndarray, " d"]:
    """A sum of so many values with these squares, shortened by as much as chance alone makes it longer.

    Its length is Hotelling's (1931) T², whose mean is d (n - 1) / (n - d - 2) if the values' is 0. As few values as
    that do not tell chance; their sum is left as it is.
    """
    size = len(total)
    if count <= size + 2:
        return total
    least = np.diag(1e-9 * total**2 + np.finfo(float).tiny)
    covariance = count / (count - 1.0) * (squares - np.outer(total, total) / count) + least
    usual = size * (count - 1.0) / (count - size - 2.0)
    return total * (1.0 - usual / max(float(total @ np.linalg.solve(covariance, total)), usual)) ** 0.5


def surprises(found: Innovations, loss: Loss) -> Float[np.ndarray, " windows"]:
    """Mean loss of a whitened prediction error that counts in each window; infinite where a simulation failed."""
    return np.where(found.whole[0], window_costs(found.counted(found.whitened[0]), loss), np.inf)


def over_windows(costs: Float[np.ndarray, " windows"]) -> float:
    """The mean over windows in which no simulation failed; 0 if there are none."""
    known = costs[np.isfinite(costs)]
    return float(known.mean()) if len(known) else 0.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FilterState:
    """The state of the search by an ensemble filter (`filtering`): where it is, and what its windows have told so far.

    Attributes:
        point: The parameters, in [-1, 1].
        horizon: Length of a window in control steps.
        rows: First rows of the windows, in random order, but that as many touch in every block of them.
        size: Number of windows of an epoch, a block of them.
        spread: Differences along each axis of the parameters' covariance, in [-1, 1], in columns.
        noise: Noise of each channel in its typical changes.
        seed: Seed of the ensembles' random numbers.
        gradients: Each window's gradient of the cost, 0 until an epoch has had it; the mean where several have.
        products: Of both ensembles' derivatives in each window, the curvature of the cost, likewise.
        squares: Of each ensemble's own, which chance makes larger.
        meat: Scatter of the gradients before the last step, which counts as an error.
        apart: What gradients of half as many states differ from these, sum of the windows compared so far.
        chance: Scatter of those differences.
        compared: Number of these windows.
        moved: The last step, by `moved_by`.
        damping: λ of the next step.
        cost: Mean loss of a whitened prediction error before it, in squared standard deviations.
        alike: The largest correlation that a channel's whitened error certainly has with that of the next reading, as
            noise has none; 0 until the end.
        wide: 0 in the first epochs, then 1 and the number of epochs since.
        quiet: 1 once noise, its mean over epochs that count together, has not changed much from one epoch to the next.
        halved: Number of blocks of windows compared with what half as many states tell.
        together: Number of epochs near the end that the last step was by, 0 before these.
        failures: Number of windows whose simulation failed.
        force: Size of random forces in N/√kg (`random_forces`), 0 until these are looked for.
        shorter_steps: By how much the parameters move without the timestep's error; 0 where the log is likelier with
            it, or without it errors are unlike noise too.
        asked: What is asked once the search has settled, and `nothing` before: whether a search from fitted starts
            leads to `exact` values, whether the log is likelier with a `shorter` timestep, by a `trial` whether random
            forces act, of what `size` they are, and nothing more when that is `known`.
        explained_share: Share in [0, 1] of prediction errors, or of random forces, that state and action explain
            (`Innovations.explained_by`); 0 until the end.
    """

    point: Float[np.ndarray, " d"]
    horizon: int
    rows: Int[np.ndarray, " windows"]
    size: int
    spread: Float[np.ndarray, "d d"]
    noise: Float[np.ndarray, " channels"]
    seed: int
    gradients: Float[np.ndarray, "windows d"]
    products: Float[np.ndarray, "windows d d"]
    squares: Float[np.ndarray, "windows d d"]
    meat: Float[np.ndarray, "d d"]
    apart: Float[np.ndarray, " d"]
    chance: Float[np.ndarray, "d d"]
    shorter_steps: Float[np.ndarray, " d"]
    compared: int = 0
    moved: float = 0.0
    damping: float = FIRST_DAMPING
    cost: float = 0.0
    alike: float = 0.0
    wide: int = 0
    quiet: int = 0
    halved: int = 0
    together: int = 0
    epochs: int = 0
    failures: int = 0
    force: float = 0.0
    asked: Literal["nothing", "exact", "shorter", "trial", "size", "known"] = "nothing"
    explained_share: float = 0.0

    @property
    def blocks(self) -> int:
        """Number of blocks of windows, of which every epoch has one."""
        return max(1, len(self.rows) // self.size)

    @property
    def block(self) -> slice:
        """The windows of the next epoch."""
        if not self.wide:
            return slice(0, self.size // 2)
        number = (self.halved if self.at_rest else self.together if self.near else 0) % self.blocks
        return slice(number * self.size, (number + 1) * self.size if number + 1 < self.blocks else None)

    @property
    def members(self) -> int:
        """Number of states in an ensemble of the next epoch."""
        return MEMBERS // 2 if self.at_rest else MEMBERS

    @property
    def explained(self) -> int:
        """Number of windows that count."""
        return int(self.squares.any((1, 2)).sum())

    @property
    def at_rest(self) -> bool:
        """Whether the last step, by several epochs in known noise, may be chance."""
        enough = self.explained >= FEWEST + len(self.point)
        return enough and self.together >= TOGETHER and bool(self.quiet) and self.moved < LIKE_CHANCE

    @property
    def to_compare(self) -> int:
        """Number of blocks still to be compared with what half as many states tell, once at rest."""
        return min(self.together, self.blocks) - self.halved

    @property
    def settled(self) -> bool:
        """Whether the search is at its end, the error of finite ensembles is known, and nothing is asked."""
        return self.at_rest and self.to_compare <= 0 and self.asked in ("nothing", "known")

    @property
    def unlike_noise(self) -> bool:
        """Whether errors at the end have long tails, are each like the next, or follow from state and action."""
        return self.cost > LONG_TAILS or self.alike > WHITE or self.explained_share > EXPLAINED

    @property
    def near(self) -> bool:
        """Whether the next step is to be by the next epoch and those before it that count together."""
        return self.wide > 1 and bool(self.quiet) and self.moved < NEAR

    @property
    def found(self) -> Found:
        """The point, with its uncertainty by the epochs that count together."""
        products, squares = self.products.sum(0), self.squares.sum(0)
        told = np.diag(squares) > 0.0
        bread = agreed(products, squares) * np.outer(told, told)
        error = beyond_chance(self.apart, self.chance, self.compared)
        uncertainty = sandwich(bread, self.meat + np.outer(error, error))
        unlike_noise, at_random = self.settled and self.unlike_noise, self.explained_share <= EXPLAINED
        force = self.force if self.settled and at_random else 0.0
        return Found(
            self.point, uncertainty, self.explained, self.settled, unlike_noise, force, shorter_steps=self.shorter_steps
        )
