"""The score test of one added term: by hand, and on a pendulum whose friction, drag or timing the model lacks."""

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.data import Disturbance, disturb, logs, typical_change
from madoc.identification import missing_terms as terms
from madoc.identification.candidate_effects import _cut_off
from madoc.identification.candidate_terms import WHOLE, Candidate
from madoc.identification.causes import DRIFT, EARLY, INTEGRATION, LATE_DRIVE, LATE_SENSOR, LOADED, ONE_RUN, WITHIN_RUNS
from madoc.identification.drifts import _between_runs, _drifts, _in_one_run
from madoc.identification.score_tests import Products
from madoc.identification.states import states_of
from madoc.identification.term_tests import TermTests
from madoc.parameters import FIELDS, Parameter, ParameterSpace
from own_robots import SPRING_SPEC, write_robot
from planted_pendulum import NOISE, SPEC, plant
from robots import SPRING_TRUTH, recorded


def scores(dataset, simulator, half_width: float = 0.01):
    point = simulator.parameters.to_unit(np.array([0.1]))
    states = states_of(dataset, simulator)
    return terms.suspicions(dataset, states, simulator, point, np.array([half_width]), typical_change(dataset)).terms


def test_a_sensor_that_reads_late(tmp_path):
    found = scores(*plant(tmp_path, filtered=0.3))
    late = {term.cause: term for term in found if term.about.group == "late"}
    term = late[f"{LATE_SENSOR} (speed)"]
    assert term.t > 5.0
    assert term.value == pytest.approx(0.3 * 0.02, rel=0.1)
    assert abs(term.shifts["dof_damping.hinge"]) > 1.0
    assert not any(cause.startswith(LATE_DRIVE) for cause in late)  # a single drive is what all drives are


@pytest.mark.parametrize(
    ("lacks", "parameter", "value"),
    [
        ({"friction": 0.05}, "dof_frictionloss.hinge", 0.05),
        ({"drag": 0.03}, "dof_drag.hinge", 0.03),
        ({"late": 1}, "action_delay", 0.02),
    ],
    ids=["friction", "drag", "delay"],
)
def test_the_missing_term_is_named_with_its_value(tmp_path, lacks, parameter, value):
    best = scores(*plant(tmp_path, **lacks))[0]
    assert best.parameter == parameter
    assert abs(best.t) > 10
    assert best.value == pytest.approx(value, rel=0.3)


@pytest.mark.slow
def test_rows_without_an_order_tell_a_missing_friction_as_well(tmp_path):
    dataset, simulator = plant(tmp_path, friction=0.01)
    loose = disturb(dataset, Disturbance(shuffled="rows"), simulator.task, jax.random.key(0))
    best = scores(loose, simulator)[0]
    assert best.parameter == "dof_frictionloss.hinge"
    assert best.t > 10
    assert best.value == pytest.approx(0.01, rel=0.2)
    honest = disturb(plant(tmp_path)[0], loose.disturbance, simulator.task, jax.random.key(0))
    assert all(abs(term.t) < 5 for term in scores(honest, simulator))


def test_actions_that_come_early_are_told_though_the_delay_is_calibrated(tmp_path):
    with_delay = SPEC + "  - {field: action_delay, low: 0, high: 0.04}\n"
    found = {}
    for late in (0, -1):
        dataset, _ = plant(tmp_path / str(late), late=late)
        (tmp_path / str(late) / "pendulum.yaml").write_text(with_delay)
        simulator = simulation.make(robots.load(tmp_path / str(late) / "pendulum.yaml").task)
        point, states = simulator.parameters.to_unit(np.array([0.1, 0.0])), states_of(dataset, simulator)
        told = terms.suspicions(dataset, states, simulator, point, np.full(2, 0.05), typical_change(dataset)).terms
        found[late] = [term for term in told if term.cause == EARLY]
    (early,) = found[-1]
    assert (early.t < -10, early.value) == (True, pytest.approx(-0.02, rel=0.5))
    assert early.shifts["action_delay"] < -1.0
    assert found[0] == []


def test_a_right_model_lacks_nothing(tmp_path):
    assert all(abs(term.t) < 5 for term in scores(*plant(tmp_path)))


def test_friction_that_puts_energy_in_is_no_candidate(tmp_path):
    friction = [term for term in scores(*plant(tmp_path)) if term.parameter == "dof_frictionloss.hinge"]
    assert all(term.value >= 0 for term in friction)


def test_a_parameter_that_changes_over_the_log_is_told_with_its_change(tmp_path):
    dataset, simulator = plant(tmp_path, damping=0.3)
    drifts = [term for term in scores(dataset, simulator) if term.cause == DRIFT]
    assert drifts[0].parameter == "dof_damping.hinge"
    assert drifts[0].value == pytest.approx(0.2, rel=0.1)  # large residuals count less, so a change comes out smaller
    assert drifts[0].t > 6.0


def test_a_log_that_is_cut_into_short_stretches_is_tested_all_the_same(tmp_path):
    dataset, simulator = plant(tmp_path, friction=0.05)
    starts = np.append(0, np.arange(80, len(dataset), 8))  # one stretch of 80 rows, all others of 8
    short = dataset.take(np.arange(len(dataset)), starts=starts)
    best = scores(short, simulator)[0]
    assert best.parameter == "dof_frictionloss.hinge"
    assert best.value == pytest.approx(0.05, abs=3.0 * best.standard_error)


def test_too_short_a_log_is_not_tested(tmp_path):
    dataset, simulator = plant(tmp_path)
    few = dataset.take(np.arange(20), starts=np.array([0]))
    point, states = np.zeros(1), states_of(few, simulator)
    assert not terms.suspicions(few, states, simulator, point, np.array([0.01]), typical_change(few)).tested


def test_a_parameter_that_alternates_from_run_to_run_is_told():
    """Its mean is the same in both halves and all thirds of the log."""
    random = np.random.default_rng(0)
    runs, slope = np.repeat(np.arange(12), 10), random.standard_normal((120, 6))
    for apart in (0.0, 0.5):
        value = apart * (-1.0) ** runs[:, None]
        products = Products.of(
            slope * value + 0.5 * random.standard_normal((120, 6)), slope[..., None], np.zeros((120, 6, 0))
        )
        space = ParameterSpace((Parameter("gravity", "", -11, -9),))
        (term,), others = _between_runs(TermTests(products, (), space, np.array([0.01]), runs))
        assert (term.cause, term.parameter) == (DRIFT, "gravity")
        assert (term.t > 5.0) == (apart > 0.0)
        assert bool(others) == (apart > 0.0)
        assert term.explained == pytest.approx(0.5 * (apart > 0.0), abs=0.1)  # the noise is as large as the change
    assert term.value == pytest.approx(0.5, rel=0.2)  # the range is 2 wide, so 0.5 in [-1, 1] is 0.5 m/s²
    assert others[0].errors["gravity"] == pytest.approx(1.96 * 0.5 * np.sqrt(1.0 + 1.0 / 11.0) / 0.01, rel=0.2)


def test_a_parameter_that_changes_within_each_run_is_told():
    """As where a drive warms up: its mean is the same in all runs and over the log."""
    random = np.random.default_rng(0)
    runs, age = np.repeat(np.arange(6), 20), np.tile(np.linspace(-1.0, 1.0, 20), 6)[:, None]
    slope, space = random.standard_normal((120, 6)), ParameterSpace((Parameter("gravity", "", -11, -9),))
    for change in (0.0, 0.3):
        # Residuals are simulated less logged: a value that is larger than the model's leaves them negative.
        residuals = -slope * change * age + 0.5 * random.standard_normal((120, 6))
        tests = TermTests(
            Products.of(residuals, slope[..., None], np.zeros((120, 6, 0))), (), space, np.array([0.01]), runs
        )
        (within,) = [term for term in _drifts(tests) if term.cause == WITHIN_RUNS]
        assert (within.t > 6.0) == (change > 0.0)
        assert all(abs(term.t) < 3.0 for term in _drifts(tests) if term.cause == DRIFT)
    assert within.value == pytest.approx(0.3, rel=0.2)
    assert within.shifts["gravity"] == pytest.approx(within.value / 0.01)


def test_a_run_that_has_another_value_than_all_others_is_named():
    """As where a tool was left on; the value is by how much it differs from the others."""
    random, names = np.random.default_rng(0), [f"{run}.csv" for run in range(6)]
    runs, slope = np.repeat(np.arange(6), 20), random.standard_normal((120, 6))
    space = ParameterSpace((Parameter("gravity", "", -11, -9),))
    for apart in (0.0, 0.6):  # where no run stands out, the t of one of six may be 0, and is a number
        residuals = -slope * apart * (runs == 4)[:, None] + 0.5 * random.standard_normal((120, 6))
        products = Products.of(residuals, slope[..., None], np.zeros((120, 6, 0)))
        (term,) = _in_one_run(TermTests(products, (), space, np.array([0.01]), runs), names)
        assert np.isfinite(term.t) and (abs(term.t) > 4.0) == (apart > 0.0)
    assert (term.cause, term.parameter) == (f"{ONE_RUN} (4.csv)", "gravity")
    assert term.value == pytest.approx(0.6, rel=0.2)
    assert not list(_in_one_run(TermTests(products, (), space, np.array([0.01]), runs % 2), names))


def test_runs_that_repeat_one_motion_agree_and_are_no_sign_of_a_change():
    random = np.random.default_rng(0)
    slope, residuals = (np.tile(random.standard_normal((8, 6)), (12, 1)) for _ in range(2))
    products = Products.of(residuals, slope[..., None], np.zeros((96, 6, 0)))
    space = ParameterSpace((Parameter("gravity", "", -11, -9),))
    tests = TermTests(products, (), space, np.array([0.01]), np.repeat(np.arange(12), 8))
    (term,), others = _between_runs(tests)
    assert (term.t, others) == (0.0, [])


@pytest.mark.parametrize(
    ("cause", "size", "counts"), [(LOADED, 0.15, True), (LOADED, 0.06, False), ("drag", 0.15, False)]
)
def test_a_force_at_a_joint_counts_where_it_is_likely(cause, size, counts):
    """Its effect is half that of the parameter, so that without it the estimate is off by half of its size."""
    random = np.random.default_rng(0)
    noise, slope, other = random.standard_normal((3, 200, 6))
    force = 0.5 * slope + other
    products = Products.of(noise - size * force, slope[..., None], force[..., None])
    space = ParameterSpace((Parameter("gravity", "", -11, -9),))
    tried = Candidate(f"{cause} (hinge)", "", "N·m", 0.0, 1.0, -np.inf, known_before=True)
    tests = TermTests(products, (tried,), space, np.array([0.01]), np.zeros(200, int))
    found = list(terms._of_forces(tests, []))
    assert len(found) == counts
    for each in found:
        value = tests.score(0).change
        assert 3.5 < tests.score(0).t < 6.5
        assert each.shifts["gravity"] == pytest.approx(-0.5 * value / 0.01, rel=0.2)


def test_a_term_that_explains_the_same_is_a_rival():
    random = np.random.default_rng(0)
    friction, unrelated = random.standard_normal((2, 200, 6))
    offset = friction + 0.1 * random.standard_normal((200, 6))
    noise, slope = random.standard_normal((2, 200, 6))
    columns = np.stack([offset, unrelated, friction], axis=-1)
    products = Products.of(0.2 * friction + noise, slope[..., None], columns)
    tried = [Candidate(cause, "", "", 0.0, 1.0, -np.inf) for cause in ("offset", "unrelated", "friction")]
    tests = TermTests(
        products,
        tuple(tried),
        ParameterSpace((Parameter("gravity", "", -11, -9),)),
        np.ones(1),
        np.zeros(len(products), int),
    )
    (chosen,) = terms._chosen(tests)
    ((rival,),) = terms._rivals(tests, [chosen])
    assert {chosen, rival} == {0, 2}


@pytest.mark.parametrize(("noise", "counts"), [(0.06, True), (0.12, False)])
def test_friction_that_is_likely_counts_though_it_is_not_significant(noise, counts):
    """Two sorts of windows: friction f and slope 1 of residuals that friction of 0.02 imitates by half.

    In each window the friction's effect is (1, 1) and the parameter's (1, 0), so that a change c of friction moves
    the parameter by -c, and what the parameter cannot explain of it is the second row: 0.02 ± noise.
    """
    effect, slope = np.ones((16, 2)), np.tile([1.0, 0.0], (16, 1))
    residuals = -0.02 * effect + noise * np.array([[0.0, 1.0], [0.0, -1.0]] * 8)
    products = Products.of(residuals, slope[..., None], effect[..., None])
    tried = (Candidate(FIELDS["dof_frictionloss"].missing, "dof_frictionloss.hinge", "N·m", 0.0, 1.0, 0.0),)
    space = ParameterSpace((Parameter("gravity", "", -11, -9),))
    tests = TermTests(products, tried, space, np.full(1, 0.01), np.zeros(16, int))
    (name,) = space.names
    found = list(terms._within_bounds(tests, []))
    assert terms._chosen(tests) == [] and bool(found) is counts
    if counts:
        # The interval of the friction is 0.02 ± 0.036, of which [0, 0.056] is physical: the parameter moves by as much
        # back, in half-widths of 0.01.
        high = 0.02 + tests.score(0).reach
        assert high == pytest.approx(0.056, abs=0.002)
        assert found[0].shifts[name] == pytest.approx(-50.0 * high)
        assert found[0].errors[name] == pytest.approx(50.0 * high)
    assert list(terms._within_bounds(tests, [0])) == []


@pytest.mark.parametrize(
    ("told", "low", "high"), [(0.0, 0.0, WHOLE), (0.6, 0.6, 0.6), (-0.5, None, None), (3.0, None, None)]
)
def test_the_error_of_the_integration_step_is_covered_as_far_as_the_log_does_not_exclude_it(told, low, high):
    """As the friction above: of the steps' effect, (1, 1), or (1, 0) where it is imitated, the parameter has (1, 0)."""
    own, slope = np.ones((16, 2)), np.tile([1.0, 0.0], (16, 1))
    own[:, 1] = 1.0 if told else 0.0
    residuals = -told * own + 0.002 * np.array([[0.0, 1.0], [0.0, -1.0]] * 8)
    products = Products.of(residuals, slope[..., None], own[..., None])
    tried = (Candidate(INTEGRATION, "", "", 0.0, 1.0, -np.inf),)
    space = ParameterSpace((Parameter("gravity", "", -11, -9),))
    tests = TermTests(products, tried, space, np.full(1, 0.1), np.zeros(16, int))
    found = list(terms._within_bounds(tests, []))
    assert bool(found) is (low is not None)
    for each in found:  # the parameter goes back by as much, in half-widths of 0.1
        (shift,), (error,) = each.shifts.values(), each.errors.values()
        assert each.bounded and shift == pytest.approx(-10.0 * 0.5 * (low + high), abs=0.05)
        assert error == pytest.approx(10.0 * 0.5 * (high - low), abs=0.05)


@pytest.mark.parametrize(
    ("cause", "value", "fits"), [(INTEGRATION, 0.9, False), (INTEGRATION, 3.0, True), (EARLY, 0.9, True)]
)
def test_terms_beside_the_error_of_the_integration_step_are_not_fitted_without_it(cause, value, fits):
    """A refit can have a spec's parameters alone, so the steps' error would be in their values."""
    by_value, by_step, by_term = np.random.default_rng(0).standard_normal((3, 16, 8))
    noise = 0.01 * np.random.default_rng(1).standard_normal((16, 8))
    residuals = noise - value * by_step - 0.5 * by_term
    products = Products.of(residuals, by_value[..., None], np.stack([by_step, by_term], axis=-1))
    tried = (Candidate(cause, "", "", 0.0, 1.0, -np.inf), Candidate("drag", "dof_drag.hinge", "N", 0.0, 1.0, 0.0))
    space = ParameterSpace((Parameter("gravity", "", -11, -9),))
    tests = TermTests(products, tried, space, np.full(1, 1e-3), np.zeros(16, int))
    chosen = terms._chosen(tests)
    assert sorted(chosen) == [0, 1] and terms._beside_steps(tests, chosen) is not fits


@pytest.mark.parametrize(("value", "taken"), [(1.0, True), (-1.0, False), (2.0, False)])
def test_the_error_of_the_steps_is_taken_away_if_its_value_is_one_that_it_can_have(value, taken):
    """Drag explains what the error of the steps leaves, and its share is one of all residuals."""
    by_value, by_step, by_term = np.random.default_rng(0).standard_normal((3, 40, 8))
    noise = 0.01 * np.random.default_rng(1).standard_normal((40, 8))
    residuals = noise - value * by_step - 0.5 * by_term
    products = Products.of(residuals, by_value[..., None], np.stack([by_term, by_step], axis=-1))
    tried = (Candidate("drag", "dof_drag.hinge", "N", 0.0, 1.0, 0.0), Candidate(INTEGRATION, "", "", 0.0, 1.0, -np.inf))
    tests = TermTests(
        products, tried, ParameterSpace((Parameter("gravity", "", -11, -9),)), np.full(1, 1e-3), np.zeros(40, int)
    )
    left = tests.beside_steps
    drag, step = terms._terms(tests)
    assert (tests.steps is not None) is taken and step.value == pytest.approx(value, abs=0.15)
    if taken:
        assert left == pytest.approx(1.0 - step.explained)
        assert drag.value == pytest.approx(0.5, abs=0.01)
        assert drag.explained == pytest.approx(left, abs=0.01)  # noise leaves nearly nothing
    else:
        assert left == 1.0 and drag.explained < 0.5


@pytest.mark.parametrize("beside", [True, False])
def test_a_log_of_a_finer_simulation_has_no_refit_that_ignores_the_steps(tmp_path, monkeypatch, beside):
    task = robots.load(write_robot(tmp_path, SPRING_SPEC)).task
    log = recorded(task.with_time_step(0.25, substeps=4), SPRING_TRUTH, 300, jax.random.key(0))
    simulator, fitted = simulation.make(task, threads=1), []
    monkeypatch.setattr(terms, "_fitted", lambda tests, chosen, *rest: fitted.append(chosen) or ({}, []))
    if not beside:
        monkeypatch.setattr(terms, "_beside_steps", lambda tests, chosen: False)
    point = simulator.parameters.to_unit(simulator.parameters.vector(SPRING_TRUTH))
    states = states_of(log, simulator)
    terms.suspicions(log, states, simulator, point, np.full(len(point), 1e-3), typical_change(log))
    assert bool(fitted) is not beside


def test_a_drive_saturates_at_both_ends_of_what_it_is_asked_for(tmp_path):
    plant(tmp_path)
    (tmp_path / "pendulum.yaml").write_text(SPEC.replace("low: -1, high: 1", "low: 0, high: 10"))
    simulator = simulation.make(robots.load(tmp_path / "pendulum.yaml").task)
    # 0, 5 and 10 N·m are -1, 0 and 1; what is above 7 N·m is cut off, nothing below 0.
    asked = np.array([-1.0, 0.0, 1.0])[None, :, None]
    np.testing.assert_allclose(_cut_off(asked, simulator)[0, :, 0], [-1.0, 0.0, 0.4])


def test_a_longer_link_is_named_with_its_length(tmp_path):
    arm = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
      <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/>
      <body name="fore" pos="0 0 -{length}"><joint name="elbow" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/></body></body></worldbody>
      <actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator></mujoco>"""
    spec = (
        SPEC[: SPEC.index("signals:")]
        + """
signals: [{name: q1, reads: position(shoulder)}, {name: q2, reads: position(elbow)},
          {name: v1, reads: velocity(shoulder)}, {name: v2, reads: velocity(elbow)}]
actions: [{name: u1, actuator: shoulder, low: -3, high: 3}, {name: u2, actuator: elbow, low: -1, high: 1}]
parameters: [{field: dof_damping, element: elbow, low: 0, high: 0.2}]
"""
    )
    (tmp_path / "model.xml").write_text(arm.format(length=0.3))
    (tmp_path / "arm.yaml").write_text(spec)
    robot, random = robots.load(tmp_path / "arm.yaml"), np.random.default_rng(0)
    (tmp_path / "model.xml").write_text(arm.format(length=0.315))
    real = simulation.make(robots.load(tmp_path / "arm.yaml").task)
    torque = np.repeat(random.uniform(-1, 1, (400, 2)), 5, axis=0)
    start, system = real.initial_state[None, None], real.bind(np.array([[0.05]]))
    states = np.concatenate([start[0], system.roll_out(start, torque[None, None])[0, 0]])[:-1]
    seen = system.observe(states[None])[0] + NOISE * random.standard_normal((len(states), 4))
    columns = np.column_stack([0.02 * np.arange(len(torque)), seen, torque * [3.0, 1.0]])
    np.savetxt(tmp_path / "log.csv", columns, "%.9g", ",", header="time,q1,q2,v1,v2,u1,u2", comments="")
    dataset, simulator = logs.read([tmp_path / "log.csv"], robot), simulation.make(robot.task)
    point, change = simulator.parameters.to_unit(np.array([0.05])), typical_change(dataset)
    found = terms.suspicions(dataset, states_of(dataset, simulator), simulator, point, np.array([0.01]), change).terms
    length = next(term for term in found if term.parameter == "body_distance.fore")
    assert length.explained == max(term.explained for term in found)
    assert length.value == pytest.approx(0.315, abs=0.003)
    assert length.nominal == 0.3
