"""A bound model as MJCF that compiles to the same model, bit for bit, wherever it is loaded; many as numbers of it."""

import ctypes
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, Int, Num

from madoc.errors import MadocError
from madoc.parameters import KINDS_OF_ARRAYS
from madoc.runs.files import replacing
from madoc.simulation import callbacks
from madoc.simulation.arrays import option_names, rows_of
from madoc.simulation.base import Simulator
from madoc.simulation.joints import needs_callbacks
from madoc.simulation.write import write_parameters
from madoc.tasks.physics import write_inertia

DIGITS = 17
"""Number of significant digits that determine a float64; MuJoCo by itself writes 6."""

DRIVES = "drives.py"
"""Name of the Python file beside a model that has drives or friction of its own."""
ASSETS = "assets"
"""Folder of meshes, height fields and textures beside a written model."""

NOT_COMPARED = ("_", "bvh", "cam_", "geom_rgba", "light_", "mat_", "mesh_", "oct_", "site_rgba", "skin_", "tex_")
"""Beginnings of the names of a model's arrays that only matter for rendering or for finding contacts faster."""

_LONG_NUMBER = re.compile(r'(?<=["\s])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?=["\s])')

_ATTRIBUTES = {
    "qpos0": "ref",
    "jnt_user": "userdata",
    "actuator_user": "userdata",
    "qpos_spring": "springref",
    "dof_solref": "solref_friction",
    "dof_solimp": "solimp_friction",
    "jnt_solref": "solref_limit",
    "jnt_solimp": "solimp_limit",
    "tendon_solref_lim": "solref_limit",
    "tendon_solimp_lim": "solimp_limit",
    "tendon_solref_fri": "solref_friction",
    "tendon_solimp_fri": "solimp_friction",
    "tendon_lengthspring": "springlength",
}
"""Attributes in MJCF of arrays whose name is not that of the attribute behind the kind of element."""
_INERTIAL = ("body_mass", "body_inertia", "body_ipos", "body_iquat")
"""Arrays that are written as the inertial frame of a body."""
_ANGLES = ("ref", "springref", "range")
"""Attributes of a hinge that are in degrees where the other angles of a model's file are."""
Numbers = Mapping[str, tuple[Int[np.ndarray, " numbers"], Num[np.ndarray, "draws numbers"]]]
"""For each array of `mujoco.MjModel` the places in it that change, of its values in a row, and what they are."""
BOXES = "bvh_aabb"
"""Boxes about geoms, by which MuJoCo finds contacts faster."""
GRAVITY = "opt.gravity"
"""The one array of a model's options that a parameter writes."""


@dataclass(frozen=True)
class Change:
    """One attribute of MJCF in which a bound model (`new`) differs from the robot's own (`old`).

    The element is its kind and name, as `joint foot_joint`; `option` for the options of the model.
    """

    element: str
    attribute: str
    old: list[float]
    new: list[float]


def save_mjcf(simulator: Simulator, values: Float[np.ndarray, " parameters"], path: Path) -> list[Change]:
    """Write the calibrated model as MJCF, its assets in a folder beside it, and check it by loading it again.

    A model with drives or friction that MuJoCo's own elements do not say comes with `DRIVES`, whose `load` reads it.
    Where an inertia changes, all inertias are made explicit, so that compiling the file does not infer them again from
    geoms, total masses or bounds. Returned are the attributes in which the model differs from the robot's own.

    Raises:
        MadocError: The file cannot be written, an asset is missing, or the written model is not the bound one.
    """
    spec, bound = simulator.task.spec(), simulator.model(values)
    nominal = _compiled(spec)
    changes = [*_write_options(spec, nominal, bound), *_write_inertia(spec, nominal, bound)]
    for kind, array in _changed(nominal, bound):
        changes += _write_rows(spec, nominal, bound, kind=kind, array=array)
    _gather_assets(spec, path.parent)
    # MuJoCo writes what was compiled last.
    _refuse_difference(bound, _compiled(spec), "written into its spec")
    with _precision(DIGITS):
        text = shortest_numbers(spec.to_xml())
    by_callback = needs_callbacks(bound)
    if by_callback:
        head, line, rest = text.partition("\n")
        text = head + line + callbacks.GUARD + rest
        shutil.copyfile(callbacks.__file__, path.with_name(DRIVES))
    with replacing(path) as stream:
        stream.write(text.encode())
    try:
        read_back = (callbacks.load if by_callback else mujoco.MjModel.from_xml_path)(str(path))
    except ValueError as error:
        raise MadocError(f"MuJoCo does not read back the model it wrote to {path}: {error}") from error
    _refuse_difference(bound, read_back, f"read back from {path}")
    return changes


def shortest_numbers(text: str) -> str:
    """XML with the shortest form of every number that is the same float64: `0.05`, not `0.050000000000000003`."""

    def shorten(number: re.Match[str]) -> str:
        written = number.group()
        return repr(float(written)) if len(written) > DIGITS else written

    return _LONG_NUMBER.sub(shorten, text)


def _compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise MadocError(f"the robot's model no longer compiles: {' '.join(str(error).split())}") from error


def _refuse_difference(wanted: mujoco.MjModel, got: mujoco.MjModel, where: str) -> None:
    """Refuse a model that differs from the bound one in a number, but for rounding of derived constants."""
    for name in dir(wanted):
        ours, theirs = getattr(wanted, name), getattr(got, name)
        if name.startswith(NOT_COMPARED) or not isinstance(ours, np.ndarray) or ours.dtype.kind != "f":
            continue
        if ours.shape != theirs.shape:
            raise MadocError(f"the model {where} has {name} of shape {theirs.shape}, the bound one {ours.shape}")
        tolerance = 1e-12 * max(1.0, float(np.abs(ours).max(initial=0.0)))
        difference = float(np.abs(ours - theirs).max(initial=0.0))
        if not difference <= tolerance:
            raise MadocError(
                f"the model {where} differs from the bound one in {name} by {difference:.3g}; "
                "this parameter, or this version of MuJoCo, cannot be written as MJCF exactly"
            )
    for name in option_names(wanted):
        if not np.array_equal(getattr(wanted.opt, name), getattr(got.opt, name)):
            raise MadocError(f"the model {where} differs from the bound one in the option {name}")


@contextmanager
def _precision(digits: int) -> Iterator[None]:
    """Make MuJoCo write numbers with this number of digits.

    Its library exports the setting without a binding in Python. A build without it writes rounded numbers, and the
    check after every writing refuses them.
    """
    folder = Path(mujoco.__file__).parent
    files = sorted([*folder.glob(f"*mujoco*{mujoco.__version__}*"), *folder.glob("mujoco*.dll")])
    library = ctypes.CDLL(str(files[0])) if files else None
    setter = getattr(library, "_mjPRIVATE__set_xml_precision", None)
    getter = getattr(library, "_mjPRIVATE__get_xml_precision", None)
    if setter is None or getter is None:
        yield
        return
    before = getter()
    setter(digits)
    try:
        yield
    finally:
        setter(before)


def _gather_assets(spec: mujoco.MjSpec, folder: Path) -> None:
    """Copy the files that a model refers to into the folder beside it, and refer to the copies."""
    copies: dict[str, str] = {}
    owners = [*spec.meshes, *spec.hfields, *spec.textures, *spec.skins]
    for owner in owners:
        own_folder = owner.compiler.texturedir if isinstance(owner, mujoco.MjsTexture) else owner.compiler.meshdir
        if owner.file:
            owner.file = _copied(spec, owner.file, own_folder, folder / ASSETS, copies)
        for side, file in enumerate(getattr(owner, "cubefiles", ())):
            if file:
                owner.cubefiles[side] = _copied(spec, file, own_folder, folder / ASSETS, copies)
    if copies:
        for compiler in (spec.compiler, *(owner.compiler for owner in owners)):
            compiler.meshdir = compiler.texturedir = ASSETS
        spec.modelfiledir = str(folder)


def _copied(spec: mujoco.MjSpec, file: str, own_folder: str, folder: Path, copies: dict[str, str]) -> str:
    """Name of the copy of a file in a folder; `copies` has those made so far, by the path of the original."""
    wanted = str(Path(own_folder) / file)
    if wanted not in copies:
        name = Path(file).name
        alike = [held for held in spec.assets if Path(held).name == name]  # as MuJoCo finds it where no path fits
        held = next((held for held in (wanted, file, name, *alike) if held in spec.assets), None)
        inside = None if held is None else spec.assets[held]
        while name in copies.values():
            name = f"_{name}"
        source = Path(spec.modelfiledir or ".") / wanted
        folder.mkdir(exist_ok=True)
        try:
            content = source.read_bytes() if inside is None else inside
        except OSError as error:
            raise MadocError(f"could not copy {source}, which the model needs: {error.strerror}") from error
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        copies[wanted] = name
    return copies[wanted]


def _write_options(spec: mujoco.MjSpec, nominal: mujoco.MjModel, bound: mujoco.MjModel) -> list[Change]:
    changes = []
    for name in option_names(bound):
        old, new = getattr(nominal.opt, name), getattr(bound.opt, name)
        if not np.array_equal(old, new):
            setattr(spec.option, name, new)
            changes.append(Change("option", name, np.atleast_1d(old).tolist(), np.atleast_1d(new).tolist()))
    return changes


def _write_inertia(spec: mujoco.MjSpec, nominal: mujoco.MjModel, bound: mujoco.MjModel) -> list[Change]:
    names = {"body_mass": "mass", "body_inertia": "diaginertia", "body_ipos": "pos", "body_iquat": "quat"}
    changes = [
        Change(f"inertial of body {_body_name(bound, index)}", attribute, _row(nominal, name, index), new)
        for index in range(1, bound.nbody)
        for name, attribute in names.items()
        if (new := _row(bound, name, index)) != _row(nominal, name, index)
    ]
    if changes or not np.array_equal(bound.geom_pos, nominal.geom_pos):
        spec.compiler.settotalmass = -1.0
        spec.compiler.boundmass = spec.compiler.boundinertia = 0.0
        spec.compiler.balanceinertia = False
        write_inertia(spec, bound)
    return changes


def _changed(nominal: mujoco.MjModel, bound: mujoco.MjModel) -> Iterator[tuple[str, str]]:
    """Kind of element and name of the arrays, with a row for each, in which two models differ, besides inertias."""
    for array in dir(bound):
        kind = KINDS_OF_ARRAYS.get(array.split("_")[0])
        if not kind or array in _INERTIAL or array.endswith("poly"):
            continue
        for one in (array, f"{array}poly"):
            ours = getattr(bound, one, None)
            if isinstance(ours, np.ndarray) and not np.array_equal(ours, getattr(nominal, one)):
                yield kind, array
                break


def _write_rows(
    spec: mujoco.MjSpec, nominal: mujoco.MjModel, bound: mujoco.MjModel, *, kind: str, array: str
) -> list[Change]:
    """Write what differs in an array of the model to the attribute of each element; nothing where MJCF has none."""
    changes = []
    attribute = _ATTRIBUTES.get(array, array.partition("_")[2])
    plural = {"body": "bodies", "equality": "equalities"}.get(kind, f"{kind}s")
    for element in getattr(spec, plural):
        index = int(rows_of(bound, array, element.id).start)
        old, new = _row(nominal, array, index), _row(bound, array, index)
        if old == new or not hasattr(element, attribute):
            continue
        turns = kind == "joint" and int(element.type) == int(mujoco.mjtJoint.mjJNT_HINGE)
        if attribute in _ANGLES and spec.compiler.degree and turns:
            old, new = np.rad2deg(old).tolist(), np.rad2deg(new).tolist()
        if attribute == "userdata":
            element.userdata = new
        elif np.ndim(getattr(element, attribute)):
            getattr(element, attribute)[: max(len(old), len(new))] = [*new, *[0.0] * (len(old) - len(new))]
        else:
            setattr(element, attribute, new[0])
        changes.append(Change(f"{kind} {element.name or element.id}", attribute, old, new))
    return changes


def _row(model: mujoco.MjModel, array: str, index: int) -> list[float]:
    """The numbers of an element; a damping or stiffness is followed by its quadratic and cubic ones, if any."""
    row = [float(value) for value in np.atleast_1d(getattr(model, array)[index])]
    higher = getattr(model, f"{array}poly")[index].tolist() if hasattr(model, f"{array}poly") else []
    return [*row, *higher] if any(higher) else row


def _body_name(model: mujoco.MjModel, index: int) -> str:
    """A body's name, or that of its first joint."""
    body = model.body(index)
    joint = model.body_jntadr[index]
    return body.name or (model.joint(joint).name if joint >= 0 else "") or str(index)


def numbers_of_draws(simulator: Simulator, values: Float[np.ndarray, "draws parameters"]) -> Numbers:
    """Every number in which a draw differs from the robot's own model, constants derived by `mj_setConst` included."""
    task, rows = simulator.task, []
    own = _arrays(task.compile())
    for draw in values:
        model = task.compile()
        write_parameters(model, mujoco.MjData(model), simulator.parameters.parameters, draw)
        rows.append({name: part for name, part in _arrays(model).items() if not np.array_equal(part, own[name])})
    changed = dict.fromkeys(name for row in rows for name in row)
    stacked = {name: np.stack([row.get(name, own[name]) for row in rows]) for name in changed}
    varied = {name: np.flatnonzero((part != own[name]).any(0)) for name, part in stacked.items()}
    return {name: (places, stacked[name][:, places]) for name, places in varied.items()}


def _arrays(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Copies of a model's arrays of numbers that matter for its motion, each in a row.

    Boxes about geoms are among them: they lie in the frame of a body's centre of mass, and contacts are sought by them.
    """
    found = {GRAVITY: np.array(model.opt.gravity)}
    for name in dir(model):
        part = None if name.startswith(NOT_COMPARED) and name != BOXES else getattr(model, name)
        if isinstance(part, np.ndarray) and part.dtype.kind in "fiu":
            found[name] = np.array(part).reshape(-1)
    return found
