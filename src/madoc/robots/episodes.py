"""Episodes of a spec: what is rewarded, when they end, where they begin, and the goals that are drawn for each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.errors import MadocError
from madoc.robots.expressions import Expression, Read
from madoc.robots.grammar import Scope, parse
from madoc.robots.model import Draft
from madoc.robots.sensing import Signals
from madoc.tasks.base import ActionChannel, Batch, never_terminated

_OF_STATE = ("position", "velocity")
"""What a reward or an end may read of the model by itself; sensors it may not."""


@dataclass(frozen=True)
class Episode:
    """The functions of an episode, batched, on NumPy or JAX arrays.

    Attributes:
        goals: Names of the values that are drawn for each episode; they end the state.
        reward: (state, action, next state) -> reward.
        ended: next state -> whether the episode has ended there.
        starts: How goals and starts are drawn.
        differs: Whether an episode differs from a log of the robot in more than its reward.
    """

    goals: tuple[str, ...]
    reward: Callable[[Batch, Batch, Batch], Batch]
    ended: Callable[[Batch], Batch]
    starts: "Starts"
    differs: bool


@dataclass(frozen=True)
class Starts:
    """How the beginnings of episodes are drawn: the goals in order, then values of the state by their address."""

    goals: tuple[tuple[str, Expression], ...]
    reset: tuple[tuple[int, Expression], ...]

    def offsets(
        self, key: PRNGKeyArray, count: int, *, start: Float[np.ndarray, " state"]
    ) -> Float[Array, "count state"]:
        """What is added to the state `start`, in which goals are 0, to begin `count` episodes."""
        of_goals, of_reset = jax.random.split(key)
        drawn: dict[str, Array] = {}
        for index, (name, expression) in enumerate(self.goals):
            drawn[name] = _drawn(expression, drawn, jax.random.fold_in(of_goals, index), count)
        offsets = jnp.zeros((count, len(start)))
        for index, name in enumerate(drawn):
            offsets = offsets.at[:, len(start) - len(drawn) + index].set(drawn[name])
        for index, (address, expression) in enumerate(self.reset):
            value = _drawn(expression, drawn, jax.random.fold_in(of_reset, index), count)
            offsets = offsets.at[:, address].set(value - start[address])
        return offsets


def _drawn(expression: Expression, goals: Mapping[str, Array], key: PRNGKeyArray, count: int) -> Float[Array, " count"]:
    """Values of an expression of goals and of random numbers, each of these drawn with a key of its own."""

    def look_up(read: Read) -> Array:
        if read.kind == "name":
            return goals[read.name]
        draw = jax.random.uniform if read.kind == "uniform" else jax.random.normal
        return draw(jax.random.fold_in(key, expression.reads.index(read)), (count,))

    return jnp.broadcast_to(jnp.asarray(expression.value(look_up, jnp), jnp.float32), (count,))


def read_episode(draft: Draft, signals: Signals, actions: tuple[ActionChannel, ...]) -> Episode:
    """The episode of a spec; a mistake in an expression is refused with its line."""
    spec, goals = draft.spec, _read_goals(draft, actions)
    names = tuple(name for name, _ in goals)
    reader = _Reader(draft, signals, actions, names)
    return Episode(
        goals=names,
        reward=no_reward if spec.reward is None else partial(_reward, reader, reader.expression("reward", spec.reward)),
        ended=never_terminated if spec.end is None else partial(_ended, reader, reader.expression("end", spec.end)),
        starts=Starts(goals, _read_reset(draft, signals, names)),
        differs=bool(spec.goals or spec.reset or spec.end is not None),
    )


def _read_goals(draft: Draft, actions: tuple[ActionChannel, ...]) -> tuple[tuple[str, Expression], ...]:
    """The goals, each an expression of random numbers and of goals above it."""
    taken = {*(signal.name for signal in draft.spec.signals), *(channel.name for channel in actions)}
    goals: list[tuple[str, Expression]] = []
    for index, goal in enumerate(draft.spec.goals):
        names = [name for name, _ in goals]
        if goal.name in taken or goal.name in names:
            raise draft.document.error(
                ("goals", index, "name"), f"the name {goal.name!r} is taken already; choose another for the goal"
            )
        with draft.document.at("goals", index, "drawn"):
            scope = Scope(names, (), draws=True, constant=True)
            goals.append((goal.name, parse(str(goal.drawn), scope)))
    return tuple(goals)


def _read_reset(draft: Draft, signals: Signals, goals: tuple[str, ...]) -> tuple[tuple[int, Expression], ...]:
    """Where each value of the state begins that the spec gives: its address, and an expression of draws and goals."""
    places: dict[int, Expression] = {}
    for key, given in draft.spec.reset.items():
        with draft.document.at("reset", key):
            place = parse(key, Scope(reads=_OF_STATE)).root
            if not isinstance(place, Read):
                raise MadocError(f"expected position(JOINT) or velocity(JOINT) before the colon, got {key!r}")
            address = signals.layout.address(place)
            if address in places:
                raise MadocError(f"{key} is given twice; keep one")
            places[address] = parse(str(given), Scope(goals, (), draws=True, constant=True))
    return tuple(places.items())


@dataclass(frozen=True)
class _Reader:
    """What expressions of a reward or an end read: signals and goals after a step, and actions in their units."""

    draft: Draft
    signals: Signals
    actions: tuple[ActionChannel, ...]
    goals: tuple[str, ...]

    def expression(self, key: str, text: str) -> Expression:
        """The expression under a key of the spec; a condition under `end`, which knows no action."""
        names = [*(signal.name for signal in self.draft.spec.signals), *self.goals]
        names += [channel.name for channel in self.actions] if key == "reward" else []
        with self.draft.document.at(key):
            expression = parse(text, Scope(names, _OF_STATE, condition=key == "end"))
            for read in expression.reads:
                self._check(key, read)
        return expression

    def _check(self, key: str, read: Read) -> None:
        """Refuse what the model does not have, and a signal that reads a sensor."""
        if read.kind != "name":
            self.signals.layout.address(read)
        elif read.name in self._of_signals:
            inside = self.signals.expressions[self._of_signals[read.name]].reads
            if any(part.kind == "sensor" for part in inside):
                what = "reward is a function of state and action" if key == "reward" else "end is a condition of states"
                raise MadocError(f"a {what}, and the signal {read.name!r} reads a sensor")

    @property
    def _of_signals(self) -> dict[str, int]:
        return {signal.name: index for index, signal in enumerate(self.draft.spec.signals)}

    def value(self, expression: Expression, state: Batch, action: Batch) -> Batch:
        """The value of an expression after a step to `state` under `action`; without a warning where it has none."""
        of_signals, of_actions = self._of_signals, {channel.name: index for index, channel in enumerate(self.actions)}
        first_goal = state.shape[-1] - len(self.goals)

        def look_up(read: Read) -> Batch:
            if read.kind != "name":
                return state[..., self.signals.layout.address(read)]
            if read.name in of_signals:
                return self.signals.value(of_signals[read.name], state)
            if read.name in self.goals:
                return state[..., first_goal + self.goals.index(read.name)]
            channel = self.actions[of_actions[read.name]]
            middle, half = (channel.low + channel.high) / 2.0, (channel.high - channel.low) / 2.0
            return middle + half * action[..., of_actions[read.name]]

        with np.errstate(all="ignore"):
            return expression.value(look_up, state.__array_namespace__())


def _reward(reader: _Reader, expression: Expression, state: Batch, action: Batch, next_state: Batch) -> Batch:
    return reader.value(expression, next_state, action)


def _ended(reader: _Reader, expression: Expression, next_state: Batch) -> Batch:
    return reader.value(expression, next_state, None)  # which no end reads


def no_reward(state: Batch, action: Batch, next_state: Batch) -> Batch:
    """0 for every row."""
    return 0.0 * next_state[..., 0]
