"""What estimates of one problem are judged on: the training rows, the hold-out, and ways to replay the latter."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from sklearn.neighbors import NearestNeighbors

from madoc.calibration import CalibrationProblem
from madoc.calibration.holdout import AgainstChance, Area, Beside
from madoc.data import Dataset, stride
from madoc.errors import MadocError
from madoc.identification.fitted_windows import STRIDES
from madoc.identification.settling import FIT_STEPS
from madoc.identification.states import LoggedStates, logged_states
from madoc.identification.term_tests import FEWEST
from madoc.identification.windows import consecutive_rows, evenly, horizons
from madoc.learning.features import Scaling
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.simulation.base import Simulator
from madoc.types import named_key
from madoc.verdict.fitted_starts import FittedReplays, fitted_replays_of, replay_steps
from madoc.verdict.prediction import MOST_WINDOWS, WHOLE_STEPS, Replays, replays_of
from madoc.verdict.statistics import better_than_chance
from madoc.verdict.two_sample import WindowView, behaviour, classify, rolled

FEWEST_HELD = 10
"""Smallest number of rows held out, at least 1. With fewer, even perfect predictions could be chance."""
_NEIGHBOURS = 5000
"""Largest number of training rows among which the nearest neighbour of a row held out is searched."""
FITTING, LEAST_FITTING = 0.4, 0.1
"""Share in (0, 1) of the time left that fitting the starts of the hold-out's windows may take, and the least: where
tests of what the model lacks leave less, there is no time for them."""
REPLAYED, REPLAYING = 12, 0.3
"""Simulations of a window of the hold-out from its logged state, and the share in (0, 1) of the time left for them."""
COLUMNS, COLUMNS_OF_A_VALUE = 60, 20
"""Simulations of a window that testing a model takes about, and how many more for each parameter and each degree of
freedom."""
FEWEST_STEPS = 2
"""Least number of steps of an initial state, however short the time: it begins at a likely one."""
FEWEST_FITTED = 10
"""Smallest number of such windows, however little time is left."""
_LONGEST_ROLLOUT = 1000
"""Largest length of a rollout in control steps, also where the episodes of the log are longer."""


@dataclass(frozen=True)
class Bench:
    """What estimates of one problem are judged on. What all of them need is computed once, at its first use.

    Attributes:
        problem: What methods are given: the training rows and the simulator.
        held_out: Rows that no method has seen.
        key: Randomness of the cloned policy and of its rollouts.
        split: How the rows were held out, in a sentence.
        until: The time (`time.monotonic`) at which judging has to end; None for whenever it is done.
        rate: Control steps that are simulated in a second, which matters under such a limit.
        tell: What is told of each part of the work.
        left_out: What there was no time for so far.
        divided: Into how many steps each timestep is divided for tests of what the model lacks, where there is time.
        own: The bench with the model's own timestep, where this one has a shorter one.

    Raises:
        MadocError: Too few rows are held out, or they are not of the simulator's robot.
    """

    problem: CalibrationProblem
    held_out: Dataset
    key: PRNGKeyArray
    split: str = ""
    until: float | None = None
    rate: float = 1.0
    tell: Callable[[str], None] = lambda part: None
    left_out: list[str] = field(default_factory=list)
    divided: int = 1
    own: "Bench | None" = None

    def __post_init__(self) -> None:
        if len(self.held_out) < FEWEST_HELD:
            raise MadocError(
                f"expected at least {FEWEST_HELD} rows held out to judge a result by, got {len(self.held_out)} beside "
                f"{len(self.problem.dataset)}; log more, or hold out a larger share"
            )
        object.__setattr__(self, "held_out", CalibrationProblem(self.held_out, self.simulator).dataset)

    @property
    def seconds_left(self) -> float:
        """Time in s for what is still to be judged."""
        return np.inf if self.until is None else self.until - time.monotonic()

    def windows_in_time(self, control_steps: int, share: float, most: int) -> int:
        """How many windows of so many control steps each can be simulated in a share of the time left, or the most.

        They are at least `FEWEST_FITTED`.
        """
        if self.until is None:
            return most
        affordable = int(share * self.rate * max(self.seconds_left, 0.0) / control_steps)
        return min(most, max(FEWEST_FITTED, affordable))

    @property
    def windows_to_test(self) -> int:
        """Number of windows that a test of what the model lacks takes at least."""
        return 2 * (FEWEST + len(self.simulator.parameters))

    @property
    def window_seconds(self) -> float:
        """About how long testing the model on a window takes, in s."""
        values = len(self.simulator.parameters) + self.simulator.task.model.nv
        steps = STRIDES * stride(self.problem.dataset) * (COLUMNS + COLUMNS_OF_A_VALUE * values)
        return steps / self.rate

    def steps_in_time(self, control_steps: int, share: float) -> int:
        """How many steps of initial states fit into a share of the time left.

        `FIT_STEPS` of them simulate so many control steps.
        """
        fits = share * self.rate * self.seconds_left / max(1, control_steps)
        return int(np.clip(FIT_STEPS * min(1.0, fits), FEWEST_STEPS, FIT_STEPS))

    def begins(self, part: str, seconds: float = 0.0) -> bool:
        """Whether there is time for a part that takes so long: it is told of, or noted where there is none."""
        if self.seconds_left > seconds:
            self.tell(part)
            return True
        self.left_out.append(part)
        return False

    @property
    def simulator(self) -> Simulator:
        """The robot, with the ranges of its parameters."""
        return self.problem.simulator

    def with_timestep_of(self, timesteps: int, tests: int = 1) -> "Bench":
        """The bench for an estimate that was made with so many steps in each of the model's timesteps.

        `tests` are those of tests of what the model lacks. What there is no time for is noted in one place for both.
        """
        if timesteps == 1:
            return self if tests == 1 else replace(self, divided=tests)
        shorter = self.problem.with_shorter_timestep
        return replace(self, problem=shorter, rate=self.rate / timesteps, divided=1, own=self)

    def for_tests(self) -> tuple["Bench", Beside]:
        """The bench on which it is tested what the model lacks, and its timestep beside that of this one.

        It has the shorter timestep, unless the log excludes that, if there is time for it, and else the model's own,
        whose error is one of the terms that are tested.
        """
        shorter = self.with_timestep_of(self.divided)
        if shorter.seconds_left >= shorter.test_seconds:
            return shorter, "same" if self.divided == 1 else "shorter"
        if self.divided > 1 or self.own is not None:
            self.left_out.append("tests with the shorter timestep")
        return (self, "same") if self.own is None else (self.own, "longer")

    @property
    def test_seconds(self) -> float:
        """About how long testing the model takes at least, in s."""
        return self.windows_to_test * self.window_seconds

    @property
    def scaling(self) -> Scaling:
        """Scaling of observations and actions by the training rows."""
        return self.problem.features.standardised

    @property
    def change(self) -> Float[np.ndarray, " observation"]:
        """Typical change of each signal in a stride of the training rows: residuals are multiples of it."""
        return self.problem.typical_change

    @property
    def states(self) -> LoggedStates:
        """What the training rows say of states; those with velocities derived from noisy positions are approximate."""
        states = self.problem.states
        derived = states.measured < self.simulator.task.observation_size
        return replace(states, kind="approximate") if states.kind == "exact" and derived else states

    @property
    def states_known(self) -> bool:
        """Whether states can be rebuilt from observations."""
        return self.states.kind == "exact"

    @cached_property
    def replays(self) -> Replays:
        """Windows of the hold-out to replay from logged states, where states can be rebuilt, as there is time for."""
        lengths = horizons(self.problem.dataset)
        steps = lengths[-1] * (REPLAYED + WHOLE_STEPS * (1 + len(self.simulator.parameters)))
        most = self.windows_in_time(steps, REPLAYING, MOST_WINDOWS)
        return replays_of(self.held_out, self.simulator, self.change, lengths, most)

    @cached_property
    def fitted(self) -> FittedReplays | None:
        """Windows of the hold-out whose initial states are fitted, as many as there is time for at the first use."""
        if self.fittable is None:
            return None
        columns = replay_steps(self.states, stride(self.problem.dataset), len(self.simulator.parameters))
        count = len(self.fittable.rows)
        room = 1.0 - self.with_timestep_of(self.divided).test_seconds / max(self.seconds_left, 1e-9)
        share = min(room, FITTING) if room >= LEAST_FITTING else FITTING
        most = self.windows_in_time(columns, share, count)
        return replace(
            self.fittable.of(evenly(np.arange(count), most)), most_steps=self.steps_in_time(most * columns, share)
        )

    @cached_property
    def fittable(self) -> FittedReplays | None:
        """Windows of the hold-out whose initial states can be fitted; None where none can be."""
        if self.states.kind == "unknown" or self.held_out.disturbance.shuffled != "none":
            return None
        return fitted_replays_of(self.held_out, self.simulator, self.change, stride(self.problem.dataset))

    @cached_property
    def clone(self) -> TanhGaussianPolicy:
        """A clone of the policy that acted in the log, for rollouts where states cannot be rebuilt."""
        return behaviour(self.problem.dataset, self.key)

    @cached_property
    def view(self) -> WindowView:
        """The features of rows that a classifier gets where states cannot be rebuilt."""
        return WindowView.of(self.problem.dataset, self.scaling)

    @cached_property
    def area_at_mid_range(self) -> Area:
        """`area_of_rollouts` at mid-range."""
        return self.area_of_rollouts(np.zeros(len(self.simulator.parameters)))

    @cached_property
    def judged_rows(self) -> Int[np.ndarray, " rows"]:
        """Rows of the hold-out whose single steps are judged: pairs of consecutive rows, where there are any."""
        held = self.held_out
        if not self.states_known:
            return evenly(np.arange(len(held)), MOST_WINDOWS)
        rows = logged_states(held, self.simulator.task)[1]
        pairs = evenly(rows[consecutive_rows(held, rows)], MOST_WINDOWS)
        return np.unique(np.concatenate([pairs, pairs + 1])) if len(pairs) else evenly(rows, MOST_WINDOWS)

    @cached_property
    def model_free(self) -> tuple[AgainstChance, ...]:
        """Predictions of next observations without a model: that nothing moves, and what followed the nearest row."""
        held, kept = self.held_out.transitions, self.problem.dataset.transitions
        rows, near = self.judged_rows, evenly(np.arange(len(kept)), _NEIGHBOURS)
        wanted, candidates = self.scaling.features(held.take(rows))[0], self.scaling.features(kept.take(near))[0]
        nearest = NearestNeighbors(n_neighbors=1).fit(candidates).kneighbors(wanted, return_distance=False)[:, 0]
        return (
            self.against_chance("staying in place", np.asarray(held.observation)[rows]),
            self.against_chance("the nearest row", np.asarray(kept.next_observation)[near[nearest]]),
        )

    def against_chance(self, prediction: str, predicted: Float[np.ndarray, "rows observation"]) -> AgainstChance:
        """Compare predicted next observations of the judged rows with random pairings of the same rows."""
        held, rows = self.held_out.transitions, self.judged_rows
        spread = self.scaling.pair_scale[: predicted.shape[1]]
        predicted = np.where(np.isfinite(predicted), predicted, np.asarray(held.observation)[rows])
        followed, episodes = np.asarray(held.next_observation)[rows], self.held_out.episode_of(rows)
        return AgainstChance(prediction, *better_than_chance(predicted / spread, followed / spread, episodes))

    def area_of_rollouts(self, point: Float[np.ndarray, " d"]) -> Area:
        """How well a classifier separates rollouts of the cloned policy, with sensor noise, from the hold-out."""
        held = self.held_out
        length = int(np.clip(np.median(held.episode_ends - held.episode_starts), 2, _LONGEST_ROLLOUT))
        simulated = rolled(
            self.clone,
            self.simulator,
            self.simulator.parameters.to_physical(point),
            length=length,
            key=named_key(self.key, "rollouts"),
            noise=self.problem.noise_by_differences,
        )
        if len(held.episode_starts) == len(held):  # loose rows: windows of one row, of rollouts too
            simulated = replace(simulated, episode_starts=np.arange(len(simulated)))
        return classify(self.view.sample(held), self.view.sample(simulated))
