"""Spoilt spec files and CSV logs for as long as asked: each must be read, or refused with one sentence.

    python benchmarks/fuzz.py --minutes 10

A good file is cut, doubled, spliced, and sprinkled with what is known to hurt. What is neither read nor refused is
left in `--keep`, and ends the run with exit code 1. Leaves a row of `results/fuzz.jsonl`.
"""

import argparse
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

import numpy as np
from kept import RESULTS, Study

from madoc import robots
from madoc.data import logs
from madoc.errors import MadocError

STUDY = Study(RESULTS / "fuzz.jsonl", ())
EXAMPLES = Path(__file__).parents[1] / "examples"
HURTFUL = (
    *(
        b"nan",
        b"inf",
        b"-1e309",
        b"1e-320",
        b"0x10",
        b"1_000",
        b"1,5",
        b"''",
        b'"',
        b"'",
        b"\x00",
        b"\xff",
        b"\xef\xbb\xbf",
    ),
    *(b"[", b"{", b"}", b"]", b": ", b"- ", b"#", b"&a", b"*a", b"!!python/name:os.system", b"<<: ", b"|", b">", b"\t"),
    *(
        b"__import__('os')",
        b"position(",
        b"position(position(shoulder))",
        b"9**9**9",
        b"1/0",
        b"sensor()[0]",
        b"-" * 200,
    ),
    *(
        b"time",
        b"shoulder",
        b"elbow",
        b"low",
        b"high",
        b"\r\n",
        b"\r",
        b"\n\n",
        b",,",
        b";",
        b"\t,",
        b"e",
        b"-",
        b"2026-01-01",
    ),
)
"""Words that parsers stumble over."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"), help="folder for what was not answered")
    arguments = parser.parse_args()
    random = np.random.default_rng(arguments.seed)
    good_spec = (EXAMPLES / "arm" / "arm.yaml").read_bytes()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "arm.xml").write_bytes((EXAMPLES / "arm" / "arm.xml").read_bytes())
        (folder / "good.yaml").write_bytes(good_spec)
        robot = robots.load(folder / "good.yaml")
        good_log = log_of(robot, random)
        end = time.monotonic() + 60 * arguments.minutes
        while time.monotonic() < end:
            spec, log = spoilt(good_spec, random), spoilt(good_log, random)
            (folder / "arm.yaml").write_bytes(spec)
            (folder / "log.csv").write_bytes(log)
            for kind, content, attempt in (
                ("spec", spec, lambda: robots.load(folder / "arm.yaml")),
                ("log", log, lambda: logs.read(folder / "log.csv", robot)),
            ):
                word = answer(attempt)
                counts[f"{kind}s {word}"] += 1
                if word == "crashed":
                    arguments.keep.mkdir(parents=True, exist_ok=True)
                    (arguments.keep / f"{kind}-{sum(counts.values())}").write_bytes(content)
    found = {"minutes": arguments.minutes, "seed": arguments.seed} | dict(sorted(counts.items()))
    STUDY.add(found)
    print(found)
    raise SystemExit(any(name.endswith("crashed") for name in counts))


def answer(attempt) -> str:
    """How a file was answered."""
    try:
        attempt()
    except MadocError as error:
        return "refused" if "\n" not in str(error) else "crashed"
    except Exception:
        traceback.print_exc()
        return "crashed"
    return "read"


def spoilt(content: bytes, random: np.random.Generator) -> bytes:
    """A file with one to four things done to it."""
    for _ in range(random.integers(1, 5)):
        content = CHANGES[random.integers(len(CHANGES))](content, random)
    return content


def cut(content: bytes, random: np.random.Generator) -> bytes:
    """A stretch left out."""
    start, end = np.sort(random.integers(0, len(content) + 1, 2))
    return content[:start] + content[end:]


def doubled(content: bytes, random: np.random.Generator) -> bytes:
    """A stretch of at most 200 bytes once more, anywhere."""
    start, place = random.integers(0, len(content) + 1, 2)
    return content[:place] + content[start : start + 200] + content[place:]


def hurt(content: bytes, random: np.random.Generator) -> bytes:
    """A hurtful word, in place of as many bytes as chance will have it."""
    place = random.integers(0, len(content) + 1)
    word = HURTFUL[random.integers(len(HURTFUL))]
    return content[:place] + word + content[place + random.integers(0, 12) :]


def flipped(content: bytes, random: np.random.Generator) -> bytes:
    """A byte changed."""
    if not content:
        return content
    place = random.integers(0, len(content))
    return content[:place] + bytes([random.integers(0, 256)]) + content[place + 1 :]


def mixed(content: bytes, random: np.random.Generator) -> bytes:
    """Two lines change places."""
    lines = content.splitlines(keepends=True)
    if len(lines) > 1:
        first, second = random.integers(0, len(lines), 2)
        lines[first], lines[second] = lines[second], lines[first]
    return b"".join(lines)


CHANGES = (cut, doubled, hurt, flipped, mixed)


def log_of(robot: robots.Robot, random: np.random.Generator) -> bytes:
    """Forty rows that the robot's reader takes."""
    rows = 40
    names = ["time", *(channel.name for channel in (*robot.signals, *robot.actions))]
    values = random.uniform(-1.0, 1.0, (rows, len(names)))
    values[:, 0] = robot.spec.control_step * np.arange(rows)
    lines = [",".join(names), *(",".join(f"{value:.9g}" for value in row) for row in values)]
    return ("\n".join(lines) + "\n").encode()


if __name__ == "__main__":
    main()
