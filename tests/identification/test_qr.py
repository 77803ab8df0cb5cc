"""QR decompositions in blocks."""

import numpy as np
import pytest

from madoc.identification.qr import BLOCK, thin_qr, triangle


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
