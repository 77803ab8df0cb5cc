"""The peak of the resident set: as the system tells it, and over an interruption."""

import jax
import numpy as np
import pytest

from madoc.runs import loop, memory
from madoc.runs.run_folder import RunFolder
from wandering import Wander

BLOCK = 100_000_000
needs_system = pytest.mark.skipif(not memory.forget_peak(), reason="the system does not tell the peak")


def peak_of(path, *, budget, resume=False):
    with (RunFolder.open if resume else RunFolder.create)(path, {"method": "wander", "budget": budget}) as folder:
        loop.run(Wander(), None, key=jax.random.key(0), budget=budget, folder=folder, resume=resume, quiet=True)
    return memory.read_peak(path)


@needs_system
def test_the_peak_outlasts_what_was_held_until_it_is_forgotten():
    assert memory.forget_peak()
    before = memory.peak_memory()
    block = np.ones(BLOCK // 8)
    held = memory.peak_memory()
    assert held > before + 0.9 * block.nbytes
    del block
    assert memory.peak_memory() > 0.99 * held  # the system counts pages in batches
    assert memory.forget_peak()
    assert memory.peak_memory() < held - 0.9 * BLOCK


@needs_system
def test_a_run_does_not_count_what_was_held_before_it(tmp_path):
    block = np.ones(BLOCK // 8)
    with_block = memory.peak_memory()
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
    monkeypatch.setattr(memory, "_PROCESS", tmp_path / "nothing")
    assert not memory.forget_peak()
    assert memory.peak_memory() is None
