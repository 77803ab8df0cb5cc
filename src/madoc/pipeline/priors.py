"""What a candidate of `auto` leaves to those after it: the estimate of least squares as their prior."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from madoc.calibration import CalibrationResult, Prior
from madoc.pipeline.folders import holds_run
from madoc.runs.files import read_json
from madoc.verdict import Assessment
from madoc.verdict.judge import beats_mid_range

FIRST = "least-squares"
"""The candidate whose estimate is the prior of later ones."""


def prior_for(place: Path, tried: Mapping[str, tuple[CalibrationResult, Assessment]]) -> Prior | None:
    """The prior of the candidate in the folder `place`: what a run there has begun at, else what the first one leaves.

    There is none before least squares has settled at an estimate that predicts the hold-out better than mid-range.
    """
    if holds_run(place):
        stored = read_json(place / "spec.json").get("prior")
        return Prior(np.array(stored["mean"]), np.array(stored["std"]), stored["origin"]) if stored else None
    if FIRST not in tried:
        return None
    result, assessment = tried[FIRST]
    useful = result.settled and beats_mid_range(assessment.holdout)
    return result.as_prior("the estimate of least squares") if useful else None


def stored(prior: Prior | None) -> dict[str, object]:
    """What the `spec.json` of a run keeps of its prior."""
    if prior is None:
        return {}
    return {"prior": {"origin": prior.origin, "mean": prior.mean.tolist(), "std": prior.std.tolist()}}
