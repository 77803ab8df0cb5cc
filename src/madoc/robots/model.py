"""The model of a robot: its files, read once and completely, and the MuJoCo spec that is made of them."""

import base64
import re
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import mujoco
import numpy as np

from madoc.errors import MadocError
from madoc.robots.document import Document
from madoc.robots.functions import PythonFile
from madoc.robots.spec import RobotSpec
from madoc.simulation.write import OF_A_JOINT, ONE_DOF
from madoc.tasks.base import compiled_model

_MESH = re.compile(r"""<mesh[^>]*\bfilename\s*=\s*["']([^"']+)["']""")


@dataclass(frozen=True)
class ModelFiles:
    """The name of a model file, and the contents of it and of all files that it refers to.

    A file is named by its path from the model file's folder, or as the model names it.
    """

    main: str
    files: tuple[tuple[str, bytes], ...]

    @classmethod
    def read(cls, path: Path) -> "ModelFiles":
        """Read a model file and everything that it refers to; a missing file is refused."""
        contents = {path.name: _read(path)}
        if is_urdf(contents[path.name]):
            for name in dict.fromkeys(_MESH.findall(contents[path.name].decode(errors="replace"))):
                contents[name] = _read(_mesh_path(name, path))
            return cls(path.name, tuple(contents.items()))
        try:
            dependencies = mujoco.mju_getXMLDependencies(str(path))
        except (ValueError, mujoco.FatalError):
            dependencies = []  # compiling the model gives the better error
        for file in map(Path, dependencies):
            if file != path and file.resolve() != path.resolve():
                inside = file.is_relative_to(path.parent)
                contents[(file.relative_to(path.parent) if inside else file).as_posix()] = _read(file, path.name)
        return cls(path.name, tuple(contents.items()))

    def to_json(self) -> dict[str, object]:
        """The files for JSON: text as it is, anything else compressed."""
        return {"main": self.main, "contents": {name: _stored(content) for name, content in self.files}}

    @classmethod
    def from_json(cls, stored: Mapping[str, object]) -> "ModelFiles":
        """The files that `to_json` wrote; a ValueError says what is damaged."""
        main, contents = stored.get("main"), stored.get("contents")
        if not isinstance(main, str) or not isinstance(contents, Mapping):
            raise ValueError("its model has no main file or no contents")
        return cls(main, tuple((name, _restored(content)) for name, content in contents.items()))

    def spec(self) -> mujoco.MjSpec:
        """A MuJoCo spec of the model, in which joints and actuators without a name are named by what they belong to.

        A joint takes the name of its body, where it is the only one there, and an actuator that of its joint.
        """
        others = dict(self.files)
        try:
            text = others.pop(self.main).decode()
        except UnicodeDecodeError as error:
            raise MadocError(f"model {self.main} is not text; expected MJCF or URDF") from error
        includes = {name: content for name, content in others.items() if PurePosixPath(name).suffix == ".xml"}
        assets = {name: content for name, content in others.items() if name not in includes}
        try:
            spec = mujoco.MjSpec.from_string(text, include=includes, assets=assets)
        except (ValueError, mujoco.FatalError) as error:
            raise MadocError(f"model {self.main} cannot be read: {_one_line(error)}") from error
        _name_by_owner(
            [(joint, joint.parent.name) for joint in spec.joints if len(joint.parent.joints) == 1], spec.joints
        )
        of_joint = [part for part in spec.actuators if int(part.trntype) in OF_A_JOINT]
        _name_by_owner([(actuator, actuator.target) for actuator in of_joint], spec.actuators)
        return spec


@dataclass(frozen=True)
class Draft:
    """A spec with its lines, and the MuJoCo spec of its model file, without the actuators that it adds.

    The Python file is that which the spec names, allowed to be run.
    """

    spec: RobotSpec
    document: Document
    base: mujoco.MjSpec
    python: PythonFile | None = None


@dataclass(frozen=True)
class AddedActuator:
    """An actuator that a spec adds to a joint: force = gain · control - stiffness · position - damping · velocity.

    Attributes:
        name: Name of the action channel.
        joint: The joint it drives.
        low: Smallest control; MuJoCo clips controls to the range, in an exported model too.
        high: Largest control.
        gain: Force per control.
        stiffness: Force per position, in SI units.
        damping: Force per velocity, in SI units.
        limit: Largest force; None is unlimited.
    """

    name: str
    joint: str
    low: float
    high: float
    gain: float = 1.0
    stiffness: float = 0.0
    damping: float = 0.0
    limit: float | None = None


def make_model(
    base: mujoco.MjSpec, added: tuple[AddedActuator, ...] = (), timestep: float | None = None
) -> mujoco.MjSpec:
    """A copy of a spec with added actuators, and with another timestep if one is given."""
    spec = base.copy()
    if timestep is not None:
        spec.option.timestep = timestep
    for actuator in added:
        new = spec.add_actuator(name=actuator.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=actuator.joint)
        new.gainprm[0] = actuator.gain
        new.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        new.ctrlrange = np.array([actuator.low, actuator.high])
        if actuator.stiffness or actuator.damping:
            new.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            new.biasprm[1:3] = -actuator.stiffness, -actuator.damping
        if actuator.limit is not None:
            new.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            new.forcerange = np.array([-actuator.limit, actuator.limit])
    return spec


def compiled(spec: Callable[[], mujoco.MjSpec], file: str) -> mujoco.MjModel:
    """The shared model of a spec (`tasks.base.compiled_model`); an error of MuJoCo is passed on as a refusal."""
    try:
        return compiled_model(spec)
    except (ValueError, mujoco.FatalError) as error:
        raise MadocError(f"model {file} does not compile: {_one_line(error)}") from error


def is_urdf(content: bytes) -> bool:
    """Whether a model file is URDF: its first element is `robot`."""
    first = re.search(rb"<\s*([A-Za-z_][\w.-]*)", re.sub(rb"<!--.*?-->|<\?.*?\?>", b"", content, flags=re.DOTALL))
    return first is not None and first[1] == b"robot"


def is_slide(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint slides; a joint that turns has other units."""
    return int(model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_SLIDE


def is_single(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint is a hinge or a slide, with one position and one velocity."""
    return int(model.jnt_type[joint]) in ONE_DOF


def _name_by_owner(
    owned: list[tuple[mujoco.MjsJoint | mujoco.MjsActuator, str]],
    everything: Iterable[mujoco.MjsJoint | mujoco.MjsActuator],
) -> None:
    """Name parts without a name by their owner, unless that name is taken or would be given twice."""
    taken = [part.name for part in everything]
    wanted = [owner for part, owner in owned if not part.name]
    for part, owner in owned:
        if not part.name and owner and owner not in taken and wanted.count(owner) == 1:
            part.name = owner


def _read(path: Path, owner: str = "") -> bytes:
    if not path.is_file():
        refers = f"{owner} refers to {path}, which is" if owner else f"there is no model file {path}: it is"
        raise MadocError(f"{refers} {'a directory' if path.is_dir() else 'missing'}; check the path")
    return read_bytes(path)


def read_bytes(path: Path) -> bytes:
    """The content of a file; one that cannot be read is refused."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise MadocError(f"could not read {path}: {error.strerror or error}") from error


def _mesh_path(name: str, model: Path) -> Path:
    """Path of a URDF's mesh: beside the model, or in the package that the model is part of."""
    bare = re.sub(r"^(package|file)://", "", name)
    inside = PurePosixPath(bare).parts[1:] if name.startswith("package://") else PurePosixPath(bare).parts
    candidates = [model.parent / bare, *(folder.joinpath(*inside) for folder in model.parents[:3])]
    candidates.append(model.parent / PurePosixPath(bare).name)
    for path in candidates:
        if path.is_file():
            return path
    raise MadocError(f"{model.name} refers to {name}, which is neither beside it nor in its package; check the path")


def _stored(content: bytes) -> str | dict[str, str]:
    try:
        return content.decode()
    except UnicodeDecodeError:
        return {"zlib_base64": base64.b64encode(zlib.compress(content)).decode()}


def _restored(stored: str | Mapping[str, str]) -> bytes:
    if isinstance(stored, str):
        return stored.encode()
    try:
        return zlib.decompress(base64.b64decode(stored["zlib_base64"]))
    except (zlib.error, TypeError, KeyError) as error:
        raise ValueError(f"a file of its model is damaged ({error})") from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
