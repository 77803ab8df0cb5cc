"""The folder of one run: its settings, its logs and its checkpoint, written by one process at a time."""

import os
import platform
import shutil
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import filelock
import numpy as np

from madoc.errors import MadocError
from madoc.runs.files import json_text, read_json, remove_leftovers, write_json
from madoc.runs.machine import versions
from madoc.types import Metrics, Unit

ENDED = ("finished", "converged")
"""The statuses of a run after which the next one may start."""

_FREE = ("budget", "versions")
"""Keys of a spec that may differ when a run is resumed."""


class RunFolder:
    """A locked run folder; as a context manager it unlocks the folder at the end.

    It holds `spec.json` (the settings and versions), `metrics.jsonl` (one line for each epoch), `tensorboard/`,
    `checkpoint.npz` (the last good state), `result.json` (how the run ended; missing until then), `memory.json` (the
    most memory held, where the system tells) and `diverged.npz` (the last state, if it held a NaN); of a learner also
    `policy.npz`. All files but the
    logs, which grow, are written whole or not at all.

    Call `create` or `open` to make one.
    """

    def __init__(self, path: Path, spec: Mapping[str, object], lock: filelock.BaseFileLock) -> None:
        self.path, self.spec, self._lock = path, spec, lock
        self.checkpoint, self.diverged = path / "checkpoint.npz", path / "diverged.npz"
        self.result, self.policy = path / "result.json", path / "policy.npz"

    @classmethod
    def create(cls, path: str | Path, spec: Mapping[str, object]) -> "RunFolder":
        """Make the folder of a new run, and write its spec: the run's settings as JSON, and the versions.

        Raises:
            MadocError: The folder already holds a run, is locked, or cannot be written.
        """
        path = Path(path).expanduser()
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = "a file has that name" if path.is_file() else error.strerror or str(error)
            raise MadocError(f"could not make the folder {path}: {reason}; take another --out") from error
        with ExitStack() as on_refusal:
            lock = _lock(path)
            on_refusal.callback(lock.release)
            if (path / "spec.json").exists():
                raise MadocError(f"{path} already holds a run; pass --resume to go on or choose another --out")
            folder = cls(path, {**spec, "versions": versions()}, lock)
            folder.write_json("spec.json", folder.spec)
            on_refusal.pop_all()
        return folder

    @classmethod
    def open(cls, path: str | Path, spec: Mapping[str, object] | None = None) -> "RunFolder":
        """Lock the folder of an earlier run, to resume it or to add to it.

        Raises:
            MadocError: The folder is missing, holds no run, or is locked; or a spec is given that differs from that
                of the run in more than the budget.
        """
        path = Path(path).expanduser()
        if not (path / "spec.json").exists():
            what = "holds no run" if path.is_dir() else "does not exist"
            raise MadocError(f"cannot resume: the folder {path} {what}; check the path, or leave out --resume")
        with ExitStack() as on_refusal:
            lock = _lock(path)
            on_refusal.callback(lock.release)
            folder = cls(path, read_json(path / "spec.json"), lock)
            if spec is not None:
                folder._agree_on(spec)
            on_refusal.pop_all()
        return folder

    def __enter__(self) -> "RunFolder":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Unlock the folder."""
        self._lock.release()

    def write_json(self, name: str, value: object) -> None:
        """Write a JSON file of this folder, whole or not at all."""
        write_json(self.path / name, value)

    def log(self, offset: int, spent: int, *, unit: Unit = "control steps") -> "RunLog":
        """The logs, cut back to a checkpoint's `offset` in bytes and count `spent`; both are 0 for a new run."""
        return RunLog(self.path, offset, spent, unit)

    def _agree_on(self, spec: Mapping[str, object]) -> None:
        """Refuse other settings, warn of other versions, and adopt a new budget."""
        before, now = (_flat({key: asked[key] for key in asked if key not in _FREE}) for asked in (self.spec, spec))
        for key in [*before, *now]:
            if before.get(key) != now.get(key):
                was, is_now = (_shortened(asked.get(key, "not given")) for asked in (before, now))
                raise MadocError(
                    f"cannot resume {self.path}: {key} was {was}, is now {is_now}; "
                    "resume with the same settings or choose another --out"
                )
        recorded = self.spec.get("versions")
        then = recorded if isinstance(recorded, dict) else {}
        differing = {name: version for name, version in versions().items() if then.get(name) != version}
        changed = [f"{name} {then.get(name)} (now {version})" for name, version in differing.items()]
        if changed:
            warnings.warn(
                f"{self.path} was started with {', '.join(changed)}; the result may differ in its last bits",
                stacklevel=3,
            )
        if "budget" in spec and spec["budget"] != self.spec.get("budget"):
            self.spec = {**self.spec, "budget": spec["budget"]}
            self.write_json("spec.json", self.spec)


@contextmanager
def working_folder(
    path: Path, spec: dict[str, object], *, resume: bool, keep: str = "checkpoint.npz"
) -> Iterator[RunFolder]:
    """The locked folder of a run with these settings: a new one, or with `resume` that of an earlier run.

    A new folder is deleted if the run is refused before it has the file `keep`, the first worth keeping.

    Raises:
        MadocError: As `RunFolder.create` and `RunFolder.open`.
    """
    path = path.expanduser()
    made = not path.exists()
    folder = RunFolder.open(path, spec) if resume else RunFolder.create(path, spec)
    try:
        with folder:
            yield folder
    except MadocError:
        if not resume and not (path / keep).exists():
            (path / "spec.json").unlink(missing_ok=True)
            if made:
                shutil.rmtree(path, ignore_errors=True)
        raise


def holds_run(path: Path) -> bool:
    """Whether a run has been started in a folder."""
    return (path / "spec.json").exists()


def ended(path: Path, also: str | None = None) -> bool:
    """Whether the run in a folder has ended, and the file `also` is there as well."""
    if not (path / "result.json").exists() or (also is not None and not (path / also).exists()):
        return False
    return read_json(path / "result.json").get("status") in ENDED


class RunLog:
    """The logs of a run, `metrics.jsonl` and TensorBoard events; as a context manager it closes them.

    Call `RunFolder.log` to open them.
    """

    def __init__(self, path: Path, offset: int, spent: int, unit: Unit) -> None:
        # Slow to import, and only runs with a folder need it. Its SummaryWriter would leave the writing to a thread,
        # and wait for that for ever where the disk is full.
        from tensorboardX.proto.event_pb2 import SessionLog
        from tensorboardX.record_writer import RecordWriter
        from tensorboardX.summary import scalar

        self._count = count_name(unit)
        self._lines = _cut(path / "metrics.jsonl", offset).open("ab")
        events = path / "tensorboard"
        events.mkdir(exist_ok=True)
        number = len(list(events.iterdir()))  # two writers in one second would overwrite the same file
        name = f"events.out.tfevents.{time.time():.0f}.{platform.node()}.{number}"
        self._events, self._scalar = RecordWriter(str(events / name)), scalar
        self._add_event(0, file_version="brain.Event:2")
        self._add_event(spent + 1, session_log=SessionLog(status=SessionLog.START))  # hides what was further

    def __enter__(self) -> "RunLog":
        return self

    def __exit__(self, *exception: object) -> None:
        with closing(self._events), self._lines:  # both, even if one has no room for what it holds
            pass

    def append(self, metrics: Metrics, *, stage: str, spent: int, seconds: float) -> None:
        """Add one epoch. A NaN or infinite metric is logged as null."""
        finite = {name: value if np.isfinite(value) else None for name, value in metrics.items()}
        line = {self._count: spent, "seconds": round(seconds, 3), "stage": stage, "metrics": finite}
        self._lines.write(json_text(line, what="metrics.jsonl").encode() + b"\n")
        self._lines.flush()
        for name, value in finite.items():
            if value is not None:
                self._add_event(spent, summary=self._scalar(f"{stage}/{name}", value))

    def _add_event(self, step: int, **content: object) -> None:
        """Add an event to those of TensorBoard."""
        from tensorboardX.proto.event_pb2 import Event

        self._events.write(Event(wall_time=time.time(), step=step, **content).SerializeToString())

    def sync(self) -> int:
        """Force all lines to the disk, and return the length of `metrics.jsonl` in bytes for the checkpoint."""
        self._lines.flush()
        os.fsync(self._lines.fileno())
        self._events.flush()
        return self._lines.tell()


def count_name(unit: Unit) -> str:
    """The unit as a key in JSON: `control_steps` or `updates`."""
    return unit.replace(" ", "_")


def _lock(path: Path) -> filelock.BaseFileLock:
    """Lock a folder, and delete the half-written files of a killed process."""
    lock = filelock.FileLock(path / ".lock", timeout=0, thread_local=False)
    try:
        lock.acquire()
    except filelock.Timeout as error:
        raise MadocError(f"{path} is in use by another process; wait until it ends, or choose another --out") from error
    except OSError as error:
        raise MadocError(f"could not lock {path}: {error.strerror or error}") from error
    remove_leftovers(path)
    return lock


def _cut(path: Path, offset: int) -> Path:
    """Cut off the lines after a checkpoint, which the resumed run writes again."""
    size = path.stat().st_size if path.exists() else 0
    if size < offset:
        raise MadocError(f"{path} has {size} bytes, its checkpoint says {offset}; restore it or start a new run")
    if size > offset:
        os.truncate(path, offset)
    return path


def _flat(spec: object, prefix: str = "") -> dict[str, str]:
    """A nested dictionary as a flat one, with dotted keys and values as JSON."""
    if isinstance(spec, Mapping) and spec:
        children = (_flat(child, f"{prefix}.{name}" if prefix else name) for name, child in spec.items())
        return {key: value for child in children for key, value in child.items()}
    return {prefix: json_text(spec, what=prefix)}


def _shortened(text: str) -> str:
    """A value cut to 80 characters, because a robot's whole model does not fit into a sentence."""
    return text if len(text) <= 80 else f"{text[:77]}..."
