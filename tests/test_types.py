"""Methods are recognised by their class and settings."""

from dataclasses import dataclass

import pytest

from madoc.calibration import CALIBRATORS, CmaEs, Dropo, LeastSquares, Madoc
from madoc.calibration.madoc.agents import AgentSettings
from madoc.errors import MadocError
from madoc.policies import LEARNERS, SAC
from madoc.types import entry_of


@pytest.mark.parametrize(
    ("method", "name"),
    [
        (Madoc(updates=3), "madoc"),
        (Madoc(groups="one", mixing="sum"), "madoc-s"),
        (Madoc(groups="learned", updates=3), "madoc-grouped"),
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
    learners = (SAC(), SAC(cloning=1.0), SAC(cloning=0.0), SAC(cloning=1.0, randomize=True), SAC(randomize=True))
    assert [entry_of(learner, LEARNERS).name for learner in learners] == ["sac", "sac-bc", "sac-bc", "dr-bc", "dr"]


def test_a_learner_that_draws_from_the_whole_box_needs_no_parameters():
    entry = entry_of(SAC(randomize=True), LEARNERS)
    assert not entry.needs_parameters
    assert not entry.needs_data


@dataclass(frozen=True)
class Guess:
    """A method in no registry."""


def test_a_method_of_ones_own_is_named_after_its_class():
    entry = entry_of(Guess(), CALIBRATORS)
    assert (entry.name, entry.unit, entry.simulates, entry.shown) == ("Guess", "control steps", True, ())


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (lambda: Madoc(updates=0), "expected updates of Madoc to be greater than or equal to 1, got 0"),
        (lambda: Madoc(hidden=(8, 0)), "expected hidden of Madoc to be greater than or equal to 1, got 0"),
        (lambda: Madoc(groups="physics"), "expected groups of Madoc to be 'each', 'learned' or 'one', got 'physics'"),
        (lambda: Madoc(group_count=2), "group_count is of groups=learned; leave it out with groups=each"),
        (
            lambda: AgentSettings(smallest_blur=0.2, first_blur=0.1, largest_blur=3.0),
            "expected agents.smallest_blur ≤ agents.first_blur ≤ agents.largest_blur, got 0.2, 0.1 and 3.0",
        ),
        (lambda: Dropo(draws=1), "expected draws of Dropo to be greater than or equal to 2, got 1"),
        (lambda: SAC(discount=float("nan")), "expected discount of SAC to be less than or equal to 1, got nan"),
        (lambda: AgentSettings(dropout=1.0), "expected dropout of AgentSettings to be less than 1, got 1.0"),
        (
            lambda: Madoc(agents=AgentSettings(reward_size=0.0)),
            "patience waits for a smaller mismatch, which agents.reward_size=0 leaves unmeasured: set patience=0",
        ),
        (lambda: SAC(batch=1.5), "expected batch of SAC to be a valid integer, got 1.5"),
        (lambda: SAC(epoch_steps=5), "expected epoch_steps of at least the 20 environments, got 5"),
        (
            lambda: SAC(epoch_steps=39, updates_per_step=0.02),
            "expected at least one update in an epoch of 20 control steps, got updates_per_step of 0.02; raise it, "
            "or epoch_steps",
        ),
    ],
)
def test_impossible_hyperparameters_are_refused_in_one_sentence(wrong, sentence):
    with pytest.raises(MadocError, match=f"^{sentence}$"):
        wrong()
