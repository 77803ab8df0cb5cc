"""What no log can show: scales of masses and forces, impossible ranges, whether a model is integrated finely enough."""

import numpy as np
from jaxtyping import Float

from madoc import simulation
from madoc.data import Dataset, stride, typical_change
from madoc.data.findings import Finding
from madoc.errors import listed
from madoc.identification.replay import window_residuals
from madoc.identification.states import LoggedStates, probing_rows, probing_windows
from madoc.identification.windows import evenly
from madoc.simulation import FINER
from madoc.simulation.base import Simulator
from madoc.simulation.response import hidden_scales, mass_like

_ROWS = 16
"""Number of states at which a scale is tried."""
_PLACES = ("payload_x", "payload_y", "payload_z")
FARTHEST = 10.0
"""Distance of a payload from its body in sizes of the whole model, beyond which it is hardly in m."""
_WINDOWS = 64
"""Largest number of windows that a finer timestep is tried on."""
COARSE = 0.25
"""Change of predictions in typical changes of a signal, above which the integration step is too long for its robot."""
_DIVERGED = 1.0
"""Typical changes that a window counts for where only the model's own integration step diverges."""


def scale_findings(
    dataset: Dataset,
    simulator: Simulator,
    logged: LoggedStates,
    point: Float[np.ndarray, " d"],
    *,
    only_ratios: bool,
) -> list[Finding]:
    """What the scale of masses and forces, and that of positions, rests on where no log can show it.

    The scales are tried at the parameters `point` in [-1, 1]. `only_ratios` is whether the calibrated parameters alone
    can be scaled alike without a trace.
    """
    names = [row.name for row in simulator.parameters.parameters if mass_like(row)]
    if not names:
        return []
    states, actions = (rows[evenly(np.arange(len(rows)), _ROWS)] for rows in probing_rows(logged, dataset, simulator))
    by_mass, by_length = hidden_scales(simulator, simulator.parameters.to_physical(point), states, actions)
    findings = []
    if by_mass:
        findings.append(_scale_of_masses(names, only_ratios=only_ratios))
    if by_length:
        what = (
            "no log can show the scale of positions here: were all of them logged too large, and every drive's gain, "
            f"the fit would be as good, and {listed(names)} wrong"
        )
        findings.append(Finding("note", what, "scale", "check one distance with a ruler", kept=True))
    return findings


def _scale_of_masses(names: list[str], *, only_ratios: bool) -> Finding:
    if only_ratios:
        what = (
            f"only ratios can be found: {listed(names)} times one common factor change nothing that is seen, as masses "
            "and forces that are all twice as large"
        )
        return Finding("warning", what, "parameters", "take one of them out of the spec, at a value that was measured")
    what = (
        f"{listed(names)} are as right as the masses and the gains of drives that are not calibrated: were all of "
        "these 10 % off, so would those be, and no interval counts that"
    )
    return Finding(
        "note", what, "scale", "weigh a part, or measure a drive's torque, and put that into the model", kept=True
    )


def range_findings(dataset: Dataset, simulator: Simulator) -> list[Finding]:
    """Ranges that cannot be: delays as long as runs of a log, loads far off, contacts too stiff for the timestep."""
    task, findings = simulator.task, []
    longest = int((dataset.episode_ends - dataset.episode_starts).max())
    if task.pending >= longest > 1:
        what = (
            f"commands act up to {simulator.control_step * task.pending:.3g} s late in the ranges of delays and lags, "
            f"and the longest stretch of the log without a gap has {simulator.control_step * longest:.3g} s"
        )
        findings.append(Finding("fatal", what, "parameters", "give action_delay and action_lag shorter ranges, in s"))
    size, shortest = float(task.model.stat.extent), 2.0 * float(task.model.opt.timestep)
    for row in simulator.parameters.parameters:
        far = max(abs(row.low), abs(row.high))
        if row.field in _PLACES and far > FARTHEST * size:
            what = f"the load may be {far:.3g} m off, and the whole model is {size:.2g} m in size"
            findings.append(Finding("warning", what, row.name, "give its place in m, in the frame of the body"))
        if row.field == "contact_time" and row.low < shortest:
            what = f"MuJoCo takes two timesteps, {shortest:.3g} s, where the time constant of a contact is shorter"
            remedy = "begin the range there, or shorten the timestep, unless the other geom's value makes it longer"
            findings.append(Finding("note", what, row.name, remedy))
    return findings


def timestep_findings(
    dataset: Dataset, simulator: Simulator, logged: LoggedStates, point: Float[np.ndarray, " d"]
) -> list[Finding]:
    """A warning where a finer integration changes predictions by much, at the parameters `point` in [-1, 1]."""
    scale = typical_change(dataset, simulator.task.attitudes)
    change = coarseness(dataset, logged, simulator, point, scale)
    if change <= COARSE:
        return []
    timestep = simulator.control_step / simulator.task.frame_skip
    what = (
        f"its timestep of {timestep:.12g} s is too long: with {timestep / FINER:.12g} s predictions of half of the "
        f"signals change by {change:.2g} typical changes or more, which parameters would make up for"
    )
    remedy = f"give timestep: {timestep / FINER:.12g} in the spec, unless the log is of a simulation with this timestep"
    return [Finding("warning", what, "the model", remedy)]


def coarseness(
    dataset: Dataset,
    logged: LoggedStates,
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    scale: Float[np.ndarray, " observation"],
) -> float:
    """By how much predictions one stride ahead change with integration steps of a quarter of the length.

    Smooth motion hardly changes. Where contacts begin or end it may, and then parameters fitted to a machine, whose
    motion has no integration step, are not the machine's.

    It is the median over signals, in units of `scale`, of the root mean square over windows of the log, as a signal
    that hardly moves may change by much of its little. A window whose finer simulation fails is left out; 0 where none
    is left. The parameters `point` are in [-1, 1].
    """
    windows = probing_windows(logged, dataset, simulator, steps=stride(dataset), count=_WINDOWS)
    finer = simulation.with_shorter_timestep(simulator)
    coarse, fine = (
        window_residuals(each, windows, point[None], scale)[0].reshape(len(windows), windows.steps, -1)[:, -1]
        for each in (simulator, finer)
    )
    counted = np.isfinite(fine).all(-1)
    change = np.abs(fine - coarse)[counted]
    change = np.where(np.isfinite(change), change, _DIVERGED)
    return float(np.median(np.sqrt((change**2).mean(0)))) if len(change) else 0.0
