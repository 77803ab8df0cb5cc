"""Scales that no log can show, found from the model."""

import pytest
from logged_arm import SPEC, arm_of, write_csv
from mujoco_log import recorded

from madoc import robots, simulation
from madoc.data import logs
from madoc.diagnosis import check
from own_robots import CART, CART_SPEC

SCALED = (
    SPEC.replace("body_mass", "body_mass_and_inertia")
    + """\
  - {field: actuator_gain, element: shoulder, low: 0.5, high: 2}
  - {field: actuator_gain, element: elbow, low: 0.5, high: 2}
"""
)
PLACE, RATIOS, MASSES = (
    "check one distance with a ruler",
    "only ratios can be found",
    "a gear and all masses scaled alike",
)


@pytest.fixture
def told(tmp_path):
    """The sentences of all findings on a log."""

    def run(robot, columns):
        dataset = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
        found = check(dataset, simulation.make(robot.task, threads=1), robot=robot)
        return [(finding.level, finding.sentence) for finding in found.findings]

    return run


def test_what_masses_rest_on(told, tmp_path):
    """Gains are known: masses are found, as far as the gains are right. Gravity keeps the scale of positions."""
    (note,) = told(arm_of(tmp_path), recorded(300))
    assert note[0] == "note"
    assert MASSES in note[1]


def test_gains_and_masses_together_are_found_as_ratios(told, tmp_path):
    found = told(arm_of(tmp_path, SCALED), recorded(300))
    (warning,) = [sentence for level, sentence in found if level == "warning" and RATIOS in sentence]
    assert all(name in warning for name in ("inertia.upper, ", "inertia.fore, ", "damping.elbow, ", "gain.shoulder, "))
    assert not any("does not identify" in sentence for _, sentence in found)


def test_a_cart_without_gravity_has_no_scale_of_positions(told, tmp_path):
    (tmp_path / "cart.xml").write_text(CART)
    (tmp_path / "cart.yaml").write_text(CART_SPEC)
    robot = robots.load(tmp_path / "cart.yaml")
    arm = recorded(300)
    columns = {"time": arm["time"], "push": arm["shoulder_torque"], "speed": arm["shoulder_speed"]}
    found = told(robot, columns | {"place": arm["shoulder"]})
    assert any(PLACE in sentence for _, sentence in found)
