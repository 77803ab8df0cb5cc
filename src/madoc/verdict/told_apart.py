"""The hold-out compared with rollouts under a cloned policy: where no state can be rebuilt."""

import numpy as np
from jaxtyping import Float

from madoc.calibration.holdout import ToldApart
from madoc.identification.noise import difference_noise
from madoc.verdict.bench import Bench, common_fields


def told_apart(bench: Bench, unit: Float[np.ndarray, " d"], interval: Float[np.ndarray, "d 2"] | None) -> ToldApart:
    """How well a classifier tells the simulator's rows from those held out.

    Args:
        bench: The hold-out.
        unit: The estimate in [-1, 1].
        interval: Its 95 % intervals in physical units, if known.
    """
    noise = difference_noise(bench.problem.dataset) / bench.change
    return ToldApart(
        area_at_mid_range=bench.mid_range_apart,
        area_at_estimate=bench.rollouts_apart(unit),
        **common_fields(bench, unit, interval, at=unit, residual=noise, by_model=(), noise=noise, control_steps=0),
    )
