"""A run folder as a page to look at: it reads folders only, and knows no method by name."""

from madoc.report.comparison import write_comparison
from madoc.report.page import write_report

__all__ = ["write_comparison", "write_report"]
