"""A spec while it is made into a task: its content, its lines, and the model of its file."""

from dataclasses import dataclass

import mujoco
import numpy as np

from madoc.robots.document import Document
from madoc.robots.spec import RobotSpec

SCALES: dict[str, float] = {
    **dict.fromkeys(("deg", "deg/s", "°", "°/s"), np.pi / 180.0),
    **dict.fromkeys(("mm", "mm/s", "mN·m", "mNm", "N·mm", "Nmm", "mN"), 1e-3),
    **dict.fromkeys(("cm", "cm/s"), 1e-2),
    **dict.fromkeys(("km/h",), 1.0 / 3.6),
}
"""Units that are converted, each as a multiple of its SI unit."""


@dataclass(frozen=True)
class Draft:
    """A spec with its lines, and the MuJoCo spec of its model file, without the actuators that it adds."""

    spec: RobotSpec
    document: Document
    base: mujoco.MjSpec
