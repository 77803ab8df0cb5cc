import pytest
from run_folders import bare_folder, whole_folder


@pytest.fixture
def whole(tmp_path):
    """A run folder with everything in it that a page shows."""
    return whole_folder(tmp_path / "whole")


@pytest.fixture
def bare(tmp_path):
    """One with a spec and a result alone."""
    return bare_folder(tmp_path / "bare")
