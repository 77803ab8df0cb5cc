"""The sections of a page: each takes a run, and gives what its template shows or a sentence on what is missing."""

from collections.abc import Callable

from madoc.report.reading import Run
from madoc.report.sections.base import NOT_ENDED, TONES, Section, Shown
from madoc.report.sections.course import curves, trace
from madoc.report.sections.estimates import correlations, estimates, grouping
from madoc.report.sections.holdout import holdout, methods, residuals, signals
from madoc.report.sections.outcome import asked, cost, policies

ALL: tuple[Callable[[Run], Section], ...] = (
    estimates,
    holdout,
    signals,
    residuals,
    trace,
    grouping,
    curves,
    correlations,
    methods,
    policies,
    cost,
    asked,
)
"""In the order of the page."""

__all__ = ["ALL", "NOT_ENDED", "TONES", "Section", "Shown"]
