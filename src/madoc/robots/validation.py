"""Pydantic's findings in a YAML document, each as one sentence with the line of the mistake."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from madoc.errors import UNPRINTABLE, nearest_hint
from madoc.robots.document import Document, Place

_WORDS = {
    "float_type": "a number",
    "float_parsing": "a number",
    "model_type": "keys and values",
    "dataclass_type": "keys and values",
    "dict_type": "keys and values",
    "list_type": "a list",
    "tuple_type": "a list",
    "int_type": "a whole number",
    "string_type": "text",
    "path_type": "text",
    "bool_type": "true or false",
    "string_pattern_mismatch": "a printable name",
}
"""What was expected, by pydantic's name of the mistake."""


LARGEST = 1e12
"""Largest size of a number, in any unit: no range or limit of a robot reaches further."""
_PRINTABLE = f"^[^{UNPRINTABLE}]+$"
Name = Annotated[str, Field(min_length=1, max_length=100, pattern=_PRINTABLE)]
File = Annotated[str, Field(min_length=1, max_length=4096, pattern=_PRINTABLE)]
Unit = Annotated[str, Field(max_length=40, pattern=f"^[^{UNPRINTABLE}]*$")]
Finite = Annotated[float, Field(allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, le=LARGEST)]


class Part(BaseModel):
    """A part of a file: no unknown key is accepted, and no value is converted into another type."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def refuse(wrong: bool, sentence: str) -> None:
    """Raise a ValueError, which pydantic reports, where something is wrong."""
    if wrong:
        raise ValueError(sentence)


@contextmanager
def refused_with_line(document: Document, whole: type, parts: Mapping[str | int, type]) -> Iterator[None]:
    """Turn pydantic's refusal inside the block into an error with the line of the first mistake.

    Args:
        document: The file that was validated.
        whole: The model of the file.
        parts: The models of its parts by their key, for the keys that each may have.
    """
    try:
        yield
    except ValidationError as error:
        # What is missing may be there under a misspelt name, which says more.
        details = sorted(
            error.errors(), key=lambda detail: (detail["type"] == "missing", document.line(_place(detail)))
        )
        more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
        place = _place(details[0])
        part = next((parts[key] for key in reversed(place[:-1]) if key in parts), whole)
        raise document.error(place, mistake(details[0], place, _keys(part)) + more) from error


def mistake(detail: ErrorDetails, place: Place, known: list[str]) -> str:
    """A finding of pydantic in words: what was expected, where, and what was there instead.

    Args:
        detail: The finding.
        place: Where it is, by the keys of the file.
        known: The keys that the part around it may have.
    """
    kind, got = detail["type"], detail["input"]
    what = ".".join(str(part) for part in place if not isinstance(part, int))
    if kind in ("missing", "missing_argument"):
        *around, key = place
        return f"expected {key}: {'here' if not around else 'in this part of ' + str(around[0])}"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"unknown key {place[-1]!r}; {nearest_hint(str(place[-1]), known)}"
    if kind == "value_error":
        return str(detail["ctx"]["error"])
    if kind in ("string_type", "path_type") and isinstance(got, int | float):
        return f"expected text in {what}, got {got!r}; put it in quotes"
    expected = detail["msg"].partition(" should ")[2].partition(" after ")[0].removeprefix("be ").removeprefix("have ")
    expected = _WORDS.get(kind, expected)
    if kind == "string_pattern_mismatch" and place == ("name",):
        expected = "a name of letters, digits, _ . and -"
    return f"expected {expected} in {what}, got {shown(got)}"


def _keys(part: type) -> list[str]:
    """The keys that a part of a file may have."""
    if is_dataclass(part):
        return [row.name for row in fields(part)]
    return list(getattr(part, "model_fields", ()))


def _place(detail: ErrorDetails) -> Place:
    """The place of an error in the document, without pydantic's mark for a key of a dictionary."""
    return tuple(part for part in detail["loc"] if part != "[key]")


def shown(value: object) -> str:
    """A value of a file in a sentence."""
    if isinstance(value, dict):
        return "keys and values"
    if value is None or value == []:
        return "nothing" if value is None else "an empty list"
    text = str(value) if isinstance(value, float) and not math.isfinite(value) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
