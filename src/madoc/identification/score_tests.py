"""Score tests of terms that a model may lack (Rao 1948), on windows of a log that are simulated at the estimate.

Residuals and derivatives enter as their sums of products within each window. Standard errors are those of leaving out
one window at a time, so they hold for residuals that are correlated within a window or larger in some windows than in
others (Liang and Zeger 1986; MacKinnon and White 1985), with as many degrees of freedom as there are windows that tell
of a term (Carter, Schnepel and Steigerwald 2017). The influence of a window in which a contact magnifies every
change is bounded (Mallows 1975).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.special import fdtrc, ndtr, ndtri, stdtr, stdtrit

REACH = 3.0
"""Length of a column of derivatives in a window relative to the median window's; a window with more is shrunk to it."""
WINDOWS_EACH = 10
"""Number of windows for each principal component of a family, so that their covariance is well known."""
_DISTINCT = 1e-3
"""Share of a column's squares that the columns before it cannot imitate; below it the two are one."""
_SINGULAR = 1e-10
"""Smallest eigenvalue of a matrix of products, relative to the largest, that counts as more than 0."""


@dataclass(frozen=True)
class Products:
    """Sums of products within each window: of the residuals (index 0), and of the columns of derivatives (from 1 on).

    `count` columns, the first ones, are those of the calibrated parameters.
    """

    each: Float[np.ndarray, "windows columns columns"]
    count: int

    @classmethod
    def of(
        cls,
        residuals: Float[np.ndarray, "windows values"],
        by_parameters: Float[np.ndarray, "windows values d"],
        others: Float[np.ndarray, "windows values terms"],
    ) -> "Products":
        """Those of residuals, of their derivatives by the parameters, and by other terms."""
        columns = np.concatenate([residuals[..., None], by_parameters, others], axis=-1)
        return cls(np.swapaxes(columns, 1, 2) @ columns, by_parameters.shape[-1])

    def __len__(self) -> int:
        return len(self.each)

    @property
    def parameters(self) -> list[int]:
        """Indices of the calibrated parameters' columns."""
        return list(range(1, 1 + self.count))

    def with_parameters(self, kept: Sequence[int]) -> "Products":
        """The same with only these of the parameters counted as such, the others behind them before all other terms."""
        others = [index for index in range(self.count) if index not in kept]
        first = [0, *(1 + index for index in (*kept, *others))]
        order = [*first, *range(len(first), self.each.shape[1])]
        return Products(self.each[:, order][:, :, order], len(kept))

    def less(self, index: int, change: float) -> "Products":
        """The same of residuals from which a column with this change of its coefficient is taken away."""
        each = self.each.copy()
        each[:, 0] += change * self.each[:, index]
        each[:, :, 0] += change * each[:, :, index]
        return Products(each, self.count)

    def combined(
        self, included: Sequence[int], terms: Sequence[int], weights: Float[np.ndarray, "some few"]
    ) -> "Products":
        """Those of the residuals, the included columns, and sums of the terms' columns with these weights."""
        first = np.array([0, *included])
        corner, mixed = self.each[:, first[:, None], first], self.each[:, first[:, None], np.array(terms)] @ weights
        inner = weights.T @ self.each[:, np.array(terms)[:, None], np.array(terms)] @ weights
        upper, lower = (
            np.concatenate([corner, mixed], axis=2),
            np.concatenate([np.swapaxes(mixed, 1, 2), inner], axis=2),
        )
        return Products(np.concatenate([upper, lower], axis=1), self.count)

    def bounded(self, columns: Sequence[int]) -> Float[np.ndarray, "windows some some"]:
        """The products of the residuals and these columns, in this order.

        No window has more than `REACH` times the usual length of any of the columns.
        """
        lengths = np.sqrt(np.maximum(self.each[:, columns, columns], 0.0))
        usual = np.array([np.median(column[column > 0.0]) if column.any() else 0.0 for column in lengths.T])
        longest = (lengths / np.where(usual > 0.0, REACH * usual, np.inf)).max(1)
        chosen = np.array([0, *columns])
        return self.each[:, chosen[:, None], chosen] / np.maximum(longest, 1.0)[:, None, None] ** 2


@dataclass(frozen=True)
class Score:
    """One term's change from the model, in its reference, and what is known of it.

    Attributes:
        change: The change that explains the residuals best.
        error: Its standard error.
        explained: Share of the squared residuals that it explains, those of initial states and parameters taken away.
        shifts: How it moves each calibrated parameter, in [-1, 1].
        freedom: Degrees of freedom of the standard error: the number of windows that tell of the term, less one and the
            columns included.
    """

    change: float
    error: float
    explained: float
    shifts: Float[np.ndarray, " d"]
    freedom: float

    @property
    def t(self) -> float:
        """The change over its standard error; see `deviate`."""
        return deviate(self.change / self.error, self.freedom)

    @property
    def reach(self) -> float:
        """Half of the 95 % interval of the change, by Student's t."""
        return float(stdtrit(self.freedom, 0.975)) * self.error


def deviate(ratio: float, freedom: float) -> float:
    """The normal deviate of the same probability as this ratio of an estimate to its standard error.

    With few degrees of freedom large ratios come by chance (Student 1908), so that thresholds would mean little.
    """
    chance = max(float(stdtr(freedom, -abs(ratio))), np.finfo(float).tiny)
    return float(np.copysign(ndtri(chance), ratio))


def shared_deviate(t: float, tests: int) -> float:
    """The normal deviate by whose probability one of so many tests exceeds t by chance, at most (Bonferroni 1936)."""
    return -float(ndtri(min(1.0, tests * max(float(ndtr(-t)), np.finfo(float).tiny))))


def score(
    products: Products,
    index: int,
    already: Sequence[int] = (),
    shape: Float[np.ndarray, " windows"] | None = None,
) -> Score | None:
    """The score test of one column, where the parameters' columns and those `already` included explain what they can.

    With a `shape`, the column is multiplied by its value in each window. None if the column is no other than those
    included, or if a single window holds all that is known of it.
    """
    included = [*products.parameters, *already]
    each = products.bounded([*included, index])
    shape = np.ones(len(products)) if shape is None else shape
    inner, with_residuals, mixed = each[:, 1:-1, 1:-1], each[:, 1:-1, 0], shape[:, None] * each[:, 1:-1, -1]
    total, right = inner.sum(0), with_residuals.sum(0)
    imitation, fitted = _solved(total, mixed.sum(0)), _solved(total, right)
    own = shape**2 * each[:, -1, -1]
    alone = own - 2.0 * mixed @ imitation + np.einsum("wij,i,j->w", inner, imitation, imitation)
    power = float(alone.sum())
    if power <= _DISTINCT * own.sum():
        return None
    left = shape * each[:, -1, 0] - mixed @ fitted
    left -= with_residuals @ imitation - np.einsum("wij,i,j->w", inner, imitation, fitted)
    change = -float(left.sum()) / power
    without = power - alone
    if (without <= _DISTINCT * power).any():
        return None
    error = float(_jackknife(((left + change * alone) / without)[:, None])[0, 0]) ** 0.5
    # Windows are left out at the same coefficients of the columns included, which have been fitted to all of them.
    error *= np.sqrt(len(each) / max(1, len(each) - len(included)))
    squares = each[:, 0, 0].sum() - 2.0 * fitted @ right + fitted @ total @ fitted
    own_columns = slice(products.count)
    response = _solved(total[own_columns, own_columns], mixed.sum(0)[own_columns])
    if not error > 0.0:
        return None
    freedom = max(1.0, power**2 / float((alone**2).sum()) - 1.0 - len(included))
    return Score(change, error, change**2 * power / float(squares), -response * change, freedom)


@dataclass(frozen=True)
class FamilyScore:
    """What several columns tell as one family.

    Attributes:
        t: The normal deviate of the probability of the family's statistic.
        changes: Of each column, in its reference, as they explain the residuals: of all, or of the leading one alone
            where that is more significant.
        explained: Share of the squared residuals that they explain, those of initial states and parameters taken away.
        shifts: How they move each calibrated parameter, in [-1, 1].
        errors: Standard errors of the shifts.
        leading: The column that by itself is the most significant.
    """

    t: float
    changes: Float[np.ndarray, " terms"]
    explained: float
    shifts: Float[np.ndarray, " d"]
    errors: Float[np.ndarray, " d"]
    leading: int


def family_score(products: Products, terms: Sequence[int], already: Sequence[int] = ()) -> FamilyScore | None:
    """Whether columns explain anything where the parameters' columns and those `already` included do not.

    They are tested together, and the most significant one by itself as one of so many (Bonferroni 1936). A mixture of
    many shows in the first way, and what is nearly one of them, however many others there are, in the second. The more
    significant counts, as one of two. None if all columns are imitated by those included.
    """
    single = {place: found for place, term in enumerate(terms) if (found := score(products, term, already)) is not None}
    together = _together(products, terms, already)
    if not single:
        return None
    leading = max(single, key=lambda place: abs(single[place].t))
    best = single[leading]
    t = shared_deviate(abs(best.t), 2 * len(terms))
    if together is not None and shared_deviate(together.t, 2) > t:
        return replace(together, t=shared_deviate(together.t, 2), leading=leading)
    changes = np.where(np.arange(len(terms)) == leading, best.change, 0.0)
    errors = np.abs(best.shifts) * best.error / abs(best.change)
    return FamilyScore(t, changes, best.explained, best.shifts, errors, leading)


def _together(products: Products, terms: Sequence[int], already: Sequence[int]) -> FamilyScore | None:
    """All columns by one statistic; its `leading` column is not told.

    The residuals' products with what is left of the columns are the score of each window. If nothing is missing their
    mean is 0, and its square in units of their own covariance between windows has Hotelling's (1931) distribution, with
    as many degrees of freedom as there are windows that tell of the columns. Only the largest principal components of
    columns count, one for `WINDOWS_EACH` windows at most; what they explain is what chance does not.
    """
    included = [*products.parameters, *already]
    weights = _principal(products.each.sum(0), included, terms, max(1, len(products) // WINDOWS_EACH))
    count, few = len(included), weights.shape[1]
    if not few:
        return None
    each = products.combined(included, terms, weights).bounded(range(1, 1 + count + few))
    fixed, own = slice(1, 1 + count), slice(1 + count, None)
    inner, right, mixed = each[:, fixed, fixed], each[:, fixed, 0], each[:, fixed, own]
    total = inner.sum(0)
    imitation, fitted = _solved(total, mixed.sum(0)), _solved(total, right.sum(0))
    crossed = np.swapaxes(mixed, 1, 2) @ imitation
    alone = each[:, own, own] - crossed - np.swapaxes(crossed, 1, 2) + imitation.T @ inner @ imitation
    left = each[:, own, 0] - np.einsum("wij,i->wj", mixed, fitted)
    left -= right @ imitation - np.einsum("wij,ik,j->wk", inner, imitation, fitted)
    power = alone.sum(0)
    inverse = np.linalg.pinv(power, rcond=_SINGULAR, hermitian=True)
    leverage = np.einsum("wij,ji->w", alone, inverse)
    windows = few**2 / max(float((leverage**2).sum()), np.finfo(float).tiny) - count
    if windows <= few + 1:
        return None
    mean, spread = left.mean(0), np.atleast_2d(np.cov(left, rowvar=False))
    squared = len(left) * float(mean @ np.linalg.pinv(spread, rcond=_SINGULAR, hermitian=True) @ mean)
    chance = float(fdtrc(few, windows - few, (windows - few) / (few * (windows - 1)) * squared)) / 2.0
    change = -inverse @ left.sum(0)
    influence = (left + np.einsum("wij,j->wi", alone, change)) @ inverse
    scatter = influence.T @ influence * len(left) / max(1, len(left) - count - few)
    squares = each[:, 0, 0].sum() - 2.0 * fitted @ right.sum(0) + fitted @ total @ fitted
    response = -imitation[: products.count]
    return FamilyScore(
        t=-float(ndtri(max(chance, np.finfo(float).tiny))),
        changes=weights @ change,
        explained=max(0.0, float(change @ power @ change) - float(np.trace(scatter @ power))) / float(squares),
        shifts=response @ change,
        errors=np.sqrt(np.maximum(np.diag(response @ scatter @ response.T), 0.0)),
        leading=0,
    )


def _principal(
    total: Float[np.ndarray, "columns columns"], included: Sequence[int], terms: Sequence[int], most: int
) -> Float[np.ndarray, "terms few"]:
    """Weights of the terms' columns in the largest principal components of what those included leave of them.

    Each column counts alike, by its length before; one that is imitated does not count.
    """
    chosen, own = np.array(included, dtype=int), np.array(terms)
    imitation = _solved(total[chosen[:, None], chosen], total[chosen[:, None], own])
    left = total[own[:, None], own] - total[own[:, None], chosen] @ imitation
    before, alone = np.diag(total)[own], np.maximum(np.diag(left), 0.0)
    counted = alone > _DISTINCT * before
    scale = np.where(counted, 1.0 / np.sqrt(np.where(counted, alone, 1.0)), 0.0)
    sizes, directions = np.linalg.eigh(left * scale[:, None] * scale)
    kept = np.argsort(-sizes)[:most]
    kept = kept[sizes[kept] > _DISTINCT * max(float(sizes.max(initial=0.0)), np.finfo(float).tiny)]
    return scale[:, None] * directions[:, kept] / np.sqrt(sizes[kept])


def imitators(products: Products, index: int) -> Float[np.ndarray, " d"] | None:
    """How the parameters move for a change of one in a column that they imitate; None of one that they do not.

    Then `score` finds nothing: whatever the column's coefficient is, the residuals are the same at other parameters.
    """
    total = products.bounded([*products.parameters, index]).sum(0)
    imitation, own = _solved(total[1:-1, 1:-1], total[1:-1, -1]), total[-1, -1]
    alone = own - imitation @ total[1:-1, -1]
    return -imitation if own > 0.0 and alone <= _DISTINCT * own else None


def joint_shift(
    products: Products, terms: Sequence[int]
) -> tuple[Float[np.ndarray, " terms"], Float[np.ndarray, " d"], Float[np.ndarray, "d d"]]:
    """The changes of several terms together, how they move the parameters, in [-1, 1], and the covariance of that."""
    each = products.bounded([*products.parameters, *terms])
    changes, covariance = _regression(each)
    total, parameters, of_terms = each[:, 1:, 1:].sum(0), slice(products.count), slice(products.count, None)
    response = -_solved(total[parameters, parameters], total[parameters, of_terms])
    return changes[of_terms], response @ changes[of_terms], response @ covariance[of_terms, of_terms] @ response.T


def parameter_shift(products: Products) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d d"]]:
    """The step to the parameters that explain the windows best, in [-1, 1], and its covariance."""
    return _regression(products.bounded(products.parameters))


def variances_by_group(
    products: Products, groups: Int[np.ndarray, " windows"]
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Variance of each parameter's estimate by leaving out one group of windows at a time, and its degrees of freedom.

    These are the number of groups that tell of the parameter, less one.
    """
    each = products.bounded(products.parameters)
    summed = np.stack([each[groups == group].sum(0) for group in np.unique(groups)])
    _, covariance = _regression(summed)
    inner = summed[:, 1:, 1:]
    directions = _solved(inner.sum(0), np.eye(products.count))
    alone = np.einsum("jd,gjk,kd->gd", directions, inner, directions)
    effective = alone.sum(0) ** 2 / np.maximum((alone**2).sum(0), np.finfo(float).tiny)
    return np.maximum(np.diag(covariance), 0.0), effective - 1.0


def _regression(
    each: Float[np.ndarray, "windows columns columns"],
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """Coefficients of columns that make residuals smallest, and their covariance by leaving out windows.

    The residuals are the first column of the products.
    """
    lengths = np.sqrt(np.maximum(np.diag(each.sum(0))[1:], np.finfo(float).tiny))
    inner = each[:, 1:, 1:] / lengths[:, None] / lengths
    with_residuals = each[:, 1:, 0] / lengths
    total = inner.sum(0)
    change = -_solved(total, with_residuals.sum(0))
    scores = with_residuals + inner @ change
    influence = np.einsum("wij,wj->wi", np.linalg.pinv(total - inner, rcond=_SINGULAR, hermitian=True), scores)
    return change / lengths, _jackknife(influence) / lengths[:, None] / lengths


def _jackknife(influence: Float[np.ndarray, "windows k"]) -> Float[np.ndarray, "k k"]:
    """Covariance of an estimate from how it changes as each window is left out."""
    windows = len(influence)
    return influence.T @ influence * (windows - 1) / windows


def _solved(
    matrix: Float[np.ndarray, "k k"], right: Float[np.ndarray, " k *columns"]
) -> Float[np.ndarray, " k *columns"]:
    """The least-squares solution of a symmetric system that may be singular, in units of its diagonal."""
    lengths = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    inverse = np.linalg.pinv(matrix / lengths[:, None] / lengths, rcond=_SINGULAR, hermitian=True)
    return (inverse / lengths[:, None] / lengths) @ right
