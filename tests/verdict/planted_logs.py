"""Situations with a known verdict, on the spring and the arm."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from madoc import simulation
from madoc.calibration import CalibrationProblem, LeastSquares, calibrate
from madoc.data import Disturbance, disturb
from madoc.data.dataset import close_episodes, hold_out
from madoc.data.record import record
from madoc.types import Transitions
from madoc.verdict import Bench, assess
from robots import ARM_TRUTH, SPRING_TRUTH, recorded, spring, two_link_arm

ROBOTS = {"spring": (spring(max_episode_steps=100), SPRING_TRUTH), "arm": (two_link_arm(), ARM_TRUTH)}
FEWER = {
    "spring": ["jnt_stiffness.slide", "dof_damping.slide"],
    "arm": ["gravity", "body_mass.upper", "dof_damping.shoulder"],
}
"""What is calibrated where the others stand fixed at the model's own, wrong values."""


def log_of(robot, *, rows=1000, noise=0.0, seed=0):
    task, truth = ROBOTS[robot]
    log = replace(recorded(task, truth, rows, jax.random.key(100 + seed)), true_parameters=None)
    return disturb(log, Disturbance(noise=noise), task, jax.random.key(101 + seed))


def at_rest(robot, rows=1000):
    """A log without any action."""
    task, truth = ROBOTS[robot]
    simulator = simulation.make(task, threads=1)

    def nothing(observation, key=None):
        return jnp.zeros((*observation.shape[:-1], simulator.action_size))

    return record(nothing, simulator, truth, transitions=rows, key=jax.random.key(3), origin="no actions")


def shuffled(log, how, seed=0):
    """A log whose next observations are others', without a word about it.

    `next`: within the log, its episodes as they were; `rows`: observations and actions in a random order, one run, as
    from a table whose rows were mixed up; `episode`: within each episode.
    """
    rng = np.random.default_rng(seed)
    logged = log.transitions
    if how == "next":
        following = rng.permutation(np.asarray(logged.next_observation))
        return replace(log, transitions=replace(logged, next_observation=following))
    if how == "episode":
        spans = zip(log.episode_starts, log.episode_ends, strict=True)
        order = np.concatenate([start + rng.permutation(end - start) for start, end in spans])
        return replace(log, transitions=replace(logged, next_observation=np.asarray(logged.next_observation)[order]))
    order = rng.permutation(len(log))
    observation = np.asarray(logged.observation)[order]
    never = np.zeros(len(log), bool)
    mixed = Transitions(
        observation, np.asarray(logged.action)[order], logged.reward, np.roll(observation, -1, 0), never, never.copy()
    )
    start = np.zeros(1, np.int64)
    return replace(log, transitions=close_episodes(mixed, start), episode_starts=start)


def bench(log, task, seed=0):
    split = hold_out(log, 0.2, jax.random.key(seed))
    problem = CalibrationProblem(split.kept, simulation.make(task, threads=1))
    return Bench(problem, split.held, jax.random.key(seed), split.sentence)


def verdict(log, task, method=None, *, budget=200_000, seed=0):
    """Calibrate to what is kept, and judge: the verdict and what it is made of."""
    judged = bench(log, task, seed)
    result = calibrate(method or LeastSquares(), judged.problem, key=jax.random.key(seed), budget=budget)
    found = assess(result, judged)
    return found.verdict, found.holdout
