"""What the acceleration of a joint tells of its action: how late it is, which way it pushes, and how much."""

import jax
import numpy as np
import pytest
from logged_arm import SPEC, arm_of, write_csv
from mujoco_log import recorded

from madoc import simulation
from madoc.data import logs
from madoc.diagnosis.explanation import box_draws
from madoc.diagnosis.response import measured_responses, response_findings
from madoc.identification.states import states_of

POSITIONS = "\n".join(line for line in SPEC.splitlines() if "velocity" not in line) + "\n"
DELAY = "  - {field: action_delay, low: 0, high: 0.06}\n"


@pytest.fixture
def told(tmp_path):
    """The findings on a log of the arm, as (where, what), and the responses themselves."""

    def run(columns, spec=SPEC):
        robot = arm_of(tmp_path, spec)
        dataset = logs.read(write_csv(tmp_path / "log.csv", columns), robot)
        simulator = simulation.make(robot.task, threads=1)
        points = box_draws(len(simulator.parameters), jax.random.key(0))
        found = response_findings(dataset, simulator, states_of(dataset, simulator), points)
        return [(finding.where, finding.what) for finding in found], measured_responses(dataset, simulator)

    return run


@pytest.mark.parametrize(("late", "spec"), [(15, SPEC), (20, SPEC), (20, POSITIONS)])
def test_the_time_from_an_action_to_its_acceleration(told, late, spec):
    """The torque takes effect 15 or 20 physics steps of 0.002 s late: 1.5 or 2 rows."""
    found, responses = told(recorded(late=late), spec)
    for response in responses:
        assert abs(response.lag - 0.002 * late) < 0.002
    assert [where for where, _ in found] == ["shoulder_torque", "elbow_torque"]
    assert found[0][1].startswith("the acceleration of shoulder follows it 0.0")


def test_a_delay_that_is_calibrated_is_not_told(told):
    assert told(recorded(late=20), SPEC + DELAY)[0] == []
    narrow = SPEC + DELAY.replace("0.06", "0.02")
    assert len(told(recorded(late=20), narrow)[0]) == 2


@pytest.mark.parametrize("spec", [SPEC, POSITIONS])
def test_honest_logs_raise_nothing(told, spec):
    noise = 1e-4 if spec is POSITIONS else 1e-2
    for columns in (recorded(), recorded(noise=noise), recorded(noise=noise, feedback=0.2)):
        assert told(columns, spec)[0] == []


def test_noise_of_the_state_biases_no_gain(told):
    """Earlier actions tell of the true state, and would be taken for the cause of what the noise of a reading hides."""
    _, exact = told(recorded(), POSITIONS)
    _, noisy = told(recorded(noise=0.004), POSITIONS)
    for one, other in zip(noisy, exact, strict=True):
        assert abs(one.gain / other.gain - 1.0) < 0.06
        assert abs(one.lag) < 3.0 * one.lag_error


def test_an_action_that_pushes_the_other_way_is_told_without_velocities(told):
    columns = recorded()
    columns |= {"shoulder_torque": -columns["shoulder_torque"]}
    assert told(columns, POSITIONS)[0] == [
        ("shoulder_torque", "it accelerates shoulder the other way than in the model")
    ]


def test_positions_in_degrees_without_velocities(told):
    columns = recorded()
    columns |= {name: np.rad2deg(columns[name]) for name in ("shoulder", "elbow")}
    found = told(columns, POSITIONS)[0]
    assert [where for where, _ in found] == ["shoulder_torque", "elbow_torque"]
    assert all(what.endswith("anywhere in the ranges of the parameters: degrees for radians?") for _, what in found)


def test_an_action_that_is_always_zero_has_no_response(told):
    found, (shoulder, elbow) = told(recorded() | {"shoulder_torque": np.zeros(1200)})
    assert (shoulder.gain, shoulder.gain_error, shoulder.lag, shoulder.certain) == (0.0, 0.0, 0.0, False)
    assert elbow.certain
    assert found == []
