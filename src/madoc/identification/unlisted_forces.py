"""Families of forces that nobody listed: at each joint, on each free body, and of drives, all that a small basis spans.

A basis has the motion and what drives exert, their products, and shapes with a kink. Its forces are tested together,
as one family by one statistic, so that a force of any shape near its span shows, whatever its name would be.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from madoc.identification.body_forces import FreeBody, free_bodies, of_all_drives
from madoc.identification.causes import BENT_ALL, CUBIC_ALL, DEAD_ALL, NEAR_GROUND, UNLISTED, WEAKENING_ALL
from madoc.identification.fitted_windows import Fit, reduced_of
from madoc.identification.information import NORMAL_95
from madoc.identification.replay import Readings
from madoc.identification.responses import Responses
from madoc.identification.score_tests import family_score, shared_deviate
from madoc.identification.term_tests import LIKELY_FORCE, SUSPICIOUS, Alternative, MissingTerm, TermTests
from madoc.simulation.base import Simulator
from madoc.simulation.write import single_joints

NEIGHBOURS = 3
"""Largest number of other joints whose motion a force may depend on: those before and behind it in the model."""
SLOW = 0.3
"""Speed over its root mean square, below which a force at low speed acts; friction turns within a third of it."""
CONSTANT = "nothing"
"""The quantity of a force that is constant."""
_OF_DRIVES = {
    BENT_ALL: "the square of what each exerts",
    CUBIC_ALL: "the cube of what each exerts",
    DEAD_ALL: "small commands",
    WEAKENING_ALL: "the speed at which each pushes",
    NEAR_GROUND: "their nearness to the ground",
}
"""What the forces of all drives grow with."""
_SMALLEST = 1e-9
"""Root mean square below which a quantity does nothing."""

Along = Float[np.ndarray, "windows steps"]


@dataclass(frozen=True)
class Family:
    """Forces that are tested together.

    Attributes:
        place: Where they act, in words.
        unit: Of their size.
        quantities: What each grows with, in words.
        forces: On each degree of freedom, of about 1 in size.
        size: Root mean square force of which sizes are multiples.
    """

    place: str
    unit: str
    quantities: tuple[str, ...]
    forces: Float[np.ndarray, "windows steps dof terms"]
    size: float = 1.0


def families(simulator: Simulator, responses: Responses) -> Iterator[Family]:
    """Every family of a robot: at each joint of one degree of freedom, by six on free bodies, and of all drives."""
    model, exerted = simulator.task.model, responses.drives.sum(2)
    dofs, speed = exerted.shape[-1], responses.motion[..., model.nq : model.nq + exerted.shape[-1]]
    joints = single_joints(model)
    along = [(responses.motion[..., int(each.qposadr[0])], speed[..., int(each.dofadr[0])]) for each, _ in joints]
    for place, (joint, turns) in enumerate(joints):
        dof = int(joint.dofadr[0])
        near = [index for index in range(len(joints)) if index != place and abs(index - place) <= NEIGHBOURS // 2 + 1]
        others = {joints[index][0].name: along[index] for index in near[:NEIGHBOURS]}
        basis = of_joint(*along[place], exerted[..., dof], others, turns=turns)
        yield _family(joint.name, "N·m" if turns else "N", basis, (np.arange(dofs) == dof).astype(float))
    bodies = list(free_bodies(simulator, responses))
    for body in bodies:
        for axis, letter in zip(np.eye(3), "xyz", strict=True):
            for turning, unit, kind in ((False, "N", "along"), (True, "N·m", "about")):
                basis = of_body(body, "xyz".index(letter), turning=turning)
                shape, nothing = np.broadcast_to(axis, body.force.shape), np.zeros_like(body.force)
                pull, torque = (nothing, shape) if turning else (shape, nothing)
                direction = body.generalised(pull, torque, dofs)
                yield _family(f"{body.name}, {kind} its {letter} axis", unit, basis, direction)
    if (np.nan_to_num(responses.drives) != 0.0).any((0, 1, 3)).sum() > 1:
        yield _of_drives(simulator, responses, speed, bodies)


def unlisted_forces(
    tests: TermTests,
    families: Iterable[Family],
    readings: Readings,
    fit: Fit,
    by_terms: Float[np.ndarray, "windows values terms"],
    responses: Responses,
) -> tuple[list[MissingTerm], list[Alternative]]:
    """Families of forces that the model may lack, and estimates with those that it likely does.

    The error of the integration step is taken away before. Each family is as significant as if it were the only one of
    a log in which as many are looked for. A term's shifts are the least that its 95 % intervals hold, as many forces
    move a parameter by some at random.

    Args:
        tests: Score tests of the listed terms, whose effects are `by_terms`.
        families: What is tried.
        readings: The windows.
        fit: What they were fitted by.
        by_terms: Derivatives of the residuals by the listed terms.
        responses: What small forces do to the windows.
    """
    steps = [] if tests.steps is None else [tests.steps[0]]
    terms, others, every = list[MissingTerm](), list[Alternative](), list(families)
    first, beside = 1 + tests.products.count, by_terms[..., steps]
    listed = replace(fit.slopes, by_parameters=np.concatenate([fit.slopes.by_parameters, beside], axis=-1))
    reduced = reduced_of(listed, readings, tests.products.count)
    if reduced is None:
        return terms, others
    for family in every:
        products = reduced.products(responses.effects(family.forces))
        own = range(first + len(steps), products.each.shape[1])
        found = family_score(products, own, range(first, own.start))
        t = 0.0 if found is None else shared_deviate(found.t, len(every))
        if found is None or t < SUSPICIOUS:
            continue
        force = (family.forces @ found.changes)[fit.slopes.whole]
        size = float(np.sqrt((force**2).sum(-1).mean())) / family.size
        quantity = family.quantities[found.leading]
        growing = f"grows most with {quantity}" if quantity != CONSTANT else "is about constant"
        cause = f"{UNLISTED} ({family.place}), which {growing}"
        least = np.sign(found.shifts) * np.maximum(np.abs(found.shifts) - NORMAL_95 * found.errors, 0.0)
        explained = tests.beside_steps * found.explained
        terms.append(MissingTerm(cause, "", size, size / t, family.unit, explained, t, tests.by_name(least)))
        if t >= LIKELY_FORCE:
            others.append(tests.alternative((cause,), found.shifts, NORMAL_95 * found.errors))
    return terms, others


def of_joint(
    position: Along, speed: Along, exerted: Along, others: Mapping[str, tuple[Along, Along]], *, turns: bool
) -> dict[str, Along]:
    """Functions of a joint's motion, of what its drive exerts and of other joints, by what they grow with."""
    places = {"the sine of its position": np.sin(position), "the cosine of its position": np.cos(position)}
    own = {"its speed": _scaled(speed), "what its drive exerts": _scaled(exerted)}
    own = {
        **(places if turns and float(np.nanstd(position)) > 0.5 else {"its position": _standardised(position)}),
        **own,
    }
    far = {f"the position of {name}": _standardised(each) for name, (each, _) in others.items()}
    far |= {f"the speed of {name}": _scaled(each) for name, (_, each) in others.items()}
    pace, drive = own["its speed"], own["what its drive exerts"]
    direction = np.tanh(3.0 * pace / SLOW)
    shapes = {
        "the direction of its motion": direction,
        "the direction of its motion at low speed": direction * np.exp(-((pace / SLOW) ** 2)),
        "the load in the direction of its motion": direction * np.abs(drive),
        "small commands": np.tanh(3.0 * drive / SLOW),
        **{f"{name}, cubed": each**3 for name, each in own.items()},
    }
    return {
        CONSTANT: np.ones_like(position),
        **own,
        **far,
        **shapes,
        **_squares(own),
        **_products(own, {**own, **far}),
    }


def of_body(body: FreeBody, axis: int, *, turning: bool) -> dict[str, Along]:
    """Functions of a free body's motion and of what drives exert on it, by what they grow with, for one axis of it."""
    force, torque = (
        {f"the {kind} {letter}": _scaled(values[..., index]) for index, letter in enumerate("xyz")}
        for kind, values in (("force of its drives along", body.force), ("torque of its drives about", body.torque))
    )
    drives = {name: each for name, each in (force | torque).items() if float(np.nanmax(np.abs(each))) > 0.0}
    motion = {f"its velocity along {letter}": _scaled(body.velocity[..., index]) for index, letter in enumerate("xyz")}
    motion |= {f"its turning about {letter}": _scaled(body.turning[..., index]) for index, letter in enumerate("xyz")}
    world = body.axes()
    leaning = {f"the world's {letter} axis": world[index, ..., axis] for index, letter in enumerate("xyz")}
    near = {
        "its height": _standardised(body.height),
        "its nearness to the ground": _scaled(np.maximum(body.height, 0.05) ** -2),
    }
    own = "its turning" if turning else "its velocity"
    with_drives = {**near, **{name: each for name, each in motion.items() if name.startswith(own)}}
    turns = {name: each for name, each in motion.items() if name.startswith("its turning")}
    products = _products(drives, with_drives) | _products(turns, turns)
    squares = _squares(drives | motion)
    return {CONSTANT: np.ones_like(body.height), **leaning, **drives, **motion, **near, **squares, **products}


def _of_drives(
    simulator: Simulator, responses: Responses, speed: Float[np.ndarray, "windows steps dof"], bodies: list[FreeBody]
) -> Family:
    """What all drives exert, by its size and by their motion, and each by itself where it acts on several degrees."""
    drives = responses.drives
    height = bodies[0].height if len(bodies) == 1 else None
    shared = of_all_drives(drives, speed, height)
    forces, quantities = [drives.sum(2), *shared.values()], ["what they exert", *(_OF_DRIVES[each] for each in shared)]
    for index in range(drives.shape[2]):
        name, own = simulator.task.model.actuator(index).name, drives[:, :, index : index + 1]
        if (np.nan_to_num(np.abs(own)).max((0, 1, 2)) > 0.0).sum() > 1:
            bent = of_all_drives(own, speed, height)
            forces += [own.sum(2), bent[BENT_ALL], bent[CUBIC_ALL]]
            quantities += [f"{power}what {name} exerts" for power in ("", "the square of ", "the cube of ")]
    size, every = float(np.sqrt(np.nanmean((forces[0] ** 2).sum(-1)))), np.nan_to_num(np.stack(forces, axis=-1))
    return Family("all drives", "of what they exert", tuple(quantities), every, max(size, _SMALLEST))


def _family(place: str, unit: str, basis: Mapping[str, Along], direction: Float[np.ndarray, "*windows dof"]) -> Family:
    """The family of a basis whose forces act in one direction; what does not change is left out."""
    kept = {name: each for name, each in basis.items() if float(np.sqrt(np.nanmean(each**2))) > _SMALLEST}
    values = np.stack([np.nan_to_num(each) for each in kept.values()], axis=-1)
    return Family(place, unit, tuple(kept), np.nan_to_num(direction)[..., :, None] * values[..., None, :])


def _products(some: Mapping[str, Along], others: Mapping[str, Along]) -> dict[str, Along]:
    """Every product of two different quantities, once."""
    found: dict[frozenset[str], tuple[str, Along]] = {}
    for (first, one), (second, other) in ((a, b) for a in some.items() for b in others.items() if a[0] != b[0]):
        found.setdefault(frozenset((first, second)), (f"{first} times {second}", one * other))
    return dict(found.values())


def _squares(some: Mapping[str, Along]) -> dict[str, Along]:
    """Every quantity times its absolute value."""
    return {f"the square of {name}": each * np.abs(each) for name, each in some.items()}


def _scaled(values: Along) -> Along:
    """The values over their root mean square; 0 where that is nothing."""
    size = float(np.sqrt(np.nanmean(values**2)))
    return values / size if size > _SMALLEST else np.zeros_like(values)


def _standardised(values: Along) -> Along:
    """The values less their mean, over their standard deviation; 0 where that is nothing."""
    return _scaled(values - np.nanmean(values))
