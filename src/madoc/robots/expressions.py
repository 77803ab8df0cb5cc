"""Expressions of a spec: text is parsed into a tree, and never run; a tree has values on arrays, or is a weighted sum.

`position(JOINT)`, `velocity(JOINT)` and `sensor(NAME)` read one value; `[i]` picks one of several. Numbers, pi,
`+ - * / **`, brackets and functions combine them. A name that is no identifier goes in quotes. Comparisons, `and`, `or`
and `not` make conditions, and `where(CONDITION, A, B)` makes a number of one. Where values are drawn,
`uniform(LOW, HIGH)` and `normal(MEAN, DEVIATION)` are random numbers, each mention one of its own.
"""

import ast
import math
import operator
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from madoc.errors import MadocError, nearest_hint
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

READS = ("position", "velocity", "sensor")
"""What may be read of a joint or a sensor."""
DRAWS = ("uniform", "normal")
"""Random numbers, by the two values that each takes: low and high, or mean and standard deviation."""
LONGEST = 500
"""Longest expression in characters; a longer one is refused."""
LARGEST = 1e15
"""Largest size of a number in an expression, written or computed, and of a weight; a larger one is refused."""
_BINARY: dict[type, Callable[[Batch, Batch], Batch]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_UNARY: dict[type, Callable[[Batch], Batch]] = {ast.UAdd: operator.pos, ast.USub: operator.neg}
_COMPARISONS: dict[type, Callable[[Batch, Batch], Batch]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_JOINED: dict[type, str] = {ast.And: "logical_and", ast.Or: "logical_or"}


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


@dataclass(frozen=True)
class Scope:
    """What an expression may say.

    Attributes:
        names: Bare names that it may read; None explains how joints and sensors are read instead.
        reads: Which of `READS` it may use.
        draws: Whether it may use `DRAWS`.
        condition: Whether it is a condition and not a number.
        constant: Whether it may read nothing.
    """

    names: Collection[str] | None = None
    reads: Collection[str] = READS
    draws: bool = False
    condition: bool = False
    constant: bool = False

    @property
    def functions(self) -> list[str]:
        """Every function that the expression may use."""
        return [*FUNCTIONS, *self.reads, *(DRAWS if self.draws else ())]


def parse(text: str, scope: Scope | None = None) -> Expression:
    """An expression of what its scope allows; by default, a number made of joints and sensors.

    Raises:
        MadocError: The text is not such an expression, reads nothing, or has no value, as `1 / 0`.
    """
    scope = scope or Scope()
    if len(text) > LONGEST:
        raise MadocError(f"expected at most {LONGEST} characters, got {len(text)}")
    try:
        root = _tree(ast.parse(text.strip(), mode="eval").body, scope)
        _check_kind(root, text, condition=scope.condition)
        reads = tuple(dict.fromkeys(_reads(root)))
        with np.errstate(all="ignore"):
            value = value_of(root, lambda _: np.zeros(1), np)
        _check_sizes(root, text)
    except MadocError:
        raise
    except SyntaxError as error:
        raise MadocError(f"expected an expression, got {text!r}, which does not parse") from error
    except (RecursionError, MemoryError, ArithmeticError, ValueError) as error:
        raise MadocError(f"expected an expression with a value, got {text!r}") from error
    if not reads and not scope.constant:
        found = f"{value:g}" if isinstance(value, float) else str(value).lower()
        raise MadocError(f"{text!r} is {found} whatever the robot does; read a joint or a sensor")
    return Expression(text, reads, root)


def _tree(node: ast.expr, scope: Scope) -> Node:
    match node:
        case ast.Constant(value=number) if isinstance(number, int | float) and not isinstance(number, bool):
            return float(number)
        case ast.Constant(value=other):
            raise MadocError(f"expected a number, got {other!r}")
        case ast.Name(id="pi"):
            return math.pi
        case ast.BinOp() if type(node.op) in _BINARY:
            return _combined(_BINARY[type(node.op)], [node.left, node.right], scope)
        case ast.UnaryOp() if type(node.op) in _UNARY:
            return _combined(_UNARY[type(node.op)], [node.operand], scope)
        case ast.Call(func=ast.Name(id=function)) if function in FUNCTIONS or (scope.draws and function in DRAWS):
            return _called(node, function, scope)
        case ast.Compare() | ast.BoolOp() | ast.UnaryOp(op=ast.Not()):
            return _condition(node, scope)
    return _read(node, scope)


def _combined(function: Callable[..., Batch] | str, arguments: list[ast.expr], scope: Scope) -> Operation:
    """An operation on numbers; conditions among its arguments are refused."""
    nodes = [_tree(argument, scope) for argument in arguments]
    for node, argument in zip(nodes, arguments, strict=True):
        _check_kind(node, ast.unparse(argument), condition=False)
    return Operation(function, tuple(nodes))


def _called(node: ast.Call, function: str, scope: Scope) -> Operation:
    """A function of numbers; of `where`, of a condition and two numbers; or a random number."""
    wanted = FUNCTIONS.get(function, 2)
    if node.keywords or len(node.args) != wanted:
        raise MadocError(f"{function} takes {wanted} values, got {len(node.args)}")
    if function == "where":
        condition = _tree(node.args[0], scope)
        _check_kind(condition, ast.unparse(node.args[0]), condition=True)
        return Operation(function, (condition, *_combined(function, node.args[1:], scope).arguments))
    operation = _combined(function, node.args, scope)
    if function in FUNCTIONS:
        return operation
    first, second = operation.arguments
    width = second if function == "normal" else Operation(operator.sub, (second, first))
    drawn = Read(function, "", node.col_offset)
    return Operation(operator.add, (first, Operation(operator.mul, (width, drawn))))


def _condition(node: ast.expr, scope: Scope) -> Node:
    """A comparison, also one of several in a row, or conditions combined."""
    match node:
        case ast.Compare(left=left, ops=operators, comparators=others):
            sides = [left, *others]
            unknown = next((one for one in operators if type(one) not in _COMPARISONS), None)
            if unknown is not None:
                raise MadocError(f"expected < <= > or >= in a condition, got {ast.unparse(node)!r}")
            pairs = zip(operators, sides[:-1], sides[1:], strict=True)
            parts = [_combined(_COMPARISONS[type(one)], [low, high], scope) for one, low, high in pairs]
            return _joined("logical_and", parts)
        case ast.BoolOp(op=joint, values=values):
            name, inside = _JOINED[type(joint)], values
        case ast.UnaryOp(operand=operand):
            name, inside = "logical_not", [operand]
    nodes = [_tree(value, scope) for value in inside]
    for one, value in zip(nodes, inside, strict=True):
        _check_kind(one, ast.unparse(value), condition=True)
    return Operation(name, (nodes[0],)) if name == "logical_not" else _joined(name, nodes)


def _joined(name: str, conditions: Sequence[Node]) -> Node:
    """Conditions joined two by two."""
    whole = conditions[0]
    for further in conditions[1:]:
        whole = Operation(name, (whole, further))
    return whole


def _check_kind(node: Node, text: str, *, condition: bool) -> None:
    """Refuse a condition where a number is wanted, and a number where a condition is."""
    is_condition = isinstance(node, Operation) and (node.function in LOGIC or node.function in _COMPARISONS.values())
    if is_condition and not condition:
        raise MadocError(f"expected a number, got the condition {text!r}; where(CONDITION, 1, 0) makes it one")
    if condition and not is_condition:
        raise MadocError(f"expected a condition, as height < 0.2, got {text!r}, which is a number")


def _read(node: ast.expr, scope: Scope) -> Read:
    """The joint, sensor or name that a node reads; nodes that read none of them are refused."""
    match node:
        case ast.Name(id=name):
            if scope.names is None:
                raise MadocError(
                    f"{name!r} alone reads nothing; write position({name}), velocity({name}) or sensor({name})"
                )
            if name in scope.names:
                return Read("name", name)
            raise MadocError(f"unknown name {name!r}; {nearest_hint(name, [*scope.names, *scope.functions, 'pi'])}")
        case ast.Subscript(value=ast.Call() as call, slice=ast.Constant(value=int() as index)) if index is not True:
            inner = _read(call, scope)
            return Read(inner.kind, inner.name, index)
        case ast.Call(func=ast.Name(id=kind), args=[argument], keywords=[]) if kind in scope.reads:
            return Read(kind, _name_in(argument, kind))
        case ast.Call(func=ast.Name(id=kind)) if kind in scope.reads:
            raise MadocError(f"{kind} takes one name, as {kind}(NAME)")
        case ast.Call(func=ast.Name(id=name)):
            raise MadocError(f"unknown function {name!r}; {nearest_hint(name, scope.functions)}")
    raise MadocError(f"expected arithmetic, got {ast.unparse(node)!r}")


def _name_in(argument: ast.expr, kind: str) -> str:
    match argument:
        case ast.Name(id=name) | ast.Constant(value=str() as name):
            return name
    text = ast.unparse(argument)
    raise MadocError(
        f"expected the name of a {'sensor' if kind == 'sensor' else 'joint'} in {kind}({text}), "
        f'in quotes where it is no plain word, as {kind}("left-knee")'
    )


def _check_sizes(node: Node, text: str) -> None:
    """Refuse a constant or a weight of what is read beyond `LARGEST`, as `1e308 * 10` is."""
    if isinstance(node, Operation):
        for argument in node.arguments:
            _check_sizes(argument, text)
    weights, constant = weighted_sum(node) or ({}, 0.0)
    wrong = next((value for value in (*weights.values(), constant) if not abs(value) <= LARGEST), None)
    if wrong is not None:
        raise MadocError(f"expected numbers up to {LARGEST:g} in {text!r}, got {wrong:g}; choose another unit")


def _reads(node: Node) -> list[Read]:
    if isinstance(node, Operation):
        return [read for argument in node.arguments for read in _reads(argument)]
    return [node] if isinstance(node, Read) else []
