"""The paper's targets: the true parameters of each robot. Truth belongs to a target, never to a task."""

from madoc.errors import MadocError


def _values(masses: dict[str, float], dampings: dict[str, float]) -> dict[str, float]:
    return (
        {"gravity": -9.81}
        | {f"body_mass.{body}": mass for body, mass in masses.items()}
        | {f"dof_damping.{joint}": damping for joint, damping in dampings.items()}
    )


PAPER_TRUTH: dict[str, dict[str, float]] = {
    "hopper": _values(
        {"torso": 3.53, "thigh": 3.93, "leg": 2.71, "foot": 5.08},
        {"thigh_joint": 1.0, "leg_joint": 1.0, "foot_joint": 1.0},
    ),
    "halfcheetah": _values(
        {"torso": 6.36, "bthigh": 1.54, "bshin": 1.58, "bfoot": 1.07, "fthigh": 1.43, "fshin": 1.18, "ffoot": 0.85},
        {"bthigh": 6.0, "bshin": 4.5, "bfoot": 3.0, "fthigh": 4.5, "fshin": 3.0, "ffoot": 1.5},
    ),
    "walker2d": _values(
        {"torso": 3.53}
        | {"thigh": 3.93, "leg": 2.71, "foot": 2.94}
        | {"thigh_left": 3.93, "leg_left": 2.71, "foot_left": 2.94},
        {f"{part}{side}_joint": 0.1 for side in ("", "_left") for part in ("thigh", "leg", "foot")},
    ),
    "ant": _values(
        {"torso": 0.33}
        | {"front_left_leg": 0.036, "aux_1": 0.036, "ankle_1": 0.065}
        | {"front_right_leg": 0.036, "aux_2": 0.036, "ankle_2": 0.065},
        {"hip_1": 1.0, "ankle_1": 1.0, "hip_2": 1.0, "ankle_2": 1.0},
    ),
}
"""Physical values by robot and parameter: tables 6-9, Jiang et al. 2024 (appendix D); kg and N·m·s/rad."""


def paper_truth(task_name: str) -> dict[str, float]:
    """The paper's true parameters of a robot, by name, in physical units; any other robot is refused."""
    if task_name not in PAPER_TRUTH:
        raise MadocError(f"the paper has no target for {task_name!r}; it has: {', '.join(PAPER_TRUTH)}")
    return dict(PAPER_TRUTH[task_name])
