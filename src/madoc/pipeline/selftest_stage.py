"""`madoc selftest`: would this data show a truth? From an order to an answer; nothing is left behind."""

import jax

from madoc.calibration import CALIBRATORS
from madoc.diagnosis.channels import signal_names
from madoc.errors import MadocError
from madoc.pipeline.auto_stage import AUTO, candidates_for
from madoc.pipeline.calibration_stage import CalibrationOrder, check_order, prepare
from madoc.pipeline.keys import stage_key
from madoc.pipeline.methods import make_method
from madoc.verdict.predicted import sensor_noise
from madoc.verdict.selftest import Selftest, selftest


def selftest_of(order: CalibrationOrder, *, truths: int, quiet: bool = True) -> Selftest:
    """Plant so many truths in the order's robot, and run its method on what the logged actions make of each.

    `auto` is the first of its candidates that does not refuse.

    Raises:
        MadocError: The order cannot be carried out, or every method refuses.
    """
    check_order(order)
    if truths < 1:
        raise MadocError(f"expected at least 1 truth to plant, got {truths}")
    prepared = prepare(order)
    if order.method == AUTO:
        methods = list(candidates_for(prepared, order.changes).values())
    else:
        methods = [make_method(CALIBRATORS, order.method, order.changes)]
    key = stage_key(order.seed, "selftest")
    return selftest(
        methods,
        prepared.dataset,
        prepared.simulator,
        noise=sensor_noise(prepared.bench),
        signals=signal_names(prepared.simulator.task),
        keys=[jax.random.fold_in(key, index) for index in range(truths)],
        budget=order.budget,
        quiet=quiet,
    )
