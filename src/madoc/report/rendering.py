"""The templates of pages, with the filters that write numbers and names, and the library that draws their charts."""

import base64
import functools
import gzip
from importlib import resources

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
    environment.filters |= {"unit": words.unit_words, "interval": words.interval_words}
    environment.globals |= {"TONES": words.TONES, "generator": GENERATOR}
    return environment


def _printable(value: object) -> object:
    """A value of a template; text that would turn the direction of what follows is written as numbers."""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def plotly() -> str:
    """Plotly's script as base64 of gzip, which the page's own script unpacks: 2 MB in place of 4.8."""
    script = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(script, mtime=0)).decode()
