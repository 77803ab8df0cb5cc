"""Slopes of residuals by central differences; `window_residuals` simulates all of their points in one batch."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

DIFFERENCE = 1e-4
"""Half width of a central difference in [-1, 1].

Its truncation error falls with the square, 1e-8 of the third derivative; rounding of next states (1e-16, and 1e-10
at contacts, where MuJoCo's solver stops) divided by it stays below 1e-6 of a typical slope.
"""


@dataclass(frozen=True)
class Linearisation:
    """Residuals at a point and their slopes there; windows in which a simulation failed are left out.

    Attributes:
        residuals: In units of each channel's typical change.
        jacobian: Their derivatives by parameters in [-1, 1].
    """

    residuals: Float[np.ndarray, "windows values"]
    jacobian: Float[np.ndarray, "windows values d"]

    def of(self, kept: Bool[np.ndarray, " windows"]) -> "Linearisation":
        """Of these windows alone."""
        return Linearisation(self.residuals[kept], self.jacobian[kept])

    def where(self, kept: Bool[np.ndarray, " windows"]) -> "Linearisation":
        """Of these windows, the others 0 everywhere."""
        part = kept[:, None]
        return Linearisation(np.where(part, self.residuals, 0.0), np.where(part[..., None], self.jacobian, 0.0))


def difference_points(unit: Float[np.ndarray, " d"]) -> Float[np.ndarray, "points d"]:
    """The point itself, then each parameter in turn a little higher, then a little lower, never outside the box."""
    shift = DIFFERENCE * np.eye(len(unit))
    return np.clip(np.concatenate([unit[None], unit + shift, unit - shift]), -1.0, 1.0)


def linearise(
    points: Float[np.ndarray, "points d"], residuals: Float[np.ndarray, "points windows values"]
) -> Linearisation:
    """Central differences between `difference_points`; one-sided where the box ends."""
    count = points.shape[1]
    width = np.diagonal(points[1 : count + 1] - points[count + 1 :])
    whole: Bool[np.ndarray, " windows"] = np.isfinite(residuals).all((0, 2))
    seen = residuals[:, whole]
    slopes = (seen[1 : count + 1] - seen[count + 1 :]) / width[:, None, None]
    return Linearisation(seen[0], np.moveaxis(slopes, 0, -1))
