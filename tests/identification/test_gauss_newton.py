"""QR decompositions in blocks."""

import numpy as np
import pytest

from madoc.identification.gauss_newton import (
    BLOCK,
    damped_step,
    eliminate,
    left_by_states,
    states_errors,
    states_steps,
    thin_qr,
    triangle,
    triangular_factors,
)
from madoc.identification.linearisation import WindowSlopes
from madoc.identification.losses import TUNING, curvature_share, loss_slope


@pytest.mark.parametrize("rows", [0, 1, 3, BLOCK, 5 * BLOCK + 7])
def test_triangle_has_the_matrix_s_products(rows: int) -> None:
    matrix = np.random.default_rng(rows).standard_normal((rows, 3))
    factor = triangle(matrix)
    assert factor.shape == (3, 3) and not np.tril(factor, -1).any()
    np.testing.assert_allclose(factor.T @ factor, matrix.T @ matrix, atol=1e-12 * rows)


@pytest.mark.parametrize("damping", [1e-9, 1.0])
def test_thin_qr_is_a_decomposition_into_orthonormal_columns(damping: float) -> None:
    """Two of the four columns are the same but for their lengths, so that damping alone tells them apart."""
    matrices = np.random.default_rng(0).standard_normal((2, 100, 4)) * [1e-6, 1.0, 1.0, 1e6]
    matrices[..., 2] = 1e3 * matrices[..., 1]
    lengths = np.linalg.norm(matrices, axis=1)
    damped = np.sqrt(damping) * lengths[:, None] * np.eye(4)
    matrices = np.concatenate([matrices, damped], axis=1)
    basis, factor = thin_qr(matrices)
    np.testing.assert_allclose((basis @ factor - matrices) / lengths[:, None], 0.0, atol=1e-14)
    np.testing.assert_allclose(np.swapaxes(basis, 1, 2) @ basis, np.stack([np.eye(4)] * 2), atol=1e-14)
    assert not np.tril(factor, -1).any()


def test_thin_qr_refuses_dependent_columns() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        thin_qr(np.ones((1, 100, 3)))


NOTHING = np.zeros(1)


def slopes_of(residuals, by_parameters, by_states):
    parts = (np.asarray(part, np.float64) for part in (residuals, by_parameters, by_states))
    return WindowSlopes(*parts, whole=np.ones(len(residuals), dtype=bool))


def test_what_a_state_explains_is_taken_out():
    # One window of two readings, one state value that moves both alike: what is left is their difference, and a
    # parameter that moved both alike is left without a say.
    slopes = slopes_of([[3.0, 1.0]], [[[1.0, 2.0], [0.0, 2.0]]], [[[1.0], [1.0]]])
    found = eliminate(slopes, np.ones((1, 2)), NOTHING)
    np.testing.assert_allclose(found.reduced.residuals[0, :2], [1.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(found.reduced.jacobian[0, :2], [[0.5, 0.0], [-0.5, 0.0]], atol=1e-12)
    np.testing.assert_allclose(left_by_states(slopes)[1], [[0.5, 0.5]], atol=1e-9)
    # The state makes up for the mean of the residuals, 2, and for what the parameters' step has moved it by.
    np.testing.assert_allclose(found.states_step(np.zeros(2)), [[-2.0]], atol=1e-12)
    np.testing.assert_allclose(found.states_step(np.array([1.0, 1.0])), [[-4.5]], atol=1e-12)


def test_eliminated_and_joint_solutions_are_the_same():
    random = np.random.default_rng(0)
    windows, values, count, states = 5, 8, 3, 2
    slopes = slopes_of(
        random.normal(size=(windows, values)),
        random.normal(size=(windows, values, count)),
        random.normal(size=(windows, values, states)),
    )
    weights = random.uniform(0.5, 2.0, (windows, values))
    found = eliminate(slopes, weights, np.zeros(windows))
    reduced = found.reduced.jacobian.reshape(-1, count)
    step = np.linalg.lstsq(reduced, -found.reduced.residuals.reshape(-1), rcond=None)[0]
    whole = np.zeros((windows * values, count + windows * states))
    whole[:, :count] = slopes.by_parameters.reshape(-1, count)
    for window in range(windows):
        own = slice(count + window * states, count + (window + 1) * states)
        whole[window * values : (window + 1) * values, own] = slopes.by_states[window]
    root = np.sqrt(weights).reshape(-1)
    joint = np.linalg.lstsq(root[:, None] * whole, -root * slopes.residuals.reshape(-1), rcond=None)[0]
    np.testing.assert_allclose(step, joint[:count], atol=1e-10)
    np.testing.assert_allclose(found.states_step(step), joint[count:].reshape(windows, states), atol=1e-10)


def test_a_state_that_nothing_shows_stays_where_it_is():
    slopes = slopes_of([[3.0, 1.0]], [[[1.0], [0.0]]], [[[1.0, 0.0], [1.0, 0.0]]])
    found = eliminate(slopes, np.ones((1, 2)), np.full(1, 1e-9))
    np.testing.assert_allclose(found.states_step(np.zeros(1)), [[-2.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize("damping", [1e-3, 1.0, 1e3])
def test_damping_shortens_a_states_step(damping):
    slopes = slopes_of([[3.0, 1.0]], [[[1.0], [0.0]]], [[[1.0], [1.0]]])
    found = eliminate(slopes, np.ones((1, 2)), np.array([damping]))
    np.testing.assert_allclose(found.states_step(np.zeros(1)), [[-4.0 / (2.0 + 2.0 * damping)]])


@pytest.mark.parametrize("damping", [1e-9, 1.0])
def test_states_alone_are_stepped_and_left_out_as_beside_parameters(damping):
    """One state value hardly shows, and two of the four nearly act alike."""
    random = np.random.default_rng(0)
    by_states = random.standard_normal((3, 50, 4)) * [1.0, 1e-5, 1e3, 1.0]
    by_states[..., 3] = by_states[..., 0] + 1e-3 * by_states[..., 3]
    slopes = slopes_of(random.standard_normal((3, 50)), np.zeros((3, 50, 0)), by_states)
    weights, each = random.uniform(0.5, 2.0, (3, 50)), np.full(3, damping)
    wanted = eliminate(slopes, weights, each)
    steps = states_steps(slopes, weights, np.stack([each, 1e3 * each]))
    np.testing.assert_allclose(steps[0], wanted.states_step(np.zeros(0)), rtol=1e-4)
    np.testing.assert_allclose(steps[1], eliminate(slopes, weights, 1e3 * each).states_step(np.zeros(0)), rtol=1e-4)
    alike = eliminate(slopes, np.ones((3, 50)))
    left, spare = left_by_states(slopes)
    np.testing.assert_allclose(left, alike.reduced.residuals[:, :50], atol=1e-12)
    np.testing.assert_allclose(spare, 1.0 - (alike.basis[:, :50] ** 2).sum(-1), atol=1e-12)


def test_the_error_of_a_state_that_two_readings_show():
    assert states_errors(np.array([[[1.0], [3.0]]])) == pytest.approx(1.0 / np.sqrt(1.0 + 9.0))


def test_newtons_step_of_a_loss_ends_at_its_minimum_where_one_of_weighted_squares_leaves_a_fifth_of_the_way():
    random = np.random.default_rng(0)
    by_parameters, noise = random.standard_normal((500, 9, 2)), random.standard_normal((500, 9))
    by_states = random.standard_normal((500, 9, 1))
    start, left = np.array([0.2, -0.1]), {}
    for newton in (False, True):
        point, way = start, []
        for _ in range(20):
            slopes = WindowSlopes(noise + by_parameters @ point, by_parameters, by_states, np.ones(500, bool))
            z = (slopes.residuals / TUNING["cauchy"]) ** 2
            curved = slopes.curved(curvature_share(z, "cauchy")) if newton else slopes
            reduced = eliminate(curved, loss_slope(z, "cauchy"), np.zeros(500)).reduced
            point = point + damped_step(*triangular_factors(reduced, 1.0, "linear"), point, 0.0)
            way.append(point)
        left[newton] = np.linalg.norm(way[0] - way[-1]) / np.linalg.norm(start - way[-1])
    assert left[False] == pytest.approx(0.2, abs=0.05)
    assert left[True] < 0.05
