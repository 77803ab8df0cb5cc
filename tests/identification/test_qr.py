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


@pytest.mark.parametrize("rows", [4, 30 * BLOCK + 1])
def test_thin_qr_is_a_decomposition_into_orthonormal_columns(rows: int) -> None:
    matrices = np.random.default_rng(0).standard_normal((2, rows, 4))
    basis, factor = thin_qr(matrices)
    np.testing.assert_allclose(basis @ factor, matrices, atol=1e-12)
    np.testing.assert_allclose(np.swapaxes(basis, 1, 2) @ basis, np.stack([np.eye(4)] * 2), atol=1e-12)
    assert not np.tril(factor, -1).any()
