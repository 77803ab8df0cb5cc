"""A log of the two-link arm that MuJoCo alone has made, without any of Madoc's simulators."""

import mujoco
import numpy as np

from robots import ARM

NAMES = ("shoulder", "elbow", "shoulder_speed", "elbow_speed")
LOW, HIGH = np.array([-0.5, 0.0]), np.array([0.5, 0.4])
"""Limits of the torques in the spec of `logged_arm`, N·m."""


def recorded(
    rows: int = 1200, *, late: int = 0, spacing: float = 0.02, noise: float = 0.0, feedback: float = 0.0
) -> dict[str, np.ndarray]:
    """Columns of a log under torques that change at random every fifth row.

    Args:
        rows: Number of rows.
        late: Time from a torque to its effect, in physics steps of a tenth of a row, at most 50.
        spacing: Time between two rows; the `time` column says 0.02 s.
        noise: Standard deviation of the readings, rad and rad/s.
        feedback: Torque of the shoulder against its speed as it is read, N·m·s/rad.
    """
    model = mujoco.MjModel.from_xml_string(ARM)
    model.opt.timestep = spacing / 10.0
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    wanted = np.repeat(random.uniform(LOW, HIGH, (rows // 5 + 1, 2)), 5, axis=0)
    torques = np.zeros((50 + 10 * rows, 2))  # by physics step, after five rows of none
    seen, taken = np.zeros((rows, 4)), np.zeros((rows, 2))
    for row in range(rows):
        seen[row] = np.concatenate([data.qpos, data.qvel]) + noise * random.standard_normal(4)
        taken[row] = np.clip(wanted[row] - feedback * seen[row, 2] * np.array([1.0, 0.0]), LOW, HIGH)
        torques[50 + 10 * row : 60 + 10 * row] = taken[row]
        for step in range(10):
            data.ctrl[:] = torques[50 + 10 * row + step - late]
            mujoco.mj_step(model, data)
    columns = {"time": 0.02 * np.arange(rows), **dict(zip(NAMES, seen.T, strict=True))}
    return columns | dict(zip(("shoulder_torque", "elbow_torque"), taken.T, strict=True))
