"""Derivatives of residuals by differences, whose points are simulated in one batch by `replay`."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

DIFFERENCE = 1e-4
"""Half width of a central difference in [-1, 1], and width of a one-sided one. Truncation errors are 1e-8 of the third
derivative and 5e-5 of the second; rounding of next states (1e-16, and the solver's 1e-10 at contacts) divided by it is
below 1e-6 of a typical derivative."""
TORN = 0.5
"""Difference of the one-sided derivatives relative to the larger one, above which a value jumps or bends there."""

LEAST_CURVATURE = 0.5
"""Curvature of a loss over that of its weighted squares; where it is smaller, residuals are not noise, and a step by it
would be too long."""


@dataclass(frozen=True)
class Linearisation:
    """Residuals at a point, in typical changes of a channel, and their derivatives by parameters in [-1, 1].

    Windows whose simulation failed are left out.
    """

    residuals: Float[np.ndarray, "windows values"]
    jacobian: Float[np.ndarray, "windows values d"]

    def of(self, kept: Bool[np.ndarray, " windows"]) -> "Linearisation":
        """These windows alone."""
        return Linearisation(self.residuals[kept], self.jacobian[kept])

    def where(self, kept: Bool[np.ndarray, " windows"]) -> "Linearisation":
        """All windows, with zeros in those that are not kept."""
        part = kept[:, None]
        return Linearisation(np.where(part, self.residuals, 0.0), np.where(part[..., None], self.jacobian, 0.0))


@dataclass(frozen=True)
class WindowSlopes:
    """Residuals of windows at a point, and their derivatives there by parameters and by each window's initial state.

    Attributes:
        residuals: Residuals in typical changes of a channel, or in standard deviations of its noise.
        by_parameters: Derivatives by parameters in [-1, 1].
        by_states: Derivatives by the window's own initial state, in standard deviations of each value over the log.
        whole: Windows in which no simulation failed; the others are 0 everywhere.
    """

    residuals: Float[np.ndarray, "windows values"]
    by_parameters: Float[np.ndarray, "windows values d"]
    by_states: Float[np.ndarray, "windows values n"]
    whole: Bool[np.ndarray, " windows"]

    @property
    def finite(self) -> Bool[np.ndarray, " windows"]:
        """Windows in which no simulation failed and every derivative is finite."""
        return self.whole & np.isfinite(self.by_parameters).all((1, 2))

    def over(self, deviation: Float[np.ndarray, " values"]) -> "WindowSlopes":
        """Residuals and derivatives divided by the deviation of each value."""
        wide = deviation[:, None]
        return WindowSlopes(self.residuals / deviation, self.by_parameters / wide, self.by_states / wide, self.whole)

    def curved(self, share: float) -> "WindowSlopes":
        """Residuals divided by the curvature of their loss over that of its weighted squares, a share in (0, 1].

        A Gauss-Newton step of the weighted squares is then Newton's step of the loss (Huber 1981, section 7.8). Without
        it each step leaves the same share of the way, a fifth under noise.
        """
        return replace(self, residuals=self.residuals / max(share, LEAST_CURVATURE))

    def at(self, residuals: Float[np.ndarray, "windows values"]) -> "WindowSlopes":
        """The same derivatives with the residuals of a point nearby, NaN in windows whose simulation fails there."""
        whole = self.whole & np.isfinite(residuals).all(-1)
        part = whole[:, None]
        return WindowSlopes(
            np.where(part, residuals, 0.0),
            np.where(part[..., None], self.by_parameters, 0.0),
            np.where(part[..., None], self.by_states, 0.0),
            whole,
        )


def difference_points(point: Float[np.ndarray, " d"], width: float = DIFFERENCE) -> Float[np.ndarray, "points d"]:
    """The point itself, then each parameter in turn higher by a width, then lower, never outside the box."""
    shift = width * np.eye(len(point))
    return np.clip(np.concatenate([point[None], point + shift, point - shift]), -1.0, 1.0)


def one_sided_points(point: Float[np.ndarray, " d"]) -> Float[np.ndarray, "points d"]:
    """The point itself, then each parameter in turn a little nearer the middle of its range."""
    return np.concatenate([point[None], point - DIFFERENCE * np.diag(np.where(point > 0.0, 1.0, -1.0))])


def linearise(
    points: Float[np.ndarray, "points d"], residuals: Float[np.ndarray, "points windows values"]
) -> Linearisation:
    """Differences between `difference_points`, one-sided where the box ends, or `one_sided_points`."""
    whole: Bool[np.ndarray, " windows"] = np.isfinite(residuals).all((0, 2))
    seen = residuals[:, whole]
    return Linearisation(seen[0], np.moveaxis(_differences(points, seen), 0, -1))


def slopes_of_windows(
    points: Float[np.ndarray, "points d"],
    by_points: Float[np.ndarray, "points windows values"],
    by_shifts: Float[np.ndarray, "n windows values"],
    widths: Float[np.ndarray, " physical"],
) -> WindowSlopes:
    """Derivatives by parameters and by initial states; the latter are one-sided.

    `by_points` are residuals at a point alone, at its `difference_points`, or at its `one_sided_points`.
    `by_shifts` are those at the first point, with each value of the initial states in turn moved by its width.
    """
    whole = np.isfinite(by_points).all((0, 2)) & np.isfinite(by_shifts).all((0, 2))
    with np.errstate(invalid="ignore"):
        by_states = (by_shifts - by_points[0]) / widths[: len(by_shifts), None, None]
        parts = (by_points[0], _differences(points, by_points), by_states)
    residuals, by_parameters, by_states = (np.where(whole[:, None], part, 0.0) for part in parts)
    return WindowSlopes(residuals, np.moveaxis(by_parameters, 0, -1), np.moveaxis(by_states, 0, -1), whole)


def _differences(
    points: Float[np.ndarray, "points d"], residuals: Float[np.ndarray, "points windows values"]
) -> Float[np.ndarray, "derivatives windows values"]:
    """Differences of residuals divided by those of the points: d of them, or none for a point without neighbours.

    With a neighbour on either side they are central. Where a contact begins between a point and its neighbour, a
    difference across it says nothing of the slope, and one window's would outweigh all others: of central and one-sided
    derivatives the smallest is taken there.
    """
    if len(points) == 1 + points.shape[1]:
        return (residuals[1:] - residuals[0]) / np.diagonal(points[1:] - points[0])[:, None, None]
    count = len(points) // 2
    here, above, below = residuals[0], residuals[1 : count + 1], residuals[count + 1 :]
    to_above = np.diagonal(points[1 : count + 1] - points[0])[:, None, None]
    to_below = np.diagonal(points[0] - points[count + 1 :])[:, None, None]
    central = (above - below) / (to_above + to_below)
    inside = np.minimum(to_above, to_below) > 0.5 * DIFFERENCE  # at an end of the box one width is about 0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ahead, behind = (above - here) / to_above, (here - below) / to_below
        torn = np.abs(ahead - behind) > TORN * np.maximum(np.abs(ahead), np.abs(behind))
    one_sided = np.where(np.abs(ahead) < np.abs(behind), ahead, behind)
    return np.where(inside & torn & (np.abs(one_sided) < np.abs(central)), one_sided, central)
