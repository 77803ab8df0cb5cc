"""What the tables should hold and do not, each with the command that runs it."""

from itertools import product

from disturbances import DISTURBED
from kept import RESULTS, calibrations, is_time, learnt

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
CALIBRATORS = ("dropo", "e-dropo", "droid", "oted", "cma-es", "cma-es-distribution", "least-squares", "nominal")
"""Besides Madoc, with the paper's budget."""


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
