"""Expressions: values worked by hand, weighted sums taken apart, everything else refused with a sentence."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from madoc.errors import MadocError
from madoc.robots.expressions import Read, Scope, parse

VALUES = {"position(a)": 0.5, "velocity(a)": -2.0, "sensor(tip)[2]": 3.0, "position('left-knee')": 0.25}


def read(one):
    return VALUES[str(one)]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("position(a)", 0.5),
        ("-position(a)", -0.5),
        ("+velocity(a)", -2.0),
        ("2 * position(a) + 1", 2.0),
        ("1 - velocity(a) / 4", 1.5),
        ("velocity(a) ** 2", 4.0),
        ("2 ** 3 * position(a)", 4.0),
        ("sensor(tip)[2] * 1000", 3000.0),
        ("position(a) * 180 / pi", 28.64788975654116),
        ("sin(position(a)) ** 2 + cos(position(a)) ** 2", 1.0),
        ("sqrt(abs(velocity(a)) + 2)", 2.0),
        ("atan2(position(a), 0.5)", math.pi / 4),
        ("tan(0.5) - tan(position(a)) + velocity(a)", -2.0),
        ("asin(sin(0.3)) + acos(cos(0.2)) + atan(tan(0.1)) + 0 * position(a)", 0.6),
        ("exp(0) + position('left-knee')", 1.25),
        ('  position("left-knee")', 0.25),
        ("1e-3 * position(a)", 5e-4),
        ("min(position(a), 0) + max(velocity(a), -1) + tanh(0)", -1.0),
        ("where(-3 < velocity(a) < -1 and not position(a) > 1, 10, 20)", 10.0),
        ("where(position(a) > 1 or velocity(a) >= 0, 10, 20)", 20.0),
        ("where(1 < 2, min(1, 2), 3) * position(a)", 0.5),
    ],
)
def test_values(text, value):
    assert parse(text).value(read) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize("namespace", [np, jnp])
def test_arrays_of_either_kind(namespace):
    values = namespace.asarray([0.25, 0.5])
    found = parse("abs(-2 * position(a)) ** 2 + sqrt(position(a) * 0 + 4)").value(lambda _: values, namespace)
    np.testing.assert_allclose(found, [2.25, 3.0], rtol=1e-6)
    assert isinstance(found, type(values))
    chosen = parse("where(0.1 < position(a) < 0.4 or not position(a) < 9, min(position(a), 0.2), 7)")
    np.testing.assert_allclose(chosen.value(lambda _: values, namespace), [0.2, 7.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "weights", "constant"),
    [
        ("position(a)", {"position(a)": 1.0}, 0.0),
        ("3 - 2 * (position(a) - 1) / 4", {"position(a)": -0.5}, 3.5),
        ("position(a) - position(b) + position(a)", {"position(a)": 2.0, "position(b)": -1.0}, 0.0),
        ("position(a) - position(a) + position(b)", {"position(b)": 1.0}, 0.0),
        ("-(position(a) * 2 ** 2 * cos(0))", {"position(a)": -4.0}, 0.0),
        ("+position(a) * 180 / pi", {"position(a)": 180 / math.pi}, 0.0),
    ],
)
def test_weighted_sums(text, weights, constant):
    found, rest = parse(text).affine()
    assert {str(one): weight for one, weight in found.items()} == pytest.approx(weights)
    assert rest == pytest.approx(constant)


@pytest.mark.parametrize(
    "text",
    ["sin(position(a))", "position(a) ** 2", "position(a) * position(b)", "1 / position(a)", "atan2(1, velocity(a))"],
)
def test_no_weighted_sum(text):
    assert parse(text).affine() is None


def test_what_is_read():
    reads = parse("position(a) + 2 * sensor('my tip')[1] - position(a)").reads
    assert reads == (Read("position", "a"), Read("sensor", "my tip", 1))
    assert [str(one) for one in reads] == ["position(a)", "sensor('my tip')[1]"]


def test_names_where_names_are_allowed():
    expression = parse("-(height - 1) ** 2", scope=Scope(["height", "push"], ()))
    assert expression.reads == (Read("name", "height"),)
    assert expression.value(lambda _: 3.0) == -4.0


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "which does not parse"),
        ("position(a", "which does not parse"),
        ("position(a) +", "which does not parse"),
        ("a = 1", "which does not parse"),
        ("import os", "which does not parse"),
        ("\0", "expected an expression"),
        ("__import__('os').system('true')", "expected arithmetic"),
        ("open('x')", "unknown function 'open'"),
        ("(lambda: 1)()", "expected arithmetic"),
        ("[1, 2]", "expected arithmetic"),
        ("position(a).real", "expected arithmetic"),
        ("position(a) if 1 else 2", "expected arithmetic"),
        ("position(a) > 1", r"expected a number, got the condition 'position\(a\) > 1'"),
        ("1 + (position(a) > 1)", "expected a number, got the condition"),
        ("where(position(a), 1, 2)", "expected a condition, as height < 0.2, got 'position\\(a\\)', which is a number"),
        ("position(a) == 1", "expected < <= > or >= in a condition"),
        ("uniform(0, 1) + position(a)", "unknown function 'uniform'"),
        ("position(a) // 2", "expected arithmetic"),
        ("position(a) % 2", "expected arithmetic"),
        ("not position(a)", "expected a condition"),
        ("positon(a)", "unknown function 'positon'; nearest: position"),
        ("coss(position(a))", "unknown function 'coss'; nearest: cos"),
        ("position()", r"position takes one name, as position\(NAME\)"),
        ("position(a, b)", "position takes one name"),
        ("position(left-knee)", "in quotes where it is no plain word"),
        ("position(left.knee)", "in quotes where it is no plain word"),
        ("sensor(tip)[1.5]", "expected arithmetic"),
        ("sensor(tip)[True]", "expected arithmetic"),
        ("sensor(tip)[1:2]", "expected arithmetic"),
        ("sin(1, 2)", "sin takes 1 values, got 2"),
        ("sin(position(a), x=1)", "sin takes 1 values"),
        ("atan2(position(a))", "atan2 takes 2 values, got 1"),
        ("shoulder", r"'shoulder' alone reads nothing; write position\(shoulder\)"),
        ("1 + 1", "is 2 whatever the robot does"),
        ("pi", "is 3.14159 whatever the robot does"),
        ("1 / 0", "expected an expression with a value"),
        ("(-1) ** 0.5", "expected an expression with a value"),
        ("9.0 ** 9 ** 9", "expected an expression with a value"),
        ("sqrt(-1)", "expected an expression with a value"),
        ("True", "expected a number, got True"),
        ("'text'", "expected a number, got 'text'"),
        ("1j", "expected a number, got 1j"),
        ("None", "expected a number, got None"),
        ("(" * 120 + "1" + ")" * 120, "whatever the robot does"),
        ("-" * 400 + "1", "whatever the robot does|expected an expression"),
        ("1 + " * 200 + "1", "expected at most 500 characters"),
    ],
)
def test_what_is_no_expression(text, sentence):
    with pytest.raises(MadocError, match=sentence):
        parse(text)


def test_unknown_names_have_the_nearest():
    with pytest.raises(MadocError, match="unknown name 'heigth'; nearest: height"):
        parse("heigth", scope=Scope(["height", "push"], ()))
    with pytest.raises(MadocError, match="unknown function 'position'"):
        parse("position(a)", scope=Scope(["height"], ()))
