"""CMA-ES in the box [-1, 1]^d, one generation at a time, its whole memory in arrays that a checkpoint can hold.

Hansen 2016, "The CMA evolution strategy: a tutorial". The equations are those of the library `cmaes`; it is built
anew from the arrays in every generation, so a search that was stopped and resumed is the same search.
"""

from dataclasses import dataclass

import jax
import numpy as np
from cmaes import CMA
from jaxtyping import Float, PRNGKeyArray

FIRST_DEVIATION = 0.5
"""Of the first draws in [-1, 1]: a quarter of each range."""
LARGEST_DEVIATION = 2.0
"""A cost without a slope lets the step size wander off; past the width of the box it would only hit its walls."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Evolution:
    """A normal distribution of candidates, and what CMA-ES remembers of how it moved.

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
    """Round draws of a given size about a given centre."""
    nothing = np.zeros(len(mean))
    return Evolution(np.array(mean, np.float64), deviation, np.eye(len(mean)), nothing, nothing, 0)


def population_of(dimensions: int) -> int:
    """Candidates a generation: 4 + ⌊3 ln d⌋ (Eq. 48 of the tutorial)."""
    return 4 + int(3.0 * np.log(dimensions))


def ask(evolution: Evolution, key: PRNGKeyArray, population: int | None = None) -> Float[np.ndarray, "population d"]:
    """The candidates of a generation, `population_of` the dimensions where no number is given.

    One that leaves the box is drawn again, a hundred times at most; then it is put on the wall.
    """
    population = population or population_of(len(evolution.mean))
    optimiser = _optimiser(evolution, population, seed=int(jax.random.randint(key, (), 0, 2**31 - 1)))
    return np.stack([optimiser.ask() for _ in range(population)])


def tell(
    evolution: Evolution, candidates: Float[np.ndarray, "population d"], costs: Float[np.ndarray, " population"]
) -> Evolution:
    """The distribution after a generation; only the order of the costs matters, and the lowest is the best."""
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
    """A sentence once no coordinate's deviation reaches the tolerance, as a share of the range; 0 never does."""
    widest = widest_deviation(evolution)
    if widest / 2.0 >= tolerance:
        return None
    return f"after {evolution.generation} generations every deviation is below {tolerance:g} of its range"


def _optimiser(evolution: Evolution, population: int, seed: int = 0) -> CMA:
    """The library's search, where ours stands. It has no public way to set the three things set last."""
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
