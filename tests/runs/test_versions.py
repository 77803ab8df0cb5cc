"""The versions that a run tells, and those written down, which install on every Python that the package allows."""

from importlib import metadata
from pathlib import Path

from packaging.specifiers import SpecifierSet

from madoc.runs.versions import versions

LOCKS = [Path(__file__).parents[2] / name for name in ("requirements.lock", "requirements-dev.lock")]
OLDEST = "3.11.0"


def test_the_version_of_mujoco_is_that_of_its_core_where_it_has_one(monkeypatch):
    installed = {"mujoco": "4.0.0", "mujoco-core": "4.0.1"}

    def version(package):
        if package not in installed:
            raise metadata.PackageNotFoundError
        return installed[package]

    monkeypatch.setattr(metadata, "version", version)
    assert versions()["mujoco"] == "4.0.1"
    del installed["mujoco-core"]
    assert versions()["mujoco"] == "4.0.0"
    installed.clear()
    assert versions()["mujoco"] == "not installed"


def locked():
    """Name and version of every line, of what runs Madoc and of what develops it."""
    return [line.split("==") for lock in LOCKS for line in lock.read_text().splitlines()]


def test_locked_packages_take_the_oldest_python():
    names = {name for name, _ in locked()}
    needs = {
        found.name: found.metadata["Requires-Python"] or "" for found in metadata.distributions() if found.name in names
    }
    assert needs
    assert [name for name, wanted in needs.items() if OLDEST not in SpecifierSet(wanted)] == []


def test_the_lock_names_versions_and_no_address():
    assert all(len(parts) == 2 and all(parts) for parts in locked())
    assert not any(mark in lock.read_text() for lock in LOCKS for mark in "/@:")
    names = [name.lower() for name, _ in locked()]
    assert len(set(names)) == len(names)
