"""Calibrate problems whose answer is known, made by a simulation of their own, and count what the verdict gets wrong.

    python benchmarks/adversary.py --robots pendulum arm --seeds 0 1
    python benchmarks/adversary.py --only honest --limit 120
    python benchmarks/adversary.py --table

One JSON file for each case and seed; those already there are skipped. The tool runs in a process of its own, with its
defaults, and is the one that Python imports: PYTHONPATH of another checkout measures that checkout.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from adversary_cases import CASES, Case, Problem, write

RESULTS = Path(__file__).parent / "results" / "adversary"
LIMIT = 300.0
"""s, of one command of the tool; it is stopped beyond that, and what its first method said is kept."""
PATIENCE = 5.0
"""s, that a command may still take after its first method's answer, where only that is asked for."""
HARMLESS = 0.005
"""Share of a parameter's range; an interval that misses the truth by less is counted, and marked as a near miss."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--cases", nargs="+", default=[], help="names such as pendulum.friction-0.05, or their beginning"
    )
    parser.add_argument("--robots", nargs="+", default=[], choices=sorted({case.robot.name for case in CASES.values()}))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--only", choices=["deceptions", "honest"])
    parser.add_argument("--limit", type=float, default=LIMIT, help="s, for one command of the tool")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--without-check", action="store_true", help="run `madoc calibrate` alone")
    parser.add_argument(
        "--first-answer", action="store_true", help="stop where the tool goes on to a second, much slower method"
    )
    parser.add_argument("--table", action="store_true", help="print the summary of what is there, and run nothing")
    arguments = parser.parse_args()
    if arguments.table:
        print(table([json.loads(path.read_text()) for path in sorted(arguments.results.glob("*.json"))]))
        return
    arguments.results.mkdir(parents=True, exist_ok=True)
    cells = [
        (case, seed) for seed in arguments.seeds for case in chosen(arguments.cases, arguments.robots, arguments.only)
    ]
    work = partial(
        cell,
        folder=arguments.results,
        commit=measured_commit(),
        limit=arguments.limit,
        check=not arguments.without_check,
        first_answer=arguments.first_answer,
    )
    with ThreadPoolExecutor(arguments.jobs) as pool:
        for line in pool.map(lambda pair: work(*pair), cells):
            if line:
                print(line, flush=True)


def chosen(names: list[str], robots: list[str], only: str | None) -> list[Case]:
    """The cases asked for, in the order in which they are named."""
    cases = list(CASES.values())
    if names:
        keys = dict.fromkeys(key for name in names for key in CASES if begins_with(key, name))
        cases = [CASES[key] for key in keys]
    if robots:
        cases = [case for case in cases if case.robot.name in robots]
    return [case for case in cases if only is None or case.honest == (only == "honest")]


def begins_with(key: str, name: str) -> bool:
    """Whether a case is the named one or, where no case has that name, begins with it."""
    return key == name if name in CASES else key.startswith(name)


def cell(
    case: Case, seed: int, *, folder: Path, commit: str, limit: float, check: bool, first_answer: bool = False
) -> str:
    """Run one case unless its file is there; a line of what came out."""
    path = folder / f"{case.key}-{seed}.json"
    if path.exists():
        return ""
    with tempfile.TemporaryDirectory() as temporary:
        problem = write(case, seed, Path(temporary))
        answer = run(problem, limit=limit, check=check, first_answer=first_answer)
    known = {"case": case.key, "robot": case.robot.name, "kind": case.kind, "seed": seed, "commit": commit}
    known |= {"honest": case.honest, "invisible": case.invisible, "cause": case.cause}
    path.write_text(json.dumps(known | answer, indent=1, ensure_ascii=False) + "\n")
    return f"{case.key} {seed}: {outcome(known | answer)}, {answer['seconds']} s"


def run(problem: Problem, *, limit: float, check: bool, first_answer: bool) -> dict[str, Any]:
    """What the tool says of a problem, beside the truth."""
    out = problem.spec.parent / "out"
    asked = [str(problem.spec), "--data", str(problem.logs), "--json", "--quiet"]
    # Where one method does not explain the log, the tool goes on to a slower one; the first one's answer is kept here.
    first = out / "least-squares" / "result.json"
    enough, started = first if first_answer else None, time.monotonic()
    code, result, error = madoc("calibrate", *asked, "--holdout", "0.2", "--out", str(out), limit=limit, enough=enough)
    seconds = round(time.monotonic() - started, 1)
    if code is None and first.exists():
        result = json.loads(first.read_text())
    verdict = result.get("verdict") or {}
    answer: dict[str, Any] = {
        "exit_code": code,
        "stopped": code is None,
        "verdict": verdict.get("word", "TIME_LIMIT" if code is None else "REFUSED"),
        "sentence": verdict.get("sentence") or error,
        "causes": verdict.get("causes", []),
        "status": result.get("status"),
        "warnings": result.get("warnings", []),
        "missing_terms": (result.get("holdout") or {}).get("missing_terms", []),
        "parameters": {
            name: compared(result.get("parameters", {}).get(name, {}), truth) for name, truth in problem.truth.items()
        },
        "control_steps": result.get("control_steps"),
        "seconds": seconds,
        "check": None,
    }
    if check:
        code, result, error = madoc("check", *asked, "--no-forecast", limit=limit)
        findings = [" ".join(map(str, finding.values())) for finding in result.get("findings", [])]
        answer["check"] = findings or [error] * bool(error)
    return answer


def madoc(*words: str, limit: float, enough: Path | None = None) -> tuple[int | None, dict[str, Any], str]:
    """Exit code (None if stopped), the JSON object that was printed, and the last line of standard error.

    The command is stopped beyond the limit, or `PATIENCE` after there is a verdict in the file `enough`.
    """
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen([sys.executable, "-m", "madoc", *words], stdout=output, stderr=errors)
        end = time.monotonic() + limit
        while process.poll() is None and time.monotonic() < end:
            if enough and enough.exists() and '"verdict"' in enough.read_text():
                end, enough = min(end, time.monotonic() + PATIENCE), None
            time.sleep(0.2)
        if process.poll() is None:
            process.kill()
            process.wait()
            return None, {}, "stopped"
        output.seek(0)
        errors.seek(0)
        text, complaint = output.read(), errors.read()
    try:
        printed = json.loads(text)
    except json.JSONDecodeError:
        printed = {}
    return process.returncode, printed, printed.get("error") or complaint.strip().rpartition("\n")[2]


def compared(row: dict[str, Any], truth: tuple[float, float]) -> dict[str, Any]:
    """An estimate beside the truth; `miss` is how far the interval is from holding it, as a share of the range."""
    interval, miss = row.get("interval"), None
    if interval:
        low, high = interval
        miss = max(low - truth[0], truth[1] - high, 0.0) / (row["high"] - row["low"])
    return {"truth": truth, "estimate": row.get("estimate"), "interval": interval, "miss": miss}


def measured_commit() -> str:
    """The commit of the checkout that Python imports the tool from; `+` marks changes to its tracked files."""
    place = subprocess.run(
        [sys.executable, "-c", "import madoc; print(*madoc.__path__)"], capture_output=True, text=True, check=True
    ).stdout.strip()

    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", place, *words], capture_output=True, text=True, check=True).stdout.strip()

    return git("rev-parse", "--short", "HEAD") + "+" * bool(git("status", "--porcelain", "-uno", "--", "."))


def misses(result: dict[str, Any]) -> list[str]:
    """Parameters whose interval does not hold the truth."""
    return [name for name, row in result["parameters"].items() if row["miss"]]


def outcome(result: dict[str, Any]) -> str:
    """`false CALIBRATED`, `false alarm`, `unnamed` (invisible and not named), or what was said rightly."""
    word = result["verdict"]
    if result["verdict"] == "TIME_LIMIT":
        return word
    if result["invisible"]:
        return f"{word}, named" if named(result, everything=True) else "unnamed"
    if result["honest"]:
        return word if word == "CALIBRATED" else f"false alarm ({word})"
    return "false CALIBRATED" if word == "CALIBRATED" and misses(result) else word


def named(result: dict[str, Any], *, everything: bool = False) -> bool:
    """Whether the verdict's sentence (or everything that is said, warnings and `check` too) names the cause."""
    said = [result["sentence"], *map(str, result["causes"])]
    if everything:
        said += [*result["warnings"], *(result["check"] or [])]
    text = " ".join(said).lower()
    for name in sorted(result["parameters"], key=len, reverse=True):
        text = re.sub(rf"\b{re.escape(name)}\b", "", text)
    return re.search(result["cause"], text) is not None


def summary(results: list[dict[str, Any]]) -> str:
    """What went wrong how often, in Markdown."""
    deceptions = [result for result in results if not result["honest"] and not result["invisible"]]
    invisible = [result for result in results if result["invisible"]]
    honest = [result for result in results if result["honest"]]
    false = [result for result in deceptions if outcome(result) == "false CALIBRATED"]
    alarms = [result for result in honest if outcome(result) != "CALIBRATED"]
    near = [result for result in false if largest_miss(result) < HARMLESS]
    lines = [
        "| what | count | of |",
        "|---|---|---|",
        f"| false CALIBRATED | {len(false)} | {len(deceptions)} |",
        f"| of these by less than {100 * HARMLESS:g} % of the range | {len(near)} | {len(false)} |",
        f"| cause named in the verdict's sentence | {sum(map(named, deceptions))} | {len(deceptions)} |",
        f"| invisible, and not named anywhere | {count(invisible, 'unnamed')} | {len(invisible)} |",
        f"| false alarms | {len(alarms)} | {len(honest)} |",
        f"| stopped in a second method or at the limit | {sum(r['stopped'] for r in results)} | {len(results)} |",
        f"| refusals of deceptions | {refusals(deceptions)} | {len(deceptions)} |",
        f"| refusals of honest cases | {refusals(honest)} | {len(honest)} |",
        f"| intervals that hold, honest cases | {coverage(honest)} |",
        f"| seconds, median and largest | {seconds(results)} |",
    ]
    return "\n".join(lines)


def table(results: list[dict[str, Any]]) -> str:
    """The summary, and every case, in Markdown."""
    deceptions = [result for result in results if not result["honest"] and not result["invisible"]]
    invisible = [result for result in results if result["invisible"]]
    honest = [result for result in results if result["honest"]]
    lines = [
        f"Commits: {', '.join(sorted({result['commit'] for result in results}))}",
        "",
        summary(results),
        "",
        "| deception | seeds | verdicts | false CALIBRATED | largest miss, share of range | cause named | anywhere |",
        "|---|---|---|---|---|---|---|",
    ]
    for case, group in grouped([*deceptions, *invisible], "case").items():
        lines.append(
            f"| {case} | {len(group)} | {words(group)} | {count(group, 'false CALIBRATED')} "
            f"| {max(map(largest_miss, group)):.3f} | {sum(map(named, group))} "
            f"| {sum(named(result, everything=True) for result in group)} |"
        )
    lines += ["", "| kind of deception | cases | false CALIBRATED |", "|---|---|---|"]
    lines += [f"| {k} | {len(v)} | {count(v, 'false CALIBRATED')} |" for k, v in grouped(deceptions, "kind").items()]
    lines += ["", "| honest | seeds | verdicts | intervals that hold, of |", "|---|---|---|---|"]
    for case, group in grouped(honest, "case").items():
        lines.append(f"| {case} | {len(group)} | {words(group)} | {coverage(group).replace(' | ', ', ')} |")
    return "\n".join(lines)


def grouped(results: Iterable[dict[str, Any]], key: str) -> dict[str, list[dict[str, Any]]]:
    """Results by what a key of theirs holds."""
    groups = defaultdict(list)
    for result in results:
        groups[result[key]].append(result)
    return dict(groups)


def count(results: Iterable[dict[str, Any]], what: str) -> int:
    """How many have an outcome."""
    return sum(outcome(result) == what for result in results)


def refusals(results: Iterable[dict[str, Any]]) -> int:
    """How many the tool refused to calibrate."""
    return sum(result["verdict"] == "REFUSED" for result in results)


def largest_miss(result: dict[str, Any]) -> float:
    """The largest miss of a result's intervals, as a share of the range."""
    return max((row["miss"] or 0.0 for row in result["parameters"].values()), default=0.0)


def coverage(results: Iterable[dict[str, Any]]) -> str:
    """Intervals that hold the truth, and all intervals."""
    missed = [row["miss"] for result in results for row in result["parameters"].values() if row["miss"] is not None]
    return f"{sum(miss == 0.0 for miss in missed)} | {len(missed)}"


def seconds(results: list[dict[str, Any]]) -> str:
    """Median and largest wall time of a calibration."""
    every = [result["seconds"] for result in results]
    return f"{median(every):.0f} | {max(every):.0f}" if every else "- | -"


def words(results: Iterable[dict[str, Any]]) -> str:
    """The verdicts of several seeds; a `…` marks those of a first method, where a second was stopped."""
    return ", ".join(sorted({result["verdict"] + " …" * result["stopped"] for result in results}))


if __name__ == "__main__":
    main()
