"""What a log can and cannot say of a robot, told before anything is solved: `check` returns a `Diagnosis`."""

import time
from dataclasses import dataclass

import jax

from madoc.data import Dataset
from madoc.data.findings import Finding, worst_first
from madoc.diagnosis.channels import Channel, channel_findings, channels_of
from madoc.diagnosis.excitation import Excitation, excitation_findings, excite, excite_unknown
from madoc.diagnosis.explanation import Explanation, action_findings, explain, explanation_findings
from madoc.identification.states import LoggedStates, probing_rows, states_of
from madoc.robots import Robot
from madoc.simulation import CpuSimulator
from madoc.simulation.sensitivity import insensitive


@dataclass(frozen=True)
class Diagnosis:
    """What was found out about a log and a model.

    Attributes:
        rows: Transitions.
        episodes: Stretches without a break.
        runs: Recordings they come from.
        control_step: s between two rows.
        channels: Signals, then actions.
        explanation: How well the model tells what happens next; None where no state can be rebuilt.
        excitation: How well the log could tell each parameter; None where a fatal finding came before.
        findings: The worst first.
        control_steps: Simulated for all of this.
        seconds: It took.
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


def check(dataset: Dataset, simulator: CpuSimulator, *, robot: Robot | None = None, seed: int = 0) -> Diagnosis:
    """Look at a log and a model before any solving.

    Args:
        dataset: The log; what reading it told is among the findings.
        simulator: The model and its box of parameters.
        robot: For units and reasons, where the robot is one's own.
        seed: Of the stretches looked at and of the draws from the box.
    """
    started = time.monotonic()
    task = simulator.task
    of_rows, of_box, of_actions, of_windows = jax.random.split(jax.random.key(seed), 4)
    channels = channels_of(dataset, task, robot)
    findings = [*dataset.findings, *channel_findings(dataset, simulator, channels)]
    explanation, excitation, spent = None, None, 0
    if not any(finding.level == "fatal" for finding in findings):
        logged = states_of(dataset, simulator)
        probing = insensitive(simulator, *probing_rows(logged, dataset, simulator), key=of_rows)
        spent += probing[1]
        findings += _insensitive_findings(probing[0])
        if logged.kind == "exact":
            states, rows = logged.exact()
            explanation = explain(dataset, simulator, states, rows, key=of_box)
            findings += explanation_findings(explanation, channels)
            about_actions, steps = action_findings(dataset, simulator, states, rows, explanation, key=of_actions)
            findings += about_actions
            start = explanation.draws[explanation.best]
            excitation = excite(dataset, simulator, states, rows, start=start, key=of_windows)
            spent += explanation.control_steps + steps
        else:
            findings.append(_inexact_states_finding(logged, robot))
            excitation = excite_unknown(dataset, simulator, logged)
        spent += excitation.control_steps
        findings += excitation_findings(excitation, simulator)
    return Diagnosis(
        rows=len(dataset),
        episodes=len(dataset.episode_starts),
        runs=len(set(dataset.run_names or ())) or len(dataset.episode_starts),
        control_step=simulator.control_step,
        channels=channels,
        explanation=explanation,
        excitation=excitation,
        findings=worst_first(findings),
        control_steps=spent,
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
