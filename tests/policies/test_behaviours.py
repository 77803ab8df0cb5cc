"""The shipped behaviours, recorded in a target."""

import jax

from madoc import tasks
from madoc.data.targets import paper_truth
from madoc.policies.behaviours import record_quality
from madoc.simulation.cpu import CpuSimulator


def test_a_recording_has_the_papers_truth_or_the_one_that_it_is_given():
    simulator, key = CpuSimulator(tasks.make("hopper", "legacy"), threads=1), jax.random.key(0)
    light = paper_truth("hopper") | {"body_mass.torso": 3.1}
    usual = record_quality(simulator, "medium", transitions=20, key=key)
    other = record_quality(simulator, "medium", transitions=20, key=key, truth=light)
    assert usual.true_parameters == paper_truth("hopper")
    assert other.true_parameters == light
    assert (usual.transitions.observation[1:] != other.transitions.observation[1:]).any()
