"""The types that all packages share: transitions, policies, metrics, and the protocol of methods."""

import zlib
from collections.abc import Callable, Mapping
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
"""A hyperparameter that is a number of things, at least one."""
CountOrZero = Annotated[int, Field(ge=0)]
"""A hyperparameter that is a number of things, possibly none."""
Several = Annotated[int, Field(ge=2)]
"""A hyperparameter that is a number of things, at least two."""
Layers = tuple[Count, ...]
"""Number of units in each hidden layer of a network."""
NotNegative = Annotated[float, Field(ge=0.0)]
"""A hyperparameter that is a number of at least 0, such as a rate or a weight."""
Share = Annotated[float, Field(ge=0.0, le=1.0)]
"""A hyperparameter that is a share of a whole, such as the weight of the newest value in a moving average."""
BelowOne = Annotated[float, Field(ge=0.0, lt=1.0)]
"""A hyperparameter that is a share of a whole of which something has to be left, such as a dropout rate."""
Positive = Annotated[float, Field(gt=0.0)]
"""A hyperparameter that is a number above 0, such as a time or a standard deviation."""

Metrics = dict[str, float]
"""Scalars for the log, by name; no step depends on them."""


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


def generator(key: PRNGKeyArray) -> np.random.Generator:
    """NumPy's generator with a JAX key as its seed, for draws whose shapes vary: JAX compiles anew for each shape."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))


def named_key(key: PRNGKeyArray, name: str) -> PRNGKeyArray:
    """A key for one purpose, made from a key that serves others too.

    The name's checksum is far from the small numbers by which keys are split, or that steps fold into them.
    """
    return jax.random.fold_in(key, zlib.crc32(name.encode()))


@runtime_checkable
class Policy(Protocol):
    """A map from observations to actions in [-1, 1]: sampled with a key, deterministic without one."""

    def __call__(
        self, observation: Float[Array, "*rows observation"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "*rows action"]:
        """Actions for a batch of observations."""


@dataclass(frozen=True)
class Epoch:
    """The metrics and the cost of one call of a method's `step`; the loop adds the costs up.

    Attributes:
        metrics: Finite scalars for the log and the progress bar.
        control_steps: Simulated control steps of any kind.
        unbudgeted: How many of them do not count against the budget, because nothing is learnt from them.
        updates: Gradient updates of the result.
        stage: The kind of the epoch in a word, such as `cloning`.
        fraction: Share of the preparation that is done, if the epoch prepares and spends none of the budget.
        converged: The reason in a sentence, once the method has stopped by itself.
        following: About how many control steps the next step simulates, if the method knows, and they are like these.
    """

    metrics: Metrics = field(default_factory=dict)
    control_steps: int = 0
    unbudgeted: int = 0
    updates: int = 0
    stage: str = "calibrating"
    fraction: float | None = None
    converged: str | None = None
    following: int | None = None


@runtime_checkable
class Method(Protocol[Problem, State]):
    """The interface that calibrators and policy learners share: hyperparameters, and functions of a state.

    A state is a pytree of JAX arrays, NumPy arrays, typed random keys, Python numbers, strings and functions.
    It holds everything that the method needs to continue. Its structure, shapes and dtypes stay those of `init`, and a
    NaN or an infinity in it means that the method has diverged.
    """

    def init(self, problem: Problem, key: PRNGKeyArray) -> State:
        """The state before the first epoch. It must be cheap: a resumed run calls it too, for the structure."""

    def step(self, problem: Problem, state: State) -> tuple[State, Epoch]:
        """One epoch of 0.1 to 2 seconds: the new state, and the epoch's metrics and cost."""


@dataclass(frozen=True)
class MethodEntry(Generic[Made]):
    """The constant facts about a method; `madoc methods` lists them.

    Attributes:
        name: The name of the method on the command line.
        kind: The method's class.
        summary: What the method does, in half a line.
        paper: Its source.
        year: Year of publication.
        settings: Hyperparameters that differ from the defaults of the class.
        recognised_by: Names of the settings that distinguish it from other entries of its class; None means all.
        shown: Metrics to show beside the progress bar.
        unit: What its budget counts.
        usual_budget: The budget where none is given: a count in `unit`, or a time such as "300s".
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
    usual_budget: int | str = 300_000
    simulates: bool = True
    needs_data: bool = True
    needs_parameters: bool = True

    def make(self, **changes: object) -> Made:
        """The method, with some hyperparameters changed."""
        return self.kind(**{**self.settings, **changes})

    @property
    def identity(self) -> dict[str, object]:
        """The hyperparameters by which `entry_of` recognises the method."""
        names = self.settings if self.recognised_by is None else self.recognised_by
        return {name: self.settings[name] for name in names}


def entry_of(method: Made, registry: Mapping[str, MethodEntry[Any]]) -> MethodEntry[Made]:
    """The entry of a registry that describes a method: of its class, and with the most settings in common.

    A setting of type float, such as a weight, matches every value but the default; all others must be equal. A method
    of a class that is not in the registry gets an entry with the name of the class and the defaults.
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
    """Refuse a dataclass of hyperparameters with a field that is not what its annotation says.

    Raises:
        MadocError: Names the first such field, what is expected of it, and its value.
    """
    kind: type = type(method)
    for name, validate in _validators(kind).items():
        try:
            validate(getattr(method, name))
        except ValidationError as error:
            problem = error.errors()[0]
            expected = problem["msg"].removeprefix("Input should be ")
            owner = f"{name} of {kind.__name__}"
            raise MadocError(f"expected {owner} to be {expected}, got {problem['input']!r}") from None


@cache
def _validators(kind: type) -> dict[str, Callable[[object], object]]:
    """A function for each field of a dataclass that raises where a value is not as annotated."""
    hints = get_type_hints(kind, include_extras=True)
    checked = {name: hint for name, hint in hints.items() if not is_dataclass(hint)}
    return {name: TypeAdapter(hint, config=ConfigDict(strict=True)).validate_python for name, hint in checked.items()}
