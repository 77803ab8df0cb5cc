"""Clauses with the size of what an export loses, from errors given by hand."""

import numpy as np
import pytest

from madoc import robots, simulation
from madoc.pipeline import export_losses
from madoc.pipeline.export_losses import Losses, losses
from own_robots import SPRING_SPEC, write_robot

STARTS = {"start": np.zeros((1, 1))}


@pytest.fixture
def simulator(tmp_path):
    """A spring with steps of 20 ms, of which ten are the physics'; its stiffness, damping and mass, and a delay."""
    spec = SPRING_SPEC + "  - {field: action_delay, low: 0, high: 0.1}\n"
    return simulation.make(robots.load(write_robot(tmp_path, spec)).task, threads=1)


def test_each_loss_is_the_error_beside_that_of_the_estimate(simulator, monkeypatch):
    step = simulator.control_step / simulator.task.frame_skip
    mean = np.full(len(simulator.parameters), 5.3 * step)
    asked = []

    def errors(evidence, simulator, values):
        asked.append(values)
        return np.array([2.0, 3.0, 4.0, np.inf, 5.0, 2.2, 3.0, 3.0, 6.0, 6.0])[: len(values)]

    monkeypatch.setattr(export_losses, "replay_errors", errors)
    own = [(0.0,), (1.0, 1.0), (2.0,), (0.0,)]
    own[1] = (1.0, 3.0)  # two elements that differ: there is no one value to leave
    draws = np.array([[1.0, 1.0, 1.0, 1.0], [2.0, 2.0, 2.0, 2.0]])
    found = losses(STARTS, simulator, mean, own, draws)
    assert found == Losses(
        [
            "; left out, the error over held-out runs is 1.5 times as large",
            "",
            "; left out, the error over held-out runs has no bound, as simulations fail",
            "; left out, the error over held-out runs is 2.5 times as large",
        ],
        rounded="; so, the error over held-out runs is 1.1 times as large",
        independent="2 times the error of whole rows over held-out runs",
    )
    (values,) = asked
    assert values[1].tolist() == [0.0, *mean[1:]] and values[4].tolist() == [*mean[:3], 0.0]
    assert values[5] == pytest.approx([*mean[:3], 5.0 * step])
    assert sorted(values[8:, 0].tolist()) == [1.0, 2.0]


def test_nothing_is_said_where_the_run_folder_does_not_tell(simulator):
    mean = simulator.parameters.middle
    assert losses({}, simulator, mean, [(0.0,)] * len(mean), mean[None]) == Losses([""] * len(mean))
