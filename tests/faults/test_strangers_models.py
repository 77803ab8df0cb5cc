"""Specs and models of strangers: each is refused at once with one sentence, nothing of other files leaks."""

import base64
import os
import struct
import zlib

import pytest
from hostile import SECRET, answers, require_refusal

from madoc import robots
from madoc.errors import MadocError, NotAllowed
from own_robots import CART, CART_SPEC, write_robot

ROD = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
URDF = f"""<robot name="r"><link name="base"/><link name="rod">{ROD}{{inside}}</link>
<joint name="swing" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint></robot>"""
URDF_SPEC = """madoc: 1
name: swing
model: cart.xml
control_step: 0.02
signals: [{name: angle, reads: position(swing)}]
actions: [{name: push, joint: swing, means: torque, low: -1, high: 1}]
parameters: [{field: dof_damping, element: swing, low: 0, high: 1}]
"""


def urdf(mesh):
    return URDF.format(inside=f'<collision><geometry><mesh filename="{mesh}"/></geometry></collision>')


def written(folder, spec, **models):
    folder.mkdir()
    return write_robot(folder, spec, **models)


def inside(text):
    """The model of the cart with something more in it."""
    return CART.replace("</mujoco>", f"{text}</mujoco>")


def picture(width, height):
    """A PNG of very many points in few bytes."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(b"\0" * 100)), (b"IEND", b"")]
    parts = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def hfield(text):
    return inside(f'<asset><hfield name="ground" size="1 1 1 1" {text}/></asset>')


OUTSIDE = {
    "a mesh by its path": (urdf("{secret}"), URDF_SPEC),
    "a mesh by its URI": (urdf("file://{secret}"), URDF_SPEC),
    "a mesh above": (urdf("../secret/id_secret"), URDF_SPEC),
    "a mesh of a package": (urdf("package://parts/secret/id_secret"), URDF_SPEC),
    "a mesh by a link": (urdf("link.stl"), URDF_SPEC),
    "an include": (inside('<include file="{secret}"/>'), CART_SPEC),
    "an include above": (inside('<include file="../secret/id_secret"/>'), CART_SPEC),
    "an asset": (inside('<asset><mesh name="m" file="id_secret"/></asset><compiler meshdir="{folder}"/>'), CART_SPEC),
    "a texture of a side": (
        inside('<asset><texture name="t" type="cube" fileright="{secret}"/></asset>'),
        CART_SPEC,
    ),
    "a skin": (inside('<asset><skin name="s" file="{secret}"/></asset>'), CART_SPEC),
    "a model in the model": (inside('<asset><model name="o" file="{secret}"/></asset>'), CART_SPEC),
}
LARGE = {
    "an open comment": ("<!--" * 250_000, "not XML"),
    "open instructions": ("<?" * 500_000, "not XML"),
    "open meshes": ("<mesh " * 150_000, "not XML"),
    "entities": ('<!DOCTYPE m [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><mujoco model="&b;"/>', "document type"),
    "a foreign entity": ('<!DOCTYPE m [<!ENTITY a SYSTEM "{secret}">]><mujoco>&a;</mujoco>', "document type"),
    "very deep": ("<body>" * 5000 + "</body>" * 5000, "too deep"),
    "no timestep": (CART.replace('"0.01"', '"nan"'), "timestep from"),
    "a timestep of 0": (CART.replace('"0.01"', '"0"'), "timestep from"),
    "a short timestep": (CART.replace('"0.01"', '"1e-9"'), "timestep from"),
    "user data": (inside('<size nuser_body="2000000000"/>'), "nuser_body"),
    "memory": (inside('<size memory="900G"/>'), "memory"),
    "keyframes": (inside('<size nkey="2000000000"/>'), "nkey"),
    "copies": (inside('<worldbody><replicate count="9000000"><site/></replicate></worldbody>'), "count"),
    "copies of copies": (
        inside(
            '<worldbody><replicate count="3000"><replicate count="3000"><site/></replicate></replicate></worldbody>'
        ),
        "elements",
    ),
    "cloth": (
        inside('<worldbody><body name="c"><flexcomp name="f" count="9000 9000 1" type="grid"/></body></worldbody>'),
        "count",
    ),
    "a height field": (hfield('nrow="100000" ncol="100000"'), "nrow times ncol"),
    "a picture": (hfield('file="large.png"'), "points"),
    "a texture": (
        inside('<asset><texture name="t" type="2d" builtin="flat" width="90000" height="90000"/></asset>'),
        "width times height",
    ),
    "a pipe": (inside('<include file="pipe.xml"/>'), "no regular file"),
    "a missing file": (inside('<include file="none.xml"/>'), "missing"),
}
SPECS = {
    "a signal without bound": (("position(rail)", '"1e308*10*position(rail)"'), "numbers up to"),
    "a weight without bound": (("position(rail)", '"sin(1e300*position(rail))"'), "numbers up to"),
    "a delay of years": (
        ("parameters:\n", "parameters:\n  - {field: action_delay, low: 0, high: 1e9}\n"),
        "action_delay",
    ),
    "a delay of many steps": (
        ("control_step: 0.02", "control_step: 0.001\ntimestep: 0.001\n#"),
        "1,000 control steps",
    ),
    "a timestep of nothing": (("control_step: 0.02", "control_step: 0.02\ntimestep: 1e-300"), "timestep"),
    "many steps": (("control_step: 0.02", "control_step: 2\ntimestep: 1e-6"), "10,000 timesteps"),
    "a name that turns text": (("name: place", 'name: "pl\\u202eace"'), "printable"),
    "many unknown keys": (("madoc: 1", "madoc: 1\n" + "".join(f"k{i}: 1\n" for i in range(20_000))), "1,000 keys"),
}


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The answer to every case, by its name; all in one process."""
    root = tmp_path_factory.mktemp("models")
    (root / "secret").mkdir()
    secret = root / "secret" / "id_secret"
    secret.write_text(f"<mujoco model='{SECRET}'/>")
    words = {"good": ["spec", written(root / "good", CART_SPEC, cart=CART)]}
    for name, (model, spec) in [*OUTSIDE.items(), *((name, (text, CART_SPEC)) for name, (text, _) in LARGE.items())]:
        path = written(
            root / name, spec, cart=model.replace("{secret}", str(secret)).replace("{folder}", str(secret.parent))
        )
        words[name] = ["spec", path]
    for name, ((before, after), _) in SPECS.items():
        spec = CART_SPEC.replace(before, after, 1)
        assert spec != CART_SPEC, name
        if "many steps" in name and "delay" in name:
            spec = spec.replace("parameters:\n", "parameters:\n  - {field: action_delay, low: 0, high: 9}\n")
        words[name] = ["spec", written(root / name, spec, cart=CART)]
    os.mkfifo(root / "a pipe" / "pipe.xml")
    (root / "a mesh by a link" / "link.stl").symlink_to(secret)
    (root / "a picture" / "large.png").write_bytes(picture(100_000, 100_000))
    told = dict(zip(words, answers(words.values()), strict=True))
    assert told["good"]["code"] == 0, told["good"]
    return told


@pytest.mark.parametrize("name", OUTSIDE)
def test_files_outside_the_folder_of_a_model_are_refused_by_name(answered, name):
    require_refusal(answered[name], "--allow-outside", "link.stl" if "link" in name else "secret")


@pytest.mark.parametrize("name", LARGE)
def test_a_model_that_asks_for_too_much_is_refused(answered, name):
    require_refusal(answered[name], LARGE[name][1])


@pytest.mark.parametrize("name", SPECS)
def test_a_spec_beyond_the_bounds_of_physics_is_refused(answered, name):
    require_refusal(answered[name], SPECS[name][1])


def test_what_a_comment_says_is_not_read(tmp_path):
    (tmp_path / "id_secret").write_text(SECRET)
    comment = f'<!-- <mesh filename="{tmp_path}/id_secret"/> <include file="{tmp_path}/id_secret"/> -->'
    for model, spec in ((URDF.format(inside=comment), URDF_SPEC), (inside(comment), CART_SPEC)):
        robot = robots.load(written(tmp_path / spec[16:20], spec, cart=model))
        assert robot.model_files == ("cart.xml",)
        assert SECRET not in str(robot.task.source)


def test_what_is_outside_is_read_where_that_is_allowed(tmp_path):
    (tmp_path / "parts.xml").write_text('<mujoco><worldbody><site name="mark"/></worldbody></mujoco>')
    path = written(tmp_path / "robot", CART_SPEC, cart=inside('<include file="../parts.xml"/>'))
    with pytest.raises(NotAllowed, match=r"line 3: cart.xml refers to ../parts.xml, outside .* --allow-outside"):
        robots.load(path)
    robot = robots.load(path, allow_outside=True)
    assert robot.model_files == ("cart.xml", f"{tmp_path}/robot/../parts.xml")
    assert robots.restore(robot.task.source).task.model.nsite == 1  # what the run keeps needs no file


def test_a_received_run_names_no_file_of_this_machine(tmp_path):
    """MuJoCo itself would read what the kept files refer to and lack."""
    secret = tmp_path / "secret.obj"
    secret.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    source = dict(robots.load(written(tmp_path / "robot", CART_SPEC, cart=CART)).task.source)
    mesh = inside(f'<asset><mesh name="m" file="{secret}"/></asset>')
    source["model"] = {"main": "cart.xml", "contents": {"cart.xml": mesh}}
    with pytest.raises(MadocError, match=r"refers to .*secret.obj, which is not among the files that are kept"):
        robots.restore(source)


def test_a_blob_in_a_received_run_is_not_unpacked_beyond_the_bound(tmp_path):
    source = dict(robots.load(written(tmp_path / "robot", CART_SPEC, cart=CART)).task.source)
    packer = zlib.compressobj(9)
    blob = b"".join([*(packer.compress(b"\0" * 10_000_000) for _ in range(20)), packer.flush()])
    stored = {"zlib_base64": base64.b64encode(blob).decode()}
    source["model"] = {"main": "cart.xml", "contents": {"cart.xml": CART, "blob.stl": stored}}
    with pytest.raises(MadocError, match=r"more than 100,000,000 bytes; restore the file"):
        robots.restore(source)
