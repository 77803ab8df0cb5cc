"""Fingerprints of every method's result with fixed seeds, to hold one commit against another bit by bit.

    python benchmarks/bits.py
    PYTHONPATH=../before/src python benchmarks/bits.py     # the code of another checkout
    python benchmarks/bits.py --compare 22cb0ce bcde2ba

Everything goes through the command line, whose options are the same on both commits. A cell that has a row of the
commit in results/bits.jsonl is not run again. Estimates are compared with all their digits, policies weight by weight;
seconds are not compared.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from kept import RESULTS, Study, commit

STUDY = Study(RESULTS / "bits.jsonl", ("cell", "commit"))
MADOC = [sys.executable, "-m", "madoc"]
EXAMPLES = Path(__file__).parent.parent / "examples"
ROWS = 4000
SMALL = ["--set", "cloning_epochs=5", "grouping_epochs=2"]
SMALL_NETWORKS = ["--set", "hidden=[32, 32]"]

RECORDED = {
    "clean": [],
    "noisy": ["--noise", "0.1"],
    "hidden": ["--hide-velocities"],
    "shuffled": ["--shuffle", "next_observations"],
}
"""Options of `madoc record hopper-medium`, by the name of the data."""

CALIBRATIONS = {
    **{
        f"{method} clean": ("clean", method, 15_000, SMALL)
        for method in ("madoc", "madoc-s", "madoc-vdn", "madoc-isac", "madoc-grouped")
    },
    "madoc-paper clean": ("clean", "madoc-paper", 8_000, ["--set", "grouping_epochs=2", "cloning_epochs=2"]),
    "madoc hidden": ("hidden", "madoc", 15_000, SMALL),
    "madoc noisy": ("noisy", "madoc", 15_000, SMALL),
    "npe shuffled": ("shuffled", "npe", 20_000, ["--set", "cloning_epochs=5"]),
    **{
        f"{method} {data}": (data, method, 150_000, [])
        for method, data in (
            ("least-squares", "clean"),
            ("least-squares", "noisy"),
            ("least-squares", "hidden"),
            ("dropo", "clean"),
            ("e-dropo", "clean"),
            ("droid", "clean"),
            ("cma-es", "clean"),
            ("cma-es-distribution", "clean"),
            ("nominal", "clean"),
            ("uniform", "clean"),
        )
    },
    "least-squares horizon 5": ("clean", "least-squares", 150_000, ["--set", "horizon=5", "loss=huber"]),
    "oted clean": ("clean", "oted", 30_000, []),
    "oted policy": ("clean", "oted", 30_000, ["--set", "starts=policy"]),
    "least-squares arm": ("arm", "least-squares", 600_000, ["--holdout", "0.2"]),
    "auto arm": ("arm", "auto", 600_000, []),
    "least-squares spring": ("spring", "least-squares", 300_000, ["--holdout", "0.2"]),
}
"""By the name of the cell: the data, the method, its budget, and more options."""

POLICIES = {
    **dict.fromkeys(
        ("sac", "sac-bc", "dr-bc"), (4_000, [*SMALL_NETWORKS, "warmup_steps=1000", "updates_per_step=0.2"])
    ),
    "h2o": (4_000, [*SMALL_NETWORKS, "warmup_steps=1000", "updates_per_step=0.1"]),
    "bc": (2_000, SMALL_NETWORKS),
    "cql": (2_000, [*SMALL_NETWORKS, "critic_hidden=[32, 32]"]),
    "morec": (
        2_000,
        [
            *(*SMALL_NETWORKS, "model_hidden=[32, 32]", "model_updates=200", "judge_every=1000"),
            *("discriminators=4", "discriminator_every=100", "discriminator_updates=400"),
        ],
    ),
}
"""By learner: its budget, and more options."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--compare", nargs=2, metavar=("BEFORE", "AFTER"), help="commits; runs nothing")
    parser.add_argument("--only", nargs="+", default=[], help="cells whose name has one of these words")
    parser.add_argument("--folder", type=Path, help="keep data and run folders here instead of a temporary folder")
    arguments = parser.parse_args()
    if arguments.compare:
        sys.exit(compare(*map(digests, arguments.compare)))
    with tempfile.TemporaryDirectory() as temporary:
        run(arguments.folder or Path(temporary), arguments.only)


def run(folder: Path, only: list[str]) -> None:
    """Run every cell that has no row of this commit; where sources have changed since, every cell."""
    revision = commit()
    done = {} if revision.endswith("+") else digests(revision)
    cells = {
        **{f"calibrate: {name}": calibration for name in CALIBRATIONS},
        **{f"learn: {name}": policy for name in POLICIES},
    }
    for cell, fingerprint in cells.items():
        if cell in done or not any(word in cell for word in only or [""]):
            continue
        found = fingerprint(cell.split(": ")[1], folder)
        print(cell, found, flush=True)
        STUDY.add({"cell": cell, "commit": revision, "digest": found})


def digests(revision: str) -> dict[str, str]:
    """What was found at a commit, by cell."""
    return {row["cell"]: row["digest"] for row in STUDY.rows() if row["commit"] == revision}


def calibration(name: str, folder: Path) -> str:
    """The fingerprint of an estimate with its spread, intervals, groups, status and cost."""
    data, method, budget, options = CALIBRATIONS[name]
    result = calibrated(folder / name.replace(" ", "-"), data, method, budget, options)
    rows = result["parameters"].values()
    kept = [[row["estimate"], row["std"], row.get("interval")] for row in rows]
    kept += [result.get("covariance"), result["groups"], result["status"], result["control_steps"]]
    return digest(json.dumps(kept).encode())


def policy(name: str, folder: Path) -> str:
    """The fingerprint of a policy's weights."""
    budget, options = POLICIES[name]
    run = folder / "nominal"
    calibrated(run, "clean", "nominal", 1, [])
    out = folder / f"policy-{name}"
    madoc("learn", str(run), "--method", name, "--budget", str(budget), "--out", str(out), "--quiet", *options)
    with np.load(out / "policy.npz") as arrays:
        return digest(*(key.encode() + arrays[key].tobytes() for key in sorted(arrays)))


def calibrated(out: Path, data: str, method: str, budget: int, options: list[str]) -> dict:
    """The result of a calibration."""
    if not (out / "result.json").exists():
        robot, log = recorded(out.parent, data)
        asked = ["--method", method, "--budget", str(budget), "--out", str(out), "--quiet", *options]
        madoc("calibrate", robot, "--data", str(log), *asked)
    return json.loads((out / "result.json").read_text())


def recorded(folder: Path, data: str) -> tuple[str, Path]:
    """The robot, and a log of it."""
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"data-{data}"
    if data in RECORDED:
        if not log.with_suffix(".npz").exists():
            size = ["--transitions", str(ROWS), "--out", str(log.with_suffix(".npz")), "--quiet"]
            madoc("record", "hopper-medium", *size, *RECORDED[data])
        return "hopper", log.with_suffix(".npz")
    spec = EXAMPLES / data / f"{data}.yaml"
    if not log.exists():
        truth, script = EXAMPLES / data / "truth.json", EXAMPLES / "record_logs.py"
        subprocess.run([sys.executable, script, spec, truth, log], check=True, stdout=subprocess.DEVNULL)
    return str(spec), log


def madoc(*words: str) -> None:
    """The command line; a verdict's exit code is no failure."""
    answer = subprocess.run([*MADOC, *words], capture_output=True, text=True, check=False)
    if answer.returncode not in (0, 10, 11, 12, 13):
        raise SystemExit(f"madoc {' '.join(words)}: {answer.stderr[-2000:]}")


def digest(*parts: bytes) -> str:
    """Sixteen digits of SHA-256."""
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


def compare(before: dict[str, str], after: dict[str, str]) -> int:
    """Print a row a cell; the number of cells that differ."""
    different = 0
    for cell in sorted({*before, *after}):
        first, second = (run.get(cell, "not run") for run in (before, after))
        different += first != second
        print(f"| {cell} | {first} | {second} | {'equal' if first == second else 'DIFFERS'} |")
    print(f"{different} of {len({*before, *after})} differ")
    return different


if __name__ == "__main__":
    main()
