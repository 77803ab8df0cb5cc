import os
import shutil

import pytest
from command_line import WHOLE, WHOLE_CODE
from filelock import FileLock

from madoc.commands.main import main


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """The folder of one `madoc run`, shared by all tests and all workers: only read it, or copy it."""
    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    folder, done = root / "whole" / "run", root / "whole-done"
    with FileLock(root / "whole.lock"):
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            assert main([*WHOLE, "--out", str(folder)]) == WHOLE_CODE
            done.touch()
    return folder


@pytest.fixture(scope="session")
def recorded(whole):
    """Five hundred recorded transitions of Hopper."""
    return whole / "data.npz"
