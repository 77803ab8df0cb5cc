"""Expressions of a spec file: arithmetic of what a robot's joints and sensors read. Parsed and walked, never run.

`position(JOINT)`, `velocity(JOINT)` and `sensor(NAME)` read one value; `[i]` picks one of several. Numbers, pi,
`+ - * / **`, brackets and the functions below combine them. A name that is no identifier goes in quotes.
"""

import ast
import math
import operator
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from madoc.robots.document import nearest
from madoc.tasks.base import Batch

READS = ("position", "velocity", "sensor")
FUNCTIONS: dict[str, int] = {
    **dict.fromkeys(("sin", "cos", "tan", "asin", "acos", "atan", "sqrt", "abs", "exp"), 1),
    "atan2": 2,
}
"""How many arguments each takes; all are in the array API, so NumPy and JAX both have them."""
LONGEST = 500
"""Characters."""

_BINARY: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_UNARY: dict[type, Callable[[Any], Any]] = {ast.UAdd: operator.pos, ast.USub: operator.neg}


class ExpressionError(ValueError):
    """An expression that is none; the sentence says why."""


@dataclass(frozen=True)
class Read:
    """One value that an expression reads.

    Attributes:
        kind: `position`, `velocity`, `sensor`; `name` for a bare name, where those are allowed.
        name: Of the joint or sensor.
        index: Which of its values; None where none is named.
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
class Expression:
    """A parsed expression.

    Attributes:
        text: As it was written.
        reads: What it reads, each once.
    """

    text: str
    reads: tuple[Read, ...]
    _root: ast.expr

    def value(self, look_up: Callable[[Read], Batch], namespace: Any = math) -> Batch:
        """Its value, with what it reads looked up; functions come from `namespace`."""
        return _value(self._root, look_up, namespace)

    def affine(self) -> tuple[dict[Read, float], float] | None:
        """Its coefficients and its constant, where it is a weighted sum of what it reads; else None."""
        found = _affine(self._root)
        return None if found is None else ({read: weight for read, weight in found[0].items() if weight}, found[1])


def parse(text: str, *, names: Collection[str] | None = None) -> Expression:
    """An expression of joints and sensors; or, with `names`, of these names alone.

    Raises:
        ExpressionError: It is none.
    """
    if len(text) > LONGEST:
        raise ExpressionError(f"expected at most {LONGEST} characters, got {len(text)}")
    try:
        root = ast.parse(text.strip(), mode="eval").body
        reads = tuple(dict.fromkeys(_reads(root, names)))
        constant = not reads and _value(root, lambda _: 0.0, math)
    except SyntaxError as error:
        raise ExpressionError(f"expected an expression, got {text!r}, which does not parse") from error
    except (RecursionError, MemoryError, ArithmeticError) as error:
        raise ExpressionError(f"expected an expression with a value, got {text!r}") from error
    except ValueError as error:
        if isinstance(error, ExpressionError):
            raise
        raise ExpressionError(f"expected an expression with a value, got {text!r}") from error
    if not reads:
        raise ExpressionError(f"{text!r} is {constant:g} whatever the robot does; read a joint or a sensor")
    return Expression(text, reads, root)


def _reads(node: ast.expr, names: Collection[str] | None) -> list[Read]:
    match node:
        case ast.Constant(value=bool() | complex()) | ast.Constant(value=str() | bytes() | None):
            raise ExpressionError(f"expected a number, got {node.value!r}")
        case ast.Constant(value=int() | float()):
            return []
        case ast.Name(id="pi"):
            return []
        case ast.BinOp() if type(node.op) in _BINARY:
            return _reads(node.left, names) + _reads(node.right, names)
        case ast.UnaryOp() if type(node.op) in _UNARY:
            return _reads(node.operand, names)
        case ast.Call(func=ast.Name(id=function)) if function in FUNCTIONS:
            if node.keywords or len(node.args) != FUNCTIONS[function]:
                raise ExpressionError(f"{function} takes {FUNCTIONS[function]} values, got {len(node.args)}")
            return [read for argument in node.args for read in _reads(argument, names)]
        case _:
            return [_read(node, names)]


def _read(node: ast.expr, names: Collection[str] | None) -> Read:
    """A joint, a sensor or a name.

    Raises:
        ExpressionError: The node is none of them.
    """
    match node:
        case ast.Name(id=name):
            if names is not None and name in names:
                return Read("name", name)
            raise _unknown(name, "" if names is None else "name", [*(names or ()), *READS, *FUNCTIONS, "pi"])
        case ast.Subscript(value=ast.Call() as call, slice=ast.Constant(value=int() as index)) if not isinstance(
            index, bool
        ):
            inner = _read(call, names)
            return Read(inner.kind, inner.name, index)
        case ast.Call(func=ast.Name(id=kind), args=[argument], keywords=[]) if kind in READS and names is None:
            return Read(kind, _name_in(argument, kind))
        case ast.Call(func=ast.Name(id=kind)) if kind in READS and names is None:
            raise ExpressionError(f"{kind} takes one name, as {kind}(NAME)")
        case ast.Call(func=ast.Name(id=name)):
            raise _unknown(name, "function", [*FUNCTIONS, *(READS if names is None else ())])
    raise ExpressionError(f"expected arithmetic, got {ast.unparse(node)!r}")


def _unknown(name: str, what: str, known: list[str]) -> ExpressionError:
    near = nearest(name, known)
    hint = f"nearest: {', '.join(near)}" if near else f"there are: {', '.join(known)}"
    if not what:
        return ExpressionError(
            f"{name!r} alone reads nothing; write position({name}), velocity({name}) or sensor({name})"
        )
    return ExpressionError(f"unknown {what} {name!r}; {hint}")


def _name_in(argument: ast.expr, kind: str) -> str:
    match argument:
        case ast.Name(id=name):
            return name
        case ast.Constant(value=str() as name):
            return name
    text = ast.unparse(argument)
    raise ExpressionError(
        f"expected the name of a {'sensor' if kind == 'sensor' else 'joint'} in {kind}({text}), "
        f'in quotes where it is no plain word, as {kind}("left-knee")'
    )


def _value(node: ast.expr, look_up: Callable[[Read], Batch], namespace: Any) -> Batch:
    match node:
        case ast.Constant(value=number):
            return float(number)  # type: ignore[arg-type]
        case ast.Name(id="pi"):
            return math.pi
        case ast.BinOp():
            left, right = _value(node.left, look_up, namespace), _value(node.right, look_up, namespace)
            return _real(_BINARY[type(node.op)](left, right))
        case ast.UnaryOp():
            return _UNARY[type(node.op)](_value(node.operand, look_up, namespace))
        case ast.Call(func=ast.Name(id=function)) if function in FUNCTIONS:
            arguments = [_value(argument, look_up, namespace) for argument in node.args]
            plain = all(isinstance(argument, float) for argument in arguments)
            return (
                abs(arguments[0]) if function == "abs" else getattr(math if plain else namespace, function)(*arguments)
            )
    return look_up(_as_read(node))


def _real(value: Batch) -> Batch:
    if isinstance(value, complex):
        raise ArithmeticError("a fractional power of a negative number")
    return value


def _as_read(node: ast.expr) -> Read:
    match node:
        case ast.Name(id=name):
            return Read("name", name)
        case ast.Subscript(value=call, slice=ast.Constant(value=int() as index)):
            inner = _as_read(call)
            return Read(inner.kind, inner.name, index)
        case ast.Call(func=ast.Name(id=kind), args=[argument]):
            return Read(kind, _name_in(argument, kind))
    raise AssertionError(ast.dump(node))


def _affine(node: ast.expr) -> tuple[dict[Read, float], float] | None:
    match node:
        case ast.Constant() | ast.Name(id="pi"):
            return {}, _value(node, lambda _: 0.0, math)
        case ast.BinOp():
            left, right = _affine(node.left), _affine(node.right)
            return None if left is None or right is None else _combined(node, left, right)
        case ast.UnaryOp():
            inner = _affine(node.operand)
            sign = -1.0 if isinstance(node.op, ast.USub) else 1.0
            return None if inner is None else _scaled(inner, sign)
        case ast.Call(func=ast.Name(id=function)) if function in FUNCTIONS:
            inners = [_affine(argument) for argument in node.args]
            if any(inner is None or inner[0] for inner in inners):
                return None
            return {}, _value(node, lambda _: 0.0, math)
    return {_as_read(node): 1.0}, 0.0


def _combined(
    node: ast.BinOp, left: tuple[dict[Read, float], float], right: tuple[dict[Read, float], float]
) -> tuple[dict[Read, float], float] | None:
    match node.op:
        case ast.Add() | ast.Sub():
            right = _scaled(right, -1.0 if isinstance(node.op, ast.Sub) else 1.0)
            weights = {read: left[0].get(read, 0.0) + right[0].get(read, 0.0) for read in {**left[0], **right[0]}}
            return weights, left[1] + right[1]
        case ast.Mult() if not left[0]:
            return _scaled(right, left[1])
        case ast.Mult() if not right[0]:
            return _scaled(left, right[1])
        case ast.Div() if not right[0] and right[1]:
            return _scaled(left, 1.0 / right[1])
        case _ if not left[0] and not right[0]:
            return {}, _BINARY[type(node.op)](left[1], right[1])
    return None


def _scaled(affine: tuple[dict[Read, float], float], factor: float) -> tuple[dict[Read, float], float]:
    return {read: weight * factor for read, weight in affine[0].items()}, affine[1] * factor
