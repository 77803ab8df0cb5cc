"""What was measured, as Markdown.

python benchmarks/tables.py            # prints, and writes results/README.md and the table of the page on methods

`make figures` writes all that is made of kept results.
"""

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import adversary
import adversary_table
import interval_coverage
import legged
import method_page
import numpy as np
import payload
import planted
import planted_servo
import rates
import wrong_friction
from disturbances import disturbed, settled_wrongly
from kept import CALIBRATIONS, POLICIES, RESULTS, SYSID, Study, commits, is_time
from pooling import by_log, label, order, shown

PAGE = RESULTS / "README.md"
SINGLE = {name: Study(RESULTS / f"{name}.jsonl", ()) for name in ("real_pendulum", "fuzz", "speed")}
"""Studies of which the last row counts."""


def main() -> None:
    text = measured()
    PAGE.write_text(text)
    method_page.PAGE.write_text(method_page.rewritten(method_page.PAGE.read_text()))
    print(text)


def measured() -> str:
    """All tables but the paper's, as Markdown."""
    parts = [
        "# Measured\n\nMade by `python benchmarks/tables.py` from the tables beside it, one line of JSON a cell. "
        "Commits are those of the code that was measured; where a row has cells of several it says *mixed*.\n",
        calibration(),
        disturbed(),
        settled_wrongly(),
        policies(),
        planted_truths(),
        verdicts(),
        sysid(),
        pendulum(),
        suites(),
        fuzz(),
        speed(),
    ]
    return "\n".join(part for part in parts if part)


def calibration() -> str:
    """Error of every task, method and budget of control steps on clean data."""
    cells = defaultdict(list)
    for row in CALIBRATIONS.rows():
        if row["data"] == "clean" and not is_time(row["budget"]) and "calibrated" not in row and "level" not in row:
            cells[f"{row['robot']}-{row['quality']}", order(label(row)), row["transitions"], row["budget"]].append(row)
    lines = [
        "## Calibration\n\n`python benchmarks/calibration.py --tasks ... --methods ... --logs ...`. Recorded legacy "
        "data. Mean absolute error in raw units, the mean over logs (lowest to highest), where seeds of a log are "
        "averaged first. Seconds are of one core, shared with other work where a method's vary.\n",
        "| task | method | control steps | logs | runs | error | % of range | s | commits |",
        "|---" * 9 + "|",
    ]
    for (task, (_, method), _, _), rows in sorted(cells.items()):
        ended = [row for row in rows if "error" in row]
        if not ended:
            lines.append(f"| {task} | {method} | | | {len(rows)} | refuses | | | {commits(rows)} |")
            continue
        errors, percent = by_log(ended), by_log(ended, "mean_percent_of_range")
        steps, seconds = (np.median([row[name] for row in ended]) for name in ("control_steps", "seconds"))
        lines.append(
            f"| {task} | {method} | {steps:,.0f} | {len(errors)} | {len(ended)} | {shown(errors)} "
            f"| {np.mean(list(percent.values())):.2g} | {seconds:.0f} | {commits(rows)} |"
        )
    return "\n".join(lines) + "\n"


def policies() -> str:
    """Return in the target of every learner, where it learnt and how, over seeds."""
    cells = defaultdict(list)
    for row in POLICIES.rows():
        budget = row["budget"] if is_time(row["budget"]) else f"{row['budget']:,} {row['unit']}"
        cells[row["robot"], row["method"], place(row), budget, " ".join(row["set"])].append(row)
    lines = [
        "## Policies\n\n`python benchmarks/policies.py` (see its options). Deterministic, in the target; medium data "
        "where a learner takes data. *madoc-vae-changes* is an earlier Madoc that is no longer there. Budgets are a "
        "fraction of the paper's, 1e6 control steps or updates, and networks are smaller where settings say `hidden`: "
        "none has converged, and none is comparable to a printed figure. What is handed back is the policy "
        "that did best in the learner's own simulator, which costs up to as many control steps again, or in MOREC's "
        "models; of CQL and BC, and of H2O and MOREC in rows whose budget is no time, it is the last.\n",
        "| robot | learner | learnt at | budget | settings | seeds | return | normalized (mean ± std) | s | commits |",
        "|---" * 10 + "|",
    ]
    for (robot, method, at, budget, settings), rows in sorted(cells.items()):
        returns = [row["return"] for row in rows]
        normalized = [row["normalized"] for row in rows]
        spread = f" ± {np.std(normalized, ddof=1):.1f}" if len(rows) > 1 else ""
        lines.append(
            f"| {robot} | {method} | {at} | {budget} | {settings} | {len(rows)} | {np.median(returns):.0f} "
            f"({min(returns):.0f} to {max(returns):.0f}) | {np.mean(normalized):.1f}{spread} "
            f"| {np.median([row['seconds'] for row in rows]):.0f} | {commits(rows)} |"
        )
    return "\n".join(lines) + "\n"


def place(row: Mapping[str, Any]) -> str:
    """Where a policy was learnt: at an estimate, with whose it is."""
    return row["at"] if row["calibrator"] is None else f"{row['at']} ({row['calibrator'].partition('-logged')[0]})"


def planted_truths() -> str:
    """What `planted.py` found: a verdict and the estimates of each robot and situation, and how intervals cover."""
    lines = [
        "## Planted truths in robots of one's own\n",
        "`python benchmarks/planted.py`. `madoc calibrate SPEC --data LOGS`, all defaults. Covered: 95 % intervals "
        "that hold the truth; where readings are exact these are as narrow as rounding. Worst: % of its range that a "
        "parameter is off.\n",
        "| robot | situation | verdict | expected | method | covered | worst, % | s | commit |",
        "|---" * 9 + "|",
    ]
    for row in planted.STUDY.rows():
        found = list(row["parameters"].values())
        covered = f"{sum(part['covered'] for part in found)} of {len(found)}" if found[0]["interval"] else "-"
        worst = max(part["percent_of_range"] for part in found)
        cells = (row["robot"], row["situation"], row["verdict"]["word"], row["expected"], row["method"])
        lines.append(f"| {' | '.join(cells)} | {covered} | {worst:.2g} | {row['seconds']:.0f} | {row['commit']} |")
    return "\n".join([*lines, "", planted.covered(planted.COVERAGE.rows())]) + "\n"


def verdicts() -> str:
    """What `adversary.py`, `interval_coverage.py`, `rates.py`, `payload.py` and others found."""
    cases = adversary.STUDY.rows()
    return (
        "## Verdicts and intervals\n\n"
        "`python benchmarks/adversary.py`: problems of seven robots, by the commit of the tool; each problem with "
        "`--table --commit`. Invisible deceptions are those that no data can show; `madoc check` names them.\n\n"
        f"{adversary_table.summary(cases)}\n\n"
        "`python benchmarks/interval_coverage.py`: honest problems, least squares, 95 % intervals.\n\n"
        f"{interval_coverage.table(interval_coverage.STUDY.rows())}\n\n"
        "`python benchmarks/rates.py`: one log of a double pendulum with coarse encoders at three rates, all defaults. "
        "Windows of 0.5 s are simulated from true states; values 5 % off the truth stand for a data sheet's.\n\n"
        f"{rates.table(rates.STUDY.rows())}\n\n"
        "`python benchmarks/payload.py`: an arm of seven joints, driven by torques that arrive 8 ms late, with an "
        "unknown load of 0.5 kg off its axis and unknown dry friction, all defaults.\n\n"
        f"{payload.table(payload.STUDY.rows())}\n\n"
        "`python benchmarks/planted_servo.py`: a hobby servo with supply limit, back-EMF, friction by speed and load, "
        "and backlash, all unknown, at two gains of its firmware; its encoder alone is logged. All defaults.\n\n"
        f"{planted_servo.table(planted_servo.STUDY.rows())}\n\n"
        "`python benchmarks/legged.py`: a quadruped of three position servos a leg that trots for 15 s and logs its "
        "joint encoders and an IMU alone, all defaults and 300 s, judging included.\n\n"
        f"{legged.table(legged.STUDY.rows())}\n\n"
        "`python benchmarks/wrong_friction.py`: arms with friction by speed and load, in a model of Coulomb and "
        "viscous friction alone; predictions over a second of unseen runs, beside those of the best parameters.\n\n"
        f"{wrong_friction.table(wrong_friction.STUDY.rows())}\n"
    )


def sysid() -> str:
    """What `against_sysid.py` found: both tools on every robot and situation."""
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
    for row in SYSID.rows():
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
    (told,) = SINGLE["real_pendulum"].rows()
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


def suites() -> str:
    """What the three benchmarks of suites have shown, each as it was kept."""
    rows = Study(RESULTS / "suite.jsonl", ("what",)).rows()
    lines = [
        "## Suites\n",
        "Workers and suites killed at random (`faults`), ten thousand planned cells (`plan`), two workers beside runs "
        "by hand (`efficiency`), many robots of one kind (`fleet`). Other work shared the machine, so that seconds say "
        "little; bits and counts do not depend on it.\n",
        "| what | command | found | commit |",
        "|---" * 4 + "|",
    ]
    for row in rows:
        found = ", ".join(f"{name} {value:g}" for name, value in row.items() if isinstance(value, int | float))
        lines.append(f"| {row['what']} | `{row['command']}` | {found} | {row['commit']} |")
    return "\n".join(lines) + "\n"


def fuzz() -> str:
    """What `fuzz.py` found."""
    (told,) = SINGLE["fuzz"].rows()
    counts = ", ".join(f"{name} {count:,}" for name, count in told.items() if name.endswith(("read", "refused")))
    return f"## Fuzzing\n\n`python benchmarks/fuzz.py --minutes {told['minutes']:g}`: {counts} ({told['commit']}).\n"


def speed() -> str:
    """What `speed.py` found last."""
    (told,) = SINGLE["speed"].rows()
    lines = [
        f"## Speed\n\n`python benchmarks/speed.py` ({told['commit']}, {told['cores']} cores): updates of a learner at "
        "batch 256 by the width of its networks, in brackets the time as a multiple of that of its matrix products; "
        "and control steps, in brackets the share of the speed of bare `mujoco.rollout`.\n",
        "| | 256 units, a second | 128 units |",
        "|---|---|---|",
    ]
    for name, by_width in told["learner_updates"].items():
        cells = (f"{found['per_second']:.0f} ({found['times_floor']})" for found in by_width.values())
        lines.append(f"| updates of {name} | {' | '.join(cells)} |")
    for robot, found in told["control_steps"].items():
        lines.append(f"| control steps of {robot} | {found['system_step']:,} ({found['ratio']}) | |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
