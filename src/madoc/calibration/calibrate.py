"""Run a calibrator on a problem."""

from collections.abc import Iterable, Mapping

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Calibrator, Estimate
from madoc.calibration.registry import CALIBRATORS
from madoc.calibration.result import CalibrationResult, ParameterEstimate
from madoc.data.velocities import dof_names
from madoc.evaluation import calibration_error
from madoc.identification.combinations import combinations
from madoc.parameters import Parameter, ParameterSpace
from madoc.runs import loop
from madoc.runs.budget import Budget
from madoc.runs.files import replacing
from madoc.runs.machine import one_blas_thread
from madoc.runs.run_folder import RunFolder
from madoc.simulation.base import SIMULATED
from madoc.simulation.response import refuse_insensitive
from madoc.simulation.write import nominal_values
from madoc.tasks import Task
from madoc.types import State, entry_of

DIVERGED = "the run diverged: the estimate is that of its last checkpoint, which may be where it began"
"""A warning that comes before those of the method."""


@one_blas_thread()
def calibrate(
    method: Calibrator[State],
    problem: CalibrationProblem,
    *,
    key: PRNGKeyArray,
    budget: Budget | str | None = None,
    truth: Mapping[str, float] | Float[np.ndarray, " d"] | None = None,
    folder: RunFolder | None = None,
    resume: bool = False,
    quiet: bool = False,
    checkpoint_every: float = 30.0,
) -> CalibrationResult:
    """Estimate the parameters, and compare the estimate with the truth where that is given.

    The budget counts simulated control steps of any kind, or is a time, as `Seconds(300)` or "300s"; by default it is
    the method's usual one. `truth` is the target's physical values, by name or as a
    vector; only the finished estimate is compared with them. The other arguments are those of `madoc.runs.loop.run`.

    Raises:
        MadocError: The method refuses the problem, a parameter changes no next state, or `loop.run` refuses.
    """
    space = problem.simulator.parameters
    true_values = None if truth is None else space.vector(truth)
    entry = entry_of(method, CALIBRATORS)
    method.init(problem, key)  # a refusal of the method comes before one of the parameters
    probe = problem.probe if entry.simulates else None  # kept by the problem, and so no step of this calibration
    began = SIMULATED.control_steps
    if probe is not None:
        refuse_insensitive(problem.simulator, *probe, key=jax.random.key(0))
    probing = SIMULATED.control_steps - began
    finished = loop.run(
        method,
        problem,
        key=key,
        budget=entry.usual_budget if budget is None else budget,
        folder=folder,
        resume=resume,
        quiet=quiet,
        description=f"{entry.name} on {problem.simulator.task.name}",
        shown=entry.shown,
        checkpoint_every=checkpoint_every,
        trace=lambda state: _trace(space, method.estimate(problem, state)),
    )
    estimate = method.estimate(problem, finished.state)
    forces = estimate.random_forces.tolist()
    told = estimate.covariance if estimate.interval is not None else None
    warnings = [*([DIVERGED] if finished.status == "diverged" else ()), *estimate.warnings]
    if estimate.failures:
        warnings.append(
            f"{estimate.failures:,} simulated rows or windows exploded, in {finished.control_steps:,} control steps, "
            "and were left out; the ranges may hold impossible parameters"
        )
    result = CalibrationResult(
        method=entry.name,
        task=problem.simulator.task.name,
        status=finished.status,
        sentence=finished.sentence,
        control_steps=finished.control_steps + probing,
        seconds=round(finished.seconds, 3),
        seed=int(np.asarray(jax.random.key_data(key))[-1]),
        groups=[[space.names[index] for index in group] for group in estimate.groups or [range(len(space))]],
        parameters=_parameters(problem.simulator.task, estimate),
        warnings=without_repeats(warnings, problem.doubts),
        notes=[*estimate.notes, *problem.notes],
        error=None if true_values is None else calibration_error(estimate.mean, true_values, space),
        covariance=None if estimate.covariance is None else estimate.covariance.tolist(),
        combinations=[] if told is None else list(combinations(space, estimate.mean, told, estimate.quantile)),
        settled=estimate.settled,
        unlike_noise=estimate.unlike_noise,
        effective=estimate.effective,
        random_forces=dict(zip(dof_names(problem.simulator.task), forces, strict=True)) if forces else {},
        timesteps=estimate.timesteps,
        test_timesteps=estimate.test_timesteps,
        group_stability=estimate.group_stability,
        problem=problem,
    )
    if folder is not None:
        if estimate.embeddings is not None:
            with replacing(folder.path / "embeddings.npz") as stream:
                np.savez(stream, allow_pickle=False, names=np.array(space.names), vectors=estimate.embeddings)
        folder.write_json("result.json", result.to_json())
    return result


def _trace(space: ParameterSpace, estimate: Estimate) -> dict[str, float]:
    """The mean and deviation of every parameter, as metrics for the log of the run."""
    columns = zip(space.names, estimate.mean.tolist(), estimate.std.tolist(), strict=True)
    rows = ({f"estimate/{name}": mean, f"std/{name}": std} for name, mean, std in columns)
    return {name: value for row in rows for name, value in row.items() if np.isfinite(value)}


def _parameters(task: Task, estimate: Estimate) -> dict[str, ParameterEstimate]:
    """The estimate of each parameter, by name."""
    space = task.parameters
    intervals = [None] * len(space) if estimate.interval is None else estimate.interval.tolist()
    columns = zip(space.parameters, estimate.mean, estimate.std, intervals, strict=True)
    return {
        row.name: ParameterEstimate(float(mean), float(std), row.low, row.high, row.unit, interval, _given(task, row))
        for row, mean, std, interval in columns
    }


def _given(task: Task, parameter: Parameter) -> float | None:
    """The value in the user's own model as it was given; None where its elements differ, or the model is Madoc's."""
    values = set(nominal_values(task.model, parameter)) if task.source is not None else set()
    return values.pop() if len(values) == 1 else None


def without_repeats(warnings: Iterable[str], doubts: Iterable[str]) -> list[str]:
    """The warnings of a method, then the doubts about the data that the method does not state already.

    It states one that says the same of other parameters before its colon, as that they can hardly be told apart: an
    estimate knows better than a check before it.
    """
    own = list(dict.fromkeys(warnings))
    heads = [f": {sentence.partition(': ')[0]}: " for sentence in own if ": " in sentence]
    new = (doubt for doubt in doubts if not any(doubt.endswith(sentence) for sentence in own))
    return [*own, *(doubt for doubt in new if not any(head in doubt for head in heads))]
