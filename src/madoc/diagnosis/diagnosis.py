"""A log and a model compared before any calibration: `check` returns a `Diagnosis`."""

import time
from dataclasses import dataclass

import jax

from madoc.data import Dataset, typical_change
from madoc.data.findings import Finding, worst_first
from madoc.diagnosis.channels import Channel, channel_findings, channels_of
from madoc.diagnosis.exchanged_columns import exchanged_columns
from madoc.diagnosis.excitation import Excitation, excitation_findings, excite, excite_unknown
from madoc.diagnosis.explanation import Explanation, action_findings, box_draws, explain, explanation_findings
from madoc.diagnosis.inertial import inertial_findings
from madoc.diagnosis.response import response_findings
from madoc.diagnosis.scales import range_findings, scale_findings, timestep_findings
from madoc.diagnosis.speeds import speed_findings
from madoc.identification.states import LoggedStates, probing_rows, states_of
from madoc.robots import Robot
from madoc.simulation import Simulator
from madoc.simulation.base import SIMULATED
from madoc.simulation.sensitivity import insensitive


@dataclass(frozen=True)
class Diagnosis:
    """A log and a model compared before any calibration.

    Attributes:
        episodes: Number of stretches of rows without a break.
        runs: Number of recordings that these come from.
        control_step: Time between two rows, s.
        explanation: How well the model predicts the log; None where states are not exact.
        excitation: How well the log can determine each parameter; None after a fatal finding.
        findings: The findings, the worst first.
        control_steps: Number of control steps simulated.
        seconds: Wall-clock time.
    """

    rows: int
    episodes: int
    runs: int
    control_step: float
    channels: tuple[Channel, ...]
    explanation: Explanation | None
    excitation: Excitation | None
    findings: tuple[Finding, ...]
    control_steps: int
    seconds: float

    @property
    def fatal(self) -> bool:
        """Whether a calibration would be pointless."""
        return any(finding.level == "fatal" for finding in self.findings)


def check(
    dataset: Dataset, simulator: Simulator, *, robot: Robot | None = None, seed: int = 0, intervals: bool = True
) -> Diagnosis:
    """Compare a log with a model before any calibration.

    Args:
        dataset: The log. Findings of its reader are among those returned.
        simulator: The model and the ranges of its parameters.
        robot: The user's own robot, if it is one: its spec gives units and reasons.
        seed: Seed of the windows that are replayed and of the parameters that are tried.
        intervals: Whether expected intervals are wanted as narrow as they can be, which takes as long as the rest, and
            where initial states have to be fitted for them; a calibration that follows has its own.
    """
    started = time.monotonic()
    of_rows, of_box, of_actions, of_windows = jax.random.split(jax.random.key(seed), 4)
    channels = channels_of(dataset, simulator.task, robot)
    findings = [*dataset.findings, *channel_findings(dataset, len(simulator.parameters), channels)]
    findings += range_findings(dataset, simulator)
    about_speeds, late_speeds = speed_findings(dataset, simulator)
    findings += [*about_speeds, *(inertial_findings(dataset, robot, simulator.control_step) if robot else [])]
    explanation, excitation, began = None, None, SIMULATED.control_steps
    if not any(finding.level == "fatal" for finding in findings):
        logged = states_of(dataset, simulator)
        idle = insensitive(simulator, *probing_rows(logged, dataset, simulator), key=of_rows)
        findings += _insensitive_findings(idle)
        of_starts, of_draws = jax.random.split(of_box)
        draws = box_draws(len(simulator.parameters), of_draws)
        start = draws[0]
        responding = response_findings(dataset, simulator, logged, draws, late_speeds=late_speeds)
        findings += responding
        if logged.kind == "exact":
            explanation = explain(dataset, simulator, logged, draws, key=of_starts)
            points, ahead = draws[[0, explanation.best]], explanation.horizons[min(1, len(explanation.horizons) - 1)]
            scale = typical_change(dataset, simulator.task.attitudes)
            exchanged = exchanged_columns(dataset, simulator, points, ahead, scale, contradicts=False)
            findings += [*explanation_findings(explanation, channels, exchanged), *exchanged]
            told = frozenset(finding.where for finding in responding)
            findings += action_findings(dataset, simulator, logged, explanation, told=told, key=of_actions)
            start = explanation.draws[explanation.best]
            excitation = excite(dataset, simulator, logged, start=start, key=of_windows, intervals=intervals)
        else:
            findings.append(_inexact_states_finding(logged, robot))
            excitation = excite_unknown(dataset, simulator, logged, intervals=intervals)
        findings += excitation_findings(excitation, simulator)
        findings += scale_findings(dataset, simulator, logged, start, only_ratios=excitation.only_ratios)
        findings += timestep_findings(dataset, simulator, logged, start)
    return Diagnosis(
        rows=len(dataset),
        episodes=len(dataset.episode_starts),
        runs=len(set(dataset.run_names or ())) or len(dataset.episode_starts),
        control_step=simulator.control_step,
        channels=channels,
        explanation=explanation,
        excitation=excitation,
        findings=worst_first(findings),
        control_steps=SIMULATED.control_steps - began,
        seconds=time.monotonic() - started,
    )


def _inexact_states_finding(logged: LoggedStates, robot: Robot | None) -> Finding:
    reasons = ", ".join(robot.undetermined) if robot is not None and robot.undetermined else logged.reason
    return Finding(
        "note",
        f"states cannot be rebuilt from the log ({reasons}), so the model was not compared with it, and methods "
        "that take logged states for true will refuse",
        "signals",
        "log the position and the velocity of every joint if you can",
    )


def _insensitive_findings(names: list[str]) -> list[Finding]:
    what = "it changes nothing that is seen, from one end of its range to the other"
    return [Finding("fatal", what, name, "leave it out of the spec, or widen its range") for name in names]
