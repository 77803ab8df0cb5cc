"""What is refused of a cell before anything starts, and what tells the contents of its files apart.

What robots and logs hold is kept, so that ten thousand cells of one robot and one log read them once.
"""

import hashlib
from functools import cache
from pathlib import Path

from madoc import robots
from madoc.data.formats import recognise
from madoc.data.logs import files_of, visible_files
from madoc.data.native import recognises as is_recorded
from madoc.errors import MadocError, about
from madoc.pipeline import refusals
from madoc.pipeline.methods import learner_of
from madoc.pipeline.orders import NO_PERMISSION, CalibrationOrder, EvaluationOrder, Permission, PolicyOrder, RecordOrder
from madoc.runs.files import read_json
from madoc.suites.cells import Kind, Order, hashed, stored
from madoc.tasks import TASKS, Task


def check_calibration(order: CalibrationOrder, *, recorded: bool, permission: Permission = NO_PERMISSION) -> None:
    """Refuse a calibration of an unknown robot, or one that its stage refuses.

    Of its data, only the existence is checked.

    Raises:
        MadocError: Names the key.
    """
    task = _robot(order.task, order.search.physics, permission)
    refusals.check_calibration(order, task)
    if not recorded:
        with about("data"):
            for path in order.source.paths:
                content_of_log(path, own=task.source is not None)


def check_policy(
    order: PolicyOrder,
    calibration: CalibrationOrder,
    recording: RecordOrder | None = None,
    *,
    permission: Permission = NO_PERMISSION,
) -> None:
    """Refuse a policy that cannot be learnt of a calibrated robot, whose calibration takes a recording or else a log.

    Raises:
        MadocError: Names the key.
    """
    search = calibration.search
    task = _robot(calibration.task, search.physics, permission)
    refusals.check_policy(order, task, written="{}:")
    refusals.truth_of(order.truth, task, search.parameters)
    truths = (order.truth, calibration.truth, recording)
    if order.at == "truth" and not any(truths) and not _may_tell_truth(calibration.source.paths):
        raise MadocError("the true parameters are not known here; add truth: FILE.json", option="at")
    _, learner = learner_of(order.method, order.set)
    for disturbance in (calibration.source.reading.disturbance, *((recording.disturbance,) if recording else ())):
        refusals.require_velocities(learner, disturbance, "the data of this cell")


def check_evaluation(
    order: EvaluationOrder, calibration: CalibrationOrder, *, permission: Permission = NO_PERMISSION
) -> None:
    """Refuse an evaluation of no episodes or draws, of a policy for a calibrated robot.

    Raises:
        MadocError: Names the key.
    """
    search = calibration.search
    refusals.check_counts(episode=order.episodes, draw=order.draws)
    refusals.check_seed(order.seed)
    refusals.truth_of(order.truth, _robot(calibration.task, search.physics, permission), search.parameters)


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
        files = files_of(place) if own else visible_files(place)
        if not files:
            raise MadocError(f"the folder {path} holds no files; name one with logs")
        return hashed([[str(file.relative_to(place)), content_of_file(str(file))] for file in files])
    if place.is_file():
        return hashed(place.name, content_of_file(path))
    if own:
        raise MadocError(f"there is no file or folder {path}; check the path")
    recognise(place)
    return path


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
    with about("task"):
        return robots.resolve(task, physics, **vars(permission))


@cache
def _may_tell_truth(paths: tuple[str, ...]) -> bool:
    """Whether a log may hold the true parameters: only a file that Madoc wrote does."""
    return any(is_recorded(Path(path)) for path in paths)
