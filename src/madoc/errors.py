"""The one exception a user's mistake raises: a sentence saying what, where and what to do."""

import difflib
from collections.abc import Iterable


class MadocError(ValueError):
    """Bad input or a refused problem. The command line prints its sentence and exits with code 2."""


def unknown_name(what: str, name: str, known: Iterable[str]) -> MadocError:
    """The refusal of a name that is not among the known ones; it points at the nearest."""
    names = list(known)
    ending = [candidate for candidate in names if candidate.endswith(f".{name}")]
    near = ending or difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {near[0]}?" if near else ";"
    return MadocError(f"unknown {what} {name!r}{hint} there are: {', '.join(names)}")
