"""Checking a user's logs before anything is solved: read, look, forecast."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.data import Dataset, Disturbance, disturb, logs, observed_task
from madoc.data.dataset import Velocities
from madoc.data.findings import Finding
from madoc.diagnosis import Diagnosis, check, refuse_fatal
from madoc.errors import MadocError
from madoc.parameters import ParameterSpace
from madoc.pipeline.forecast import Forecast, forecast
from madoc.pipeline.keys import stage_key
from madoc.simulation import Simulator


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


def check_logs(
    spec: str | Path,
    paths: Sequence[str | Path],
    *,
    clip_actions: bool = False,
    velocities: Velocities = "logged",
    budget: int | None = 300_000,
    seed: int = 0,
) -> Checked:
    """Read logs of a robot of one's own and say what they can and cannot tell, with velocities put in if asked.

    A log that cannot be read is a finding too; a spec that cannot be is refused. Without a budget there is no forecast.

    Raises:
        MadocError: The spec or its model is refused.
    """
    robot = robots.load(spec)
    simulator = simulation.make(robot.task)
    space = simulator.parameters
    try:
        dataset = logs.read(paths, robot, clip_actions=clip_actions)
        if velocities == "differences":
            dataset = disturb(dataset, Disturbance(velocities=velocities), robot.task, stage_key(seed, "disturbing"))
            simulator = simulation.make(observed_task(robot.task, dataset))
    except MadocError as error:
        return Checked(space, None, refusal=Finding("fatal", str(error)))
    diagnosis = check(dataset, simulator, robot=robot, seed=seed)
    if diagnosis.fatal or budget is None:
        return Checked(space, diagnosis)
    return Checked(space, diagnosis, forecast(CalibrationProblem(dataset, simulator), budget=budget))


def checked(dataset: Dataset, simulator: Simulator) -> Dataset:
    """The dataset with all that checking it told, for the warnings of a result.

    Raises:
        MadocError: A finding is fatal.
    """
    source = simulator.task.source
    robot = None if source is None else robots.restore_robot(source)
    found = check(dataset, simulator, robot=robot)
    refuse_fatal(found.findings)
    return replace(dataset, findings=found.findings)
