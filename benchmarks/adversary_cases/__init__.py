"""Calibration problems with a known answer: plants simulated by MuJoCo alone, logs, models, and specs.

`DECEPTIONS` are problems whose model or spec is wrong, `HONEST` those whose model is right.
"""

from adversary_cases.case import Case
from adversary_cases.deceptions import DECEPTIONS
from adversary_cases.honest import HONEST
from adversary_cases.write import Problem, write

CASES: dict[str, Case] = {case.key: case for case in (*DECEPTIONS, *HONEST)}
"""Every case by robot and name."""

__all__ = ["CASES", "DECEPTIONS", "HONEST", "Case", "Problem", "write"]
