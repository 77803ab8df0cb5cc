"""The hold-out compared with rollouts under a cloned policy: where no state can be rebuilt."""

import numpy as np
from jaxtyping import Float

from madoc.calibration.holdout import ToldApart
from madoc.verdict.bench import Bench, common_fields
from madoc.verdict.identifiability import half_widths, told_shares
from madoc.verdict.noise import difference_noise
from madoc.verdict.statistics import NEGLIGIBLE


def told_apart(bench: Bench, unit: Float[np.ndarray, " d"], interval: Float[np.ndarray, "d 2"] | None) -> ToldApart:
    """How well a classifier tells the simulator's rows from those held out.

    Args:
        bench: The hold-out.
        unit: The estimate in [-1, 1].
        interval: Its 95 % intervals in physical units, if known.
    """
    space, noise = bench.simulator.parameters, difference_noise(bench.problem.dataset)
    area_at_mid_range, area_at_estimate = bench.mid_range_apart, bench.rollouts_apart(unit)
    half, spent = half_widths(bench.problem, unit, np.maximum(noise / bench.scaling.next_scale, NEGLIGIBLE))
    shares = told_shares(half, interval, space.high - space.low)
    return ToldApart(
        **common_fields(bench, unit, shares, by_model=(), noise=noise, control_steps=spent),
        area_at_mid_range=area_at_mid_range,
        area_at_estimate=area_at_estimate,
    )
