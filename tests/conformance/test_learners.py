"""What every policy learner must keep to. A learner that is not in the dictionary here fails."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import checkpoint, simulation
from madoc.errors import MadocError
from madoc.numpy_policy import NumpyPolicy
from madoc.policies import LEARNERS, PolicyProblem, learn_policy, load_policy
from madoc.run_folder import RunFolder
from robots import ARM_TRUTH, CountingSimulator, recorded, two_link_arm

KEY = jax.random.key(0)
BUDGET = 200
EPOCH = 40
TINY = {"hidden": (8, 8), "environments": 4, "epoch_steps": EPOCH, "updates_per_step": 0.1, "warmup_steps": EPOCH}
TINY |= {"batch": 16, "replay_capacity": 150}

METHODS = {
    "sac": LEARNERS["sac"].make(**TINY),
    "sac-bc": LEARNERS["sac-bc"].make(**TINY),
}


@pytest.fixture(scope="module")
def dataset():
    return recorded(two_link_arm(), ARM_TRUTH, 200, jax.random.key(100))


@pytest.fixture
def simulator():
    return CountingSimulator(simulation.make(two_link_arm(), threads=1))


@pytest.fixture
def problem(dataset, simulator):
    return PolicyProblem(simulator, simulator.parameters.middle, dataset)


@pytest.fixture(params=METHODS)
def method(request):
    return METHODS[request.param]


def bits(policy):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(policy)]


def stepped(method, problem, epochs):
    state = method.init(problem, KEY)
    for _ in range(epochs):
        state, _ = method.step(problem, state)
    return state


def test_no_learner_is_forgotten():
    assert set(LEARNERS) <= set(METHODS), "add the new learner to METHODS"


@pytest.mark.parametrize("name", LEARNERS)
def test_a_learner_knows_the_name_it_is_listed_under(name):
    assert METHODS[name].name == name
    assert LEARNERS[name].summary
    assert LEARNERS[name].paper
    assert 1900 < LEARNERS[name].year < 2100


def test_the_budget_is_kept_and_counted(method, problem, simulator):
    learnt = learn_policy(method, problem, key=KEY, budget=BUDGET - 1)
    assert learnt.status == "finished"
    assert learnt.control_steps == simulator.rows == BUDGET
    action = learnt.policy(np.zeros((5, 4)))
    assert action.shape == (5, 2)
    assert (abs(action) <= 1.0).all()


def test_same_seed_same_bits_and_another_seed_others(method, problem):
    first, again, other = (
        bits(learn_policy(method, problem, key=jax.random.key(seed), budget=BUDGET).policy) for seed in (0, 0, 1)
    )
    assert first == again
    assert first != other


def test_stopped_and_resumed_equals_uninterrupted(method, problem, tmp_path):
    whole = learn_policy(method, problem, key=KEY, budget=BUDGET)
    with RunFolder.create(tmp_path / "run", {"seed": 0}) as folder:
        for budget in (EPOCH, 3 * EPOCH):  # before the first update, and after some
            part = learn_policy(method, problem, key=KEY, budget=budget, folder=folder, resume=budget > EPOCH)
            assert part.control_steps == budget
            assert bits(part.policy) != bits(whole.policy)
        resumed = learn_policy(method, problem, key=KEY, budget=BUDGET, folder=folder, resume=True)
        assert bits(resumed.policy) == bits(whole.policy)
        assert resumed.control_steps == whole.control_steps
        told = json.loads(folder.result.read_text())
        assert (told["status"], told["control_steps"]) == ("finished", BUDGET)


def test_the_layout_of_the_state_never_changes(method, problem):
    expected = checkpoint.layout(method.init(problem, KEY))
    for epochs in (1, 3):
        state = stepped(method, problem, epochs)
        assert checkpoint.difference(checkpoint.layout(state), expected) is None
        assert checkpoint.first_non_finite(state) is None


def test_stages_metrics_and_progress(method, problem):
    state = method.init(problem, KEY)
    assert method.stage(state) == "exploring"
    done, seen = [method.progress(state, BUDGET)], set()
    while method.control_steps(state) < BUDGET:
        state, metrics = method.step(problem, state)
        assert all(np.isfinite(value) for value in metrics.values())
        seen |= metrics.keys()
        done.append(method.progress(state, BUDGET))
    assert method.stage(state) == "learning"
    assert method.converged(state) is None
    assert done == sorted(done)
    assert (done[0], done[-1]) == (0.0, 1.0)
    assert "temperature" in seen


def test_nothing_is_traced_again(method, problem, traced):
    state = stepped(method, problem, 4)
    assert method.stage(state) == "learning"
    before = traced()
    for _ in range(10):
        state, _ = method.step(problem, state)
    assert traced() == before


def test_a_saved_policy_acts_the_same_with_and_without_jax(method, problem, tmp_path):
    with RunFolder.create(tmp_path / "run", {"seed": 0}) as folder:
        policy = learn_policy(method, problem, key=KEY, budget=BUDGET, folder=folder).policy
    observation = 3.0 * np.random.default_rng(0).normal(size=(50, 4))
    wanted = np.asarray(policy(observation))
    saved = NumpyPolicy.load(tmp_path / "run/policy.npz")
    assert saved.task_name == "two_link_arm"
    np.testing.assert_allclose(saved.act(observation), wanted, atol=1e-5)
    np.testing.assert_allclose(saved.act(observation[0]), wanted[0], atol=1e-5)
    loaded = load_policy(tmp_path / "run/policy.npz")
    assert bits(loaded) == bits(policy)
    assert (loaded(observation, jax.random.key(1)) == policy(observation, jax.random.key(1))).all()
    with np.load(tmp_path / "run/policy.npz", allow_pickle=False) as arrays:
        assert all(arrays[name].dtype != object for name in arrays)


def test_several_systems_at_a_time(method, dataset, simulator):
    space = simulator.parameters
    problem = PolicyProblem(simulator, np.stack([space.low * 0.9 + space.high * 0.1, space.middle]), dataset)
    assert learn_policy(method, problem, key=KEY, budget=2 * EPOCH).control_steps == 2 * EPOCH


def test_environments_that_do_not_fill_the_systems_are_refused(method, dataset, simulator):
    problem = PolicyProblem(simulator, np.stack([simulator.parameters.middle] * 3), dataset)
    with pytest.raises(MadocError, match="expected a multiple of 3 environments for 3 systems, got 4"):
        learn_policy(method, problem, key=KEY, budget=BUDGET)


def test_parameters_of_another_robot_are_refused(simulator):
    with pytest.raises(MadocError, match="expected 5 parameter values for two_link_arm, got 2"):
        PolicyProblem(simulator, np.zeros(2))


def test_cloning_without_data_is_refused(problem):
    with pytest.raises(MadocError, match="sac-bc clones the data's actions: give it a dataset"):
        learn_policy(METHODS["sac-bc"], replace(problem, dataset=None), key=KEY, budget=BUDGET)


def test_without_cloning_data_makes_no_difference(problem):
    alone = learn_policy(METHODS["sac"], replace(problem, dataset=None), key=KEY, budget=BUDGET)
    assert bits(alone.policy) == bits(learn_policy(METHODS["sac"], problem, key=KEY, budget=BUDGET).policy)


def test_no_budget_is_refused(method, problem):
    with pytest.raises(MadocError, match="budget of at least 1 control step, got 0"):
        learn_policy(method, problem, key=KEY, budget=0)
