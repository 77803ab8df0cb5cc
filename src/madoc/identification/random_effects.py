"""What several robots of one kind have in common, and how much they differ beyond their intervals.

The random-effects model of meta-analysis: robot i has a parameter drawn from a normal distribution of mean μ and
standard deviation τ, and its estimate adds an error whose standard deviation is known from its 95 % interval.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import optimize, stats

from madoc.identification.information import CONFIDENCE

SIGNIFICANCE = 0.05
"""Largest probability, over all robots together, of calling one an outlier that is none."""
FEWEST = 3
"""Fewest robots of which a range for another one can be told."""

_FINEST = 1e-8
"""Accuracy of the search for τ², as a share of the estimates' variance."""

Rows = Float[np.ndarray, " robots"]


@dataclass(frozen=True)
class Common:
    """What robots share in one parameter, in its unit.

    Attributes:
        mean: Mean μ of the kind.
        interval: Its 95 % interval.
        spread: Standard deviation τ between robots, beyond what their intervals explain.
        homogeneity: Probability of estimates at least that different if all robots were alike (Cochran's Q).
        range: Where another robot of the kind is expected with 95 % (prediction interval); None of fewer than 3.
    """

    mean: float
    interval: tuple[float, float]
    spread: float
    homogeneity: float
    range: tuple[float, float] | None


def common(estimates: Rows, errors: Rows) -> Common:
    """Mean and spread of the kind, by restricted maximum likelihood.

    The interval of the mean is Hartung's and Knapp's, at least as wide as the plain one; the range for another robot is
    that of Higgins, Thompson and Spiegelhalter (2009).

    Args:
        estimates: At least two.
        errors: Their standard errors, positive.
    """
    count = len(estimates)
    variance = between(estimates, errors)
    mean, error = _mean(estimates, errors, variance)
    half = stats.t.ppf((1 + CONFIDENCE) / 2, count - 1) * error
    fixed = 1.0 / errors**2
    alike = np.sum(fixed * (estimates - np.sum(fixed * estimates) / np.sum(fixed)) ** 2)
    other = None
    if count >= FEWEST:
        reach = stats.t.ppf((1 + CONFIDENCE) / 2, count - 2) * np.sqrt(variance + error**2)
        other = (float(mean - reach), float(mean + reach))
    return Common(
        mean=float(mean),
        interval=(float(mean - half), float(mean + half)),
        spread=float(np.sqrt(variance)),
        homogeneity=float(stats.chi2.sf(alike, count - 1)),
        range=other,
    )


def outliers(estimates: Rows, errors: Rows) -> dict[int, float]:
    """Positions of robots that do not belong to the others, and the probability of one so far off by chance.

    The farthest from what the others share is tested at 5 % over all robots (Bonferroni), left out if it is an
    outlier, and the next is tested among those that remain: several outliers do not hide each other.
    """
    kept, found = list(range(len(estimates))), dict[int, float]()
    while len(kept) > FEWEST:
        chance = _chances(estimates[kept], errors[kept])
        worst = int(np.argmin(chance))
        if chance[worst] * len(kept) >= SIGNIFICANCE:
            break
        found[kept.pop(worst)] = float(min(1.0, chance[worst] * len(kept)))
    return found


def between(estimates: Rows, errors: Rows) -> float:
    """Variance τ² between robots that maximises the restricted likelihood; 0 where their errors explain all."""

    def cost(variance: float) -> float:
        total = errors**2 + variance
        mean = np.sum(estimates / total) / np.sum(1.0 / total)
        misfit = np.sum((estimates - mean) ** 2 / total)
        return float(0.5 * (np.sum(np.log(total)) + np.log(np.sum(1.0 / total)) + misfit))

    scatter = float(np.var(estimates, ddof=1))
    if scatter == 0.0:
        return 0.0
    # The likelihood falls beyond the scatter itself; a search in units of it does not depend on the parameter's unit.
    found = optimize.minimize_scalar(lambda share: cost(share * scatter), bounds=(0.0, 4.0), options={"xatol": _FINEST})
    variance = float(found.x) * scatter
    return variance if found.x > 2 * _FINEST and cost(variance) < cost(0.0) else 0.0


def _mean(estimates: Rows, errors: Rows, variance: float) -> tuple[float, float]:
    """Weighted mean and its standard error."""
    weights = 1.0 / (errors**2 + variance)
    mean = np.sum(weights * estimates) / np.sum(weights)
    ratio = np.sum(weights * (estimates - mean) ** 2) / (len(estimates) - 1)
    return float(mean), float(np.sqrt(max(1.0, ratio) / np.sum(weights)))


def _chances(estimates: Rows, errors: Rows) -> Rows:
    """For each robot, the probability of an estimate so far from what all others share (deleted residuals)."""
    rows = np.arange(len(estimates))
    chances = []
    for row in rows:
        others = rows != row
        variance = between(estimates[others], errors[others])
        mean, error = _mean(estimates[others], errors[others], variance)
        away = abs(estimates[row] - mean) / np.sqrt(errors[row] ** 2 + variance + error**2)
        chances.append(2.0 * stats.t.sf(away, len(estimates) - 2))
    return np.array(chances)
