"""What a calibrator is given: states at which every parameter has a say, also where none can be rebuilt."""

import jax
import numpy as np

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.calibration.calibrate import without_repeats
from madoc.simulation.response import insensitive
from own_robots import CART, CART_SPEC, write_robot
from robots import recorded

SWINGING = CART.replace('type="slide" axis="1 0 0"', 'type="hinge" axis="0 1 0"').replace(
    'mass="1"', 'pos="0 0 -1" mass="1"'
)


def swinging(folder, hidden):
    """A pendulum without one of its signals, and a log of it; one physics step a control step."""
    spec = CART_SPEC.replace("control_step: 0.02", "control_step: 0.01").replace("force", "torque")
    spec = "\n".join(line for line in spec.splitlines() if f"name: {hidden}," not in line)
    spec += "\n  - {field: gravity, low: -15, high: -5}\n"
    task = robots.load(write_robot(folder, spec, cart=SWINGING)).task
    log = recorded(task, {"body_mass.cart": 1.0, "gravity": -9.81}, 100, jax.random.key(0))
    return task, log, CalibrationProblem(log, simulation.make(task, threads=1))


def test_where_velocities_are_hidden_it_probes_near_the_log(tmp_path):
    _, log, problem = swinging(tmp_path, "speed")
    states, actions = problem.probe
    np.testing.assert_array_equal(states[:, 0], log.transitions.observation[:, 0])
    np.testing.assert_array_equal(actions, log.transitions.action)
    assert insensitive(problem.simulator, states, actions, key=jax.random.key(0)) == []


def test_where_positions_are_hidden_it_probes_where_logged_actions_lead(tmp_path):
    task, log, problem = swinging(tmp_path, "place")
    states, actions = problem.probe
    np.testing.assert_array_equal(states[0], [0.0, 0.0])
    np.testing.assert_array_equal(actions, log.transitions.action[:64])
    system = problem.simulator.bind(task.parameters.middle[None])
    np.testing.assert_array_equal(system.step(states[None, :63], actions[None, :63])[0], states[1:])
    assert insensitive(problem.simulator, states, actions, key=jax.random.key(0)) == []
    resting = np.zeros((64, 2))  # hanging, gravity pulls at nothing
    assert insensitive(problem.simulator, resting, actions, key=jax.random.key(0)) == ["gravity"]


def test_what_method_and_check_both_say_is_without_repeats():
    own = ["the data does not identify mass, gain together; leave one out", "at the end of its range: damping"]
    doubts = [f"parameters: {own[0]}", "run.csv: the run is cut there"]
    assert without_repeats(own, doubts) == [*own, "run.csv: the run is cut there"]
    told = "the data can hardly tell apart (correlation of the estimates): mass and gain (+0.97)"
    before = told.replace("+0.97", "+0.91")
    assert without_repeats([told], [f"parameters: {before}", "scale: no log can show it"])[1:] == [
        "scale: no log can show it"
    ]
