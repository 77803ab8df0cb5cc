"""Parameters that change no next state are named and refused, and the control steps it took are counted."""

import jax
import numpy as np
import pytest

from madoc.errors import MadocError
from madoc.parameters import Parameter
from madoc.simulation.cpu import CpuSimulator
from madoc.simulation.response import insensitive, refuse_insensitive
from robots import counted

KEY = jax.random.key(0)
STIFFNESS = Parameter("jnt_stiffness", "slide", 1.0, 9.0)
GRAVITY = Parameter("gravity", "", -20.0, -5.0)
FRICTION = Parameter("geom_friction", "box", 0.5, 1.5)
DAMPING = Parameter("dof_damping", "slide", 0.0, 2.0)


def logged(count=100):
    """States and actions of a spring, moving."""
    randomness = np.random.default_rng(0)
    return randomness.normal(size=(count, 2)), randomness.uniform(-1, 1, (count, 1))


def test_gravity_across_a_slide_and_friction_in_the_air_change_nothing(spring_task):
    simulator = CpuSimulator(spring_task(STIFFNESS, GRAVITY, DAMPING, FRICTION), threads=1)
    names, control_steps = counted(insensitive, simulator, *logged(), key=KEY)
    assert names == ["gravity", "geom_friction.box"]
    assert control_steps == 64 * 9 + 36 * 5  # all four in 64 rows, then the two that were not felt


def test_the_refusal_names_one(spring_task):
    simulator = CpuSimulator(spring_task(GRAVITY, STIFFNESS), threads=1)
    sentence = "^parameter gravity changes no next state in 100 logged rows; remove it or widen its range$"
    with pytest.raises(MadocError, match=sentence):
        refuse_insensitive(simulator, *logged(), key=KEY)


def test_the_refusal_names_several_and_the_rows_there_were(spring_task):
    simulator = CpuSimulator(spring_task(GRAVITY, STIFFNESS, FRICTION), threads=1)
    sentence = r"^parameters gravity, geom_friction.box change no next state in 5 logged rows; remove them or widen"
    with pytest.raises(MadocError, match=sentence):
        refuse_insensitive(simulator, *logged(5), key=KEY)


def test_each_parameter_is_simulated_at_both_ends_of_its_range(spring_task):
    simulator = CpuSimulator(spring_task(STIFFNESS, DAMPING), threads=1)
    assert counted(refuse_insensitive, simulator, *logged(), key=KEY)[1] == 64 * 5
    assert counted(refuse_insensitive, simulator, *logged(10), key=KEY)[1] == 10 * 5


def test_damping_is_not_felt_at_rest(spring_task):
    # v = 0 stays 0 at x = 0 without a force, so neither damping nor stiffness shows.
    simulator = CpuSimulator(spring_task(STIFFNESS, DAMPING), threads=1)
    names = insensitive(simulator, np.zeros((3, 2)), np.zeros((3, 1)), key=KEY)
    assert names == ["jnt_stiffness.slide", "dof_damping.slide"]


def test_all_parameters_of_hopper_are_felt_where_it_moves(hopper, make_batch):
    _, state, action = make_batch(hopper, 1, 50)
    assert counted(insensitive, hopper, state[0], action[0], key=KEY) == ([], 50 * 17)


def test_rows_that_fail_do_not_count_as_change(spring_task):
    simulator = CpuSimulator(spring_task(STIFFNESS, Parameter("geom_friction", "box", 0.5, 1.5)), threads=1)
    states, actions = logged(8)
    states[::2] = 1e12
    assert insensitive(simulator, states, actions, key=KEY) == ["geom_friction.box"]


def test_an_end_that_always_fails_is_no_change(spring_task):
    simulator = CpuSimulator(spring_task(STIFFNESS, Parameter("actuator_gain", "push", -1e12, 1e12)), threads=1)
    states, actions = logged(8)
    assert insensitive(simulator, states, 1e4 * actions, key=KEY) == ["actuator_gain.push"]


def test_when_mid_range_always_fails_that_is_the_sentence(spring_task):
    simulator = CpuSimulator(spring_task(), threads=1)
    with pytest.raises(MadocError, match="spring: the simulation fails in all 4 rows at mid-range parameters; check"):
        insensitive(simulator, np.full((4, 2), 1e12), np.zeros((4, 1)), key=KEY)


def test_no_rows_are_refused(spring_task):
    simulator = CpuSimulator(spring_task(), threads=1)
    with pytest.raises(MadocError, match="expected at least one logged state"):
        insensitive(simulator, np.zeros((0, 2)), np.zeros((0, 1)), key=KEY)


def test_same_key_same_rows(spring_task):
    simulator = CpuSimulator(spring_task(STIFFNESS), threads=1)
    states, actions = logged(6000)
    states[:-1], actions[:-1] = 0.0, 0.0  # one row in 6,000 shows the stiffness, and 4,096 are tried
    found = [insensitive(simulator, states, actions, key=jax.random.key(seed)) for seed in range(10)]
    assert found == [insensitive(simulator, states, actions, key=jax.random.key(seed)) for seed in range(10)]
    assert [] in found
    assert ["jnt_stiffness.slide"] in found


def test_a_parameter_that_is_felt_in_few_rows_is_felt(spring_task):
    simulator = CpuSimulator(spring_task(STIFFNESS, DAMPING), threads=1)
    states, actions = np.zeros((600, 2)), np.zeros((600, 1))
    states[137] = 1.0
    for seed in range(3):
        assert insensitive(simulator, states, actions, key=jax.random.key(seed)) == []
