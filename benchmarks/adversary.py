"""Calibrate problems whose answer is known, made by a simulation of their own, and count what the verdict gets wrong.

    python benchmarks/adversary.py --robots pendulum arm --seeds 0 1
    python benchmarks/adversary.py --only honest --limit 120
    python benchmarks/adversary.py --table                  # of the commit with the most problems; or --commit

A row of results/adversary.jsonl for each case and seed; those already there are skipped. The tool runs in a process of
its own, with its defaults, and is the one that Python imports: PYTHONPATH of another checkout measures that checkout.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from adversary_cases import CASES, Case, Problem, write
from adversary_table import outcome, table
from kept import RESULTS, Study, commit

STUDY = Study(RESULTS / "adversary.jsonl", ("case", "seed"))
LIMIT = 300.0
"""s, of one command of the tool; it is stopped beyond that, and what its first method said is kept."""
PATIENCE = 5.0
"""s, that a command may still take after its first method's answer, where only that is asked for."""


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
    parser.add_argument("--results", type=Path, default=STUDY.file)
    parser.add_argument("--anew", action="store_true", help="run cases again whose row is of another commit")
    parser.add_argument("--commit", help="whose problems the table shows; default: the one that has most of them")
    parser.add_argument("--without-check", action="store_true", help="run `madoc calibrate` alone")
    parser.add_argument(
        "--first-answer", action="store_true", help="stop where the tool goes on to a second, much slower method"
    )
    parser.add_argument("--table", action="store_true", help="print the summary of what is there, and run nothing")
    arguments = parser.parse_args()
    study = replace(STUDY, file=arguments.results)
    if arguments.table:
        rows = study.rows()
        shown = arguments.commit or Counter(row["commit"] for row in rows).most_common(1)[0][0]
        print(table([row for row in rows if row["commit"] == shown]))
        return
    cells = [
        (case, seed) for seed in arguments.seeds for case in chosen(arguments.cases, arguments.robots, arguments.only)
    ]
    work = partial(
        cell,
        study=study,
        revision=commit(),
        anew=arguments.anew,
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
    case: Case,
    seed: int,
    *,
    study: Study,
    revision: str,
    limit: float,
    check: bool,
    anew: bool = False,
    first_answer: bool = False,
) -> str:
    """Run one case unless its row is there; a line of what came out."""
    known = {"case": case.key, "robot": case.robot.name, "kind": case.kind, "seed": seed, "commit": revision}
    known |= {"honest": case.honest, "invisible": case.invisible, "cause": case.cause}
    with study.claimed(known, revision if anew else None) as ours, tempfile.TemporaryDirectory() as temporary:
        if not ours:
            return ""
        problem = write(case, seed, Path(temporary))
        answer = run(problem, limit=limit, check=check, first_answer=first_answer)
        study.add(known | answer)
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


def solved(spec: Path, logs: Path, truth: dict[str, float], *words: str, limit: float) -> dict[str, Any]:
    """What `madoc calibrate` makes of planted logs: verdict, seconds, and every estimate beside its truth."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        given = ["calibrate", str(spec), "--data", str(logs), "--out", str(Path(folder) / "out"), "--json", "--quiet"]
        _, result, complaint = madoc(*given, *words, limit=limit)
    after, seconds = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - started
    verdict, found = result.get("verdict") or {}, result.get("parameters", {})
    return {
        "commit": commit(),
        "verdict": verdict.get("word", complaint),
        "sentence": verdict.get("sentence"),
        "seconds": round(seconds, 1),
        "processor_seconds": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        "parameters": {name: compared(found.get(name, {}), (value, value)) for name, value in truth.items()},
    }


if __name__ == "__main__":
    main()
