"""Readings of an inertial measurement unit against each other: of a right log nothing is told, of each mistake one."""

import mujoco
import numpy as np
import pytest
from logged_arm import write_csv

from madoc import robots
from madoc.data import logs
from madoc.diagnosis.inertial import inertial_findings

STEP = 0.02
MODEL = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <body name="head"><joint name="yaw" axis="0 0 1" damping="0.5" armature="0.1"/>
      <geom size="0.1" mass="1"/>
      <body name="neck"><joint name="pitch" axis="0 1 0" damping="0.5" armature="0.1"/>
        <geom size="0.1" mass="1"/><site name="other" euler="0 0 90"/>
        <site name="imu" pos="0.05 0 0.1" euler="90 0 30"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="yaw" joint="yaw" kp="20"/><position name="pitch" joint="pitch" kp="20"/></actuator>
  <sensor>
    <framequat name="attitude" objtype="{of}" objname="{name}"/>
    <gyro name="gyro" site="imu"/><accelerometer name="accelerometer" site="imu"/>
  </sensor>
</mujoco>
"""
SIGNALS = {"w": "attitude)[0]", "x": "attitude)[1]", "y": "attitude)[2]", "z": "attitude)[3]"}
SIGNALS |= {f"g{axis}": f"gyro)[{index}]" for index, axis in enumerate("xyz")}
SIGNALS |= {f"a{axis}": f"accelerometer)[{index}]" for index, axis in enumerate("xyz")}
QUATERNION, GYRO, ACCELEROMETER = (list(SIGNALS)[part] for part in (slice(4), slice(4, 7), slice(7, 10)))


@pytest.fixture
def told(tmp_path):
    """The findings on a log of a head that looks about, changed by a function of its columns."""

    def run(change=lambda columns: columns, *, of="site", name="imu", left_out=(), called="attitude"):
        model = MODEL.format(of=of, name=name).replace('"attitude"', f'"{called}"')
        (tmp_path / "head.xml").write_text(model)
        signals = "".join(
            f'  - {{name: {each}, reads: "sensor({text.replace("attitude", repr(called))}"}}\n'
            for each, text in SIGNALS.items()
            if each not in left_out
        )
        (tmp_path / "head.yaml").write_text(
            f"madoc: 1\nname: head\nmodel: head.xml\ncontrol_step: {STEP}\nsignals:\n{signals}actions:\n"
            "  - {name: yaw, actuator: yaw, low: -2, high: 2}\n  - {name: pitch, actuator: pitch, low: -2, high: 2}\n"
            "parameters:\n  - {field: body_mass, element: neck, low: 0.5, high: 2}\n"
        )
        robot = robots.load(tmp_path / "head.yaml")
        columns = {"time": STEP * np.arange(400)} | change(recorded(model))
        dataset = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
        return [(each.level, each.where, each.what) for each in inertial_findings(dataset, robot, STEP)]

    return run


def recorded(text, rows=400):
    """Readings before each action, with the noise of a cheap sensor."""
    model, random = mujoco.MjModel.from_xml_string(text), np.random.default_rng(0)
    data, time = mujoco.MjData(model), STEP * np.arange(rows)
    actions = np.stack([1.5 * np.sin(1.7 * time), 0.8 * np.sin(2.9 * time + 1.0)], axis=-1)
    readings = []
    for action in actions:
        data.ctrl = action
        mujoco.mj_forward(model, data)
        readings.append(data.sensordata.copy())
        mujoco.mj_step(model, data, round(STEP / model.opt.timestep))
    noisy = np.array(readings) + 1e-3 * random.standard_normal((rows, 10))
    return dict(zip(SIGNALS, noisy.T, strict=True)) | dict(zip(("yaw", "pitch"), actions.T, strict=True))


def scaled(names, factor):
    return lambda columns: columns | {name: factor * columns[name] for name in names}


def reordered(names):
    return lambda columns: columns | dict(zip(QUATERNION, [columns[name] for name in names], strict=True))


@pytest.mark.parametrize("fixed", [("site", "imu"), ("site", "other"), ("xbody", "neck"), ("body", "neck")])
def test_of_a_right_log_nothing_is_told(told, fixed):
    """The attitude may be that of another frame of the gyroscope's body."""
    assert told(of=fixed[0], name=fixed[1]) == []


def test_an_attitude_of_another_body_is_not_compared(told):
    assert told(scaled(GYRO, 57.3), of="xbody", name="head") == []


@pytest.mark.parametrize("fixed", [("site", "imu"), ("xbody", "neck")])
def test_another_order_of_the_quaternion(told, fixed):
    (finding,) = told(reordered("xyzw"), of=fixed[0], name=fixed[1])
    assert finding == ("warning", "w, x, y, z", "their changes agree with sensor(gyro) as x, y, z, w")


def test_a_sensor_may_have_any_name(told):
    assert told(called="imu-quat") == []
    ((_, where, _),) = told(reordered("xyzw"), called="imu-quat")
    assert where == "w, x, y, z"
    ((_, where, _),) = told(left_out=("w",), called="imu-quat")
    assert where == "sensor(imu-quat)"


def test_a_quaternion_that_turns_the_other_way(told):
    (finding,) = told(scaled("xyz", -1.0))
    assert finding == (
        "warning",
        "w, x, y, z",
        "their changes agree with sensor(gyro) as w, x, y, z, with x, y and z negated",
    )


def test_a_reading_of_zeros_is_a_gap(told):
    def dropped(columns):
        return columns | {name: np.where(np.arange(400) % 50 == 10, 0.0, columns[name]) for name in QUATERNION}

    assert told(dropped) == []
    ((_, where, _),) = told(lambda columns: reordered("xyzw")(dropped(columns)))
    assert where == "w, x, y, z"


@pytest.mark.parametrize(("factor", "length"), [(16384.0, "1.64e+04"), (0.0, "0")])
def test_four_values_that_are_no_quaternion(told, factor, length):
    (finding,) = told(scaled(QUATERNION, factor))
    assert finding == ("fatal", "w, x, y, z", f"their length is {length}, and that of a quaternion is 1")


def test_a_gyroscope_in_degrees(told):
    ((level, where, what),) = told(scaled(GYRO, 180.0 / np.pi))
    assert (level, where) == ("warning", "sensor(gyro)")
    assert what.startswith("it turns 56.9 times as fast as the attitude of w, x, y, z: ") and what.endswith(
        "one in degrees, the other in radians?"
    )


def test_an_accelerometer_in_g(told):
    ((level, where, what),) = told(scaled(ACCELEROMETER, 1.0 / 9.81))
    assert (level, where) == ("warning", "sensor(accelerometer)")
    assert "where gravity is 9.81 m/s²: in g?" in what


def test_an_accelerometer_without_gravity(told):
    (finding,) = told(scaled(ACCELEROMETER, 0.02))
    assert finding[2].startswith("its reading is 0.198 m/s² long in the median, and at rest it would be 9.81")


def test_a_quaternion_with_a_value_left_out(told):
    (finding,) = told(left_out=("w",))
    assert finding == ("warning", "sensor(attitude)", "signals show 3 of its 4 values, which tell no attitude")
