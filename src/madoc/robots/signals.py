"""Signals of a spec: their expressions, checked against the model, and their units."""

import mujoco

from madoc.robots.expressions import Expression
from madoc.robots.grammar import parse
from madoc.robots.model import Draft, is_single, is_slide
from madoc.robots.sensing import Layout, Signals
from madoc.robots.spec import SCALES


def read_signals(draft: Draft, model: mujoco.MjModel) -> Signals:
    """The signals of a spec, each with an expression that parses, has a value, and reads what the model has."""
    expressions = []
    layout = Layout.of(model)
    for index, signal in enumerate(draft.spec.signals):
        with draft.document.at("signals", index, "reads"):
            expression = parse(signal.reads)
            for read in expression.reads:
                layout.address(read)
        expressions.append(expression)
        _check_unit(draft, model, index, expression)
    return Signals(tuple(expressions), layout)


def _plain_unit(model: mujoco.MjModel, expression: Expression) -> str:
    """The SI unit of an expression that is one joint's position or velocity, unscaled; else empty."""
    affine = expression.affine()
    if affine is None or len(affine[0]) != 1:
        return ""
    ((read, weight),) = affine[0].items()
    if read.kind == "sensor" or weight != 1.0:
        return ""
    joint = int(model.joint(read.name).id)
    if not is_single(model, joint):
        return ""
    return ("m" if is_slide(model, joint) else "rad") + ("/s" if read.kind == "velocity" else "")


def signal_unit(draft: Draft, model: mujoco.MjModel, expression: Expression, index: int) -> str:
    """The unit of a signal: the spec's, else the one that follows from its joint; empty where neither gives one."""
    return draft.spec.signals[index].unit or _plain_unit(model, expression)


def _check_unit(draft: Draft, model: mujoco.MjModel, index: int, expression: Expression) -> None:
    """Refuse `position(JOINT)` in deg: the unit converts nothing, the expression has to."""
    plain, given = _plain_unit(model, expression), draft.spec.signals[index].unit
    if plain and given in SCALES:
        factor = "180 / pi" if plain.startswith("rad") else f"{1.0 / SCALES[given]:g}"
        raise draft.document.error(
            ("signals", index, "unit"),
            f"{expression.text} is in {plain}, not in {given}; "
            f"write reads: {expression.text} * {factor}, or unit: {plain}",
        )
