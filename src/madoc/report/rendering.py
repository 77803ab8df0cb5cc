"""The templates of pages and charts, with the filters that write numbers and names."""

import functools

import jinja2
from markupsafe import Markup

from madoc.errors import printable
from madoc.report import words

GENERATOR = "madoc report"
"""The generator that a page names in its head; only a file that names it is overwritten."""


@functools.cache
def templates() -> jinja2.Environment:
    """All templates; every word that comes from a file is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("madoc.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_printable,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    names = ("number", "percent", "count", "duration", "spread", "spread_words", "place", "parameter_title")
    environment.filters |= {name: getattr(words, name) for name in names}
    environment.filters |= {"unit": words.unit_words, "interval": words.interval_words, "px": "{:.1f}".format}
    environment.globals |= {"TONES": words.TONES, "generator": GENERATOR}
    return environment


def _printable(value: object) -> object:
    """A value of a template; text that would turn the direction of what follows is written as numbers."""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def chart(kind: str, **values: object) -> Markup:
    """An SVG: a macro of `templates/charts.svg`, applied to some values."""
    return Markup(getattr(templates().get_template("charts.svg").module, kind)(**values))
