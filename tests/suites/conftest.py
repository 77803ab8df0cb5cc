import shutil

import jax
import pytest

from madoc import data, robots
from own_robots import SPRING_SPEC, write_robot
from robots import SPRING_TRUTH, recorded


@pytest.fixture(scope="session")
def spring(tmp_path_factory):
    """A folder with a spring and two logs of 60 rows of it: only copy it."""
    folder = tmp_path_factory.mktemp("spring")
    write_robot(folder, SPRING_SPEC, "spring.yaml")
    task = robots.load(folder / "spring.yaml").task
    for name, seed in (("log.npz", 1), ("other.npz", 2)):
        data.save(recorded(task, SPRING_TRUTH, 60, jax.random.key(seed)), folder / name)
    return folder


@pytest.fixture
def place(tmp_path, spring):
    """A folder of one's own with the spring and its logs."""
    return shutil.copytree(spring, tmp_path / "place")


@pytest.fixture
def suite(place):
    """A function that writes a suite file, and returns its path."""

    def write(text, name="suite.yaml"):
        path = place / name
        path.write_text(text if text.startswith("madoc") or not text else f"madoc: 1\ncells:\n{text}")
        return path

    return write
