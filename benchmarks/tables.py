"""Medians of what was measured, as Markdown, beside the paper's figures where it prints them.

python benchmarks/tables.py            # prints, and writes results/README.md and the tables of the README

`make figures` writes all that is made of committed results.
"""

import json
from collections import defaultdict

import adversary
import coverage
import numpy as np
import paper
import rates
import readme
from disturbances import disturbed
from kept import RESULTS, calibrations, is_time, learnt, shown
from not_run import not_run

SETS = ("adversary", "rates")
"""Folders of results of one JSON file each that are shown together."""


def main() -> None:
    text = measured()
    (RESULTS / "README.md").write_text(text)
    readme.README.write_text(readme.rewritten(readme.README.read_text(), learnt()))
    print(text)


def measured() -> str:
    """All tables but the paper's, as Markdown."""
    parts = ["# Measured\n\nMade by `python benchmarks/tables.py` from the files beside it.\n"]
    parts += [
        calibration(),
        groups(),
        disturbed(),
        policies(),
        planted(),
        verdicts(),
        sysid(),
        pendulum(),
        fuzz(),
        speed(),
        not_run(),
    ]
    return "\n".join(part for part in parts if part)


def calibration() -> str:
    """Error of every (robot, method, starts, budget) on clean data, median over seeds."""
    cells = defaultdict(list)
    for row in calibrations():
        if row["data"] == "clean" and "error" in row and not is_time(row["budget"]):
            cells[row["robot"], row["quality"], row["method"], row["starts"], row["budget"]].append(row)
    if not cells:
        return ""
    lines = [
        "## Calibration\n\n`python benchmarks/calibration.py` (see its options). Recorded legacy data, 200 000 rows. "
        "Mean absolute error in raw units, median (lowest to highest) over seeds; the paper's took 1e6 control steps. "
        "Seconds are of one core, shared with other work where a method's vary.\n",
        "| robot | data | method | starts | control steps | seeds | error | % of range | paper | seconds | commit |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (robot, quality, method, starts, _), rows in sorted(cells.items()):
        errors = [row["error"]["mean_absolute"] for row in rows]
        percent = np.median([row["error"]["mean_percent_of_range"] for row in rows])
        steps = int(np.median([row["control_steps"] for row in rows]))
        seconds = np.median([row["wall_seconds"] for row in rows])
        printed = paper.printed("table-10", f"{robot}-{quality}", method)
        commits = ", ".join(sorted({row["commit"] for row in rows}))
        lines.append(
            f"| {robot} | {quality} | {method} | {starts} | {steps:,} | {len(rows)} | {shown(errors)} "
            f"| {percent:.2f} | {printed[0] if printed else ''} | {seconds:.0f} | {commits} |"
        )
    return "\n".join(lines) + "\n"


def groups() -> str:
    """Error of groups, one agent and one agent a parameter: on the four robots, and by parameters and draws."""
    return (
        "## Groups or one agent\n\n`madoc suite benchmarks/suites/groups.yaml` (each seed is in `paper/scores.json`). "
        "Mean absolute error on medium data after 300,000 control steps, mean over seeds.\n\n"
        + readme.errors()
        + readme.study()
    )


def policies() -> str:
    """Return in the target of every learner, where it learnt and how, over seeds."""
    cells = defaultdict(list)
    for row in learnt():
        budget = row["budget"] if is_time(row["budget"]) else f"{row['budget']:,} {row['unit']}"
        cells[row["robot"], row["method"], row["at"], budget, " ".join(row["set"])].append(row)
    if not cells:
        return ""
    lines = [
        "## Policies\n\n`python benchmarks/policies.py` (see its options). Deterministic, in the target; medium data "
        "where a learner takes data. Budgets are a fraction of the paper's, 1e6 control steps or updates on D4RL's own "
        "data: none has converged. What is handed back is the policy that did best in the learner's own simulator, "
        "which costs up to as many control steps again, or in MOREC's models; of CQL and BC, and of H2O and MOREC in "
        "rows whose budget is no time, it is the last.\n",
        "| robot | learner | learnt at | budget | settings | seeds | return | normalized (mean ± std) | paper | s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (robot, method, at, budget, settings), rows in sorted(cells.items()):
        returns = [row["return"] for row in rows]
        normalized = [row["normalized"] for row in rows]
        spread = f" ± {np.std(normalized, ddof=1):.1f}" if len(rows) > 1 else ""
        lines.append(
            f"| {robot} | {method} | {at} | {budget} | {settings} | {len(rows)} | {np.median(returns):.0f} "
            f"({min(returns):.0f} to {max(returns):.0f}) | {np.mean(normalized):.1f}{spread} "
            f"| {_printed_return(robot, method, at)} | {np.median([row['seconds'] for row in rows]):.0f} |"
        )
    return "\n".join(lines) + "\n"


def _printed_return(robot: str, method: str, at: str) -> str:
    """The normalized return that the paper prints for a learner on medium data."""
    system = "madoc" if (method, at) == ("sac", "calibrated") else method
    printed = paper.printed("table-1", f"{robot}-medium", system) if system != "sac" else None
    return f"{printed[0]:.1f} ± {printed[1]:.1f}" if printed else ""


def speed() -> str:
    """What `speed.py` wrote."""
    path = RESULTS / "speed.json"
    if not path.exists():
        return ""
    return f"## Speed\n\n`python benchmarks/speed.py`\n\n```json\n{path.read_text()}```\n"


def planted() -> str:
    """What `planted.py` found: a verdict and the estimates of each robot and situation, and how intervals cover."""
    rows = [json.loads(path.read_text()) for path in sorted((RESULTS / "planted").glob("*-[0-9].json"))]
    if not rows:
        return ""
    lines = [
        "## Planted truths in robots of one's own\n",
        "`python benchmarks/planted.py`. `madoc calibrate SPEC --data LOGS`, all defaults. Covered: 95 % intervals "
        "that hold the truth; where readings are exact these are as narrow as rounding. Worst: % of its range that a "
        "parameter is off.\n",
        "| robot | situation | verdict | expected | method | covered | worst, % | s | commit |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        found = list(row["parameters"].values())
        covered = f"{sum(part['covered'] for part in found)} of {len(found)}" if found[0]["interval"] else "-"
        worst = max(part["percent_of_range"] for part in found)
        cells = (row["robot"], row["situation"], row["verdict"]["word"], row["expected"], row["method"])
        lines.append(f"| {' | '.join(cells)} | {covered} | {worst:.2g} | {row['seconds']:.0f} | {row['commit']} |")
    for path in sorted((RESULTS / "planted").glob("*-coverage-*.json")):
        told = json.loads(path.read_text())
        lines.append(
            f"\nOf {told['problems']} problems planted on the pendulum (least squares, noise of {told['noise']:g} of "
            f"each signal's spread), {100 * told['covered']:.1f} % of 95 % intervals cover the truth "
            f"({told['commit']})."
        )
    return "\n".join(lines) + "\n"


def verdicts() -> str:
    """What `adversary.py`, `coverage.py` and `rates.py` found."""
    cases, logs = ([json.loads(path.read_text()) for path in sorted((RESULTS / name).glob("*.json"))] for name in SETS)
    seeds = ", ".join(map(str, sorted({case["seed"] for case in cases})))
    return (
        "## Verdicts and intervals\n\n"
        f"`python benchmarks/adversary.py`: {len(cases)} problems of seven robots, seeds {seeds}; each with `--table`. "
        "Invisible deceptions are those that no data can show; `madoc check` names them.\n\n"
        f"{adversary.summary(cases)}\n\n"
        "`python benchmarks/coverage.py`: honest problems, least squares, 95 % intervals.\n\n"
        f"{coverage.table(coverage.RESULTS)}\n\n"
        "`python benchmarks/rates.py`: one log of a double pendulum with coarse encoders at three rates, all defaults. "
        "Windows of 0.5 s are simulated from true states; values 5 % off the truth stand for a data sheet's.\n\n"
        f"{rates.table(logs)}\n"
    )


def sysid() -> str:
    """What `against_sysid.py` found: both tools on every robot and situation."""
    rows = [json.loads(path.read_text()) for path in sorted((RESULTS / "sysid").glob("*.json"))]
    if not rows:
        return ""
    lines = [
        "## Against mujoco.sysid\n",
        "`python benchmarks/against_sysid.py`. The planted truths above; `--method least-squares` beside MuJoCo's own "
        "toolbox with its default optimizer, normalization and intervals, on whole runs or on stretches, whichever "
        "leave the smaller residual. Errors and the median half width of 95 % intervals in % of each parameter's "
        "range; where readings are exact, intervals are as narrow as rounding. Seconds on the wall, in which ours also "
        "checks the log and leaves a run folder, and of solving alone, with its ratio to all of `mujoco.sysid`.\n",
        "| robot | situation | tool | data | worst, % | mean, % | covered | half width, % | s | solving, s | ratio "
        "| commit |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        for name, told in (("madoc", row["madoc"]), ("mujoco.sysid", row["sysid"])):
            figures = " | ".join(f"{told[part]:.2g}" for part in ("worst", "mean"))
            solving = told.get("solving", told["seconds"])
            ratio = f"{solving / row['sysid']['seconds']:.2f}" if name == "madoc" else ""
            lines.append(
                f"| {row['robot']} | {row['situation']} | {name} | {told.get('cut', '-')} | {figures} | "
                f"{told['covered']} of {len(told['parameters'])} | {told['half_width']:.2g} | {told['seconds']:.2f} | "
                f"{solving:.2f} | {ratio} | {row['commit']} |"
            )
    return "\n".join(lines) + "\n"


def pendulum() -> str:
    """What `real_pendulum.py` found."""
    path = RESULTS / "real_pendulum.json"
    if not path.exists():
        return ""
    told = json.loads(path.read_text())
    lines = [
        "## A pendulum of hardware\n",
        f"`python benchmarks/real_pendulum.py --data FOLDER`; {told['unit']}. Calibrated to the run under iLQR; commit "
        f"{told['commit']}.\n",
        "| run | ours | the best published set for that run | mid-range |",
        "|---|---|---|---|",
    ]
    for run, errors in told["errors"].items():
        others = {name: error for name, error in errors.items() if name not in ("madoc", "mid-range")}
        best = min(others, key=lambda name: others[name])
        middle = f"{errors['mid-range']:.3f}" if "mid-range" in errors else "-"
        lines.append(f"| {run} | {errors['madoc']:.3f} | {others[best]:.3f} ({best}) | {middle} |")
    return "\n".join(lines) + "\n"


def fuzz() -> str:
    """What `fuzz.py` found."""
    path = RESULTS / "fuzz.json"
    if not path.exists():
        return ""
    told = json.loads(path.read_text())
    counts = ", ".join(f"{name} {count:,}" for name, count in told.items() if isinstance(count, int) and name != "seed")
    return f"## Fuzzing\n\n`python benchmarks/fuzz.py --minutes {told['minutes']:g}`: {counts} ({told['commit']}).\n"


if __name__ == "__main__":
    main()
