"""Disturbances of real logs (noise, hidden velocities, lost order), put into clean data, which remembers them."""

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from madoc.data.dataset import Dataset, close_episodes
from madoc.data.disturbance import Disturbance
from madoc.data.velocities import moving_states, show_velocities
from madoc.errors import MadocError
from madoc.simulation.velocities import missing_velocities, refuse_unseen_positions
from madoc.tasks import Task


def disturb(dataset: Dataset, disturbance: Disturbance, task: Task, key: PRNGKeyArray) -> Dataset:
    """The dataset as it would have been logged under noise, without velocities, or out of order.

    Velocities by differences of positions are put in last, as a reader of such a log would.

    Rewards and ends stay as they were recorded. The friction of a target is a matter of recording and is only
    noted down.

    Args:
        dataset: What to disturb.
        disturbance: The noise, hidden velocities and order to put into it.
        task: The robot, with all values of a clean observation.
        key: The source of randomness, for the noise and the order.

    Raises:
        MadocError: The data is disturbed in the same way already, velocities are not the last values of the task's
            observations, or they cannot be computed from positions.
    """
    _refuse_twice(dataset, disturbance)
    of_noise, of_order = jax.random.split(key)
    if disturbance.noise:
        dataset = _with_noise(dataset, disturbance.noise, of_noise)
    if disturbance.hidden_velocities:
        dataset = _with_observations(dataset, slice(hide_velocities(task).observation_size))
    if disturbance.shuffled != "none":
        order = np.asarray(jax.random.permutation(of_order, len(dataset)))
        shuffle = _shuffle_rows if disturbance.shuffled == "rows" else _shuffle_next_observations
        dataset = shuffle(dataset, order)
    dataset = replace(dataset, disturbance=dataset.disturbance.joined(disturbance))
    return _with_differences(dataset, task) if disturbance.velocities == "differences" else dataset


def observed_task(task: Task, dataset: Dataset) -> Task:
    """The robot with the observations of the data: without hidden velocities, with those made from positions."""
    known = dataset.disturbance
    if known.velocities == "differences":
        return task if task.velocities else show_velocities(task)
    return hide_velocities(task) if known.hidden_velocities and task.velocities else task


def hide_velocities(task: Task) -> Task:
    """The same robot seen without velocities: no state can then be rebuilt from one observation.

    Raises:
        MadocError: Its velocities are not the last values of an observation.
    """
    if not task.velocities:
        raise MadocError(f"an observation of {task.name} does not end in velocities, so they cannot be hidden")
    size, observe, whole = task.observation_size - task.velocities, task.observe, task.state_from_observation
    unknown = np.full(task.velocities, np.nan)
    return replace(
        task,
        observation_size=size,
        observe=lambda state: observe(state)[..., :size],
        velocities=0,
        state_from_observation=None,
        rebuildable=None,
        posture=None if whole is None else lambda observation: whole(_joined(observation, unknown)),
    )


def _joined(positions: Float[np.ndarray, "*rows positions"], velocities: np.ndarray) -> np.ndarray:
    return np.concatenate([positions, np.broadcast_to(velocities, (*positions.shape[:-1], len(velocities)))], axis=-1)


def noise_of(
    dataset: Dataset, share: float, key: PRNGKeyArray
) -> tuple[Float[np.ndarray, "rows observation"], Float[np.ndarray, "rows observation"]]:
    """Normal noise for observations and next observations, its standard deviation a share of a step's typical change.

    A sensor is read once a step: where a row's next observation is the next row's observation, both carry the same
    noise.
    """
    logged = dataset.transitions
    observation, following = np.asarray(logged.observation), np.asarray(logged.next_observation)
    deviation = share * (following - observation).std(0)
    first, second = (
        np.asarray(jax.random.normal(part, observation.shape), np.float64) for part in jax.random.split(key)
    )
    same = (following[:-1] == observation[1:]).all(-1)
    same[dataset.episode_starts[1:] - 1] = False
    second = np.array(second)
    second[:-1][same] = first[1:][same]
    return deviation * first, deviation * second


def _with_noise(dataset: Dataset, share: float, key: PRNGKeyArray) -> Dataset:
    logged = dataset.transitions
    before, after = noise_of(dataset, share, key)
    transitions = replace(
        logged, observation=logged.observation + before, next_observation=logged.next_observation + after
    )
    return replace(dataset, transitions=transitions)


def _with_differences(dataset: Dataset, task: Task) -> Dataset:
    hidden = dataset.disturbance.hidden_velocities
    if task.state_from_observation is not None and not hidden:
        raise MadocError(f"the data of {dataset.origin} has velocities; velocities=differences is for data without")
    if dataset.disturbance.shuffled == "next_observations":
        raise MadocError(f"the next observations of {dataset.origin} are shuffled: their differences are no velocities")
    positions = hide_velocities(task) if hidden else task
    refuse_unseen_positions(positions)
    logged = dataset.transitions
    missing = None if hidden else missing_velocities(task)
    here, there = (
        np.concatenate(
            [shown, np.asarray(task.observe(states))[:, shown.shape[1] :] if missing is None else states[:, missing]],
            axis=-1,
        )
        for shown, states in zip(
            (logged.observation, logged.next_observation), moving_states(dataset, positions), strict=True
        )
    )
    return replace(dataset, transitions=replace(logged, observation=here, next_observation=there))


def _with_observations(dataset: Dataset, shown: slice) -> Dataset:
    logged = dataset.transitions
    transitions = replace(
        logged, observation=logged.observation[:, shown], next_observation=logged.next_observation[:, shown]
    )
    return replace(dataset, transitions=transitions)


def _shuffle_rows(dataset: Dataset, order: Int[np.ndarray, " rows"]) -> Dataset:
    """Make every row an episode of its own, in random order: what came before or after it is lost."""
    starts = np.arange(len(dataset))
    names = dataset.run_names
    if names is not None:
        episode = dataset.episode_of(order)
        names = tuple(names[index] for index in episode)
    transitions = close_episodes(dataset.transitions.take(order), starts)
    return replace(dataset, transitions=transitions, episode_starts=starts, run_names=names)


def _shuffle_next_observations(dataset: Dataset, order: Int[np.ndarray, " rows"]) -> Dataset:
    """Lose which next observation belongs to which row, and with it the order of the rows."""
    loose = _shuffle_rows(dataset, order)
    following = np.asarray(dataset.transitions.next_observation)
    return replace(loose, transitions=replace(loose.transitions, next_observation=following))


def _refuse_twice(dataset: Dataset, disturbance: Disturbance) -> None:
    there = dataset.disturbance
    now = disturbance
    for what, before, asked in (
        ("carries noise", there.noise, now.noise),
        ("hides velocities", there.hidden_velocities, now.hidden_velocities),
        ("has velocities by differences", there.velocities == "differences", now.velocities == "differences"),
        ("is shuffled", there.shuffled != "none", now.shuffled != "none"),
    ):
        if before and asked:
            raise MadocError(f"the data of {dataset.origin} {what} already; disturb the clean data instead")
