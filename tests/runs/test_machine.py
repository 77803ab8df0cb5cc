"""The peak of the resident set, as the system tells it and over an interruption, and versions.

Those that a run tells, and those written down, which install on every Python that the package allows.
"""

from importlib import metadata
from pathlib import Path

import jax
import numpy as np
import pytest
from packaging.specifiers import SpecifierSet

from madoc.runs import loop, machine
from madoc.runs.run_folder import RunFolder
from wandering import Wander

LOCKS = [Path(__file__).parents[2] / name for name in ("requirements.lock", "requirements-dev.lock")]
OLDEST = "3.11.0"
BLOCK = 100_000_000
needs_system = pytest.mark.skipif(not machine.forget_peak(), reason="the system does not tell the peak")


def peak_of(path, *, budget, resume=False):
    with (RunFolder.open if resume else RunFolder.create)(path, {"method": "wander", "budget": budget}) as folder:
        loop.run(Wander(), None, key=jax.random.key(0), budget=budget, folder=folder, resume=resume, quiet=True)
    return machine.read_peak(path)


@needs_system
def test_the_peak_outlasts_what_was_held_until_it_is_forgotten():
    assert machine.forget_peak()
    before = machine.peak_memory()
    block = np.ones(BLOCK // 8)
    held = machine.peak_memory()
    assert held > before + 0.9 * block.nbytes
    del block
    assert machine.peak_memory() > 0.99 * held  # the system counts pages in batches
    assert machine.forget_peak()
    assert machine.peak_memory() < held - 0.9 * BLOCK


@needs_system
def test_a_run_does_not_count_what_was_held_before_it(tmp_path):
    block = np.ones(BLOCK // 8)
    with_block = machine.peak_memory()
    del block
    assert 0 < peak_of(tmp_path / "run", budget=600) < with_block - 0.5 * BLOCK


@pytest.mark.parametrize(
    ("peaks", "told"),
    [((3000, 2000), 3000), ((2000, 3000), 3000), ((None, 3000), None), ((3000, None), None)],
    ids=["larger before", "larger after", "not known before", "not known after"],
)
def test_a_resumed_run_keeps_the_largest(tmp_path, monkeypatch, peaks, told):
    for peak, budget in zip(peaks, (200, 600), strict=True):
        monkeypatch.setattr(loop, "forget_peak", lambda known=peak is not None: known)
        monkeypatch.setattr(loop, "peak_memory", lambda known=peak: known)
        found = peak_of(tmp_path / "run", budget=budget, resume=budget == 600)
        assert found == (peak if budget == 200 else told)


def test_a_system_that_tells_nothing_is_no_mistake(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "_PROCESS", tmp_path / "nothing")
    assert not machine.forget_peak()
    assert machine.peak_memory() is None


def test_the_version_of_mujoco_is_that_of_its_core_where_it_has_one(monkeypatch):
    installed = {"mujoco": "4.0.0", "mujoco-core": "4.0.1"}

    def version(package):
        if package not in installed:
            raise metadata.PackageNotFoundError
        return installed[package]

    monkeypatch.setattr(metadata, "version", version)
    assert machine.versions()["mujoco"] == "4.0.1"
    del installed["mujoco-core"]
    assert machine.versions()["mujoco"] == "4.0.0"
    installed.clear()
    assert machine.versions()["mujoco"] == "not installed"


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
