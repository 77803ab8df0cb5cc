"""Signals of a spec: expressions that the model can answer, in the unit they say."""

import mujoco
import numpy as np

from madoc.robots.draft import SCALES, Draft
from madoc.robots.expressions import Expression, ExpressionError, parse
from madoc.robots.model import is_single, is_slide
from madoc.robots.sensing import Layout, Signals, quiet_arithmetic


def read_signals(draft: Draft, model: mujoco.MjModel) -> Signals:
    """What is observed, tried once at the model's initial state."""
    expressions = []
    layout = Layout.of(model)
    for index, signal in enumerate(draft.spec.signals):
        place = ("signals", index, "reads")
        try:
            expression = parse(signal.reads)
            for read in expression.reads:
                layout.address(read)
            with quiet_arithmetic():
                expression.value(lambda _: np.zeros(1), np)
                expression.affine()
        except ExpressionError as error:
            raise draft.document.error(place, str(error)) from error
        except ArithmeticError as error:
            raise draft.document.error(place, f"expected an expression with a value, got {signal.reads!r}") from error
        expressions.append(expression)
        _check_unit(draft, model, index, expression)
    return Signals(tuple(expressions), layout)


def _plain_unit(draft: Draft, expression: Expression) -> str:
    """The SI unit of an expression that is one joint's position or speed as it is; else empty."""
    affine = expression.affine()
    if affine is None or len(affine[0]) != 1:
        return ""
    ((read, weight),) = affine[0].items()
    if read.kind == "sensor" or weight != 1.0:
        return ""
    joint = int(draft.plain.joint(read.name).id)
    if not is_single(draft.plain, joint):
        return ""
    return ("m" if is_slide(draft.plain, joint) else "rad") + ("/s" if read.kind == "velocity" else "")


def signal_unit(draft: Draft, expression: Expression, index: int) -> str:
    """What a signal is in: what the spec says, else what its joint tells; empty where neither does."""
    return draft.spec.signals[index].unit or _plain_unit(draft, expression)


def _check_unit(draft: Draft, model: mujoco.MjModel, index: int, expression: Expression) -> None:
    """Refuse `position(JOINT)` in deg: the unit is only a word, the expression has to convert."""
    plain, said = _plain_unit(draft, expression), draft.spec.signals[index].unit
    if plain and said in SCALES:
        angle = plain.startswith("rad")
        hint = " * 180 / pi" if angle else f" * {1.0 / SCALES[said]:g}"
        raise draft.document.error(
            ("signals", index, "unit"),
            f"{expression.text} is in {plain}, not in {said}; write reads: {expression.text}{hint}, or unit: {plain}",
        )
