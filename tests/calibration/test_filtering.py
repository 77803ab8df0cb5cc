"""An ensemble filter worked by hand, and the search by its prediction errors: a foot that slides under noise."""

from dataclasses import dataclass, replace

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.calibration.least_squares import filtering, instruments
from madoc.calibration.least_squares.calibrator import LeastSquares
from madoc.calibration.least_squares.filtering import of_contacts
from madoc.calibration.least_squares.instruments import Side, agreed, axes_of, products_of, shares_of
from madoc.data import Disturbance, disturb
from madoc.identification.ensembles import (
    BEFORE,
    DRAWN,
    FARTHEST,
    NOISE_ROUNDS,
    Correction,
    Innovations,
    few_of,
    innovations,
    likely_states,
    members_at,
    with_contacts_settled,
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


@dataclass(frozen=True)
class Given(Side):
    """An ensemble whose errors and slopes are given."""

    by_hand: tuple[np.ndarray, np.ndarray]

    def errors(self):
        return self.by_hand[0]

    def slopes(self):
        return self.by_hand[1]


def known(errors):
    """Innovations with these whitened errors, as the covariance of predictions is 1."""
    rows, channels = errors.shape[1:-1], errors.shape[-1]
    one, none = np.broadcast_to(np.eye(channels), (*rows, channels, channels)), np.zeros((*rows, 1, channels))
    correction = Correction(one, one, none, none, np.ones((*rows, channels)))
    return Innovations(errors, correction, np.ones(errors.shape[:2], bool), errors, 0)


def given(errors, slopes):
    nothing, nowhere = known(np.zeros((1, len(errors), 1, 1))), np.zeros(slopes.shape[-1])
    return Given(nothing.members, nothing, nothing, np.diag(nowhere), nowhere, (errors, slopes))


def problem_of_foot(folder, rows=900, spec=FOOT_SPEC):
    """A log whose heights are as noisy as a camera's, many times as deep as the foot sinks in."""
    task = robots.load(write_robot(folder, spec, foot=FOOT)).task
    log = recorded(task, {"action_delay": 0.01, **FOOT_TRUTH} if task.pending else FOOT_TRUTH, rows, jax.random.key(0))
    random, logged = np.random.default_rng(0), log.transitions
    here, there = (np.array(part, np.float64) for part in (logged.observation, logged.next_observation))
    error = random.standard_normal((len(here) + 1, 4)) * [*NOISE.values()]
    last = np.isin(np.arange(len(here)), log.episode_ends - 1)
    following = np.where(last[:, None], random.standard_normal(here.shape) * [*NOISE.values()], error[1:])
    noisy = replace(logged, observation=here + error[:-1], next_observation=there + following)
    return CalibrationProblem(replace(log, transitions=noisy), simulation.make(task, threads=1))


def test_states_follow_a_reading_by_kalmans_gain():
    """By hand: two states with a variance of 2 and a reading of noise 1 that is 2 below them: K = 2/3, P = 2/3."""
    states, apart = np.array([4.0, 2.0]).reshape(1, 1, 2, 1), np.array([3.0, 1.0]).reshape(1, 1, 2, 1)
    correction = Correction.of(states[0], apart[0])
    assert correction.factor == pytest.approx(np.sqrt(3.0))
    after = correction.follow(states, apart)
    assert after.mean() == pytest.approx(3.0 - 2.0 * 2.0 / 3.0)
    assert after.var(ddof=1) == pytest.approx(2.0 / 3.0)
    far = Correction.of(states[0], apart[0] + 1000.0)
    false = far.follow(states, apart + 1000.0)
    assert false.mean() == pytest.approx(3.0 - FARTHEST * 2.0 / np.sqrt(3.0))
    both = far.follow(np.concatenate([states, states]), np.concatenate([apart + 1000.0, apart + 500.0]))
    assert 3.0 - both[1].mean() == pytest.approx(0.5 * (3.0 - both[0].mean()), rel=0.01)  # the first system decides
    one = correction.follow(states[..., :1, :], apart[..., :1, :])  # a single state follows by the ensemble's gain
    assert one.item() == pytest.approx(4.0 - 3.0 * 2.0 / 3.0)


def test_prediction_errors_of_the_right_model_are_white_and_of_variance_one():
    task = spring(max_episode_steps=100)
    log = disturb(recorded(task, SPRING_TRUTH, 600, jax.random.key(0)), Disturbance(noise=0.1), task, jax.random.key(1))
    problem = CalibrationProblem(replace(log, disturbance=Disturbance()), simulation.make(task, threads=1))
    rows = np.arange(0, 600, 25)
    readings = Readings.at(problem.dataset, problem.states, rows, 20, problem.typical_change)
    noise = 0.1 * np.ones(len(readings.scale))
    random = np.random.default_rng(0)
    members = members_at(problem.dataset, problem.states, problem.simulator, rows, noise * readings.scale, 200, random)
    around = members - problem.states.states[np.searchsorted(problem.states.rows, rows)][:, None]
    np.testing.assert_allclose(around.std((0, 1)), noise * readings.scale, rtol=0.05)
    truth = task.parameters.to_unit(task.parameters.vector(SPRING_TRUTH))
    found = innovations(problem.simulator, readings, np.stack([truth, -truth]), members, noise)
    errors = found.whitened[0]
    assert found.whole.all()
    assert errors.var() == pytest.approx(1.0, rel=0.1)
    assert abs((errors[:, 1:] * errors[:, :-1]).mean()) < 0.1
    surprise = found.surprise("linear").mean(1)
    assert surprise[0] < surprise[1]
    few = few_of(members, 50, problem.states.physical_size)
    again = innovations(problem.simulator, readings, truth[None], few, noise, like=found)
    np.testing.assert_allclose(again.mean[0], found.mean[0], atol=1e-6)  # where motion is linear few say the same


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


def test_chance_biases_no_product_of_two_ensembles():
    """Slopes of 1 with chance of variance 4: squares are 5, products 1; the gradient is that of the errors alone."""
    random, windows = np.random.default_rng(0), 4000
    errors = 0.3 + 0.1 * random.standard_normal((windows, 1))

    def side():
        chance = 2.0 * random.standard_normal((windows, 1, 1))
        return given(errors + 0.1 * chance[..., 0], 1.0 + chance)

    gradients, products, squares = products_of(side(), side(), np.ones(windows, bool), "linear")
    assert products.mean() == pytest.approx(1.0, abs=0.15)
    assert squares.mean() == pytest.approx(5.0, rel=0.1)
    assert gradients.mean() == pytest.approx(0.3, abs=0.05)  # with its own slopes an ensemble's would be 0.7
    np.testing.assert_allclose(agreed(np.array([[-1.0]]), np.array([[4.0]])), [[4.0 * instruments.AGREEING]])


def test_what_both_ensembles_agree_on_is_kept_along_a_weak_direction_too():
    """Two parameters that act alike but for a thousandth, and a third of which there is chance alone."""
    alike = np.array([[1.0, 1.0, 0.0], [1.0, 1.000001, 0.0], [0.0, 0.0, -0.5]])
    squares = alike + np.diag([0.0, 0.0, 2.5])
    expected = alike.copy()
    expected[2, 2] = 2.0 * instruments.AGREEING
    np.testing.assert_allclose(agreed(alike, squares), expected, atol=1e-9)


def test_a_window_of_chance_alone_does_not_decide():
    """Of thirty windows one has slopes a thousand times as large as the others'."""
    slopes = np.random.default_rng(0).standard_normal((30, 8, 2))
    slopes[0] *= 1000.0
    side = given(np.ones((30, 8)), slopes)
    gradients, products, squares = products_of(side, side, np.ones(30, bool), "linear")
    shares = shares_of(squares)
    np.testing.assert_allclose(shares.sum(0), np.eye(2), atol=1e-6)
    np.testing.assert_allclose(products, squares)  # one ensemble agrees with itself
    told = np.trace(shares, axis1=1, axis2=2) / 2.0
    assert told[0] == told.max() <= 1.05 * instruments.LARGEST_SHARE
    less = gradients[0] / slopes[0].sum(0)
    assert less[0] == pytest.approx(less[1]) and less[0] < 1e-4
    np.testing.assert_allclose(gradients[1:], slopes[1:].sum(1))


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


@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_the_gradient_at_the_truth_is_none_though_chance_is_shared(loss):
    """Errors are noise and an ensemble's chance, which is also in its own slopes, a tenth of a range wide."""
    random, shape = np.random.default_rng(0), (2000, 10)
    noise = random.standard_normal(shape)

    def side():
        here, there = 0.5 * random.standard_normal((2, *shape))
        return given(noise + here, (3.0 + (there - here) / 0.1)[..., None])

    gradients, *_ = products_of(side(), side(), np.ones(len(noise), bool), loss)
    assert abs(gradients.mean()) < 3.0 * gradients.std() / np.sqrt(len(gradients))


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
    monkeypatch.setattr(filtering, "touched", lambda problem, states, known, rows, horizon: np.arange(len(rows)) < 8)
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
    log = problem, Readings.at(problem.dataset, problem.states, rows, steps, change), rows
    sides = [Side.of(*log, point, spread, search.noise, 16, np.random.default_rng(number)) for number in (0, 1)]
    for side in sides:
        np.testing.assert_allclose(side.apart, [[0.2, 0.2], [-0.2, 0.1]])  # both ends of 1 +- 0.2 and of 1 +- 0.1
        np.testing.assert_allclose(side.aside, [0.0, -0.075])
        assert side.few.shape[1] == instruments.FEW
    assert (sides[0].few != sides[1].few).any()


def test_predictions_leave_errors_alike_only_where_windows_agree():
    """Errors of one channel that are noise, of a second that lasts, and of a third that lasts in one window."""
    random = np.random.default_rng(0)
    errors = random.standard_normal((1, 40, 30, 3))
    errors[..., 1] += 1.5 * random.standard_normal((1, 40, 1))
    found = known(errors)
    clipped = np.clip(errors[0, ..., 1], -3.0, 3.0)
    pairs = (clipped[:, 1:] * clipped[:, :-1]).mean(1) / (clipped**2).mean()
    assert found.alike() == pytest.approx(pairs.mean() - 2.0 * pairs.std(ddof=1) / np.sqrt(40))
    assert 0.4 < found.alike() < 0.6
    errors[..., 1], errors[0, 0, :, 2] = errors[..., 0], 2.9
    assert replace(found).alike() < 0.1  # the third has a correlation of 0.2 that one window makes


@pytest.mark.parametrize(("above", "below", "mean"), [(0.1, -0.1, 2.01), (0.1, -0.3, 2.03)])
def test_errors_are_the_mean_over_both_ends_and_lead_back_to_the_point(above, below, mean):
    """By hand: errors 2 + 3 p + p², whose mean at a standard error of 0.1 is 2 + 0.1².

    A line through both ends of a parabola passes the point too high by their product.
    """
    point, *ends = (known(np.array(2.0 + 3.0 * p + p**2).reshape(1, 1, 1, 1)) for p in (0.0, above, below))
    errors = np.concatenate([each.mean for each in ends])
    both = replace(point, mean=errors, whole=np.ones((2, 1), bool), members=errors)
    apart, aside = np.array([[above - below]]), np.array([(above + below) / 2.0])
    side = Side(np.zeros((1, 1, 1)), point, both, apart, aside)
    np.testing.assert_allclose(side.slopes(), [[[3.0 + above + below]]])
    np.testing.assert_allclose(side.errors(), [[mean]])
    np.testing.assert_allclose(side.found.counted(side.found.whitened[0]), [[2.0]])


def test_steps_are_judged_by_what_chance_makes_of_as_many():
    """By hand: half of all normal values are within 0.6745, and half of all pairs within 1.0518 = z((1 + √½) / 2)."""
    two = np.array([0.1, -2.1036])
    assert instruments.moved_by(np.array([0.6745]), np.ones(1)) == pytest.approx(1.0, rel=1e-4)
    assert instruments.moved_by(two, np.array([1.0, 2.0])) == pytest.approx(1.0, rel=1e-4)
    np.testing.assert_allclose(instruments.beyond_chance(two, np.eye(2), 4), two)
    values = np.array([[1.0, 0.0], [-1.0, 0.0], [1.0, 2.0], [-1.0, 2.0]] * 4)  # T² of (0, 16): 16² / (16 / 15 · 16)
    shorter = instruments.beyond_chance(values.sum(0), values.T @ values, 16) / 16.0
    np.testing.assert_allclose(shorter, [0.0, (1.0 - 2.0 * 15.0 / 12.0 / 15.0) ** 0.5])
    assert not instruments.beyond_chance(np.array([0.1, -0.1]), np.eye(2), 16).any()


def test_an_epoch_at_rest_tells_what_half_the_ensemble_errs_and_moves_nothing(tmp_path):
    problem = problem_of_foot(tmp_path)
    search = of_contacts(problem, jax.random.key(0))
    assert (search.blocks, len(search.rows)) == (1, 42)
    told = np.broadcast_to(np.eye(2), (len(search.rows), 2, 2))
    truth = problem.simulator.parameters.to_unit(problem.simulator.parameters.vector(FOOT_TRUTH))
    rest = replace(search, point=truth, wide=3, quiet=1, together=filtering.TOGETHER, squares=told)
    assert rest.at_rest and not rest.settled and rest.members == filtering.MEMBERS // 2
    (after, _), spent = counted(filtering.step, problem, rest, "cauchy")
    assert after.settled
    np.testing.assert_array_equal(after.point, rest.point)
    assert not rest.apart.any() and after.apart.all() and after.chance.all()
    known_well = replace(after, apart=np.array([1.0, 2.0]), compared=0, products=1e3 * told, squares=1e3 * told)
    covariance = known_well.found.uncertainty.covariance  # of one gradient alone, as there was no scatter before
    np.testing.assert_allclose(covariance, np.array([[1.0, 2.0], [2.0, 4.0]]) / (1e3 * len(told)) ** 2)
    systems = filtering.MEMBERS + 2 * 2 * len(problem.simulator.parameters) * instruments.FEW
    large = filtering.LARGE_ROUNDS * filtering.LARGE * search.size
    assert spent == (systems * len(search.rows) + large) * filtering.horizon_of(problem)


def test_only_what_a_larger_ensemble_loses_too_counts_as_lost(tmp_path, monkeypatch):
    problem = problem_of_foot(tmp_path)
    search = of_contacts(problem, jax.random.key(0))
    told = np.broadcast_to(np.eye(2), (len(search.rows), 2, 2))
    rest = replace(search, wide=3, quiet=1, together=filtering.TOGETHER, squares=told)
    asked = []

    def by_hand(found, loss):
        """An ensemble loses the third window and the fifth, and fails in the sixth; a larger one loses the fifth."""
        asked.append(len(found.mean[0]))
        costs = np.full(search.size, 0.5)
        costs[[2, 4, 5]] = 9.0, 9.0, np.inf
        return costs if len(asked) == 1 else np.array([0.5, 7.0, np.inf])

    monkeypatch.setattr(filtering, "surprises", by_hand)
    (after, _), spent = counted(filtering.step, problem, rest, "cauchy")
    assert asked == [search.size, 3]
    assert after.cost == pytest.approx((0.5 * (search.size - 2) + 7.0) / (search.size - 1))
    systems = filtering.MEMBERS + 2 * 2 * len(problem.simulator.parameters) * instruments.FEW
    large = filtering.LARGE * (filtering.LARGE_ROUNDS * search.size + filtering.LARGER * 3)
    assert spent == (systems * len(search.rows) + large) * filtering.horizon_of(problem)
    one = known(np.array([[[[2.0], [0.0]], [[1.0], [0.0]]]]))  # of two windows of two readings, one channel
    failed = replace(one, whole=np.array([[True, False]]))
    np.testing.assert_allclose(instruments.surprises(failed, "linear"), [2.0, np.inf])


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
    far = replace(near, quiet=1, moved=filtering.NEAR)
    fresh_start, _ = filtering.step(problem, far, "cauchy")
    assert fresh_start.together == 0 and not fresh_start.gradients[32:].any()
