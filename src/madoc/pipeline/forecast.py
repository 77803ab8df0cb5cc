"""Forecasts of how long methods would take on this machine, from a second of each."""

import time
from dataclasses import dataclass

import jax

from madoc.calibration import CalibrationProblem, LeastSquares, Madoc
from madoc.errors import MadocError
from madoc.report.words import duration

REFINING_EPOCHS = 6
"""Number of steps on all windows that least squares usually takes."""
PREPARATION = 1.15
"""Ratio of the time of a whole run of Madoc to that of its calibrating epochs: measured with the defaults on Hopper."""


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
    """Forecasts of least squares until it settles, and of Madoc for a budget of control steps, with their defaults.

    Least squares takes one step of its search, Madoc two epochs, the first of which compiles.
    """
    return (_least_squares(problem), _madoc(problem, budget))


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


def _madoc(problem: CalibrationProblem, budget: int) -> Forecast:
    method = Madoc(cloning_epochs=0, regression_epochs=1, regression_updates=1)
    name = "madoc"
    try:
        state = method.init(problem, jax.random.key(0))
        state, _ = method.step(problem, state)
        times = []
        for _ in range(2):
            started = time.monotonic()
            state, epoch = method.step(problem, state)
            times.append(time.monotonic() - started)
    except MadocError as error:
        return Forecast(name, None, 0, str(error))
    epochs = budget / epoch.control_steps
    return Forecast(name, times[0] + PREPARATION * epochs * times[1], budget)
