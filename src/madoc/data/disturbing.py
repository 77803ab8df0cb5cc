"""Disturbances of real logs (noise, hidden velocities, lost order), put into clean data, which remembers them."""

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.data.dataset import Dataset
from madoc.data.disturbance import Disturbance
from madoc.data.velocities import moving_states, show_velocities
from madoc.errors import MadocError
from madoc.simulation.unobserved import missing_velocities, refuse_unseen_positions
from madoc.tasks import Task

Observations = Float[jax.Array | np.ndarray, "rows observation"]


def disturb(dataset: Dataset, disturbance: Disturbance, task: Task, key: PRNGKeyArray) -> Dataset:
    """The dataset as it would have been logged under noise, without velocities, or out of order.

    Velocities by differences of positions are computed last, as a reader of such a log would. Rewards and ends stay as
    they were recorded. The friction of a target can only be changed when it is recorded; here it is only noted. `task`
    is the robot with all values of a clean observation; the key draws the noise and the order.

    Raises:
        MadocError: The data is disturbed in the same way already, velocities are not the last values of the task's
            observations, or they cannot be computed from positions.
    """
    _refuse_twice(dataset, disturbance)
    noise_key, order_key = jax.random.split(key)
    logged = dataset.transitions
    if disturbance.noise:
        before, after = noise_of(dataset, disturbance.noise, noise_key)
        dataset = _observing(dataset, logged.observation + before, logged.next_observation + after)
    if disturbance.hidden_velocities:
        logged, size = dataset.transitions, hide_velocities(task).observation_size
        dataset = _observing(dataset, logged.observation[:, :size], logged.next_observation[:, :size])
    if disturbance.shuffled != "none":
        order = np.asarray(jax.random.permutation(order_key, len(dataset)))
        dataset = _shuffled(dataset, order, with_next=disturbance.shuffled == "rows")
    dataset = replace(dataset, disturbance=dataset.disturbance.joined(disturbance))
    return _with_differences(dataset, task) if disturbance.velocities == "differences" else dataset


def observed_task(task: Task, dataset: Dataset) -> Task:
    """The robot with the observations of the data: without hidden velocities, with those computed from positions."""
    disturbance = dataset.disturbance
    if disturbance.velocities == "differences":
        return task if task.velocities else show_velocities(task)
    return hide_velocities(task) if disturbance.hidden_velocities and task.velocities else task


def hide_velocities(task: Task) -> Task:
    """The same robot observed without velocities: no state can then be rebuilt from one observation.

    Raises:
        MadocError: Its velocities are not the last values of an observation.
    """
    if not task.velocities:
        if task.source is not None:
            raise MadocError(f"only madoc's robots hide velocities: take their signals out of the spec of {task.name}")
        raise MadocError(f"an observation of {task.name} does not end in velocities, so they cannot be hidden")
    size, observe, rebuild = task.observation_size - task.velocities, task.observe, task.state_from_observation

    def posture(positions: np.ndarray) -> np.ndarray:
        assert rebuild is not None
        unknown = np.full((*positions.shape[:-1], task.velocities), np.nan)
        return rebuild(np.concatenate([positions, unknown], axis=-1))

    return replace(
        task,
        observation_size=size,
        observe=lambda state: observe(state)[..., :size],
        velocities=0,
        state_from_observation=None,
        rebuildable=None,
        posture=None if rebuild is None else posture,
    )


def row_change(dataset: Dataset) -> Float[np.ndarray, " observation"]:
    """Standard deviation of each channel's change from a row to the next, in its unit: what noise is a share of."""
    logged = dataset.transitions
    return (np.asarray(logged.next_observation) - np.asarray(logged.observation)).std(0)


def noise_of(dataset: Dataset, share: float, key: PRNGKeyArray) -> tuple[Observations, Observations]:
    """Normal noise for observations and next observations, its standard deviation a share of a step's typical change.

    A sensor is read once a step: where a row's next observation is the next row's observation, both carry the same
    noise.
    """
    logged, deviation = dataset.transitions, share * row_change(dataset)
    observation, following = np.asarray(logged.observation), np.asarray(logged.next_observation)
    before, after = (np.array(jax.random.normal(part, observation.shape), float) for part in jax.random.split(key))
    same = (following[:-1] == observation[1:]).all(-1)
    same[dataset.episode_starts[1:] - 1] = False
    after[:-1][same] = before[1:][same]
    return deviation * before, deviation * after


def _with_differences(dataset: Dataset, task: Task) -> Dataset:
    hidden = dataset.disturbance.hidden_velocities
    if task.state_from_observation is not None and not hidden:
        raise MadocError(f"the data of {dataset.origin} has velocities; velocities=differences is for data without")
    if dataset.disturbance.shuffled == "next_observations":
        raise MadocError(f"the next observations of {dataset.origin} are shuffled: their differences are no velocities")
    positions = hide_velocities(task) if hidden else task
    refuse_unseen_positions(positions)
    missing = None if hidden else missing_velocities(task)

    def filled(shown: jax.Array | np.ndarray, states: np.ndarray) -> Observations:
        computed = np.asarray(task.observe(states))[:, shown.shape[1] :] if missing is None else states[:, missing]
        return np.concatenate([shown, computed], axis=-1)

    logged, (here, there) = dataset.transitions, moving_states(dataset, positions)
    return _observing(dataset, filled(logged.observation, here), filled(logged.next_observation, there))


def _observing(dataset: Dataset, observation: Observations, next_observation: Observations) -> Dataset:
    transitions = replace(dataset.transitions, observation=observation, next_observation=next_observation)
    return replace(dataset, transitions=transitions)


def _shuffled(dataset: Dataset, order: Int[np.ndarray, " rows"], *, with_next: bool) -> Dataset:
    """Make every row an episode of its own, in the given order, with its next observation or with another row's."""
    loose = dataset.take(order, np.arange(len(dataset)))
    if with_next:
        return loose
    return _observing(loose, loose.transitions.observation, dataset.transitions.next_observation)


def _refuse_twice(dataset: Dataset, disturbance: Disturbance) -> None:
    before = dataset.disturbance
    for what, already, again in (
        ("carries noise", before.noise, disturbance.noise),
        ("hides velocities", before.hidden_velocities, disturbance.hidden_velocities),
        ("has velocities by differences", before.velocities != "logged", disturbance.velocities != "logged"),
        ("is shuffled", before.shuffled != "none", disturbance.shuffled != "none"),
    ):
        if already and again:
            raise MadocError(f"the data of {dataset.origin} {what} already; disturb the clean data instead")
