import pytest

from madoc import tasks


@pytest.fixture(scope="session")
def hopper():
    return tasks.hopper()


@pytest.fixture(scope="session")
def ant():
    return tasks.ant()
