"""A spec on its way to a task: what it says, on which line, and the model as it is in its file."""

from dataclasses import dataclass

import mujoco
import numpy as np

from madoc.robots.document import Document
from madoc.robots.model import ModelFiles
from madoc.robots.spec import RobotSpec

SCALES: dict[str, float] = {
    **dict.fromkeys(("deg", "deg/s", "°", "°/s"), np.pi / 180.0),
    **dict.fromkeys(("mm", "mm/s", "mN·m", "mNm", "N·mm", "Nmm", "mN"), 1e-3),
    **dict.fromkeys(("cm", "cm/s"), 1e-2),
    **dict.fromkeys(("km/h",), 1.0 / 3.6),
}
"""Units that are not SI's, in SI's."""


@dataclass(frozen=True)
class Draft:
    """A spec with its lines, and the model as it is in its file."""

    spec: RobotSpec
    document: Document
    files: ModelFiles
    base: mujoco.MjSpec
    plain: mujoco.MjModel
