"""A cell of a suite: one order, the folder named by the hash of what it asks, and the plan that lists all of them."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from madoc.errors import MadocError, unknown_name
from madoc.pipeline.orders import CalibrationOrder, EvaluationOrder, PolicyOrder, RecordOrder
from madoc.runs.files import read_bytes, replacing
from madoc.suites.options import Order, adapter, flat

Kind = Literal["record", "calibrate", "learn", "evaluate"]

KINDS: Mapping[Kind, type] = {
    "record": RecordOrder,
    "calibrate": CalibrationOrder,
    "learn": PolicyOrder,
    "evaluate": EvaluationOrder,
}
"""The order of each kind of cell."""

RECORDED = "data.npz"
"""Name of the file that a recording leaves in its cell."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A stage of a suite.

    Attributes:
        name: Hash of what it asks; its folder has this name.
        kind: What is done.
        order: The order, as `stored` writes it; paths are absolute.
        needs: Name of the cell whose result it takes; None where it takes none.
        entry: Position in the suite file of the entry it comes from, from 0.
        robot: Name of the robot whose log it takes, where an entry names several.
        wanted: Whether the file asks for it itself, and not only for what needs it.
    """

    name: str
    kind: Kind
    order: Mapping[str, Any]
    needs: str | None = None
    entry: int = 0
    robot: str = ""
    wanted: bool = True

    def read(self) -> Order:
        """The order itself."""
        return adapter(KINDS[self.kind]).validate_python(dict(self.order))

    @property
    def asks(self) -> dict[str, Any]:
        """What it asks, by the keys of a suite file; values left at their default are not among them."""
        return flat(KINDS[self.kind], self.order)

    def folder(self, suite: Path) -> Path:
        """Its run folder inside the folder of a suite."""
        return suite / "cells" / self.name


def hashed(*parts: object) -> str:
    """The name of what is asked: 16 digits that change with anything in it."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def write_plan(suite: Path, name: str, cells: Iterable[Cell]) -> None:
    """Leave the plan `plans/NAME.jsonl` in a suite's folder, a cell a line.

    Raises:
        MadocError: The folder cannot be made or written.
    """
    file = suite / "plans" / f"{name}.jsonl"
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MadocError(f"could not make the folder {file.parent}: {error.strerror or error}") from error
    with replacing(file) as stream:
        for cell in cells:
            stream.write(json.dumps(asdict(cell), ensure_ascii=False).encode() + b"\n")


def read_plans(suite: Path, name: str | None = None) -> list[Cell]:
    """The cells of the plan of this name in a suite's folder, by default of all plans; each once, in their order.

    Raises:
        MadocError: There is no plan, or none of that name, or one is damaged.
    """
    files = sorted((suite / "plans").glob("*.jsonl"))
    if not files:
        raise MadocError(f"there is no plan of a suite in {suite}; make one with: madoc suite SUITE.yaml --out {suite}")
    if name is not None:
        names = [file.stem for file in files]
        if name not in names:
            raise unknown_name(f"plan of {suite}", name, names)
        files = [file for file in files if file.stem == name]
    cells: dict[str, Cell] = {}
    for file in files:
        for number, line in enumerate(read_bytes(file).decode().splitlines(), 1):
            try:
                cell = Cell(**json.loads(line))
            except (ValueError, TypeError) as error:
                raise MadocError(f"{file}, line {number} is damaged ({error}); run madoc suite again") from error
            cells.setdefault(cell.name, cell)
    return list(cells.values())
