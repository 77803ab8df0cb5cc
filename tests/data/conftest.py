import pytest
from logged_arm import arm_of, columns_of

from madoc import tasks


@pytest.fixture(scope="session")
def hopper():
    return tasks.hopper()


@pytest.fixture(scope="session")
def ant():
    return tasks.ant()


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm_of(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def columns(robot):
    return columns_of(robot)
