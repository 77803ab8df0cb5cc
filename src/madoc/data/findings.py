"""Findings about a log: each with its level, a clause that says it, its place, and what to do."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Level = Literal["fatal", "warning", "note"]
LEVELS: tuple[Level, ...] = ("fatal", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One finding about a log.

    Attributes:
        level: `fatal` stops a calibration, `warning` is kept with its result, `note` is printed once, unless `kept`.
        what: The finding, as a clause.
        where: A file, a row, a signal or a parameter; empty where it concerns the whole log.
        do: What to do about it; empty where nothing is to be done.
        contradicts: Whether the log contradicts the spec, so that no estimate from the two is to be trusted.
        rough: Whether it is a size that the log alone tells roughly, so that an estimate may refute it.
        kept: Whether a note is kept with results, as it bears on what estimates mean.
    """

    level: Level
    what: str
    where: str = ""
    do: str = ""
    contradicts: bool = False
    rough: bool = False
    kept: bool = False

    @property
    def sentence(self) -> str:
        """The whole finding on one line."""
        place = f"{self.where}: " if self.where else ""
        return f"{place}{self.what}" + (f"; {self.do}" if self.do else "")

    def to_json(self) -> dict[str, str]:
        """The fields for JSON."""
        return {"level": self.level, "what": self.what, "where": self.where, "do": self.do}


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Fatal findings, then warnings, then notes; each only once, otherwise in the given order."""
    return tuple(sorted(dict.fromkeys(findings), key=lambda finding: LEVELS.index(finding.level)))
