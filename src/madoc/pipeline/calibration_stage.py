"""Calibration as a stage: the robot, the data and the problem of an order, and one method on it.

`auto` chooses the method by what the data allows.
"""

import time
import warnings
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

from madoc import simulation
from madoc.calibration import CALIBRATORS, CalibrationProblem, CalibrationResult, calibrate
from madoc.calibration.holdout import Fitted
from madoc.data import Dataset, observed_task
from madoc.data.dataset import hold_out
from madoc.diagnosis import check, refuse_fatal
from madoc.pipeline.data_stage import Machine, fingerprint, load_source
from madoc.pipeline.methods import choose, hyperparameters, methods_for
from madoc.pipeline.orders import AUTO, NO_PERMISSION, CalibrationOrder, Permission
from madoc.pipeline.refusals import check_calibration, check_folder, seed_key, stage_key, truth_of
from madoc.report.records import DataRecord, stored_path
from madoc.runs.budget import Budget, Seconds, read_budget
from madoc.runs.progress import waiting
from madoc.runs.run_folder import ENDED, working_folder
from madoc.simulation import Simulator
from madoc.tasks import Task
from madoc.verdict import Bench, assess
from madoc.verdict.evidence import evidence, save_evidence

HOLDOUT = 0.2
"""Share of the rows that `auto` holds out by default, as in five-fold cross-validation."""


@dataclass(frozen=True)
class Prepared:
    """An order with its defaults resolved, its data and its robot.

    Attributes:
        order: What was asked.
        method: Name of the calibrator; `auto` until one is chosen.
        budget: A count of control steps, or a time; None for `auto` until a method is chosen, if the order has none.
        holdout: Share of the rows that no method sees; None where nothing is judged.
        machine: The robot with all of its parameters at their normal ranges.
        dataset: All rows.
        simulator: Simulator of the parameters, ranges and physics that the order names.
        truth: True values by name, from the order or else from the data.
    """

    order: CalibrationOrder
    method: str
    budget: Budget | None
    holdout: float | None
    machine: Machine
    dataset: Dataset
    simulator: Simulator
    truth: dict[str, float] | None

    def by(self, method: str) -> "Prepared":
        """The same for the method of this name, with the budget it usually has where the order has none."""
        budget = read_budget(CALIBRATORS[method].usual_budget) if self.budget is None else self.budget
        return replace(self, method=method, budget=budget)

    @property
    def seed(self) -> int:
        """The seed of all randomness."""
        return self.order.search.seed

    @cached_property
    def bench(self) -> Bench:
        """What results are judged on."""
        split = hold_out(self.dataset, self.holdout or HOLDOUT, stage_key(self.seed, "hold-out"))
        problem = CalibrationProblem(split.kept, self.simulator)
        return Bench(problem, split.held, stage_key(self.seed, "verdict"), split.sentence)

    @cached_property
    def problem(self) -> CalibrationProblem:
        """What methods are given: all rows but those that are held out."""
        return CalibrationProblem(self.dataset, self.simulator) if self.holdout is None else self.bench.problem

    @property
    def calibrated_truth(self) -> dict[str, float] | None:
        """The true values of the calibrated parameters."""
        names = self.simulator.parameters.names
        return None if self.truth is None else {name: self.truth[name] for name in names}

    def spec(self, out: Path) -> dict[str, object]:
        """What the `spec.json` of the run folder `out` keeps; `SpecRecord` reads it."""
        search, source, task = self.order.search, self.order.source, self.simulator.task
        files = {path: Path(path).expanduser() for path in source.paths}
        data = DataRecord(
            paths=tuple(stored_path(file, out) if file.exists() else path for path, file in files.items()),
            format=source.reading.format,
            clip_actions=source.reading.clip_actions,
            max_transitions=source.max_transitions,
            disturbance=source.reading.disturbance,
            rows=len(self.dataset),
            fingerprint=fingerprint(self.dataset),
        )
        held = {} if self.holdout is None else {"holdout": self.holdout}
        asked = {
            "command": "calibrate",
            "task": task.name,
            "physics": task.physics,
            "level": search.level,
            "parameters": {row.name: [row.low, row.high] for row in task.parameters.parameters},
            "method": self.method,
            "data": asdict(data),
            "seed": self.seed,
            "budget": str(self.budget) if isinstance(self.budget, Seconds) else self.budget,
            "truth": self.truth,
        }
        return asked | held | self.machine.stored()


def prepare(order: CalibrationOrder, *, permission: Permission = NO_PERMISSION) -> Prepared:
    """Read the robot and the data of an order, and check the logs of a user's own robot.

    Raises:
        MadocError: The robot, the data or the truth is refused, or the check finds the data to be useless.
    """
    machine, dataset, task = _read(order, permission=permission)
    budget = None if order.search.budget is None else read_budget(order.search.budget)
    holdout = HOLDOUT if order.method == AUTO and order.holdout is None else order.holdout
    truth = truth_of(order.truth, machine.task, task.parameters.names, known=dataset.true_parameters)
    simulator = simulation.make(task)
    if machine.robot is not None:
        diagnosis = check(dataset, simulator, robot=machine.robot, intervals=False)
        refuse_fatal(diagnosis.findings)
        dataset = replace(dataset, findings=diagnosis.findings)
    return Prepared(order, order.method, budget, holdout, machine, dataset, simulator, truth)


def _read(order: CalibrationOrder, *, permission: Permission) -> tuple[Machine, Dataset, Task]:
    """The robot, its data, and the task with the parameters and ranges that are calibrated."""
    search = order.search
    machine = Machine.named(order.task, search.physics, permission=permission)
    check_calibration(order, machine.task)
    dataset = load_source(order.source, machine, seed=search.seed)
    recorded = dataset.physics if dataset.physics != "unknown" else None
    machine = machine.in_physics(search.physics or recorded or "legacy")
    task = observed_task(machine.task.with_level(search.level), dataset)
    if recorded is not None and recorded != task.physics:
        warnings.warn(
            f"{', '.join(order.source.paths)} was recorded in {recorded} physics and is calibrated in {task.physics}: "
            "the estimate will make up for the difference; leave out --physics to take the data's",
            stacklevel=2,
        )
    return machine, dataset, task.with_parameters(list(search.parameters)) if search.parameters else task


def calibrate_in(
    out: str | Path,
    order: CalibrationOrder,
    *,
    resume: bool = False,
    quiet: bool = False,
    permission: Permission = NO_PERMISSION,
) -> CalibrationResult:
    """Calibrate, judge the result where rows are held out, and leave a run folder.

    Raises:
        MadocError: The order cannot be carried out; a new folder is then not left behind.
    """
    out, began = Path(out), time.monotonic()
    check_folder(out, order.source)
    prepared = prepare(order, permission=permission)
    methods = methods_for(order.method, order.search.set)
    key = seed_key(prepared.seed)
    name, why = choose(methods, prepared.problem, key)
    prepared, method = prepared.by(name), methods[name]
    judged_by, budget = None, prepared.budget
    if prepared.holdout is not None and isinstance(budget, Seconds):
        if order.search.budget is None:  # the usual time is that of a search
            judged_by = began + budget.with_judging.seconds
        else:
            judged_by, budget = began + budget.until_judged.seconds, budget.for_search(time.monotonic() - began)
    spec = prepared.spec(out) | {"hyperparameters": hyperparameters(method)}
    with working_folder(out, spec, resume=resume) as folder:
        result = calibrate(
            method,
            prepared.problem,
            key=key,
            budget=budget,
            truth=prepared.calibrated_truth,
            folder=folder,
            resume=resume,
            quiet=quiet,
        )
        result = replace(result, chosen=why)
        if prepared.holdout is not None and result.status in ENDED:
            rate = result.control_steps / max(result.seconds, 1e-3)
            with waiting("judging the estimate on the rows held out", quiet=quiet) as tell:
                bench = replace(prepared.bench, until=judged_by, rate=max(rate, 1.0), tell=tell)
                result = assess(result, bench).result
                tell("whole runs")
                fits_starts, step = isinstance(result.holdout, Fitted), prepared.simulator.control_step
                arrays = evidence(bench, result.mean, control_step=step, fits_starts=fits_starts)
            save_evidence(out / "evidence.npz", arrays)
        folder.write_json("result.json", result.to_json())
        return result


def default_folder(order: CalibrationOrder) -> Path:
    """The run folder of an order that names none: `runs/TASK-METHOD-SEED`."""
    return Path("runs") / f"{Path(order.task).stem}-{order.method}-{order.search.seed}"
