from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import simulation
from madoc.calibration import CalibrationProblem, Madoc
from madoc.calibration.madoc import innovations
from madoc.data import Disturbance
from madoc.errors import MadocError
from madoc.parameters import Parameter
from robots import CountingSimulator, recorded, spring

TRUTH = {"jnt_stiffness.slide": 4.0, "dof_damping.slide": 0.5, "body_mass.cart": 2.0}


def problem_of(task=None, rows=400):
    task = task or spring()
    truth = {row.name: TRUTH[row.name] for row in task.parameters.parameters}
    return CalibrationProblem(recorded(task, truth, rows, jax.random.key(0)), simulation.make(task, threads=1))


def test_innovations_by_hand():
    problem = problem_of()
    rows, at = problem.dataset.transitions, problem.simulator.parameters.vector
    at_truth = innovations.innovations(problem.simulator, at(TRUTH), rows)
    np.testing.assert_allclose(at_truth, 0.0, atol=1e-12)
    # A stiffness too large by 1 N/m takes 1 · x h / m from the predicted speed, which the innovation has too much.
    stiffer = innovations.innovations(problem.simulator, at(TRUTH | {"jnt_stiffness.slide": 5.0}), rows)
    position, step = rows.observation[:, 0], problem.simulator.control_step
    far = np.abs(position) > 0.05
    np.testing.assert_allclose(stiffer[far, 1], position[far] * step / 2.0, rtol=0.1)


def test_rows_that_cannot_be_rebuilt_have_none():
    task = replace(spring(), rebuildable=lambda observation: observation[..., 0] > 0.0)
    problem = problem_of(task)
    seen = innovations.innovations(problem.simulator, problem.simulator.parameters.middle, problem.dataset.transitions)
    known = problem.dataset.transitions.observation[:, 0] > 0.0
    assert known.any() and not known.all()
    np.testing.assert_array_equal(np.isfinite(seen).all(-1), known)


def test_innovations_have_the_shape_of_a_rollout():
    problem = problem_of(rows=120)
    rows, middle = problem.dataset.transitions, problem.simulator.parameters.middle
    rollout = jax.tree.map(lambda column: column.reshape(10, 4, 3, *column.shape[1:]), rows)
    flat = innovations.innovations(problem.simulator, middle, rows)
    np.testing.assert_array_equal(
        innovations.innovations(problem.simulator, middle, rollout), flat.reshape(10, 4, 3, 2)
    )


def test_a_reference_counts_its_rows_and_scales_them_together_with_simulated_ones():
    problem = problem_of()
    counting = CountingSimulator(problem.simulator)
    counted = replace(problem, simulator=counting)
    scaling, simulated = problem.features.standardised, np.full((50, 2), np.nan)
    simulated[:30] = [3.0, 0.0]
    middle = problem.simulator.parameters.middle
    found = innovations.renewed(counted, scaling, middle, simulated, jax.random.key(0))
    assert counting.rows == 400 == len(found.pair)
    logged = innovations.innovations(problem.simulator, middle, problem.dataset.transitions)
    squares = np.concatenate([logged, simulated[:30]]) ** 2
    most = np.quantile(squares, 0.99, axis=0)
    np.testing.assert_allclose(found.scale, np.sqrt(np.minimum(squares, most).mean(0)))
    # asinh(3 · 1) / 3 = 0.606, asinh(0.03) / 3 = 0.01: linear below a third of the scale
    np.testing.assert_allclose(found.features(np.array([1.0, 0.01]) * found.scale), [0.6061, 0.01], rtol=1e-3)
    assert sorted(found.following[:, 1].tolist()) == sorted(found.features(logged)[:, 1].tolist())
    assert found.size(2.0 * found.scale) == pytest.approx(0.5)


def test_a_signal_that_no_parameter_moves_is_no_feature():
    problem = problem_of(spring(Parameter("dof_damping", "slide", 0.0, 1.0)))
    truth = problem.simulator.parameters.vector({"dof_damping.slide": 0.5})
    nothing = np.zeros((1, 2))
    found = innovations.renewed(problem, problem.features.standardised, truth, nothing, jax.random.key(0))
    assert found.scale.tolist() == [0.0, 0.0]
    assert not np.asarray(found.following).any()
    assert found.size(problem.typical_change) == 1.0


def test_where_innovations_cannot_be_had():
    task = spring()
    problem = problem_of(task)
    assert innovations.obstacle(problem, 1) == ""
    assert "3 rows" in innovations.obstacle(problem, 3)
    hidden = replace(task, state_from_observation=None)
    shuffled = replace(problem.dataset, disturbance=Disturbance(shuffled="next_observations"))
    for other, word in (
        (replace(problem, simulator=simulation.make(hidden, threads=1)), "does not determine its state"),
        (replace(problem, dataset=shuffled), "shuffled"),
    ):
        assert word in innovations.obstacle(other, 1)
        with pytest.raises(MadocError, match="features=innovations cannot be had here"):
            Madoc(features="innovations").init(other, jax.random.key(0))
        assert Madoc().init(other, jax.random.key(0)).reference is None


def test_an_epoch_counts_every_predicted_row_and_the_reference_moves_with_the_estimate():
    problem = problem_of()
    counting = CountingSimulator(problem.simulator)
    method = Madoc(groups="one", cloning_epochs=0, epoch_steps=200, draws=4, horizon=10, updates=2)
    counted = replace(problem, simulator=counting)
    state = method.init(counted, jax.random.key(0))
    spent, references = [], []
    for _ in range(innovations.RENEWAL + 1):
        before = counting.rows
        state, epoch = method.step(counted, state)
        assert epoch.control_steps == counting.rows - before
        spent.append(epoch.control_steps)
        references.append(state.reference.parameters)
    assert spent == [800, *[400] * (innovations.RENEWAL - 1), 800]  # simulated, predicted, and 400 logged rows
    np.testing.assert_array_equal(references[0], problem.simulator.parameters.middle)
    np.testing.assert_array_equal(references[0], references[-2])
    assert (references[-1] != references[0]).all()


def test_a_log_of_which_no_row_can_be_predicted_is_refused(monkeypatch):
    problem = problem_of()
    nowhere = np.full(problem.dataset.transitions.observation.shape, np.nan)
    monkeypatch.setattr(innovations, "innovations", lambda *_: nowhere)
    middle = problem.simulator.parameters.middle
    with pytest.raises(MadocError, match="all of 400 logged rows diverged"):
        innovations.renewed(problem, problem.features.standardised, middle, np.zeros((1, 2)), jax.random.key(0))
