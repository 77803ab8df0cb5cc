"""Initial states as further unknowns, one a window, eliminated before the parameters are solved for.

The normal matrix of shared parameters θ and windows' states s is a block arrow: windows meet only in θ. Projecting
each window's residuals and slopes on what its own state cannot explain is its Schur complement

    A - B C⁻¹ Bᵀ with A = Jθᵀ Jθ, B = Jθᵀ Js, C = Jsᵀ Js (weighted),

and what is left is a least-squares problem of θ alone (Triggs et al. 2000, Bundle Adjustment, section 6).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from madoc.identification.linearisation import Linearisation

_FLOOR = 1e-3
"""Least length of a state's column, relative to the window's longest: what no reading shows stays where it is."""


@dataclass(frozen=True)
class WindowSlopes:
    """Residuals of windows at a point, and their slopes there.

    Attributes:
        residuals: In deviations of each channel's noise.
        by_parameters: Their derivatives by parameters in [-1, 1].
        by_states: Their derivatives by the window's own initial state, in units of each value's spread.
        whole: Windows in which no simulation failed; the others are 0 everywhere.
    """

    residuals: Float[np.ndarray, "windows values"]
    by_parameters: Float[np.ndarray, "windows values d"]
    by_states: Float[np.ndarray, "windows values n"]
    whole: Bool[np.ndarray, " windows"]

    def over(self, deviation: Float[np.ndarray, " values"]) -> "WindowSlopes":
        """The same in other units."""
        wide = deviation[:, None]
        return WindowSlopes(self.residuals / deviation, self.by_parameters / wide, self.by_states / wide, self.whole)


@dataclass(frozen=True)
class Eliminated:
    """What is left for the parameters, and how the states follow them.

    Attributes:
        reduced: Weighted residuals and slopes that no state of its window can explain.
        spare: 1 - leverage of each value: the share of its noise that its window's state does not absorb.
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
        slopes: Residuals and slopes.
        weights: Of each squared residual.
        damping: λ of each window: its state's step is that of ‖r + Js p‖² + λ ‖D p‖², D the lengths of the columns.
    """
    windows, values, states = slopes.by_states.shape
    root = np.sqrt(weights)[..., None]
    by_states = root * slopes.by_states
    lengths = np.linalg.norm(by_states, axis=1)
    lengths = np.maximum(lengths, np.maximum(_FLOOR * lengths.max(-1, keepdims=True), np.finfo(float).tiny ** 0.25))
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
