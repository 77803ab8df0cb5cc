"""What an export loses where it goes: errors over held-out runs with a parameter left out, rounded, drawn by itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from madoc.simulation import Simulator
from madoc.verdict.evidence import replay_errors

COMPARED = 20
"""Number of draws whose errors are compared with those of as many drawn parameter by parameter."""


@dataclass(frozen=True)
class Losses:
    """Clauses with the size of what is lost; each is empty where the run folder does not tell.

    Attributes:
        left_out: Of each parameter, where it stays what the robot's own model has: outside it, nothing.
        rounded: Where the delay is a whole number of physics steps.
        independent: Where parameters are drawn each by itself, beside whole rows of draws.
    """

    left_out: Sequence[str]
    rounded: str = ""
    independent: str = ""


def losses(
    evidence: Mapping[str, np.ndarray],
    simulator: Simulator,
    mean: Float[np.ndarray, " d"],
    own: Sequence[tuple[float, ...]],
    draws: Float[np.ndarray, "draws d"],
) -> Losses:
    """Simulate the held-out runs anew with what is lost, all from the starts of the estimate's simulation.

    `evidence` has the arrays of `verdict.evidence`, or none; `mean` is the estimate in physical units; `own` has the
    values of each parameter in the robot's own model, one for each element.
    """
    nothing = Losses([""] * len(mean))
    if "start" not in evidence:
        return nothing
    step = simulator.control_step / simulator.task.frame_skip
    delays = [row.field == "action_delay" and not row.elements for row in simulator.parameters.parameters]
    alone = np.where(np.eye(len(mean), dtype=bool), [np.mean(values) for values in own], mean)
    whole = np.where(delays, np.round(mean / step) * step, mean)
    some = draws[:COMPARED]
    apart = np.random.default_rng(0).permuted(some, axis=0)  # the same values of each parameter, in another order
    found = replay_errors(evidence, simulator, np.concatenate([mean[None], alone, whole[None], some, apart]))
    if found is None or not 0.0 < found[0] < np.inf:
        return nothing
    ratio = found / found[0]
    joint, single = (np.sqrt(np.mean(part**2)) for part in np.split(found[-2 * len(some) :], 2))
    same = [len(set(values)) == 1 for values in own]
    return Losses(
        [_clause("left out", each) if known else "" for each, known in zip(ratio[1:], same, strict=False)],
        rounded=_clause("so", ratio[1 + len(mean)]) if any(delays) else "",
        independent=f"{single / joint:.3g} times the error of whole rows over held-out runs" if joint < np.inf else "",
    )


def _clause(how: str, ratio: float) -> str:
    told = f"is {ratio:.3g} times as large" if ratio < np.inf else "has no bound, as simulations fail"
    return f"; {how}, the error over held-out runs {told}"
