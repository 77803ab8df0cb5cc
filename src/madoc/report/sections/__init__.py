"""The sections of a page: a function takes a run and returns what its template shows, or a sentence on what is missing.

The macro of `templates/parts.html` with the section's name draws it.
"""

from collections.abc import Callable, Mapping

from madoc.report.reading import Run
from madoc.report.sections.course import curves, trace
from madoc.report.sections.estimates import correlations, estimates, grouping, lacks, together
from madoc.report.sections.holdout import holdout, residuals, signals
from madoc.report.sections.outcome import asked, cost, film, motion, policies, robustness

SECTIONS: Mapping[str, tuple[str, Callable[[Run], dict[str, object] | str]]] = {
    "motion": ("The robot in a held-out run", motion),
    "signals": ("Measured and simulated", signals),
    "estimates": ("Estimates", estimates),
    "lacks": ("What the model may lack", lacks),
    "holdout": ("On held-out data", holdout),
    "residuals": ("Residual by signal", residuals),
    "trace": ("Estimates over the search", trace),
    "grouping": ("What acts alike", grouping),
    "curves": ("What the method measured", curves),
    "together": ("Told in combination", together),
    "correlations": ("Correlations of the estimates", correlations),
    "policies": ("Policies in the target", policies),
    "film": ("Policies at work", film),
    "robustness": ("Where the estimate is not sure", robustness),
    "cost": ("Cost", cost),
    "asked": ("What was asked", asked),
}
"""Title and function of each section by name, in the order of the page."""

__all__ = ["SECTIONS"]
