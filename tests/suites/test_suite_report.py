"""Which cells stand together in a row of a suite's report, and what the row says."""

from madoc.suites.cells import Cell
from madoc.suites.report import _line, groups
from madoc.suites.results import COLUMNS, NOT_RUN, Result, write_csv


def chain(robot, method, seed):
    """A recording, a calibration to it, a policy and its evaluation."""
    names = [f"{what}-{robot}-{method}-{seed}" for what in ("calibrate", "learn", "evaluate")]
    recording = f"record-{robot}"
    calibration = {"task": robot, "source": {"paths": [f"{recording}/data.npz"]}, "search": {"method": method}}
    calibration["search"] |= {"seed": seed}
    return [
        Cell(recording, "record", {"name": f"{robot}-medium"}),
        Cell(names[0], "calibrate", calibration, recording),
        Cell(names[1], "learn", {"method": "sac", "seed": seed}, names[0]),
        Cell(names[2], "evaluate", {"episodes": 3}, names[1]),
    ]


def rows(cells):
    return {(row.kind, row.asks): row.seeds for row in groups([Result(cell, NOT_RUN) for cell in cells])}


def test_policies_of_other_robots_and_of_other_methods_are_rows_of_their_own():
    pairs = [(robot, method) for robot in ("ant", "hopper") for method in ("madoc", "droid")]
    cells = {cell.name: cell for pair in pairs for seed in (0, 1) for cell in chain(*pair, seed)}
    expected = {}
    for robot, method in pairs:
        calibration = f"name={robot}-medium; task={robot} method={method}"
        expected["calibrate", calibration] = 2
        expected["learn", f"{calibration}; method=sac"] = 2
        expected["evaluate", f"{calibration}; method=sac; episodes=3"] = 2
    assert rows(cells.values()) == expected


def test_logs_of_one_name_in_other_folders_are_rows_of_their_own():
    def cell(log, seed):
        order = {"task": "/robots/arm.yaml", "source": {"paths": [log]}, "search": {"seed": seed}}
        return Cell(f"{log}{seed}", "calibrate", order)

    cells = [cell(log, seed) for log in ("/a/1/log.npz", "/b/1/log.npz", "/b/2/log.npz") for seed in (0, 1)]
    shown = [(row.asks, row.seeds) for row in groups([Result(cell, NOT_RUN) for cell in cells])]
    of_log = "task=robots/arm.yaml data={}/log.npz"
    assert shown == [(of_log.format(name), 2) for name in ("1", "1", "2")]


def test_a_line_names_the_robot_once():
    order = {"task": "/robots/arm.yaml", "source": {"paths": ["/logs/arm-1"]}}
    calibration = Cell("calibration", "calibrate", order, robot="arm-1")
    policy = Cell("policy", "learn", {"method": "bc"}, "calibration", robot="arm-1")
    cells = {cell.name: cell for cell in (calibration, policy)}
    of_log = "robot=arm-1 task=robots/arm.yaml data=logs/arm-1"
    assert _line(Result(calibration, NOT_RUN), cells)["asks"] == of_log
    assert _line(Result(policy, NOT_RUN), cells)["asks"] == f"{of_log}; method=bc"


def test_no_cell_of_the_table_is_a_formula(tmp_path):
    names = list(COLUMNS)[:3]
    write_csv(tmp_path / "suite.csv", [dict(zip(names, ('=HYPERLINK("x")', "@a\u202eb", "knee"), strict=True))])
    written = (tmp_path / "suite.csv").read_text().splitlines()[1]
    assert written.startswith('"\'=HYPERLINK(""x"")",\'@a\\u202eb,knee,')
