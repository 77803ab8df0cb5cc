"""What candidate terms do to simulated windows: the derivative of the residuals by each."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float

from madoc import simulation
from madoc.identification.candidate_terms import Candidate
from madoc.identification.causes import DELAY, INTEGRATION, LATE_DRIVE, LATE_SENSOR, SATURATION, SPACING, TILTS
from madoc.identification.replay import Readings
from madoc.parameters import FIELDS, Parameter
from madoc.simulation.base import Simulator

CHANGE = 1e-3
"""Change of a candidate, as a share of what would balance the joint's typical torque, for its one-sided difference."""
_SATURATED = 0.3
"""Share of the largest logged action by which actions are cut off, to compute the effect of a drive that saturates."""
_LATER = 0.1
"""Delay in control steps with which the effect of a delay is computed."""


def effects(
    simulator: Simulator,
    wide: Simulator,
    readings: Readings,
    before: Float[np.ndarray, "windows action"],
    at: Float[np.ndarray, " k"],
    states: Float[np.ndarray, "windows state"],
    added: list[tuple[Candidate, Parameter]],
) -> tuple[list[Candidate], Float[np.ndarray, "windows values terms"]]:
    """Every candidate and the derivative of the residuals by it, in its reference.

    `wide` is the simulator with the added parameters, the last ones of `at`; `before` are the actions before windows.
    """
    count, base = len(added), readings.residuals(wide, at[None], states[None])[0, 0]
    points = np.repeat(at[None], count, axis=0)
    points[np.arange(count), len(at) - count + np.arange(count)] += 2.0 * CHANGE
    by_candidate = readings.residuals(wide, points, np.repeat(states[None], count, axis=0))[:, 0] - base
    tried, found = [candidate for candidate, _ in added], list(by_candidate / CHANGE)
    for candidate, column in _of_groups(simulator, added, np.stack(found)):
        tried.append(candidate)
        found.append(column)
    point, step = at[: len(at) - count], simulator.control_step
    earlier = np.concatenate([before[:, None], readings.actions[:, :-1]], axis=1)
    late = replace(readings, actions=readings.actions + _LATER * (earlier - readings.actions))
    saturated = replace(readings, actions=_cut_off(readings.actions, simulator))
    stretched = simulation.make(simulator.task.with_time_step(1.0 + CHANGE))
    finer = simulation.with_shorter_timestep(simulator)
    fields = {each.field for each in simulator.parameters.parameters}
    timed = [each for each in simulator.parameters.parameters if each.kind.of_all]
    tilts = TILTS if np.any(simulator.task.model.opt.gravity) else ()
    for candidate, other, inputs, change in (
        *(
            (
                Candidate(cause, "", "rad", 0.0, 1.0, -np.inf, known_before=True),
                simulation.make(simulator.task.with_tilt(axis, CHANGE)),
                readings,
                CHANGE,
            )
            for axis, cause in enumerate(tilts)
        ),
        (Candidate(DELAY, "action_delay", "s", 0.0, step, -np.inf), simulator, late, _LATER),
        (Candidate(SATURATION, "", "of the largest action cut off", 0.0, 1.0, 0.0), simulator, saturated, _SATURATED),
        (Candidate(SPACING, "", "s", step, step, 0.0), stretched, readings, CHANGE),
        (Candidate(INTEGRATION, "", "", 0.0, 1.0, -np.inf), finer, readings, 1.0),
    ):
        if candidate.parameter not in fields and not (candidate.cause == DELAY and timed):
            moved = inputs.residuals(other, point[None], states[None])[0, 0]
            tried.append(candidate)
            found.append((moved - base) / change)
    commands = [(place, channel) for place, channel in enumerate(simulator.task.actions) if channel.command]
    for place, channel in commands if len(commands) > 1 else ():
        if any(not each.elements or channel.name in each.elements for each in timed):
            continue
        actions = readings.actions.copy()
        actions[..., place] = late.actions[..., place]
        moved = replace(readings, actions=actions).residuals(simulator, point[None], states[None])[0, 0]
        tried.append(_late(LATE_DRIVE, step, f"action_delay.{channel.name}"))
        found.append((moved - base) / _LATER)
    for signal, column in _late_sensors(simulator, readings, base):
        tried.append(_late(f"{LATE_SENSOR} ({signal})", step))
        found.append(column)
    return tried, np.stack(found, axis=-1)


def _late(cause: str, step: float, parameter: str = "") -> Candidate:
    """A lag of a single drive or sensor, s."""
    return Candidate(cause, parameter, "s", 0.0, step, 0.0, known_before=True)


def _late_sensors(
    simulator: Simulator, readings: Readings, residuals: Float[np.ndarray, "windows values"]
) -> Iterator[tuple[str, Float[np.ndarray, "windows values"]]]:
    """Each signal that a user's robot logs, and what it reads less by if it is a control step late: to first order."""
    if simulator.task.source is None:
        return
    predicted = residuals.reshape(readings.observed.shape) + readings.observed / readings.scale
    less = -np.gradient(predicted, axis=1)
    for place, signal in enumerate(simulator.task.signals[: predicted.shape[-1]]):
        column = np.where(np.isnan(less), np.nan, 0.0)
        column[..., place] = less[..., place]
        yield signal, column.reshape(residuals.shape)


def _cut_off(
    actions: Float[np.ndarray, "windows steps action"], simulator: Simulator
) -> Float[np.ndarray, "windows steps action"]:
    """Actions of a drive that saturates: in the spec's units none is farther from 0 than a share of the largest."""
    middle, half = simulator.task.action_ranges
    asked = actions * half + middle
    most = (1.0 - _SATURATED) * np.abs(asked).max((0, 1))
    most[[not channel.command for channel in simulator.task.actions] or slice(0)] = np.inf
    return (np.clip(asked, -most, most) - middle) / half


def _of_groups(
    simulator: Simulator,
    added: list[tuple[Candidate, Parameter]],
    columns: Float[np.ndarray, "added windows values"],
) -> Iterator[tuple[Candidate, Float[np.ndarray, "windows values"]]]:
    """The terms of joints that share a calibrated parameter, and the gain of all drives, of one value for all.

    Effects of small values add up. Of terms that all of these lack, the others would hide each single one.
    """
    index_of = {(parameter.field, parameter.element): index for index, (_, parameter) in enumerate(added)}
    groups = dict.fromkeys(row.elements for row in simulator.parameters.parameters if len(row.elements) > 1)
    joint_fields = [name for name, field in FIELDS.items() if field.element == "joint" and field.missing]
    gains = {parameter.element: each.nominal for each, parameter in added if parameter.field == "actuator_gain"}
    drives = [("actuator_gain", tuple(gains))] if len(gains) > 1 and len(set(gains.values())) == 1 else []
    for field, group in (*product(joint_fields, groups), *drives):
        members = [index_of[field, element] for element in group if (field, element) in index_of]
        if len(members) == len(group):
            single = [added[index][0] for index in members]
            reference = float(np.mean([each.reference for each in single]))
            name = Parameter(field, group, 0.0, 1.0).name
            together = replace(single[0], parameter=name, elements=group, reference=reference)
            yield together, sum(reference / added[index][0].reference * columns[index] for index in members)
