"""Is an estimate to be trusted: judged on rows that no method has seen, without any truth."""

from madoc.verdict.assessment import Assessment, Bench, assess
from madoc.verdict.judge import WORDS, Verdict, judge

__all__ = ["WORDS", "Assessment", "Bench", "Verdict", "assess", "judge"]
