"""Expressions of a spec file: arithmetic of what joints and sensors read. They are parsed into a tree, never run.

`position(JOINT)`, `velocity(JOINT)` and `sensor(NAME)` read one value; `[i]` picks one of several. Numbers, pi,
`+ - * / **`, brackets and the functions below combine them. A name that is no identifier goes in quotes.
"""

import ast
import math
import operator
from collections.abc import Callable, Collection
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from madoc.errors import MadocError, nearest_hint
from madoc.tasks.base import Batch

READS = ("position", "velocity", "sensor")
FUNCTIONS: dict[str, int] = {
    **dict.fromkeys(("sin", "cos", "tan", "asin", "acos", "atan", "sqrt", "abs", "exp"), 1),
    "atan2": 2,
}
"""Functions and their numbers of arguments; all are in the array API, so NumPy and JAX both have them."""
LONGEST = 500
"""Longest expression in characters; a longer one is refused."""

_BINARY: dict[type, Callable[[Batch, Batch], Batch]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_UNARY: dict[type, Callable[[Batch], Batch]] = {ast.UAdd: operator.pos, ast.USub: operator.neg}


@dataclass(frozen=True)
class Read:
    """One value that an expression reads: its kind (one of `READS`, or `name` for a bare name), its name and index."""

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
    """An operator of the module `operator`, or a function of `FUNCTIONS` by its name, and its arguments."""

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
    _root: Node

    def value(self, look_up: Callable[[Read], Batch], namespace: ModuleType = math) -> Batch:
        """The value of the expression; `look_up` gives each value read, and functions come from `namespace`."""
        return _value(self._root, look_up, namespace)

    def affine(self) -> Sum | None:
        """Coefficients and constant where the expression is a weighted sum of what it reads; else None."""
        whole = _affine(self._root)
        return None if whole is None else ({read: weight for read, weight in whole[0].items() if weight}, whole[1])


def parse(text: str, *, names: Collection[str] | None = None) -> Expression:
    """An expression of joints and sensors; or, with `names`, of these names alone.

    Raises:
        MadocError: The text is not such an expression, reads nothing, or has no value, as `1 / 0`.
    """
    if len(text) > LONGEST:
        raise MadocError(f"expected at most {LONGEST} characters, got {len(text)}")
    try:
        root = _tree(ast.parse(text.strip(), mode="eval").body, names)
        reads = tuple(dict.fromkeys(_reads(root)))
        with np.errstate(all="ignore"):
            value = _value(root, lambda _: np.zeros(1), np)
        _affine(root)
    except MadocError:
        raise
    except SyntaxError as error:
        raise MadocError(f"expected an expression, got {text!r}, which does not parse") from error
    except (RecursionError, MemoryError, ArithmeticError, ValueError) as error:
        raise MadocError(f"expected an expression with a value, got {text!r}") from error
    if not reads:
        raise MadocError(f"{text!r} is {value:g} whatever the robot does; read a joint or a sensor")
    return Expression(text, reads, root)


def _tree(node: ast.expr, names: Collection[str] | None) -> Node:
    match node:
        case ast.Constant(value=number) if isinstance(number, int | float) and not isinstance(number, bool):
            return float(number)
        case ast.Constant(value=other):
            raise MadocError(f"expected a number, got {other!r}")
        case ast.Name(id="pi"):
            return math.pi
        case ast.BinOp() if type(node.op) in _BINARY:
            return Operation(_BINARY[type(node.op)], (_tree(node.left, names), _tree(node.right, names)))
        case ast.UnaryOp() if type(node.op) in _UNARY:
            return Operation(_UNARY[type(node.op)], (_tree(node.operand, names),))
        case ast.Call(func=ast.Name(id=function)) if function in FUNCTIONS:
            if node.keywords or len(node.args) != FUNCTIONS[function]:
                raise MadocError(f"{function} takes {FUNCTIONS[function]} values, got {len(node.args)}")
            return Operation(function, tuple(_tree(argument, names) for argument in node.args))
    return _read(node, names)


def _read(node: ast.expr, names: Collection[str] | None) -> Read:
    """The joint, sensor or name that a node reads; nodes that read none of them are refused."""
    match node:
        case ast.Name(id=name):
            if names is None:
                raise MadocError(
                    f"{name!r} alone reads nothing; write position({name}), velocity({name}) or sensor({name})"
                )
            if name in names:
                return Read("name", name)
            raise MadocError(f"unknown name {name!r}; {nearest_hint(name, [*names, *FUNCTIONS, 'pi'])}")
        case ast.Subscript(value=ast.Call() as call, slice=ast.Constant(value=int() as index)) if index is not True:
            inner = _read(call, names)
            return Read(inner.kind, inner.name, index)
        case ast.Call(func=ast.Name(id=kind), args=[argument], keywords=[]) if kind in READS and names is None:
            return Read(kind, _name_in(argument, kind))
        case ast.Call(func=ast.Name(id=kind)) if kind in READS and names is None:
            raise MadocError(f"{kind} takes one name, as {kind}(NAME)")
        case ast.Call(func=ast.Name(id=name)):
            known = [*FUNCTIONS, *(READS if names is None else ())]
            raise MadocError(f"unknown function {name!r}; {nearest_hint(name, known)}")
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


def _reads(node: Node) -> list[Read]:
    if isinstance(node, Operation):
        return [read for argument in node.arguments for read in _reads(argument)]
    return [node] if isinstance(node, Read) else []


def _value(node: Node, look_up: Callable[[Read], Batch], namespace: ModuleType) -> Batch:
    if isinstance(node, Read):
        return look_up(node)
    if isinstance(node, float):
        return node
    arguments = [_value(argument, look_up, namespace) for argument in node.arguments]
    if not isinstance(node.function, str):
        value = node.function(*arguments)
        if isinstance(value, complex):
            raise ArithmeticError("a fractional power of a negative number")
        return value
    if node.function == "abs":
        return abs(arguments[0])
    plain = all(isinstance(argument, float) for argument in arguments)
    return getattr(math if plain else namespace, node.function)(*arguments)


def _affine(node: Node) -> Sum | None:
    if isinstance(node, Read):
        return {node: 1.0}, 0.0
    if isinstance(node, float):
        return {}, node
    parts = [_affine(argument) for argument in node.arguments]
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
    return {}, _value(node, lambda _: 0.0, math)


def _scaled(affine: Sum, factor: float) -> Sum:
    return {read: weight * factor for read, weight in affine[0].items()}, affine[1] * factor
