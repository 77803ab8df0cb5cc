"""One damped Gauss-Newton step within the box (Levenberg 1944, Marquardt 1963), unknown initial states eliminated.

The normal matrix of shared parameters θ and windows' initial states s is a block arrow: windows meet only in θ.
Projecting each window's residuals and derivatives on what its own state cannot explain is its Schur complement

    A - B C⁻¹ Bᵀ with A = Jθᵀ Jθ, B = Jθᵀ Js, C = Jsᵀ Js (weighted),

and what is left is a least-squares problem of θ alone (Triggs et al. 2000, Bundle Adjustment, section 6). Where initial
states are known nothing is eliminated; where parameters are known, d is 0 and the states' step is all there is.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from madoc.identification.linearisation import Linearisation, WindowSlopes, difference_points, linearise
from madoc.identification.losses import Loss, loss_slope, scale_of
from madoc.identification.replay import window_residuals
from madoc.identification.windows import Windows
from madoc.simulation.base import Simulator

BLOCK = 128
"""Number of rows of a block, larger than the number of columns of most problems."""
FIRST_DAMPING = 1e-2
"""Damping of the first step of a search, relative to the squared lengths of the columns."""
TRIALS = (1e-2, 1.0, 1e2)
"""Factors of the last damping that helped, which are tried at once."""
DAMPING = 1e-6
"""Relative damping of a step near the minimum; 0 is none."""
LEAST_DAMPING = 1e-9
"""Relative damping of initial states whose steps need none, far below the rounding of their differences."""


def triangle(matrix: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "columns columns"]:
    """R of the QR decomposition, for a matrix of any number of rows; missing rows count as zeros."""
    columns = matrix.shape[1]
    if not len(matrix):
        return np.zeros((columns, columns))
    rows = max(BLOCK, 2 * columns)
    while len(matrix) > 2 * rows:
        blocks = _padded(matrix, rows).reshape(-1, rows, columns)
        matrix = np.asarray(np.linalg.qr(blocks, mode="r")).reshape(-1, columns)
    return np.asarray(np.linalg.qr(_padded(matrix, max(1, columns)), mode="r"))


def thin_qr(
    matrices: Float[np.ndarray, "stack rows columns"],
) -> tuple[Float[np.ndarray, "stack rows columns"], Float[np.ndarray, "stack columns columns"]]:
    """Q and R of each matrix of a stack by two Cholesky decompositions (Yamamoto et al. 2015, CholeskyQR2).

    The columns of each matrix, taken to the same length, must have a condition number of at most 10^7, as those of a
    damped problem have. Q is then orthonormal to rounding, and two products of matrices take less than half of the time
    of Householder's reflections.

    Raises:
        numpy.linalg.LinAlgError: The columns of a matrix are nearer to linear dependence, or not finite.
    """
    lengths = np.linalg.norm(matrices, axis=1, keepdims=True)
    lengths[lengths == 0.0] = 1.0
    basis, factor = matrices / lengths, np.eye(matrices.shape[2])
    for _ in range(2):
        part = np.linalg.cholesky(np.swapaxes(basis, 1, 2) @ basis, upper=True)
        basis, factor = basis @ np.linalg.inv(part), part @ factor
    return basis, factor * lengths


def _padded(matrix: Float[np.ndarray, "rows columns"], multiple: int) -> Float[np.ndarray, "more columns"]:
    """The matrix with rows of zeros below it, so that its number of rows is a multiple."""
    missing = -len(matrix) % multiple
    return np.concatenate([matrix, np.zeros((missing, matrix.shape[1]))]) if missing else matrix


_SHORTEST = 1e-3
"""Smallest length of a state value's column of derivatives, relative to the longest column of its window, in (0, 1).

A shorter column is treated as this long, so that a value that hardly shows in any observation does not move far.
"""


def triangular_factors(
    around: Linearisation, scale: float, loss: Loss
) -> tuple[Float[np.ndarray, "d d"], Float[np.ndarray, " d"]]:
    """R and Qᵀr of the QR decomposition of √ρ' (J, r) / √values, from which steps of any damping are computed."""
    count = around.jacobian.shape[-1]
    residuals = around.residuals.reshape(-1)
    jacobian = around.jacobian.reshape(-1, count)
    root = np.sqrt(loss_slope((residuals / scale) ** 2, loss) / max(1, len(residuals)))
    factor = triangle(root[:, None] * np.column_stack([jacobian, residuals]))
    return factor[:count, :count], factor[:count, count]


def damped_step(
    factor: Float[np.ndarray, "d d"],
    target: Float[np.ndarray, " d"],
    point: Float[np.ndarray, " d"],
    damping: float,
    *,
    limit: float = 1.0,
) -> Float[np.ndarray, " d"]:
    """The p that minimises ‖R p + Qᵀr‖² + λ ‖D p‖² with `point` + p in [-limit, limit].

    D is the length of each column of R, Marquardt's scaling, with a floor for columns that are nearly 0.
    """
    from scipy.optimize import lsq_linear  # 35 MB, and a listing of a suite does not need it

    lengths = np.linalg.norm(factor, axis=0)
    lengths = np.maximum(lengths, 1e-6 * max(float(lengths.max()), 1e-12))
    rows = np.concatenate([factor, np.diag(np.sqrt(damping) * lengths)])
    wanted = np.concatenate([-target, np.zeros(len(point))])
    step = lsq_linear(rows, wanted, bounds=(-limit - point, limit - point), method="bvls").x
    return np.clip(point + step, -limit, limit) - point


def descend(
    simulator: Simulator,
    windows: Windows,
    start: Float[np.ndarray, " d"],
    scale: Float[np.ndarray, " observation"],
    *,
    steps: int,
    loss: Loss,
    damping: float,
    limit: float = 1.0,
    shortest: float = 0.0,
) -> tuple[list[Linearisation], Float[np.ndarray, "steps d"]]:
    """Take Gauss-Newton steps from `start` on windows whose initial states are known.

    There are at most `steps` of them. They end early where every simulation fails, and after a step whose components
    are all smaller than `shortest`.

    Returns:
        The linearisation before each step, and the point after it.
    """
    linearisations, visited, point = [], list[Float[np.ndarray, " d"]](), start
    for _ in range(steps):
        points = difference_points(point)
        around = linearise(points, window_residuals(simulator, windows, points, scale))
        if not len(around.residuals):
            break
        factors = triangular_factors(around, scale_of(around.residuals, loss), loss)
        step = damped_step(*factors, point, damping, limit=limit)
        point = point + step
        linearisations.append(around)
        visited.append(point)
        if np.abs(step).max() < shortest:
            break
    return linearisations, np.array(visited).reshape(-1, len(start))


@dataclass(frozen=True)
class Eliminated:
    """The least-squares problem of the parameters alone, and how the initial states follow the parameters.

    Attributes:
        reduced: Weighted residuals and derivatives, projected on what no initial state of their window can explain.
        response: R⁻¹ Qᵀ (r, Jθ), from which `states_step` is computed.
        basis: Q, with the rows of the damping below.
        root: Square roots of the weights.
    """

    reduced: Linearisation
    response: Float[np.ndarray, "windows n columns"]
    basis: Float[np.ndarray, "windows rows n"]
    root: Float[np.ndarray, "windows values 1"]

    def states_step(self, step: Float[np.ndarray, " d"]) -> Float[np.ndarray, "windows n"]:
        """The states' step that goes with a step of the parameters: -C⁻¹ (Jsᵀ r + Bᵀ p)."""
        return -(self.response[..., 0] + self.response[..., 1:] @ step)

    def projected(
        self, columns: Float[np.ndarray, "windows values columns"]
    ) -> Float[np.ndarray, "windows rows columns"]:
        """Other columns, weighted and projected as the reduced ones are."""
        padded = _weighted(self.root, columns, self.basis.shape[2])
        return padded - self.basis @ (np.swapaxes(self.basis, 1, 2) @ padded)


def states_basis(
    by_states: Float[np.ndarray, "windows values n"], damping: Float[np.ndarray, " windows"] | float = LEAST_DAMPING
) -> tuple[Float[np.ndarray, "windows rows n"], Float[np.ndarray, "windows n n"]]:
    """Q and R of every window's derivatives by its initial state, with rows below for the damping √λ D.

    What a window's initial state explains of its residuals is Q Qᵀ r, of which the first `values` rows are meant.
    """
    windows, _, states = by_states.shape
    lengths = _lengths(np.linalg.norm(by_states, axis=1))
    damped = np.zeros((windows, states, states))
    damped[:, np.arange(states), np.arange(states)] = np.sqrt(np.broadcast_to(damping, windows))[:, None] * lengths
    return thin_qr(np.concatenate([by_states, damped], axis=1))


def left_by_states(
    slopes: WindowSlopes,
) -> tuple[Float[np.ndarray, "windows values"], Float[np.ndarray, "windows values"]]:
    """What initial states cannot explain of the residuals, and 1 - leverage: the share of noise that they leave."""
    basis = explicable(slopes)
    return left_by(basis, slopes.residuals), spare_of(basis)


def explicable(slopes: WindowSlopes) -> Float[np.ndarray, "windows values n"]:
    """Orthonormal columns that span what initial states explain of each window's residuals, to first order."""
    return states_basis(slopes.by_states)[0][:, : slopes.residuals.shape[1]]


def left_by(
    basis: Float[np.ndarray, "windows values n"], residuals: Float[np.ndarray, "windows values"]
) -> Float[np.ndarray, "windows values"]:
    """What is left of residuals without their projection on these orthonormal columns."""
    return residuals - (basis @ (np.swapaxes(basis, 1, 2) @ residuals[..., None]))[..., 0]


def spare_of(basis: Float[np.ndarray, "windows values n"]) -> Float[np.ndarray, "windows values"]:
    """1 - leverage of each value: the share of its noise that these orthonormal columns do not absorb."""
    return 1.0 - (basis**2).sum(-1)


def states_steps(
    slopes: WindowSlopes,
    weights: Float[np.ndarray, "windows values"],
    dampings: Float[np.ndarray, "trials windows"],
) -> Float[np.ndarray, "trials windows n"]:
    """Every window's step of its initial state alone, for each damping, as `Eliminated.states_step` of no parameters.

    The normal equations are solved. A damping of `LEAST_DAMPING` or more, which they must have, bounds their condition,
    so that a step is right to about 10^-5 of its length.
    """
    weighted = np.swapaxes(np.sqrt(weights)[..., None] * slopes.by_states, 1, 2)
    normal = weighted @ np.swapaxes(weighted, 1, 2)
    slope = (weighted @ (np.sqrt(weights) * slopes.residuals)[..., None])[..., 0]
    damped, lengths = _damped(normal, dampings)
    return -np.linalg.solve(damped, (slope / lengths)[..., None])[..., 0] / lengths


def states_errors(by_states: Float[np.ndarray, "windows values n"]) -> Float[np.ndarray, "windows n"]:
    """Standard errors of every window's initial state, for residuals in standard deviations of their noise."""
    damped, lengths = _damped(np.swapaxes(by_states, 1, 2) @ by_states, np.full(len(by_states), LEAST_DAMPING))
    return np.sqrt(np.diagonal(np.linalg.inv(damped), axis1=-2, axis2=-1)) / lengths


def _damped(
    normal: Float[np.ndarray, "windows n n"], damping: Float[np.ndarray, "*trials windows"]
) -> tuple[Float[np.ndarray, "*trials windows n n"], Float[np.ndarray, "windows n"]]:
    """Normal matrices of columns of length 1 with a relative damping, and the lengths that the columns had."""
    lengths = _lengths(np.sqrt(np.diagonal(normal, axis1=-2, axis2=-1)))
    alike = normal / (lengths[:, :, None] * lengths[:, None, :])
    return alike + damping[..., None, None] * np.eye(normal.shape[-1]), lengths


def _lengths(found: Float[np.ndarray, "windows n"]) -> Float[np.ndarray, "windows n"]:
    """Lengths of the columns by which damping is measured: none is far shorter than its window's longest."""
    return np.maximum(found, np.maximum(_SHORTEST * found.max(-1, keepdims=True), np.finfo(float).tiny ** 0.25))


def eliminate(
    slopes: WindowSlopes,
    weights: Float[np.ndarray, "windows values"],
    damping: Float[np.ndarray, " windows"] | float = LEAST_DAMPING,
) -> Eliminated:
    """Project every window's residuals and derivatives on what its initial state cannot explain.

    `weights` are those of the squared residuals. A window's state step p minimises ‖r + Js p‖² + λ ‖D p‖², with its
    `damping` λ and the columns' lengths D.
    """
    root = np.sqrt(weights)[..., None]
    basis, factor = states_basis(root * slopes.by_states, damping)
    columns = np.concatenate([slopes.residuals[..., None], slopes.by_parameters], axis=-1)
    padded = _weighted(root, columns, slopes.by_states.shape[2])
    within = np.swapaxes(basis, 1, 2) @ padded
    left = padded - basis @ within
    return Eliminated(
        reduced=Linearisation(left[..., 0], left[..., 1:]),
        response=np.linalg.solve(factor, within),
        basis=basis,
        root=root,
    )


def _weighted(
    root: Float[np.ndarray, "windows values 1"], columns: Float[np.ndarray, "windows values columns"], below: int
) -> Float[np.ndarray, "windows rows columns"]:
    """The weighted columns with so many rows of zeros below."""
    windows, _, count = columns.shape
    return np.concatenate([root * columns, np.zeros((windows, below, count))], axis=1)
