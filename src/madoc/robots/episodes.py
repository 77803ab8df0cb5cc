"""Episodes of a spec: what is rewarded, when they end, where they begin, and the goals that are drawn for each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from madoc.errors import MadocError
from madoc.robots.expressions import Expression, Read, Scope, parse
from madoc.robots.functions import NAMES, Argument, Function, read_functions
from madoc.robots.model import Draft
from madoc.robots.signals import Layout, Signals, Span
from madoc.tasks.base import ActionChannel, Batch, never_terminated
from madoc.types import generator

_OF_STATE = ("position", "velocity")
"""What a reward or an end may read of the model by itself; sensors it may not."""


@dataclass(frozen=True)
class Episode:
    """The functions of an episode, batched, on NumPy or JAX arrays: `reward` of a step, and whether it has `ended`.

    Goals are drawn for each episode and end the state. It `differs` from a log of the robot where that is in more than
    its reward.
    """

    goals: tuple[str, ...]
    reward: Callable[[Batch, Batch, Batch], Batch]
    ended: Callable[[Batch], Batch]
    starts: "Starts"
    differs: bool
    rewarded: bool


@dataclass(frozen=True)
class Starts:
    """How the beginnings of episodes are drawn: the goals in order, then values of the state by their address.

    A function `reset` of a Python file may stand in the place of the latter; it draws with NumPy, and is not traced.
    The layout says where the values of a state are.
    """

    goals: tuple[tuple[str, Expression], ...]
    reset: tuple[tuple[int, Expression], ...]
    layout: Layout
    function: Function | None = None

    def offsets(
        self, key: PRNGKeyArray, count: int, *, start: Float[np.ndarray, " state"]
    ) -> Float[Array | np.ndarray, "count state"]:
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
        if self.function is not None:
            return self._by_function(self.function, of_reset, offsets, drawn, start)
        return offsets

    def _by_function(
        self,
        function: Function,
        key: PRNGKeyArray,
        offsets: Float[Array, "count state"],
        goals: Mapping[str, Array],
        start: Float[np.ndarray, " state"],
    ) -> Float[np.ndarray, "count state"]:
        """Offsets from `start`, float64, with those of the values that the function names."""
        count, made = len(offsets), np.array(offsets, dtype=np.float64)
        values: dict[str, Argument] = {name: _read_only(np.asarray(goal, np.float64)) for name, goal in goals.items()}
        values |= {"random": generator(key), "count": count}
        result = function(values)
        if not isinstance(result, Mapping):
            got = type(result).__name__
            raise MadocError(f'{function.place}: expected {{"position(JOINT)": values, ...}}, got {got}')
        for place, drawn in result.items():
            try:
                address = _address(str(place), self.layout)
            except MadocError as error:
                raise MadocError(f"{function.place}: {error}") from error
            made[:, address] = function.checked(drawn, (count,), f" for {place}") - start[address]
        return made


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
    functions = _read_functions(reader)
    if not actions and (spec.reward is not None or "reward" in functions):
        raise draft.document.error(("actions",), "a reward: is for a policy, which needs an action to choose; add one")

    def source(key: str) -> Expression | Function | None:
        text = getattr(spec, key)
        return functions.get(key) or (None if text is None else reader.expression(key, text))

    reward, end = source("reward"), source("end")
    return Episode(
        goals=names,
        reward=no_reward if reward is None else partial(reader.reward, reward),
        ended=never_terminated if end is None else partial(reader.ended, end),
        starts=Starts(goals, _read_reset(draft, signals, names), signals.layout, functions.get("reset")),
        differs=bool(spec.goals or spec.reset or end is not None or "reset" in functions),
        rewarded=reward is not None,
    )


def _read_functions(reader: "_Reader") -> dict[str, Function]:
    """The functions of the Python file of a spec; one whose key the spec has too is refused."""
    draft = reader.draft
    if draft.python is None:
        return {}
    after = [*reader.state_names, "position", "velocity"]
    actions = [channel.name for channel in reader.actions]
    with draft.document.at("python"):
        functions = read_functions(
            draft.python,
            {"reward": [*after, *actions], "end": after, "reset": ["random", "count", *reader.goals]},
        )
    for name in NAMES:
        if name in functions and getattr(draft.spec, name):
            raise draft.document.error((name,), f"{name}: is here and a function in {draft.python.name}; keep one")
    return functions


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
            address = _address(key, signals.layout)
            if address in places:
                raise MadocError(f"{key} is given twice; keep one")
            places[address] = parse(str(given), Scope(goals, (), draws=True, constant=True))
    return tuple(places.items())


def _address(text: str, layout: Layout) -> int:
    """Address in a state of `position(JOINT)` or `velocity(JOINT)`; any other text is refused."""
    place = parse(text, Scope(reads=_OF_STATE)).root
    if not isinstance(place, Read):
        raise MadocError(f"expected position(JOINT) or velocity(JOINT) before the colon, got {text!r}")
    return layout.address(place)


def _read_only(values: Batch) -> Batch:
    """A view that a user's function cannot write through."""
    view = values.view()
    view.flags.writeable = False
    return view


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
        elif read.name in self._of_signals and self._reads_sensor(read.name):
            what = "reward is a function of state and action" if key == "reward" else "end is a condition of states"
            raise MadocError(f"a {what}, and the signal {read.name!r} reads a sensor")

    def _reads_sensor(self, signal: str) -> bool:
        return any(part.kind == "sensor" for part in self.signals.expressions[self._of_signals[signal]].reads)

    @property
    def state_names(self) -> list[str]:
        """What a state determines by name: the goals, and the signals that read no sensor."""
        return [*(name for name in self._of_signals if not self._reads_sensor(name)), *self.goals]

    @property
    def _of_signals(self) -> dict[str, int]:
        return {signal.name: index for index, signal in enumerate(self.draft.spec.signals)}

    def reward(self, of: Expression | Function, state: Batch, action: Batch, next_state: Batch) -> Batch:
        """The reward of a step, by an expression or a function."""
        return self._value(of, next_state, action)

    def ended(self, of: Expression | Function, next_state: Batch) -> Batch:
        """Whether an episode has ended, by a condition or a function; neither reads an action."""
        return self._value(of, next_state, None)

    def _value(self, of: Expression | Function, state: Batch, action: Batch) -> Batch:
        """The value after a step to `state` under `action`; without a warning where it has none."""
        if isinstance(of, Function):
            return of.rows(self._arguments(of, state, action), state.shape[:-1])
        with np.errstate(all="ignore"):
            return of.value(partial(self._look_up, state, action), state.__array_namespace__())

    def _arguments(self, function: Function, state: Batch, action: Batch) -> dict[str, Argument]:
        """What a function of a Python file is handed after a step to `state` under `action`: float64, read-only."""
        state = np.asarray(state, dtype=np.float64)
        values: dict[str, Argument] = {}
        named = [*self.state_names, *(channel.name for channel in self.actions)]
        for name in function.arguments:
            if name in _OF_STATE and name not in named:
                spans: dict[str, Span] = getattr(self.signals.layout, name)
                values[name] = {
                    joint: _read_only(state[..., start] if count == 1 else state[..., start : start + count])
                    for joint, (start, count) in spans.items()
                }
            else:
                values[name] = _read_only(np.asarray(self._look_up(state, action, Read("name", name)), np.float64))
        return values

    def _look_up(self, state: Batch, action: Batch, read: Read) -> Batch:
        """One value after a step."""
        of_signals, of_actions = self._of_signals, {channel.name: index for index, channel in enumerate(self.actions)}
        if read.kind != "name":
            return self.signals.layout.look_up(read, state)
        if read.name in of_signals:
            return self.signals.value(of_signals[read.name], state)
        if read.name in self.goals:
            return state[..., state.shape[-1] - len(self.goals) + self.goals.index(read.name)]
        channel = self.actions[of_actions[read.name]]
        middle, half = (channel.low + channel.high) / 2.0, (channel.high - channel.low) / 2.0
        return middle + half * action[..., of_actions[read.name]]


def no_reward(state: Batch, action: Batch, next_state: Batch) -> Batch:
    """0 for every row."""
    return 0.0 * next_state[..., 0]
