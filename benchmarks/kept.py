"""What was measured, as tables: one line of JSON a cell, appended by the runners and read by the tables.

A row says what was asked, what came out, and where: commit, versions and machine. Rows are appended under a lock, so
several processes may run the same command at once; a line that a killed process left unfinished is taken away. A cell
that was run again has another row below, and the last one counts. Rows with a key `gone` are of a method that is no
longer there: they stay, and no table shows them.
"""

import argparse
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

RESULTS = Path(__file__).parent / "results"
CLAIMS = Path(tempfile.gettempdir()) / "madoc-claims"
"""Locks of the cells that processes of this machine are running."""
VERSIONED = ("mujoco", "jax", "numpy", "scipy", "equinox", "optax")
"""Packages whose versions a row tells, beside Python's."""


@dataclass(frozen=True)
class Study:
    """A table of cells.

    Attributes:
        file: Lines of JSON, a row each.
        key: Names of the values that tell one cell from another; a row without one is as one with null.
    """

    file: Path
    key: tuple[str, ...]

    def every(self) -> list[dict[str, Any]]:
        """Every row in the order in which they were appended, those of methods that are gone included."""
        if not self.file.exists():
            return []
        whole = self.file.read_text(encoding="utf-8").rpartition("\n")[0]
        return [json.loads(line) for line in whole.splitlines()]

    def rows(self) -> list[dict[str, Any]]:
        """The last row of every cell whose method is still there, in the order of the file."""
        return list({self.cell_of(row): row for row in self.every() if "gone" not in row}.values())

    def cell_of(self, row: Mapping[str, Any]) -> str:
        """What a row was asked, as one text."""
        return json.dumps([row.get(name) for name in self.key], ensure_ascii=False)

    def has(self, asked: Mapping[str, Any], commit: str | None = None) -> bool:
        """Whether a cell has a row, at a commit where one is given."""
        cell = self.cell_of(asked)
        return any(self.cell_of(row) == cell and commit in (None, row.get("commit")) for row in self.rows())

    def add(self, row: Mapping[str, Any]) -> None:
        """Append a row with its commit, versions and machine; the file has whole lines only, whoever else appends."""
        line = json.dumps(stamp() | dict(row), ensure_ascii=False, separators=(",", ":")) + "\n"
        self.file.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{self.file}.lock"), self.file.open("ab+") as stream:
            stream.seek(0)
            stream.truncate(stream.read().rfind(b"\n") + 1)
            stream.write(line.encode())
            stream.flush()
            os.fsync(stream.fileno())

    @contextmanager
    def claimed(self, asked: Mapping[str, Any], commit: str | None = None) -> Iterator[bool]:
        """Whether a cell is this process's to run: it has no row (at the commit), and no other process is at it."""
        digest = hashlib.sha256(f"{self.file.resolve()} {self.cell_of(asked)}".encode()).hexdigest()
        CLAIMS.mkdir(parents=True, exist_ok=True)
        lock = FileLock(CLAIMS / f"{digest[:32]}.lock")
        try:
            lock.acquire(blocking=False)
        except Timeout:
            yield False
            return
        try:
            yield not self.has(asked, commit)
        finally:
            lock.release()


CALIBRATIONS = Study(
    RESULTS / "calibration.jsonl",
    (
        *("robot", "quality", "data", "transitions", "level", "calibrated"),
        *("method", "set", "log", "seed", "budget"),
    ),
)
"""Calibrations of the paper's robots, by `calibration.py`, and those of the suites that `paper.py --collect` keeps."""
POLICIES = Study(RESULTS / "policies.jsonl", ("robot", "method", "at", "calibrator", "budget", "set", "seed"))
"""Policies that were learnt and evaluated, by `policies.py`."""
SYSID = Study(RESULTS / "sysid.jsonl", ("robot", "situation", "seed"))
"""Both tools on the same logs, by `against_sysid.py`."""


def run_seeds(
    study: Study,
    solve: Callable[[int], dict[str, Any]],
    table: Callable[[list[dict[str, Any]]], str],
    *,
    description: str | None,
) -> None:
    """The command line of a study whose cells are seeds: run those that have no row, and print the table of all."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--results", type=Path, default=study.file)
    parser.add_argument("--table", action="store_true", help="print the summary of what is there, and run nothing")
    arguments = parser.parse_args()
    study = replace(study, file=arguments.results)
    for seed in arguments.seeds if not arguments.table else ():
        with study.claimed({"seed": seed}) as ours:
            if ours:
                study.add(solve(seed))
    print(table(study.rows()))


def commits(rows: Iterable[Mapping[str, Any]]) -> str:
    """At which commits rows were measured; of several, that they are mixed."""
    found = sorted({row["commit"] for row in rows})
    return ("mixed: " if len(found) > 1 else "") + ", ".join(found)


def is_time(budget: int | str) -> bool:
    """Whether a budget is a time, as "60s"."""
    return isinstance(budget, str)


def stamp() -> dict[str, Any]:
    """Where a row is measured: the commit, the versions and the machine, in words that name no host and no path."""
    versions = {"python": platform.python_version()}
    versions |= {name: importlib.metadata.version(name) for name in VERSIONED}
    return {"commit": commit(), "versions": versions, "machine": machine()}


def machine() -> str:
    """Number of cores and the kind of processor."""
    cores, kind = os.cpu_count() or 1, platform.processor() or platform.machine()
    about = Path("/proc/cpuinfo")
    if about.exists():
        named = (line.partition(":")[2].strip() for line in about.read_text().splitlines() if "model name" in line)
        kind = next(named, kind)
    return f"{cores} core{'s' * (cores > 1)}, {kind}"


def commit() -> str:
    """The commit of the checkout that Python imports the tool from; `+` marks changes to its sources."""
    found = importlib.util.find_spec("madoc")
    assert found is not None and found.origin is not None
    source = Path(found.origin).parent

    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", source, *words], capture_output=True, text=True, check=True).stdout.strip()

    runners = str(Path(__file__).parent / "*.py")
    places = [".", *([runners] if source.parents[1] == Path(__file__).parents[1] else [])]
    return git("rev-parse", "--short", "HEAD") + "+" * bool(git("status", "--porcelain", "-uno", "--", *places))
