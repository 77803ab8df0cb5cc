from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from planted_logs import ROBOTS, log_of

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.data import Disturbance, disturb
from madoc.data.dataset import Dataset
from madoc.identification.windows import HORIZONS
from madoc.verdict.bench import Bench
from madoc.verdict.predicted import noisy_contacts
from madoc.verdict.prediction import nearby_best, replays_of
from own_robots import BOUNCER, BOUNCER_SPEC, write_robot
from robots import counted, recorded

TASK, TRUTH = ROBOTS["spring"]
SIMULATOR = simulation.make(TASK, threads=1)
SCALE = np.array([0.1, 0.2])


def test_residuals_are_simulated_less_logged_in_steps_changes():
    replays = replays_of(log_of("spring", rows=300), SIMULATOR, SCALE, HORIZONS)
    assert replays.horizons == (1, 5, 20)
    points = np.stack([np.zeros(3), TASK.parameters.to_unit(TASK.parameters.vector(TRUTH))])
    residuals = replays.residuals(points)
    assert residuals.shape == (2, len(replays.windows), 20, 2)
    assert np.abs(residuals[1]).max() < 1e-10
    step = SIMULATOR.bind(TASK.parameters.middle[None]).step(
        replays.windows.states[None, :1], replays.windows.actions[None, :1, 0]
    )
    assert residuals[0, 0, 0] == pytest.approx((step[0, 0] - replays.windows.following[0, 0]) / SCALE)


def test_a_failed_window_counts_as_the_worst_that_did_not():
    replays = replace(replays_of(log_of("spring", rows=300), SIMULATOR, SCALE, HORIZONS), horizons=(2,))
    residuals = np.full((1, 3, 2, 2), 0.5)
    residuals[0, 0, 1], residuals[0, 1, 1] = (-7.0, 0.1), np.nan
    assert replays.magnitudes(residuals)[:, 0, 0].tolist() == [[7.0, 0.1], [7.0, 1.0], [0.5, 0.5]]


def test_horizons_that_no_episode_lasts_are_left_out():
    short = log_of("spring", rows=600)
    single = disturb(short, Disturbance(shuffled="rows"), TASK, jax.random.key(0))
    assert replays_of(single, SIMULATOR, SCALE, HORIZONS).horizons == (1,)
    assert isinstance(short, Dataset)


def test_nearby_the_truth_is_found():
    replays = replays_of(log_of("spring", rows=300), SIMULATOR, SCALE, HORIZONS)
    truth = TASK.parameters.to_unit(TASK.parameters.vector(TRUTH))
    points, spent = counted(nearby_best, replays, np.clip(truth + 0.2, -1, 1))
    assert points[-1] == pytest.approx(truth, abs=1e-4)
    assert spent % (7 * len(replays.windows)) == 0
    assert 2 <= spent / (7 * len(replays.windows)) <= 8


def test_random_forces_add_up_with_random_signs_and_a_constant_one_adds_up_to_more():
    # A push of the speed in each step leaves n pushes after n steps if all have one sign, about √n if it is random.
    replays = replays_of(log_of("spring", rows=600), SIMULATOR, SCALE, HORIZONS)
    truth = TASK.parameters.to_unit(TASK.parameters.vector(TRUTH))
    nothing = np.zeros((1, len(replays.windows), 20, 2))
    assert replays.random_floor(truth, nothing, nothing[0]) is nothing
    pushes = np.zeros((len(replays.windows), 20, 2))
    pushes[:, 0, 1] = 0.01
    (floor,) = replays.random_floor(truth, nothing, pushes)
    # After the first step alone it is the push itself, with either sign, in the speed and not in the position.
    assert np.abs(floor[:, 0, 1]) == pytest.approx(0.01)
    assert floor[:, 0, 0] == pytest.approx(0.0)
    assert {-1.0, 1.0} == set(np.sign(floor[:, 0, 1]))
    pushes[:, :, 1] = 0.01
    (floor,) = replays.random_floor(truth, nothing, pushes)
    signs = np.sign(np.diff(np.concatenate([np.zeros((len(floor), 1)), floor[:, :3, 1]], axis=1)))
    assert (signs > 0).mean() == pytest.approx(0.5, abs=0.15)
    assert np.sqrt((floor[:, 4, 1] ** 2).mean()) == pytest.approx(0.01 * np.sqrt(5.0), rel=0.25)


@pytest.mark.parametrize(("noise", "noisy"), [(0.0, False), (0.05, True)])
def test_states_are_noisy_for_contacts_where_residuals_of_single_steps_alternate(tmp_path, monkeypatch, noise, noisy):
    task = robots.load(write_robot(tmp_path, BOUNCER_SPEC, bouncer=BOUNCER)).task
    truth = {"body_mass.trunk": 2.0, "body_mass.leg": 0.5, "dof_damping.knee": 5.0}
    log = recorded(task, truth, 1000, jax.random.key(0))
    read = replace(disturb(log, Disturbance(noise=noise), task, jax.random.key(1)), disturbance=Disturbance())
    train, held = read.split(0.3)
    bench = Bench(CalibrationProblem(train, simulation.make(task, threads=1)), held, jax.random.key(0))
    point = task.parameters.to_unit(task.parameters.vector(truth))
    assert noisy_contacts(bench, point) == noisy
    far = np.array([1.0, 1.0, 1.0])  # no excuse for an estimate that errs by far more than noise
    assert not noisy_contacts(bench, far)
    rows = held.transitions
    loose = replace(held, episode_starts=np.arange(len(held)))
    assert not noisy_contacts(replace(bench, held_out=loose), point)  # no row follows another
    raised = {name: getattr(rows, name) + np.array([10.0, 0, 0, 0]) for name in ("observation", "next_observation")}
    assert not noisy_contacts(replace(bench, held_out=replace(held, transitions=replace(rows, **raised))), point)
    late = replace(rows, action=np.roll(np.asarray(rows.action), -1, axis=0))  # the machine acts a row later
    assert noisy_contacts(replace(bench, held_out=replace(held, transitions=late)), point) == noisy
    for apart, many in ((30, True), (400, False)):  # a ball in flight touches in few rows and in most windows
        touch = partial(lambda each, states, _: np.arange(len(states)) % each == 0, apart)
        monkeypatch.setattr(type(bench.simulator), "contacts", staticmethod(touch))
        assert noisy_contacts(bench, point) == (noisy and many)
