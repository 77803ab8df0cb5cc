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
from scipy.optimize import lsq_linear

from madoc.identification.linearisation import Linearisation, WindowSlopes
from madoc.identification.losses import Loss, loss_slope

_SHORTEST = 1e-3
"""Least length of a state's column, relative to the window's longest; a value with a shorter one is kept where it is.

Between 0 and 1: a value that no observation shows must not move far.
"""


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
    *,
    limit: float = 1.0,
) -> Float[np.ndarray, " d"]:
    """The p that minimises ‖R p + Qᵀr‖² + λ ‖D p‖² with `unit` + p in [-limit, limit].

    D is the length of each column of R, Marquardt's scaling, with a floor for columns that are nearly 0.
    """
    lengths = np.linalg.norm(factor, axis=0)
    lengths = np.maximum(lengths, 1e-6 * max(float(lengths.max()), 1e-12))
    rows = np.concatenate([factor, np.diag(np.sqrt(damping) * lengths)])
    wanted = np.concatenate([-target, np.zeros(len(unit))])
    step = lsq_linear(rows, wanted, bounds=(-limit - unit, limit - unit), method="bvls").x
    return np.clip(unit + step, -limit, limit) - unit


@dataclass(frozen=True)
class Eliminated:
    """What is left for the parameters once initial states are eliminated, and how the states follow them.

    Attributes:
        reduced: Weighted residuals and derivatives that no initial state of their window can explain.
        spare: 1 - leverage of each value: the share of its noise that its window's initial state does not absorb.
        response: R⁻¹ Qᵀ (r, Jθ): minus the states' step is its first column plus the others times the parameters' step.
    """

    reduced: Linearisation
    spare: Float[np.ndarray, "windows values"]
    response: Float[np.ndarray, "windows n 1+d"]

    def states_step(self, step: Float[np.ndarray, " d"]) -> Float[np.ndarray, "windows n"]:
        """The states' step that goes with a step of the parameters: -C⁻¹ (Jsᵀ r + Bᵀ p)."""
        return -(self.response[..., 0] + self.response[..., 1:] @ step)


def eliminate(
    slopes: WindowSlopes, weights: Float[np.ndarray, "windows values"], damping: Float[np.ndarray, " windows"]
) -> Eliminated:
    """Project every window on what its initial state cannot explain.

    Args:
        slopes: Residuals and derivatives.
        weights: Of each squared residual.
        damping: λ of each window: its state's step is that of ‖r + Js p‖² + λ ‖D p‖², D the lengths of the columns.
    """
    windows, values, states = slopes.by_states.shape
    root = np.sqrt(weights)[..., None]
    by_states = root * slopes.by_states
    lengths = np.linalg.norm(by_states, axis=1)
    lengths = np.maximum(lengths, np.maximum(_SHORTEST * lengths.max(-1, keepdims=True), np.finfo(float).tiny ** 0.25))
    damped = np.zeros((windows, states, states))
    damped[:, np.arange(states), np.arange(states)] = np.sqrt(damping)[:, None] * lengths
    basis, factor = np.linalg.qr(np.concatenate([by_states, damped], axis=1))
    others = root * np.concatenate([slopes.residuals[..., None], slopes.by_parameters], axis=-1)
    padded = np.concatenate([others, np.zeros((windows, states, others.shape[-1]))], axis=1)
    within = np.swapaxes(basis, 1, 2) @ padded
    left = padded - basis @ within
    return Eliminated(
        reduced=Linearisation(left[..., 0], left[..., 1:]),
        spare=1.0 - (basis[:, :values] ** 2).sum(-1),
        response=np.linalg.solve(factor, within),
    )
