"""The exception for a user's mistakes, and sentences that its messages have in common."""

import difflib
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

UNPRINTABLE = r"\x00-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
"""Characters, as in a class of a regular expression, that move a cursor or turn the direction of text around them."""
_HIDDEN = re.compile(f"[{UNPRINTABLE}]")


class MadocError(ValueError):
    """Bad input or a refused problem. The command line prints its sentence and exits with code 2.

    Where it is about one option of an order, a suite says the line at which its file has that; "" is a whole part.
    """

    def __init__(self, sentence: str, *, option: str | None = None) -> None:
        super().__init__(sentence)
        self.option = option


class NotAllowed(MadocError):
    """What was asked would run code of a user's file, or read files elsewhere, and nobody has allowed that."""


@contextmanager
def about(option: str) -> Iterator[None]:
    """Say of a refusal inside the block which option it is about, unless it says so itself."""
    try:
        yield
    except MadocError as error:
        if error.option is None:
            error.option = option
        raise


@contextmanager
def needing(what: str, package: str) -> Iterator[None]:
    """Refuse where an import in the block fails: `what` begins the sentence, how to install the package follows."""
    try:
        yield
    except ImportError as error:
        raise MadocError(f'{what} pip install "{package}" ({error})') from error


def printable(text: str, *, kept: str = "\n\t") -> str:
    """A text whose control characters and those that turn its direction are written as numbers, but for some."""
    return _HIDDEN.sub(lambda found: found[0] if found[0] in kept else f"\\u{ord(found[0]):04x}", text)


def unknown_name(what: str, name: str, known: Iterable[str]) -> MadocError:
    """The error for a name that is not among the known ones; it suggests the nearest."""
    names = list(known)
    ending = [candidate for candidate in names if candidate.endswith(f".{name}")]
    near = ending or difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {near[0]}?" if near else ";"
    return MadocError(f"unknown {what} {name!r}{hint} there are: {', '.join(names)}")


def nearest(wanted: str, names: Iterable[str]) -> list[str]:
    """At most three of the names: those that contain the wanted one first, then those spelled like it."""
    known = list(names)
    by_case = {name.lower(): name for name in known}
    close = [by_case[name] for name in difflib.get_close_matches(wanted.lower(), list(by_case), n=3, cutoff=0.5)]
    containing = [name for name in known if wanted and wanted.lower() in name.lower()]
    return list(dict.fromkeys([*containing, *close]))[:3]


def nearest_hint(wanted: str, names: Iterable[str], *, none: str = "there is none") -> str:
    """The end of an error about an unknown name: the nearest names, else the first of all, else `none`."""
    known = list(names)
    near = nearest(wanted, known)
    if near:
        return f"nearest: {', '.join(near)}"
    return f"there are: {listed(known)}" if known else none


def listed(names: Iterable[str], most: int = 12) -> str:
    """Names for a sentence: at most `most`, then how many more there are."""
    known = list(names)
    if not known:
        return "none"
    return ", ".join(known[:most]) + (f" and {len(known) - most} more" if len(known) > most else "")
