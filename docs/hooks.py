"""What the site needs beside its pages: equations as MathML, which browsers draw, and the measured tables."""

import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

MEASURED = Path(__file__).parents[1] / "benchmarks" / "results" / "README.md"

_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
_TABLE = re.compile(r"^\{\{ measured: (.+) \}\}$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the measured tables where a page asks for one, as `{{ measured: HEADING }}`."""
    return _TABLE.sub(lambda asked: measured(asked[1]), markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Turn equations into MathML."""
    return _EQUATION.sub(_mathml, content)


def measured(heading: str) -> str:
    """What stands under a heading of the measured results.

    Raises:
        KeyError: There is no such heading.
    """
    sections = re.split(r"^## ", MEASURED.read_text(), flags=re.MULTILINE)
    found = {section.partition("\n")[0].strip(): section.partition("\n")[2].strip() for section in sections[1:]}
    return found[heading]


def _mathml(equation: re.Match[str]) -> str:
    return convert(html.unescape(equation[2]), display="block" if equation[1] == "div" else "inline")
