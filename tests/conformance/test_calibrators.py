"""What every calibrator must keep to. A method that is not in the dictionary here fails."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

import madoc.data.targets
from madoc import simulation
from madoc.calibration import (
    CALIBRATORS,
    CalibrationProblem,
    CalibrationResult,
    CmaEs,
    Droid,
    Dropo,
    LeastSquares,
    Npe,
    Oted,
    Uncalibrated,
    calibrate,
)
from madoc.data import Dataset, Disturbance, disturb, observed_task
from madoc.errors import MadocError
from madoc.parameters import Parameter
from madoc.runs import checkpoint
from madoc.runs.run_folder import RunFolder
from madoc.types import Epoch, entry_of
from robots import ARM_TRUTH, CountingSimulator, recorded, two_link_arm

KEY = jax.random.key(0)
BUDGET = 400
PROBING = 64 * 11  # rows x (2 d + 1): what finding parameters that change nothing costs


def small(name):
    """A Madoc whose epochs take milliseconds."""
    method = CALIBRATORS[name].make()
    agents = replace(method.agents, hidden=(8,), critic_hidden=(8,), batch=16, actor_batch=8)
    tiny = {"hidden": (8,), "cloning_epochs": 2, "cloning_updates": 3, "grouping_epochs": 2, "grouping_updates": 3}
    tiny |= {"regression_hidden": (8,), "regression_epochs": 2, "regression_updates": 3, "horizon": 5}
    tiny |= {"epoch_steps": 80, "updates": 3, "draws": 4, "batch": 16, "replay_capacity": 300, "agents": agents}
    return replace(method, **tiny)


METHODS = {
    **{name: small(name) for name in CALIBRATORS if name.startswith("madoc")},
    "least-squares": LeastSquares(windows=6, search_windows=3, searches=2, search_epochs=2, tolerance=0.0),
    "least-squares, windows": LeastSquares(horizon=3, windows=4, search_windows=2, search_epochs=1, tolerance=0.0),
    "least-squares, estimating": LeastSquares(
        initial_states="estimated", horizon=3, windows=4, search_windows=2, search_epochs=1, tolerance=0.0
    ),
    "oted": Oted(draws=6, rows=2, horizon=5, updates=2, batch=16, hidden=(8,), cloning_epochs=2, cloning_updates=3),
    "oted, free running": Oted(
        "policy", draws=4, horizon=5, updates=2, batch=16, hidden=(8,), cloning_epochs=0, sensor_noise=0.0
    ),
    "dropo": Dropo(draws=4, transitions=3, sensor_noise=0.0),
    "e-dropo": Dropo(draws=4, transitions=3, sensor_noise=0.0, entropy_weight=0.1),
    "droid": Droid(horizon=3, windows=3),
    "cma-es": CmaEs(rows=9),
    "cma-es-distribution": CmaEs("distribution", rows=9, features=7),
    "cma-es, acting": CmaEs(
        "distribution",
        "policy",
        rows=2,
        horizon=4,
        features=7,
        hidden=(8,),
        cloning_epochs=2,
        cloning_updates=3,
        batch=16,
        sensor_noise=0.0,
    ),
}
METHODS["npe"] = Npe(
    draws=8,
    rows=2,
    horizon=5,
    epochs=1,
    hidden=(8,),
    fitting_epochs=2,
    updates=3,
    batch=16,
    replay_capacity=300,
    flow_layers=1,
    flow_width=4,
    flow_updates=8,
    samples=50,
    cloning_epochs=2,
    cloning_updates=3,
    cloning_batch=16,
    sensor_noise=0.0,  # estimating it takes seconds
)
IDLE = {"nominal": Uncalibrated(), "uniform": Uncalibrated(randomised=True)}


@pytest.fixture(scope="module")
def task():
    return two_link_arm()


@pytest.fixture(scope="module")
def dataset(task):
    return recorded(task, ARM_TRUTH, 200, jax.random.key(100))


@pytest.fixture
def simulator(task):
    return CountingSimulator(simulation.make(task, threads=1))


@pytest.fixture
def problem(dataset, simulator):
    return CalibrationProblem(dataset, simulator)


QUICK = (
    "madoc",
    "least-squares",
    "oted",
    "dropo",
    "droid",
    "cma-es-distribution",
    "npe",
)  # the others differ by a value; `make test-slow` holds them to every rule too


def quick_and_slow(names):
    return [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in names]


@pytest.fixture(params=quick_and_slow(METHODS))
def method(request):
    return METHODS[request.param]


def without_seconds(result):
    return {name: value for name, value in result.to_json().items() if name != "seconds"}


def through_all_stages(method, problem, *, key=KEY):
    """Every state, and the epoch that made it, until the second epoch of calibration is done."""
    state = method.init(problem, key)
    yield Epoch(stage="init"), state
    calibrated = 0
    while calibrated < 2:
        state, epoch = method.step(problem, state)
        calibrated += epoch.stage == "calibrating"
        yield epoch, state


def until_spent(method, problem):
    """The epochs until the budget is spent or the method stops by itself, and the last state."""
    state, epochs = method.init(problem, KEY), []
    while sum(epoch.control_steps - epoch.unbudgeted for epoch in epochs) < BUDGET:
        state, epoch = method.step(problem, state)
        epochs.append(epoch)
        if epoch.converged:
            break
    return epochs, state


def test_no_calibrator_is_forgotten():
    assert set(CALIBRATORS) <= {*METHODS, *IDLE}, "add the new calibrator to METHODS"


@pytest.mark.parametrize("name", CALIBRATORS)
def test_a_method_is_recognised_as_the_entry_it_was_made_from(name):
    assert entry_of(CALIBRATORS[name].make(), CALIBRATORS).name == CALIBRATORS[name].name == name
    assert CALIBRATORS[name].summary
    assert CALIBRATORS[name].paper
    assert 1900 < CALIBRATORS[name].year < 2100


def test_the_result_is_sound_and_the_budget_kept(method, problem, simulator, task):
    result = calibrate(method, problem, key=KEY, budget=BUDGET, truth=ARM_TRUTH)
    space = task.parameters
    assert result.status in ("finished", "converged")
    assert result.control_steps == simulator.rows
    epochs = [epoch for epoch, _ in through_all_stages(method, problem)]
    largest = max(epoch.control_steps - epoch.unbudgeted for epoch in epochs)
    grouping = sum(epoch.unbudgeted for epoch in epochs)
    assert BUDGET <= result.control_steps - PROBING - grouping < BUDGET + largest
    assert np.isfinite(result.mean).all()
    assert (space.low <= result.mean).all()
    assert (result.mean <= space.high).all()
    assert (result.std >= 0).all()
    assert np.isfinite(result.std).all()
    assert sorted(name for names in result.groups for name in names) == sorted(space.names)
    assert list(result.parameters) == list(space.names)
    assert result.method == entry_of(method, CALIBRATORS).name
    assert result.error["per_parameter"].keys() == ARM_TRUTH.keys()
    assert str(result)
    told = result.to_json()
    assert CalibrationResult.from_json(json.loads(json.dumps(told))).to_json() == told


def test_stopped_and_resumed_equals_uninterrupted_and_another_seed_differs(method, problem, tmp_path):
    whole, other = (calibrate(method, problem, key=jax.random.key(seed), budget=BUDGET) for seed in (0, 1))
    assert (whole.mean != other.mean).any()
    assert (whole.seed, other.seed) == (0, 1)
    with RunFolder.create(tmp_path / "run", {"seed": 0}) as folder:
        part = calibrate(method, problem, key=KEY, budget=BUDGET // 2, folder=folder)
        assert part.control_steps < whole.control_steps
        resumed = calibrate(method, problem, key=KEY, budget=BUDGET, folder=folder, resume=True)
        assert without_seconds(resumed) == without_seconds(whole)
        again = calibrate(method, problem, key=KEY, budget=BUDGET, folder=folder, resume=True)
        assert again == resumed
        assert json.loads(folder.result.read_text()) == resumed.to_json()


def test_the_layout_of_the_state_never_changes(method, problem):
    expected, seen = None, []
    for epoch, state in through_all_stages(method, problem):
        expected = expected or checkpoint.layout(state)
        seen.append(epoch.stage)
        assert checkpoint.difference(checkpoint.layout(state), expected) is None, epoch.stage
        assert checkpoint.first_non_finite(state) is None, epoch.stage
    assert seen[-1] == "calibrating"


def test_metrics_are_finite_numbers_and_the_preparation_costs_no_budget(method, problem):
    epochs, _ = until_spent(method, problem)
    assert all(np.isfinite(value) for epoch in epochs for value in epoch.metrics.values())
    prepared = [epoch.fraction for epoch in epochs if epoch.fraction is not None]
    assert prepared == sorted(prepared)
    assert prepared[-1:] in ([], [1.0])
    assert all(epoch.control_steps == epoch.unbudgeted for epoch in epochs if epoch.fraction is not None)
    assert set(entry_of(method, CALIBRATORS).shown) & epochs[-1].metrics.keys()


class Poison:
    """Raises whatever is done with it."""

    def _refuse(self, *_):
        raise AssertionError("the truth was read")

    __getattr__ = __getitem__ = __iter__ = __len__ = __call__ = __eq__ = __bool__ = __contains__ = _refuse
    __hash__ = None


def test_the_truth_is_never_read(method, dataset, simulator, monkeypatch):
    poisoned = replace(dataset, true_parameters=None)
    object.__setattr__(poisoned, "true_parameters", Poison())  # past the suite's type checker, which would read it
    monkeypatch.setattr(madoc.data.targets, "PAPER_TRUTH", Poison())
    monkeypatch.setattr(madoc.data.targets, "paper_truth", Poison())
    monkeypatch.setattr("madoc.evaluation.calibration_error", Poison())
    problem = CalibrationProblem(poisoned, simulator)
    assert problem.dataset.true_parameters is None
    calibrate(method, problem, key=KEY, budget=BUDGET)


def test_the_result_is_the_same_whatever_the_truth(method, problem, dataset, simulator):
    lying = replace(dataset, true_parameters=dict.fromkeys(ARM_TRUTH, 0.3))
    told = [
        calibrate(method, CalibrationProblem(rows, simulator), key=KEY, budget=BUDGET).parameters
        for rows in (dataset, lying)
    ]
    assert told[0] == told[1]


class Fragile(CountingSimulator):
    """Explodes under light forearms."""

    def bind(self, parameters):
        system = super().bind(parameters)
        roll_out = system.roll_out

        def exploding(state, actions, force=None):
            following = roll_out(state, actions, force)
            following[parameters[:, 2] < 0.5] = np.nan
            return following

        system.roll_out = exploding
        return system


def test_draws_that_explode_are_left_out_and_counted(method, dataset, task):
    problem = CalibrationProblem(dataset, Fragile(simulation.make(task, threads=1)))
    epochs, state = until_spent(method, problem)
    assert checkpoint.first_non_finite(state) is None
    estimate = method.estimate(problem, state)
    assert np.isfinite(estimate.mean).all()
    assert 0 < estimate.failures < sum(epoch.control_steps for epoch in epochs)
    result = calibrate(method, problem, key=KEY, budget=BUDGET)
    (warning,) = (told for told in result.warnings if "exploded" in told)
    steps = result.control_steps - PROBING
    assert f"{estimate.failures:,} simulated rows or windows exploded, in {steps:,} control steps" in warning


def test_nothing_is_traced_again(method, problem, traced):
    *_, (epoch, state) = through_all_stages(method, problem)
    assert epoch.stage == "calibrating"
    before = traced()
    for _ in range(10):
        state, _ = method.step(problem, state)
    assert traced() == before


def test_data_of_another_robot_is_refused(dataset, simulator):
    with pytest.raises(MadocError, match="recorded from hopper, the simulator is two_link_arm"):
        CalibrationProblem(replace(dataset, task_name="hopper"), simulator)


@pytest.fixture
def blind(dataset):
    return CalibrationProblem(dataset, simulation.make(replace(two_link_arm(), state_from_observation=None), threads=1))


@pytest.mark.parametrize("name", quick_and_slow(name for name in METHODS if not name.startswith(("madoc", "npe"))))
def test_logged_starts_without_states_are_refused(name, blind):
    method = METHODS[name]
    if isinstance(method, Oted | CmaEs):
        method = replace(method, starts="logged")
    with pytest.raises(MadocError, match="does not determine its state, so nothing can start at logged states"):
        calibrate(method, blind, key=KEY, budget=BUDGET)


def test_madoc_needs_no_states(blind):
    assert calibrate(METHODS["madoc"], blind, key=KEY, budget=BUDGET).status == "finished"


UNSEEING = (
    *("madoc", "least-squares", "least-squares, estimating", "oted, free running"),
    *("cma-es, acting", "npe", "nominal", "uniform"),
)


@pytest.mark.parametrize("name", UNSEEING)
def test_hidden_velocities_leave_methods_that_need_no_states(dataset, name):
    whole = replace(two_link_arm(), velocities=2)
    hidden = disturb(dataset, Disturbance(hidden_velocities=True), whole, KEY)
    problem = CalibrationProblem(hidden, simulation.make(observed_task(whole, hidden), threads=1))
    result = calibrate((METHODS | IDLE)[name], problem, key=KEY, budget=BUDGET)
    assert result.status in ("finished", "converged")
    assert any("hides velocities" in warning for warning in result.warnings)


def test_data_that_shows_other_observations_is_refused(dataset, simulator):
    hidden = disturb(dataset, Disturbance(hidden_velocities=True), replace(two_link_arm(), velocities=2), KEY)
    with pytest.raises(MadocError, match="the data has 2 values per observation, the simulator's two_link_arm shows 4"):
        CalibrationProblem(hidden, simulator)


@pytest.mark.parametrize("name", IDLE)
def test_what_simulates_nothing_costs_nothing(problem, simulator, task, tmp_path, name):
    with RunFolder.create(tmp_path / "run", {"seed": 0}) as folder:
        result = calibrate(IDLE[name], problem, key=KEY, budget=1, truth=ARM_TRUTH, folder=folder)
        again = calibrate(IDLE[name], problem, key=KEY, budget=1, truth=ARM_TRUTH, folder=folder, resume=True)
    assert again == result
    assert (result.status, result.control_steps, simulator.rows) == ("converged", 0, 0)
    assert (result.mean == task.parameters.middle).all()
    width = task.parameters.high - task.parameters.low
    assert result.std == pytest.approx(width / 12**0.5 if name == "uniform" else 0.0 * width)
    assert CalibrationResult.from_json(json.loads(json.dumps(result.to_json()))) == result


def test_a_parameter_that_changes_nothing_is_refused_before_any_budget_is_spent(method, dataset: Dataset, monkeypatch):
    # Contacts are off, so friction is never felt.
    task = two_link_arm(Parameter("body_mass", "fore", 0.2, 1.0), Parameter("geom_friction", "fore", 0.5, 2.0))
    problem = CalibrationProblem(dataset, simulation.make(task, threads=1))
    monkeypatch.setattr(type(method), "step", Poison())
    with pytest.raises(MadocError, match=r"geom_friction\.fore changes no next state in 200 logged rows; remove it"):
        calibrate(method, problem, key=KEY, budget=BUDGET)


@pytest.mark.parametrize("truth", [{"gravity": -9.81}, ARM_TRUTH | {"body_mass.tail": 1.0}])
def test_a_truth_of_other_parameters_is_refused(method, problem, truth):
    with pytest.raises(MadocError, match="expected values for exactly"):
        calibrate(method, problem, key=KEY, budget=BUDGET, truth=truth)


def test_no_budget_is_refused(method, problem):
    with pytest.raises(MadocError, match="budget of at least 1 control step, got 0"):
        calibrate(method, problem, key=KEY, budget=0)


def test_one_parameter_can_be_calibrated_alone(dataset):
    task = two_link_arm().with_parameters(["dof_damping.elbow"])
    problem = CalibrationProblem(replace(dataset, true_parameters=None), simulation.make(task, threads=1))
    result = calibrate(METHODS["madoc"], problem, key=KEY, budget=BUDGET)
    assert result.groups == [["dof_damping.elbow"]]
