"""Is an estimate to be trusted: judged on rows that no method has seen, without any truth."""

from madoc.verdict.assessment import Assessment, assess
from madoc.verdict.bench import Bench
from madoc.verdict.judge import WORDS, Verdict, judge

__all__ = ["WORDS", "Assessment", "Bench", "Verdict", "assess", "judge"]
