"""Gears of a spec: which joints can have one, and whether a timestep resolves it."""

import mujoco

from madoc.parameters import ParameterSpace
from madoc.robots.drives import single_joint
from madoc.robots.model import Draft
from madoc.simulation.gears import SUFFIX, longest_timestep
from madoc.simulation.write import OF_A_JOINT


def check_gears(draft: Draft) -> None:
    """Refuse a gear of a joint that cannot have one."""
    taken = {part.name for part in (*draft.base.joints, *draft.base.tendons)}
    for index, gear in enumerate(draft.spec.gears):
        place, joint = ("gears", index), single_joint(draft, ("gears", index), gear.joint)
        name = f"{gear.joint}{SUFFIX}"
        if name in taken:
            raise draft.document.error(place, f"the name {name!r} of what a gear inserts is taken; say a gear once")
        if gear.armature is None and joint.armature <= 0.0:
            raise draft.document.error(
                place, f"expected armature:, the inertia of the motor, as the model says none of {gear.joint!r}"
            )
        if joint.parent.joints[-1].name != gear.joint:
            raise draft.document.error(
                place, f"expected the last joint of its body, got {gear.joint!r}; give its link a body of its own"
            )
        if gear.encoder == "link" and _has_servo(draft, gear.joint):
            raise draft.document.error(
                (*place, "encoder"),
                f"a servo of MuJoCo reads the motor's shaft; give the action of {gear.joint!r} a drive:, which reads "
                "the encoder, or say encoder: motor",
            )
        taken.add(name)


def check_timestep(draft: Draft, model: mujoco.MjModel, space: ParameterSpace) -> None:
    """Refuse a timestep that is too long for a gear at the largest stiffness or damping that it may have."""
    for index, gear in enumerate(draft.spec.gears):
        largest = {"gear_stiffness": gear.stiffness, "gear_damping": gear.damping}
        for row in space.parameters:
            if row.field in largest and gear.joint in row.elements:
                largest[row.field] = max(row.high, largest[row.field])
        tendon = model.tendon(f"{gear.joint}{SUFFIX}").id
        longest = longest_timestep(model, tendon, largest["gear_stiffness"], largest["gear_damping"])
        if model.opt.timestep > longest:
            raise draft.document.error(
                ("gears", index),
                f"the gear of {gear.joint!r} is too stiff or too damped for a timestep of {model.opt.timestep:g} s; "
                f"give timestep: of at most {0.95 * longest:.2g} s, or a smaller stiffness or damping",
            )


def encoder_tendon(draft: Draft, joint: str) -> float:
    """Number of the tendon whose length the encoder of a joint shows besides; -1 where it is on the motor's shaft."""
    behind = [index for index, gear in enumerate(draft.spec.gears) if (gear.joint, gear.encoder) == (joint, "link")]
    return float(len(draft.base.tendons) + behind[0]) if behind else -1.0


def _has_servo(draft: Draft, joint: str) -> bool:
    """Whether an actuator of MuJoCo's own reads the position or speed of a joint that it drives."""
    own = any(
        action.joint == joint and action.drive is None and action.means in ("position", "velocity")
        for action in draft.spec.actions
    )
    return own or any(
        int(actuator.trntype) in OF_A_JOINT and actuator.target == joint and any(actuator.biasprm[1:3])
        for actuator in draft.base.actuators
    )
