"""The paper's robots, all of which walk. The root's x (and y) position never enters their dynamics."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.parameters import Parameter, ParameterSpace
from madoc.tasks.base import Batch, Task, never_terminated
from madoc.tasks.physics import load_robot

VELOCITY_CLIP = 10.0
"""Bound of an observed velocity of Hopper and Walker2d in m/s or rad/s; larger ones are clipped to it."""

Span = tuple[float, float]
"""Lower and upper end of a range."""
Ranges = tuple[Span, Sequence[Span], Sequence[Span]]
"""Ranges of gravity (m/s²), of each mass (kg) and of each damping (N·m·s/rad)."""


def hopper(physics: str = "legacy") -> Task:
    """The Hopper of D4RL and Gymnasium v5: 11 observations, 3 motors, 8 parameters. One leg, which must not fall.

    Rewards are those of v5: D4RL's count one more in the step in which it falls.
    """
    return _walking_task(
        "hopper",
        "hopper.xml",
        physics,
        bodies=("torso", "thigh", "leg", "foot"),
        joints=("thigh_joint", "leg_joint", "foot_joint"),
        ranges={  # Table 7, Jiang et al. 2024: gravity, masses 1-4, damping 3-5.
            "easy": ((-15, -5), ((3, 4), (3.5, 4.5), (2, 3), (4.5, 5.5)), 3 * ((0, 2),)),
            "normal": ((-30, 0), ((3, 5), (3, 5), (2, 4), (4, 6)), 3 * ((0, 3),)),
            "hard": ((-50, 0), ((2, 6), (2, 6), (1, 5), (3, 7)), 3 * ((0, 4),)),
        },
        positions=6,
        velocities=6,
        clipped=True,
        frame_skip=4,
        dt=0.008,
        cost=1e-3,
        terminated=hopper_fallen,
        groups=4,
        reference_returns=(-20.272305, 3234.3),
    )


def hopper_fallen(next_state: Batch) -> Batch:
    """Below 0.7 m, tilted by more than 0.2 rad, or any coordinate but x past 100."""
    height, angle = next_state[..., 1], next_state[..., 2]
    within = (abs(next_state[..., 2:]) < 100.0).all(-1)
    return ~(within & (height > 0.7) & (abs(angle) < 0.2))


def half_cheetah(physics: str = "legacy") -> Task:
    """The HalfCheetah of D4RL and Gymnasium: 17 observations, 6 motors, 14 parameters. It never terminates."""
    return _walking_task(
        "halfcheetah",
        "half_cheetah.xml",
        physics,
        bodies=("torso", "bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"),
        joints=("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"),
        ranges={  # Table 6, Jiang et al. 2024: gravity, masses 1-7, damping 3-8.
            "easy": (
                (-15, -5),
                ((6, 7), (1, 2), (1, 2), (0.5, 1.5), (1, 2), (0.5, 1.5), (0.5, 1.5)),
                ((4.5, 7.5), (3, 6), (1.5, 4.5), (3, 6), (1.5, 4.5), (0, 3)),
            ),
            "normal": ((-30, 0), ((5, 7), *6 * ((0, 2),)), (*3 * ((1.5, 7.5),), *3 * ((0, 6),))),
            "hard": ((-50, 0), ((4, 8), *6 * ((0, 3),)), 6 * ((0, 7.5),)),
        },
        positions=9,
        velocities=9,
        clipped=False,
        frame_skip=5,
        dt=0.05,
        cost=0.1,
        reference_returns=(-280.178953, 12135.0),
        total_mass=14.0,
    )


def walker2d(physics: str = "legacy") -> Task:
    """The Walker2d of D4RL and Gymnasium v2 to v4: 17 observations, 6 motors, 14 parameters. It must not fall.

    Rewards are those of v5: the earlier ones count one more in the step in which it falls.
    """

    def masses(heavy: Span, light: Span) -> tuple[Span, ...]:
        return (heavy, heavy, light, light, heavy, light, light)  # torso and thighs are heavy

    return _walking_task(
        "walker2d",
        "walker2d.xml",
        physics,
        bodies=("torso", "thigh", "leg", "foot", "thigh_left", "leg_left", "foot_left"),
        joints=("thigh_joint", "leg_joint", "foot_joint", "thigh_left_joint", "leg_left_joint", "foot_left_joint"),
        # "normal" is the paper's own (its code). "easy" and "hard" are by analogy with Hopper: masses 1 and 4 kg
        # wide about the same centres, gravity as everywhere, damping of two thirds and four thirds the width.
        ranges={
            "easy": ((-15, -5), masses((3.5, 4.5), (2.5, 3.5)), 6 * ((0, 0.33),)),
            "normal": ((-30, 0), masses((3, 5), (2, 4)), 6 * ((0, 0.5),)),
            "hard": ((-50, 0), masses((2, 6), (1, 5)), 6 * ((0, 0.67),)),
        },
        positions=9,
        velocities=9,
        clipped=True,
        frame_skip=4,
        dt=0.008,
        cost=1e-3,
        terminated=walker2d_fallen,
        reference_returns=(1.629008, 4592.3),
    )


def walker2d_fallen(next_state: Batch) -> Batch:
    """Height outside (0.8, 2) m or tilted by more than 1 rad."""
    height, angle = next_state[..., 1], next_state[..., 2]
    return ~((height > 0.8) & (height < 2.0) & (abs(angle) < 1.0))


def ant(physics: str = "legacy") -> Task:
    """The Ant of D4RL without its always-zero contact forces: 27 observations, 8 motors, 12 parameters.

    Its reward is Gymnasium's without the contact cost, which mujoco-py 2.x (D4RL) always had as zero.
    """

    def spans(gravity: Span, torso: Span, legs: Span, damping: Span) -> Ranges:
        return gravity, (torso, *6 * (legs,)), 4 * (damping,)

    return _walking_task(
        "ant",
        "ant.xml",
        physics,
        # Bodies 1-7 of the paper's Table 9. The lower legs have no name of their own: their joints name them.
        bodies=("torso", "front_left_leg", "aux_1", "ankle_1", "front_right_leg", "aux_2", "ankle_2"),
        joints=("hip_1", "ankle_1", "hip_2", "ankle_2"),
        # "normal" is the paper's Table 9. "easy" and "hard" are by analogy with Hopper: half and twice the width.
        ranges={
            "easy": spans((-15, -5), (0.2, 0.45), (0.02, 0.07), (0, 2)),
            "normal": spans((-30, 0), (0, 0.5), (0, 0.1), (0, 3)),
            "hard": spans((-50, 0), (0, 1.0), (0, 0.2), (0, 4)),
        },
        positions=15,
        velocities=14,
        root=2,
        clipped=False,
        frame_skip=5,
        dt=0.05,
        cost=0.5,
        terminated=ant_fallen,
        reference_returns=(-325.6, 3879.7),
    )


def ant_fallen(next_state: Batch) -> Batch:
    """Torso outside [0.2, 1] m, or a coordinate that is not finite."""
    height = next_state[..., 2]
    finite = (abs(next_state) < float("inf")).all(-1)
    return ~(finite & (height >= 0.2) & (height <= 1.0))


def _walking_task(
    name: str,
    file: str,
    physics: str,
    *,
    bodies: Sequence[str],
    joints: Sequence[str],
    ranges: Mapping[str, Ranges],
    positions: int,
    velocities: int,
    root: int = 1,
    clipped: bool,
    frame_skip: int,
    dt: float,
    cost: float,
    terminated: Callable[[Batch], Batch] | None = None,
    groups: int = 6,
    reference_returns: tuple[float, float],
    total_mass: float | None = None,
) -> Task:
    """A robot of the paper, from a file of Gymnasium's MuJoCo assets.

    The masses of `bodies` and the damping of `joints` are calibrated, by level within `ranges`, of which `normal` is
    the task's own. A state has `positions` and `velocities`; an observation leaves out the first `root` positions.
    Observed velocities of Hopper and Walker2d are `clipped`, and their resets as uniform as Gymnasium's. `dt` (s) and
    `cost` are those of `_forward_reward`. The model's masses are scaled to `total_mass` in kg where it is given. The
    other arguments are attributes of `Task`.
    """
    spaces = {level: _space(bodies, joints, spans) for level, spans in ranges.items()}
    seen, noise = positions - root, _uniform_noise if clipped else _uniform_and_normal_noise
    return Task(
        name=name,
        physics=physics,
        spec=partial(load_robot, file, physics, total_mass),
        frame_skip=frame_skip,
        observation_size=seen + velocities,
        observe=partial(_observe, root=root, positions=positions, clipped=clipped),
        reward=partial(_forward_reward, dt=dt, cost=cost, terminated=terminated),
        terminated=terminated or never_terminated,
        reset_noise=partial(noise, positions=positions, velocities=velocities),
        parameters=spaces["normal"],
        ranges=spaces,
        groups=groups,
        max_episode_steps=1000,
        reference_returns=reference_returns,
        state_from_observation=partial(_with_root, root=root),
        rebuildable=partial(_unclipped, positions=seen) if clipped else _always,
        velocities=velocities,
    )


def _forward_reward(
    state: Batch,
    action: Batch,
    next_state: Batch,
    *,
    dt: float,
    cost: float,
    terminated: Callable[[Batch], Batch] | None,
) -> Batch:
    """Velocity along the first coordinate (m/s), plus 1 where not `terminated`, less `cost` · the squared action."""
    speed = (next_state[..., 0] - state[..., 0]) / dt
    healthy = speed if terminated is None else speed + ~terminated(next_state)
    return healthy - cost * (action**2).sum(-1)


def _uniform_noise(key: PRNGKeyArray, count: int, *, positions: int, velocities: int) -> jax.Array:
    """Offsets of an initial state, uniform in ±0.005, shape (count, positions + velocities)."""
    return jax.random.uniform(key, (count, positions + velocities), minval=-5e-3, maxval=5e-3)


def _uniform_and_normal_noise(key: PRNGKeyArray, count: int, *, positions: int, velocities: int) -> jax.Array:
    """Offsets of an initial state, as Gymnasium's: positions uniform in ±0.1, velocities normal with deviation 0.1."""
    of_position, of_velocity = jax.random.split(key)
    uniform = jax.random.uniform(of_position, (count, positions), minval=-0.1, maxval=0.1)
    normal = 0.1 * jax.random.normal(of_velocity, (count, velocities))
    return jax.numpy.concatenate([uniform, normal], axis=-1)


def _space(bodies: Sequence[str], joints: Sequence[str], ranges: Ranges) -> ParameterSpace:
    """The paper's box: gravity, masses of bodies, damping of joints, in this order."""
    gravity, masses, dampings = ranges
    return ParameterSpace(
        (
            Parameter("gravity", "", *gravity),
            *(Parameter("body_mass", body, *span) for body, span in zip(bodies, masses, strict=True)),
            *(Parameter("dof_damping", joint, *span) for joint, span in zip(joints, dampings, strict=True)),
        )
    )


def _observe(state: Batch, *, root: int, positions: int, clipped: bool) -> Batch:
    """Every position but the root's, then the velocities, clipped or not."""
    if not clipped:
        return state[..., root:]
    namespace = state.__array_namespace__()
    velocity = namespace.clip(state[..., positions:], -VELOCITY_CLIP, VELOCITY_CLIP)
    return namespace.concat([state[..., root:positions], velocity], axis=-1)


def _with_root(observation: Batch, *, root: int) -> Batch:
    """The state whose root is at 0."""
    namespace = observation.__array_namespace__()
    return namespace.concat([namespace.zeros_like(observation[..., :root]), observation], axis=-1)


def _unclipped(observation: Batch, *, positions: int) -> Batch:
    """Whether no velocity of a row is at the clip: only then can its state be rebuilt."""
    return (abs(observation[..., positions:]) < VELOCITY_CLIP).all(-1)


def _always(observation: Batch) -> Batch:
    """Every row determines its state."""
    return np.ones(observation.shape[:-1], dtype=bool)
