"""The state of the search by an ensemble filter (`filtering`): where it is, and what its windows have told so far."""

from dataclasses import dataclass
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.least_squares.instruments import agreed, beyond_chance
from madoc.calibration.least_squares.plan import FEWEST, LONG_TAILS, Found
from madoc.identification.gauss_newton import FIRST_DAMPING
from madoc.identification.information import sandwich
from madoc.identification.noise import WHITE
from madoc.identification.systematic import EXPLAINED

MEMBERS = 32
"""Number of states in an ensemble; the last epochs, with half as many, tell what a finite one errs."""
NEAR, LIKE_CHANCE = 2.5, 1.0
"""Steps in what chance usually makes (`moved_by`), below which the first epochs end and later ones count together, and
below which the search ends."""
TOGETHER = 3
"""Least number of epochs that count together in the end."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FilterState:
    """The state of the search.

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
        epochs: Number of epochs.
        failures: Number of windows whose simulation failed.
        force: Size of random forces in N/√kg (`random_forces`), 0 until these are looked for.
        asked: What is asked once the search has settled, and `nothing` before: whether a search from fitted starts
            leads to `exact` values, by a `trial` whether random forces act, of what `size` they are, and nothing more
            when that is `known`.
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
    asked: Literal["nothing", "exact", "trial", "size", "known"] = "nothing"
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
        """Whether the search is at its end, the error of finite ensembles is known, and nothing is asked of forces."""
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
        return Found(self.point, uncertainty, self.explained, self.settled, unlike_noise, force)
