"""What drives of a class of machines are like: ranges for a first spec, from machines that were identified."""

from dataclasses import dataclass

Ends = tuple[float, float]


@dataclass(frozen=True)
class Recipe:
    """Ranges of a hinge's drive, at the joint; None leaves what follows from the model.

    Attributes:
        about: The machines that the ranges are of, for the spec's comment.
        armature: Reflected inertia of the rotor, kg·m².
        friction: Coulomb friction, N·m.
        damping: Viscous friction, N·m·s/rad.
        kp: Stiffness of the position servo, N·m/rad.
        delay: From a command to its effect, s.
        means: What the log's action of a joint is that the model does not drive.
        limit: Torque limit of such a drive, N·m.
    """

    about: str
    armature: Ends | None = None
    friction: Ends | None = None
    damping: Ends | None = None
    kp: Ends | None = None
    delay: Ends | None = None
    means: str = "position"
    limit: float | None = None


_GEARMOTOR = Recipe(
    "Dynamixel XL330 and MX-64 (BAM)", (0.0005, 0.05), (0.0, 0.5), (0.0, 0.5), delay=(0.0, 0.02), means="torque"
)
RECIPES = {
    "hobby-servo": Recipe(
        "Feetech STS3215 and Dynamixel XL330 (BAM); kp of an STS3215 at 7.4 V is 0.556 times its firmware's P",
        (0.001, 0.05),
        (0.0, 0.6),  # 0.2 N·m, and a quarter of half of the largest torque, as friction grows with the load
        (0.0, 1.0),
        (4.0, 40.0),
        (0.0, 0.02),
        limit=3.25,
    ),
    "harmonic-arm": Recipe("eRob 80:50 (BAM), Franka's wrist", (0.05, 1.0), (0.0, 7.0), (0.0, 5.0), delay=(0.0, 0.01)),
    "direct-drive-leg": Recipe(
        "Unitree Go1, Go2 and G1, ANYmal (PACE)", (0.002, 0.1), (0.0, 1.0), (0.0, 1.0), delay=(0.0, 0.025)
    ),
    "dc-gearmotor": _GEARMOTOR,
    "wheeled": _GEARMOTOR,
    "drone": Recipe("none: mass, inertia and thrust within what a model's file is usually wrong by", delay=(0.0, 0.05)),
}
"""By name of the class. BAM is Rhoban/bam, PACE leggedrobotics/pace-sim2real; of Go1 and G1 the values are mjlab's, of
Go2 those of repeated identifications (iit-DLSLab/sim2real-robot-identification, issue 8)."""
