"""Medians of what was measured, as Markdown, beside the paper's figures where it prints them.

python benchmarks/tables.py            # prints, and writes results/README.md
"""

import json
from collections import defaultdict
from itertools import product
from pathlib import Path

import numpy as np

RESULTS = Path(__file__).parent / "results"

# Table 10, Jiang et al. 2024: mean absolute calibration error on D4RL medium after 1e6 control steps.
PAPER_ERROR = {
    ("halfcheetah", "madoc"): 0.06,
    ("halfcheetah", "madoc-s"): 0.13,
    ("hopper", "madoc"): 0.33,
    ("hopper", "madoc-s"): 0.34,
    ("walker2d", "madoc"): 0.18,
    ("walker2d", "madoc-s"): 0.26,
    ("ant", "madoc"): 0.16,
    ("ant", "madoc-s"): 0.25,
}


def main() -> None:
    parts = ["# Measured\n\nMade by `python benchmarks/tables.py` from the files beside it.\n"]
    parts += [calibration(), policies(), speed(), not_run()]
    text = "\n".join(part for part in parts if part)
    (RESULTS / "README.md").write_text(text)
    print(text)


def calibration() -> str:
    """Error of every (robot, method, starts, budget), median over seeds."""
    cells = defaultdict(list)
    for path in sorted((RESULTS / "calibration").glob("*.json")):
        row = json.loads(path.read_text())
        budget = path.stem.rsplit("-", 2)[1]
        cells[row["task"], row["quality"], row["method"], row["starts"], int(budget)].append(row)
    if not cells:
        return ""
    lines = [
        "## Calibration\n\n`python benchmarks/calibration.py` (see its options). Recorded legacy data, 200 000 rows. "
        "Mean absolute error in raw units, median (lowest to highest) over seeds; the paper's took 1e6 control steps. "
        "Seconds are of one core.\n",
        "| robot | data | method | starts | control steps | seeds | error | % of range | paper | seconds | commit |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (robot, quality, method, starts, _), rows in sorted(cells.items()):
        errors = [row["error"]["mean_absolute"] for row in rows]
        percent = np.median([row["error"]["mean_percent_of_range"] for row in rows])
        steps = int(np.median([row["control_steps"] for row in rows]))
        seconds = np.median([row["wall_seconds"] for row in rows])
        paper = PAPER_ERROR.get((robot, method), "")
        commits = ", ".join(sorted({row["commit"] for row in rows}))
        lines.append(
            f"| {robot} | {quality} | {method} | {starts} | {steps:,} | {len(rows)} | {np.median(errors):.3f} "
            f"({min(errors):.3f} to {max(errors):.3f}) | {percent:.2f} | {paper} | {seconds:.0f} | {commits} |"
        )
    return "\n".join(lines) + "\n"


def policies() -> str:
    """Return in the target by where the policy was learnt, median over seeds."""
    cells = defaultdict(list)
    for path in sorted((RESULTS / "policies").glob("*.json")):
        row = json.loads(path.read_text())
        cells[row["robot"], row["at"], row["budget"], row["hidden"], row["updates_per_step"]].append(row)
    if not cells:
        return ""
    lines = [
        "## Policies\n\n`python benchmarks/policies.py` (see its options). Deterministic, return in the target.\n",
        "| robot | learnt at | control steps | hidden | updates | seeds | return | normalized | seconds | commit |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (robot, at, budget, hidden, updates), rows in sorted(cells.items()):
        returns = [row["return"] for row in rows]
        normalized = np.median([row["normalized"] for row in rows])
        seconds = np.median([row["seconds"] for row in rows])
        commits = ", ".join(sorted({row["commit"] for row in rows}))
        lines.append(
            f"| {robot} | {at} | {budget:,} | 2x{hidden} | {updates:g} | {len(rows)} | {np.median(returns):.0f} "
            f"({min(returns):.0f} to {max(returns):.0f}) | {normalized:.1f} | {seconds:.0f} | {commits} |"
        )
    return "\n".join(lines) + "\n"


def speed() -> str:
    """What `speed.py` wrote."""
    path = RESULTS / "speed.json"
    if not path.exists():
        return ""
    return f"## Speed\n\n`python benchmarks/speed.py`\n\n```json\n{path.read_text()}```\n"


def not_run() -> str:
    """What the tables should hold and do not, each with the command that runs it."""
    lines = []
    for robot, starts in product(("hopper", "halfcheetah", "walker2d", "ant"), ("logged", "policy")):
        for method in ("madoc", "madoc-s") if robot == "halfcheetah" else ("madoc",):
            wanted = range(5 if robot == "halfcheetah" else 3)
            name = f"{robot}-medium-{method}-{starts}-300000"
            seeds = [seed for seed in wanted if not (RESULTS / "calibration" / f"{name}-{seed}.json").exists()]
            if seeds:
                lines.append(
                    f"- `python benchmarks/calibration.py --robots {robot} --methods {method} --starts {starts} "
                    f"--seeds {' '.join(map(str, seeds))}`"
                )
    if len(list((RESULTS / "policies").glob("*.json"))) < 18:
        lines.append("- `python benchmarks/policies.py --robots hopper halfcheetah --seeds 0 1 2`")
    if not (RESULTS / "speed.json").exists():
        lines.append("- `python benchmarks/speed.py`")
    return "\n".join(["## Not run yet\n", *lines]) + "\n" if lines else ""


if __name__ == "__main__":
    main()
