"""How long a run may take: a count of control steps or updates, or a time."""

import re
from dataclasses import dataclass

from madoc.errors import MadocError
from madoc.types import Unit

OF_SEARCH, LEAST_OF_SEARCH = 2.0 / 3.0, 0.2
"""Share of a time budget that a search may take, with what is spent before it, and the least one that it gets."""
UNTIL_JUDGED = 0.95
"""Share of a time budget at which judging is to end, as a film of the motion follows."""


@dataclass(frozen=True)
class Seconds:
    """A budget in wall-clock time from the start of a run, that before a resume included.

    What a run under it results in depends on how fast the machine is.
    """

    seconds: float

    def for_search(self, spent: float) -> "Seconds":
        """What a search gets of a time that is for a whole command, judging included, of which some is spent."""
        return Seconds(self.seconds * max(LEAST_OF_SEARCH, OF_SEARCH - spent / self.seconds))

    @property
    def until_judged(self) -> "Seconds":
        """The time from the start of a whole command of this budget to the end of judging."""
        return Seconds(self.seconds * UNTIL_JUDGED)

    @property
    def with_judging(self) -> "Seconds":
        """The time for a whole command whose search gets this one."""
        return Seconds(self.seconds / OF_SEARCH)

    def __str__(self) -> str:
        return f"{self.seconds:g} s"


Budget = int | Seconds
"""How long a method may run: a count of what its entry says (`Unit`), or a time."""

_TIME_UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}


def read_budget(given: Budget | str, unit: Unit = "control steps") -> Budget:
    """A budget as written, or read already: `300000` is a count of the unit, `300s`, `15min` and `2h` are times.

    Raises:
        MadocError: It is neither, or not positive.
    """
    if isinstance(given, Seconds) or (isinstance(given, int) and not isinstance(given, bool)):
        budget: Budget = given
    else:
        words = re.fullmatch(r"([\d_.]+) ?(s|min|h)?", str(given).strip())
        try:
            number, time = (words[1], words[2]) if words else ("", None)
            budget = Seconds(float(number) * _TIME_UNITS[time]) if time else int(number)
        except ValueError:
            raise MadocError(f"expected a budget such as 300000, 300s, 15min or 2h, got {given!r}") from None
    if isinstance(budget, Seconds) and not budget.seconds > 0:
        raise MadocError(f"expected a budget of more than 0 s, got {given}")
    if isinstance(budget, int) and budget < 1:
        raise MadocError(f"expected a budget of at least 1 {unit.removesuffix('s')}, got {budget}")
    return budget
