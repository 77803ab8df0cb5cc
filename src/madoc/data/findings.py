"""What was found out about a log: each a value with a level, what, where, and what to do."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal

Level = Literal["fatal", "warning", "note"]
LEVELS: tuple[Level, ...] = ("fatal", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One thing to know about a log before anything is made of it.

    Attributes:
        level: `fatal` stops a calibration, `warning` goes with its result, `note` is told once.
        what: What was found, as a clause.
        where: A file, a row, a signal, a parameter; empty where it is the whole.
        do: What to do about it; empty where nothing is.
    """

    level: Level
    what: str
    where: str = ""
    do: str = ""

    @property
    def sentence(self) -> str:
        """All of it on one line."""
        place = f"{self.where}: " if self.where else ""
        return f"{place}{self.what}" + (f"; {self.do}" if self.do else "")

    def to_json(self) -> dict[str, str]:
        """Its fields."""
        return asdict(self)


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Fatal ones, then warnings, then notes; each only once, in the order found."""
    return tuple(sorted(dict.fromkeys(findings), key=lambda finding: LEVELS.index(finding.level)))
