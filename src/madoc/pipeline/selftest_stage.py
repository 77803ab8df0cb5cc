"""`madoc selftest`: would this data let a calibration find a truth? From an order to an answer; no file is left."""

import jax

from madoc.calibration import CALIBRATORS
from madoc.diagnosis.channels import signal_names
from madoc.errors import MadocError
from madoc.pipeline.auto_stage import candidates_for
from madoc.pipeline.keys import stage_key
from madoc.pipeline.methods import make_method
from madoc.pipeline.orders import AUTO, CalibrationOrder, SelftestOrder
from madoc.pipeline.preparation import check_order, prepare
from madoc.verdict.predicted import sensor_noise
from madoc.verdict.selftest import Selftest, selftest


def selftest_of(order: SelftestOrder, *, quiet: bool = False) -> Selftest:
    """Plant truths in the order's robot, and run its method on what the logged actions make of each.

    `auto` is the first of its candidates that does not refuse.

    Raises:
        MadocError: The order cannot be carried out, or every method refuses.
    """
    calibration = CalibrationOrder(order.task, order.source, order.search)
    check_order(calibration)
    if order.truths < 1:
        raise MadocError(f"expected at least 1 truth to plant, got {order.truths}")
    prepared = prepare(calibration)
    if prepared.method == AUTO:
        methods = list(candidates_for(prepared).values())
    else:
        methods = [make_method(CALIBRATORS, prepared.method, order.search.changes)]
    key = stage_key(order.search.seed, "selftest")
    return selftest(
        methods,
        prepared.dataset,
        prepared.simulator,
        noise=sensor_noise(prepared.bench),
        signals=signal_names(prepared.simulator.task),
        keys=[jax.random.fold_in(key, index) for index in range(order.truths)],
        budget=prepared.budget,
        quiet=quiet,
    )
