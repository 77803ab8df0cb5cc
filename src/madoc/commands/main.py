"""The command `madoc`: it reads the arguments, runs the command of one of its siblings, and prints the answer."""

import contextlib
import io
import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence

import tyro

from madoc import __version__
from madoc.commands.answer import EXIT_CODES, Answer
from madoc.commands.lists import Methods, Tasks
from madoc.commands.logs import Check, Record, Selftest
from madoc.commands.results import Export, Report, View
from madoc.commands.spec import Init, Spec
from madoc.commands.stages import Calibrate, Evaluate, Learn, Run
from madoc.commands.suite import Suite, Worker
from madoc.errors import MadocError, printable
from madoc.runs.files import json_text

WIDTH = 110
"""Width of a table in characters where standard output is no terminal."""

Commands = (
    Run
    | Record
    | Calibrate
    | Selftest
    | Learn
    | Evaluate
    | Suite
    | Worker
    | Init
    | Spec
    | Check
    | Report
    | View
    | Export
    | Tasks
    | Methods
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; its exit code. A user's mistake is one sentence on standard error and code 2."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal that lacks a letter shows its number instead
        sys.stdout.reconfigure(errors="backslashreplace")
    code = 0
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words == ["--version"]:
        from madoc.runs.machine import versions

        others = {name: version for name, version in versions().items() if name != "madoc"}
        print(f"madoc {__version__} ({', '.join(f'{name} {version}' for name, version in others.items())})")
        return code
    try:
        command = _parse(words)
        with _calm(), contextlib.redirect_stdout(sys.stderr):
            answer = command.run()
        code = EXIT_CODES[answer.status]
        _print(answer, as_json=command.output.json)
    except MadocError as error:
        return _refused(str(error))
    except KeyboardInterrupt:
        print("madoc: interrupted", file=sys.stderr)
        return EXIT_CODES["interrupted"]
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing more is written, not even at exit
    except RuntimeError as error:
        if "home directory" not in str(error):  # what pathlib says of ~ and an unknown user
            raise
        return _refused("a path begins with ~ and the name of no user of this machine; write the folder out")
    except OSError as error:  # a full disk, a folder that may not be written to, a name that is too long
        where = "" if error.filename is None else f" at {error.filename!r:.200}"
        reason = error.strerror or str(error)
        return _refused(f"the system refused{where}: {reason}; check the path, the rights and the space, and try again")
    return code


def _refused(sentence: str) -> int:
    """Print why a command was refused; the exit code of a user's mistake."""
    print(f"madoc: {printable(sentence)}", file=sys.stderr)
    return EXIT_CODES["rejected"]


def _parse(arguments: Sequence[str]) -> Commands:
    """The command and its options.

    Raises:
        MadocError: They cannot be understood.
    """
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            return tyro.cli(
                Commands,
                prog="madoc",
                description="Calibrate a simulator to logged robot data, learn a policy there, and show that it "
                "works in the target. `madoc --version` tells the versions of what is installed.",
                args=arguments,
                config=(tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone),
            )
    except SystemExit as end:
        if not end.code:
            raise
        raise MadocError(_one_sentence(printed.getvalue())) from None


def _one_sentence(box: str) -> str:
    """A box drawn by tyro as one sentence: its first paragraph, a suggestion if any, and where to read on."""
    box = re.sub("-{10,}", "─" * 10, box)  # the rule between paragraphs where the terminal has ASCII alone
    lines = [line.strip("│╭╮╰╯ ") for line in box.splitlines()[1:-1]]
    paragraphs = [" ".join(text.split()) for text in "\n".join(lines).split("─" * 10) if text.strip("─\n ")]
    paragraphs = [text.strip("─ ") for text in paragraphs]
    if not paragraphs:
        return " ".join(box.split())
    parts = [_plain(paragraphs[0], box)]
    parts += [text for text in paragraphs[1:-1] if text.startswith(("Perhaps", "Available"))][:1]
    read_on = paragraphs[-1] if paragraphs[-1].startswith("For full") else ""
    read_on = read_on[read_on.find("madoc") :]
    return "; ".join([*parts, f"see {read_on}"] if read_on else parts)


def _plain(text: str, box: str) -> str:
    """The first paragraph of a box of tyro in the words of other refusals."""
    wrong = re.match(r"Error parsing (\S+): .*?'([^']*)'", text)
    if wrong and ("int()" in text or "float" in text):
        kind = "a whole number" if "int()" in text else "a number"
        return f"{wrong[1]}: expected {kind}, got {wrong[2]!r}"
    if text.startswith("Missing from "):
        names = re.findall(r"^. {5}([-A-Z]\S+)", box[: box.index("─" * 10, box.index(text[:12]))], re.MULTILINE)
        return f"{text[len('Missing from ') : text.index(':')]}: {' and '.join(names)} must be given"
    return re.sub(r"^Error parsing \S+: ", "", text).replace("Expected 1 values", "Expected one").rstrip(".")


@contextlib.contextmanager
def _calm() -> Iterator[None]:
    """Print each warning of a block as one line."""

    def show(message: Warning | str, *where: object, **options: object) -> None:
        print(f"madoc: warning: {printable(str(message))}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def _print(answer: Answer, *, as_json: bool) -> None:
    """Print an answer on standard output."""
    if as_json:
        ascii_only = (sys.stdout.encoding or "utf-8").lower() not in ("utf-8", "utf8")
        print(printable(json_text(dict(answer.json), what="the answer", ascii_only=ascii_only)), flush=True)
        return
    from rich.console import Console
    from rich.segment import Segment, Segments

    console = Console(markup=False) if sys.stdout.isatty() else Console(markup=False, width=WIDTH)
    with console.capture() as capture:  # printed by hand: Rich would exit at a closed pipe
        for part in answer.text:
            if isinstance(part, str):
                console.print(printable(part), markup=False, highlight=False, soft_wrap=True)
                continue
            shown = [Segment(printable(segment.text), segment.style) for segment in console.render(part)]
            console.print(Segments(shown), end="")
    print(capture.get(), end="", flush=True)
