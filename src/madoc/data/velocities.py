"""Velocities computed from logged positions: central differences within an episode."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from madoc.data.dataset import Dataset
from madoc.errors import MadocError
from madoc.simulation.unobserved import missing_velocities, velocities_between, with_velocities
from madoc.tasks import Task


def moving_states(
    dataset: Dataset, task: Task
) -> tuple[Float[np.ndarray, "rows state"], Float[np.ndarray, "rows state"]]:
    """(qpos, qvel) before and after every row, with velocities as observed, or else by differences of positions.

    The velocity at a reading is the central difference of the readings before and after it, two control steps apart;
    at the first and last reading of an episode it is the one-sided difference over one control step. At constant
    acceleration the former is exact, and the latter is the velocity half a control step away. Positions that are not
    observed are NaN, and their velocities 0.

    Raises:
        MadocError: The task's observation determines none of its positions.
    """
    posture = task.posture
    if posture is None:
        raise MadocError(
            f"an observation of {task.name} determines none of its positions, so nothing can start at logged "
            "states; take a method that starts rollouts from the task's reset: madoc with starts=policy"
        )
    logged = dataset.transitions
    here, there = (
        np.asarray(posture(np.asarray(part, np.float64))) for part in (logged.observation, logged.next_observation)
    )
    first = np.zeros(len(dataset), dtype=bool)
    first[dataset.episode_starts] = True
    last = np.append(first[1:], True)
    before = np.where(first[:, None], here, np.roll(here, 1, axis=0))
    beyond = np.where(last[:, None], there, np.roll(there, -1, axis=0))
    return (
        with_velocities(task, here, velocities_between(task, before, there, 2.0 - first)),
        with_velocities(task, there, velocities_between(task, here, beyond, 2.0 - last)),
    )


def velocity_names(task: Task, addresses: Int[np.ndarray, " values"]) -> tuple[str, ...]:
    """Names of indices in (qpos, qvel) as in a spec: velocity(JOINT), or velocity(JOINT)[2] where it has several."""
    names = [name.partition("[") for name in dof_names(task)]
    every = [f"velocity({joint}){bracket}{part}" for joint, bracket, part in names]
    return tuple(every[dof] for dof in np.asarray(addresses) - task.model.nq)


def dof_names(task: Task) -> list[str]:
    """Names of degrees of freedom: JOINT, or JOINT[2] where it has several; a joint without a name by its number."""
    model = task.model
    counts, first = np.bincount(model.dof_jntid), model.jnt_dofadr[model.dof_jntid]
    names = [model.joint(joint).name or str(joint) for joint in model.dof_jntid]
    several = counts[model.dof_jntid] > 1
    return [f"{name}[{dof - first[dof]}]" if several[dof] else name for dof, name in enumerate(names)]


def show_velocities(task: Task) -> Task:
    """The same robot with the velocities that its signals do not determine appended: a state can then be rebuilt.

    Raises:
        MadocError: Its signals determine no position.
    """
    posture, observe, sense = task.posture, task.observe, task.sense
    if posture is None:
        raise MadocError(f"an observation of {task.name} determines none of its positions, so no velocities are added")
    size, missing = task.observation_size, missing_velocities(task)

    def rebuild(observation: np.ndarray) -> np.ndarray:
        state = np.asarray(posture(observation[..., :size])).copy()
        state[..., missing] = observation[..., size:]
        return state

    def both(shown: np.ndarray, state: np.ndarray) -> np.ndarray:
        return np.concatenate([shown, state[..., missing]], axis=-1)

    return replace(
        task,
        observation_size=size + len(missing),
        observe=lambda state: both(observe(state), state),
        sense=None if sense is None else lambda state, sensordata: both(sense(state, sensordata), state),
        signals=(*task.signals, *velocity_names(task, missing)),
        state_from_observation=rebuild,
        velocities=len(missing),
    )
