"""Forces at a joint that no parameter of a spec adds: by hand, and on a pendulum that has one."""

import numpy as np
import pytest
from test_missing_terms import scores

from madoc import robots, simulation
from madoc.data import logs
from madoc.identification.causes import (
    BENT,
    BUILT_UP,
    CONSTANT,
    COUPLED,
    DEAD_ZONE,
    LOADED,
    PLACED,
    RIPPLE,
    SLOW,
    UNEVEN,
    WEAKENING,
    cause_of,
)
from madoc.identification.joint_forces import joint_forces
from madoc.verdict.adequacy import NEARLY, is_certain, likeliest
from planted_pendulum import MODEL, NOISE, SPEC


def test_forces_along_a_motion():
    # A joint that always moves at 2 rad/s under 3 N·m, at 0 and at a quarter of a turn: tanh(10) is 1, as is |drive|.
    position, speed, exerted = np.array([[0.0, np.pi / 2.0]]), np.full((1, 2), 2.0), np.full((1, 2), 3.0)
    found = joint_forces(position, speed, exerted, turns=True)
    ones = np.ones((1, 2))
    assert found[CONSTANT][0] == pytest.approx(ones)
    assert found[LOADED][0] == pytest.approx(-ones)
    assert found[WEAKENING][0] == pytest.approx(-ones)
    assert found[SLOW][0] == pytest.approx(-np.exp(-1.0 / 0.09) * ones)
    for cause, sign in ((PLACED, 1.0), (UNEVEN, -1.0), (RIPPLE, 1.0)):
        assert found[cause][0] == pytest.approx(sign * np.array([[0.0, 1.0]]), abs=1e-8)
        assert found[cause][1] == pytest.approx(sign * np.array([[1.0, 0.0]]), abs=1e-8)
    assert found[PLACED][2] == pytest.approx(np.zeros((1, 2)), abs=1e-8)  # the sine of twice the angle
    assert found[PLACED][3] == pytest.approx(np.array([[1.0, -1.0]]))
    assert found[DEAD_ZONE][0] == pytest.approx(-ones)
    assert found[BENT][0] == pytest.approx(-ones)
    along, squared, cubed = joint_forces(position, speed, exerted, turns=False)[PLACED]
    assert along == pytest.approx(np.array([[-1.0, 1.0]]))
    assert squared == pytest.approx(ones)
    assert cubed == pytest.approx(along)


def test_friction_builds_up_after_a_reversal():
    """The joint moves to and fro between 0 and 1, so that the variance of its position is 3/5 · 2/5."""
    position, speed = np.array([[0.0, 1.0, 1.0, 0.0, 1.0]]), np.array([[1.0, 1.0, -1.0, -1.0, 1.0]])
    deviation = np.sqrt(0.24)
    near, *far = joint_forces(position, speed, speed, turns=False)[BUILT_UP]
    expected = np.array([[0.0, 0.0, -1.0, -np.exp(-1.0 / (0.03 * deviation)), 1.0]])
    assert near == pytest.approx(expected, abs=1e-8)
    for shape, distance in zip(far, (0.2, 0.5, 1.2), strict=True):
        kept = np.exp(-1.0 / (distance * deviation))
        first = 1.0 - kept
        back = -1.0 + (first + 1.0) * kept
        again = 1.0 + (back - 1.0) * kept
        assert shape == pytest.approx(-np.array([[0.0, first, first, back, again]]), abs=1e-8)


def test_friction_that_had_built_up_before_a_window_is_there_when_it_begins():
    position, earlier = np.array([[1.0, 2.0]]), np.array([[0.0, 0.5]])
    shape = joint_forces(position, position, position, turns=False, earlier=earlier)[BUILT_UP][2]
    kept = np.exp(-1.0 / (0.5 * 0.5))  # per unit of position: 0.5 of a standard deviation, which is 0.5
    assert shape == pytest.approx(-np.array([[1.0 - kept, 1.0 - kept**2]]))


def dahl(friction, rate):
    """What friction that builds up over 1 / `rate` rad (Dahl 1968) lacks of Coulomb friction of that size."""
    state = [0.0]

    def force(q, v, u):
        state[0] = np.clip(state[0] + 0.02 * rate * (v - abs(v) * state[0]), -1.0, 1.0)
        return friction * (np.tanh(v / 0.02) - state[0])

    return force


def test_forces_by_another_joint():
    one, still = np.array([[1.0, 3.0]]), np.zeros((1, 2))
    (coupled,) = joint_forces(still, still, still, [(one, still)], turns=True)[COUPLED]
    assert coupled == pytest.approx(np.array([[-1.0, 1.0]]))


def test_what_neither_moves_nor_drives_has_a_constant_force_alone():
    still = np.zeros((1, 3))
    assert joint_forces(still, still, still, turns=True).keys() == {CONSTANT}
    assert LOADED not in joint_forces(still, still + 1.0, still, turns=True)


def test_causes_are_known_by_their_begin():
    assert cause_of(f"{LOADED} (hinge)").group == "force"
    assert cause_of("Coulomb friction").group == "term"


@pytest.mark.parametrize(
    ("force", "cause"),
    [
        (lambda q, v, u: 0.02, CONSTANT),
        (lambda q, v, u: -0.08 * abs(u) * np.tanh(v / 0.05), LOADED),
        pytest.param(
            lambda q, v, u: -0.06 * np.tanh(v / 0.05) * np.exp(-((v / 0.4) ** 2)), SLOW, marks=pytest.mark.slow
        ),
        (lambda q, v, u: 0.1 * u * np.sin(q), RIPPLE),
        pytest.param(lambda q, v, u: -np.clip(u, -0.03, 0.03), DEAD_ZONE, marks=pytest.mark.slow),
        (dahl(0.08, rate=10.0), BUILT_UP),
    ],
    ids=["constant", "loaded", "slow", "ripple", "dead zone", "built up"],
)
def test_a_force_at_the_joint_is_certain_and_named(tmp_path, force, cause):
    (tmp_path / "model.xml").write_text(MODEL.format(damping=0.1, friction=0.03, drag=""))
    (tmp_path / "pendulum.yaml").write_text(SPEC)
    robot = robots.load(tmp_path / "pendulum.yaml")
    simulator = simulation.make(robot.task)
    system, random = simulator.bind(np.array([[0.1]])), np.random.default_rng(0)
    torque, state, seen = np.repeat(random.uniform(-1, 1, 320), 5), simulator.initial_state[None, None], []
    for each in torque:
        seen.append(state[0, 0, :2])
        outside = np.full((1, 1, 1), force(*state[0, 0, :2], each))
        state = system.step(state, np.full((1, 1, 1), each), outside)
    seen = np.array(seen) + NOISE * random.standard_normal((len(torque), 2))
    columns = np.column_stack([0.02 * np.arange(len(torque)), seen, torque])
    np.savetxt(tmp_path / "log.csv", columns, "%.9g", ",", header="time,angle,speed,torque", comments="")
    told = scores(logs.read([tmp_path / "log.csv"], robot), simulator)
    certain = [term for term in told if is_certain(term)]
    named = likeliest(certain)
    if cause == CONSTANT:  # small swings cannot tell it from a shift of the angle, which a spec can add
        assert named.parameter == "signal_bias.angle"
        assert any(term.cause.startswith(cause) and term.explained > NEARLY * named.explained for term in certain)
    else:
        assert named.cause.startswith(cause)
