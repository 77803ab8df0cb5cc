"""Forecasts of how long methods would take on this machine, from a second of each."""

import time
from dataclasses import dataclass, replace

import jax

from madoc.calibration import CalibrationProblem, LeastSquares, Npe
from madoc.errors import MadocError
from madoc.report.words import duration

REFINING_EPOCHS = 6
"""Number of steps on all windows that least squares usually takes."""
PREPARATION = 1.15
"""Ratio of the time of a whole run of NPE to that of its rounds: cloning, and the posterior of each round."""


@dataclass(frozen=True)
class Forecast:
    """Expected duration of a method and the control steps that it learns from.

    `seconds` is None where it refuses the data.
    """

    method: str
    seconds: float | None
    control_steps: int
    refusal: str = ""

    @property
    def sentence(self) -> str:
        """The forecast in words."""
        if self.seconds is None:
            return f"{self.method} would refuse: {self.refusal}"
        return f"{self.method}: about {duration(self.seconds)} for {self.control_steps:,} control steps"


def forecast(problem: CalibrationProblem, *, budget: int) -> tuple[Forecast, ...]:
    """Forecasts of least squares until it settles, and of NPE for a budget of control steps, with their defaults.

    Least squares takes one step of its search, NPE two epochs of each kind, the first of which compiles.
    """
    return (_least_squares(problem), _npe(problem, budget))


def _least_squares(problem: CalibrationProblem) -> Forecast:
    method, name = LeastSquares(), "least-squares"
    try:
        state = method.init(problem, jax.random.key(0))
    except MadocError as error:
        return Forecast(name, None, 0, str(error))
    started = time.monotonic()
    state, epoch = method.step(problem, state)
    seconds = time.monotonic() - started
    total = method.whole_run(problem, state, refining_epochs=REFINING_EPOCHS)
    return Forecast(name, seconds / epoch.control_steps * total, total)


def _npe(problem: CalibrationProblem, budget: int) -> Forecast:
    usual, name = Npe(), "npe"
    method = replace(usual, cloning_epochs=0, epochs=2, fitting_epochs=2)
    try:
        state, times = method.init(problem, jax.random.key(0)), []
        for _ in range(method.epochs + method.fitting_epochs):
            started = time.monotonic()
            state, epoch = method.step(problem, state)
            times.append((time.monotonic() - started, epoch.control_steps))
    except MadocError as error:
        return Forecast(name, None, 0, str(error))
    (_, _), (simulating, steps), (_, _), (fitting, _) = times  # the first of each compiles
    a_round = usual.epochs * simulating + usual.fitting_epochs * fitting
    return Forecast(name, PREPARATION * a_round * budget / (usual.epochs * steps), budget)
