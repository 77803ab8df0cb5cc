"""Checks of data before it is calibrated to: what a log shows, how long it would take, and whether it finds a truth."""

import time
from dataclasses import dataclass, replace

import jax

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, LeastSquares, Npe
from madoc.data import Disturbance, disturb, logs, observed_task
from madoc.data.findings import Finding
from madoc.diagnosis import Diagnosis, check
from madoc.errors import MadocError
from madoc.parameters import ParameterSpace
from madoc.pipeline.calibration_stage import prepare
from madoc.pipeline.methods import methods_for
from madoc.pipeline.orders import NO_PERMISSION, CalibrationOrder, CheckOrder, Permission, SelftestOrder
from madoc.pipeline.refusals import check_counts, check_seed, stage_key
from madoc.report.words import duration
from madoc.runs.budget import read_budget
from madoc.verdict.predicted import sensor_noise
from madoc.verdict.selftest import Selftest, selftest

REFINING_EPOCHS = 6
"""Number of steps on all windows that least squares usually takes."""
PREPARATION = 1.15
"""Ratio of the time of a whole run of NPE to that of its rounds: cloning, and the posterior of each round."""


@dataclass(frozen=True)
class Forecast:
    """Expected duration of a method and the control steps that it learns from.

    `seconds` is None where it refuses the data.
    """

    method: str
    seconds: float | None
    control_steps: int
    refusal: str = ""

    @property
    def sentence(self) -> str:
        """The forecast in words."""
        if self.seconds is None:
            return f"{self.method} would refuse: {self.refusal}"
        return f"{self.method}: about {duration(self.seconds)} for {self.control_steps:,} control steps"


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
    check_counts(truth=order.truths)
    prepared = prepare(calibration, permission=permission)
    methods = list(methods_for(calibration.method, calibration.search.set).values())
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


def forecast(problem: CalibrationProblem, *, budget: int) -> tuple[Forecast, ...]:
    """Forecasts of least squares until it settles, and of NPE for a budget of control steps, with their defaults.

    Least squares takes one step of its search, NPE two epochs of each kind, the first of which compiles.
    """
    return (_least_squares(problem), _npe(problem, budget))


def _least_squares(problem: CalibrationProblem) -> Forecast:
    method, name = LeastSquares(), "least-squares"
    try:
        state = method.init(problem, jax.random.key(0))
    except MadocError as error:
        return Forecast(name, None, 0, str(error))
    started = time.monotonic()
    state, epoch = method.step(problem, state)
    seconds = time.monotonic() - started
    total = method.whole_run(problem, state, refining_epochs=REFINING_EPOCHS)
    return Forecast(name, seconds / epoch.control_steps * total, total)


def _npe(problem: CalibrationProblem, budget: int) -> Forecast:
    usual, name = Npe(), "npe"
    method = replace(usual, cloning_epochs=0, epochs=2, fitting_epochs=2)
    try:
        state, times = method.init(problem, jax.random.key(0)), []
        for _ in range(method.epochs + method.fitting_epochs):
            started = time.monotonic()
            state, epoch = method.step(problem, state)
            times.append((time.monotonic() - started, epoch.control_steps))
    except MadocError as error:
        return Forecast(name, None, 0, str(error))
    (_, _), (simulating, steps), (_, _), (fitting, _) = times  # the first of each compiles
    a_round = usual.epochs * simulating + usual.fitting_epochs * fitting
    return Forecast(name, PREPARATION * a_round * budget / (usual.epochs * steps), budget)
