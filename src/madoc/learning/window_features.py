"""Several rows as one: what a discriminator is shown where a single observation does not determine the state.

Not in the paper, whose robots show all of their state. Where velocities are hidden, (s, a) does not determine s'; the
last few observations and actions do about as well as a state.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from madoc.data.dataset import Dataset, spread_of
from madoc.errors import MadocError
from madoc.learning.cloning import Pairs
from madoc.learning.dynamics_ratio import Scaling
from madoc.types import Transitions

Stretch = tuple[
    Float[np.ndarray, "length *rows observation"],
    Float[np.ndarray, "length *rows action"],
    Float[np.ndarray, "length *rows observation"],
]
"""Observations, actions, next observations of consecutive rows, the earliest first."""


@dataclass(frozen=True)
class WindowScaling:
    """How windows of rows become features of order one; a window of one row is described as `Scaling` does.

    The last row is (s, a), earlier ones are (s' - s, a): on a grid of small steps two positions alone would look the
    same. What follows is described by how far it is from going on as in the step before, (s' - s) - (s - s₋₁).

    Attributes:
        scaling: Of one row.
        length: Rows of a window.
        next_scale: Of what describes the observation after the window.
    """

    scaling: Scaling
    length: int
    next_scale: Float[np.ndarray, " observation"]

    @classmethod
    def of(cls, scaling: Scaling, stretch: Stretch) -> "WindowScaling":
        """As the logged windows have it."""
        plain = cls(scaling, len(stretch[0]), scaling.next_scale)
        if plain.length == 1 or not scaling.difference:
            return plain
        return replace(plain, next_scale=spread_of(turn(stretch)))

    @property
    def sizes(self) -> tuple[int, int]:
        """Values of a described window, and of what follows it."""
        return self.length * len(self.scaling.pair_offset), len(self.next_scale)

    def features(
        self, stretch: Stretch
    ) -> tuple[Float[np.ndarray, "*rows window"], Float[np.ndarray, "*rows observation"]]:
        """Features of the window and of what follows it, float32."""
        each = [self.scaling.features(_row(*parts)) for parts in zip(*stretch, strict=True)]
        pair, following = each[-1]
        if self.length == 1:
            return pair, following
        if not self.scaling.difference:
            return np.concatenate([pair for pair, _ in each], axis=-1), following
        size = following.shape[-1]
        earlier = [part for pair, change in each[-2::-1] for part in (change, pair[..., size:])]
        return np.concatenate([pair, *earlier], axis=-1), (turn(stretch) / self.next_scale).astype(np.float32)


class LoggedFeatures:
    """A log as networks see it. Every description of it is made once, when it is first asked for."""

    def __init__(self, dataset: Dataset) -> None:
        """Of this log."""
        self._dataset = dataset
        self._windows: dict[tuple[str, int], tuple[WindowScaling, tuple[Array, Array]]] = {}

    @cached_property
    def pairs(self) -> Pairs:
        """Observations and actions as they are, on the device, float32."""
        logged = self._dataset.transitions
        return jnp.asarray(logged.observation, jnp.float32), jnp.asarray(logged.action, jnp.float32)

    @cached_property
    def standardised(self) -> Scaling:
        """How (s, a, s') become features of order one."""
        return Scaling.standardised(self._dataset.transitions)

    def windows(
        self, features: Literal["standardised", "raw"], length: int
    ) -> tuple[WindowScaling, tuple[Float[Array, "windows window"], Float[Array, "windows observation"]]]:
        """How windows of so many rows are described, and the features of all there are, on the device.

        Raises:
            MadocError: No episode is long enough.
        """
        if (features, length) not in self._windows:
            rows, starts = self._dataset.transitions, self._dataset.episode_starts
            last = last_rows(len(self._dataset), starts, length)
            if not len(last):
                raise MadocError(
                    f"no episode of {self._dataset.origin} has the {length} rows of a window; take a shorter one"
                )
            stretch = logged_stretch(rows, last, length)
            scaling = WindowScaling.of(self.standardised if features == "standardised" else Scaling.raw(rows), stretch)
            window, following = scaling.features(stretch)
            self._windows[features, length] = scaling, (jnp.asarray(window), jnp.asarray(following))
        return self._windows[features, length]


def turn(stretch: Stretch) -> Float[np.ndarray, "*rows observation"]:
    """The last change less the one before it."""
    observation, _, following = stretch
    return (following[-1] - observation[-1]) - (following[-2] - observation[-2])


def logged_stretch(rows: Transitions, last: Int[np.ndarray, " windows"], length: int) -> Stretch:
    """The windows of the log that end in the given rows."""
    stretch = last - np.arange(length)[::-1, None]
    return tuple(np.asarray(part)[stretch] for part in (rows.observation, rows.action, rows.next_observation))  # type: ignore[return-value]


def last_rows(count: int, episode_starts: Int[np.ndarray, " episodes"], length: int) -> Int[np.ndarray, " windows"]:
    """Rows that end a window of their own episode."""
    rows = np.arange(count)
    episode = np.searchsorted(episode_starts, rows, side="right") - 1
    return rows[rows - episode_starts[episode] >= length - 1]


def rolled_stretch(rows: Transitions, length: int) -> Stretch:
    """The windows of a rollout, time first, that end in each of its steps but the first `length` - 1."""
    ends = len(rows.observation) - length + 1
    return tuple(  # type: ignore[return-value]
        np.stack([np.asarray(part)[first : first + ends] for first in range(length)])
        for part in (rows.observation, rows.action, rows.next_observation)
    )


def unbroken(
    valid: Bool[np.ndarray, "steps *rows"], ended: Bool[np.ndarray, "steps *rows"], length: int
) -> Bool[np.ndarray, "windows *rows"]:
    """Which of those windows hold no failed row and no start in between."""
    ends = len(valid) - length + 1
    whole = np.ones((ends, *valid.shape[1:]), dtype=bool)
    for first in range(length):
        part = slice(first, first + ends)
        whole &= valid[part] if first == length - 1 else valid[part] & ~ended[part]
    return whole


def _row(observation: np.ndarray, action: np.ndarray, following: np.ndarray) -> Transitions:
    none = np.zeros(observation.shape[:-1])
    return Transitions(observation, action, none, following, none, none)
