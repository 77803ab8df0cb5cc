import os
import subprocess
import sys

import jax
import pytest
from command_line import SOURCE

import madoc


def loaded_by(code):
    """Which heavy packages some code imports, in a process of its own."""
    program = f"{code}; import sys; print(*({{'jax', 'mujoco', 'equinox', 'rich'}} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"PYTHONPATH": str(SOURCE)},
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


def test_a_robots_computer_needs_numpy_alone():
    assert loaded_by("import madoc; from madoc.numpy_policy import NumpyPolicy") == set()


def test_the_command_line_starts_without_jax():
    assert "jax" not in loaded_by("import madoc.commands.main")


def test_public_names_are_there():
    assert set(madoc.__all__) <= set(dir(madoc))
    for name in madoc.__all__:
        assert getattr(madoc, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'calibrated'"):
        _ = madoc.calibrated


def test_the_python_of_the_readme_runs():
    task = madoc.tasks.hopper()
    simulator = madoc.simulation.make(task)
    dataset = madoc.record(simulator, "medium", transitions=1_000, key=jax.random.key(0))
    problem = madoc.CalibrationProblem(dataset, simulator)
    method = madoc.Madoc(groups="one", starts="replay", updates=2, epoch_steps=500)
    result = madoc.calibrate(method, problem, key=jax.random.key(1), budget=1_000, truth=dataset.true_parameters)
    assert "gravity" in str(result)
    learner = madoc.SAC(warmup_steps=500, updates_per_step=0.01, epoch_steps=500, hidden=(16, 16))
    policy = madoc.learn_policy(
        learner, madoc.PolicyProblem(simulator, result.mean), key=jax.random.key(2), budget=1_000
    )
    target = simulator.parameters.vector(dataset.true_parameters)
    summary = madoc.evaluate(policy.policy, simulator, target, key=jax.random.key(3), episodes=2).summary()
    assert summary["episodes"] == 2
