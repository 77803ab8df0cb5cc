"""What every policy learner must keep to. A learner that is not in the dictionary here fails."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from madoc import simulation
from madoc.data.dataset import Disturbance
from madoc.errors import MadocError
from madoc.numpy_policy import NumpyPolicy
from madoc.policies import (
    LEARNERS,
    NormalParameters,
    PolicyProblem,
    UniformParameters,
    learn_policy,
    load_policy,
)
from madoc.runs import checkpoint
from madoc.runs.loop import Tally
from madoc.runs.run_folder import RunFolder
from madoc.types import entry_of
from robots import ARM_TRUTH, CountingSimulator, recorded, two_link_arm

KEY = jax.random.key(0)
BUDGET = 200
EPOCH = 40
SMALL = {"hidden": (8, 8), "batch": 16}
ACTING = SMALL | {"environments": 4, "epoch_steps": EPOCH, "updates_per_step": 0.1, "warmup_steps": EPOCH}
ACTING |= {"replay_capacity": 150}
OFFLINE = SMALL | {"epoch_updates": EPOCH}

FAST = SMALL | {"environments": 4, "epoch_steps": EPOCH, "steps_per_update": 10, "warmup_steps": EPOCH}
FAST |= {"replay_capacity": 150, "judge_every": 4, "judge_episodes": 2}

METHODS = {
    "sac": LEARNERS["sac"].make(**ACTING, judge_every=2 * EPOCH, judge_episodes=2),
    "sac-bc": LEARNERS["sac-bc"].make(**ACTING),
    "dr-bc": LEARNERS["dr-bc"].make(**ACTING),
    "dr": LEARNERS["dr"].make(**ACTING),
    "fast-sac": LEARNERS["fast-sac"].make(**FAST),
    "rlpd": LEARNERS["rlpd"].make(**FAST),
    "h2o": LEARNERS["h2o"].make(**ACTING, judge_every=2 * EPOCH, judge_episodes=2),
    "bc": LEARNERS["bc"].make(**OFFLINE),
    "cql": LEARNERS["cql"].make(**OFFLINE, critic_hidden=(8, 8), samples=2, cloning_updates=EPOCH),
    "morec": LEARNERS["morec"].make(
        **OFFLINE,
        model_hidden=(8,),
        models=3,
        elites=2,
        model_updates=2 * EPOCH,
        patience=EPOCH,
        judge_every=EPOCH,
        horizon=3,
        discriminator_hidden=(8,),
        discriminators=1,
        discriminator_every=EPOCH,
        judge_rows=4,
        discriminator_updates=EPOCH,
        imagined_per_update=2,
        imagined_rows=5,
        replay_capacity=150,
        holdout_every=10,
    ),
}
SIMULATING = [name for name, entry in LEARNERS.items() if entry.simulates]
FED = [name for name, entry in LEARNERS.items() if entry.needs_data]
REWARDED = ["rlpd", "h2o", "cql", "morec"]


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
def name(request):
    return request.param


@pytest.fixture
def method(name):
    return METHODS[name]


@pytest.fixture
def unit(name):
    return LEARNERS[name].unit


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
def test_a_learner_is_recognised_as_the_entry_it_was_made_from(name):
    assert entry_of(METHODS[name], LEARNERS).name == LEARNERS[name].name == name
    assert LEARNERS[name].summary
    assert LEARNERS[name].paper
    assert 1900 < LEARNERS[name].year < 2100
    assert LEARNERS[name].simulates == (LEARNERS[name].unit == "control steps")


def test_the_budget_is_kept_and_counted(method, unit, problem, simulator):
    learnt = learn_policy(method, problem, key=KEY, budget=BUDGET - 1)
    assert (learnt.status, learnt.spent, learnt.unit) == ("finished", BUDGET, unit)
    assert learnt.sentence == f"the budget of {BUDGET - 1} {unit} is spent"
    assert learnt.control_steps == simulator.rows
    assert learnt.control_steps >= BUDGET if unit == "control steps" else learnt.control_steps == 0
    action = learnt.policy(np.zeros((5, 4)))
    assert action.shape == (5, 2)
    assert (abs(action) <= 1.0).all()


def test_stopped_and_resumed_equals_uninterrupted_and_another_seed_differs(method, unit, problem, tmp_path):
    whole, other = (learn_policy(method, problem, key=jax.random.key(seed), budget=BUDGET) for seed in (0, 1))
    assert bits(whole.policy) != bits(other.policy)
    assert bits(whole.policy) != bits(method.policy(method.init(problem, KEY)))
    with RunFolder.create(tmp_path / "run", {"seed": 0}) as folder:
        for budget in (EPOCH, 3 * EPOCH):  # before the first update, and after some
            part = learn_policy(method, problem, key=KEY, budget=budget, folder=folder, resume=budget > EPOCH)
            assert part.spent == budget
        resumed = learn_policy(method, problem, key=KEY, budget=BUDGET, folder=folder, resume=True)
        assert bits(resumed.policy) == bits(whole.policy)
        assert resumed.control_steps == whole.control_steps
        told = json.loads(folder.result.read_text())
        assert (told["status"], told["control_steps"]) == ("finished", whole.control_steps)
        assert unit == "control steps" or told["updates"] == BUDGET


def test_the_layout_of_the_state_never_changes(method, problem):
    expected = checkpoint.layout(method.init(problem, KEY))
    for epochs in (1, 3):
        state = stepped(method, problem, epochs)
        assert checkpoint.difference(checkpoint.layout(state), expected) is None
        assert checkpoint.first_non_finite(state) is None


def test_stages_and_metrics(name, method, unit, problem):
    state, tally, stages, seen = method.init(problem, KEY), Tally(), [], set()
    while tally.spent(unit) < BUDGET:
        state, epoch = method.step(problem, state)
        tally = tally.plus(epoch)
        assert all(np.isfinite(value) for value in epoch.metrics.values())
        assert tally.converged is None
        seen |= epoch.metrics.keys()
        stages.append(epoch.stage)
    assert tally.prepared == (1.0 if name == "morec" else None)
    assert seen >= set(LEARNERS[name].shown) - {"return_in_simulator"}
    assert list(dict.fromkeys(stages)) == {
        "bc": ["cloning"],
        "cql": ["cloning", "learning"],
        "morec": ["fitting", "opposing", "learning"],
    }.get(name, ["exploring", "learning"])


def test_nothing_is_traced_again(method, problem, traced):
    state = stepped(method, problem, 4)
    before = traced()
    for _ in range(10):
        state, epoch = method.step(problem, state)
    assert epoch.stage in ("learning", "cloning")
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


def corners(simulator):
    space = simulator.parameters
    return np.stack([space.low * 0.9 + space.high * 0.1, space.middle])


def distributions(space):
    return [
        UniformParameters(space),
        NormalParameters(space, space.middle, np.diag(((space.high - space.low) / 8) ** 2)),
    ]


def test_several_systems_at_a_time(method, dataset, simulator):
    problem = PolicyProblem(simulator, corners(simulator), dataset)
    assert learn_policy(method, problem, key=KEY, budget=2 * EPOCH).spent == 2 * EPOCH


@pytest.mark.parametrize("of", [0, 1])
def test_systems_are_drawn_from_distributions(method, dataset, simulator, of):
    problem = PolicyProblem(simulator, distributions(simulator.parameters)[of], dataset)
    first, again = (bits(learn_policy(method, problem, key=KEY, budget=2 * EPOCH).policy) for _ in range(2))
    assert first == again


@pytest.mark.parametrize("name", METHODS)
def test_parameters_matter_where_a_learner_says_so(name, dataset, simulator):
    method = METHODS[name]
    first, second = (
        bits(learn_policy(method, PolicyProblem(simulator, row, dataset), key=KEY, budget=3 * EPOCH).policy)
        for row in corners(simulator)
    )
    assert (first != second) == LEARNERS[name].needs_parameters


@pytest.mark.parametrize("name", [name for name in SIMULATING if LEARNERS[name].needs_parameters])
def test_environments_that_do_not_fill_the_systems_are_refused(name, dataset, simulator):
    problem = PolicyProblem(simulator, np.stack([simulator.parameters.middle] * 3), dataset)
    with pytest.raises(MadocError, match="expected a multiple of 3 environments for 3 systems, got 4"):
        learn_policy(METHODS[name], problem, key=KEY, budget=BUDGET)


def test_no_learner_sees_the_truth(dataset, problem):
    assert dataset.true_parameters is not None
    assert problem.dataset.true_parameters is None


def test_data_of_another_robot_is_refused(dataset, simulator):
    other = replace(dataset, task_name="spring")
    with pytest.raises(MadocError, match="recorded from spring, the simulator is two_link_arm"):
        PolicyProblem(simulator, simulator.parameters.middle, other)


@pytest.mark.parametrize("name", FED)
def test_no_data_is_refused(name, problem):
    with pytest.raises(MadocError, match="learns from logged data: give it a dataset"):
        learn_policy(METHODS[name], replace(problem, dataset=None), key=KEY, budget=BUDGET)


@pytest.mark.parametrize("name", FED)
def test_too_few_rows_are_refused(name, dataset, problem):
    few = replace(dataset, transitions=dataset.transitions.take(np.arange(5)))
    with pytest.raises(MadocError, match=r"needs at least .* 16, got 5 in a random policy"):
        learn_policy(METHODS[name], replace(problem, dataset=few), key=KEY, budget=BUDGET)


@pytest.mark.parametrize("name", REWARDED)
def test_data_without_rewards_is_refused_where_they_are_learnt_from(name, dataset, problem):
    silent = replace(dataset, transitions=replace(dataset.transitions, reward=np.zeros(len(dataset))))
    with pytest.raises(MadocError, match=r"learns from logged rewards, and every reward .* is 0"):
        learn_policy(METHODS[name], replace(problem, dataset=silent), key=KEY, budget=BUDGET)


@pytest.mark.parametrize("name", REWARDED)
def test_next_observations_of_other_rows_are_refused_where_they_are_learnt_from(name, dataset, problem):
    torn = replace(dataset, disturbance=Disturbance(shuffled="next_observations"))
    with pytest.raises(MadocError, match="learns from the outcomes of actions"):
        learn_policy(METHODS[name], replace(problem, dataset=torn), key=KEY, budget=BUDGET)


def test_data_of_another_observation_is_refused(dataset, simulator):
    rows = dataset.transitions
    narrow = replace(rows, observation=rows.observation[:, :2], next_observation=rows.next_observation[:, :2])
    with pytest.raises(MadocError, match="the data has 2 values per observation, the simulator's two_link_arm shows 4"):
        PolicyProblem(simulator, simulator.parameters.middle, replace(dataset, transitions=narrow))


def test_a_model_cannot_be_learnt_where_falls_cannot_be_told(dataset):
    task = replace(two_link_arm(), state_from_observation=None)
    problem = PolicyProblem(simulation.make(task, threads=1), task.parameters.middle, dataset)
    with pytest.raises(MadocError, match="cannot tell where an imagined episode ends"):
        learn_policy(METHODS["morec"], problem, key=KEY, budget=BUDGET)


def test_parameters_of_another_robot_are_refused(simulator):
    with pytest.raises(MadocError, match=r"expected 5 parameter values \(.*\), got an array of shape \(2,\)"):
        PolicyProblem(simulator, np.zeros(2))


def test_without_cloning_data_makes_no_difference(problem):
    alone = learn_policy(METHODS["sac"], replace(problem, dataset=None), key=KEY, budget=BUDGET)
    assert bits(alone.policy) == bits(learn_policy(METHODS["sac"], problem, key=KEY, budget=BUDGET).policy)


def test_no_budget_is_refused(method, unit, problem):
    with pytest.raises(MadocError, match=f"budget of at least 1 {unit[:-1]}, got 0"):
        learn_policy(method, problem, key=KEY, budget=0)
