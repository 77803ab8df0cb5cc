"""Is an estimate to be trusted: judged on rows that no method has seen, without any truth."""

from madoc.calibration.holdout import Fitted, HoldOut, Predicted, ToldApart, Verdict, Word
from madoc.verdict.assessment import Assessment, assess
from madoc.verdict.bench import Bench
from madoc.verdict.judge import judge

__all__ = [
    "Assessment",
    "Bench",
    "Fitted",
    "HoldOut",
    "Predicted",
    "ToldApart",
    "Verdict",
    "Word",
    "assess",
    "judge",
]
