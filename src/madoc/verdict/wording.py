"""Numbers of a verdict in words."""

import numpy as np

from madoc.calibration.holdout import Area, PredictionErrors


def change_of(errors: PredictionErrors) -> str:
    """Errors after the most rows: at mid-range, then at the estimate."""
    before, after = errors.mid_range[-1], errors.estimate[-1]
    change = f"of what a signal changes in {in_rows(errors.stride)}"
    both = f"mid-range errs by {before.mean:.2g} and the estimate by {after.mean:.2g}"
    return f"{both} {change}, after {in_rows(after.steps)}"


def of_area(area: Area) -> str:
    """An area under the curve, with its interval."""
    low, high = area.interval
    return f"{area.area:.2f} [{low:.2f}, {high:.2f}]"


def in_rows(count: int) -> str:
    """A number of rows of a log, which are control steps of its robot."""
    return "1 row" if count == 1 else f"{count} rows"


def in_percent(share: float) -> str:
    """A share in percent, with three digits near 100; a question mark for one that is not finite."""
    return f"{100 * share:.{2 if share < 0.995 else 3}g} %" if np.isfinite(share) else "?"
