"""Running mean and standard deviation of rows that arrive in batches."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Moments:
    """Number of rows so far, their mean, and the sum of their squared distances to the mean."""

    count: int
    mean: Float[np.ndarray, " n"]
    squares: Float[np.ndarray, " n"]

    @classmethod
    def none(cls, size: int) -> "Moments":
        """The moments before the first row, for rows of `size` values."""
        return cls(0, np.zeros(size), np.zeros(size))

    @property
    def deviation(self) -> Float[np.ndarray, " n"]:
        """Standard deviation of each value; 1 before the first row."""
        return np.sqrt(self.squares / self.count) if self.count else np.ones_like(self.squares)

    def including(self, rows: Float[np.ndarray, "rows n"]) -> "Moments":
        """The moments once more rows have come in (Chan et al. 1979, pairwise update of mean and variance)."""
        if not len(rows):
            return self
        count, mean = self.count + len(rows), rows.mean(0)
        difference = mean - self.mean
        squares = ((rows - mean) ** 2).sum(0) + difference**2 * self.count * len(rows) / count
        return Moments(count, self.mean + difference * len(rows) / count, self.squares + squares)
