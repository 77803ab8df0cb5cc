"""Problems planted in a log or a model, and what `check` says of them."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from logged_arm import SPEC, TRUTH, arm_of, columns_of, write_csv

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.data import logs
from madoc.data.findings import Finding
from madoc.diagnosis import check, refuse_fatal
from madoc.diagnosis.diagnosis import _inexact_states_finding
from madoc.diagnosis.excitation import excite
from madoc.errors import MadocError
from madoc.identification.states import LoggedStates, states_of
from madoc.simulation.response import refuse_insensitive
from robots import ARM, counted

ROWS = 300


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm_of(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def columns(robot):
    return columns_of(robot, ROWS)


@pytest.fixture
def checked(tmp_path):
    """The findings of a log of a robot, as (level, where, what)."""

    def run(robot, columns):
        dataset = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
        found = check(dataset, simulation.make(robot.task, threads=1), robot=robot)
        return found, [(finding.level, finding.where, finding.what) for finding in found.findings]

    return run


def test_a_good_log_has_nothing_to_warn_of(robot, columns, checked):
    found, findings = checked(robot, columns)
    assert [level for level, _, _ in findings] == ["note"]
    assert findings[0][1] == "scale"
    assert not found.fatal
    assert (found.rows, found.runs, found.episodes, found.control_step) == (ROWS - 1, 1, 1, 0.02)
    shoulder = found.channels[0]
    assert (shoulder.low, shoulder.high) == (columns["shoulder"].min(), columns["shoulder"].max())
    assert (found.explanation.overall[found.explanation.best] < 0.5).all()
    assert (found.excitation.effect > 10).all()
    assert (found.excitation.half_width < 0.01).all()


def test_without_intervals_a_check_finds_the_same_in_fewer_steps(robot, columns, checked, tmp_path):
    whole, _ = checked(robot, columns)
    dataset = logs.read(write_csv(tmp_path / "again.csv", columns), robot)
    simulator = simulation.make(robot.task, threads=1)
    short = check(dataset, simulator, robot=robot, intervals=False)
    assert short.findings == whole.findings
    given, start = (dataset, simulator, states_of(dataset, simulator)), whole.explanation.draws[whole.explanation.best]
    of_short, of_whole = (
        counted(excite, *given, start=start, key=jax.random.key(0), intervals=wanted)[1] for wanted in (False, True)
    )
    assert of_short < 0.8 * of_whole
    assert short.control_steps < whole.control_steps


def test_a_dead_signal_and_a_dead_action(robot, columns, checked):
    still = columns | {"elbow": np.full(ROWS, 0.3), "elbow_torque": np.full(ROWS, 0.1)}
    _, findings = checked(robot, still)
    assert ("warning", "elbow", f"it never moves: 0.3 in all {ROWS - 1} rows") in findings
    assert ("warning", "elbow_torque", f"it never moves: 0.1 in all {ROWS - 1} rows") in findings


def test_no_signal_moves(robot, columns, checked):
    still = {name: values if "torque" in name or name == "time" else np.zeros(ROWS) for name, values in columns.items()}
    found, findings = checked(robot, still)
    assert found.fatal
    assert findings[0] == ("fatal", "shoulder", f"it never moves: 0 in all {ROWS - 1} rows")
    assert found.explanation is None
    with pytest.raises(MadocError, match=r"the data is refused: shoulder: it never moves.*\(and 3 more"):
        refuse_fatal(found.findings)


def test_an_encoder_whose_steps_are_larger_than_the_motion(robot, columns, checked):
    """100 counts a turn; the shoulder moves by a few hundredths of a radian in a row."""
    step = 2.0 * np.pi / 100.0
    found, findings = checked(robot, columns | {"shoulder": step * np.round(columns["shoulder"] / step)})
    assert abs(found.channels[0].resolution - step) < 1e-12
    assert found.channels[1].resolution == 0.0
    (what,) = [what for level, where, what in findings if where == "shoulder" and "steps" in what]
    assert what.startswith("it is read in steps of 0.0628 rad, 100 a turn, and changes by 0.0")


def test_an_action_at_its_limits(robot, columns, checked):
    torque = np.where(np.arange(ROWS) % 4 == 0, 0.5, columns["shoulder_torque"])
    _, findings = checked(robot, columns | {"shoulder_torque": torque})
    assert ("warning", "shoulder_torque", "it stands at an end of its range in 25 % of the rows") in findings


def test_an_action_that_hardly_uses_its_range(robot, columns, checked):
    _, findings = checked(robot, columns | {"shoulder_torque": columns["shoulder_torque"] / 1000.0})
    assert any(where == "shoulder_torque" and "% of its range" in what for _, where, what in findings)


@pytest.mark.parametrize(
    ("column", "factor", "words"),
    [
        ("shoulder", 180.0 / np.pi, "it changes 57.3 times as fast as shoulder_speed says: one in degrees"),
        (
            "shoulder_speed",
            -1.0,
            "it changes -1 times as fast as shoulder_speed says: one of them",
        ),
    ],
)
def test_units_and_signs_that_contradict_each_other(robot, columns, checked, column, factor, words):
    _, findings = checked(robot, columns | {column: factor * columns[column]})
    assert any(level == "warning" and where == "shoulder" and words in what for level, where, what in findings)


def test_an_angle_that_wraps(robot, columns, checked):
    wrapped = np.where(columns["shoulder"] > 0.1, columns["shoulder"] - 2 * np.pi, columns["shoulder"])
    _, findings = checked(robot, columns | {"shoulder": wrapped})
    jumps = int((np.abs(np.diff(wrapped)) > np.pi).sum())
    assert ("note", "log.csv", f"column 'shoulder' jumps by a whole turn in {jumps} rows: it was unwrapped") in findings


def test_a_reversed_action(robot, columns, checked):
    _, findings = checked(robot, columns | {"shoulder_torque": -columns["shoulder_torque"]})
    about = [what for _, where, what in findings if where == "shoulder_torque"]
    assert about == ["it accelerates shoulder the other way than in the model"]


@pytest.mark.parametrize(
    ("shift", "place", "words"),
    [
        (1, "actions", "take effect a row before they are logged"),
        (-1, "elbow_torque", "the acceleration of elbow follows it 0.0"),
    ],
)
def test_actions_logged_a_row_off(robot, columns, checked, shift, place, words):
    shifted = {name: np.roll(columns[name], shift) for name in ("shoulder_torque", "elbow_torque")}
    _, findings = checked(robot, columns | shifted)
    assert any(where == place and words in what for _, where, what in findings)


def test_a_parameter_that_changes_nothing(columns, checked, tmp_path):
    robot = arm_of(tmp_path, SPEC + "  - {field: geom_friction, element: fore, low: 0.1, high: 2}\n")
    found, findings = checked(robot, columns)
    assert found.fatal
    assert findings[0][:2] == ("fatal", "geom_friction.fore")
    assert "it changes nothing that is seen" in findings[0][2]


def test_two_masses_on_one_rigid_body_cannot_be_told_apart(columns, checked, tmp_path):
    load = '<body name="load" pos="0 0 -.4"><inertial pos="0 0 0" mass="0.1" diaginertia="1e-6 1e-6 1e-6"/></body>'
    twin = load.replace('"load"', '"twin"')
    end = '<geom name="fore"'
    model = ARM.replace(end, load + twin + end)
    spec = SPEC + "  - {field: body_mass, element: load, low: 0, high: 0.5}\n"
    robot = arm_of(tmp_path, spec + "  - {field: body_mass, element: twin, low: 0, high: 0.5}\n", model=model)
    truth = np.array([1.5, 0.4, 0.3, 0.35, 0.2, 0.1])
    found, findings = checked(robot, columns_of(robot, ROWS, truth=truth))
    assert not found.fatal
    assert any(
        level == "warning" and where == "parameters" and "body_mass.load" in what and "body_mass.twin" in what
        for level, where, what in findings
    )


def test_a_log_that_excites_nothing(robot, columns, checked):
    """At rest but for noise: no parameter moves what is seen by more than that."""
    noise = 1e-3 * np.asarray(jax.random.normal(jax.random.key(1), (4, ROWS)), np.float64)
    names = ("shoulder", "elbow", "shoulder_speed", "elbow_speed")
    still = columns | dict(zip(names, noise, strict=True))
    still |= {"shoulder_torque": noise[0], "elbow_torque": np.abs(noise[1])}
    _, findings = checked(robot, still)
    assert any(where == "dof_damping.shoulder" or "dof_damping.shoulder" in what for _, where, what in findings)


def test_a_wrong_model(columns, checked, tmp_path):
    """Gravity upside down: no draw tells the speeds better than "nothing changes" does."""
    robot = arm_of(tmp_path, model=ARM.replace("0 0 -9.81", "0 0 39.81"))
    found, findings = checked(robot, columns)
    assert found.fatal
    level, where, what = findings[0]
    assert (level, where) == ("fatal", "the model")
    assert "shoulder_speed, elbow_speed 1, 5 or 20 rows ahead better than 'nothing changes' does" in what


def test_hidden_speeds_are_told_and_intervals_still_expected(robot, columns, checked, tmp_path):
    spec = "\n".join(line for line in SPEC.splitlines() if "velocity" not in line) + "\n"
    found, findings = checked(arm_of(tmp_path, spec), columns)
    (note,) = [finding for finding in findings if finding[1] == "signals"]
    assert note[0] == "note"
    assert "states cannot be rebuilt from the log" in note[2]
    assert "): least-squares estimates them from what is logged; this check did not compare the model" in note[2]
    assert found.explanation is None
    assert (found.excitation.half_width < 0.1 * (robot.task.parameters.high - robot.task.parameters.low)).all()


def test_a_base_that_the_floor_tells_is_said_to_stand_there():
    nothing = np.zeros(2, bool)
    logged = LoggedStates("approximate", np.zeros((1, 2)), np.zeros(1, int), "no z", 2, 1, np.ones(2, bool), nothing)
    assert (
        ", and its base stands on the floor by its attitude; this check" in _inexact_states_finding(logged, None).what
    )
    unknown = _inexact_states_finding(replace(logged, kind="unknown"), None).sentence
    assert "floor" not in unknown and unknown.endswith("log the position and the velocity of every joint")


def test_few_rows(robot, columns, checked):
    _, findings = checked(robot, {name: values[:20] for name, values in columns.items()})
    assert any(level == "warning" and what == "only 19 rows" for level, _, what in findings)
    found, _ = checked(robot, {name: values[:3] for name, values in columns.items()})
    assert found.fatal


def test_what_reading_told_is_among_the_findings(robot, columns, checked):
    late = columns | {"time": columns["time"] + 1.0 * (np.arange(ROWS) >= 100)}
    found, findings = checked(robot, late)
    assert found.episodes == 2
    assert any(
        level == "warning" and where == "log.csv" and "the run is cut there" in what for level, where, what in findings
    )


def test_half_widths_shrink_with_the_log(robot, tmp_path):
    """Four times as many noisy runs: half the width, give or take."""
    widths = []
    simulator = simulation.make(robot.task, threads=1)
    for runs in (2, 8):
        for run in range(runs):
            columns = columns_of(robot, 150, seed=run)
            noise = 1e-3 * np.asarray(jax.random.normal(jax.random.key(run), (4, 150)), np.float64)
            for name, part in zip(("shoulder", "elbow", "shoulder_speed", "elbow_speed"), noise, strict=True):
                columns[name] = columns[name] + part
            write_csv(tmp_path / str(runs) / f"{run}.csv", columns)
        dataset = logs.read(tmp_path / str(runs), robot)
        start, key = simulator.parameters.to_unit(TRUTH), jax.random.key(0)
        found = excite(dataset, simulator, states_of(dataset, simulator), start=start, key=key)
        widths.append(found.half_width)
    ratio = widths[1] / widths[0]
    assert ((ratio > 0.3) & (ratio < 0.8)).all()


def test_findings_go_with_a_calibration(robot, columns, tmp_path):
    dataset = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
    simulator = simulation.make(robot.task, threads=1)
    found = check(dataset, simulator, robot=robot).findings
    assert CalibrationProblem(dataset, simulator).doubts == ()
    told = replace(
        dataset, findings=(*found, Finding("warning", "it squeaks", "elbow", "oil it"), Finding("note", "x"))
    )
    (scale,) = (finding.sentence for finding in found if finding.where == "scale")  # what masses rest on is kept too
    problem = CalibrationProblem(told, simulator)
    assert (problem.notes, problem.doubts) == ((scale,), ("elbow: it squeaks; oil it",))


def test_a_parameter_that_matters_only_where_the_log_was_is_not_refused(tmp_path):
    """A floor's friction is felt on the floor, and the model begins above it; velocities are hidden."""
    model = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 .1"/>
    <body name="box" pos="0 0 1">
      <joint name="along" type="slide" axis="1 0 0"/><joint name="up" type="slide" axis="0 0 1"/>
      <geom name="box" type="box" size=".1 .1 .1" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""
    spec = """\
madoc: 1
name: sledge
model: sledge.xml
control_step: 0.02
signals:
  - {name: along, reads: position(along)}
  - {name: up, reads: position(up)}
actions:
  - {name: push, joint: along, means: force, low: -20, high: 20}
parameters:
  - {field: geom_friction, element: floor, low: 0.1, high: 2}
  - {field: body_mass, element: box, low: 0.5, high: 2}
"""
    (tmp_path / "sledge.xml").write_text(model)
    (tmp_path / "sledge.yaml").write_text(spec)
    robot = robots.load(tmp_path / "sledge.yaml")
    simulator = simulation.make(robot.task, threads=1)
    system = simulator.bind(np.array([[0.5, 1.0]]))
    state, seen = simulator.initial_state[None, None].copy(), []
    state[..., 1] = -0.9  # on the floor
    push = np.repeat(np.random.default_rng(0).uniform(-1, 1, 60), 5)
    for force in push:
        seen.append(np.asarray(system.observe(state))[0, 0])
        state = system.step(state, np.array([[[force]]]))
    along, up = np.stack(seen).T
    columns = {"time": 0.02 * np.arange(300), "along": along, "up": up, "push": 20.0 * push}
    dataset = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
    assert not check(dataset, simulator, robot=robot).fatal
    probe = CalibrationProblem(dataset, simulator).probe
    assert counted(refuse_insensitive, simulator, *probe, key=jax.random.key(0))[1] > 0
