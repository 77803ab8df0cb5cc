import shutil

import pytest

from madoc.pipeline.orders import CalibrationOrder, EvaluationOrder, PolicyOrder, RecordOrder
from madoc.suites import checks
from madoc.suites.cells import keys_of, read_plans, write_plan
from madoc.suites.planning import plan_of
from robots import CELL


def names(path):
    return [cell.name for cell in plan_of(path).cells]


def test_a_grid_is_every_combination_and_the_last_key_changes_fastest(suite):
    text = CELL.replace("    budget: 400\n", "") + "    grid: {budget: [400, 500], seed: 0..2}\n"
    orders = [cell.read() for cell in plan_of(suite(text)).cells]
    assert [(order.search.budget, order.search.seed) for order in orders] == [
        *((400, 0), (400, 1), (400, 2)),
        *((500, 0), (500, 1), (500, 2)),
    ]
    assert {order.search.set for order in orders} == {(("windows=4",),)}


def test_more_seeds_repeat_nothing_and_a_changed_setting_is_another_cell(suite):
    few = names(suite(CELL + "    grid: {seed: [0, 1]}\n"))
    assert names(suite(CELL + "    grid: {seed: 0..3}\n"))[:2] == few
    changed = names(suite(CELL.replace("windows: 4", "windows: 5") + "    grid: {seed: [0, 1]}\n"))
    assert not set(changed) & set(few)


def test_a_default_that_is_written_out_is_the_same_cell(suite):
    assert names(suite(CELL + "    seed: 0\n    level: normal\n")) == names(suite(CELL))


def test_a_cell_is_named_by_what_its_files_hold_and_not_by_where_they_are(suite, place):
    (before,) = names(suite(CELL))
    moved = place / "elsewhere"
    shutil.copytree(place, moved, ignore=lambda *_: ["elsewhere"])
    assert names(moved / "suite.yaml") == [before]
    shutil.copy(place / "other.npz", moved / "log.npz")  # another log under the same name
    # What was read is remembered for as long as a process plans: a file does not change while it does.
    checks.content_of_file.cache_clear()
    checks.content_of_log.cache_clear()
    assert names(moved / "suite.yaml") != [before]


def test_files_that_are_not_read_make_no_other_cell(suite, place):
    (place / "logs").mkdir()
    (place / "log.npz").rename(place / "logs" / "log.npz")
    text = CELL.replace("log.npz", "logs")
    (before,) = names(suite(text))
    for name in (".DS_Store", "README.md", "notes.txt", ".trash/log.npz", "out/plans/suite.jsonl", "out/suite.csv"):
        (place / "logs" / name).parent.mkdir(exist_ok=True, parents=True)
        (place / "logs" / name).write_text("not a log")
    (place / "logs" / "out" / "cells").mkdir()
    checks.content_of_log.cache_clear()
    assert names(suite(text)) == [before]
    shutil.copy(place / "other.npz", place / "logs" / "other.npz")
    checks.content_of_log.cache_clear()
    assert names(suite(text)) != [before]


def test_hidden_files_of_a_folder_are_no_part_of_a_log_of_madocs_robots(tmp_path):
    (tmp_path / "data.hdf5").write_bytes(b"1")
    before = checks.content_of_log(str(tmp_path), own=False)
    (tmp_path / ".DS_Store").write_bytes(b"2")
    checks.content_of_log.cache_clear()
    assert checks.content_of_log(str(tmp_path), own=False) == before


def test_a_folder_whose_name_is_a_date_is_a_folder(suite, place):
    (place / "log.npz").rename(place / "2024-05-01")
    (cell,) = plan_of(suite(CELL.replace("log.npz", "2024-05-01"))).cells
    assert cell.read().source.paths == (str(place / "2024-05-01"),)


def test_stages_that_several_cells_need_are_there_once(suite):
    text = "  - record: {name: hopper-medium, transitions: 1000}\n    budget: 900\n    evaluate: 2\n"
    text += "    grid: {learn: [{method: bc, budget: 10}, {method: sac, budget: 500, at: truth}], seed: 0..1}\n"
    cells = plan_of(suite(text)).cells
    kinds = [cell.kind for cell in cells]
    assert {kind: kinds.count(kind) for kind in kinds} == {"record": 1, "calibrate": 2, "learn": 4, "evaluate": 4}
    assert [cell.kind for cell in cells if cell.wanted] == ["evaluate"] * 4
    by_name = {cell.name: position for position, cell in enumerate(cells)}
    assert all(by_name[cell.needs] < by_name[cell.name] for cell in cells if cell.needs)
    assert {cell.read().seed for cell in cells if cell.kind == "learn"} == {0, 1}  # that of the calibration
    assert all(checks.name_of(cell.kind, cell.read(), cell.needs) == cell.name for cell in cells)


def test_robots_are_named_by_what_tells_their_paths_apart(suite, place):
    for number in (1, 2):
        (place / "fleet" / f"arm-{number}").mkdir(parents=True)
        shutil.copy(place / ("log.npz", "other.npz")[number - 1], place / "fleet" / f"arm-{number}" / "log.npz")
    (place / "fleet" / ".DS_Store").write_text("not a robot")
    folders = plan_of(suite(CELL.replace("data: log.npz", "robots: fleet/*"))).cells
    assert [cell.robot for cell in folders] == ["arm-1", "arm-2"]
    cells = plan_of(suite(CELL.replace("data: log.npz", "robots: fleet/*/log.npz"))).cells
    assert [cell.robot for cell in cells] == ["arm-1", "arm-2"]
    assert all(cell.read().source.paths[0].endswith(f"{cell.robot}/log.npz") for cell in cells)


def test_a_plan_comes_back_from_its_file(suite, place):
    plan = plan_of(suite(CELL + "    grid: {seed: 0..4}\n"))
    write_plan(place / "out", plan.name, plan.cells)
    write_plan(place / "out", "same", plan.cells)
    assert read_plans(place / "out") == list(plan.cells)


@pytest.mark.parametrize("order", [CalibrationOrder, RecordOrder, PolicyOrder, EvaluationOrder])
def test_every_option_of_an_order_has_one_key(order):
    keys = keys_of(order)
    assert len(set(keys.values())) == len(keys)
    assert all(key == key.lower() and "-" not in key for key in keys)


def test_keys_are_the_names_of_the_command_line():
    assert {"data", "hide_velocities", "shuffle", "max_transitions", "set"} <= set(keys_of(CalibrationOrder))
