"""Which versions of MuJoCo are taken: by the package's metadata, by `make test-versions`, and at run time."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

import madoc.tasks
from madoc.errors import MadocError
from madoc.robots.model_files import ModelFiles
from madoc.tasks import mujoco_versions
from madoc.tasks.mujoco_versions import OLDEST, WRONG, refuse_unfit_mujoco

ROOT = Path(__file__).parents[2]


@pytest.fixture
def wanted():
    """The versions that the package asks for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (one,) = [line for line in project["dependencies"] if line.startswith("mujoco")]
    return SpecifierSet(one.removeprefix("mujoco"))


@pytest.mark.parametrize("version", ["3.6.0", "3.7.0", "3.8.0", "3.10.0", "3.17.0", "4.0.0", "4.0.1"])
def test_what_is_refused_is_what_the_package_does_not_ask_for(version, wanted):
    if version in wanted:
        refuse_unfit_mujoco(version)
    else:
        with pytest.raises(
            MadocError, match=rf"^MuJoCo {re.escape(version)} .*'mujoco>={OLDEST},!={next(iter(WRONG))}'"
        ):
            refuse_unfit_mujoco(version)


def test_the_ends_of_the_range_are_tested_and_the_locked_version_is_in_it(wanted):
    (tested,) = re.findall(r"^MUJOCO := (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    versions = [one.rpartition("==")[2] for one in tested.split()]
    assert versions[0].startswith(f"{OLDEST}.")
    (locked,) = re.findall(r"^mujoco==(.+)$", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    assert all(version in wanted for version in [*versions, locked])


@pytest.mark.parametrize("robot", ["hopper", "own"])
def test_a_model_says_what_the_installed_version_lacks(robot, monkeypatch):
    def refuse():
        refuse_unfit_mujoco("3.6.0")

    for room in (madoc.tasks.physics, madoc.robots.model):
        monkeypatch.setattr(room, mujoco_versions.refuse_unfit_mujoco.__name__, refuse)
    model = next((ROOT / "examples" / "reach").glob("*.xml"))
    with pytest.raises(MadocError, match=r"^MuJoCo 3\.6\.0 lacks MjModel\.dof_dampingpoly; install another one: pip "):
        madoc.robots.model.read_model(ModelFiles.read(model)) if robot == "own" else madoc.tasks.make(robot).spec()
