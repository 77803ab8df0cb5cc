"""A mistake in a suite file is one sentence with its line, and nothing is started."""

import shutil

import pytest

from madoc.commands.main import main
from robots import CELL

GRID = CELL + "    grid:\n"


HOPPER = "  - record: {name: hopper-medium}\n"
ROBOTS = CELL.replace("data: log.npz", "robots: {}").replace("{windows: 4}", "{{windows: 4}}")
REWARDED = CELL.replace("spring.yaml", "rewarded.yaml")


def changed(old, new):
    assert old in CELL
    return CELL.replace(old, new)


@pytest.mark.parametrize(
    ("text", "line", "sentence"),
    [
        (changed("least-squares", "least-square"), 5, "did you mean least-squares?"),
        (changed("log.npz", "logs.npz"), 4, "there is no file or folder"),
        (CELL + CELL, 8, "two cells ask for exactly the same: this one and one on line 3"),
        (GRID + "      seed: 0..\n", 9, "the range 0.. of seed has no end; write both, as 0..4"),
        (changed("spring.yaml", "sping.yaml"), 3, "expected the spec file of a robot"),
        (changed("budget: 400", "budget: many"), 6, "expected a budget such as 300000, 300s, 15min or 2h, got 'many'"),
        (changed("budget: 400", "seed: two"), 6, "expected a whole number in seed, got 'two'"),
        (changed("budget: 400", "budget: 0"), 6, "at least 1 control step, got 0"),
        (changed("budget", "budgt"), 6, "unknown key 'budgt'; nearest: budget"),
        (changed("windows", "windws"), 7, "did you mean windows?"),
        (CELL + "    parameters: [body_mass.cat]\n", 8, "unknown parameter of spring.yaml 'body_mass.cat'"),
        (CELL + "    parameters: []\n", 8, "expected the names of parameters to calibrate, got none"),
        (HOPPER + "    parameters: [gravity, gravity]\n", 4, "the parameter gravity is named twice; keep one"),
        (changed("windows: 4", "windows: 2024-05-01"), 7, "windows of least-squares"),
        (changed("400", "2024-05-01"), 6, "expected a budget such as 300000, 300s, 15min or 2h, got '2024-05-01'"),
        (ROBOTS.format("a**b/*"), 4, "a**b/*"),
        (GRID + "      robots: [log.npz, other.npz]\n", 9, "robots: stands beside grid:, not in it"),
        (GRID + "      grid: {seed: 0..2}\n", 9, "grid: stands beside grid:, not in it"),
        (CELL + "    seed: 0..3\n", 8, "in seed, got '0..3'; ranges and lists of values go under grid:"),
        (CELL + "    seed: [0, 1]\n", 8, "in seed, got [0, 1]; ranges and lists of values go under grid:"),
        (HOPPER + "    learn: [sac, bc]\n", 4, "got ['sac', 'bc']; ranges and lists of values go under grid:"),
        (changed("log.npz", ""), 4, "expected a path or a list of paths in data, got nothing"),
        (changed("log.npz", "{a: 1}"), 4, "expected a path or a list of paths in data, got keys and values"),
        (CELL + "    parameters: 3\n", 8, "expected a name or a list of names in parameters, got 3"),
        (ROBOTS.format("[log.npz, same/log.npz]"), 3, "within this entry; the logs of log.npz and same are equal"),
        (GRID + f"      seed: 0..{'9' * 5000}\n", 9, "expected a list of values or a range as 0..4 for seed"),
        (GRID + "      seed: []\n", 9, "at least one value for seed, got an empty list"),
        (GRID + "      seed: 3..1\n", 9, "ends before it begins"),
        (GRID + "      budget: [400, 500]\n", 9, "budget is given here and again outside of grid"),
        (GRID + "      holdout: [0.2, 1.5]\n", 9, "share of the rows to hold out between 0 and 1, got 1.5"),
        (CELL + "    truth: truth.json\n", 8, "could not read"),
        (CELL + "    learn: {method: sca}\n", 8, "unknown method 'sca'"),
        (CELL + "    learn: {method: bc}\n", 8, "reward"),
        (HOPPER + "    learn: {method: bc, budget: 0}\n", 4, "expected a budget of at least 1 update, got 0"),
        (CELL + "    evaluate: 3\n", 8, "evaluate: belongs to learn:"),
        (CELL + "    robots: [log.npz, other.npz]\n", 8, "robots: and data: both name logs"),
        (CELL.replace("    data: log.npz\n", "    robots: arm-*\n"), 4, "there is no file or folder arm-*"),
        (CELL + "    format: tape\n", 8, "unknown format 'tape'"),
        (CELL + "    max_transitions: 0\n", 8, "expected max_transitions of 1 or more, got 0"),
        (changed("log.npz", "''"), 4, "expected the log after --data, got nothing"),
        (CELL + "    truth: strange.json\n", 8, "unknown parameter of spring in the truth 'gravty'"),
        (HOPPER + "    learn: sac\n    evaluate: {draws: 0}\n", 5, "at least 1 draw, got 0"),
        (HOPPER + "    learn: sac\n    evaluate: {truth: strange.json}\n", 5, "'gravty'; did you mean gravity?"),
        (HOPPER + "    learn: {method: sac, truth: strange.json}\n", 4, "'gravty'; did you mean gravity?"),
        (
            HOPPER + "    learn: {method: sac, share: 0.5}\n",
            4,
            "are of at: distribution and would change nothing at calibrated",
        ),
        (
            HOPPER + "    learn: {method: sac,\n      width: 2}\n",
            5,
            "are of at: distribution and would change nothing at calibrated",
        ),
        (HOPPER + "    hide_velocities: true\n    learn: h2o\n", 5, "h2o learns from whole observations"),
        (HOPPER.replace("}", ", hide_velocities: true}") + "    learn: h2o\n", 4, "h2o learns from whole observations"),
        (HOPPER.replace("}", ", friction: -1}"), 3, "friction as a positive multiple of the model's, got -1"),
        (HOPPER + "    task: ant\n", 3, "hopper-medium is a recording of hopper, and task: another"),
        ("  - {task: hopper, data: a.hdf5, learn: {method: sac, at: truth}}\n", 3, "the true parameters are not known"),
        (REWARDED + "    learn: {method: rlpd}\n", 8, "no log has the goals of spring: wanted"),
        ("  - {record: hopper-mdium}\n", 3, "did you mean medium?"),
        ("madoc: 1\ncells: []\n", 2, "at least 1 item"),
        ("madoc: 2\ncells: []\n", 1, "expected 1 in madoc, got 2"),
        ("madoc: 1\ncells: *all\n", 2, "anchors and aliases"),
        ("", None, "suite.yaml is empty"),
    ],
)
def test_a_mistake_is_one_sentence_with_its_line(suite, place, capsys, text, line, sentence):
    (place / "strange.json").write_text('{"gravty": -9.81}')
    (place / "a.hdf5").write_bytes(b"")
    (place / "same").mkdir()
    shutil.copy(place / "log.npz", place / "same" / "log.npz")
    goals = 'reward: -abs(place)\ngoals: [{name: wanted, drawn: "uniform(-1, 1)"}]\n'
    (place / "rewarded.yaml").write_text((place / "spring.yaml").read_text() + goals)
    assert main(["suite", str(suite(text)), "--out", str(place / "out")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("madoc: suite.yaml" if line is None else f"madoc: suite.yaml, line {line}: ")
    assert sentence in err
    assert not (place / "out").exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("--workers -1", "at least 1 worker"),
        ("--workers 0 --executor ray", "at least 1 worker"),
        ("--address auto", "add --executor ray"),
        ("--executor ray --address auto --workers 2", "--workers is of a cluster that madoc starts"),
        ("--dry-run --report", "choose one"),
        ("--parquet", "add --report"),
    ],
)
def test_options_that_do_not_go_together(suite, place, capsys, options, sentence):
    assert main(["suite", str(suite(CELL)), "--out", str(place / "out"), *options.split()]) == 2
    assert sentence in capsys.readouterr().err
    assert not (place / "out").exists()
