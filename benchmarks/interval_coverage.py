"""How often 95 % intervals hold the truth: problems of the adversary whose model is right, in many seeds each.

    python benchmarks/interval_coverage.py --conditions process-little --seeds 0 100 --results runs/coverage
    python benchmarks/interval_coverage.py --table

A row of results/coverage.jsonl for each problem; those already there are skipped. Least squares calibrates in this
process, as `madoc calibrate --method least-squares --holdout 0.2` does, and the intervals are those that it tells.
"""

import argparse
import contextlib
import io
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from adversary import compared
from adversary_cases import CASES, write
from kept import RESULTS, Study, commit, commits
from scipy.stats import binomtest

from madoc.commands.main import main as madoc

STUDY = Study(RESULTS / "coverage.jsonl", ("condition", "seed"))
CONDITIONS = {
    "process-little": ("pendulum.process-little", "cart.process-little"),
    "process-much": ("pendulum.process-much", "cart.process-much"),
    "closed-loop": ("pendulum.closed-loop", "cart.closed-loop"),
    "positions": ("pendulum.positions", "cart.positions"),
    "contacts": ("ball.plain", "leg.plain"),
}
"""The cases of each condition, which take turns from seed to seed."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), choices=list(CONDITIONS))
    parser.add_argument("--seeds", nargs=2, type=int, default=(0, 100), help="the first, and the one after the last")
    parser.add_argument("--results", type=Path, default=STUDY.file)
    parser.add_argument("--anew", action="store_true", help="run problems again whose row is of another commit")
    parser.add_argument("--table", action="store_true", help="print the summary of what is there, and run nothing")
    arguments = parser.parse_args()
    study, revision = replace(STUDY, file=arguments.results), commit()
    for seed in range(*arguments.seeds) if not arguments.table else ():
        for condition in arguments.conditions:
            asked = {"condition": condition, "seed": seed, "commit": revision}
            with study.claimed(asked, revision if arguments.anew else None) as ours:
                if ours:
                    study.add(asked | solve(CONDITIONS[condition], seed))
    print(table(study.rows()))


def solve(cases: Sequence[str], seed: int) -> dict:
    """What comes out of one problem."""
    case, started = CASES[cases[seed % len(cases)]], time.monotonic()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()) as told:
        problem = write(case, seed, Path(folder))
        words = ["calibrate", str(problem.spec), "--data", str(problem.logs), "--method", "least-squares"]
        madoc([*words, "--holdout", "0.2", "--json", "--quiet", "--out", str(Path(folder) / "out")])
    result = json.loads(told.getvalue())
    return {
        "case": case.key,
        "seconds": round(time.monotonic() - started, 1),
        "verdict": (result.get("verdict") or {}).get("word", "REFUSED"),
        "widened": any("95 % intervals are wider than" in warning for warning in result.get("warnings", [])),
        "parameters": {
            name: compared(result.get("parameters", {}).get(name, {}), truth) for name, truth in problem.truth.items()
        },
    }


def table(results: Sequence[dict]) -> str:
    """Coverage by condition, with its own 95 % interval, as Markdown."""
    lines = [
        "| condition | problems | intervals | hold the truth | 95 % interval | CALIBRATED | widened | commits |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for condition in CONDITIONS:
        rows = [row for row in results if row["condition"] == condition]
        misses = [one["miss"] for row in rows for one in row["parameters"].values() if one["miss"] is not None]
        if not misses:
            lines.append(f"| {condition} | not run |  |  |  |  |  |  |")
            continue
        held = sum(miss == 0.0 for miss in misses)
        low, high = binomtest(held, len(misses)).proportion_ci(method="wilson")
        lines.append(
            f"| {condition} | {len(rows)} | {len(misses)} | {100 * held / len(misses):.1f} % "
            f"| {100 * low:.1f} to {100 * high:.1f} % | {sum(row['verdict'] == 'CALIBRATED' for row in rows)} "
            f"| {sum(row['widened'] for row in rows)} | {commits(rows)} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
