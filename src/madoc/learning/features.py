"""Logged and simulated rows as features of order one, as networks see them.

`Scaling` works on NumPy arrays in float64, `Features` does the same inside jitted updates in float32. Where velocities
are hidden or actions late, (s, a) does not determine s', so `WindowScaling` describes a window of consecutive rows in
place of one. The paper has no windows: its robots show their whole state.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from madoc.data.dataset import Dataset, spread_of
from madoc.errors import MadocError
from madoc.learning.cloning import Pairs
from madoc.types import Transitions

HIDDEN_WINDOW = 3
"""Window length, in rows, where one row tells no state: two rows give a velocity, a third an acceleration."""


@dataclass(frozen=True)
class Scaling:
    """Offset and scale of (s, a), and scale of the description of s': by s' - s with `difference`, else by s' itself.

    Features are computed in float64 and returned in float32.
    """

    pair_offset: Float[np.ndarray, " pair"]
    pair_scale: Float[np.ndarray, " pair"]
    next_scale: Float[np.ndarray, " observation"]
    difference: bool

    @classmethod
    def standardised(cls, rows: Transitions) -> "Scaling":
        """(s, a) standardised, s' - s divided by its standard deviation; constant channels are not scaled."""
        pair = np.concatenate([rows.observation, rows.action], axis=-1)
        return cls(pair.mean(0), spread_of(pair), spread_of(_change(rows)), difference=True)

    @classmethod
    def raw(cls, rows: Transitions) -> "Scaling":
        """(s, a, s') unchanged, as in the paper."""
        pair, size = rows.observation.shape[-1] + rows.action.shape[-1], rows.observation.shape[-1]
        return cls(np.zeros(pair), np.ones(pair), np.ones(size), difference=False)

    def features(
        self, rows: Transitions
    ) -> tuple[Float[np.ndarray, "*rows pair"], Float[np.ndarray, "*rows observation"]]:
        """Features of (s, a) and of s'."""
        pair = np.concatenate([rows.observation, rows.action], axis=-1)
        following = _change(rows) if self.difference else np.asarray(rows.next_observation)
        return (
            ((pair - self.pair_offset) / self.pair_scale).astype(np.float32),
            (following / self.next_scale).astype(np.float32),
        )


class Features(eqx.Module):
    """The standardised `Scaling` of a log in float32 on the device, and the scale of its rewards."""

    pair_offset: Float[Array, " pair"]
    pair_scale: Float[Array, " pair"]
    change_scale: Float[Array, " observation"]
    reward_offset: Float[Array, ""]
    reward_scale: Float[Array, ""]

    @classmethod
    def of(cls, rows: Transitions) -> "Features":
        """The standardisation of these rows."""
        scaling = Scaling.standardised(rows)
        spread = np.std(rows.reward)
        reward = (np.mean(rows.reward), spread if spread > 1e-8 else 1.0)
        parts = (scaling.pair_offset, scaling.pair_scale, scaling.next_scale, *reward)
        return cls(*(jnp.asarray(part, jnp.float32) for part in parts))

    def pair(
        self, observation: Float[Array, "*rows observation"], action: Float[Array, "*rows action"]
    ) -> Float[Array, "*rows pair"]:
        """(s, a) with mean 0 and standard deviation 1."""
        pair = jnp.concatenate([observation, action], axis=-1)
        return (pair - _like(self.pair_offset, pair)) / _like(self.pair_scale, pair)

    def described(self, rows: dict[str, Array]) -> tuple[Float[Array, "rows pair"], Float[Array, "rows observation"]]:
        """Standardised (s, a), and s' - s in units of its standard deviation."""
        change = rows["next_observation"] - rows["observation"]
        return self.pair(rows["observation"], rows["action"]), change / _like(self.change_scale, change)

    def following(
        self, observation: Float[Array, "*rows observation"], change: Float[Array, "*rows observation"]
    ) -> Float[Array, "*rows observation"]:
        """The next observation s', given a standardised change."""
        return observation + change * _like(self.change_scale, change)


@dataclass(frozen=True)
class WindowScaling:
    """Scaling of windows of consecutive rows; a window of one row has the features of its `Scaling`.

    Of a longer window, the last row is described by (s, a) and the earlier rows by (s' - s, a), the latest first:
    positions of neighbouring rows would hardly differ. The observation after the window is described by the change of
    motion, (s' - s) - (s - s₋₁), whose scale is `next_scale`.
    """

    scaling: Scaling
    length: int
    next_scale: Float[np.ndarray, " observation"]

    @classmethod
    def of(cls, scaling: Scaling, windows: Transitions) -> "WindowScaling":
        """The scaling of logged windows, as `windows_ending` gives them."""
        length = len(windows)
        turns = length > 1 and scaling.difference
        return cls(scaling, length, spread_of(change_of_motion(windows)) if turns else scaling.next_scale)

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of features of a window, and of the observation after it."""
        return self.length * len(self.scaling.pair_offset), len(self.next_scale)

    def changes(
        self, window: Float[np.ndarray, "*rows window"], following: Float[np.ndarray, "*rows observation"]
    ) -> Float[np.ndarray, "*rows observation"]:
        """The features of s' as those of a change: raw ones less s, which stands in the last row of a raw window."""
        first = (self.length - 1) * len(self.scaling.pair_offset)
        return following if self.scaling.difference else following - window[..., first : first + following.shape[-1]]

    def features(
        self, windows: Transitions
    ) -> tuple[Float[np.ndarray, "*rows window"], Float[np.ndarray, "*rows observation"]]:
        """Features of windows and of the observation after each, float32."""
        pair, following = self.scaling.features(windows)
        if self.length == 1:
            return pair[0], following[0]
        if not self.scaling.difference:
            return np.concatenate(list(pair), axis=-1), following[-1]
        actions = pair[..., following.shape[-1] :]
        earlier = [part[row] for row in range(self.length - 2, -1, -1) for part in (following, actions)]
        turn = (change_of_motion(windows) / self.next_scale).astype(np.float32)
        return np.concatenate([pair[-1], *earlier], axis=-1), turn


class LoggedFeatures:
    """Features of a log, each kind computed when it is first needed."""

    def __init__(self, dataset: Dataset) -> None:
        """Features of this log."""
        self._dataset = dataset
        self._windows: dict[tuple[str, int], tuple[WindowScaling, tuple[Array, Array]]] = {}
        self._pairs: dict[int, Pairs] = {}

    def pairs(self, recalled: int = 0) -> Pairs:
        """What the policy of the log saw, with so many earlier rows, and its actions; neither scaled, on the device.

        Earlier rows are recalled as `simulation.rollout.Walkers` have them.
        """
        if recalled not in self._pairs:
            rows = self._dataset.transitions
            seen = [np.asarray(rows.observation), *self._earlier(recalled)]
            pairs = np.concatenate(seen, axis=-1), np.asarray(rows.action)
            self._pairs[recalled] = (jnp.asarray(pairs[0], jnp.float32), jnp.asarray(pairs[1], jnp.float32))
        return self._pairs[recalled]

    def _earlier(self, count: int) -> Iterator[Float[np.ndarray, "rows values"]]:
        """(s' - s, a) of the row before each row, of the one before that, and so on; 0 before an episode."""
        dataset = self._dataset
        row, first = np.arange(len(dataset)), dataset.episode_starts[dataset.episode_of(np.arange(len(dataset)))]
        step = np.concatenate([_change(dataset.transitions), np.asarray(dataset.transitions.action)], axis=-1)
        for back in range(1, count + 1):
            yield np.where((row - back >= first)[:, None], step[np.maximum(row - back, 0)], 0.0)

    @cached_property
    def standardised(self) -> Scaling:
        """The standardised scaling of the log's rows."""
        return Scaling.standardised(self._dataset.transitions)

    def windows(
        self, features: Literal["standardised", "raw"], length: int
    ) -> tuple[WindowScaling, tuple[Float[Array, "windows window"], Float[Array, "windows observation"]]]:
        """The scaling of windows of `length` rows, and the features of all such windows of the log, on the device.

        Raises:
            MadocError: No episode has so many rows.
        """
        if (features, length) not in self._windows:
            rows, last = self._dataset.transitions, last_rows(self._dataset, length)
            if not len(last):
                raise MadocError(
                    f"no episode of {self._dataset.origin} has the {length} rows of a window; take a shorter one"
                )
            logged = windows_ending(rows, last, length)
            scaling = WindowScaling.of(self.standardised if features == "standardised" else Scaling.raw(rows), logged)
            window, following = scaling.features(logged)
            self._windows[features, length] = scaling, (jnp.asarray(window), jnp.asarray(following))
        return self._windows[features, length]


def change_of_motion(windows: Transitions) -> Float[np.ndarray, "*rows observation"]:
    """The change in the last row of each window, minus the change in the row before it."""
    change = _change(windows)
    return change[-1] - change[-2]


def windows_ending(rows: Transitions, last: Int[np.ndarray, " windows"], length: int) -> Transitions:
    """Windows of consecutive rows that end in the given rows; the first axis runs through a window."""
    return rows.take(_rows_of(last, length))


def last_rows(dataset: Dataset, length: int) -> Int[np.ndarray, " windows"]:
    """The rows in which a window of one episode can end."""
    rows = np.arange(len(dataset))
    return rows[rows - dataset.episode_starts[dataset.episode_of(rows)] >= length - 1]


def unbroken(
    valid: Bool[np.ndarray, " steps *rows"], ended: Bool[np.ndarray, " steps *rows"], length: int
) -> Bool[np.ndarray, " windows *rows"]:
    """Whether each window of a rollout has only valid steps, and no episode that ends before its last step."""
    steps = _rows_of(np.arange(length - 1, len(valid)), length)
    return valid[steps].all(0) & ~ended[steps[:-1]].any(0)


def _rows_of(last: Int[np.ndarray, " windows"], length: int) -> Int[np.ndarray, "length windows"]:
    return last - np.arange(length)[::-1, None]


def _change(rows: Transitions) -> Float[np.ndarray, "*rows observation"]:
    return np.asarray(rows.next_observation) - rows.observation


def _like(part: Array, rows: Array) -> Array:
    return jnp.broadcast_to(part, rows.shape)
