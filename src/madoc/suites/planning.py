"""A suite file planned into cells: every order built and checked before anything starts."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from madoc.errors import MadocError, nearest_hint
from madoc.pipeline.data_stage import check_recording
from madoc.pipeline.orders import NO_PERMISSION, CalibrationOrder, EvaluationOrder, Permission, PolicyOrder, RecordOrder
from madoc.robots.document import Document
from madoc.suites import checks
from madoc.suites.cells import RECORDED, Asked, Cell, Kind, Order, build, keys_of, stored
from madoc.suites.grid import GRID, ROBOTS, Combination, combinations, read_suite
from madoc.tasks import TASKS

PARTS: Mapping[str, str] = {"record": "name", "learn": "method", "evaluate": "episodes"}
"""Parts of an entry that are orders of their own, and the key that a bare value of each stands for."""


@dataclass(frozen=True)
class Plan:
    """A suite file, planned: its name, and its cells so that each comes after what it needs."""

    name: str
    file: Path
    cells: tuple[Cell, ...]


def plan_of(file: Path, *, permission: Permission = NO_PERMISSION) -> Plan:
    """Read a suite file, and plan all that it asks; `permission` is what specs of robots may ask for.

    Raises:
        MadocError: It has a mistake, or asks for the same thing twice; the sentence names the line.
    """
    suite, document = read_suite(file)
    planner = _Planner(document, file.resolve().parent, permission=permission)
    for combination in combinations(suite, document, planner.folder):
        planner.add(combination)
    return Plan(file.stem, file, tuple(planner.cells.values()))


class _Planner:
    """The cells so far, and the line at which each was asked for."""

    def __init__(self, document: Document, folder: Path, *, permission: Permission) -> None:
        self.document, self.folder, self.permission = document, folder, permission
        self.cells: dict[str, Cell] = {}
        self._lines: dict[str, int] = {}

    def add(self, asked: Combination) -> None:
        """Add the cells of a combination: a recording, a calibration, a policy and its evaluation, as far as asked."""
        given = dict(asked.given)
        parts = {name: given.pop(name) for name in PARTS if name in given}
        try:
            last = self._calibration(given, parts.pop("record", None), asked)
            if parts:
                last = self._policy(parts, last, asked)
        except MadocError as error:
            if error.option is None:
                raise
            place = asked.places.get(error.option, asked.places[""])
            raise self.document.error(place, str(error)) from error
        self._want(last, asked)

    def _want(self, cell: Cell, asked: Combination) -> None:
        """Note that the file asks for a cell itself; the same cell twice is refused."""
        line = self.document.line(asked.places[""])
        if cell.name in self._lines:
            what = "within this entry" if self._lines[cell.name] == line else f"on line {self._lines[cell.name]}"
            which = f"; the logs of {cell.robot} and {asked.robot} are equal" if cell.robot and asked.robot else ""
            sentence = f"two cells ask for exactly the same: this one and one {what}{which}"
            raise self.document.error(asked.places[""], sentence)
        self._lines[cell.name] = line
        self.cells[cell.name] = replace(cell, wanted=True)

    def _calibration(self, given: dict[str, Any], record: object, asked: Combination) -> Cell:
        """The calibration of a combination, and the recording that it needs."""
        needs = None
        if record is not None:
            if "data" in given:
                raise MadocError("record: and data: both name the data; keep one", option="record")
            recording = self._part(RecordOrder, "record", record, asked)
            with self._inside("record", asked):
                check_recording(recording)
            needs = self._put("record", recording, None, asked).name
            robot = recording.name.partition("-")[0]
            if given.get("task", robot) != robot:
                sentence = f"{recording.name} is a recording of {robot}, and task: another; leave it out"
                raise MadocError(sentence, option="record")
            given |= {"data": [f"{needs}/{RECORDED}"], "task": robot}
        known = [*keys_of(CalibrationOrder), *PARTS, ROBOTS, GRID]
        if unknown := next((key for key in given if key not in known), None):
            raise MadocError(f"unknown key {unknown!r}; {nearest_hint(unknown, known)}", option=unknown)
        order = build(CalibrationOrder, self._located(given, recorded=needs is not None))
        checks.check_calibration(order, recorded=needs is not None, permission=self.permission)
        return self._put("calibrate", order, needs, asked)

    def _policy(self, parts: Mapping[str, object], calibration: Cell, asked: Combination) -> Cell:
        """The policy of a combination, and its evaluation if that is asked for too."""
        if "learn" not in parts:
            sentence = "evaluate: belongs to learn:, and there is no policy to evaluate; add one"
            raise MadocError(sentence, option="evaluate")
        calibrating = calibration.read()
        assert isinstance(calibrating, CalibrationOrder)
        seed = calibrating.search.seed
        order = self._part(PolicyOrder, "learn", parts["learn"], asked, seed=seed)
        with self._inside("learn", asked):
            recording = self.cells[calibration.needs].read() if calibration.needs else None
            assert recording is None or isinstance(recording, RecordOrder)
            checks.check_policy(order, calibrating, recording, permission=self.permission)
        policy = self._put("learn", order, calibration.name, asked)
        if "evaluate" not in parts:
            return policy
        evaluation = self._part(EvaluationOrder, "evaluate", parts["evaluate"], asked)
        with self._inside("evaluate", asked):
            checks.check_evaluation(evaluation, calibrating, permission=self.permission)
        return self._put("evaluate", evaluation, policy.name, asked)

    def _put(self, kind: Kind, order: Order, needs: str | None, asked: Combination) -> Cell:
        """The cell of an order, the same for all combinations that ask for the same."""
        name = checks.name_of(kind, order, needs, permission=self.permission)
        cell = Cell(name, kind, stored(order), needs, asked.entry, asked.robot, wanted=False)
        return self.cells.setdefault(name, cell)

    def _part(self, kind: type[Asked], name: str, value: object, asked: Combination, **default: object) -> Asked:
        """The order of a part of an entry: keys and values, or the one value that matters most."""
        keys = dict(value) if isinstance(value, dict) else {PARTS[name]: value}
        with self._inside(name, asked):
            return build(kind, self._located({**default, **keys}))

    @contextmanager
    def _inside(self, name: str, asked: Combination) -> Iterator[None]:
        """Give refusals in the block the line of their key inside a part of the entry, as `learn:`."""
        try:
            yield
        except MadocError as error:
            raise self.document.error((*asked.places[name], error.option or ""), str(error)) from error

    def _located(self, given: Mapping[str, Any], *, recorded: bool = False) -> dict[str, Any]:
        """Values with the paths among them made absolute: they are relative to the suite file."""
        located = dict(given)
        if isinstance(located.get("truth"), str):
            located["truth"] = self._absolute(located["truth"])
        if isinstance(task := located.get("task"), str) and task not in TASKS and _located(self.folder, task):
            located["task"] = self._absolute(task)
        if not recorded and "data" in located:
            paths = [located["data"]] if isinstance(located["data"], str) else located["data"]
            if isinstance(paths, list):
                located["data"] = [
                    _located(self.folder, path) or path if path and isinstance(path, str) else path for path in paths
                ]
        return located

    def _absolute(self, path: str) -> str:
        return _located(self.folder, path) or str(self.folder / path)


@lru_cache(maxsize=100_000)
def _located(folder: Path, path: str) -> str | None:
    """The absolute path of a file or folder that is named relative to another; None where there is none."""
    place = folder / Path(path).expanduser()
    return str(place.resolve()) if place.exists() else None
