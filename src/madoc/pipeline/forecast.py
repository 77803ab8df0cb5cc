"""How long methods would take on this machine, from a second of each."""

import time
from dataclasses import asdict, dataclass

import jax

from madoc.calibration import CalibrationProblem, LeastSquares, Madoc
from madoc.errors import MadocError

REFINING_EPOCHS = 6
"""Number of steps on all windows that least squares usually takes."""
PREPARATION = 1.15
"""Time of a whole run of Madoc over that of its calibrating epochs, as cloning and grouping come first: measured with
the defaults on Hopper."""


@dataclass(frozen=True)
class Forecast:
    """A method's time, or why it would refuse.

    Attributes:
        method: Name of the method.
        seconds: Expected duration; None where the method refuses the data.
        control_steps: The most control steps that it would simulate.
        refusal: Why it refuses the data; empty where it does not.
    """

    method: str
    seconds: float | None
    control_steps: int
    refusal: str = ""

    def to_json(self) -> dict[str, object]:
        """Its fields."""
        return asdict(self)

    @property
    def sentence(self) -> str:
        """The forecast in words."""
        if self.seconds is None:
            return f"{self.method} would refuse: {self.refusal}"
        return f"{self.method}: about {_duration(self.seconds)} for {self.control_steps:,} control steps"


def forecast(problem: CalibrationProblem, *, budget: int) -> tuple[Forecast, ...]:
    """Forecasts of least squares and of Madoc with their defaults.

    Least squares takes one step of its search, Madoc two epochs, the first of which compiles.
    """
    return (_least_squares(problem, budget), _madoc(problem, budget))


def _least_squares(problem: CalibrationProblem, budget: int) -> Forecast:
    method, name = LeastSquares(), "least-squares"
    try:
        state = method.init(problem, jax.random.key(0))
    except MadocError as error:
        return Forecast(name, None, 0, str(error))
    started = time.monotonic()
    state, epoch = method.step(problem, state)
    seconds = time.monotonic() - started
    total = min(budget, method.whole_run(problem, state, refining_epochs=REFINING_EPOCHS))
    return Forecast(name, seconds / epoch.control_steps * total, total)


def _madoc(problem: CalibrationProblem, budget: int) -> Forecast:
    method = Madoc(groups="one", cloning_epochs=0)
    name = "madoc"
    try:
        state = method.init(problem, jax.random.key(0))
        times = []
        for _ in range(2):
            started = time.monotonic()
            state, _ = method.step(problem, state)
            times.append(time.monotonic() - started)
    except MadocError as error:
        return Forecast(name, None, 0, str(error))
    epochs = budget / method.epoch_steps
    return Forecast(name, times[0] + PREPARATION * epochs * times[1], budget)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{max(1.0, seconds):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
