import pytest
from command_line import WHOLE, WHOLE_CODE

from madoc.commands.main import main


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """The folder of one `madoc run`, shared by all tests: only read it, or copy it."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert main([*WHOLE, "--out", str(folder)]) == WHOLE_CODE
    return folder


@pytest.fixture(scope="session")
def recorded(whole):
    """Five hundred recorded transitions of Hopper."""
    return whole / "data.npz"
