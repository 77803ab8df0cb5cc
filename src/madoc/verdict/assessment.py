"""An estimate judged on rows that no method has seen, without any truth: `assess` does all of it."""

import time
from dataclasses import dataclass, replace
from functools import partial

import jax
import numpy as np
from jaxtyping import Float

from madoc.calibration import CalibrationProblem, CalibrationResult
from madoc.calibration.holdout import HoldOut, OpenLoop, ToldApart, Verdict
from madoc.data import Dataset
from madoc.errors import MadocError
from madoc.runs.machine import one_blas_thread
from madoc.simulation.base import SIMULATED, Simulator
from madoc.verdict.adequacy import about_imitated, with_widened_intervals
from madoc.verdict.bench import Bench
from madoc.verdict.fitted import fitted
from madoc.verdict.judge import beats_mid_range, explains_all, judge
from madoc.verdict.open_loop import open_loop
from madoc.verdict.predicted import noise_hides_gain, noisy_contacts, predicted
from madoc.verdict.records import EXCHANGED, TESTS, judged

LATER = "predictions over longer times"
"""A part of judging without which nothing is tested."""
NEEDED = frozenset({EXCHANGED, TESTS, LATER})
"""All such parts."""
NO_BETTER = "the estimate predicts the rows held out no better than mid-range does, so it is not settled"


@dataclass(frozen=True)
class Assessment:
    """How well an estimate explains the hold-out. Printing it shows the verdict.

    Attributes:
        verdict: What to make of the estimate: a word and a sentence.
        holdout: The numbers behind the verdict.
        result: The result with both, its intervals widened where the data does not exclude a term the model lacks.
    """

    verdict: Verdict
    holdout: HoldOut
    result: CalibrationResult

    def __str__(self) -> str:
        return str(self.verdict)


@one_blas_thread()
def assess(
    result: CalibrationResult,
    held_out: Dataset | Bench,
    *,
    training: Dataset | None = None,
    simulator: Simulator | None = None,
    seed: int = 0,
) -> Assessment:
    """Judge a calibration by rows that its method has not seen.

    Args:
        result: What `calibrate` returned.
        held_out: The other part of the data, as `dataset.split` gives it, or a `Bench` for several results.
        training: The rows that were calibrated to. Only a result read from a file needs them.
        simulator: The simulator that was calibrated. Only a result read from a file needs it.
        seed: Seed of the rollouts that are compared where states cannot be rebuilt from the data.

    Returns:
        The verdict and the numbers behind it.

    Raises:
        MadocError: It is not known what was calibrated to, or the hold-out is too small or of another robot.
    """
    bench = held_out
    if isinstance(bench, Dataset):
        bench = Bench(_problem_of(result, training, simulator), bench, jax.random.key(seed), _split_sentence(bench))
    if bench.simulator.parameters.names != tuple(result.parameters):
        raise MadocError(
            f"expected a simulator with the result's parameters {', '.join(result.parameters)}, got one with "
            f"{', '.join(bench.simulator.parameters.names)}"
        )
    # Predictions over longer times are the model's as it is.
    tested = bench.with_timestep_of(result.timesteps, result.test_timesteps)
    bench.left_out.clear()
    began, simulated = time.monotonic(), SIMULATED.control_steps
    point = np.clip(bench.simulator.parameters.to_unit(result.mean), -1.0, 1.0)
    bench.tell("predictions of single steps and short windows")
    fits_starts = _fits_starts(tested, point)
    # Predictions come first where all depends on them: an unsettled search is of use by them alone, and from fitted
    # starts they take much of the time.
    half = (bench.simulator.parameters.high - bench.simulator.parameters.low) / 2.0
    covariance = None if result.covariance is None else result.covariance / np.outer(half, half)
    predict = partial(_predictions, bench, point, fits_starts, covariance, np.array([*result.random_forces.values()]))
    predictions = None if result.settled and not fits_starts else predict()
    holdout = measured(tested, result.mean, result.interval, fits_starts=fits_starts)
    if predictions is None:
        noise = np.array(list(holdout.noise.values())) / bench.change[: len(holdout.noise)]
        predictions = predict(noise)
    whole, simulated = holdout.tested and LATER not in bench.left_out, SIMULATED.control_steps - simulated
    holdout = replace(holdout, open_loop=predictions, tested=whole, control_steps=simulated)
    widened = with_widened_intervals(result, holdout)
    verdict = judge(
        holdout,
        settled=result.settled,
        unlike_noise=result.unlike_noise,
        effective=result.effective,
        in_time=NEEDED.isdisjoint(bench.left_out),
        combinations=widened.combinations,
    )
    better = beats_mid_range(holdout) or explains_all(holdout)
    warnings = [*widened.warnings, *about_imitated(holdout), *([] if better else [NO_BETTER])]
    if bench.left_out:
        warnings.append(
            f"the budget left no time for these parts of judging: {'; '.join(bench.left_out)} (give it a larger one "
            "with --budget)"
        )
    settled = result.settled and better
    widened = replace(widened, verdict=verdict, holdout=holdout, warnings=warnings, settled=settled)
    widened = replace(widened, judging_seconds=round(time.monotonic() - began, 3))
    return Assessment(verdict, holdout, widened)


def measured(
    bench: Bench,
    mean: Float[np.ndarray, " d"],
    interval: Float[np.ndarray, "d 2"] | None = None,
    *,
    fits_starts: bool | None = None,
) -> HoldOut:
    """The hold-out's numbers for an estimate and its 95 % intervals in physical units, by the measure its states allow.

    Where states can be rebuilt, but bodies touch and the sensors' noise is not small for them, or it hides what
    parameters do, initial states are fitted too. `fits_starts` is whether they are; None is to find that out.

    Raises:
        MadocError: No state of the hold-out can be rebuilt though the robot's observations determine it.
    """
    point = np.clip(bench.simulator.parameters.to_unit(mean), -1.0, 1.0)
    fits_starts = _fits_starts(bench, point) if fits_starts is None else fits_starts
    if bench.states_known and not fits_starts:
        return predicted(bench, point, interval)
    if bench.fitted is not None:
        return fitted(bench, bench.fitted, point, interval)
    noise = bench.problem.noise_by_differences / bench.change
    areas = bench.area_at_mid_range, bench.area_of_rollouts(point)
    record = partial(ToldApart, area_at_mid_range=areas[0], area_at_estimate=areas[1])
    return judged(record, bench, point, interval, at=point, residual=noise, by_model=(), noise=noise)


def _fits_starts(bench: Bench, point: Float[np.ndarray, " d"]) -> bool:
    """Whether initial states of the hold-out are fitted, as they are not known or too noisy."""
    noisy = not bench.states_known or noisy_contacts(bench, point) or noise_hides_gain(bench)
    return noisy and bench.fittable is not None


def _predictions(
    bench: Bench,
    point: Float[np.ndarray, " d"],
    fits_starts: bool,
    covariance: Float[np.ndarray, "d d"] | None,
    forces: Float[np.ndarray, " dof"],
    noise: Float[np.ndarray, " observation"] | None = None,
) -> tuple[OpenLoop, ...]:
    """Predictions over longer times, if there is time for them."""
    if not bench.begins(LATER):
        return ()
    return open_loop(bench, point, fits_starts=fits_starts, covariance=covariance, noise=noise, forces=forces)


def _problem_of(result: CalibrationResult, training: Dataset | None, simulator: Simulator | None) -> CalibrationProblem:
    problem = result.problem
    if problem is not None:
        return CalibrationProblem(training or problem.dataset, simulator or problem.simulator)
    if training is None or simulator is None:
        raise MadocError(
            "this result was read from a file, which does not hold the data and the simulator it was calibrated with; "
            "give training=, the rows that were calibrated to, and simulator=, the simulator that was calibrated, too"
        )
    return CalibrationProblem(training, simulator)


def _split_sentence(held_out: Dataset) -> str:
    count = len(held_out.episode_starts)
    return f"{len(held_out):,} rows in {count} episode{'s' * (count != 1)} were held out"
