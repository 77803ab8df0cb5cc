"""Figure 3a: groups of Hopper's parameters on the robot, and in the plane of their embeddings.

madoc suite benchmarks/suites/figure-3a.yaml --out runs/paper      # minutes
python benchmarks/embedding.py --collect runs/paper                # keeps groups and embeddings in results
python benchmarks/embedding.py                                     # draws docs/concepts/groups.svg from the last ones
"""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from drawing import scatter_chart
from jaxtyping import Float
from kept import RESULTS, Study
from paper_cells import planned

from madoc import tasks
from madoc.report.reading import read_arrays
from madoc.report.sections.estimates import plane_of
from madoc.simulation.pictures import outlines
from madoc.simulation.write import find_elements
from madoc.tasks import Task

SUITE = "figure-3a"
PICTURE = Path(__file__).parents[1] / "docs" / "concepts" / "groups.svg"
STUDY = Study(RESULTS / "figure-3a.jsonl", ("groups_by",))
TITLE = "Learned by the VAE, as in the paper"
ROBOT, PLANE, HEIGHT, HEAD = 330, 560, 330, 34
"""Widths of both panels, the height of a row, and that of its title."""
STYLE = """
text { font: 13px system-ui, sans-serif; fill: #222 } .axis { font-size: 11.5px; fill: #666 }
.title { font-weight: 600 }
.frame { fill: none; stroke: #ddd } .limb { stroke: #d5d8dc; stroke-linecap: round }
.thread { stroke: var(--c); stroke-width: 7; stroke-linecap: round; opacity: 0.2 }
.dot { fill: var(--c); stroke: #fff; stroke-width: 2 }
.g0 { --c: #0072b2 } .g1 { --c: #d55e00 } .g2 { --c: #009e73 } .g3 { --c: #b8860b }
.g4 { --c: #cc79a7 } .g5 { --c: #56b4e9 } .g6 { --c: #7f7f7f } .g7 { --c: #8b4513 }
"""
"""Colours of groups as the report has them: classes g0, g1, ... in the order of the groups."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--collect", type=Path, help="folder of the suite, whose ended cells are kept")
    arguments = parser.parse_args()
    if arguments.collect:
        print(f"{SUITE}: {collect(arguments.collect)} cells kept")
    else:
        PICTURE.write_text(picture(STUDY.rows()[-1]))
        print(PICTURE)


def collect(folder: Path) -> int:
    """Keep groups, their stability and the embeddings of the cell, if it has ended: how many were kept."""
    (cell,) = [each for each in planned(SUITE).cells if each.kind == "calibrate"]
    place = cell.folder(folder)
    embeddings = read_arrays(place / "embeddings.npz", "names", "vectors")
    if embeddings is None or not (place / "outcome.json").exists():
        return 0
    result = json.loads((place / "result.json").read_text())
    STUDY.add(
        {
            "groups_by": "learned",
            "cell": cell.name,
            "groups": result["groups"],
            "stability": result["group_stability"],
            "names": embeddings["names"].tolist(),
            "vectors": np.round(embeddings["vectors"], 6).tolist(),
        }
    )
    return 1


def picture(found: Mapping) -> str:
    """An SVG: the robot, and the plane of the embeddings."""
    size = f"{ROBOT + PLANE} {HEIGHT + HEAD}"
    label = "Groups of Hopper's parameters, on the robot and in the plane of their embeddings"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" role="img" aria-label="{label}">\n'
        f'<style>{STYLE}</style>\n<rect width="100%" height="100%" fill="#fff"/>\n'
        f"{_drawn(tasks.make('hopper'), found)}</svg>\n"
    )


def _drawn(task: Task, found: Mapping) -> str:
    """The robot with its parameters, and their plane."""
    colour = {name: f"g{group}" for group, names in enumerate(found["groups"]) for name in names}
    points, shares = plane_of(np.array(found["vectors"]))
    chart = scatter_chart(
        points,
        [_title(name) for name in found["names"]],
        [colour[name] for name in found["names"]],
        titles=(f"first component, {100 * shares[0]:.0f} % of the variance", f"second, {100 * shares[1]:.0f} %"),
        width=PLANE,
        height=HEIGHT,
    )
    placed = f'<g transform="translate({ROBOT} {HEAD})">{chart}</g>'
    return (
        f'<g>\n<text class="title" x="12" y="22">{TITLE}: {len(found["groups"])} groups, '
        f"adjusted Rand index of its votes {found['stability']:.2f}</text>\n{robot(task, colour)}{placed}</g>\n"
    )


def robot(task: Task, colours: Mapping[str, str]) -> str:
    """The robot from its side as it stands at qpos0, and each parameter as a point: masses right, dampings left."""
    model = task.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    ends, radii = outlines(model, np.array([model.qpos0]))
    limbs = ends[0][:, :, [0, 2]]
    low, high = (limbs - radii[:, None, None]).min((0, 1)), (limbs + radii[:, None, None]).max((0, 1))
    scale = (HEIGHT - 50) / (high[1] - low[1])
    origin = np.array([ROBOT / 2 - scale * (low[0] + high[0]) / 2, HEAD + HEIGHT - 20 + scale * low[1]])
    drawn = [
        _limb(*(origin + scale * limb * [1, -1]), width=2 * scale * radius)
        for limb, radius in zip(limbs, radii, strict=True)
    ]
    for parameter in task.parameters.parameters:
        (element,) = find_elements(model, parameter)
        places = {"body_mass": data.xipos, "dof_damping": data.xanchor}
        at = origin + scale * places[parameter.field][element][[0, 2]] * [1, -1] if element >= 0 else GRAVITY
        side = -1 if parameter.field == "dof_damping" else 1
        drawn.append(_point(at, _title(parameter.name), colours[parameter.name], side))
    return "".join(drawn)


GRAVITY = np.array([28.0, HEAD + 40.0])
"""Where gravity stands, beside the robot."""


def _limb(first: Float[np.ndarray, " 2"], last: Float[np.ndarray, " 2"], *, width: float) -> str:
    ends = " ".join(
        f'{name}="{value:.1f}"' for name, value in zip(("x1", "y1", "x2", "y2"), (*first, *last), strict=True)
    )
    return f'<line class="limb" {ends} stroke-width="{width:.1f}"/>\n'


def _title(name: str) -> str:
    """`dof_damping.foot_joint` as `foot_joint damping`, which is short enough for a picture."""
    field, _, element = name.partition(".")
    return f"{element} {field.partition('_')[2]}" if element else field


def _point(at: Float[np.ndarray, " 2"], name: str, colour: str, side: int) -> str:
    """A named point; its name stands to the right where the side is 1, else to the left."""
    (x, y), anchor = at, "start" if side > 0 else "end"
    words = x + 14 * side
    return (
        f'<circle class="dot {colour}" cx="{x:.1f}" cy="{y:.1f}" r="6.5"/>'
        f'<text x="{words:.1f}" y="{y + 4:.1f}" text-anchor="{anchor}">{name}</text>\n'
    )


if __name__ == "__main__":
    main()
