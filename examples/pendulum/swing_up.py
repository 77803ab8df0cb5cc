"""Swing the pendulum of `swing_up_python.yaml` up, and hold it there with little torque."""

import numpy as np


def reward(angle, speed, torque):
    """1 upright and at rest; less where it is held up with a large torque."""
    upright = (1 - np.cos(angle)) / 2
    return upright - 0.01 * torque**2 * (upright > 0.9)


def end(position):
    """It may not wind up."""
    return abs(position["hinge"]) > 2 * np.pi


def reset(random, count):
    """From hanging nearly still."""
    return {"position(hinge)": random.uniform(-0.3, 0.3, count), "velocity(hinge)": random.normal(0, 0.2, count)}
