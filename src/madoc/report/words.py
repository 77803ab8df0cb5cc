"""Numbers and names as text for a reader; most of these functions are filters of the templates."""

import math
from collections.abc import Sequence

from madoc.calibration.result import CalibrationResult, ParameterEstimate

TONES = {
    "CALIBRATED": "good",
    "USABLE": "doubtful",
    "NO_IMPROVEMENT": "doubtful",
    "NOT_IDENTIFIABLE": "doubtful",
    "MODEL_MISMATCH": "bad",
    "DATA_REJECTED": "bad",
}
"""Class in the style sheet of each verdict's colour."""
TO_DO = {
    "CALIBRATED": "use the model, within the intervals of its values: madoc export writes it for other tools",
    "USABLE": "use the calibrated model in MuJoCo as it is, and do not take its values for the machine's own; better, "
    "find what the model lacks, put it into the spec and calibrate again",
    "NO_IMPROVEMENT": "do what the verdict says; else give it a larger budget (--budget), or try another "
    "method (--method)",
    "NOT_IDENTIFIABLE": "do what the verdict says; else log motion that moves these parameters, or calibrate "
    "fewer of them",
    "MODEL_MISMATCH": "do not use these values; find what the verdict describes, on the machine or in the "
    "spec and the log; where it gives a line for the spec, add that line; then calibrate again",
    "DATA_REJECTED": "check the order of the rows, and which columns of the log the spec reads",
}
"""What to do first after each verdict of a search that has converged, where all was tested."""
_RESUME = "resume the search with a larger budget (--resume, --budget)"
_TEST = "first give it a larger budget (--budget) or a longer log: not all was tested that the model may lack"


def to_do(result: CalibrationResult) -> str:
    """What to do first after a verdict; of one without a verdict nothing."""
    if result.verdict is None:
        return ""
    whole, holdout = TO_DO[result.verdict.word], result.holdout
    first, better, then = whole.partition("; better, ")
    if then and result.status != "converged":
        return f"{first}{better}{_RESUME}"
    if then and holdout is not None and (not holdout.tested or holdout.open_in_time):
        return f"{first}{better}{_TEST}"
    return whole


_METRIC_WORDS = {
    "residual": "residual; 1 is what a signal usually changes in a step",
    "moved": "largest move of an estimate, in tolerances; a stage of the search ends below 1",
    "accuracy_sa": "from (s, a)",
    "accuracy_sas": "from (s, a, s′)",
    "discriminator_loss_sa": "from (s, a)",
    "discriminator_loss_sas": "from (s, a, s′)",
}
"""Words for metrics whose name would say less."""


def metric_title(name: str) -> str:
    """A metric's name in words."""
    return _METRIC_WORDS.get(name, name.replace("_", " "))


def unit_words(unit: str) -> str:
    """A unit, and nothing for that of a ratio."""
    return "" if unit == "1" else unit


def number(value: float | None, digits: int = 4) -> str:
    """A value with this many significant digits; powers of ten only where it is very large or small."""
    if value is None or not math.isfinite(value):
        return "–"
    size = abs(value)
    if size and (size < 1e-4 or size >= 1e7):
        mantissa, _, exponent = f"{value:.{max(digits - 2, 0)}e}".partition("e")
        power = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{mantissa}·10{power}".replace("-", "−")
    if size >= 10 ** (digits - 1):
        return count(value)
    return f"{value:.{digits}g}".replace("-", "−")


def with_error(value: float, error: float) -> str:
    """A value with its standard error, which has two digits, and as many decimals; without one where the error is 0."""
    if not error or not math.isfinite(error) or not math.isfinite(value):
        return number(value, 3)
    size = abs(value) or error
    digits = math.floor(math.log10(size)) - math.floor(math.log10(error)) + 2
    return f"{number(value, max(2, digits))} ± {number(error, 2)}"


def percent(share: float) -> str:
    """A share of 1 in percent."""
    return f"{number(100 * share, 3)} %"


def count(value: float) -> str:
    """A whole number with a space between thousands."""
    return f"{value:,.0f}".replace(",", " ").replace("-", "−")


def duration(seconds: float) -> str:
    """`0.8 s`, `42 s`, `3 min 5 s`, `2 h 10 min`."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def memory(size: int) -> str:
    """Bytes as `512 MB` (of 10⁶ bytes) or `1.24 GB`."""
    megabytes = round(size / 1e6)
    return f"{megabytes} MB" if megabytes < 1000 else f"{size / 1e9:.2f} GB"


def interval_words(ends: Sequence[float]) -> str:
    """An interval by its ends, or by its half-width where the ends agree in four digits."""
    low, high = (number(end) for end in ends)
    return f"{low} to {high}" if low != high else f"± {number((ends[1] - ends[0]) / 2, 2)}"


def spread(row: ParameterEstimate) -> tuple[float, float]:
    """Ends of the 95 % interval of an estimate; without one, of one standard deviation to either side."""
    low, high = row.interval or (row.estimate - row.std, row.estimate + row.std)
    return low, high


def spread_words(row: ParameterEstimate) -> str:
    """The 95 % interval of an estimate; without one, its standard deviation."""
    return interval_words(row.interval) if row.interval else f"± {number(row.std, 2)}"


def place(value: float, low: float, high: float) -> float:
    """Where a value stands between two ends, in %; a value beyond an end stands at the end."""
    return round(min(max((value - low) / (high - low), 0.0), 1.0) * 100, 3)
