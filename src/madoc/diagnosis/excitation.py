"""How well a log can determine each parameter: expected intervals and correlations of estimates."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.data import Dataset, stride, typical_change
from madoc.data.findings import Finding
from madoc.identification.excitation import expected_half_widths
from madoc.identification.fitted_windows import fit_log, noise_of, windows_of
from madoc.identification.gauss_newton import descend
from madoc.identification.information import (
    Uncertainty,
    bread,
    correlated_pairs,
    half_width,
    identifiability,
    meat,
    sandwich,
)
from madoc.identification.linearisation import Linearisation, difference_points, linearise
from madoc.identification.replay import window_residuals
from madoc.identification.states import LoggedStates, probing_windows
from madoc.identification.windows import disjoint_windows, drawn, longest_fit, windows_at
from madoc.parameters import ParameterSpace
from madoc.simulation.base import Simulator
from madoc.simulation.response import mass_like

WINDOWS = {3: 300, 20: 60}
"""Largest number of windows, by their length in strides (`data.dataset.stride`). Long ones narrow the intervals where
sensors are noisy, short ones where the robot is chaotic."""
FEW = 100
"""Largest number of short windows where no intervals are wanted."""
FEWEST = 5
"""Windows beyond the number of parameters that are fitted where states are approximate."""
ROUNDS = 3
"""Number of linearisations, at least 1: from the best draw two steps reach the residuals that no parameters explain."""
INSIDE = 0.98
"""Largest |parameter| in [-1, 1] at which derivatives are taken, as there are none at, say, a mass of 0."""
_DAMPING = 1e-8
"""Marquardt's damping of a step, relative to the squared lengths of the columns: enough for unidentified directions."""
HIDDEN = 1e-2
"""If scaling all calibrated masses and forces by one factor changes the residuals by less than this share of what the
single parameters change them by (root of the sum of squares), the common scale counts as invisible. Masses that stay
fixed and weigh 1 % of the calibrated ones leave about this much."""
ALIGNED = 0.9
"""Cosine from which on two directions count as one."""
WIDE = 0.25
"""Share in [0, 1] of its range; a parameter whose expected interval has a larger half width is warned of."""


@dataclass(frozen=True)
class Excitation:
    """How well the log can determine each parameter at best.

    Attributes:
        effect: Change of an observation by half of the parameter's range, over the residual that no parameters
            explain; NaN where states are unknown, so that this residual cannot be computed.
        half_width: Half of the expected 95 % interval, in physical units; NaN likewise.
        pairs: Parameters whose estimates would be correlated: two names and the correlation.
        sentences: Which parameters, alone or together, cannot be determined.
        only_ratios: Whether all masses and forces that are calibrated can be scaled alike without a trace.
    """

    effect: Float[np.ndarray, " d"]
    half_width: Float[np.ndarray, " d"]
    pairs: tuple[tuple[str, str, float], ...]
    sentences: tuple[str, ...]
    only_ratios: bool


def excite(
    dataset: Dataset,
    simulator: Simulator,
    logged: LoggedStates,
    *,
    start: Float[np.ndarray, " d"],
    key: PRNGKeyArray,
    intervals: bool = True,
) -> Excitation:
    """Expected intervals from derivatives of residuals over windows of the log that do not overlap.

    A few Gauss-Newton steps go from `start`, in [-1, 1], to where residuals are those that no parameters explain. The
    expected intervals take these for noise. Of short and long windows, those with the narrower intervals count; where
    no `intervals` are wanted, short ones alone tell what cannot be determined, in a fraction of the time.
    """
    lengths = WINDOWS if intervals else {min(WINDOWS): FEW}
    of_length = [_excited(dataset, simulator, logged, start=start, windows=each, key=key) for each in lengths.items()]
    spans = simulator.parameters.high - simulator.parameters.low
    widths = [np.nan_to_num(each.half_width / spans, nan=1.0).mean() for each in of_length]
    return of_length[int(np.argmin(widths))]


def _excited(
    dataset: Dataset,
    simulator: Simulator,
    logged: LoggedStates,
    *,
    start: Float[np.ndarray, " d"],
    windows: tuple[int, int],
    key: PRNGKeyArray,
) -> Excitation:
    """As `excite`, over windows of one length in strides, so many at most."""
    space, (states, rows) = simulator.parameters, logged.exact()
    steps = longest_fit(dataset, rows, windows[0] * stride(dataset))
    disjoint = disjoint_windows(dataset, rows, steps, gap=0)
    chosen, available = drawn(disjoint, windows[1], key), len(disjoint)
    replayed = windows_at(dataset, states[chosen], rows[chosen], steps)
    first = np.clip(start, -0.9 * INSIDE, 0.9 * INSIDE)
    linearisations, visited = descend(
        simulator,
        replayed,
        first,
        typical_change(dataset, simulator.task.attitudes),
        steps=ROUNDS,
        loss="linear",
        damping=_DAMPING,
        limit=INSIDE,
    )
    if not linearisations:
        nothing = np.full(len(space), np.nan)
        sentence = f"the simulation fails in all {len(replayed)} stretches tried; look at the ranges and the states"
        return Excitation(nothing, nothing, (), (sentence,), False)
    at = int(np.argmin([(each.residuals**2).mean() for each in linearisations]))
    best, point = linearisations[at], (first, *visited)[at]
    more = max(1.0, available / len(best.residuals))  # windows of the whole log for each of these
    certainty = sandwich(more * bread(best, 1.0, "linear"), more * meat(best, 1.0, "linear"))
    noise = max(float(np.sqrt((best.residuals**2).mean())), np.finfo(float).tiny)
    effect = np.sqrt((best.jacobian**2).mean((0, 1))) / noise
    half = (space.high - space.low) / 2.0 * half_width(certainty.covariance, available)
    return _excitation(effect, half, certainty, best, point, space)


def excite_unknown(dataset: Dataset, simulator: Simulator, logged: LoggedStates, *, intervals: bool) -> Excitation:
    """Which estimates would correlate, where the log's states are not exact, and intervals where they are approximate.

    Those are the narrowest that the log allows where parameters and initial states fit some of its windows best, with
    what is left there for noise; NaN where states are unknown, or no `intervals` are wanted.
    """
    space = simulator.parameters
    strides, count = max(WINDOWS.items())
    windows = probing_windows(logged, dataset, simulator, steps=strides * stride(dataset), count=count)
    middle = np.zeros(len(space))
    points = difference_points(middle)
    scale = typical_change(dataset, simulator.task.attitudes)
    around = linearise(points, window_residuals(simulator, windows, points, scale))
    certainty = sandwich(bread(around, 1.0, "linear"), np.zeros((len(space), len(space))))
    effect = half = np.full(len(space), np.nan)
    if intervals and logged.kind == "approximate":
        fitted = windows_of(dataset, logged, scale, fewest=FEWEST + len(space), most=FEWEST + len(space))
        fit = fit_log(dataset, logged, simulator, fitted, middle)
        if fit.counted.any():
            noise = noise_of(fit, fitted.readings)
            left = scale[: len(noise)] * noise
            half = expected_half_widths(logged, dataset, simulator, fit.point, left, exact=False)
            half = half * (space.high - space.low) / 2.0
            seen = fit.slopes.over(np.tile(noise, fitted.readings.steps + 1)).by_parameters[fit.counted]
            effect = np.sqrt((seen**2).mean((0, 1)))
    return _excitation(effect, half, certainty, around, middle, space)


def _excitation(
    effect: Float[np.ndarray, " d"],
    half: Float[np.ndarray, " d"],
    certainty: Uncertainty,
    around: Linearisation,
    point: Float[np.ndarray, " d"],
    space: ParameterSpace,
) -> Excitation:
    """What a certainty says; if scaling all masses and forces alike changes no residual, without that direction."""
    scaled = np.array([mass_like(row) for row in space.parameters])
    direction = np.where(scaled, space.to_physical(point) / (0.5 * (space.high - space.low)), 0.0)
    parts = around.jacobian * direction
    only_ratios = not (parts.sum(-1) ** 2).sum() >= HIDDEN**2 * (parts**2).sum()
    if only_ratios:
        along = certainty.unidentified @ direction / np.linalg.norm(direction)
        certainty = replace(certainty, unidentified=certainty.unidentified[np.abs(along) < ALIGNED])
    pairs = tuple(correlated_pairs(certainty.correlation, space.names))
    return Excitation(effect, half, pairs, identifiability(certainty, space.names), only_ratios)


def excitation_findings(excitation: Excitation, simulator: Simulator) -> list[Finding]:
    """A warning for each parameter with a wide expected interval, and for those that cannot be determined."""
    findings = [Finding("warning", sentence, "parameters") for sentence in excitation.sentences]
    named = " ".join(excitation.sentences)
    for parameter, width in zip(simulator.parameters.parameters, excitation.half_width, strict=True):
        share = width / (parameter.high - parameter.low)
        scaled = excitation.only_ratios and mass_like(parameter)  # that is a finding of its own
        if share > WIDE and parameter.name not in named and not scaled:
            what = (
                f"the log hardly determines it: expect ± {width:.2g} {parameter.unit} (95 %), which is "
                f"{min(200 * share, 100):.0f} % of its range"
            )
            remedy = "excite it more, record longer, or leave it out"
            findings.append(Finding("warning", what, parameter.name, remedy))
    return findings
