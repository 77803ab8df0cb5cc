"""Least squares by hand: losses, steps, covariance, and what the data cannot tell."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import simulation
from madoc.calibration import CalibrationProblem, LeastSquares, calibrate
from madoc.data import Disturbance, disturb
from madoc.errors import MadocError
from madoc.identification import losses
from madoc.identification.gauss_newton import damped_step, triangular_factors
from madoc.identification.information import (
    BOX_VARIANCE,
    at_least_noise,
    bread,
    correlated_pairs,
    half_width,
    identifiability,
    jackknife_meat,
    least_share,
    meat,
    sandwich,
)
from madoc.identification.linearisation import (
    DIFFERENCE,
    Linearisation,
    difference_points,
    linearise,
)
from madoc.identification.replay import window_residuals
from madoc.identification.windows import windows_at
from madoc.parameters import Parameter
from robots import SPRING_TRUTH, CountingSimulator, recorded, spring

ROBUST = ("huber", "soft-l1", "cauchy")


@pytest.mark.parametrize(
    ("loss", "value", "slope", "curvature"),
    [
        ("linear", 4.0, 1.0, 1.0),
        ("huber", 3.0, 0.5, 0.0),
        ("soft-l1", 2.0 * (5.0**0.5 - 1.0), 5.0**-0.5, 5.0**-1.5),
        ("cauchy", np.log(5.0), 0.2, -3.0 / 25.0),
    ],
)
def test_losses_of_a_residual_twice_the_scale(loss, value, slope, curvature):
    z = np.array([4.0])
    assert losses.loss_value(z, loss) == pytest.approx(value)
    assert losses.loss_slope(z, loss) == pytest.approx(slope)
    assert losses.loss_curvature(z, loss) == pytest.approx(curvature)


@pytest.mark.parametrize("loss", losses.TUNING)
def test_slope_and_curvature_are_the_derivatives_of_the_loss(loss):
    residual, small = np.array([0.3, 0.9, 1.7]), 1e-6

    def cost(r):
        return 0.5 * losses.loss_value(r**2, loss)

    def psi(r):
        return losses.loss_slope(r**2, loss) * r

    np.testing.assert_allclose(
        (cost(residual + small) - cost(residual - small)) / (2 * small), psi(residual), rtol=1e-6
    )
    slope = (psi(residual + small) - psi(residual - small)) / (2 * small)
    np.testing.assert_allclose(slope, losses.loss_curvature(residual**2, loss), rtol=1e-6, atol=1e-9)


def test_the_scale_is_the_deviation_that_the_median_speaks_of():
    residuals = np.array([-1.0, 2.0, -3.0, 4.0, 1e9])
    assert losses.scale_of(residuals, "linear") == 1.0
    assert losses.scale_of(residuals, "cauchy") == pytest.approx(2.385 * 1.4826 * 3.0)
    assert losses.scale_of(np.zeros(4), "huber") > 0.0


def test_where_most_residuals_are_zero_the_largest_tenth_speaks():
    size = np.concatenate([np.zeros(80), np.full(20, 0.5)])
    assert losses.robust_deviation(size) == pytest.approx(0.2 * 0.5 / 1.644854)
    assert losses.robust_deviation(1e6 * size) == pytest.approx(0.2 / 1.644854)  # no noise is larger than a step
    assert losses.robust_deviation(np.full(10, 2.0)) == pytest.approx(1.4826 * 2.0)


def test_a_window_that_failed_costs_as_much_as_the_worst():
    residuals = np.array([[1.0, 1.0], [2.0, 2.0], [np.nan, 0.0]])
    assert losses.mean_cost(residuals, 1.0, "linear") == pytest.approx((1.0 + 4.0 + 4.0) / 3.0)
    assert losses.mean_cost(np.full((2, 1), np.nan), 1.0, "linear") == losses.ALL_FAILED


def at(jacobian, residuals):
    return Linearisation(np.array(residuals, float), np.array(jacobian, float))


def test_the_factors_hold_the_normal_equations():
    around = at([[[1.0, 2.0], [0.0, 3.0]], [[4.0, 0.0], [1.0, 1.0]]], [[1.0, -1.0], [2.0, 0.5]])
    factor, target = triangular_factors(around, 1.0, "linear")
    jacobian, residuals = around.jacobian.reshape(4, 2), around.residuals.reshape(4)
    np.testing.assert_allclose(factor.T @ factor, jacobian.T @ jacobian / 4)
    np.testing.assert_allclose(factor.T @ target, jacobian.T @ residuals / 4)


def test_a_large_residual_weighs_less_under_a_robust_loss():
    around = at([[[1.0]], [[1.0]]], [[0.0], [3.0]])
    steps = {loss: damped_step(*triangular_factors(around, 1.0, loss), np.zeros(1), 0.0)[0] for loss in losses.TUNING}
    assert steps["linear"] == pytest.approx(-1.0)  # -1.5 ends at the box
    assert steps["cauchy"] == pytest.approx(-3.0 * 0.1 / 1.1)


@pytest.mark.parametrize(("damping", "start", "step"), [(0.0, 0.0, -1.0), (1.0, 0.0, -0.5), (0.0, -0.8, -0.2)])
def test_a_damped_step_by_hand(damping, start, step):
    # |2 p + 2|² + λ |2 p|² is least at p = -1 / (1 + λ), and the box ends at -1.
    moved = damped_step(np.array([[2.0]]), np.array([2.0]), np.array([start]), damping)
    assert moved == pytest.approx([step])


def test_a_parameter_at_the_end_of_its_range_leaves_the_others_free():
    # Least at p = (-3, 0.5) without bounds; with p1 at -1 the other makes up for it: 2 p2 = 2 + p1 -> 0.5.
    factor = np.array([[1.0, 0.0], [-1.0, 2.0]])
    moved = damped_step(factor, np.array([3.0, -2.0]), np.zeros(2), 0.0)
    assert moved == pytest.approx([-1.0, 0.5])


def test_central_differences_are_one_sided_where_the_box_ends():
    unit = np.array([1.0, 0.0])
    points = difference_points(unit)
    assert (np.abs(points) <= 1.0).all()
    assert points[1] == pytest.approx(unit)
    assert points[4, 1] == -DIFFERENCE
    residuals = (points[:, :1] * 3.0 + points[:, 1:] ** 2)[:, None]
    found = linearise(points, residuals)
    np.testing.assert_allclose(found.residuals, [[3.0]])
    np.testing.assert_allclose(found.jacobian, [[[3.0, 0.0]]], atol=1e-9)


def test_an_end_of_the_box_within_rounding_is_no_jump():
    points = difference_points(np.array([1.0 - 1e-16]))
    np.testing.assert_allclose(linearise(points, 3.0 * points[:, None]).jacobian, [[[3.0]]])


def test_a_jump_beside_the_point_is_no_slope():
    points = difference_points(np.zeros(1))
    slope, jump = 2.0 * points[:, 0], np.where(points[:, 0] > 0.5 * DIFFERENCE, 7.0, 0.0)
    found = linearise(points, np.stack([slope, slope + jump, slope - jump], axis=-1)[:, None])
    np.testing.assert_allclose(found.jacobian[0, :, 0], [2.0, 2.0, 2.0])


def test_windows_that_failed_under_any_parameter_are_left_out_of_the_slopes():
    points = difference_points(np.zeros(1))
    residuals = np.zeros((3, 2, 1))
    residuals[2, 0] = np.nan
    assert len(linearise(points, residuals).residuals) == 1


def test_all_slopes_come_from_one_batch():
    task = spring()
    log = recorded(task, SPRING_TRUTH, 50, jax.random.key(0))
    simulator = CountingSimulator(simulation.make(task, threads=1))
    rows = np.arange(4)
    windows = windows_at(log, log.transitions.observation[rows], rows, 3)
    truth = task.parameters.to_unit(task.parameters.vector(SPRING_TRUTH))
    residuals = window_residuals(simulator, windows, difference_points(truth), np.ones(2))
    assert residuals.shape == (7, 4, 6)
    assert simulator.rows == 7 * 4 * 3
    np.testing.assert_allclose(residuals[0], 0.0, atol=1e-12)


def test_a_scatter_below_rounding_is_not_told_and_no_variance_is_negative():
    found = sandwich(np.diag([1.0, 1e-9]), np.diag([0.1, -1e-17]))
    np.testing.assert_allclose(np.diag(found.covariance), [0.1, BOX_VARIANCE])
    np.testing.assert_allclose(np.abs(found.unidentified), [[0.0, 1.0]])
    nothing = sandwich(np.diag([1.0, 1e-9]), np.zeros((2, 2)))
    np.testing.assert_array_equal(nothing.covariance, np.zeros((2, 2)))


def test_the_sandwich_of_a_mean_is_its_standard_error():
    residuals = np.array([[1.0], [-2.0], [0.5], [0.5]])
    around = at(np.ones((4, 1, 1)), residuals)
    found = sandwich(bread(around, 1.0, "linear"), meat(around, 1.0, "linear") * 0.1)
    # Σ r² / (n - 1) / n, a tenth of it so that it is below the box's variance.
    assert found.covariance[0, 0] == pytest.approx(0.1 * 5.5 / 3 / 4)
    assert not len(found.unidentified)


def test_the_jackknife_of_a_mean_is_its_standard_error():
    around = at(np.ones((4, 1, 1)), np.array([[1.0], [2.0], [4.0], [-7.0]]))
    bread = np.array([[4.0]])
    covariance = sandwich(bread, jackknife_meat(around, 1.0, bread)).covariance
    # The variance of the values, 70 / 3, over their number.
    np.testing.assert_allclose(jackknife_meat(around, 1.0, bread) / 16.0, [[70.0 / 3.0 / 4.0]])
    assert covariance[0, 0] == pytest.approx(1.0 / 3.0)  # wider than the box


def test_a_window_that_weighs_much_shows_how_far_it_has_drawn():
    # Two values at slope 1, one at slope 2: B = 6, g = (1, 1, -2); left out, δ = g / (5, 5, 2).
    around = at(np.array([[[1.0]], [[1.0]], [[2.0]]]), np.array([[1.0], [1.0], [-1.0]]))
    found = jackknife_meat(around, 1.0, np.array([[6.0]]))
    np.testing.assert_allclose(found / 36.0, [[2.0 / 3.0 * (0.04 + 0.04 + 1.0)]])


def test_windows_that_scatter_too_little_by_chance():
    bread, meat_of_windows = np.diag([2.0, 4.0]), np.diag([1.0, 16.0])
    # C = (1/4, 1) by windows, (1/2, 1/4) by noise.
    np.testing.assert_allclose(at_least_noise(meat_of_windows, bread, 1.0), np.diag([0.5 * 4.0, 1.0 * 16.0]))


def test_a_parameter_that_no_or_one_window_tells_narrows_no_other():
    # The second changes nothing; the third is told by one window, without scatter: noise gives it 1/4.
    bread, meat_of_windows = np.diag([2.0, 0.0, 4.0]), np.diag([16.0, 0.0, 0.0])
    found = at_least_noise(meat_of_windows, bread, 1.0)
    np.testing.assert_allclose(found, np.diag([16.0, 0.0, 0.25 * 16.0]))
    np.testing.assert_allclose(at_least_noise(np.zeros((3, 3)), bread, 0.5), 0.5 * bread)


def test_values_of_one_window_count_as_one_piece_of_evidence():
    alone = at(np.ones((4, 1, 1)), [[0.1], [-0.2], [0.05], [0.05]])
    repeated = at(np.ones((4, 3, 1)), np.repeat(alone.residuals, 3, axis=1))
    first, second = (sandwich(bread(part, 1.0, "linear"), meat(part, 1.0, "linear")) for part in (alone, repeated))
    assert first.covariance == pytest.approx(second.covariance)


def test_where_cauchys_tails_prevail_the_weights_stand_in_for_the_curvature():
    around = at(np.ones((2, 1, 1)), [[3.0], [-3.0]])
    assert bread(around, 1.0, "cauchy")[0, 0] == pytest.approx(2 * 0.1)


def test_the_least_share_is_that_of_the_direction_a_part_tells_least_of():
    # Squares of slopes: of the first parameter 1, 1 and 2, of the second 4 in the last window alone.
    jacobian = np.array([[[1.0, 0.0], [0.0, 0.0]], [[1.0, 0.0], [0.0, 0.0]], [[1.0, 0.0], [1.0, 2.0]]])
    around = Linearisation(np.zeros((3, 2)), jacobian)
    assert least_share(around, around) == pytest.approx(1.0)
    assert least_share(around.of(np.array([True, True, False])), around) == pytest.approx(0.0, abs=1e-12)
    alike = Linearisation(np.zeros((4, 1)), np.ones((4, 1, 2)))  # tells of one direction only
    assert least_share(alike.of(np.array([True, False, False, False])), alike) == pytest.approx(0.25)


def test_the_interval_is_students():
    assert half_width(np.array([[4.0]]), windows=11) == pytest.approx([2.0 * 2.228], rel=1e-3)  # table of t, 10 degrees


def test_parameters_that_only_enter_as_a_sum_are_named_together():
    around = at([[[1.0, 1.0, 0.0]], [[2.0, 2.0, 0.0]], [[0.0, 0.0, 1.0]], [[0.0, 0.0, 2.0]]], np.full((4, 1), 1e-3))
    found = sandwich(bread(around, 1.0, "linear"), meat(around, 1.0, "linear"))
    np.testing.assert_allclose(np.abs(found.unidentified), [[0.5**0.5, 0.5**0.5, 0.0]], atol=1e-12)
    assert found.covariance[0, 0] == pytest.approx(1.0 / 6.0, rel=1e-3)  # half of the box's 1/3
    (sentence,) = identifiability(found, ("one", "two", "three"))
    assert sentence.startswith("the data does not identify one, two together")


def test_a_direction_known_worse_than_the_box_is_not_identified():
    noisy = at(1e-3 * np.ones((4, 1, 1)), [[1.0], [-1.0], [1.0], [-1.0]])
    found = sandwich(bread(noisy, 1.0, "linear"), meat(noisy, 1.0, "linear"))
    assert found.covariance[0, 0] == pytest.approx(1.0 / 3.0)
    assert identifiability(found, ("mass",)) == ("the data does not identify mass; leave it out or narrow its range",)


def test_correlated_pairs_are_named_strongest_first():
    correlation = np.array([[1.0, -0.99, 0.1], [-0.99, 1.0, 0.96], [0.1, 0.96, 1.0]])
    assert correlated_pairs(correlation, ("a", "b", "c")) == [("a", "b", -0.99), ("b", "c", 0.96)]


def spring_problem(*parameters, rows=400, disturbance=None, **changes):
    task = replace(spring(*parameters, max_episode_steps=100), **changes)
    everything = spring(max_episode_steps=100)
    log = recorded(everything, SPRING_TRUTH, rows, jax.random.key(7))
    if disturbance is not None:
        log = disturb(log, disturbance, everything, jax.random.key(8))
    return CalibrationProblem(log, simulation.make(task, threads=1))


def test_a_spring_of_unknown_scale_is_told():
    free = (
        Parameter("jnt_stiffness", "slide", 1.0, 9.0),
        Parameter("dof_damping", "slide", 0.0, 2.0),
        Parameter("body_mass", "cart", 1.0, 3.0),
        Parameter("actuator_gain", "push", 0.5, 1.5),
    )
    result = calibrate(LeastSquares(), spring_problem(*free), key=jax.random.key(0), budget=50_000)
    (warning,) = result.warnings
    assert warning.startswith("the data does not identify")
    # Twice of everything moves the same; the damping is a small part of that direction in these ranges.
    assert all(name in warning for name in ("jnt_stiffness.slide", "body_mass.cart", "actuator_gain.push"))


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_intervals_hold_the_truth_as_often_as_they_say(loss):
    task = spring(max_episode_steps=100)
    clean = recorded(task, SPRING_TRUTH, 300, jax.random.key(7))
    truth, simulator = task.parameters.vector(SPRING_TRUTH), simulation.make(task, threads=1)
    logged, held = clean.transitions, []
    for seed in range(100):
        noise = 0.02 * logged.next_observation.std(0) * np.random.default_rng(seed).standard_t(4, (300, 2))
        noisy = replace(clean, transitions=replace(logged, next_observation=logged.next_observation + noise))
        method = LeastSquares(loss=loss, searches=1)
        result = calibrate(method, CalibrationProblem(noisy, simulator), key=jax.random.key(seed), budget=100_000)
        spans = np.array([row.interval for row in result.parameters.values()])
        held.append((spans[:, 0] <= truth) & (truth <= spans[:, 1]))
    assert 0.91 < np.mean(held) < 0.99, np.mean(held, axis=0)


def test_permuted_parameters_permute_the_estimate():
    forward = spring_problem()
    space = forward.simulator.parameters
    backward = spring_problem(*space.parameters[::-1])
    first, second = (
        calibrate(LeastSquares(), part, key=jax.random.key(0), budget=50_000) for part in (forward, backward)
    )
    np.testing.assert_allclose(first.mean, second.mean[::-1], rtol=1e-9)
    assert first.error is None


def test_outliers_pull_a_robust_loss_less():
    problem = spring_problem(rows=1000)
    logged = problem.dataset.transitions
    following = np.array(logged.next_observation)
    following[::20] += 1.0
    bad = replace(problem.dataset, transitions=replace(logged, next_observation=following))
    truth = problem.simulator.parameters.vector(SPRING_TRUTH)
    far = {
        loss: np.abs(
            calibrate(
                LeastSquares(loss=loss),
                CalibrationProblem(bad, problem.simulator),
                key=jax.random.key(0),
                budget=90_000,
            ).mean
            - truth
        ).max()
        for loss in ("linear", *ROBUST)
    }
    assert all(far[loss] < 0.1 * far["linear"] for loss in ROBUST), far


def test_longer_windows_find_the_same():
    problem = spring_problem()
    result = calibrate(LeastSquares(horizon=5, windows=40), problem, key=jax.random.key(0), budget=50_000)
    assert result.mean == pytest.approx(problem.simulator.parameters.vector(SPRING_TRUTH), rel=1e-8)


def test_rows_whose_state_cannot_be_rebuilt_are_left_out():
    problem = spring_problem(rebuildable=lambda observation: observation[..., 0] > 0.0)
    assert 0 < len(problem.states.exact()[0]) < len(problem.dataset)
    result = calibrate(LeastSquares(), problem, key=jax.random.key(0), budget=50_000)
    assert result.mean == pytest.approx(problem.simulator.parameters.vector(SPRING_TRUTH), rel=1e-8)


def test_none_that_can_be_rebuilt_is_refused():
    problem = spring_problem(rebuildable=lambda observation: observation[..., 0] > 1e9)
    with pytest.raises(MadocError, match="none of the 400 logged states of spring can be rebuilt"):
        calibrate(LeastSquares(), problem, key=jax.random.key(0), budget=50_000)


@pytest.mark.parametrize(
    ("shuffled", "horizon", "sentence"),
    [
        ("next_observations", 1, "are shuffled; take a method that compares distributions"),
        ("rows", 2, "no stretch of 2 rows begins at a state that can be rebuilt"),
    ],
)
def test_shuffled_data_is_refused_where_it_makes_no_sense(shuffled, horizon, sentence):
    problem = spring_problem(disturbance=Disturbance(shuffled=shuffled))
    with pytest.raises(MadocError, match=sentence):
        calibrate(LeastSquares(horizon=horizon), problem, key=jax.random.key(0), budget=50_000)


def test_fewer_values_than_parameters_are_refused():
    problem = spring_problem(rows=1)
    with pytest.raises(
        MadocError, match="at least as many logged values as parameters, got 1 windows of 1 rows with 2"
    ):
        calibrate(LeastSquares(), problem, key=jax.random.key(0), budget=50_000)
