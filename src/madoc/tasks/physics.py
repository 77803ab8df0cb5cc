"""Two physics, of models as MuJoCo reads them now, and as mujoco-py (D4RL, NeoRL, the paper) did; unfit MuJoCos."""

import importlib.resources
import re

import mujoco
import numpy as np

from madoc.errors import MadocError

PHYSICS = ("legacy", "modern")

LACKING = {"3.7": "MjModel.dof_dampingpoly", "3.8": "an MjSpec.modelfiledir that can be changed"}
"""What Madoc uses of MuJoCo, by the first version that has it: the first for `dof_drag`, the other for exports."""

OLDEST = [*LACKING][-1]

WRONG = {"4.0.0": "solves contacts with a wrong factorisation"}
"""Versions that compute something wrong, and what: issue 3767 of MuJoCo, mended in 4.0.1."""


def refuse_unfit_mujoco(version: str = mujoco.__version__) -> None:
    """Raise a `MadocError` where the installed MuJoCo is too old for what Madoc uses of it, or computes wrongly."""
    reasons = [f"lacks {what}" for first, what in LACKING.items() if _numbers(version) < _numbers(first)]
    reasons += [WRONG[version]] if version in WRONG else []
    if reasons:
        others = "".join(f",!={other}" for other in WRONG)
        raise MadocError(f"MuJoCo {version} {reasons[0]}; install another one: pip install 'mujoco>={OLDEST}{others}'")


def _numbers(version: str) -> tuple[int, ...]:
    """Major and minor number."""
    return tuple(int(number) for number in re.findall(r"\d+", version)[:2])


def load_robot(file: str, physics: str, total_mass: float | None = None) -> mujoco.MjSpec:
    """Gymnasium's model of a robot in one of the two physics.

    In MuJoCo before 2.1.1 ("legacy") a capsule of half-length h and radius r had the mass and inertia of a
    cylinder of length 2h + r. In both physics the floor's margin is 0: since MuJoCo 3.5.0 margins add, before
    the larger counted, and the robots' geoms carry theirs already.

    Masses and inertias are scaled so that the masses sum to `total_mass` in kg, where it is given.
    """
    refuse_unfit_mujoco()
    if physics not in PHYSICS:
        raise MadocError(f"unknown physics {physics!r}; expected one of {', '.join(PHYSICS)}")
    xml = (importlib.resources.files("gymnasium") / "envs" / "mujoco" / "assets" / file).read_text()
    spec = mujoco.MjSpec.from_string(xml)
    spec.compiler.settotalmass = -1.0
    spec.geom("floor").margin = 0.0
    if physics == "legacy":
        _use_legacy_inertia(spec)
    if total_mass is not None:
        _scale_mass(spec, total_mass)
    return spec


def legacy_capsule(radius: float, half_length: float, density: float) -> tuple[float, np.ndarray]:
    """Mass (kg) and principal inertia (x, y, z; kg·m²) of a capsule along z as mujoco-py computed them."""
    length = 2.0 * half_length + radius
    mass = density * np.pi * radius**2 * length
    across = mass * (3.0 * radius**2 + length**2) / 12.0
    return mass, np.array([across, across, mass * radius**2 / 2.0])


def solid_sphere(radius: float, density: float) -> tuple[float, np.ndarray]:
    """Mass (kg) and principal inertia (kg·m²) of a sphere."""
    mass = density * 4.0 / 3.0 * np.pi * radius**3
    return mass, np.full(3, 0.4 * mass * radius**2)


def _use_legacy_inertia(spec: mujoco.MjSpec) -> None:
    """Give every body the explicit inertia that mujoco-py would have inferred from its geoms."""
    model = spec.compile()
    densities = [geom.density for body in spec.bodies for geom in body.geoms]
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for body in spec.bodies[1:]:
        geoms = model.body_geomadr[body.id] + np.arange(model.body_geomnum[body.id])
        parts = [_geom_inertia(model, geom, densities[geom]) for geom in geoms.tolist()]
        mass = sum(part[0] for part in parts)
        centre = sum(part[0] * part[1] for part in parts) / mass
        inertia = np.sum([part[2] + part[0] * _parallel_axis(part[1] - centre) for part in parts], axis=0)
        body.explicitinertial = True
        body.mass = mass
        body.ipos = centre
        body.iquat = [1.0, 0.0, 0.0, 0.0]
        body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _geom_inertia(model: mujoco.MjModel, geom: int, density: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre and inertia matrix of one geom in its body's frame."""
    kind = model.geom_type[geom]
    radius, half_length = model.geom_size[geom, :2]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        mass, principal = legacy_capsule(radius, half_length, density)
    elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        mass, principal = solid_sphere(radius, density)
    else:
        raise MadocError(f"legacy physics knows capsules and spheres, got geom type {kind} in geom {geom}")
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, model.geom_quat[geom])
    rotation = flat.reshape(3, 3)
    return mass, model.geom_pos[geom].copy(), rotation @ np.diag(principal) @ rotation.T


def _parallel_axis(offset: np.ndarray) -> np.ndarray:
    """Inertia per unit mass that a displacement adds: |d|² I - d dᵀ."""
    return offset @ offset * np.eye(3) - np.outer(offset, offset)


def _scale_mass(spec: mujoco.MjSpec, total_mass: float) -> None:
    """Make the inertia of every body explicit, scaled so that the masses sum to `total_mass`."""
    model = spec.compile()
    factor = total_mass / model.body_mass.sum()
    model.body_mass *= factor
    model.body_inertia *= factor
    write_inertia(spec, model)


def write_inertia(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Give every body of a spec the inertia that it has in a model, instead of one inferred from its geoms."""
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for body in spec.bodies[1:]:
        body.explicitinertial = bool(model.body_mass[body.id] > 0.0)
        body.mass = model.body_mass[body.id]
        body.ipos = model.body_ipos[body.id]
        body.iquat = model.body_iquat[body.id]
        body.inertia = model.body_inertia[body.id]
        body.fullinertia = np.full(6, np.nan)
