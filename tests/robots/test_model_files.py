"""What a model refers to: kept with a run, and looked for where it belongs."""

import json

import numpy as np
import pytest

from madoc import robots
from madoc.errors import MadocError, NotAllowed
from own_robots import CART_SPEC, URDF, URDF_SPEC, task_of, write_robot


def test_meshes_and_includes_are_kept(tmp_path):
    corner = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "corner.obj").write_text(corner)
    (tmp_path / "part.xml").write_text(
        '<mujoco><worldbody><body name="b"><joint name="j"/>'
        '<geom type="mesh" mesh="corner"/></body></worldbody></mujoco>'
    )
    model = (
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="corner" file="corner.obj"/></asset>'
        '<include file="part.xml"/></mujoco>'
    )
    spec = CART_SPEC.replace("rail", "j").replace("element: cart", "element: b").replace("force", "torque")
    task = task_of(tmp_path, spec, cart=model)
    (tmp_path / "part.xml").unlink()
    (tmp_path / "meshes" / "corner.obj").unlink()
    again = robots.restore(json.loads(json.dumps(task.source))).task
    assert again.compile().nmesh == task.compile().nmesh == 1
    np.testing.assert_array_equal(again.compile().body_inertia, task.compile().body_inertia)


def test_a_urdf_finds_meshes_in_its_package(tmp_path):
    package = tmp_path / "arm_description"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    (package / "meshes" / "rod.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    mesh = '<collision><geometry><mesh filename="package://arm_description/meshes/rod.obj"/></geometry></collision>'
    text = URDF.replace("</inertial>", f"</inertial>{mesh}")
    path = write_robot(package / "urdf", URDF_SPEC, pendulum=text)
    with pytest.raises(NotAllowed, match=r"robot.yaml, line 3: .*package://arm_description/meshes/rod.obj, outside"):
        robots.load(path)
    assert robots.load(path, allow_outside=True).task.compile().nmesh == 1
    (package / "meshes" / "rod.obj").unlink()
    with pytest.raises(
        MadocError, match=r"robot.yaml, line 3: pendulum.xml refers to package://arm_description/meshes/rod"
    ):
        robots.load(path)
