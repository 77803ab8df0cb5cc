"""The paper's targets: the true parameters of each robot. Truth belongs to a target, never to a task."""

from madoc.errors import MadocError

# Tables 6-9, Jiang et al. 2024 (appendix D).
PAPER_TRUTH: dict[str, dict[str, float]] = {
    "hopper": {
        "gravity": -9.81,
        "body_mass.torso": 3.53,
        "body_mass.thigh": 3.93,
        "body_mass.leg": 2.71,
        "body_mass.foot": 5.08,
        "dof_damping.thigh_joint": 1.0,
        "dof_damping.leg_joint": 1.0,
        "dof_damping.foot_joint": 1.0,
    },
    "halfcheetah": {
        "gravity": -9.81,
        "body_mass.torso": 6.36,
        "body_mass.bthigh": 1.54,
        "body_mass.bshin": 1.58,
        "body_mass.bfoot": 1.07,
        "body_mass.fthigh": 1.43,
        "body_mass.fshin": 1.18,
        "body_mass.ffoot": 0.85,
        "dof_damping.bthigh": 6.0,
        "dof_damping.bshin": 4.5,
        "dof_damping.bfoot": 3.0,
        "dof_damping.fthigh": 4.5,
        "dof_damping.fshin": 3.0,
        "dof_damping.ffoot": 1.5,
    },
    "walker2d": {
        "gravity": -9.81,
        "body_mass.torso": 3.53,
        "body_mass.thigh": 3.93,
        "body_mass.leg": 2.71,
        "body_mass.foot": 2.94,
        "body_mass.thigh_left": 3.93,
        "body_mass.leg_left": 2.71,
        "body_mass.foot_left": 2.94,
        "dof_damping.thigh_joint": 0.1,
        "dof_damping.leg_joint": 0.1,
        "dof_damping.foot_joint": 0.1,
        "dof_damping.thigh_left_joint": 0.1,
        "dof_damping.leg_left_joint": 0.1,
        "dof_damping.foot_left_joint": 0.1,
    },
    "ant": {
        "gravity": -9.81,
        "body_mass.torso": 0.33,
        "body_mass.front_left_leg": 0.036,
        "body_mass.aux_1": 0.036,
        "body_mass.ankle_1": 0.065,
        "body_mass.front_right_leg": 0.036,
        "body_mass.aux_2": 0.036,
        "body_mass.ankle_2": 0.065,
        "dof_damping.hip_1": 1.0,
        "dof_damping.ankle_1": 1.0,
        "dof_damping.hip_2": 1.0,
        "dof_damping.ankle_2": 1.0,
    },
}


def paper_truth(task_name: str) -> dict[str, float]:
    """The paper's true parameters of a robot, by name, in physical units.

    Raises:
        MadocError: The paper has no such robot.
    """
    if task_name not in PAPER_TRUTH:
        raise MadocError(f"the paper has no target for {task_name!r}; it has: {', '.join(PAPER_TRUTH)}")
    return dict(PAPER_TRUTH[task_name])
