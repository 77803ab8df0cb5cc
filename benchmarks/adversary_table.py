"""What the adversary's problems came to: outcomes, counted by commit and never over several, and every case."""

import re
from collections import defaultdict
from collections.abc import Iterable
from statistics import median
from typing import Any

HARMLESS = 0.005
"""Share of a parameter's range; an interval that misses the truth by less is counted, and marked as a near miss."""
ENOUGH = 20
"""Fewest problems of a commit that has a line of its own in the summary of all."""


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


def summary(results: list[dict[str, Any]], *, fewest: int = ENOUGH) -> str:
    """What went wrong how often, a line for each commit that has enough problems, as Markdown; none are pooled."""
    lines = [
        "| commit | seeds | deceptions | false CALIBRATED | of these by less than "
        f"{100 * HARMLESS:g} % of the range | cause named | refused | invisible, not named anywhere | honest "
        "| false alarms | refused | intervals that hold | stopped | seconds, median and largest |",
        "|---" * 14 + "|",
    ]
    by_commit = grouped(results, "commit")
    lines += [_of_commit(name, rows) for name, rows in by_commit.items() if len(rows) >= fewest]
    others = [rows for rows in by_commit.values() if len(rows) < fewest]
    if others:
        lines.append(f"\nNot shown: {sum(map(len, others))} problems at {len(others)} commits with few of them.")
    return "\n".join(lines)


def _of_commit(name: str, rows: list[dict[str, Any]]) -> str:
    deceptions, invisible, honest = split(rows)
    false = [row for row in deceptions if outcome(row) == "false CALIBRATED"]
    cells = [
        *(name, len({row["seed"] for row in rows}), len(deceptions), len(false)),
        sum(largest_miss(row) < HARMLESS for row in false),
        *(sum(map(named, deceptions)), refusals(deceptions)),
        f"{count(invisible, 'unnamed')} of {len(invisible)}",
        *(len(honest), sum(outcome(row) != "CALIBRATED" for row in honest), refusals(honest)),
        *(coverage(honest), sum(row["stopped"] for row in rows), seconds(rows)),
    ]
    return f"| {' | '.join(map(str, cells))} |"


def split(results: Iterable[dict[str, Any]]) -> tuple[list[dict], list[dict], list[dict]]:
    """Deceptions that data can show, those that it cannot, and honest problems."""
    parts: tuple[list[dict], list[dict], list[dict]] = ([], [], [])
    for result in results:
        parts[2 if result["honest"] else 1 if result["invisible"] else 0].append(result)
    return parts


def table(results: list[dict[str, Any]]) -> str:
    """The summary, and every case, in Markdown.

    Raises:
        ValueError: The problems are of several commits.
    """
    if len(commits := {result["commit"] for result in results}) > 1:
        raise ValueError(f"expected problems of one commit, got those of {', '.join(sorted(commits))}")
    deceptions, invisible, honest = split(results)
    lines = [
        summary(results, fewest=1),
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
    lines += ["", "| honest | seeds | verdicts | intervals that hold |", "|---|---|---|---|"]
    lines += [
        f"| {case} | {len(rows)} | {words(rows)} | {coverage(rows)} |" for case, rows in grouped(honest, "case").items()
    ]
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
    """How many intervals hold the truth, of how many."""
    missed = [row["miss"] for result in results for row in result["parameters"].values() if row["miss"] is not None]
    return f"{sum(miss == 0.0 for miss in missed)} of {len(missed)}"


def seconds(results: list[dict[str, Any]]) -> str:
    """Median and largest wall time of a calibration."""
    every = [result["seconds"] for result in results]
    return f"{median(every):.0f}, {max(every):.0f}" if every else ""


def words(results: Iterable[dict[str, Any]]) -> str:
    """The verdicts of several seeds; a `…` marks those of a first method, where a second was stopped."""
    return ", ".join(sorted({result["verdict"] + " …" * result["stopped"] for result in results}))
