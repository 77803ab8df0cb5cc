"""The calibrated model as MJCF: the same model in every number, wherever it is loaded."""

import contextlib
import json
import struct
import subprocess
import sys
import zlib
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from madoc import robots, simulation, tasks
from madoc.errors import MadocError
from madoc.parameters import INERTIA, Parameter, ParameterSpace
from madoc.simulation import mjcf
from madoc.simulation.mjcf import Change, save_mjcf, shortest_numbers
from robots import spring, two_link_arm

FRESH = """
import json, sys
import mujoco, numpy as np
for case in json.load(open(sys.argv[1])):
    model = mujoco.MjModel.from_xml_path(case["model"])
    data = mujoco.MjData(model)
    for row in case["rows"]:
        data.qpos[:], data.qvel[:], data.ctrl[:] = row["qpos"], row["qvel"], row["ctrl"]
        data.qacc_warmstart[:], data.time = 0, 0
        for _ in range(case["steps"]):
            mujoco.mj_step(model, data)
        off = np.abs(np.concatenate([data.qpos, data.qvel]) - row["next"]).max()
        assert off <= 1e-9, (case["model"], off)
print("same")
"""

OWN = """
madoc: 1
name: lift
model: lift.xml
control_step: 0.02
signals:
  - {name: height, reads: position(rail)}
  - {name: climb, reads: velocity(rail)}
  - {name: tilt, reads: position(hinge)}
  - {name: turn, reads: velocity(hinge)}
actions:
  - {name: target, actuator: target, low: -0.2, high: 0.3}
  - {name: torque, actuator: torque, low: -1, high: 1}
parameters:
  - {field: actuator_gain, element: target, low: 10, high: 60}
  - {field: actuator_kv, element: target, low: 1, high: 6}
  - {field: jnt_ref, element: hinge, low: -0.5, high: 0.5}
  - {field: body_mass_and_inertia, element: block, low: 0.5, high: 3}
  - {field: body_com, element: rod, low: 0.05, high: 0.4}
  - {field: body_inertia, element: rod, low: 0.001, high: 0.02}
  - {field: dof_frictionloss, element: rail, name: drag, low: 0, high: 1}
  - {field: dof_armature, element: hinge, low: 0, high: 0.1}
  - {field: geom_friction, element: sole, low: 0.2, high: 2}
  - {field: geom_friction_rolling, element: sole, low: 0, high: 0.01}
  - {field: contact_time, element: sole, low: 0.01, high: 0.05}
  - {field: contact_damping, element: sole, low: 0.2, high: 2}
  - {field: action_delay, low: 0, high: 0.01}
"""

LIFT = """
<mujoco>
  <compiler meshdir="shapes" texturedir="skins" boundmass="0.01"/>
  <option timestep="0.005"/>
  <asset>
    <mesh name="wedge" file="wedge.obj"/>
    <texture name="grey" type="2d" file="grey.png"/>
    <material name="grey" texture="grey"/>
  </asset>
  <worldbody>
    <body name="block">
      <joint name="rail" type="slide" axis="0 0 1"/>
      <geom type="mesh" mesh="wedge" material="grey"/>
      <body name="rod" pos="0.1 0 0">
        <joint name="hinge" axis="0 1 0" damping="0.05" stiffness="0.1" springref="10" range="-90 120"/>
        <geom name="sole" type="capsule" size="0.02" fromto="0 0 0 0.1 0 -0.3"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="cord" springlength="0.1" stiffness="1" range="-1 2"><joint joint="hinge" coef="1.5"/></fixed>
  </tendon>
  <actuator>
    <position name="target" joint="rail" kp="30" kv="3"/>
    <motor name="torque" joint="hinge"/>
  </actuator>
</mujoco>
"""

WEDGE = "v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nv 0 0 0.3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def png(size=4):
    """A grey square."""

    def part(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    rows = b"".join(b"\0" + bytes(range(row, row + 3 * size)) for row in range(size))
    header = struct.pack(">IIBBBBB", size, size, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", header) + part(b"IDAT", zlib.compress(rows)) + part(b"IEND", b"")


@pytest.fixture
def lift(tmp_path):
    """A robot of a user's own, with a mesh, a texture and a height field, restored from what a run keeps of it."""
    for name, content in {
        "lift.yaml": OWN.encode(),
        "lift.xml": LIFT.encode(),
        "shapes/wedge.obj": WEDGE.encode(),
        "skins/grey.png": png(),
    }.items():
        (tmp_path / "own" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "own" / name).write_bytes(content)
    task = robots.load(tmp_path / "own" / "lift.yaml").task
    restored = robots.restore(json.loads(json.dumps(dict(task.source)))).task
    (tmp_path / "own").rename(tmp_path / "moved")
    return simulation.make(restored, threads=1)


def somewhere(simulator, seed=0):
    """Values inside the ranges."""
    unit = np.random.default_rng(seed).uniform(-0.9, 0.9, len(simulator.parameters))
    return simulator.parameters.to_physical(unit)


def different(one, other):
    """Names of the arrays of numbers in which two models are not the same."""
    names = [name for name in dir(one) if isinstance(getattr(one, name, None), np.ndarray) and name[0] != "_"]
    return [name for name in names if not np.array_equal(getattr(one, name), getattr(other, name))]


@pytest.mark.parametrize("physics", ["legacy", "modern"])
@pytest.mark.parametrize("name", ["hopper", "halfcheetah", "walker2d", "ant"])
def test_a_written_robot_is_the_bound_one_bit_for_bit(name, physics, tmp_path):
    simulator = simulation.make(tasks.make(name, physics), threads=1)
    values = somewhere(simulator)
    save_mjcf(simulator, values, tmp_path / "model.xml")
    assert different(simulator.model(values), mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))) == []


def test_a_fresh_process_steps_written_models_as_the_systems_do(lift, tmp_path):
    cases = []
    robots_tried = {name: simulation.make(tasks.make(name, "legacy"), threads=1) for name in tasks.TASKS}
    for name, simulator in (robots_tried | {"lift": lift, "arm": simulation.make(two_link_arm(), threads=1)}).items():
        values = somewhere(simulator)
        values[[row.field == "action_delay" for row in simulator.parameters.parameters]] = 0.0
        (tmp_path / name).mkdir()
        save_mjcf(simulator, values, tmp_path / name / "model.xml")
        generator, model = np.random.default_rng(1), simulator.model(values)
        state = simulator.initial_state + generator.normal(scale=0.05, size=(1, 20, len(simulator.initial_state)))
        action = generator.uniform(-1, 1, (1, 20, simulator.action_size))
        following = simulator.bind(values[None]).step(state, action)
        assert np.isfinite(following).all()
        rows = [
            {
                "qpos": state[0, row, : model.nq].tolist(),
                "qvel": state[0, row, model.nq : model.nq + model.nv].tolist(),
                "ctrl": simulator._controls(action)[0, row].tolist(),
                "next": following[0, row, : model.nq + model.nv].tolist(),
            }
            for row in range(20)
        ]
        cases.append({"model": str(tmp_path / name / "model.xml"), "steps": simulator.task.frame_skip, "rows": rows})
    (tmp_path / "cases.json").write_text(json.dumps(cases))
    told = subprocess.run(
        [sys.executable, "-c", FRESH, str(tmp_path / "cases.json")],
        capture_output=True,
        text=True,
        cwd="/",
        check=False,
    )
    assert told.stdout == "same\n", told.stderr


def test_assets_lie_beside_a_written_model(lift, tmp_path):
    (tmp_path / "out").mkdir()
    save_mjcf(lift, somewhere(lift), tmp_path / "out" / "model.xml")
    found = sorted(path.name for path in (tmp_path / "out" / "assets").iterdir())
    assert found == ["grey.png", "wedge.obj"]
    assert "moved" not in (tmp_path / "out" / "model.xml").read_text()


def test_only_what_was_calibrated_changes(tmp_path):
    task = spring(Parameter("dof_damping", "slide", 0.0, 2.0), Parameter("body_mass", "cart", 1.0, 3.0))
    changes = save_mjcf(simulation.make(task, threads=1), np.array([1.25, 2.5]), tmp_path / "model.xml")
    assert changes == [
        Change("inertial of body cart", "mass", [2.0], [2.5]),
        Change("joint slide", "damping", [0.5], [1.25]),
    ]
    text = (tmp_path / "model.xml").read_text()
    assert 'mass="2.5"' in text and 'damping="1.25"' in text and 'stiffness="4"' in text


def test_nothing_changes_at_the_robots_own_values(tmp_path):
    task = spring(Parameter("jnt_stiffness", "slide", 1.0, 9.0))
    assert save_mjcf(simulation.make(task, threads=1), np.array([4.0]), tmp_path / "model.xml") == []


def test_drag_is_taken_out_where_none_was_found(tmp_path):
    def dragging():
        spec = spring().spec()
        spec.joints[0].damping = [0.5, 0.2, 0.0]
        return spec

    task = replace(spring(Parameter("dof_drag", "slide", 0.0, 1.0)), spec=dragging)
    (change,) = save_mjcf(simulation.make(task, threads=1), np.array([0.0]), tmp_path / "model.xml")
    assert (change.old[:2], change.new[:1]) == ([0.5, 0.2], [0.5])
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert (written.dof_damping[0], written.dof_dampingpoly[0, 0]) == (0.5, 0.0)


@pytest.mark.parametrize(
    ("written", "short"),
    [
        ('pos="0.050000000000000003 0 -0.69999999999999996"', 'pos="0.05 0 -0.7"'),
        ('size="1.0000000000000001e-05"', 'size="1e-05"'),
        ('range="-2.6179938779914944 0"', 'range="-2.6179938779914944 0"'),
        ('name="rod_0.050000000000000003"', 'name="rod_0.050000000000000003"'),
    ],
)
def test_numbers_are_short_and_the_same(written, short):
    assert shortest_numbers(written) == short


def test_a_rounding_writer_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(mjcf, "_precision", lambda digits: contextlib.nullcontext())
    simulator = simulation.make(tasks.make("hopper", "legacy"), threads=1)
    with pytest.raises(MadocError, match=r"read back from .*model.xml differs from the bound one in "):
        save_mjcf(simulator, somewhere(simulator), tmp_path / "model.xml")


def test_a_change_that_cannot_be_written_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(mjcf, "_changed", lambda nominal, bound: iter(()))
    task = spring(Parameter("dof_damping", "slide", 0.0, 2.0))
    with pytest.raises(MadocError, match=r"written into its spec differs from the bound one in dof_damping by 0\.75"):
        save_mjcf(simulation.make(task, threads=1), np.array([1.25]), tmp_path / "model.xml")


def from_files(folder):
    """A cart whose shapes are files, two of one name in different folders, and a ground that is a picture."""
    for name, content in {"cart/box.obj": WEDGE, "wheel/box.obj": WEDGE.replace("0.2", "0.1")}.items():
        (folder / "shapes" / name).parent.mkdir(parents=True)
        (folder / "shapes" / name).write_text(content)
    (folder / "shapes" / "ground.png").write_bytes(png())
    (folder / "cart.xml").write_text("""
    <mujoco>
      <compiler meshdir="shapes"/>
      <asset>
        <mesh name="cart" file="cart/box.obj"/>
        <mesh name="wheel" file="wheel/box.obj"/>
        <hfield name="ground" file="ground.png" size="3 3 0.1 0.1"/>
      </asset>
      <worldbody>
        <geom type="hfield" hfield="ground" pos="0 0 -1"/>
        <body name="cart">
          <joint name="slide" type="slide" axis="1 0 0"/>
          <geom type="mesh" mesh="cart"/><geom type="mesh" mesh="wheel"/>
        </body>
      </worldbody>
      <actuator><motor joint="slide"/></actuator>
    </mujoco>
    """)
    task = spring(Parameter("dof_damping", "slide", 0.0, 2.0))
    return replace(task, spec=lambda: mujoco.MjSpec.from_file(str(folder / "cart.xml")))


def test_files_of_one_name_are_kept_apart(tmp_path):
    simulator = simulation.make(from_files(tmp_path), threads=1)
    (tmp_path / "out").mkdir()
    save_mjcf(simulator, np.array([0.5]), tmp_path / "out" / "model.xml")
    found = {path.name: path.read_bytes() for path in (tmp_path / "out" / "assets").iterdir()}
    assert sorted(found) == ["_box.obj", "box.obj", "ground.png"]
    (tmp_path / "shapes").rename(tmp_path / "gone")
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml"))
    bound = simulator.model(np.array([0.5]))
    np.testing.assert_allclose(written.body_inertia, bound.body_inertia, rtol=1e-13)
    np.testing.assert_allclose(written.mesh_vert, bound.mesh_vert, rtol=1e-6)
    np.testing.assert_array_equal(written.hfield_data, bound.hfield_data)


def test_a_missing_file_is_named(tmp_path):
    simulator = simulation.make(from_files(tmp_path), threads=1)
    (tmp_path / "shapes" / "wheel" / "box.obj").unlink()
    with pytest.raises(MadocError, match=r"no longer compiles: .*wheel/box.obj"):
        save_mjcf(simulator, np.array([0.5]), tmp_path / "model.xml")


def test_a_payload_and_a_whole_inertia_leave_as_inertial_frames(lift, tmp_path):
    fields = [("payload_mass", "rod", 0.0, 1.0), ("payload_y", "rod", 0.0, 0.1)]
    fields += [(field, "block", -0.2, 0.2) for field in INERTIA]
    space = ParameterSpace(tuple(Parameter(*each) for each in fields))
    simulator = simulation.make(replace(lift.task, parameters=space, ranges={}), threads=1)
    changes = save_mjcf(simulator, somewhere(simulator), tmp_path / "written.xml")
    assert {change.element for change in changes} == {"inertial of body rod", "inertial of body block"}
    bound, read_back = (
        simulator.model(somewhere(simulator)),
        mujoco.MjModel.from_xml_path(str(tmp_path / "written.xml")),
    )
    np.testing.assert_allclose(read_back.dof_M0, bound.dof_M0, rtol=1e-12)
