"""The two physics: masses and inertias against the reference, a capsule by hand; which versions of MuJoCo are taken."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from packaging.specifiers import SpecifierSet

import madoc.tasks
from madoc.errors import MadocError
from madoc.robots.model_files import ModelFiles
from madoc.tasks.physics import OLDEST, WRONG, legacy_capsule, refuse_unfit_mujoco, solid_sphere

# MuJoCo's models in mujoco-py, printed to the digits of the paper's tables and of Gymnasium's documentation.
MASSES = [
    ("hopper", "legacy", [3.53429, 3.92699, 2.71434, 5.08938]),
    ("hopper", "modern", [3.66519, 4.05789, 2.78136, 5.31557]),
    ("walker2d", "legacy", [3.53429, 3.92699, 2.71434, 2.94053, 3.92699, 2.71434, 2.94053]),
]


@pytest.mark.parametrize(("name", "physics", "masses"), MASSES)
def test_masses_of_the_reference(name, physics, masses):
    np.testing.assert_allclose(madoc.tasks.make(name, physics).compile().body_mass[1:], masses, atol=5e-6)


@pytest.mark.parametrize(("physics", "torso"), [("legacy", 6.3603), ("modern", 6.2502)])
def test_half_cheetah_weighs_14_kg_in_both_physics(physics, torso):
    mass = madoc.tasks.make("halfcheetah", physics).compile().body_mass
    assert mass.sum() == pytest.approx(14.0, abs=1e-12)
    assert mass[1] == pytest.approx(torso, abs=5e-5)


def test_legacy_masses_are_the_papers_truth():
    # Tables 6 and 9, Jiang et al. 2024: printed to two and three digits.
    half_cheetah = madoc.tasks.make("halfcheetah").compile().body_mass
    np.testing.assert_allclose(half_cheetah[1:], [6.36, 1.54, 1.58, 1.07, 1.43, 1.18, 0.85], atol=6e-3)
    ant = madoc.tasks.make("ant").compile().body_mass
    np.testing.assert_allclose(ant[1:8], [0.33, 0.036, 0.036, 0.065, 0.036, 0.036, 0.065], atol=3e-3)


def test_capsule_worked_by_hand():
    # Radius 2, half-length 1, density 1/π: L = 4, m = r² L = 16, across = 16 (3·4 + 16)/12 = 37.33, along = 32.
    mass, inertia = legacy_capsule(2.0, 1.0, 1.0 / np.pi)
    assert mass == pytest.approx(16.0)
    np.testing.assert_allclose(inertia, [112 / 3, 112 / 3, 32.0])


def test_sphere_worked_by_hand():
    # Radius 3, density 1/π: m = 36, I = 0.4 · 36 · 9.
    mass, inertia = solid_sphere(3.0, 1.0 / np.pi)
    assert mass == pytest.approx(36.0)
    np.testing.assert_allclose(inertia, [129.6] * 3)


def test_legacy_torso_of_the_hopper_is_the_cylinder():
    # torso: radius 0.05, from z 1.45 to 1.05: h = 0.2, L = 0.45, density 1000.
    model = madoc.tasks.make("hopper").compile()
    mass, across, along = 1000 * np.pi * 0.0025 * 0.45, (3 * 0.0025 + 0.2025) / 12, 0.0025 / 2
    torso = model.body("torso")
    assert torso.mass[0] == pytest.approx(mass)
    np.testing.assert_allclose(np.sort(torso.inertia), np.sort(mass * np.array([across, across, along])))


@pytest.mark.parametrize("name", madoc.tasks.TASKS)
def test_inertia_differs_between_the_physics_and_shape_does_not(name):
    legacy, modern = (madoc.tasks.make(name, physics).compile() for physics in ("legacy", "modern"))
    assert (legacy.body_inertia[1] != modern.body_inertia[1]).any()
    np.testing.assert_array_equal(legacy.geom_size, modern.geom_size)
    np.testing.assert_allclose(legacy.geom_pos, modern.geom_pos, atol=1e-12)


@pytest.mark.parametrize("name", madoc.tasks.TASKS)
@pytest.mark.parametrize("physics", ["legacy", "modern"])
def test_the_floor_has_no_margin(name, physics):
    assert madoc.tasks.make(name, physics).compile().geom("floor").margin[0] == 0.0


def test_unknown_names_are_refused():
    with pytest.raises(MadocError, match="unknown physics 'old'; expected one of legacy, modern"):
        madoc.tasks.make("hopper", "old").compile()
    with pytest.raises(MadocError, match="unknown task 'humanoid'; there are: hopper, halfcheetah, walker2d, ant"):
        madoc.tasks.make("humanoid")


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
        monkeypatch.setattr(room, refuse_unfit_mujoco.__name__, refuse)
    model = next((ROOT / "examples" / "reach").glob("*.xml"))
    with pytest.raises(MadocError, match=r"^MuJoCo 3\.6\.0 lacks MjModel\.dof_dampingpoly; install another one: pip "):
        madoc.robots.model.read_model(ModelFiles.read(model)) if robot == "own" else madoc.tasks.make(robot).spec()
