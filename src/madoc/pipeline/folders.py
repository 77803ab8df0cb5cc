"""Run folders of the stages: a new one that is refused leaves nothing, a finished one is recognised."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from madoc.errors import MadocError
from madoc.runs.files import read_json
from madoc.runs.run_folder import RunFolder

ENDED = ("finished", "converged")
"""The statuses of a stage after which the next one may start."""


@contextmanager
def working_folder(
    path: Path, spec: dict[str, object], *, resume: bool, keep: str = "checkpoint.npz"
) -> Iterator[RunFolder]:
    """The locked folder of a run, new or, with `resume`, as it was left.

    Args:
        path: The folder.
        spec: The settings of the run.
        resume: Go on with the run that the folder holds.
        keep: The first file worth keeping: a new folder is deleted if the run is refused before it has that file.

    Raises:
        MadocError: As `RunFolder.create` and `RunFolder.open`.
    """
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
    """Whether a run has been started there."""
    return (path / "spec.json").exists()


def ended(path: Path, also: str | None = None) -> bool:
    """Whether the run there came to its end, and left the file `also` after it."""
    if not (path / "result.json").exists() or (also is not None and not (path / also).exists()):
        return False
    return read_json(path / "result.json").get("status") in ENDED


def stored_path(path: Path, folder: Path) -> str:
    """A path as the spec in `folder` remembers it: relative beside the folder, so that both can move."""
    target, parent = path.expanduser().resolve(), folder.expanduser().resolve().parent
    return f"../{target.relative_to(parent)}" if target.is_relative_to(parent) else str(target)


def restored_path(text: str, folder: Path) -> Path:
    """The path that `stored_path` wrote."""
    return folder / text
