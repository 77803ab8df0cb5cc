"""The one exception a user's mistake raises: a sentence saying what, where and what to do."""

import difflib
from collections.abc import Iterable


class MadocError(ValueError):
    """Bad input or a refused problem. The command line prints its sentence and exits with code 2."""


def check_at_least(owner: object, **minima: float) -> None:
    """Refuse attributes of a hyperparameter object that are below their minimum; None is let through.

    Raises:
        MadocError: One is too small.
    """
    for name, minimum in minima.items():
        value = getattr(owner, name)
        smallest = min(value, default=minimum) if isinstance(value, tuple) else value
        if smallest is not None and not smallest >= minimum:
            raise MadocError(f"expected {name} of at least {minimum:g} for {type(owner).__name__}, got {value}")


def unknown_name(what: str, name: str, known: Iterable[str]) -> MadocError:
    """The refusal of a name that is not among the known ones; it points at the nearest."""
    names = list(known)
    ending = [candidate for candidate in names if candidate.endswith(f".{name}")]
    near = ending or difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {near[0]}?" if near else ";"
    return MadocError(f"unknown {what} {name!r}{hint} there are: {', '.join(names)}")
