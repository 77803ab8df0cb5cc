"""CMA-ES in the box [-1, 1]^d, one generation at a time, with its whole state in arrays that a checkpoint can hold.

Hansen 2016, "The CMA evolution strategy: a tutorial". The library `cmaes` computes its equations; an optimiser is made
of the arrays in every generation, so that a resumed search is the same search.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

if TYPE_CHECKING:
    from cmaes import CMA

FIRST_DEVIATION = 0.5
"""Deviation of the first candidates, in [-1, 1]: a quarter of each range."""
LARGEST_DEVIATION = 2.0
"""Largest deviation of a candidate, the width of the box. The step size of a flat cost grows without limit; beyond this
candidates would only be put on the walls."""

Candidates = Float[np.ndarray, "population d"]
"""Parameters of each candidate of a generation, in [-1, 1]."""
Costs = Float[np.ndarray, " population"]
"""Cost of each candidate of a generation."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Evolution:
    """A normal distribution of candidates, and the evolution paths of CMA-ES.

    Attributes:
        mean: Centre of the next candidates, in [-1, 1].
        deviation: σ, the step size.
        covariance: C; candidates are drawn from N(mean, σ² C), again where they leave the box.
        deviation_path: p_σ.
        covariance_path: p_c.
        generation: Generations done.
    """

    mean: Float[np.ndarray, " d"]
    deviation: float
    covariance: Float[np.ndarray, "d d"]
    deviation_path: Float[np.ndarray, " d"]
    covariance_path: Float[np.ndarray, " d"]
    generation: int


def begin(mean: Float[np.ndarray, " d"], deviation: float = FIRST_DEVIATION) -> Evolution:
    """A distribution with equal and independent deviations about a given centre."""
    nothing = np.zeros(len(mean))
    return Evolution(np.array(mean, np.float64), deviation, np.eye(len(mean)), nothing, nothing, 0)


def ask(evolution: Evolution, key: PRNGKeyArray, population: int | None = None) -> Candidates:
    """The candidates of a generation, by default 4 + ⌊3 ln d⌋ of them (Eq. 48 of the tutorial).

    A candidate outside the box is drawn again, a hundred times at most; then it is put on the wall.
    """
    population = population or 4 + int(3.0 * np.log(len(evolution.mean)))
    optimiser = _optimiser(evolution, population, seed=int(jax.random.randint(key, (), 0, 2**31 - 1)))
    return np.stack([optimiser.ask() for _ in range(population)])


def tell(evolution: Evolution, candidates: Candidates, costs: Costs) -> Evolution:
    """The distribution after a generation. Only the order of the costs matters, and the lowest is the best."""
    optimiser = _optimiser(evolution, len(candidates))
    optimiser.tell(list(zip(candidates, costs.tolist(), strict=True)))
    widest = float(np.sqrt(np.diag(optimiser._C).max()))
    return Evolution(
        mean=optimiser.mean,
        deviation=min(float(optimiser._sigma), LARGEST_DEVIATION / widest),
        covariance=optimiser._C,
        deviation_path=optimiser._p_sigma,
        covariance_path=optimiser._pc,
        generation=optimiser.generation,
    )


def spread(evolution: Evolution) -> Float[np.ndarray, "d d"]:
    """Covariance of the candidates, σ² C, without the box."""
    return evolution.deviation**2 * evolution.covariance


def widest_deviation(evolution: Evolution) -> float:
    """The largest deviation of a candidate's coordinate."""
    return float(np.sqrt(np.diag(spread(evolution)).max()))


def settled(evolution: Evolution, tolerance: float) -> str | None:
    """A sentence once every coordinate's deviation, as a share of its range, is below the tolerance; else None."""
    widest = widest_deviation(evolution)
    if widest / 2.0 >= tolerance:
        return None
    return f"after {evolution.generation} generations every deviation is below {tolerance:g} of its range"


def _optimiser(evolution: Evolution, population: int, seed: int = 0) -> "CMA":
    """The library's optimiser in this state. It has no public way to set the last three attributes."""
    from cmaes import CMA  # slow to import, and only methods that search by it need it

    optimiser = CMA(
        mean=np.clip(evolution.mean, -1.0, 1.0),
        sigma=evolution.deviation,
        bounds=np.tile([-1.0, 1.0], (len(evolution.mean), 1)),
        population_size=population,
        cov=evolution.covariance.copy(),
        seed=seed,
    )
    optimiser._p_sigma = evolution.deviation_path.copy()
    optimiser._pc = evolution.covariance_path.copy()
    optimiser._g = evolution.generation
    return optimiser
