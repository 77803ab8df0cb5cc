"""Medians of what was measured, as Markdown, beside the paper's figures where it prints them.

python benchmarks/tables.py            # prints, and writes results/README.md and the tables of the README

`make figures` writes all that is made of committed results.
"""

import json
from collections import defaultdict
from itertools import product
from pathlib import Path

import adversary
import coverage
import numpy as np
import paper
import rates
import readme

from calibration import usual_starts

RESULTS = Path(__file__).parent / "results"
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


def calibrations() -> list[dict]:
    """Every calibration that was run, refused ones included."""
    rows = [json.loads(path.read_text()) for path in sorted((RESULTS / "calibration").glob("*.json"))]
    return [{"robot": row.get("task"), "data": "clean", "budget": 300_000} | row for row in rows]


def is_time(budget: int | str) -> bool:
    """Whether a budget is a time, as "60s"."""
    return isinstance(budget, str)


def label(row: dict) -> str:
    """A method and where its rollouts start, if that is not where they usually do on such data."""
    usual = "policy" if row["method"] == "madoc" else usual_starts(row["data"])
    return row["method"] if row["starts"] in ("-", usual) else f"{row['method']}, {row['starts']}"


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
        "## Groups or one agent\n\n`madoc suite benchmarks/suites/groups.yaml` (each seed is in `paper/groups.json`). "
        "Mean absolute error on medium data after 300,000 control steps, mean over seeds.\n\n"
        + readme.errors()
        + readme.study()
    )


def shown(errors: list[float]) -> str:
    """Median (lowest to highest), three decimals or, below them, three digits."""
    median, low, high = np.median(errors), min(errors), max(errors)
    return f"{median:.3f} ({low:.3f} to {high:.3f})" if median >= 1e-3 else f"{median:.1e} ({low:.1e} to {high:.1e})"


def disturbed() -> str:
    """Error of every method on every kind of data, or that it refuses: at equal wall time, then at equal steps."""
    timed = [row for row in calibrations() if is_time(row["budget"])]
    counted = [row for row in calibrations() if not is_time(row["budget"])]
    return (
        "## Under disturbances\n\n`python benchmarks/calibration.py --data-is ...`. Median of the mean absolute error "
        "over seeds, and in brackets in % of the range. *refuses*: with a sentence, kept in the result. Empty: not "
        "run. What the data tells: the median over parameters of half the width of least squares' 95 % intervals, in % "
        "of the range.\n\n" + "\n".join(_disturbed(rows) for rows in (timed, counted) if rows)
    )


def _disturbed(rows: list[dict]) -> str:
    cells, methods, robots = defaultdict(list), set(), set()
    for row in rows:
        cells[row["robot"], row["data"], row["budget"], label(row)].append(row)
        if row["data"] != "clean":
            methods.add(label(row))
            robots.add(row["robot"])
    methods = sorted(methods, key=lambda name: (name not in ("least-squares", "madoc"), name))
    head = ("robot", "data", "budget", "seeds", "what the data tells, %", *methods)
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for robot, data, budget in sorted({cell[:3] for cell in cells}):
        columns = [cells.get((robot, data, budget, method), []) for method in methods]
        if robot in robots and any(columns):
            of_all = budget if is_time(budget) else f"{budget:,}"
            seeds = sorted({len(column) for column in columns if column})
            told = _half_width(cells.get((robot, data, budget, "least-squares"), []))
            words = (robot, data, of_all, " to ".join(map(str, seeds[:: max(1, len(seeds) - 1)])), told)
            lines.append(f"| {' | '.join((*words, *map(_cell, columns)))} |")
    return "\n".join(lines) + "\n"


def _half_width(rows: list[dict]) -> str:
    """Half the width of intervals in % of the range, the median over parameters and seeds; empty without intervals."""
    found = [
        50.0 * (part["interval"][1] - part["interval"][0]) / (part["high"] - part["low"])
        for row in rows
        for part in row.get("parameters", {}).values()
        if part.get("interval")
    ]
    return f"{np.median(found):.2g}" if found else ""


def _cell(rows: list[dict]) -> str:
    errors = [row["error"] for row in rows if "error" in row]
    if not errors:
        return "refuses" if rows else ""
    percent = np.median([error["mean_percent_of_range"] for error in errors])
    return f"{shown([error['mean_absolute'] for error in errors]).partition(' ')[0]} ({percent:.2g})"


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


def learnt() -> list[dict]:
    """Every policy that was learnt and evaluated."""
    return [json.loads(path.read_text()) for path in sorted((RESULTS / "policies").glob("*.json"))]


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


ROBOTS = ("hopper", "halfcheetah")
SIMULATING = {"hopper": "hidden=[128,128] updates_per_step=1", "halfcheetah": "hidden=[128,128] updates_per_step=0.25"}
OFFLINE = dict.fromkeys(ROBOTS, "")
POLICIES = [
    ("sac", ("calibrated", "distribution", "uniform", "midrange", "truth"), (300_000, 300_000), SIMULATING),
    ("sac-bc", ("calibrated",), (100_000, 300_000), SIMULATING),
    ("dr-bc", ("-",), (100_000, 300_000), SIMULATING),
    ("h2o", ("midrange",), (100_000, 300_000), SIMULATING),
    ("bc", ("-",), (20_000, 20_000), OFFLINE),
    ("cql", ("-",), (50_000, 50_000), dict.fromkeys(ROBOTS, "hidden=[128,128] critic_hidden=[128,128] samples=4")),
    (
        "morec",
        ("-",),
        ("900s", "900s"),
        {"hopper": "hidden=[128,128] penalty=2.5", "halfcheetah": "hidden=[128,128]"},
    ),
]
"""Learners, where they learn, and the budget and settings on each robot that fit two cores; of 3 seeds. MOREC's penalty
is chosen for each robot, as its authors do."""


def policies_not_run() -> list[str]:
    """Of every learner, robot and place, the seeds that the table should hold and does not."""
    done = {
        (row["robot"], row["method"], row["at"], row["budget"], " ".join(row["set"]), row["seed"]) for row in learnt()
    }
    lines = []
    for (method, places, budgets, settings), (index, robot) in product(POLICIES, enumerate(ROBOTS)):
        budget, chosen = budgets[index], settings[robot]
        for at in places:
            seeds = [str(seed) for seed in range(3) if (robot, method, at, budget, chosen, seed) not in done]
            words = [
                *([f"--at {at}"] if at != "-" else []),
                f"--budget {budget}",
                *([f"--set {chosen}"] if chosen else []),
            ]
            if seeds:
                lines.append(
                    f"- `python benchmarks/policies.py --robots {robot} --methods {method} {' '.join(words)} "
                    f"--seeds {' '.join(seeds)}`"
                )
    return lines


CALIBRATORS = ("dropo", "e-dropo", "droid", "oted", "cma-es", "cma-es-distribution", "least-squares", "nominal")
"""Besides Madoc, with the paper's budget."""


DISTURBED = ("noise-1", "noise-10", "modern", "friction-20", "hidden", "shuffled-rows", "shuffled-next")


def disturbed_not_run() -> list[str]:
    """Of every calibrator and robot, the disturbances that it has not met for an equal wall time."""
    timed = (row for row in calibrations() if is_time(row["budget"]))
    done = {(row.get("method"), row["robot"], row["data"]) for row in timed}
    lines = []
    for method, robot in product((*CALIBRATORS, "madoc"), ROBOTS):
        data = [name for name in DISTURBED if (method, robot, name) not in done]
        if data:
            lines.append(
                f"- `python benchmarks/calibration.py --robots {robot} --methods {method} --data-is {' '.join(data)} "
                "--budget 60s --seeds 0`"
            )
    return lines


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
    for method, robot in product(CALIBRATORS, ROBOTS):
        found = [row for row in calibrations() if (row.get("method"), row["robot"]) == (method, robot)]
        done = {row["seed"] for row in found if row["data"] == "clean"}
        seeds = [str(seed) for seed in range(3) if seed not in done]
        if seeds:
            lines.append(
                f"- `python benchmarks/calibration.py --robots {robot} --methods {method} --budget 1000000 "
                f"--seeds {' '.join(seeds)}`"
            )
    lines += disturbed_not_run()
    lines += policies_not_run()
    if not (RESULTS / "speed.json").exists():
        lines.append("- `python benchmarks/speed.py`")
    return "\n".join(["## Not run yet\n", *lines]) + "\n" if lines else ""


if __name__ == "__main__":
    main()
