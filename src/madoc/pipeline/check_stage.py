"""Checks of data before it is calibrated to: what a log shows, and whether a calibration to it would find a truth."""

from dataclasses import dataclass

import jax

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.data import Disturbance, disturb, logs, observed_task
from madoc.data.findings import Finding
from madoc.diagnosis import Diagnosis, check
from madoc.errors import MadocError
from madoc.parameters import ParameterSpace
from madoc.pipeline.forecast import Forecast, forecast
from madoc.pipeline.keys import check_seed, stage_key
from madoc.pipeline.methods import methods_for
from madoc.pipeline.orders import NO_PERMISSION, CalibrationOrder, CheckOrder, Permission, SelftestOrder
from madoc.pipeline.preparation import prepare
from madoc.pipeline.refusals import check_order
from madoc.runs.budget import read_budget
from madoc.verdict.predicted import sensor_noise
from madoc.verdict.selftest import Selftest, selftest


@dataclass(frozen=True)
class Checked:
    """The outcome of a check: a diagnosis of the log, or the refusal of one that cannot be read.

    Attributes:
        space: The robot's parameters.
        diagnosis: What the log shows; None where it cannot be read.
        forecasts: How long methods would take; none after a fatal finding.
        refusal: Why the log cannot be read.
    """

    space: ParameterSpace
    diagnosis: Diagnosis | None
    forecasts: tuple[Forecast, ...] = ()
    refusal: Finding | None = None

    @property
    def fatal(self) -> bool:
        """Whether a calibration would be refused."""
        return self.diagnosis is None or self.diagnosis.fatal


def check_logs(order: CheckOrder, *, permission: Permission = NO_PERMISSION) -> Checked:
    """Read logs of a user's own robot, with velocities put in if asked, and diagnose them.

    Raises:
        MadocError: The robot's spec or its model is refused; the refusal of a log is part of the outcome.
    """
    check_seed(order.seed)
    read_budget(order.budget)
    robot = robots.load(order.spec, **vars(permission))
    task = robot.task
    try:
        dataset = logs.read(order.paths, robot, clip_actions=order.clip_actions)
        if order.velocities == "differences":
            put_in = Disturbance(velocities=order.velocities)
            dataset = disturb(dataset, put_in, task, stage_key(order.seed, "disturbing"))
            task = observed_task(task, dataset)
    except MadocError as error:
        return Checked(task.parameters, None, refusal=Finding("fatal", str(error)))
    simulator = simulation.make(task)
    diagnosis = check(dataset, simulator, robot=robot, seed=order.seed)
    if diagnosis.fatal or not order.forecast:
        return Checked(task.parameters, diagnosis)
    forecasts = forecast(CalibrationProblem(dataset, simulator), budget=order.budget)
    return Checked(task.parameters, diagnosis, forecasts)


def selftest_of(order: SelftestOrder, *, quiet: bool = False, permission: Permission = NO_PERMISSION) -> Selftest:
    """Plant truths in the order's robot, replay the logged actions, and calibrate to each replay.

    The method is the order's; of `auto`, the first candidate that does not refuse.

    Raises:
        MadocError: The order cannot be carried out, or every method refuses.
    """
    calibration = CalibrationOrder(order.task, order.source, order.search)
    check_order(calibration)
    if order.truths < 1:
        raise MadocError(f"expected at least 1 truth to plant, got {order.truths}")
    prepared = prepare(calibration, permission=permission)
    methods = list(methods_for(calibration).values())
    key = stage_key(order.search.seed, "selftest")
    return selftest(
        methods,
        prepared.dataset,
        prepared.simulator,
        noise=sensor_noise(prepared.bench),
        signals=prepared.simulator.task.signal_names,
        keys=[jax.random.fold_in(key, index) for index in range(order.truths)],
        budget=prepared.budget,
        quiet=quiet,
    )
