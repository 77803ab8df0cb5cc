"""An ensemble filter worked by hand, and the search by its prediction errors: a foot that slides under noise."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.calibration.least_squares import filtering, instruments, left_over
from madoc.calibration.least_squares.calibrator import LeastSquares
from madoc.calibration.least_squares.filtering import of_contacts
from madoc.calibration.least_squares.instruments import Side, agreed, axes_of
from madoc.calibration.least_squares.lengthening import LeastSquaresState, back_to_filter
from madoc.calibration.least_squares.sentences import TIMESTEP, about_surprises
from madoc.data import stride
from madoc.identification import random_forces
from madoc.identification.ensembles import (
    BEFORE,
    DRAWN,
    NOISE_ROUNDS,
    FilteredWindows,
    likely_states,
    with_contacts_settled,
    with_noise,
)
from madoc.identification.information import BOX_VARIANCE
from madoc.identification.replay import Readings
from madoc.identification.settling import RESETTLING, settled, settled_to_noise
from madoc.identification.windows import disjoint_windows
from madoc.runs.checkpoint import load, save
from own_robots import write_robot
from robots import SPRING_TRUTH, counted, recorded, spring

FOOT = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="ground" type="plane" size="9 9 1" friction="0.05"/>
    <body name="foot" pos="0 0 0.05">
      <joint name="along" type="slide" axis="1 0 0"/><joint name="up" type="slide" axis="0 0 1"/>
      <geom name="sole" type="sphere" size="0.05" mass="1" friction="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="along" ctrlrange="-9 9"/></actuator>
</mujoco>
"""
FOOT_SPEC = """\
madoc: 1
name: foot
model: foot.xml
control_step: 0.01
signals:
  - {name: along, reads: position(along)}
  - {name: up, reads: position(up)}
  - {name: along_speed, reads: velocity(along)}
  - {name: up_speed, reads: velocity(up)}
actions:
  - {name: push, actuator: push, low: -9, high: 9}
parameters:
  - {field: geom_friction, element: sole, name: friction, low: 0.1, high: 1}
  - {field: body_mass, element: foot, name: mass, low: 0.5, high: 2}
"""
FOOT_TRUTH = {"friction": 0.4, "mass": 0.8}
NOISE = {"along": 5e-4, "up": 5e-4, "along_speed": 5e-3, "up_speed": 5e-3}


def problem_of_foot(folder, rows=900, spec=FOOT_SPEC, force=0.0):
    """A log whose heights are as noisy as a camera's, many times as deep as the foot sinks in; a random force acts."""
    task = robots.load(write_robot(folder, spec, foot=FOOT)).task
    truth = {"action_delay": 0.01, **FOOT_TRUTH} if task.pending else FOOT_TRUTH
    return with_noisy_sensors(task, recorded(task, truth, rows, jax.random.key(0), force))


def with_noisy_sensors(task, log, share=1.0):
    random, logged, noise = np.random.default_rng(0), log.transitions, share * np.array([*NOISE.values()])
    here, there = (np.array(part, np.float64) for part in (logged.observation, logged.next_observation))
    error = random.standard_normal((len(here) + 1, 4)) * noise
    last = np.isin(np.arange(len(here)), log.episode_ends - 1)
    following = np.where(last[:, None], random.standard_normal(here.shape) * noise, error[1:])
    noisy = replace(logged, observation=here + error[:-1], next_observation=there + following)
    noisy = replace(log, transitions=noisy, physics=task.physics)
    return CalibrationProblem(noisy, simulation.make(task, threads=1))


def test_likely_states_before_a_window_explain_it_where_narrow_steps_do_not(tmp_path):
    problem, steps = problem_of_foot(tmp_path), 20
    simulator, logged = problem.simulator, problem.states
    point = simulator.parameters.to_unit(simulator.parameters.vector(FOOT_TRUTH))
    rows = logged.rows[disjoint_windows(problem.dataset, logged.rows, steps)]
    readings = Readings.at(problem.dataset, logged, rows, steps, problem.typical_change)
    given = problem.dataset, logged, simulator, readings, rows, point
    guesses = logged.states[rows]
    states, spent = counted(with_contacts_settled, *given, guesses)
    narrow = settled(simulator, readings, point, guesses, (0.0, *RESETTLING), 0)
    found = settled(simulator, readings, point, states, (0.0,), 0)
    size = readings.observed[0].size
    assert found.unexplained(size, "cauchy").mean() < 0.5 * narrow.unexplained(size, "cauchy").mean()
    assert (found.deviation[2:] < 0.95 * narrow.deviation[2:]).all()  # of speeds, which contacts decide
    begun = int((rows - problem.dataset.episode_starts[problem.dataset.episode_of(rows)] >= BEFORE).sum())
    drawn = NOISE_ROUNDS * begun * DRAWN * BEFORE + len(rows) * (DRAWN + 1) * steps
    (likely,), of_draws = counted(likely_states, *given[:-1], point[None], guesses)
    of_two = likely_states(*given[:-1], np.stack([np.zeros_like(point), point]), guesses)
    assert (of_two[1] == likely).all() and (of_two[0] != likely).any()  # of the same states, each its own choice
    _, settling = counted(settled_to_noise, simulator, readings, point, likely)
    assert of_draws == drawn and spent == drawn + settling
    aloft = np.add(guesses, [0.0, 1.0, 0.0, 0.0])
    untouched, nothing = counted(with_contacts_settled, *given, aloft)
    assert nothing == 0 and (untouched == aloft).all()  # without contacts derivatives at the guesses serve


def test_a_parameter_that_changes_nothing_stays_unknown(tmp_path):
    assert (agreed(np.zeros((2, 2)), np.zeros((2, 2))) < 1e-90).all()
    search = of_contacts(problem_of_foot(tmp_path, rows=300), jax.random.key(0))
    one, windows = np.diag([4.0, 0.0]), len(search.rows)
    each = np.broadcast_to(one / windows, (windows, 2, 2))
    found = replace(search, products=each, squares=each, meat=one, epochs=3).found
    np.testing.assert_allclose(np.diag(found.uncertainty.covariance), [0.25, BOX_VARIANCE])


def test_a_foot_that_slides_under_noise(tmp_path):
    problem = problem_of_foot(tmp_path)
    method, space = LeastSquares(), problem.simulator.parameters
    state = method.init(problem, jax.random.key(0))
    assert state.filtered is not None and not state.unknown[0].epochs
    while not state.finished:
        before, (state, epoch) = state, method.step(problem, state)
        if state.stage == "filtering" and state.filtered.epochs == 2:
            assert epoch.control_steps == filtering.epoch_steps(problem, before.filtered)
            save(tmp_path / "checkpoint.npz", before, {})
            second = state
    assert state.stage == "filtering" and epoch.converged
    estimate, truth = method.estimate(problem, state), space.vector(FOOT_TRUTH)
    assert ((estimate.interval[:, 0] <= truth) & (truth <= estimate.interval[:, 1])).all()
    for found, most in ((method.estimate(problem, before), 0.05), (estimate, 0.1)):  # half ensembles may err by chance
        assert (np.diff(found.interval, axis=1)[:, 0] < most * (space.high - space.low)).all()
    assert estimate.settled and not estimate.unlike_noise
    found = state.filtered.noise * problem.typical_change
    np.testing.assert_allclose(found, [*NOISE.values()], rtol=0.4)
    assert any("predicted by an ensemble filter" in note for note in estimate.notes)
    wrong = replace(state, filtered=replace(state.filtered, alike=0.3))
    doubtful = method.estimate(problem, wrong)
    assert doubtful.unlike_noise and any("(a correlation of at least 0.30)" in warning for warning in doubtful.warnings)
    resumed, _ = load(tmp_path / "checkpoint.npz", method.init(problem, jax.random.key(0)))
    again, _ = method.step(problem, resumed)
    for kept, other in zip(jax.tree.leaves(second), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(kept, other)


def test_windows_begin_at_rows_whose_states_are_known_and_episodes_may_be_short(tmp_path):
    short = spring(max_episode_steps=15)
    log = recorded(short, SPRING_TRUTH, 600, jax.random.key(0))
    assert of_contacts(CalibrationProblem(log, simulation.make(short, threads=1)), jax.random.key(0)) is None
    delayed = FOOT_SPEC + "  - {field: action_delay, low: 0, high: 0.05}\nmax_episode_steps: 60\n"
    problem = problem_of_foot(tmp_path, spec=delayed)
    search = of_contacts(problem, jax.random.key(0))
    assert np.isin(search.rows, problem.states.rows).all()
    ends = problem.dataset.episode_ends[problem.dataset.episode_of(search.rows)]
    assert (search.rows + filtering.horizon_of(problem) <= ends).all()


def test_logs_without_contacts_fit_initial_states_and_a_horizon_of_the_users_is_the_filters(tmp_path):
    task = spring(max_episode_steps=100)
    log = recorded(task, SPRING_TRUTH, 600, jax.random.key(0))
    assert of_contacts(CalibrationProblem(log, simulation.make(task, threads=1)), jax.random.key(0)) is None
    problem = problem_of_foot(tmp_path)
    own = {"initial_states": "estimated", "horizon": 5, "windows": 20}
    filtered = LeastSquares(**own).init(problem, jax.random.key(0)).filtered
    assert (filtered.horizon, len(filtered.rows)) == (5, 20)
    for without in ({"initial_states": "logged"}, own | {"windows": 6}, own | {"horizon": 1}):
        assert LeastSquares(**without).init(problem, jax.random.key(0)).filtered is None
    assert of_contacts(problem, jax.random.key(0)).size == filtering.BLOCK


def test_epochs_have_more_windows_where_few_touch(tmp_path, monkeypatch):
    monkeypatch.setattr(filtering, "touched", lambda problem, rows, horizon: np.arange(len(rows)) < 8)
    assert of_contacts(problem_of_foot(tmp_path), jax.random.key(0)).size == 2 * filtering.BLOCK


def test_differences_lead_along_the_axes_of_the_covariance_and_not_out_of_a_range(tmp_path):
    problem = problem_of_foot(tmp_path, rows=300)
    search = of_contacts(problem, jax.random.key(0))
    np.testing.assert_allclose(search.spread, filtering.WIDTH * np.eye(2))
    # Standard errors of sqrt(8e-4) along (1, 1), and of sqrt(2e-4) across it.
    axes = axes_of(np.array([[5e-4, 3e-4], [3e-4, 5e-4]]))
    expected = np.sqrt([[2e-4, 8e-4], [2e-4, 8e-4]])  # two of them, in each component 1 / sqrt(2) of the length
    np.testing.assert_allclose(np.abs(axes), expected)
    np.testing.assert_allclose(np.linalg.norm(axes_of(np.diag([0.0, 9.0])), axis=0), instruments.WIDTHS)
    wider = np.linalg.norm(axes_of(np.diag([8e-6, 8e-5])), axis=0)  # thrice, as far as that is small
    np.testing.assert_allclose(wider, [3.0 * 4e-3, instruments.WIDE])
    steps, change = filtering.horizon_of(problem), problem.typical_change
    rows, point, spread = search.rows[search.block], np.array([0.0, 1.0]), np.array([[0.1, -0.1], [0.2, 0.1]])
    readings = Readings.at(problem.dataset, problem.states, rows, steps, change)
    windows = FilteredWindows(problem.dataset, problem.states, problem.simulator, readings, rows)
    random = [np.random.default_rng(number) for number in range(3)]
    found, _ = with_noise(windows, point, search.noise, np.zeros(4), 16, 1, random[2])
    sides = [Side.of(windows, found, point, spread, 16, each) for each in random[:2]]
    for side in sides:
        assert side.ends.corrections is found.corrections  # by one ensemble's gains
        np.testing.assert_allclose(side.apart, [[0.2, 0.2], [-0.2, 0.1]])  # both ends of 1 +- 0.2 and of 1 +- 0.1
        np.testing.assert_allclose(side.aside, [0.0, -0.075])
        assert side.few.shape[1] == instruments.FEW
    assert (sides[0].few != sides[1].few).any()


def test_an_epoch_at_rest_tells_what_half_the_ensemble_errs_and_moves_nothing(tmp_path):
    problem = problem_of_foot(tmp_path)
    search = of_contacts(problem, jax.random.key(0))
    assert (search.blocks, len(search.rows)) == (1, 42)
    told = np.broadcast_to(np.eye(2), (len(search.rows), 2, 2))
    truth = problem.simulator.parameters.to_unit(problem.simulator.parameters.vector(FOOT_TRUTH))
    rest = replace(search, point=truth, wide=3, quiet=1, together=instruments.TOGETHER, squares=told)
    assert rest.at_rest and not rest.settled and rest.members == instruments.MEMBERS // 2
    (after, _), spent = counted(filtering.step, problem, rest, "cauchy")
    assert after.settled
    np.testing.assert_array_equal(after.point, rest.point)
    assert not rest.apart.any() and after.apart.all() and after.chance.all()
    known_well = replace(after, apart=np.array([1.0, 2.0]), compared=0, products=1e3 * told, squares=1e3 * told)
    covariance = known_well.found.uncertainty.covariance  # of one gradient alone, as there was no scatter before
    np.testing.assert_allclose(covariance, np.array([[1.0, 2.0], [2.0, 4.0]]) / (1e3 * len(told)) ** 2)
    systems = instruments.MEMBERS // 2 + 2 * 2 * len(problem.simulator.parameters) * instruments.FEW
    large = left_over.LARGE_ROUNDS * left_over.LARGE * search.size
    assert spent == (systems * len(search.rows) + large) * filtering.horizon_of(problem)


def test_only_what_a_larger_ensemble_loses_too_counts_as_lost(tmp_path, monkeypatch):
    problem = problem_of_foot(tmp_path)
    search = of_contacts(problem, jax.random.key(0))
    told = np.broadcast_to(np.eye(2), (len(search.rows), 2, 2))
    rest = replace(search, wide=3, quiet=1, together=instruments.TOGETHER, squares=told)
    asked = []

    def by_hand(found, loss):
        """An ensemble loses the third window and the fifth, and fails in the sixth; a larger one loses the fifth."""
        asked.append(len(found.mean[0]))
        costs = np.full(search.size, 0.5)
        costs[[2, 4, 5]] = 9.0, 9.0, np.inf
        return costs if len(asked) == 1 else np.array([0.5, 7.0, np.inf])

    monkeypatch.setattr(instruments, "surprises", by_hand)
    (after, _), spent = counted(filtering.step, problem, rest, "cauchy")
    assert asked == [search.size, 3]
    assert after.cost == pytest.approx((0.5 * (search.size - 2) + 7.0) / (search.size - 1))
    systems = instruments.MEMBERS // 2 + 2 * 2 * len(problem.simulator.parameters) * instruments.FEW
    large = left_over.LARGE * (left_over.LARGE_ROUNDS * search.size + left_over.LARGER * 3)
    assert spent == (systems * len(search.rows) + large) * filtering.horizon_of(problem)


def test_random_forces_are_asked_for_at_the_end_and_found(tmp_path):
    """A force of 0.4 N; the inertia that the model has, before it is calibrated, is 1 kg."""
    problem = problem_of_foot(tmp_path, force=0.4)
    search = of_contacts(problem, jax.random.key(0))
    told = np.broadcast_to(np.eye(2), (len(search.rows), 2, 2))
    truth = problem.simulator.parameters.to_unit(problem.simulator.parameters.vector(FOOT_TRUTH))
    search = replace(search, point=truth, noise=np.array([*NOISE.values()]) / problem.typical_change)
    rest = replace(search, wide=3, quiet=1, together=instruments.TOGETHER, squares=told, halved=9)
    state = back_to_filter(LeastSquaresState(None, (), "filtering", rest, None))
    assert state.filtered.asked == "shorter" and not state.filtered.settled and not state.finished
    (trial, _), spent = counted(filtering.step, problem, state.filtered, "cauchy")
    assert trial.asked == "trial" and not trial.shorter_steps.any()  # the log is of the model's own timestep
    assert spent == filtering.epoch_steps(problem, state.filtered)
    state = replace(state, filtered=replace(trial, epochs=state.filtered.epochs))  # and so the same ensembles follow
    exact = replace(state.filtered, asked="exact", cost=2.0)  # before a search from fitted starts has had its steps
    assert not exact.settled and not exact.found.unlike_noise
    (tried, _), spent = counted(filtering.step, problem, state.filtered, "cauchy")
    assert tried.asked == "size" and spent == filtering.epoch_steps(problem, state.filtered)
    (found, _), spent = counted(filtering.step, problem, tried, "cauchy")
    assert spent == filtering.epoch_steps(problem, tried)
    assert found.force == pytest.approx(0.4, rel=0.25) and not found.settled
    done = replace(found, together=instruments.TOGETHER, moved=0.0, quiet=1, halved=9, squares=told, alike=0.9)
    assert done.settled and back_to_filter(replace(state, filtered=done)).finished  # they are looked for once
    np.testing.assert_allclose(random_forces.by_dof(problem.simulator, found.force), found.force * np.ones(2))
    (warning,) = about_surprises(problem, replace(done, alike=0.0))
    assert f"that on along has the largest standard deviation, {found.force:.2g} N or N·m" in warning
    known = replace(done, alike=0.0, explained_share=0.5)
    assert known.found.unlike_noise and known.found.force == 0.0 and replace(done, alike=0.0).found.force == found.force
    (warning,) = about_surprises(problem, known)
    assert "they are not random: state and action explain 50 % of one of them" in warning
    (warning,) = about_surprises(problem, replace(known, force=0.0))
    assert "explain 50 % of what the model leaves of a signal" in warning
    without = problem_of_foot(tmp_path)
    trial = replace(state.filtered, size=12)
    (none, _), _ = counted(filtering.step, without, trial, "cauchy")
    assert none.force == 0.0 and none.settled and none.asked == "known"
    doubtful = back_to_filter(replace(state, filtered=replace(rest, cost=2.0, size=12))).filtered
    assert doubtful.asked == "shorter"
    doubtful = replace(doubtful, asked="size")
    (none, _), _ = counted(filtering.step, without, doubtful, "cauchy")
    assert none.force == 0.0 and none.asked == "known" and none.settled


def test_a_shorter_timestep_that_leaves_noise_explains_errors_that_are_unlike_it(tmp_path):
    """A timestep of 10 ms and a plant of 1.25 ms; by the model's own search mass and friction are off by this much."""
    task = robots.load(write_robot(tmp_path, FOOT_SPEC, foot=FOOT.replace("0.002", "0.01"))).task
    off, finer = np.array([-0.0825, 0.0547]), task.with_time_step(1.0 / 8.0, substeps=8)
    problem = with_noisy_sensors(task, recorded(finer, FOOT_TRUTH, 900, jax.random.key(0)), 0.2)
    search = of_contacts(problem, jax.random.key(0))
    point = problem.simulator.parameters.to_unit(problem.simulator.parameters.vector(FOOT_TRUTH)) + off
    search = replace(search, point=point, spread=0.02 * np.eye(2), wide=3, quiet=1)
    for _ in range(3):
        told, _ = filtering.step(problem, search, "cauchy")
        search = replace(search, noise=told.noise)
    rest = replace(search, alike=0.4, halved=9, together=instruments.TOGETHER)
    rest = replace(rest, squares=told.squares, products=told.products)
    asked = back_to_filter(LeastSquaresState(None, (), "filtering", rest, None)).filtered
    assert asked.asked == "shorter" and not asked.settled
    (known, _), spent = counted(filtering.step, problem, asked, "cauchy")
    finer = simulation.FINER * search.horizon  # control steps of a state in a window with the shorter timestep
    lost = finer * left_over.LARGER * left_over.LARGE  # a window that the first ensemble loses
    spared = finer * asked.size * (instruments.MEMBERS + 2 * 2 * 2 * instruments.FEW)  # a step that is not needed
    assert filtering.epoch_steps(problem, asked) - spent in (n * spared - m * lost for n in (0, 1) for m in range(4))
    assert known.settled and not known.found.unlike_noise and about_surprises(problem, known) == (TIMESTEP,)
    np.testing.assert_allclose(known.shorter_steps, -off, atol=0.05)
    np.testing.assert_array_equal(known.point, point)
    method = LeastSquares()
    state = replace(method.init(problem, jax.random.key(0)), stage="filtering", filtered=known, finished=1)
    moved, still = (
        method.estimate(problem, replace(state, filtered=replace(known, shorter_steps=each))).interval
        for each in (np.array([0.1, -0.2]), np.zeros(2))
    )
    half = (problem.simulator.parameters.high - problem.simulator.parameters.low) / 2.0
    np.testing.assert_allclose(moved - still, [[0.0, 0.1 * half[0]], [-0.2 * half[1], 0.0]], atol=1e-12)
    (like, _), _ = counted(filtering.step, problem, replace(asked, alike=0.0), "cauchy")
    assert like.asked == "trial" and like.shorter_steps.any()  # the log is likelier, whatever errors are like
    lacking = problem_of_foot(tmp_path, force=4.0)
    (left, _), _ = counted(filtering.step, lacking, replace(asked, alike=0.9, size=16), "cauchy")
    assert left.asked == "size" and left.alike == 0.9 and not left.shorter_steps.any()


def test_the_curvature_follows_what_a_step_changes_of_the_gradient():
    """Of the cost 3 x² + y² / 2, known as (x² + 4 y²) / 2: a step along x tells the first, one along y the second."""
    true, known = np.diag([6.0, 1.0]), np.diag([1.0, 4.0])
    along = left_over.curvature_after(known, np.array([0.1, 0.0]), true @ [0.1, 0.0])
    np.testing.assert_allclose(along, np.diag([6.0, 4.0]))
    np.testing.assert_allclose(left_over.curvature_after(along, np.array([0.0, 0.2]), true @ [0.0, 0.2]), true)
    for step, change in (([0.0, 0.0], [1.0, 1.0]), ([0.1, 0.0], [-0.1, 0.0]), ([0.1, 0.0], [0.009, 0.0])):
        np.testing.assert_array_equal(left_over.curvature_after(known, np.array(step), np.array(change)), known)


def test_epochs_near_the_end_take_other_windows_and_count_together(tmp_path):
    problem = problem_of_foot(tmp_path, rows=2400)
    search = of_contacts(problem, jax.random.key(0))
    assert search.blocks == 3 and search.block == slice(0, filtering.BLOCK // 2)
    near = replace(search, wide=2, quiet=1, together=1, moved=0.5)
    assert near.block == slice(32, 64)
    near, _ = filtering.step(problem, near, "cauchy")
    assert near.together == 2 and near.explained == 32 and not near.gradients[:32].any()
    assert replace(near, quiet=1, moved=0.5).block == slice(64, None)
    kept, fresh = np.arange(6.0), np.array([9.0, 9.0])
    np.testing.assert_allclose(filtering._counted(kept, fresh, slice(2, 4), 2), [0.0, 1.0, 5.5, 6.0, 4.0, 5.0])
    assert replace(near, quiet=1, together=5, moved=0.99 * instruments.NEAR).near  # what one of them says counts less
    far = replace(near, quiet=1, moved=instruments.NEAR)
    fresh_start, _ = filtering.step(problem, far, "cauchy")
    assert fresh_start.together == 0 and not fresh_start.gradients[32:].any()


def test_random_forces_are_likelier_only_beyond_two_standard_errors_of_enough_windows():
    """By hand: changes of -1 ± 1 in sixteen windows have a mean of -1 and a standard error of 1.03 / 4."""
    change = np.tile([0.0, -2.0], 8)
    assert left_over.likelier(change, np.zeros(16), 2)
    assert not left_over.likelier(change + 0.5, np.zeros(16), 2)  # -0.5 is less than twice 0.258
    assert left_over.likelier(change + 0.45, np.zeros(16), 2)
    assert not left_over.likelier(change, np.where(np.arange(16) < 12, np.nan, 0.0), 2)  # four windows do not tell
    assert left_over.likelier(np.append(change, np.nan), np.zeros(17), 2)  # one that fails does not count


def test_the_largest_random_force_makes_the_typical_change_of_the_speed(tmp_path):
    """The foot's mass in the model is 1 kg; in 10 ms a force F changes its speed by F · 0.01 s / 1 kg."""
    problem = problem_of_foot(tmp_path, rows=300)
    steps = stride(problem.dataset)
    log, speeds = problem.dataset, problem.states.states[:, 2:4]
    runs = [speeds[first:end] for first, end in zip(log.episode_starts, log.episode_ends, strict=True)]
    changes = np.abs(np.concatenate([each[steps:] - each[:-steps] for each in runs])).mean(0)
    size = random_forces.largest(problem.dataset, problem.states, problem.simulator)
    assert size == pytest.approx(changes.max() / 0.01 / np.sqrt(steps))
