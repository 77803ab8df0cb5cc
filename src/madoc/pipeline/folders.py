"""Run folders of the stages: none is left of a refused run, and those of finished runs are recognised."""

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
    """The locked folder of a run: a new one, or with `resume` that of an earlier run.

    Args:
        path: The folder.
        spec: The settings of the run.
        resume: Go on with the run that the folder holds.
        keep: The first file worth keeping: a new folder is deleted if the run is refused before it has that file.

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
