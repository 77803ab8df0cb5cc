"""Masses, centres of mass and moments of inertia of bodies: each written alone, or all as one that can exist."""

from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from madoc.errors import MadocError
from madoc.parameters import INERTIA, PAYLOAD

MASS_FLOOR = 1e-3
"""Mass of a body in kg to which smaller values are raised, as the motion of a massless body diverges; see `LEAST`."""

INERTIA_FLOOR = 1e-9
"""Moment of inertia in kg·m² to which smaller values are raised for the same reason; see `LEAST`."""

LEAST = 1e-3
"""Share of a body's own mass or inertia in the model to which they are raised, where that is less than the floors."""

CENTRED = 1e-6
"""Distance of a centre of mass from its body's origin, in radii of gyration, up to which rounding makes it."""

_EXTENT = 1e-6
"""Share of its moments of inertia by which a body extends in each direction at least, or it has no Cholesky factor."""
_INERTIAL_FRAMES = (mujoco.mjtSameFrame.mjSAMEFRAME_INERTIA, mujoco.mjtSameFrame.mjSAMEFRAME_INERTIAROT)


def write_mass(model: mujoco.MjModel, body: int, value: float) -> None:
    """The mass alone; 0 is raised to the floor."""
    before = float(model.body_mass[body])
    model.body_mass[body] = max(value, min(MASS_FLOOR, LEAST * before) if before else MASS_FLOOR)


def write_mass_and_inertia(model: mujoco.MjModel, body: int, value: float) -> None:
    """The mass, and the moments of inertia in proportion; a body without a mass is refused."""
    before = float(model.body_mass[body])
    if before == 0.0:
        name = model.body(body).name
        raise MadocError(f"body_mass_and_inertia: body {name!r} has no mass to scale; use body_mass instead")
    write_mass(model, body, value)
    model.body_inertia[body] *= model.body_mass[body] / before


def write_inertia(model: mujoco.MjModel, body: int, value: float) -> None:
    """The largest moment of inertia, and the others in proportion; a body without inertia is refused."""
    largest = model.body_inertia[body].max()
    if largest == 0.0:
        name = model.body(body).name
        raise MadocError(f"body_inertia: body {name!r} has no inertia to scale; give it one in the model")
    model.body_inertia[body] *= max(value, min(INERTIA_FLOOR, LEAST * largest)) / largest


def off_centre(model: mujoco.MjModel, body: int) -> float:
    """Distance of a body's centre of mass from its origin, m; 0 where it is there but for rounding."""
    distance = float(np.linalg.norm(model.body_ipos[body]))
    gyration = np.sqrt(model.body_inertia[body].max() / max(float(model.body_mass[body]), MASS_FLOOR))
    return distance if distance > CENTRED * gyration else 0.0


def write_centre_of_mass(model: mujoco.MjModel, body: int, value: float) -> None:
    """Its distance from the body's origin in the direction that it has; without one it is refused."""
    distance = off_centre(model, body)
    if distance == 0.0:
        raise MadocError(
            f"body_com: the centre of mass of body {model.body(body).name!r} is at its origin, so it has no direction "
            "to move in; place it in the model"
        )
    before = model.body_ipos[body].copy()
    model.body_ipos[body] *= value / distance
    _keep_shapes(model, body, model.body_ipos[body] - before)


def _keep_shapes(model: mujoco.MjModel, body: int, moved: np.ndarray) -> None:
    """Leave geoms and sites where they are: MuJoCo keeps some of them, and boxes around them, in the inertial frame."""
    for owner, frame in ((model.geom_bodyid, model.geom_sameframe), (model.site_bodyid, model.site_sameframe)):
        in_inertial_frame = (owner == body) & np.isin(frame, _INERTIAL_FRAMES)
        frame[in_inertial_frame] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    first, count = model.body_bvhadr[body], model.body_bvhnum[body]
    if count:
        back, turned = np.zeros(4), np.zeros(3)
        mujoco.mju_negQuat(back, model.body_iquat[body])
        mujoco.mju_rotVecQuat(turned, moved, back)
        model.bvh_aabb[first : first + count, :3] -= turned


def pseudo_inertia(model: mujoco.MjModel, body: int) -> Float[np.ndarray, "4 4"]:
    """The pseudo-inertia matrix of a body in its own frame, [[Σ, h], [hᵀ, m]] in kg·m², kg·m and kg.

    Σ is the integral of x xᵀ over the mass, which is half the trace of the inertia about the origin minus that inertia;
    h is that of x, mass times centre (Rucker and Wensing 2022).
    """
    turn, mass, centre = np.zeros(9), float(model.body_mass[body]), model.body_ipos[body]
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    axes = turn.reshape(3, 3)
    moments = model.body_inertia[body]
    spread = axes @ np.diag(moments.sum() / 2.0 - moments) @ axes.T + mass * np.outer(centre, centre)
    return np.block([[spread, mass * centre[:, None]], [mass * centre[None], np.full((1, 1), mass)]])


def write_pseudo_inertia(model: mujoco.MjModel, body: int, wanted: Float[np.ndarray, "4 4"]) -> None:
    """Give a body the mass, centre, axes and moments of a pseudo-inertia matrix; its shapes stay where they are."""
    mass = float(wanted[3, 3])
    centre = wanted[:3, 3] / max(mass, mujoco.mjMINVAL)
    spread = wanted[:3, :3] - mass * np.outer(centre, centre)
    inertia = np.trace(spread) * np.eye(3) - spread
    moments, axes, turn = np.zeros(3), np.zeros(9), np.zeros(4)
    mujoco.mju_eig3(moments, axes, turn, inertia.ravel())
    model.body_mass[body] = mass
    model.body_inertia[body] = np.maximum(moments, INERTIA_FLOOR if mass else 0.0)
    model.body_ipos[body], model.body_iquat[body] = centre, turn
    model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    _keep_shapes(model, body, np.zeros(3))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # its boxes lie in the inertial frame, which turns


def write_deviations(model: mujoco.MjModel, body: int, values: Mapping[str, float]) -> None:
    """Write what is calibrated of a body's ten inertial numbers and of the payload that it carries, which adds to them.

    With J the body's own pseudo-inertia, J = L Lᵀ, it becomes L U Uᵀ Lᵀ, whatever the deviations that U is made of
    (`deviation`), that of a body that can exist: the log-Cholesky parametrisation of Rucker and Wensing 2022, from the
    model's body instead of from a unit one.

    Raises:
        MadocError: The body has no extent in some direction, or MuJoCo keeps its mass matrix diagonal.
    """
    name = model.body(body).name
    if model.body_simple[body]:
        raise MadocError(
            f"body {name!r} has its centre of mass at its origin, which MuJoCo calls simple, and has no place for a "
            "load off it or for other axes; add an empty <body/> to it in the model"
        )
    wanted = pseudo_inertia(model, body)
    if any(field in INERTIA for field in values):
        moments = model.body_inertia[body]
        if not moments.sum() / 2.0 - moments.max() > _EXTENT * moments.sum():
            raise MadocError(
                f"inertia: body {name!r} has no mass, or no extent in some direction (one moment of inertia is the sum "
                "of the others), so that there is no logarithm of it; change its <inertial>, or use payload_mass"
            )
        own = np.linalg.cholesky(wanted[::-1, ::-1])[::-1, ::-1]  # the upper factor is the lower one, turned round
        factor = own @ deviation(*(values.get(field, 0.0) for field in INERTIA))
        wanted = factor @ factor.T
    mass, *centre, gyration = (values.get(field, 0.0) for field in PAYLOAD)
    load = np.outer([*centre, 1.0], [*centre, 1.0]) + np.diag([gyration**2 / 2.0] * 3 + [0.0])
    write_pseudo_inertia(model, body, wanted + mass * load)


def deviation(
    alpha: float,
    d1: float,
    d2: float,
    d3: float,
    s12: float,
    s23: float,
    s13: float,
    t1: float,
    t2: float,
    t3: float,
) -> Float[np.ndarray, "4 4"]:
    """The upper triangular factor of Rucker and Wensing 2022 of its ten numbers; of zeros it is the unit matrix."""
    stretch = [[np.exp(d1), s12, s13, t1], [0.0, np.exp(d2), s23, t2], [0.0, 0.0, np.exp(d3), t3], [0.0, 0.0, 0.0, 1.0]]
    return float(np.exp(alpha)) * np.array(stretch)
