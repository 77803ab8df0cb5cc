"""Scales that no log can show, found from the model."""

import jax
import mujoco
import numpy as np
import pytest
from logged_arm import SPEC, arm_of, write_csv
from mujoco_log import recorded

from madoc import robots, simulation
from madoc.data import logs, stride
from madoc.diagnosis import check, scales
from madoc.diagnosis.scales import COARSE, coarseness, range_findings
from madoc.identification.states import states_of
from own_robots import BOUNCER, BOUNCER_SPEC, CART, CART_SPEC, task_of
from robots import counted
from robots import recorded as planted

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
    "are as right as the masses and the gains of drives that are not calibrated",
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


BOX = """\
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="box" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="box" type="box" size="0.1 0.1 0.1" mass="1.6" friction="0.5 0.005 0.0001" priority="1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x" ctrllimited="true" ctrlrange="-25 25"/></actuator>
</mujoco>
"""
BOX_SPEC = """\
madoc: 1
name: box
model: box.xml
control_step: 0.02
signals:
  - {name: x, reads: position(x)}
  - {name: z, reads: position(z)}
  - {name: x_speed, reads: velocity(x)}
  - {name: z_speed, reads: velocity(z)}
actions:
  - {name: push, actuator: push, low: -25, high: 25}
parameters:
  - {field: body_mass, element: box, low: 1.5, high: 1.7}
"""


@pytest.fixture
def box(tmp_path):
    """A box whose hops on the floor are shorter than a few integration steps, and a log of it."""
    (tmp_path / "box.xml").write_text(BOX)
    (tmp_path / "box.yaml").write_text(BOX_SPEC)
    model = mujoco.MjModel.from_xml_string(BOX)
    data, random, rows = mujoco.MjData(model), np.random.default_rng(0), []
    model.opt.timestep = 0.001
    for row in range(300):
        if row % 10 == 0:
            data.ctrl[:] = random.uniform(-25.0, 25.0)
        rows.append([data.time, *data.qpos, *data.qvel, *data.ctrl])
        mujoco.mj_step(model, data, 20)
    columns = dict(zip(["time", "x", "z", "x_speed", "z_speed", "push"], np.array(rows).T, strict=True))
    robot = robots.load(tmp_path / "box.yaml")
    return robot, logs.read(write_csv(tmp_path / "log.csv", columns), robot)


def test_a_timestep_that_is_too_long_for_its_contacts_is_told_with_a_shorter_one(box):
    robot, dataset = box
    found = check(dataset, simulation.make(robot.task, threads=1), robot=robot)
    (finding,) = [each for each in found.findings if "timestep" in each.what]
    assert (finding.level, finding.where) == ("warning", "the model")
    assert "its timestep of 0.005 s is too long: with 0.00125 s predictions of half of the signals" in finding.what
    assert finding.do.startswith("give timestep: 0.00125 in the spec")


def test_a_timestep_that_diverges_counts_as_too_long(box, monkeypatch):
    robot, dataset = box
    simulator = simulation.make(robot.task, threads=1)
    both = iter([np.full((1, 64, 4), np.nan), np.zeros((1, 64, 4))])
    monkeypatch.setattr(scales, "window_residuals", lambda *_: next(both))
    assert coarseness(dataset, states_of(dataset, simulator), simulator, np.zeros(1), np.ones(4)) == 1.0


def test_smooth_motion_hardly_depends_on_the_timestep(tmp_path):
    (tmp_path / "cart.xml").write_text(CART)
    (tmp_path / "cart.yaml").write_text(CART_SPEC)
    robot = robots.load(tmp_path / "cart.yaml")
    random = np.random.default_rng(0)
    columns = {"time": 0.02 * np.arange(100)} | {
        name: random.standard_normal(100) for name in ("place", "speed", "push")
    }
    dataset = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
    simulator = simulation.make(robot.task, threads=1)
    middle = np.zeros(len(simulator.parameters))
    change, spent = counted(coarseness, dataset, states_of(dataset, simulator), simulator, middle, np.ones(2))
    assert 0.0 < change < COARSE / 10
    assert spent == 2 * 64 * stride(dataset)


@pytest.mark.parametrize(
    ("line", "level", "sentence"),
    [
        (
            "action_delay, low: 0, high: 9",
            "fatal",
            "up to 9 s late in the ranges of delays and lags, and the longest",
        ),
        ("payload_x, element: fore, low: -50, high: 50", "warning", "payload_x.fore: the load may be 50 m off, and"),
    ],
)
def test_ranges_that_cannot_be(told, tmp_path, line, level, sentence):
    spec = SPEC + "  - {field: payload_mass, element: fore, low: 0, high: 1}\n  - {field: " + line + "}\n"
    found = told(arm_of(tmp_path, spec), recorded(300))
    assert any(sentence in each and level == found_level for found_level, each in found), found


def test_contacts_too_stiff_for_the_timestep(tmp_path):
    contact = "  - {field: contact_time, element: foot, low: 0.0001, high: 0.02}\n"
    spec = BOUNCER_SPEC.replace("max_episode_steps", contact + "max_episode_steps")
    leg = BOUNCER.replace('size=".05" pos', 'name="foot" size=".05" pos')
    task = task_of(tmp_path, spec, bouncer=leg)
    truth = dict(zip(task.parameters.names, task.parameters.middle.tolist(), strict=True))
    dataset = planted(task, truth, 60, jax.random.key(0))
    (found,) = range_findings(dataset, simulation.make(task, threads=1))
    assert found.sentence.startswith("contact_time.foot: MuJoCo takes two timesteps, 0.01 s, where the time constant")
