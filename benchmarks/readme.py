"""The measured tables of the README, made from committed results, between marks that name them."""

import json
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import paper
from scipy import stats

README = Path(__file__).parents[1] / "README.md"
FEWEST_PAIRS = 6
"""Smallest number of pairs of runs that are compared."""
STUDY = Path(__file__).parent / "results" / "groups"
"""Results of `benchmarks/groups.py`."""
NAMES = {"hopper": "Hopper", "halfcheetah": "HalfCheetah", "walker2d": "Walker2d", "ant": "Ant"}
COLUMNS = {"madoc": "one agent a parameter", "madoc-grouped": "one a group", "madoc-s": "one for all"}
"""Variants of Madoc by who its agents are."""
STUDIED = {
    "one": "one agent",
    "physics": "groups by physics",
    "random": "random groups",
    "learned": "groups by the VAE",
    "each": "one agent a parameter",
    "each-dop": "the same, credit by DOP",
}
"""Who the agents of `benchmarks/groups.py` are, in the order of the columns."""
PLACES = ("calibrated", "truth", "midrange")
"""Parameters at which policies are learnt, in the order of the columns."""
_MARKED = re.compile(r"(<!-- measured: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def rewritten(text: str, policies: Sequence[dict]) -> str:
    """The README with its marked tables made anew.

    Args:
        text: The README.
        policies: Every policy that was learnt and evaluated.

    Raises:
        KeyError: A mark names no table.
    """
    tables: dict[str, Callable[[], str]] = {
        "errors": errors,
        "minutes": lambda: minutes(policies),
        "returns": lambda: returns(policies),
        "tasks": tasks,
    }
    return _MARKED.sub(lambda found: found[1] + tables[found[2]]() + found[3], text)


def errors() -> str:
    """Madoc's error on medium data by who its agents are, beside the printed ones, and whether groups pay."""
    found = paper.by_seed("groups")
    names = " | ".join(f"{told} (`{name}`)" for name, told in COLUMNS.items())
    lines = [
        f"| robot | {names} | paper, groups | one for all |",
        "|---" * (len(COLUMNS) + 3) + "|",
    ]
    for robot, name in NAMES.items():
        task = f"{robot}-medium"
        ours = " | ".join(_mean(list(found[task, column].values())) for column in COLUMNS)
        theirs = [paper.printed("table-10", task, column) for column in ("madoc", "madoc-s")]
        lines.append(f"| {name} | {ours} | {' | '.join(f'{each[0]:.2f}' for each in theirs if each)} |")
    return "\n".join(lines) + "\n" + _comparison(found)


def _comparison(found: Mapping[tuple[str, str], Mapping[int, float]]) -> str:
    """Who errs less over pairs of runs with the same log and seed, on all robots and on each."""
    lines = []
    for first, second in combinations(COLUMNS, 2):
        of_robots = {
            name: [
                (error, beside[seed])
                for seed, error in found[f"{robot}-medium", first].items()
                if seed in (beside := found[f"{robot}-medium", second])
            ]
            for robot, name in NAMES.items()
        }
        pairs = [pair for each in of_robots.values() for pair in each]
        if len(pairs) >= FEWEST_PAIRS:
            less = sum(ours < theirs for ours, theirs in pairs)
            means = " | ".join(f"{_mean_ratio(each):.2g}" if each else "" for each in of_robots.values())
            lines.append(f"| `{first}` against `{second}` | {len(pairs)} | {less} | {ratio(pairs)} | {means} |")
    names = " | ".join(NAMES.values())
    header = f"| pairs of runs with the same log and seed | pairs | err less | ratio of errors (95 %) | {names} |"
    return "\n".join(["", header, "|---" * (4 + len(NAMES)) + "|", *lines, ""]) if lines else ""


def _mean_ratio(pairs: Sequence[tuple[float, float]]) -> float:
    """Geometric mean of the ratio of the first error of each pair to the second."""
    return float(stats.gmean([ours / theirs for ours, theirs in pairs]))


def ratio(pairs: Sequence[tuple[float, float]]) -> str:
    """Geometric mean of the ratio of the first error of each pair to the second, and its 95 % interval."""
    logs = np.log([ours / theirs for ours, theirs in pairs])
    low, high = np.exp(stats.ttest_1samp(logs, 0.0).confidence_interval())
    return f"{_mean_ratio(pairs):.2f} ({low:.2f} to {high:.2f})"


def study() -> str:
    """Error of `benchmarks/groups.py` by parameters, draws an epoch and agents, beside that of an agent a parameter."""
    cells = defaultdict[tuple[int, int], defaultdict[str, dict[int, dict]]](lambda: defaultdict(dict))
    for path in STUDY.glob("*.json"):
        row = json.loads(path.read_text())
        cells[row["parameters"], row["draws"]][row["groups"]][row["seed"]] = row
    if not cells:
        return ""
    used = [name for name in STUDIED if any(name in rows for rows in cells.values())]
    lines = [
        "\n`python benchmarks/groups.py`: an Ant with planted parameters of our own. Mean error in % of the range, "
        "mean over seeds, each of them another truth. Of three seeds and more, its ratio to that of an agent for each "
        "parameter with the same truth: geometric mean and 95 % interval.\n",
        f"| parameters | draws an epoch | {' | '.join(STUDIED[name] for name in used)} |",
        "|---" * (len(used) + 2) + "|",
    ]
    for (count, draws), rows in sorted(cells.items()):
        lines.append(f"| {count} | {draws} | " + " | ".join(_studied(rows, name) for name in used) + " |")
    fewest = min(draws for _, draws in cells)
    lines += [
        f"\nThe same runs as ratios to one agent, and to {fewest} draws an epoch, with the same truth.\n",
        f"| parameters | draws an epoch | {STUDIED['physics']} to one agent | {STUDIED['each']} to one agent | "
        + " | ".join(f"{STUDIED[name]} to {fewest} draws" for name in ("one", "physics", "each"))
        + " |",
        "|---" * 7 + "|",
    ]
    for (count, draws), rows in sorted(cells.items()):
        compared = [(rows.get(name, {}), rows.get("one", {})) for name in ("physics", "each")]
        before = cells[count, fewest] if draws > fewest else {}
        compared += [(rows.get(name, {}), before.get(name, {})) for name in ("one", "physics", "each")]
        found = [_ratio_of(*pair) for pair in compared]
        if any(found):
            lines.append(f"| {count} | {draws} | {' | '.join(found)} |")
    return "\n".join(lines) + "\n"


def _ratio_of(rows: Mapping[int, dict], others: Mapping[int, dict]) -> str:
    """The ratio of errors of runs with the same seed and its interval; empty of fewer than three pairs."""
    pairs = [(rows[seed]["error"], others[seed]["error"]) for seed in rows if seed in others]
    return ratio(pairs) if len(pairs) > 2 else ""


def _studied(rows: Mapping[str, Mapping[int, dict]], name: str) -> str:
    if not (runs := rows.get(name)):
        return "not run"
    beside = _ratio_of(runs, rows.get("each", {})) if name != "each" else ""
    compared = f": {beside}" if beside else ""
    seeds = f"{len(runs)} seed{'s' * (len(runs) > 1)}"
    return f"{np.mean([row['error'] for row in runs.values()]):.2f} ({seeds}){compared}"


def _mean(errors: Sequence[float]) -> str:
    """Mean, to two digits, and number of seeds; nothing of none."""
    return f"{np.mean(errors):.2g} ({len(errors)} seed{'s' * (len(errors) > 1)})" if errors else "not run"


def minutes(rows: Sequence[dict]) -> str:
    """Median return of the default learner after the longest wall time it was given, by where it learnt."""
    cells = defaultdict[tuple[str, str], defaultdict[float, list[float]]](lambda: defaultdict(list))
    for row in rows:
        if (row["method"], row["set"]) == ("fast-sac", []):
            cells[row["robot"], row["at"]][float(row["budget"].removesuffix("s"))].append(row["return"])
    lines = [
        "| robot | wall time | learnt at the calibrated parameters | at the truth | at mid-range |",
        "|---|---|---|---|---|",
    ]
    for robot, name in NAMES.items():
        longest = max(cells[robot, "calibrated"])
        ours = " | ".join(_earned(cells[robot, place][longest]) for place in PLACES)
        lines.append(f"| {name} | {longest:.0f} s | {ours} |")
    return "\n".join(lines) + "\n"


def returns(rows: Sequence[dict]) -> str:
    """Median return of SAC with 300 000 control steps, by the parameters it learnt at."""
    cells = defaultdict[tuple[str, str], list[float]](list)
    for row in rows:
        if (row["method"], row["budget"]) == ("sac", 300_000):
            cells[row["robot"], row["at"]].append(row["return"])
    lines = ["| robot | learnt at the calibrated parameters | at the truth | at mid-range |", "|---|---|---|---|"]
    for robot in ("hopper", "halfcheetah"):
        ours = " | ".join(_earned(cells[robot, place]) for place in PLACES)
        lines.append(f"| {NAMES[robot]} | {ours} |")
    return "\n".join(lines) + "\n"


def tasks() -> str:
    """Madoc's error on the paper's 21 tasks beside the printed one, as far as its cells were run."""
    rows = paper.beside_printed("madoc")
    ours, theirs = (np.mean([row[index] for row in rows]) for index in (1, 2))
    above = [row[0] for row in rows if row[1] > row[2]]
    counts = sorted({row[3] for row in rows})
    seeds = f"{counts[0]} to {counts[-1]} seeds" if counts[1:] else f"{counts[0]} seed{'s' * (counts[0] > 1)}"
    within = f"{len(rows) - len(above)}, all but {' and '.join(above)}" if above else "each of them"
    return (
        f"On {len(rows)} of the paper's 21 tasks, {seeds} each, `madoc` errs by {ours:.2g} on "
        f"average where the paper prints {theirs:.2f},\nand by no more than printed in {within}. It learns from "
        "300 000 control steps.\n"
    )


def _earned(returns: Sequence[float]) -> str:
    """Median and range; of a single seed, its return."""
    if len(returns) == 1:
        return f"{returns[0]:.0f} (one seed)"
    return f"{np.median(returns):.0f} ({min(returns):.0f} to {max(returns):.0f})"
