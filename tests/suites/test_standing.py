import pytest

from madoc.suites.cells import Cell
from madoc.suites.claims import Outcome
from madoc.suites.standing import forecast


def cell(name, method="droid", budget=1000, seed=0, data="log"):
    search = {"method": method, "budget": budget, "seed": seed}
    return Cell(name, "calibrate", {"task": "arm.yaml", "source": {"paths": [data]}, "search": search})


def ended(*pairs, **options):
    known = {"status": "finished", "sentence": "", "attempts": 1, "host": "here"} | options
    return {cell.name: (cell, Outcome(seconds=seconds, **known)) for cell, seconds in pairs}


def test_nothing_is_known_before_the_first_has_ended():
    told = forecast([cell("a")], {}, workers=2)
    assert (told.seconds, told.left) == (None, 1)
    assert "not known before the first has ended" in told.sentence(2)


def test_other_seeds_take_as_long_and_workers_share_the_time():
    done = ended((cell("a"), 10.0), (cell("b", seed=1), 14.0))
    left = [cell(f"c{seed}", seed=seed) for seed in range(2, 8)]
    assert forecast(left, done, workers=2).seconds == pytest.approx(6 * 12.0 / 2)
    assert forecast(left[:1], done, workers=2).seconds == pytest.approx(12.0)


def test_a_larger_budget_takes_longer_in_proportion():
    done = ended((cell("a"), 10.0))
    assert forecast([cell("b", budget=4000)], done, workers=1).seconds == pytest.approx(40.0)


def test_the_same_order_counts_before_other_logs_and_these_before_other_budgets():
    done = ended((cell("a"), 10.0), (cell("b", data="long"), 50.0), (cell("c", budget=2000), 200.0))
    assert forecast([cell("d", seed=1)], done, workers=1).seconds == pytest.approx(10.0)
    assert forecast([cell("d", data="third")], done, workers=1).seconds == pytest.approx(30.0)


def test_the_first_cell_of_a_process_counts_only_alone():
    first = ended((cell("a"), 60.0), fresh=True)
    assert forecast([cell("c", seed=2)], first, workers=1).seconds == pytest.approx(60.0)
    both = first | ended((cell("b", seed=1), 10.0))
    assert forecast([cell("c", seed=2)], both, workers=1).seconds == pytest.approx(10.0)


def test_cells_of_a_method_that_has_not_been_seen_are_told_of():
    told = forecast([cell("b", method="oted"), cell("c", seed=1)], ended((cell("a"), 10.0)), workers=1)
    assert (told.seconds, told.unlike) == (pytest.approx(20.0), 1)
    assert "of the methods of 1 of them none has ended yet" in told.sentence(1)
