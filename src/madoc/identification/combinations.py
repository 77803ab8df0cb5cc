"""What a log tells of parameters that act alike: sums or products of them, where it leaves each by itself open."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import qr

from madoc.identification.information import NORMAL_95, OPEN
from madoc.parameters import ParameterSpace

TOLD = 0.25
"""Half of a combination's 95 % interval in [-1, 1]; below it the combination counts as told."""
SPARSE = 1.5
"""Ratio of standard errors, at least 1: a parameter is left out of a combination if that costs no more."""
EXACT = 1e-3
"""Standard error of a combination in [-1, 1]; a smaller one is not worth another parameter in it."""
WHOLE = 0.15
"""Distance of an exponent from a whole number, below which parameters combine as a product."""
LARGEST_POWER = 3
"""Largest exponent of a product."""


@dataclass(frozen=True)
class Combination:
    """A sum or product of parameters that a log tells though it leaves each of them open.

    Attributes:
        name: The combination, such as `armature + 36·inertia` or `mass·length²`.
        parameters: Factor of each parameter in the sum, or its exponent in the product.
        kind: Which of the two it is.
        estimate: Its value.
        interval: Its 95 % interval.
        unit: Its unit.
    """

    name: str
    parameters: dict[str, float]
    kind: str
    estimate: float
    interval: tuple[float, float]
    unit: str

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.name} = {self.estimate:.4g} [{low:.4g}, {high:.4g}] {self.unit}".rstrip()


def combinations(
    space: ParameterSpace,
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    quantile: float = NORMAL_95,
) -> tuple[Combination, ...]:
    """The combinations of open parameters that an estimate tells, each of as few parameters as possible.

    `mean` and `covariance` are in physical units. A direction that the log does not tell has the variance of the box.
    Half of a 95 % interval is `quantile` standard errors.
    """
    half = (space.high - space.low) / 2.0
    scaled = covariance / half[:, None] / half
    is_open = np.flatnonzero(quantile * np.sqrt(np.diag(scaled)) >= OPEN)
    values, vectors = np.linalg.eigh(scaled[np.ix_(is_open, is_open)])
    told = vectors[:, quantile * np.sqrt(np.maximum(values, 0.0)) < TOLD].T
    if not len(told):
        return ()
    _, factor, order = qr(told, mode="economic", pivoting=True)
    basis = np.linalg.solve(factor[:, : len(told)], factor)
    found = []
    for row in basis:
        weights = np.zeros(len(space))
        weights[is_open[order]] = row
        weights = _sparse(weights, scaled)
        asked = (space, mean, scaled, weights, quantile)
        found.append(_product(*asked) or _sum(*asked))
    return tuple(found)


def _sparse(weights: Float[np.ndarray, " d"], scaled: Float[np.ndarray, "d d"]) -> Float[np.ndarray, " d"]:
    """The weights without those that the standard error hardly needs, the smallest first."""
    limit = SPARSE * max(_error(weights, scaled), EXACT)
    for index in np.argsort(np.abs(weights)):
        fewer = weights.copy()
        fewer[index] = 0.0
        if np.count_nonzero(fewer) >= 1 and _error(fewer, scaled) <= limit:
            weights = fewer
    return weights


def _error(weights: Float[np.ndarray, " d"], scaled: Float[np.ndarray, "d d"]) -> float:
    """Standard error of the sum with these weights of parameters in [-1, 1]."""
    return float(np.sqrt(max(0.0, weights @ scaled @ weights)))


def _sum(
    space: ParameterSpace,
    mean: Float[np.ndarray, " d"],
    scaled: Float[np.ndarray, "d d"],
    weights: Float[np.ndarray, " d"],
    quantile: float,
) -> Combination:
    """The sum with these weights of parameters in [-1, 1], in the unit of the first, whose factor is 1."""
    involved = np.flatnonzero(weights)
    half = (space.high - space.low) / 2.0
    factors = weights / half
    first = involved[np.argmax(np.abs(weights[involved]))]
    scale = 1.0 / factors[first]
    factors, error = factors * scale, _error(weights, scaled) * abs(scale)
    value = float(factors @ mean)
    others = [index for index in involved if index != first]
    terms = [f"{'+' if factors[i] > 0 else '-'} {abs(factors[i]):.3g}·{space.names[i]}" for i in others]
    return Combination(
        name=" ".join([space.names[first], *terms]),
        parameters={space.names[index]: float(factors[index]) for index in (first, *others)},
        kind="sum",
        estimate=value,
        interval=(value - quantile * error, value + quantile * error),
        unit=space.parameters[first].unit,
    )


def _product(
    space: ParameterSpace,
    mean: Float[np.ndarray, " d"],
    scaled: Float[np.ndarray, "d d"],
    weights: Float[np.ndarray, " d"],
    quantile: float,
) -> Combination | None:
    """The product of whole powers that has these weights at the estimate; None if there is none.

    Near one estimate a product moves as a sum does. Parameters of the same unit are taken to add up.
    """
    involved = np.flatnonzero(weights)
    half = (space.high - space.low) / 2.0
    units = {space.parameters[index].unit for index in involved}
    if len(involved) < 2 or len(units) < len(involved) or (mean[involved] <= 0.0).any():
        return None
    powers = weights[involved] * mean[involved] / half[involved]
    powers = powers / powers[np.argmin(np.abs(powers))]
    whole = np.round(powers)
    if (np.abs(powers - whole) > WHOLE).any() or np.abs(whole).max() > LARGEST_POWER:
        return None
    order = np.argsort(-whole, kind="stable")
    involved, whole = involved[order], whole[order]
    gradient = np.zeros(len(space))
    gradient[involved] = whole * half[involved] / mean[involved]
    error, value = _error(gradient, scaled), float(np.prod(mean[involved] ** whole))
    exact = max(_error(weights, scaled), EXACT) / np.abs(weights).max() * np.abs(gradient).max()
    if error > SPARSE * exact:
        return None
    low, high = value * np.exp(-quantile * error), value * np.exp(quantile * error)
    return Combination(
        name=_powers([space.names[index] for index in involved], whole),
        parameters={space.names[index]: float(power) for index, power in zip(involved, whole, strict=True)},
        kind="product",
        estimate=value,
        interval=(float(low), float(high)),
        unit=_powers([space.parameters[index].unit for index in involved], whole),
    )


def _powers(names: list[str], whole: Float[np.ndarray, " some"]) -> str:
    """Names with their exponents, as `mass·length²/gain`."""
    raised = {1: "", 2: "²", 3: "³"}
    above = [f"{name}{raised[int(power)]}" for name, power in zip(names, whole, strict=True) if power > 0]
    below = [f"/{name}{raised[int(-power)]}" for name, power in zip(names, whole, strict=True) if power < 0]
    return ("·".join(above) or "1") + "".join(below)
