"""`madoc run` of a robot of one's own: from its logs to a verdict, a policy and the exported model."""

import json

import jax
import numpy as np
import pytest
from command_line import FAST_LEARNER, asked_for_json

from madoc import data, robots
from madoc.commands.main import main
from madoc.numpy_policy import NumpyPolicy
from own_robots import CART_SPEC, write_robot
from robots import recorded

EPISODE = """\
goals: [{name: wanted, drawn: "uniform(-1, 1)"}]
reward: exp(-(place - wanted) ** 2)
end: abs(place) > 3
reset: {position(rail): "uniform(-1, 1)"}
"""

LEARNING = [*("--policy-budget", "1000", "--episodes", "3", "--draws", "10", "--quiet", "--policy-set"), *FAST_LEARNER]


@pytest.fixture
def words(tmp_path):
    """The command, with logs of a cart of 1 kg."""
    long, short = (
        write_robot(tmp_path, f"{CART_SPEC}{EPISODE}max_episode_steps: {steps}\n", f"{name}.yaml")
        for name, steps in (("log", 100), ("cart", 10))
    )
    data.save(recorded(robots.load(long).task, {"body_mass.cart": 1.0}, 400, jax.random.key(1)), tmp_path / "log.npz")
    return ["run", short, "--data", tmp_path / "log.npz", *LEARNING]


def test_all_of_it(words, tmp_path, capsys):
    out = tmp_path / "all"
    answer, code = asked_for_json(capsys, [*words, "--out", out])
    assert (answer["calibration"]["verdict"]["word"], code) == ("CALIBRATED", 0)
    assert answer["calibration"]["parameters"]["body_mass.cart"]["estimate"] == pytest.approx(1.0, abs=1e-6)
    assert list(answer["evaluation"]["policies"]) == ["calibrated", "midrange", "truth"]
    assert answer["evaluation"]["over_draws"]["calibrated"]["draws"] == 10
    assert (out / "export" / "model.xml").exists()
    # Place, speed, and the goal.
    policy = NumpyPolicy.load(out / "policy-calibrated" / "policy.npz")
    assert policy.act(np.array([0.0, 0.0, 0.5])).shape == (1,)


def test_a_policy_over_the_distribution_of_the_estimate(words, tmp_path, capsys):
    asked = ["--policy-at", "distribution", "--policy-share", "0.5", "--policy-width", "2", "--no-yardsticks"]
    answer, code = asked_for_json(capsys, [*words, *asked, "--out", tmp_path / "all"])
    assert code == 0
    assert list(answer["evaluation"]["at_estimate"]) == ["distribution"]
    spec = json.loads((tmp_path / "all" / "policy-distribution" / "spec.json").read_text())
    assert (spec["at"], spec["drawing"]) == ("distribution", {"share": 0.5, "width": 2.0})


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (["--policy-share", "0.5"], "--policy-share and --policy-width are of --policy-at distribution"),
        (["--policy-at", "distribution", "--policy-share", "0"], "expected a share of systems to draw above 0"),
        (["--holdout", "1"], "expected a share of the rows to hold out between 0 and 1, got 1"),
        (["--draws", "0"], "expected at least 1 draw, got 0"),
        (["--learner", "rlpd"], "rlpd learns from logged observations, and no log has the goals of cart: wanted;"),
    ],
)
def test_refusals(words, changed, sentence, tmp_path, capsys):
    assert main([str(word) for word in [*words, *changed, "--out", tmp_path / "all"]]) == 2
    assert sentence in capsys.readouterr().err


def test_logs_are_needed(words, capsys):
    assert main(["run", str(words[1])]) == 2
    assert f"expected logs of {words[1]} after --data" in capsys.readouterr().err


FUNCTIONS = """
import numpy as np

def reward(place, push):
    return np.exp(-(place**2)) - 0.01 * push**2

def reset(random, count):
    return {"position(rail)": random.uniform(-1, 1, count)}
"""


def test_a_reward_in_python_is_kept_with_the_run(words, tmp_path, capsys):
    spec, out = tmp_path / "python.yaml", tmp_path / "run"
    spec.write_text(f"{CART_SPEC}python: cart.py\nmax_episode_steps: 10\n")
    (tmp_path / "cart.py").write_text(FUNCTIONS)
    calibrate = ["calibrate", spec, "--data", tmp_path / "log.npz", "--method", "least-squares", "--out", out]
    assert main([*map(str, calibrate)]) == 2
    refusal = (
        "the spec names the Python file cart.py, which would be run; read it, and if you trust it pass --allow-code"
    )
    assert refusal in capsys.readouterr().err
    asked_for_json(capsys, [*calibrate, "--allow-code", "--quiet"])
    (tmp_path / "cart.py").write_text(FUNCTIONS.replace("0.01", "0.02"))
    assert main([*map(str, calibrate), "--allow-code", "--resume"]) == 2
    assert "robot.python.sha256 was" in capsys.readouterr().err
    for command in ("learn", "export"):
        assert main([command, str(out)]) == 2
        assert "this run keeps, with the spec python.yaml, the Python file cart.py" in capsys.readouterr().err
    assert main(["export", str(out), "--allow-code"]) == 0
