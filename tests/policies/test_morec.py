"""MOREC's hyperparameters: combinations that would not do what they say are refused."""

import pytest

from madoc.errors import MadocError
from madoc.policies import LEARNERS


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"models": 3, "elites": 4}, "expected at least as many models as elites, 4, got 3"),
        (
            {"discriminator_updates": 3999},
            "expected at least 4000 discriminator_updates for 10 discriminators, got 3999",
        ),
        ({"discriminator_every": 1, "discriminator_updates": 999}, "expected at least 1000 discriminator_updates"),
    ],
)
def test_combinations_that_would_not_do_what_they_say_are_refused(options, message):
    with pytest.raises(MadocError, match=message):
        LEARNERS["morec"].make(**options)


def test_no_discriminator_needs_to_be_trained():
    assert LEARNERS["morec"].make(discriminator_updates=0).discriminator_updates == 0
