"""What every room exchanges: transitions, policies, metrics, and the protocol of methods."""

from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass
from functools import cache
from typing import Annotated, Any, Generic, Literal, Protocol, TypeVar, get_type_hints, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from madoc.errors import MadocError

Problem = TypeVar("Problem", contravariant=True)
State = TypeVar("State")
Made = TypeVar("Made")

Unit = Literal["control steps", "updates"]
"""What a budget counts: simulated control steps, or gradient updates where a method does not simulate."""

Count = Annotated[int, Field(ge=1)]
"""A hyperparameter that counts something there must be one of."""
CountOrZero = Annotated[int, Field(ge=0)]
"""A hyperparameter that counts something there may be none of."""
Layers = tuple[Count, ...]
"""Units of a network's hidden layers."""
NotNegative = Annotated[float, Field(ge=0.0)]
"""A hyperparameter such as a rate or a weight."""

Metrics = dict[str, float]
"""Scalars worth looking at, by name. Never needed by the next step."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Transitions:
    """Rows of (s, a, r, s'), NumPy or JAX, with any leading axes.

    `terminated` ends the task (a fall); `truncated` only ends the record (a time limit).
    """

    observation: Float[Array | np.ndarray, "*rows observation"]
    action: Float[Array | np.ndarray, "*rows action"]
    reward: Float[Array | np.ndarray, "*rows"]
    next_observation: Float[Array | np.ndarray, "*rows observation"]
    terminated: Bool[Array | np.ndarray, "*rows"]
    truncated: Bool[Array | np.ndarray, "*rows"]

    def __len__(self) -> int:
        return len(self.reward)

    def take(self, rows: np.ndarray | slice) -> "Transitions":
        """The given rows (indices or mask over the first axis)."""
        return jax.tree.map(lambda column: column[rows], self)


@runtime_checkable
class Policy(Protocol):
    """Acts. With a key it samples, without one it returns its deterministic action."""

    def __call__(
        self, observation: Float[Array, "*rows observation"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "*rows action"]:
        """Actions in [-1, 1] for a batch of observations."""
        ...


@dataclass(frozen=True)
class Epoch:
    """What one call of a method's `step` did; the loop adds these up.

    Attributes:
        metrics: Finite scalars for the log and the progress bar.
        control_steps: Simulated control steps, of any kind.
        unbudgeted: Those of them that the budget does not count, because nothing is learnt from them.
        updates: Gradient updates of the result.
        stage: A word for what the epoch did, such as `cloning`.
        fraction: Share of the preparation that is done, where the epoch prepares and spends none of the budget.
        converged: A sentence once the method has stopped by itself.
    """

    metrics: Metrics = field(default_factory=dict)
    control_steps: int = 0
    unbudgeted: int = 0
    updates: int = 0
    stage: str = "calibrating"
    fraction: float | None = None
    converged: str | None = None


@runtime_checkable
class Method(Protocol[Problem, State]):
    """What calibrators and policy learners have in common: hyperparameters, and functions of a state.

    A state is a pytree of JAX arrays, NumPy arrays, typed random keys, Python numbers, strings and functions.
    It carries everything the method needs to go on. Its structure, shapes and dtypes stay those of `init`,
    and a healthy state holds no NaN and no infinity, not even as a marker.
    """

    def init(self, problem: Problem, key: PRNGKeyArray) -> State:
        """The state before the first epoch. Cheap, as a resumed run calls it too, for the structure."""
        ...

    def step(self, problem: Problem, state: State) -> tuple[State, Epoch]:
        """One epoch, 0.1 to 2 seconds long: the new state, and what was done."""
        ...


@dataclass(frozen=True)
class MethodEntry(Generic[Made]):
    """A line of `madoc methods`: what never changes about a method.

    Attributes:
        name: As `madoc methods` lists it.
        kind: The method's class.
        summary: What it does, in half a line.
        paper: Where it comes from.
        year: When that was published.
        settings: Hyperparameters in which it differs from the defaults of its class.
        recognised_by: Those of them that tell it from other entries of its class; None: all of them.
        shown: Metrics worth a place beside the progress bar.
        unit: What its budget counts.
        usual_budget: A policy learner's budget where none is given.
        simulates: Whether it spends control steps.
        needs_data: Whether it uses logged data.
        needs_parameters: Whether the parameters of a policy problem make a difference to it.
    """

    name: str
    kind: type[Made]
    summary: str = ""
    paper: str = ""
    year: int = 0
    settings: Mapping[str, object] = field(default_factory=dict)
    recognised_by: tuple[str, ...] | None = None
    shown: tuple[str, ...] = ()
    unit: Unit = "control steps"
    usual_budget: int = 300_000
    simulates: bool = True
    needs_data: bool = True
    needs_parameters: bool = True

    def make(self, **changes: object) -> Made:
        """The method, with some hyperparameters changed."""
        return self.kind(**{**self.settings, **changes})

    @property
    def identity(self) -> dict[str, object]:
        """The hyperparameters by which a method is recognised as this one."""
        names = self.settings if self.recognised_by is None else self.recognised_by
        return {name: self.settings[name] for name in names}


def entry_of(method: Made, registry: Mapping[str, MethodEntry[Any]]) -> MethodEntry[Made]:
    """The entry of a registry that describes a method: its class, and as many recognised settings as possible.

    A number such as a weight is recognised at any value but the default, everything else at the entry's own value.
    A method of another class is named after its class, and has the defaults of an entry.
    """

    def fits(entry: MethodEntry[Any]) -> bool:
        return entry.kind is type(method) and all(
            value == getattr(method, name)
            or (type(value) is float and getattr(entry.kind(), name) != getattr(method, name))
            for name, value in entry.identity.items()
        )

    fitting = [entry for entry in registry.values() if fits(entry)]
    return max(fitting, key=lambda entry: len(entry.identity), default=MethodEntry(type(method).__name__, type(method)))


def check_hyperparameters(method: object) -> None:
    """Refuse fields of a dataclass of hyperparameters that are not what their annotations say.

    Raises:
        MadocError: Names the first such field, what is expected of it, and what it was.
    """
    kind: type = type(method)
    for name, adapter in _adapters(kind).items():
        try:
            adapter.validate_python(getattr(method, name))
        except ValidationError as error:
            problem = error.errors()[0]
            expected = problem["msg"].removeprefix("Input should be ")
            owner = f"{name} of {kind.__name__}"
            raise MadocError(f"expected {owner} to be {expected}, got {problem['input']!r}") from None


@cache
def _adapters(kind: type) -> dict[str, TypeAdapter]:
    """What checks each field of a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    checked = {name: hint for name, hint in hints.items() if not is_dataclass(hint)}
    return {name: TypeAdapter(hint, config=ConfigDict(strict=True)) for name, hint in checked.items()}
