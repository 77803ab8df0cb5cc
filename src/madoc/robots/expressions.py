"""Expressions of a spec file as trees: their values on arrays, and whether they are weighted sums of what they read.

`grammar.py` makes them of text.
"""

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from madoc.tasks.base import Batch

FUNCTIONS: dict[str, int] = {
    **dict.fromkeys(("sin", "cos", "tan", "asin", "acos", "atan", "sqrt", "abs", "exp", "tanh"), 1),
    **dict.fromkeys(("atan2", "min", "max"), 2),
    "where": 3,
}
"""Functions and their numbers of arguments; all are in the array API, so NumPy and JAX both have them."""
LOGIC: dict[str, Callable[[list[Any]], Any]] = {
    "logical_and": all,
    "logical_or": any,
    "logical_not": lambda values: not values[0],
}
"""How conditions are combined: names of the array API, and what they are of plain Python values."""
_OF_ARRAYS = {"min": "minimum", "max": "maximum"}
"""Functions that the array API calls otherwise."""


@dataclass(frozen=True)
class Read:
    """One value that an expression reads: its kind, its name and its index.

    The kind is `position`, `velocity` or `sensor`; `name` of a bare name; `uniform` (in [0, 1]) or `normal` (with
    standard deviation 1) of a random number, whose index tells it from others.
    """

    kind: str
    name: str
    index: int | None = None

    def __str__(self) -> str:
        if self.kind == "name":
            return self.name
        name = self.name if self.name.isidentifier() else repr(self.name)
        return f"{self.kind}({name})" + ("" if self.index is None else f"[{self.index}]")


@dataclass(frozen=True)
class Operation:
    """An operator of the module `operator`, or the name of one of `FUNCTIONS` or of `LOGIC`, and its arguments."""

    function: Callable[..., Batch] | str
    arguments: tuple["Node", ...]


Node = float | Read | Operation
Sum = tuple[dict[Read, float], float]
"""A weighted sum: the coefficient of each value read, and the constant."""


@dataclass(frozen=True)
class Expression:
    """A parsed expression: the text as it was written, and the values it reads, each once."""

    text: str
    reads: tuple[Read, ...]
    root: Node

    def value(self, look_up: Callable[[Read], Batch], namespace: ModuleType = math) -> Batch:
        """The value of the expression; `look_up` gives each value read, and functions come from `namespace`."""
        return value_of(self.root, look_up, namespace)

    def affine(self) -> Sum | None:
        """Coefficients and constant where the expression is a weighted sum of what it reads; else None."""
        whole = weighted_sum(self.root)
        return None if whole is None else ({read: weight for read, weight in whole[0].items() if weight}, whole[1])


def value_of(node: Node, look_up: Callable[[Read], Batch], namespace: ModuleType) -> Batch:
    """The value of a node; ArithmeticError or ValueError where plain numbers have none."""
    if isinstance(node, Read):
        return look_up(node)
    if isinstance(node, float):
        return node
    arguments = [value_of(argument, look_up, namespace) for argument in node.arguments]
    if not isinstance(node.function, str):
        value = node.function(*arguments)
        if isinstance(value, complex):
            raise ArithmeticError("a fractional power of a negative number")
        return value
    if node.function == "abs":
        return abs(arguments[0])
    if all(isinstance(argument, float | bool) for argument in arguments):
        return _plain(node.function, arguments)
    return getattr(namespace, _OF_ARRAYS.get(node.function, node.function))(*arguments)


def _plain(function: str, arguments: list[float]) -> float | bool:
    """The value of a function of plain numbers."""
    if function in LOGIC:
        return LOGIC[function](arguments)
    if function == "where":
        condition, first, second = arguments
        return first if condition else second
    if function in _OF_ARRAYS:
        return min(arguments) if function == "min" else max(arguments)
    return float(getattr(math, function)(*arguments))


def weighted_sum(node: Node) -> Sum | None:
    """The coefficient of each value that a node reads, and the constant; None where it is no weighted sum."""
    if isinstance(node, Read):
        return {node: 1.0}, 0.0
    if isinstance(node, float):
        return {}, node
    parts = [weighted_sum(argument) for argument in node.arguments]
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        return None
    match node.function, known:
        case operator.pos, [part]:
            return part
        case operator.neg, [part]:
            return _scaled(part, -1.0)
        case operator.add | operator.sub, [left, right]:
            right = _scaled(right, -1.0 if node.function is operator.sub else 1.0)
            weights = {read: left[0].get(read, 0.0) + right[0].get(read, 0.0) for read in {**left[0], **right[0]}}
            return weights, left[1] + right[1]
        case operator.mul, [left, right] if not left[0]:
            return _scaled(right, left[1])
        case operator.mul, [left, right] if not right[0]:
            return _scaled(left, right[1])
        case operator.truediv, [left, right] if not right[0] and right[1]:
            return _scaled(left, 1.0 / right[1])
    if any(weights for weights, _ in known):
        return None
    return {}, value_of(node, lambda _: 0.0, math)


def _scaled(affine: Sum, factor: float) -> Sum:
    return {read: weight * factor for read, weight in affine[0].items()}, affine[1] * factor
