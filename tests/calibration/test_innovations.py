from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from madoc import simulation
from madoc.calibration import CalibrationProblem, Madoc, Prior
from madoc.calibration.madoc import innovations, slopes
from madoc.calibration.madoc.actors import Actors
from madoc.calibration.madoc.agents import OF_INNOVATIONS
from madoc.calibration.madoc.watch import SETTLING
from madoc.data import Disturbance
from madoc.errors import MadocError
from madoc.parameters import Parameter
from madoc.runs import checkpoint
from madoc.simulation.rollout import Rollout
from madoc.types import Transitions
from robots import CountingSimulator, recorded, spring

TRUTH = {"jnt_stiffness.slide": 4.0, "dof_damping.slide": 0.5, "body_mass.cart": 2.0}
KEY = jax.random.key(0)


def problem_of(task=None, rows=400):
    task = task or spring()
    truth = {row.name: TRUTH[row.name] for row in task.parameters.parameters}
    return CalibrationProblem(recorded(task, truth, rows, KEY), simulation.make(task, threads=1))


def rollout_of(problem, valid=None):
    """The log's own first 120 rows as a rollout of 10 steps, 4 systems and 3 rows."""
    rows = jax.tree.map(lambda column: column[:120].reshape(10, 4, 3, *column.shape[1:]), problem.dataset.transitions)
    return Rollout(Transitions(*jax.tree.leaves(rows)), np.ones((10, 4, 3), bool) if valid is None else valid)


def seen(problem, reference=None, estimate=None, rollout=None):
    """With actors at the physical values `estimate`, a tenth wide before squashing."""
    scaling, space = problem.features.standardised, problem.simulator.parameters
    mean = np.arctanh(space.to_unit(space.middle if estimate is None else estimate))
    return innovations.seen(
        problem,
        scaling,
        innovations.no_reference(problem, scaling, KEY) if reference is None else reference,
        Actors(mean, np.full(len(space), np.log(0.1))),
        np.zeros((4, len(space))),
        rollout_of(problem) if rollout is None else rollout,
        KEY,
    )


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


def test_rows_that_cannot_be_rebuilt_or_failed_have_none():
    problem = problem_of(replace(spring(), rebuildable=lambda observation: observation[..., 0] > 0.0))
    valid = np.ones((10, 4, 3), bool)
    valid[0, 0] = False
    found = seen(problem, rollout=rollout_of(problem, valid))
    known = (problem.dataset.transitions.observation[:120, 0] > 0.0).reshape(10, 4, 3) & valid
    assert known.any() and not known.all()
    np.testing.assert_array_equal(np.isfinite(found.following).all(-1), known)
    assert found.failures == 0  # the failed rows of the rollout are counted with it


def test_the_scale_is_that_of_logged_and_simulated_innovations_together():
    problem = problem_of()
    middle = problem.simulator.parameters.middle
    found = seen(problem)
    assert (found.reference.age, found.control_steps) == (0, 120 + 400 + 150 * 3)
    logged = innovations.innovations(problem.simulator, middle, problem.dataset.transitions)
    scale = np.median(np.abs(np.concatenate([logged, logged[:120]])), axis=0)
    reference, floor = found.reference, np.maximum(scale / problem.typical_change, 1e-4)
    np.testing.assert_allclose(reference.slopes.floor, floor, rtol=1e-6)
    np.testing.assert_allclose(reference.slopes.deviation, 0.1, rtol=1e-6)
    pair = problem.features.standardised.features(problem.dataset.transitions)[0]
    spread = slopes.spreads(reference.slopes, jnp.asarray(pair))
    features = np.arcsinh(logged / problem.typical_change / spread)
    np.testing.assert_allclose(found.following.reshape(120, 2), features[:120], rtol=1e-3, atol=1e-6)
    assert sorted(reference.following[:, 1].tolist()) == pytest.approx(sorted(features[:, 1].tolist()), rel=1e-3)
    assert reference.size == pytest.approx(np.sqrt(np.mean(floor**2)))


def test_derivatives_by_hand():
    problem = problem_of(spring(Parameter("jnt_stiffness", "slide", 2.0, 6.0)))
    rows, space = problem.dataset.transitions, problem.simulator.parameters
    known = innovations.innovations(problem.simulator, space.middle, rows)
    found = innovations._derivatives(problem, np.zeros(1), rows, known)
    # A stiffness larger by 2 N/m, half the range, takes 2 · x h / m from the next speed; the cart has 2 kg.
    position, step = rows.observation[:, 0], problem.simulator.control_step
    far = np.abs(position) > 0.05
    assert found.shape == (400, 2, 1)
    expected = -2.0 * position[far] * step / 2.0 / problem.typical_change[1]
    np.testing.assert_allclose(found[far, 1, 0], expected, rtol=0.1)


def test_rounding_of_a_log_is_no_difference():
    problem = problem_of(spring(Parameter("dof_damping", "slide", 0.0, 1.0)))
    rows = problem.dataset.transitions
    rounded = replace(rows, observation=rows.observation.round(9), next_observation=rows.next_observation.round(9))
    log = replace(problem.dataset, transitions=rounded)
    truth = problem.simulator.parameters.vector({"dof_damping.slide": 0.5})
    found = seen(replace(problem, dataset=log), estimate=truth)
    assert np.abs(found.reference.following).max() < 0.01  # of the smallest blur


def test_a_reference_is_renewed_at_the_estimate_once_it_is_due():
    problem = problem_of()
    truth = problem.simulator.parameters.vector(TRUTH)
    first = seen(problem).reference
    kept = seen(problem, first, truth)
    assert (kept.reference.age, kept.control_steps) == (1, 120)
    np.testing.assert_array_equal(kept.reference.parameters, first.parameters)
    renewed = seen(problem, replace(kept.reference, age=innovations.RENEWAL - 1), truth).reference
    assert renewed.age == 0
    np.testing.assert_array_equal(renewed.parameters, truth)


def test_a_reference_at_which_nothing_can_be_predicted_is_not_taken():
    problem = problem_of()
    nothing = rollout_of(problem, np.zeros((10, 4, 3), bool))
    before = seen(problem, rollout=nothing)
    assert before.following is None
    assert before.reference.age == -1
    old = replace(seen(problem).reference, age=innovations.RENEWAL - 1)
    after = seen(problem, old, rollout=nothing)
    assert after.reference is old  # still due
    assert after.control_steps == 120 + 400 + 120


def test_where_innovations_cannot_be_had():
    task = spring()
    problem = problem_of(task)
    silent = np.zeros(2)
    assert innovations.obstacle(problem, 1, silent) == ""
    assert "3 rows" in innovations.obstacle(problem, 3, silent)
    assert innovations.obstacle(problem, 1, 0.02 * problem.typical_change) == ""
    assert "noise is more than 3 %" in innovations.obstacle(problem, 1, 0.04 * problem.typical_change)
    hidden = simulation.make(replace(task, state_from_observation=None), threads=1)
    shuffled, derived = (
        replace(problem, dataset=replace(problem.dataset, disturbance=disturbance))
        for disturbance in (Disturbance(shuffled="next_observations"), Disturbance(velocities="differences"))
    )
    blind = replace(problem, simulator=hidden)
    for other, word in ((blind, "does not determine the state"), (shuffled, "shuffled"), (derived, "differences")):
        assert word in innovations.obstacle(other, 1, silent)
        with pytest.raises(MadocError, match="features=innovations cannot be had here"):
            Madoc(features="innovations").init(other, KEY)
        state = Madoc(cloning_epochs=0, epoch_steps=200, updates=2).init(other, KEY)
        assert state.reference is None
        watched = replace(state, watch=replace(state.watch, epochs=SETTLING))
        (warning,) = [text for text in Madoc().estimate(other, watched).warnings if "no innovations" in text]
        assert word in warning
        early = Madoc().estimate(other, replace(state, watch=replace(state.watch, epochs=SETTLING - 1)))
        assert "no innovations" not in " ".join(early.warnings)


def test_innovations_begin_where_rows_overlap_and_a_checkpoint_holds_them(monkeypatch, tmp_path):
    problem = problem_of()
    counting = CountingSimulator(problem.simulator)
    counted = replace(problem, simulator=counting)
    method = Madoc(groups="one", cloning_epochs=0, epoch_steps=200, draws=4, horizon=10, updates=2)
    state = method.init(counted, KEY)
    spent, ages = [], []
    for epoch in range(SETTLING + 3):
        before = counting.rows
        monkeypatch.setattr(innovations, "OVERLAP", 0.0 if epoch > SETTLING else 2.0)
        state, told = method.step(counted, state)
        assert told.control_steps == counting.rows - before
        spent.append(told.control_steps)
        assert state.reference is not None
        ages.append(state.reference.age)
    assert ages == [-1] * (SETTLING + 1) + [0, 1]
    assert spent == [200] * (SETTLING + 1) + [1250, 400]  # simulated, predicted, 400 logged rows, derivatives of 150
    assert state.watch.began == SETTLING + 1
    assert not method.estimate(counted, state).settled  # the discriminators began anew two epochs ago
    for overlap, reason in ((0.1, "too seldom where logged"), (0.9, "no row could be predicted")):
        seen_alone = replace(state, reference=replace(state.reference, age=-1))
        seen_alone = replace(seen_alone, watch=replace(state.watch, began=0, overlap=overlap))
        monkeypatch.setattr(innovations, "OVERLAP", 0.3)
        assert reason in " ".join(method.estimate(counted, seen_alone).warnings)
    middle = problem.simulator.parameters.middle
    assert state.reference is not None
    assert (state.reference.parameters != middle).all()
    checkpoint.save(tmp_path / "checkpoint.npz", state, {})
    fresh = method.init(counted, KEY)
    assert checkpoint.difference(checkpoint.layout(state), checkpoint.layout(fresh)) is None
    resumed, _ = checkpoint.load(tmp_path / "checkpoint.npz", fresh)
    ours, theirs = (jax.tree.leaves(method.step(counted, each)[0]) for each in (state, resumed))
    for one, other in zip(ours, theirs, strict=True):
        if isinstance(one, jax.Array) and jax.dtypes.issubdtype(one.dtype, jax.dtypes.prng_key):
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        np.testing.assert_array_equal(one, other)


def test_with_a_prior_of_every_parameter_innovations_begin_at_once():
    problem, method = problem_of(), Madoc(groups="one", starts=None, cloning_epochs=0, epoch_steps=200, updates=2)
    truth = problem.simulator.parameters.vector(TRUTH)
    half = (problem.simulator.parameters.high - problem.simulator.parameters.low) / 2.0
    known = replace(problem, prior=Prior(truth, 0.1 * half, "a guess"))
    partly = replace(problem, prior=Prior(truth, np.array([0.1, 0.1, 0.9]) * half, "a guess"))
    references = []
    for each in (partly, known):
        state, _ = method.step(each, method.init(each, KEY))
        references.append(state.reference)
    assert [reference.age for reference in references] == [-1, 0]
    np.testing.assert_allclose(references[1].parameters, truth, rtol=1e-5)


def test_where_innovations_begin_the_actors_stay_and_networks_are_fresh():
    problem, method = problem_of(), Madoc(groups="one")
    state = method.init(problem, KEY)
    moved = replace(state.agents.actors, mean=state.agents.actors.mean + 0.5)
    state = replace(state, agents=replace(state.agents, actors=moved, updates=state.agents.updates + 7))
    again = method._begun_again(problem, state, jax.random.key(1))
    assert again.actors is moved
    assert int(again.updates) == 7
    assert float(np.exp(again.log_blur)) == pytest.approx(OF_INNOVATIONS.blur)
    before, after = (each.discriminators.triple.layers[0].weight for each in (state.agents, again))
    assert not np.array_equal(before, after)
