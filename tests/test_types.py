"""Methods are recognised by their class and settings."""

from dataclasses import dataclass

import pytest

from madoc.calibration import CALIBRATORS, CmaEs, Dropo, LeastSquares, Madoc
from madoc.errors import MadocError
from madoc.policies import LEARNERS, SAC
from madoc.types import Seconds, entry_of, read_budget


@pytest.mark.parametrize(
    ("method", "name"),
    [
        (Madoc(updates=3), "madoc"),
        (Madoc(groups="one", mixing="sum"), "madoc-s"),
        (Madoc(groups="each", mixing="sum"), "madoc-vdn"),
        (Madoc(features="raw"), "madoc"),
        (Madoc.paper(updates=3), "madoc-paper"),
        (LeastSquares(horizon=3), "least-squares"),
        (Dropo(entropy_weight=0.3), "e-dropo"),
        (CmaEs("distribution", "policy"), "cma-es-distribution"),
    ],
)
def test_a_calibrator_is_recognised_by_the_settings_of_its_entry(method, name):
    assert entry_of(method, CALIBRATORS).name == name


def test_a_learner_is_recognised_by_the_settings_of_its_entry():
    learners = (SAC(), SAC(cloning=1.0), SAC(cloning=0.0), SAC(cloning=1.0, randomize=True))
    assert [entry_of(learner, LEARNERS).name for learner in learners] == ["sac", "sac-bc", "sac-bc", "dr-bc"]


@dataclass(frozen=True)
class Guess:
    """A method in no registry."""


def test_a_method_of_ones_own_is_named_after_its_class():
    entry = entry_of(Guess(), CALIBRATORS)
    assert (entry.name, entry.unit, entry.simulates, entry.shown) == ("Guess", "control steps", True, ())


@pytest.mark.parametrize(
    ("written", "budget"),
    [
        (300, 300),
        ("300_000", 300_000),
        ("300s", Seconds(300.0)),
        ("0.5 min", Seconds(30.0)),
        ("2h", Seconds(7200.0)),
        (Seconds(3.0), Seconds(3.0)),
    ],
)
def test_a_budget_is_a_count_or_a_time(written, budget):
    assert read_budget(written) == budget


@pytest.mark.parametrize("written", ["soon", "3 days", "1.5", "0s", "1.2.3s", Seconds(-1.0)])
def test_what_is_no_budget_is_refused(written):
    with pytest.raises(MadocError, match="expected a budget"):
        read_budget(written)
