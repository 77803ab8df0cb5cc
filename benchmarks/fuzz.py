"""Spoilt specs, models and logs for as long as asked: each must be read, or refused with one sentence, soon.

    python benchmarks/fuzz.py --minutes 10                # specs and models, then logs, of each so many
    python benchmarks/fuzz.py --minutes 10 --what models

A good file is cut, doubled, spliced, and sprinkled with what is known to hurt; models are also made by Hypothesis of
MuJoCo's own elements and attributes. What is neither read nor refused, or takes longer than `LONGEST`, is left in
`--keep`, and ends the run with exit code 1; what ends the process itself is left there as `last-...`. Leaves
a row of `results/fuzz.jsonl`.
"""

import argparse
import io
import json
import re
import resource
import signal
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pyarrow
import pyarrow.parquet
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from kept import RESULTS, Study
from mcap.writer import Writer

from madoc import robots
from madoc.data import logs
from madoc.errors import MadocError

STUDY = Study(RESULTS / "fuzz.jsonl", ())
EXAMPLES = Path(__file__).parents[1] / "examples"
LONGEST = 20.0
"""Longest time in s that an answer may take; on a machine that others use too, ten times what it takes alone."""
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


class TooLong(BaseException):
    """Raised in whatever runs when `LONGEST` has passed."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--what", choices=("models", "logs"), action="append")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"), help="folder for what was not answered")
    arguments = parser.parse_args()
    arguments.keep.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGALRM, _too_long)
    counts: Counter[str] = Counter()
    peaks = {}
    for what in arguments.what or ("models", "logs"):
        tries = Tries(arguments.keep, counts, time.monotonic() + 60 * arguments.minutes)
        with tempfile.TemporaryDirectory() as name:
            for file in ("arm.xml", "arm.yaml"):
                (Path(name) / file).write_bytes((EXAMPLES / "arm" / file).read_bytes())
            (of_models if what == "models" else of_logs)(Path(name), tries, arguments.seed)
        peaks[f"{what}: most MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1000
    found = {"minutes": arguments.minutes, "seed": arguments.seed} | peaks | dict(sorted(counts.items()))
    STUDY.add(found)
    print(found)
    raise SystemExit(any(name.endswith(("crashed", "too long")) for name in counts))


class Tries:
    """Attempts at files, counted by how they were answered, until a moment."""

    def __init__(self, keep: Path, counts: Counter[str], end: float) -> None:
        self.keep, self.counts, self.end = keep, counts, end

    @property
    def over(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() > self.end

    def __call__(self, kind: str, content: bytes, attempt: Callable[[], object]) -> None:
        """Count how a file is answered; it is kept unless the answer is right."""
        last = self.keep / f"last-{kind}"
        last.write_bytes(content)
        word = answer(attempt)
        self.counts[f"{kind} {word}"] += 1
        if word in ("crashed", "too long"):
            last.rename(self.keep / f"{kind}-{self.counts.total()}")


def answer(attempt: Callable[[], object]) -> str:
    """How a file was answered."""
    signal.setitimer(signal.ITIMER_REAL, LONGEST)
    try:
        attempt()
    except MadocError as error:
        if "\n" not in str(error):
            return "refused"
        print(error)
        return "crashed"
    except TooLong:
        traceback.print_exc()
        return "too long"
    except Exception:
        traceback.print_exc()
        return "crashed"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    return "read"


def _too_long(*_: object) -> None:
    raise TooLong


def of_models(folder: Path, tries: Tries, first_seed: int) -> None:
    """Specs that are spoilt, and models that are spoilt or made, in turn."""
    random = np.random.default_rng(first_seed)
    spec, model = ((folder / name).read_bytes() for name in ("arm.yaml", "arm.xml"))
    batch = 0
    while not tries.over:

        @seed(first_seed + batch)
        @settings(
            max_examples=100,
            database=None,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(st.data())
        def made(data: st.DataObject) -> None:
            parts, place = data.draw(PARTS), data.draw(PLACES)
            if not tries.over:
                (folder / "made.xml").write_bytes(content := with_parts(model, parts, place))
                (folder / "made.yaml").write_bytes(spec.replace(b"arm.xml", b"made.xml"))
                tries("model", content, lambda: robots.load(folder / "made.yaml"))

        made()
        batch += 1
        for _ in range(100):
            if tries.over:
                break
            (folder / "spoilt.yaml").write_bytes(content := spoilt(spec, random))
            tries("spec", content, lambda: robots.load(folder / "spoilt.yaml"))
            (folder / "made.xml").write_bytes(content := spoilt(model, random))
            tries("model", content, lambda: robots.load(folder / "made.yaml"))


def schema() -> dict[str, list[str]]:
    """The attributes of each element that MuJoCo's models may have."""
    found: dict[str, list[str]] = {}
    tag = ""
    for line in mujoco.mj_printSchema(False, False).splitlines():
        begun = re.match(r"\s*(\w+) \(.\)(.*)", line)
        tag, rest = (begun[1], begun[2]) if begun else (tag, line)
        found.setdefault(tag, []).extend(rest.split())
    return found


SCHEMA = schema()
NUMBERS = st.one_of(
    st.floats(),
    st.integers(),
    st.sampled_from([0, -1, 1e-300, 1e300, 2**31 - 1, 2**31, 2**63, 1e-9, 1e9, float("nan"), float("inf"), 100_000]),
).map(str)
NAMES = "shoulder elbow upper arm.xml ../arm.xml /etc/hostname mesh box sphere hinge free ball slide true false auto"
SETTINGS = "grid cube 2d checker Euler implicit cable fluid user 9G &#0; &lt;"
WORDS = st.one_of(
    NUMBERS,
    st.lists(NUMBERS, max_size=7).map(" ".join),
    st.sampled_from((*tuple(f"{NAMES} {SETTINGS}".split(" ")), "", "1 1", "1 2 3")),
)


def element(tag: str) -> st.SearchStrategy[tuple[str, dict[str, str]]]:
    """An element with some of its attributes."""
    names = st.lists(st.sampled_from(SCHEMA[tag] or ["name"]), max_size=4, unique=True)
    attributes = names.flatmap(lambda chosen: st.fixed_dictionaries({name: WORDS for name in chosen}))
    return attributes.map(lambda given_attributes: (tag, given_attributes))


ELEMENTS = st.sampled_from(sorted(SCHEMA)).flatmap(element)
PARTS = st.recursive(
    ELEMENTS.map(lambda part: (part, [])),
    lambda inside: st.tuples(ELEMENTS, st.lists(inside, max_size=4)),
    max_leaves=8,
)
PLACES = st.floats(0.0, 1.0)


def with_parts(model: bytes, parts: tuple, place: float) -> bytes:
    """A model with an element more, behind one of its tags."""
    tags = [found.end() for found in re.finditer(rb"<[^?!>]*>", model)]
    at = tags[min(int(place * len(tags)), len(tags) - 1)]
    return model[:at] + as_text(parts).encode() + model[at:]


def as_text(parts: tuple) -> str:
    """An element as XML."""
    (tag, attributes), inside = parts
    given_attributes = "".join(f' {name}="{value}"' for name, value in attributes.items())
    return f"<{tag}{given_attributes}>{''.join(map(as_text, inside))}</{tag}>"


def of_logs(folder: Path, tries: Tries, first_seed: int) -> None:
    """Logs of every format, spoilt, in turn."""
    random = np.random.default_rng(first_seed)
    robot = robots.load(folder / "arm.yaml")
    good = {kind: write(table_of(robot, random), folder) for kind, write in WRITERS.items()}
    while not tries.over:
        for kind, content in good.items():
            file = folder / f"log.{kind}"
            file.write_bytes(content := spoilt(content, random))
            tries(kind, content, lambda file=file: logs.read(file, robot))


def table_of(robot: robots.Robot, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Forty rows that a reader takes, by column."""
    names = [channel.name for channel in (*robot.signals, *robot.actions)]
    time_of_rows = {"time": robot.spec.control_step * np.arange(40)}
    return time_of_rows | {name: random.uniform(-1.0, 1.0, 40) for name in names}


def as_csv(table: dict[str, np.ndarray], folder: Path) -> bytes:
    rows = zip(*table.values(), strict=True)
    return "\n".join([",".join(table), *(",".join(f"{value:.9g}" for value in row) for row in rows), ""]).encode()


def as_npz(table: dict[str, np.ndarray], folder: Path) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **table)
    return stream.getvalue()


def as_hdf5(table: dict[str, np.ndarray], folder: Path) -> bytes:
    with h5py.File(folder / "good.h5", "w") as file:
        for name, values in table.items():
            file.create_dataset(name, data=values, chunks=(8,), compression="gzip")
    return (folder / "good.h5").read_bytes()


def as_parquet(table: dict[str, np.ndarray], folder: Path) -> bytes:
    stream = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table(table), stream)
    return stream.getvalue()


def as_mcap(table: dict[str, np.ndarray], folder: Path) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=500)
    writer.start()
    channel = writer.register_channel("/arm", "json", 0)
    for row, values in enumerate(zip(*table.values(), strict=True)):
        message = json.dumps(dict(zip(table, map(float, values), strict=True))).encode()
        writer.add_message(channel, row * 20_000_000, message, row * 20_000_000)
    writer.finish()
    return stream.getvalue()


WRITERS = {"csv": as_csv, "npz": as_npz, "h5": as_hdf5, "parquet": as_parquet, "mcap": as_mcap}


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


if __name__ == "__main__":
    main()
