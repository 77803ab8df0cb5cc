"""Checking a user's logs before anything is solved: read, look, forecast."""

from dataclasses import dataclass

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.data import Disturbance, disturb, logs, observed_task
from madoc.data.findings import Finding
from madoc.diagnosis import Diagnosis, check
from madoc.errors import MadocError
from madoc.parameters import ParameterSpace
from madoc.pipeline.forecast import Forecast, forecast
from madoc.pipeline.keys import stage_key
from madoc.pipeline.orders import CheckOrder


@dataclass(frozen=True)
class Checked:
    """What `madoc check` found.

    Attributes:
        space: The robot's parameters.
        diagnosis: Of the log; None where it could not be read.
        forecasts: Of how long methods would take; none after a fatal finding.
        refusal: Why the log could not be read.
    """

    space: ParameterSpace
    diagnosis: Diagnosis | None
    forecasts: tuple[Forecast, ...] = ()
    refusal: Finding | None = None

    @property
    def fatal(self) -> bool:
        """Whether a calibration would be refused."""
        return self.diagnosis is None or self.diagnosis.fatal


def check_logs(order: CheckOrder) -> Checked:
    """Read logs of a robot of one's own and say what they can and cannot tell, with velocities put in if asked.

    A log that cannot be read is a finding too; a spec that cannot be read is refused.

    Raises:
        MadocError: The spec or its model is refused.
    """
    robot = robots.load(order.spec)
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
