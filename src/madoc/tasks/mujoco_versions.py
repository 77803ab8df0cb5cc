"""The versions of MuJoCo that models are made and stepped by, and a refusal of the others."""

import re

import mujoco

from madoc.errors import MadocError

LACKING = {"3.7": "MjModel.dof_dampingpoly", "3.8": "an MjSpec.modelfiledir that can be changed"}
"""What Madoc uses of MuJoCo, by the first version that has it: the first for `dof_drag`, the other for exports."""

OLDEST = [*LACKING][-1]

WRONG = {"4.0.0": "solves contacts with a wrong factorisation"}
"""Versions that compute something wrong, and what: issue 3767 of MuJoCo, mended in 4.0.1."""


def refuse_unfit_mujoco(version: str = mujoco.__version__) -> None:
    """Raise a `MadocError` where the installed MuJoCo is too old for what Madoc uses of it, or computes wrongly."""
    reasons = [f"lacks {what}" for first, what in LACKING.items() if _numbers(version) < _numbers(first)]
    reasons += [WRONG[version]] if version in WRONG else []
    if reasons:
        others = "".join(f",!={other}" for other in WRONG)
        raise MadocError(f"MuJoCo {version} {reasons[0]}; install another one: pip install 'mujoco>={OLDEST}{others}'")


def _numbers(version: str) -> tuple[int, ...]:
    """Major and minor number."""
    return tuple(int(number) for number in re.findall(r"\d+", version)[:2])
