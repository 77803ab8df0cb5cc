"""What is refused of a cell before anything starts, and what tells the contents of its files apart.

Each answer is kept, so that ten thousand cells of one robot and one method cost one check.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

from madoc import robots
from madoc.calibration import CALIBRATORS
from madoc.errors import MadocError, unknown_name
from madoc.pipeline import refusals
from madoc.pipeline.methods import candidates_for, learner_of, make_method
from madoc.pipeline.orders import (
    AUTO,
    NO_PERMISSION,
    CalibrationOrder,
    Drawing,
    EvaluationOrder,
    Permission,
    PolicyOrder,
    RecordOrder,
    Search,
    Settings,
    parse_settings,
)
from madoc.policies import require_reward
from madoc.runs.files import read_json
from madoc.suites.cells import Kind, Misfit, Order, hashed, stored
from madoc.tasks import TASKS, Task


@contextmanager
def under(key: str) -> Iterator[None]:
    """Say under which key of the file a refusal inside the block belongs."""
    try:
        yield
    except Misfit:
        raise
    except MadocError as error:
        raise Misfit(key, str(error)) from error


def check_calibration(order: CalibrationOrder, *, recorded: bool, permission: Permission = NO_PERMISSION) -> None:
    """Refuse a calibration of an unknown robot, by an unknown method, or with impossible numbers.

    Of its data, only the existence is checked.

    Raises:
        Misfit: Names the key.
    """
    search = order.search
    with under("task"):
        task = _robot(order.task, search.physics, permission)
    with under("level" if search.parameters is None else "parameters"):
        _ranges(order.task, search.physics, search.parameters, search.level, permission)
    method = refusals.method_of(order)
    with under("method"):
        _calibrator(method, ())
    with under("set"):
        _calibrator(method, search.set)
    with under("seed"):
        refusals.check_seed(search.seed)
    with under("holdout" if order.holdout is not None and not 0 < order.holdout < 1 else "budget"):
        refusals.check_order(order)
    with under("format"):
        _check_format(order.source.reading.format)
    with under("max_transitions"):
        rows = order.source.max_transitions
        if rows is not None and rows < 1:
            raise MadocError(f"expected at least 1 transition to keep, got {rows}")
    if not recorded:
        with under("data"):
            for path in order.source.paths:
                content_of_log(path, own=task.source is not None)
    _check_truth(order.truth, order, permission)


def check_policy(
    order: PolicyOrder,
    calibration: CalibrationOrder,
    recording: RecordOrder | None = None,
    *,
    permission: Permission = NO_PERMISSION,
) -> None:
    """Refuse a policy that cannot be learnt of a calibrated robot, whose calibration takes a recording or else a log.

    Raises:
        Misfit: Names the key.
    """
    task = _robot(calibration.task, calibration.search.physics, permission)
    with under("method"):
        _learner(order.method, ())
    with under("set"):
        learner = _learner(order.method, order.set)
    with under("budget"):
        refusals.policy_budget(learner, order.budget)
    with under("at"):
        refusals.check_place(learner, order.at, f"at: {order.at}")
        truths = (order.truth, calibration.truth, recording)
        if order.at == "truth" and not any(truths) and not _may_tell_truth(calibration.source.paths):
            raise MadocError("the true parameters are not known here; add truth: FILE.json")
    with under("share" if order.drawing.share != Drawing().share else "width"):
        refusals.check_drawing(order.drawing, order.at, "share: and width: are of at: distribution")
    with under(""):
        require_reward(task)
    with under("method"):
        refusals.require_no_goals(task, learner)
        for disturbance in (calibration.source.reading.disturbance, *((recording.disturbance,) if recording else ())):
            refusals.require_velocities(learner, disturbance, "the data of this cell")
    with under("seed"):
        refusals.check_seed(order.seed)
    _check_truth(order.truth, calibration, permission)


def check_recording(order: RecordOrder) -> None:
    """Refuse a recording of an unknown robot or quality, or of no rows.

    Raises:
        Misfit: Names the key.
    """
    from madoc.pipeline.data_stage import split_name  # reads data formats, which only recordings need

    with under("name"):
        if not split_name(order.name)[1]:
            raise MadocError(f"expected TASK-QUALITY to record, as hopper-medium, got {order.name!r}")
    with under("transitions"):
        refusals.check_counts(transition=order.transitions)
    with under("friction"):
        replace(order.disturbance, friction=order.friction)
    with under("seed"):
        refusals.check_seed(order.seed)


def check_evaluation(
    order: EvaluationOrder, calibration: CalibrationOrder, *, permission: Permission = NO_PERMISSION
) -> None:
    """Refuse an evaluation of no episodes or draws, of a policy for a calibrated robot.

    Raises:
        Misfit: Names the key.
    """
    with under("episodes"):
        refusals.check_counts(episode=order.episodes)
    with under("draws"):
        refusals.check_counts(draw=order.draws)
    with under("seed"):
        refusals.check_seed(order.seed)
    _check_truth(order.truth, calibration, permission)


def _check_truth(truth: Path | None, calibration: CalibrationOrder, permission: Permission) -> None:
    """Refuse a file of true parameters that cannot be read, or does not fit what is calibrated."""
    if truth is not None:
        search = calibration.search
        with under("truth"):
            _truth(truth, calibration.task, search.physics, search.parameters, permission)


def name_of(kind: Kind, order: Order, needs: str | None, *, permission: Permission = NO_PERMISSION) -> str:
    """The name of the cell of an order: a hash of what that asks, and of the content of the files that it names.

    Raises:
        MadocError: A file cannot be read.
        NotAllowed: A spec asks for what is not allowed.
    """
    told = stored(order)
    if isinstance(order, CalibrationOrder):
        told["task"] = content_of_robot(order.task, permission=permission)
        own = order.task not in TASKS
        logs = [needs] if needs else [content_of_log(path, own=own) for path in order.source.paths]
        told["source"] = {key: value for key, value in told["source"].items() if key != "paths"} | {"logs": logs}
    truth = getattr(order, "truth", None)
    if truth is not None:
        told["truth"] = content_of_file(str(truth))
    return hashed(kind, told, needs)


def forget_contents() -> None:
    """Read the files that cells name anew from here on, as they may have changed."""
    for content in (content_of_robot, content_of_log, content_of_file):
        content.cache_clear()


@cache
def content_of_robot(task: str, *, permission: Permission = NO_PERMISSION) -> str:
    """What a robot is: the name of one of Madoc's, or the content of a spec file and of what it names."""
    return task if task in TASKS else hashed(dict(robots.load(task, **vars(permission)).task.source or {}))


@cache
def content_of_log(path: str, *, own: bool) -> str:
    """The content of a file or folder of logs; the id itself of a Minari dataset on this machine.

    Raises:
        MadocError: There is no such log.
    """
    place = Path(path)
    if place.is_dir():
        files = _files_of(place, own=own)
        if not files:
            raise MadocError(f"the folder {path} holds no files; name one with logs")
        return hashed([[str(file.relative_to(place)), content_of_file(str(file))] for file in files])
    if place.is_file():
        return hashed(place.name, content_of_file(path))
    if own:
        raise MadocError(f"there is no file or folder {path}; check the path")
    from madoc.data.formats import recognise  # reads data formats, which only ids need

    recognise(place)
    return path


def _files_of(folder: Path, *, own: bool) -> list[Path]:
    """The files of a folder of logs that count: no hidden ones, and of a user's own robot those that are read."""
    if own:
        from madoc.data.logs import files_of  # reads data formats, which only folders need

        return files_of(folder)
    visible = (file for file in folder.rglob("*") if not any(p.startswith(".") for p in file.relative_to(folder).parts))
    return sorted(file for file in visible if file.is_file())


@cache
def content_of_file(path: str) -> str:
    """A checksum of a file; one that should be JSON is read as such.

    Raises:
        MadocError: It cannot be read.
    """
    if path.endswith(".json"):
        return hashed(read_json(Path(path)))
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
    except OSError as error:
        raise MadocError(f"could not read {path}: {error.strerror or error}") from error


@cache
def _robot(task: str, physics: str | None, permission: Permission) -> Task:
    return robots.resolve(task, physics, **vars(permission))


@cache
def _ranges(
    task: str, physics: str | None, parameters: tuple[str, ...] | None, level: str, permission: Permission
) -> None:
    refusals.check_search(
        Search(parameters=parameters, level=level), _robot(task, physics, permission), Path(task).name
    )


@cache
def _truth(
    file: Path, task: str, physics: str | None, parameters: tuple[str, ...] | None, permission: Permission
) -> None:
    from madoc.pipeline.data_stage import Machine, read_truth

    robot = _robot(task, physics, permission)
    values = read_truth(file) or {}
    Machine(robot).check_truth(values, robot.with_parameters(list(parameters or robot.parameters.names)))


@cache
def _check_format(name: str | None) -> None:
    if name is None:
        return
    from madoc.data.formats import FORMATS

    if name not in FORMATS:
        raise unknown_name("format", name, FORMATS)


@cache
def _may_tell_truth(paths: tuple[str, ...]) -> bool:
    """Whether a log may hold the true parameters: only a file that Madoc wrote does."""
    from madoc.data.native import recognises

    return any(recognises(Path(path)) for path in paths)


@cache
def _calibrator(method: str, settings: Settings) -> None:
    changes = parse_settings(settings)
    if method == AUTO:
        candidates_for(changes)
    else:
        make_method(CALIBRATORS, method, changes)


@cache
def _learner(method: str, settings: Settings) -> str:
    """The name of what a learner is with its settings."""
    return learner_of(method, settings)[1].name
