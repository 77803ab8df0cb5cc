import json
import warnings
from dataclasses import replace
from pathlib import Path

import jax
import pytest

from madoc import tasks
from madoc.calibration import CALIBRATORS, CalibrationProblem
from madoc.commands.main import _parse
from madoc.data import Disturbance, disturb, observed_task
from madoc.errors import MadocError
from madoc.pipeline import CalibrationOrder, Reading, Search, Source, fingerprint, split_name
from madoc.pipeline.calibration_stage import prepare
from madoc.pipeline.data_stage import Machine
from madoc.pipeline.methods import candidates_for, choose, hyperparameters, make_method
from madoc.pipeline.orders import parse_settings
from madoc.pipeline.refusals import seed_key, stage_key, truth_of
from madoc.report.records import restored_path, stored_path
from madoc.runs.run_folder import ended, working_folder
from madoc.simulation import make
from robots import SPRING_TRUTH, spring
from robots import recorded as log_of


def test_a_name_is_a_task_and_a_quality():
    assert split_name("hopper-medium-replay") == ("hopper", "medium-replay")
    assert split_name("hopper") == ("hopper", "")


def test_hyperparameters_are_read_as_what_they_are():
    changes = parse_settings(
        (("updates=3e2", "hidden=[64, 32]", "mixing=sum"), ("group-count=null", "agents.bound=3", "features=raw"))
    )
    method = make_method(CALIBRATORS, "madoc", changes)
    assert (method.updates, method.hidden, method.mixing, method.group_count) == (300, (64, 32), "sum", None)
    assert method.features == "raw"
    assert method.agents.bound == 3.0
    assert hyperparameters(method)["agents"]["bound"] == 3.0


def test_what_the_command_line_reads_is_the_order_that_the_pipeline_carries_out():
    words = "calibrate hopper --data a.npz b.npz --noise 0.1 --hide-velocities --level easy --budget 5 --set updates=2"
    reading = Reading(disturbance=Disturbance(noise=0.1, hidden_velocities=True))
    search = Search(level="easy", budget=5, set=(("updates=2",),))
    expected = CalibrationOrder("hopper", Source(("a.npz", "b.npz"), reading=reading), search)
    assert _parse(words.split()).order == expected
    asked = _parse(["selftest", "hopper", "--data", "a.npz"]).order
    assert (asked.search.method, asked.search.budget, asked.truths) == ("auto", None, 3)
    with pytest.raises(MadocError, match="--friction"):
        _parse(["calibrate", "hopper", "--data", "a.npz", "--friction", "1.2"])


def test_a_preset_keeps_its_own_values():
    paper, changed = (make_method(CALIBRATORS, "madoc-paper", {**change}) for change in ({}, {"updates": 7}))
    assert changed.updates == 7
    assert changed.features == paper.features == "raw"


def test_stages_have_streams_of_their_own():
    keys = [seed_key(0), stage_key(0, "recording"), stage_key(0, "learning"), stage_key(1, "recording")]
    assert len({str(key) for key in keys}) == 4
    assert stage_key(0, "learning") == stage_key(0, "learning")


def test_a_target_binds_what_was_not_calibrated():
    truth = {"gravity": -5.0, "body_mass.torso": 3.3}
    machine = Machine.named("hopper")
    assert truth_of(None, machine.task, ["gravity"], known=truth) == truth
    simulator, parameters = machine.at(truth)
    model = simulator.model(parameters)
    assert model.body("torso").mass[0] == 3.3
    assert model.opt.gravity[2] == -5.0


def test_paths_beside_the_folder_move_with_it(tmp_path):
    folder = tmp_path / "run" / "calibration"
    assert stored_path(tmp_path / "run" / "data.npz", folder) == "../data.npz"
    assert Path(restored_path("../data.npz", folder)).resolve() == tmp_path / "run" / "data.npz"
    elsewhere = tmp_path / "data.npz"
    assert restored_path(stored_path(elsewhere, folder), folder) == str(elsewhere)
    assert restored_path("mujoco/hopper/expert-v0", folder) == "mujoco/hopper/expert-v0"


@pytest.mark.parametrize("kept", [False, True])
def test_a_new_folder_is_taken_away_unless_it_holds_something(tmp_path, kept):
    path = tmp_path / "run"
    with pytest.raises(MadocError, match="no"), working_folder(path, {"seed": 0}, resume=False):
        if kept:
            (path / "checkpoint.npz").touch()
        raise MadocError("no")
    assert path.exists() == kept


def test_a_stage_has_ended_when_its_last_file_is_there(tmp_path):
    assert not ended(tmp_path)
    (tmp_path / "result.json").write_text(json.dumps({"status": "interrupted"}))
    assert not ended(tmp_path)
    (tmp_path / "result.json").write_text(json.dumps({"status": "converged"}))
    assert ended(tmp_path)
    assert not ended(tmp_path, "policy.npz")


def test_physics_is_the_datas_unless_asked_otherwise(recorded):
    source = Source((str(recorded),))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = prepare(CalibrationOrder("hopper", source))
    assert found.simulator.task.physics == found.dataset.physics == "legacy"
    with pytest.warns(UserWarning, match="recorded in legacy physics"):
        asked = prepare(CalibrationOrder("hopper", source, Search(physics="modern")))
    assert asked.simulator.task.physics == "modern"
    assert fingerprint(found.dataset) == fingerprint(asked.dataset)


def test_few_rows_step_like_many():
    """Below eight rows one thread steps them."""
    import numpy as np

    simulator = make(tasks.hopper(), threads=2)
    system = simulator.bind(simulator.parameters.middle[None])
    state = np.repeat(simulator.initial_state[None, None], 16, axis=1)
    action = np.random.default_rng(0).uniform(-1, 1, (1, 16, 3))
    many = system.step(state, action)
    assert (system.step(state[:, :3], action[:, :3]) == many[:, :3]).all()


KEY = jax.random.key(0)


def spring_log(**disturbance):
    """A problem of the spring, and its log disturbed."""
    task = replace(spring(max_episode_steps=100), velocities=1)
    log = disturb(log_of(task, SPRING_TRUTH, 300, KEY), Disturbance(**disturbance), task, KEY)
    return CalibrationProblem(log, make(observed_task(task, log), threads=1))


def test_auto_takes_least_squares_where_it_can():
    name, why = choose(candidates_for({}), spring_log(), KEY)
    assert name == "least-squares"
    assert why == "auto took least-squares: the robot's states can be had from the log"


def test_auto_takes_npe_where_least_squares_refuses_and_says_why():
    methods, problem = candidates_for({}), spring_log(hidden_velocities=True, shuffled="rows")
    with pytest.raises(MadocError) as refusal:
        methods["least-squares"].init(problem, KEY)
    assert choose(methods, problem, KEY) == ("npe", f"auto took npe: least-squares refuses: {refusal.value}")


def test_a_method_that_was_named_is_taken_as_it_is():
    assert choose({"oted": make_method(CALIBRATORS, "oted")}, spring_log(), KEY) == ("oted", None)


def test_what_auto_takes_has_its_usual_budget_unless_one_is_given(recorded):
    source = Source((str(recorded),))
    prepared = prepare(CalibrationOrder("hopper", source))
    assert (prepared.method, prepared.budget, prepared.holdout) == ("auto", None, 0.2)
    taken = prepared.by("madoc")
    assert (taken.method, taken.budget) == ("madoc", 300_000)
    given = prepare(CalibrationOrder("hopper", source, Search(budget=5)))
    assert given.by("least-squares").budget == 5
