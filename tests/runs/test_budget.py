"""Budgets as people write them."""

import pytest

from madoc.errors import MadocError
from madoc.runs.budget import Seconds, read_budget


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


@pytest.mark.parametrize("written", ["soon", "3 days", "1.5", "0s", 0, "1.2.3s", Seconds(-1.0)])
def test_what_is_no_budget_is_refused(written):
    with pytest.raises(MadocError, match="expected a budget"):
        read_budget(written)


@pytest.mark.parametrize(("spent", "left"), [(0.0, 80.0), (10.0, 70.0), (100.0, 24.0)])
def test_a_search_gets_two_thirds_of_a_time_with_what_is_spent_before_it(spent, left):
    assert Seconds(120.0).for_search(spent).seconds == pytest.approx(left)
    assert Seconds(80.0).with_judging.seconds == pytest.approx(120.0)  # what a command takes whose search gets 80 s
    assert Seconds(120.0).until_judged.seconds == pytest.approx(114.0)  # a film follows
