"""A dataset: logged transitions, where their episodes begin, and where they come from."""

from dataclasses import dataclass, field, replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from madoc.data.findings import Finding
from madoc.errors import MadocError
from madoc.types import Transitions

Shuffled = Literal["none", "rows", "next_observations"]
Velocities = Literal["logged", "differences"]


@dataclass(frozen=True)
class Disturbance:
    """What keeps logged data from being clean: the truth of sensors, put there on purpose or not.

    Attributes:
        noise: Deviation of the noise on every observation, as a share of its channel's typical change in a step.
        hidden_velocities: Observations show positions alone.
        shuffled: `rows`: rows (s, a, s') stay whole but their order is lost; `next_observations`: which s' belongs
            to which (s, a) is lost as well.
        friction: Of all contacts in the target, as a multiple of the model's: a gap no parameter can close.
        velocities: `logged`, or `differences` of positions in place of those that are hidden.
    """

    noise: float = 0.0
    hidden_velocities: bool = False
    shuffled: Shuffled = "none"
    friction: float = 1.0
    velocities: Velocities = "logged"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.noise) and self.noise >= 0):
            raise MadocError(f"expected noise as a share of a step's change, 0 or more, got {self.noise}")
        if not (np.isfinite(self.friction) and self.friction > 0):
            raise MadocError(f"expected friction as a positive multiple of the model's, got {self.friction}")

    def joined(self, other: "Disturbance") -> "Disturbance":
        """Both, one after the other."""
        return Disturbance(
            noise=float(np.hypot(self.noise, other.noise)),
            hidden_velocities=self.hidden_velocities or other.hidden_velocities,
            shuffled=other.shuffled if self.shuffled == "none" else self.shuffled,
            friction=self.friction * other.friction,
            velocities=other.velocities if self.velocities == "logged" else self.velocities,
        )

    def sentences(self) -> tuple[str, ...]:
        """What a reader of an estimate should know, one sentence each; none where the data is clean."""
        found = []
        if self.noise:
            found.append(
                f"the data carries observation noise of {100 * self.noise:g} % of a step's change: states rebuilt from "
                "it are not exact, and methods that take them for true are biased"
            )
        if self.velocities == "differences":
            found.append(
                "the data's velocities are differences of positions: states rebuilt from them are not exact, and "
                "methods that take them for true are biased"
            )
        elif self.hidden_velocities:
            found.append("the data hides velocities: its states cannot be rebuilt, and a clone acts on positions alone")
        if self.shuffled == "rows":
            found.append("the data's rows are in random order: nothing longer than one row can be replayed")
        if self.shuffled == "next_observations":
            found.append("the data's next observations are not those of their rows: only their distribution is known")
        if self.friction != 1.0:
            found.append(
                f"the target's friction is {self.friction:g} times the simulator's: the estimate will make up for it"
            )
        return tuple(found)


@dataclass(frozen=True)
class Dataset:
    """Logged transitions of one robot.

    Attributes:
        transitions: NumPy, float64 and bool; actions in [-1, 1]. The last row of every episode is terminated
            or truncated. No row pairs observations of two episodes.
        episode_starts: Rows where an episode begins, ascending; the first is 0.
        task_name: The task it was recorded for.
        physics: `legacy`, `modern`, or `unknown` where the file does not say.
        origin: The file, or a description.
        true_parameters: The target's physical values by parameter name, if known. Only evaluation reads them.
        disturbance: What it is known to suffer from.
        run_names: The run of each episode, where it was read from a user's logs: episodes of one name are stretches of
            one run.
        findings: What reading and checking it told.
    """

    transitions: Transitions
    episode_starts: Int[np.ndarray, " episodes"]
    task_name: str
    physics: str
    origin: str
    true_parameters: dict[str, float] | None = None
    disturbance: Disturbance = field(default_factory=Disturbance)
    run_names: tuple[str, ...] | None = None
    findings: tuple[Finding, ...] = ()

    def __len__(self) -> int:
        return len(self.transitions)

    @property
    def episode_ends(self) -> Int[np.ndarray, " episodes"]:
        """One past the last row of every episode."""
        return np.append(self.episode_starts[1:], len(self))

    def episode_of(self, rows: Int[np.ndarray, "*rows"]) -> Int[np.ndarray, "*rows"]:
        """The index of the episode that each of the given rows belongs to."""
        return np.searchsorted(self.episode_starts, rows, side="right") - 1


def starts_after(ends: Bool[np.ndarray, " rows"]) -> Int[np.ndarray, " episodes"]:
    """Rows where an episode begins, from whether a row ends one."""
    return np.flatnonzero(np.append(True, ends[:-1]))


def close_episodes(transitions: Transitions, episode_starts: Int[np.ndarray, " episodes"]) -> Transitions:
    """Mark the last row of every episode truncated unless it is terminated: the record ends there."""
    last = np.append(episode_starts[1:], len(transitions)) - 1
    truncated = np.array(transitions.truncated)
    truncated[last] |= ~np.asarray(transitions.terminated)[last]
    return replace(transitions, truncated=truncated)


def subsample(dataset: Dataset, max_transitions: int, key: PRNGKeyArray) -> Dataset:
    """At most `max_transitions` transitions: whole episodes in a random order, the last one cut short.

    The rule looks at episodes only, so it is the same for every format, and a smaller draw with the same key
    is a prefix of a larger one. A dataset that is small enough comes back as it is.

    Raises:
        MadocError: `max_transitions` is not positive.
    """
    if max_transitions < 1:
        raise MadocError(f"expected max_transitions of at least 1, got {max_transitions}")
    if max_transitions >= len(dataset):
        return dataset
    starts, ends = dataset.episode_starts, dataset.episode_ends
    order = np.asarray(jax.random.permutation(key, len(starts)))
    filled = np.cumsum((ends - starts)[order])
    episodes = int(np.searchsorted(filled, max_transitions)) + 1
    chosen = order[:episodes]
    rows = np.concatenate([np.arange(starts[episode], ends[episode]) for episode in chosen])[:max_transitions]
    new_starts = np.append(0, filled[: episodes - 1])
    transitions = close_episodes(dataset.transitions.take(rows), new_starts)
    names = None if dataset.run_names is None else tuple(dataset.run_names[episode] for episode in chosen)
    return replace(dataset, transitions=transitions, episode_starts=new_starts, run_names=names)


def typical_change(dataset: Dataset) -> Float[np.ndarray, " observation"]:
    """Standard deviation of each channel's change in a control step, in its unit; 1 for one that never moves."""
    logged = dataset.transitions
    spread = (np.asarray(logged.next_observation) - logged.observation).std(0)
    return np.where(spread > 1e-8, spread, 1.0)
