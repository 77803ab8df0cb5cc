"""Reward, end and reset as functions of a Python file: the same as expressions, and refused unless allowed."""

import json

import jax
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.errors import MadocError, NotAllowed
from madoc.gymnasium_environment import CalibratedVectorEnvironment
from madoc.simulation.rollout import reset_states
from own_robots import CART_SPEC, write_robot

GOALS = 'goals: [{name: wanted, drawn: "uniform(1, 3)"}]\n'

FUNCTIONS = """
import numpy as np

def reward(place, wanted, push):
    away = abs(place - wanted)
    return np.where(away < 0.1, 1, -away) - 0.1 * push

def end(wanted, velocity, *, limit=-5.0):
    return (velocity["rail"] < limit) | (wanted > 2.5)

def reset(random, count, wanted):
    return {"position(rail)": wanted - random.uniform(1, 2, count), "velocity(rail)": np.full(count, 0.25)}
"""

KEY = jax.random.key(0)


@pytest.fixture
def write(tmp_path):
    """A function that writes the cart with a Python file; where its spec lies."""

    def made(text=FUNCTIONS, spec=CART_SPEC + GOALS + "python: task.py\n"):
        (tmp_path / "task.py").write_text(text)
        return write_robot(tmp_path, spec)

    return made


def test_functions_are_what_the_same_expressions_are(write, tmp_path):
    expressions = "reward: where(abs(place - wanted) < 0.1, 1, -abs(place - wanted)) - 0.1 * push\n"
    expressions += "end: velocity(rail) < -5 or wanted > 2.5\n"
    theirs = robots.load(write_robot(tmp_path, CART_SPEC + GOALS + expressions, "expressions.yaml")).task.for_policies
    ours = robots.load(write(), allow_code=True).task
    assert ours.rewarded
    random = np.random.default_rng(0)
    state, action = random.normal(0, 4, (2, 50, 3)), random.uniform(-1, 1, (2, 50, 1))
    learnt = ours.for_policies
    reward = learnt.reward(state, action, state)
    assert reward.dtype == np.float64
    np.testing.assert_array_equal(reward, theirs.reward(state, action, state))
    np.testing.assert_array_equal(learnt.terminated(state), theirs.terminated(state))
    assert ours.reward(state, action, state).tolist() == np.zeros((2, 50)).tolist()  # a log has no goals


def test_a_reset_is_drawn_again_from_the_same_key(write):
    simulator = simulation.make(robots.load(write(), allow_code=True).task.for_policies)
    starts = reset_states(simulator)
    place, speed, wanted = starts(KEY, 500).T
    assert ((wanted - place > 1.0) & (wanted - place < 2.0)).all()
    assert np.ptp(wanted - place) > 0.9
    assert (speed == 0.25).all()
    np.testing.assert_array_equal(starts(KEY, 500), starts(KEY, 500))
    assert (starts(jax.random.key(1), 500) != starts(KEY, 500)).any(1).all()
    environment = CalibratedVectorEnvironment(3, simulator.task)
    observation, _ = environment.reset(seed=0)
    assert len({float(row[0]) for row in observation}) == 3


def test_only_who_allows_it_runs_the_file(write):
    path = write("raise SystemExit(3)")
    line = path.read_text().splitlines().index("python: task.py") + 1
    with pytest.raises(
        NotAllowed, match=rf"robot.yaml, line {line}: the spec names the Python file task.py, .*--allow"
    ):
        robots.load(path)
    source = robots.load(write(), allow_code=True).task.source
    with pytest.raises(NotAllowed, match=r"this run keeps, with the spec robot.yaml, the Python file task.py"):
        robots.restore(source)


def test_a_run_keeps_the_file(write):
    path = write()
    task = robots.load(path, allow_code=True).task
    source = json.loads(json.dumps(task.source))
    assert robots.restore(source, allow_code=True).task is task
    write(FUNCTIONS.replace("0.1 * push", "0.2 * push"))
    changed = robots.load(path, allow_code=True).task
    assert changed.source["python"]["sha256"] != source["python"]["sha256"]
    state, push = np.zeros((1, 3)), np.ones((1, 1))
    again = robots.restore(source, allow_code=True).task
    assert [one.for_policies.reward(state, push, state).item() for one in (again, changed)] == [0.0, -1.0]
    source["python"]["text"] += "\n"
    with pytest.raises(MadocError, match=r"the text of task.py is not what its checksum says; restore"):
        robots.restore(source, allow_code=True)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("def reward(:", "line 1: its import failed with SyntaxError"),
        ("\nimport nothing_like_it", "line 2: its import failed with ModuleNotFoundError"),
        ("raise SystemExit(0)", "its import failed with SystemExit"),
        ("def rewards(place): return place", "task.py defines none of the functions reward, end, reset; define one"),
        ("reward = 3", "expected reward as a function, got int"),
        ("def reward(plaice): return plaice", "task.py, reward: there is nothing called 'plaice' .*nearest: place"),
        ("def end(push): return push > 0", "task.py, end: there is nothing called 'push'"),
        ("def reward(**all): return 0", "expected arguments by name"),
        ("def reward(place): return place.mean()", r"a value for every row, shape \(2, 3\), got shape \(\);"),
        ("def reward(place): return ['a']", "expected an array of numbers, got <U1"),
        ("def end(place): return place", "expected an array of true and false, got float64"),
        ("def reward(place):\n    place += 1\n    return place", "task.py, line 2: reward failed with ValueError"),
        ("def reset(random, count): return 3", r'expected {"position\(JOINT\)": values, ...}, got int'),
        ("def reset(random, count): return {'position(rial)': 0}", "the model has no joint 'rial'; nearest: rail"),
        ("def reset(random, count): return {'position(rail)': 0}", r"for position\(rail\), shape \(3,\), got shape"),
        ("#" * 200_001, "a file of functions at most 200,000"),
    ],
)
def test_mistakes_in_the_file(write, text, sentence):
    with pytest.raises(MadocError, match=sentence) as refusal:
        robots.load(write(text), allow_code=True)
    assert str(refusal.value).startswith("robot.yaml, line ")


@pytest.mark.parametrize(
    ("spec", "sentence"),
    [
        ("python: ../task.py", "expected a Python file inside the folder of the spec, got ../task.py"),
        ("python: other.py", "there is no Python file other.py beside the spec"),
        ("python: cart.xml", "there is no Python file cart.xml beside the spec"),
        ("python: task.py\nend: place > 3", "end: is here and a function in task.py; keep one"),
    ],
)
def test_mistakes_in_the_spec(write, spec, sentence):
    with pytest.raises(MadocError, match=sentence):
        robots.load(write(spec=f"{CART_SPEC}{GOALS}{spec}\n"), allow_code=True)
