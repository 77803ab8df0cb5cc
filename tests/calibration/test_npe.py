"""Neural posterior estimation: equations by hand, and calibration on a simulator whose posterior is known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from affine import affine
from madoc import simulation
from madoc.calibration import CalibrationProblem, Npe
from madoc.calibration.baselines.npe.moments import (
    Cosines,
    Emulator,
    Reader,
    Sets,
    by_halves,
    emulation_loss,
    errors_of,
    less_noisy,
    moments,
    moved,
)
from madoc.calibration.baselines.npe.posterior import (
    Belief,
    Regression,
    doubts,
    posterior_samples,
    prior_belief,
    truncated_box,
)
from madoc.data import Disturbance, disturb
from robots import ARM_TRUTH, recorded, two_link_arm

KEY = jax.random.key(0)


def emulator():
    """One parameter, one signal, a window of one value w: m = 2 w, J = 3 + w, log v = log 4."""
    outputs = affine([[2.0], [1.0], [0.0]], [0.0, 3.0, np.log(4.0)])
    one = jnp.ones(1)
    return Emulator(outputs, 0.0 * one, one, one, 0.0 * one, one)


def test_the_loss_by_hand():
    # At w = 1, u = 0.5: expected 2 + 4 / 2 = 4, the error of 6 is 2, so ½ (4 / 4 + log 4), times √4.
    loss = emulation_loss(emulator(), jnp.array([[1.0]]), jnp.array([[6.0]]), jnp.array([[0.5]]))
    assert float(loss) == pytest.approx(2.0 * 0.5 * (1.0 + np.log(4.0)))


def test_another_box_changes_the_units_and_not_what_is_expected():
    there = moved(emulator(), np.array([0.4]), np.array([0.2]))
    mean, slopes, _ = there.parts(jnp.array([[1.0]]))
    assert (float(mean[0, 0]), float(slopes[0, 0, 0])) == pytest.approx((2.0 + 4.0 * 0.4, 4.0 * 0.2))
    assert float(there.point(jnp.array([[0.5]]))[0, 0]) == pytest.approx(0.5)
    rows = jnp.array([[1.0]]), jnp.array([[6.0]]), jnp.array([[0.5]])
    assert float(emulation_loss(there, *rows)) == pytest.approx(float(emulation_loss(emulator(), *rows)))


def test_moments_of_pairs_by_hand():
    # Rows w = 0 and 1 with y = 2 and 6: errors y - m are 2 and 4, J is 3 and 4, v is 4; a third row does not count.
    window, following = jnp.array([[[0.0], [1.0], [9.0]]]), jnp.array([[[2.0], [6.0], [9.0]]])
    values, slopes, rows = moments(emulator(), window, following, jnp.array([[1.0, 1.0, 0.0]]), None)
    np.testing.assert_allclose(values, [[(3 * 2 / 4 + 4 * 4 / 4) / 2, (2 / 2 + 4 / 2) / 2]], rtol=1e-6)
    np.testing.assert_allclose(slopes, [[[(9 / 4 + 16 / 4) / 2], [(3 / 2 + 4 / 2) / 2]]], rtol=1e-6)
    assert float(rows[0]) == 2.0


def test_moments_without_pairs_do_not_depend_on_them():
    features = Cosines(jnp.array([[2.0]]), jnp.array([0.3]))
    window, ratio = jnp.array([[[0.1], [0.2], [0.4]]]), jnp.array([0.5])
    after = np.array([0.3, -0.1, 0.7])  # standardised next observations: s + ratio y

    def of(after):
        following = jnp.asarray((after - np.asarray(window[0, :, 0])) / 0.5, jnp.float32)[None, :, None]
        return moments(emulator(), window, following, jnp.ones((1, 3)), (features, ratio))

    values, slopes, _ = of(after)
    for again in of(after[[2, 0, 1]])[:2], (values, slopes):
        np.testing.assert_allclose(again[0], values, atol=1e-6)
        np.testing.assert_allclose(again[1], slopes, atol=1e-6)
    w = np.array([0.1, 0.2, 0.4])
    expected = w + 0.5 * 2.0 * w
    step = 0.5 * (3.0 + w)
    wanted = [(after - expected).mean(), np.sqrt(2) * (np.cos(2 * after + 0.3) - np.cos(2 * expected + 0.3)).mean()]
    np.testing.assert_allclose(values[0], wanted, atol=1e-6)
    sloping = [step.mean(), (-2 * np.sqrt(2) * np.sin(2 * expected + 0.3) * step).mean()]
    np.testing.assert_allclose(slopes[0, :, 0], sloping, atol=1e-6)


def test_sets_are_joined_by_their_rows():
    sets = Sets(np.array([[1.0], [4.0]]), np.array([[[2.0]], [[5.0]]]), np.array([1.0, 2.0]))
    whole = sets.joined(0)
    assert (whole.values.item(), whole.slopes.item(), whole.rows.item()) == pytest.approx((3.0, 4.0, 3.0))
    np.testing.assert_allclose(errors_of(sets, np.array([[0.5], [1.0]])), [[0.0], [-1.0]])


def test_a_log_is_read_by_hand():
    # J = 2, W = 1: (4 + 3)⁻¹ 2 (T - bias); what is left of T - bias is squared.
    reader = Reader(np.array([[2.0]]), np.array([0.5]), np.array([[1.0]]))
    assert reader.statistic(np.array([4.0])).item() == pytest.approx(1.0)
    assert float(reader.misfit(np.array([4.0]))) == pytest.approx((3.5 - 2.0) ** 2)


def test_sampling_noise_is_taken_out_and_the_rest_stays():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (4000, 2))
    noise, lasting = np.diag([0.09, 0.01]), np.diag([0.16, 0.04])
    statistics = points + rng.multivariate_normal(np.zeros(2), noise + lasting, 4000)
    left = less_noisy(statistics, points, noise, 0.0)
    np.testing.assert_allclose(np.cov((left - points).T), lasting, atol=0.015)
    np.testing.assert_allclose(less_noisy(statistics, points, noise, 1.0), statistics, atol=1e-9)


def test_a_regression_is_undone_by_its_residuals():
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (200, 3))
    statistics = points @ rng.normal(size=(3, 3)) + 0.1 * rng.normal(size=(200, 3))
    regression = Regression.of(statistics, points)
    residuals = regression.residuals(statistics, points)
    np.testing.assert_allclose(np.cov(residuals.T), np.eye(3), atol=0.05)
    np.testing.assert_allclose(regression.points(statistics[7], residuals[7:8])[0], points[7], atol=1e-9)


def test_the_box_is_cut_off_about_the_posterior_and_stays_in_the_prior():
    samples = np.stack([np.linspace(-0.1, 0.1, 1001), np.linspace(0.9, 1.0, 1001), np.linspace(-1, 1, 1001)], axis=-1)
    low, high = truncated_box(samples, 2.0, 0.15)
    np.testing.assert_allclose(low, [-0.198, 0.7, -1.0], atol=1e-6)
    np.testing.assert_allclose(high, [0.198, 1.0, 1.0], atol=1e-6)


def test_what_an_estimate_is_doubted_for():
    names = ("mass", "damping")
    assert "larger budget" in doubts(prior_belief(2), names)[0]
    narrow = Belief(np.zeros(2), 0.01 * np.eye(2), np.zeros((2, 2)), 1.0, 2.0, 3)
    assert doubts(narrow, names) == ()
    (far,) = doubts(replace(narrow, misfit=3.0), names)
    assert "farther from the estimate's simulations" in far
    (wide,) = doubts(replace(narrow, covariance=np.diag([0.33, 0.01])), names)
    assert "as wide as the range of mass" in wide


def analytic(rng, point, rows):
    """Moments of `rows` rows y = J u + noise, J = (1, ½), in two halves."""
    slopes = np.array([[1.0, 0.0], [0.0, 0.5], [0.5, 0.5]])
    values = slopes @ point + rng.normal(size=(2, 3)) / np.sqrt(rows / 2)
    return Sets(values, np.broadcast_to(slopes, (2, 3, 2)), np.full(2, rows / 2))


def test_ranks_of_the_truth_among_samples_are_uniform():
    """Simulation-based calibration (Talts et al. 2018) on a linear and normal simulator."""
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (200, 2))
    draws = [analytic(rng, point, 20.0) for point in points]
    halves = jax.tree.map(lambda *parts: np.stack(parts), *draws)
    ranks = []
    for trial in range(60):
        truth = rng.uniform(-1, 1, 2)
        logged = analytic(rng, truth, 20.0).joined(0)
        samples, *_ = posterior_samples(
            halves,
            points,
            logged,
            jax.random.fold_in(KEY, trial),
            layers=2,
            width=8,
            updates=80,
            learning_rate=1e-3,
            count=99,
        )
        ranks.append((samples < truth).sum(0))
    counts = np.stack([np.bincount(np.array(ranks)[:, k] // 20, minlength=5) for k in range(2)])
    # Chi-squared of five bins with 12 expected in each: beyond 18.5 once in a thousand.
    assert (((counts - 12.0) ** 2 / 12.0).sum(1) < 18.5).all()


def test_rows_of_a_draw_are_parted_whole():
    part = np.arange(2 * 1 * 3).reshape(2, 1, 3)  # steps, draws, rows
    np.testing.assert_array_equal(by_halves(part), [[[0, 3], [1, 4]]])


@pytest.mark.slow
@pytest.mark.parametrize("shuffled", ["none", "next_observations"])
def test_it_recovers_an_arm(shuffled):
    task = two_link_arm()
    log = disturb(recorded(task, ARM_TRUTH, 4000, KEY), Disturbance(shuffled=shuffled), task, KEY)
    problem = CalibrationProblem(replace(log, true_parameters=None), simulation.make(task, threads=1))
    method = Npe(hidden=(64, 64), draws=20, epochs=4, cloning_epochs=10)
    state, spent = method.init(problem, KEY), 0
    while spent < 40_000:
        state, epoch = method.step(problem, state)
        spent += epoch.control_steps
    estimate = method.estimate(problem, state)
    space = task.parameters
    error = np.abs(estimate.mean - space.vector(ARM_TRUTH)) / (space.high - space.low)
    assert estimate.settled
    assert error.mean() < 0.05
