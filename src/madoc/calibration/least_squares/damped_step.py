"""One damped Gauss-Newton step within the box (Levenberg 1944, Marquardt 1963)."""

import numpy as np
from jaxtyping import Float
from scipy.optimize import lsq_linear

from madoc.identification.linearisation import Linearisation
from madoc.identification.losses import Loss, loss_slope


def triangular_factors(
    around: Linearisation, scale: float, loss: Loss
) -> tuple[Float[np.ndarray, "d d"], Float[np.ndarray, " d"]]:
    """R and Qᵀr of the weighted problem √ρ' (J, r), divided by √values: all that a step needs of the residuals."""
    count = around.jacobian.shape[-1]
    residuals = around.residuals.reshape(-1)
    jacobian = around.jacobian.reshape(-1, count)
    root = np.sqrt(loss_slope((residuals / scale) ** 2, loss) / max(1, len(residuals)))
    # Zero rows keep the factor square where there are fewer values than parameters.
    stacked = np.concatenate([root[:, None] * np.column_stack([jacobian, residuals]), np.zeros((count + 1, count + 1))])
    factor = np.asarray(np.linalg.qr(stacked, mode="r"))
    return factor[:count, :count], factor[:count, count]


def damped_step(
    factor: Float[np.ndarray, "d d"],
    target: Float[np.ndarray, " d"],
    unit: Float[np.ndarray, " d"],
    damping: float,
) -> Float[np.ndarray, " d"]:
    """The p that minimises ‖R p + Qᵀr‖² + λ ‖D p‖² with `unit` + p in [-1, 1].

    D is the length of each column of R, Marquardt's scaling, with a floor for columns that are nearly 0.
    """
    lengths = np.linalg.norm(factor, axis=0)
    lengths = np.maximum(lengths, 1e-6 * max(float(lengths.max()), 1e-12))
    rows = np.concatenate([factor, np.diag(np.sqrt(damping) * lengths)])
    wanted = np.concatenate([-target, np.zeros(len(unit))])
    step = lsq_linear(rows, wanted, bounds=(-1.0 - unit, 1.0 - unit), method="bvls").x
    return np.clip(unit + step, -1.0, 1.0) - unit
