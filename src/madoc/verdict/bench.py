"""What estimates of one problem are judged on: a log in two parts, and ways to replay what is held out."""

from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from sklearn.neighbors import NearestNeighbors

from madoc.calibration.base import CalibrationProblem
from madoc.data.split import Split
from madoc.identification import noise as sensors
from madoc.identification.states import logged_states
from madoc.identification.windows import consecutive_rows, evenly
from madoc.learning.dynamics_ratio import Scaling
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.simulation.base import Simulator
from madoc.tasks import Task
from madoc.verdict.fitted_starts import FittedReplays, fitted_replays_of
from madoc.verdict.prediction import MOST_WINDOWS, Replays, replays_of
from madoc.verdict.statistics import better_than_chance
from madoc.verdict.two_sample import Told, WindowView, behaviour, rolled, tell_apart

_NEIGHBOURS = 5000
"""Kept rows among which the nearest is looked for."""
_LONGEST_ROLLOUT = 1000


@dataclass(frozen=True)
class Bench:
    """What estimates of one problem are judged on; what they share is worked out once.

    Attributes:
        split: The log, in what methods see and what is held out.
        simulator: The robot.
        key: Randomness of the clone and of its rollouts.
    """

    split: Split
    simulator: Simulator
    key: PRNGKeyArray

    @cached_property
    def problem(self) -> CalibrationProblem:
        """What methods are given."""
        return CalibrationProblem(self.split.kept, self.simulator)

    @cached_property
    def scaling(self) -> Scaling:
        """Of the rows kept."""
        return self.problem.scalings["standardised"]

    @property
    def measure(self) -> str:
        """`prediction` where windows can be replayed, else `two-sample`."""
        return "prediction" if self.rebuilds or self.fitted is not None else "two-sample"

    @property
    def rebuilds(self) -> bool:
        """Whether an observation tells the state."""
        return self.simulator.task.state_from_observation is not None

    @cached_property
    def replays(self) -> Replays:
        """Windows of the hold-out."""
        return replays_of(self.split.held, self.simulator, self.scaling.next_scale)

    @cached_property
    def fitted(self) -> FittedReplays | None:
        """Windows of the hold-out whose starts are to be fitted: where velocities are hidden, and no more than that."""
        if self.rebuilds or not self.problem.states.starts_known or self.split.held.disturbance.shuffled != "none":
            return None
        return fitted_replays_of(self.split.held, self.simulator, self.scaling.next_scale)

    @cached_property
    def clone(self) -> TanhGaussianPolicy:
        """Who acted, to act in the simulator where states cannot be rebuilt."""
        return behaviour(self.split.kept, self.key)

    @cached_property
    def view(self) -> WindowView:
        """How rows are shown to the classifier where states cannot be rebuilt."""
        return WindowView.of(self.split.kept, self.scaling)

    @cached_property
    def middle_apart(self) -> Told:
        """How well rows of mid-range are told from those held out, where states cannot be rebuilt."""
        return self.rolled_apart(np.zeros(len(self.simulator.parameters)))

    @cached_property
    def judged_rows(self) -> Int[np.ndarray, " rows"]:
        """Rows of the hold-out at which single steps are looked at: in pairs that follow each other, if there are."""
        held = self.split.held
        if not self.rebuilds:
            return evenly(np.arange(len(held)), MOST_WINDOWS)
        rows = logged_states(held, self.simulator.task)[1]
        pairs = evenly(rows[consecutive_rows(held, rows)], MOST_WINDOWS)
        return np.unique(np.concatenate([pairs, pairs + 1])) if len(pairs) else evenly(rows, MOST_WINDOWS)

    @cached_property
    def model_free(self) -> dict[str, dict[str, float]]:
        """Whether rows follow from each other at all: by staying where they are, or by doing as a row nearby did."""
        held, kept = self.split.held.transitions, self.split.kept.transitions
        rows, near = self.judged_rows, evenly(np.arange(len(self.split.kept)), _NEIGHBOURS)
        wanted, known = self.scaling.features(held.take(rows))[0], self.scaling.features(kept.take(near))[0]
        nearest = NearestNeighbors(n_neighbors=1).fit(known).kneighbors(wanted, return_distance=False)[:, 0]
        guesses = {
            "staying in place": np.asarray(held.observation)[rows],
            "the nearest row": np.asarray(kept.next_observation)[near[nearest]],
        }
        return {name: self.follows(guess) for name, guess in guesses.items()}

    def follows(self, guess: Float[np.ndarray, "rows observation"]) -> dict[str, float]:
        """How far predictions of the judged rows are from chance."""
        held, rows = self.split.held, self.judged_rows
        spread = self.scaling.pair_scale[: guess.shape[1]]
        here = np.asarray(held.transitions.observation)[rows]
        guess = np.where(np.isfinite(guess), guess, here)
        followed = np.asarray(held.transitions.next_observation)[rows]
        episodes = held.episode_of(rows)
        return better_than_chance(guess / spread, followed / spread, episodes)

    def rolled_apart(self, unit: Float[np.ndarray, " d"]) -> Told:
        """The two-sample test of rollouts under the clone, whose sensors are as noisy as those of the log."""
        parameters, held = self.simulator.parameters.to_physical(unit), self.split.held
        length = int(np.clip(np.median(held.episode_ends - held.episode_starts), 2, _LONGEST_ROLLOUT))
        noise, key = sensors.difference_noise(self.split.kept), jax.random.fold_in(self.key, 1)
        simulated = rolled(self.clone, self.simulator, parameters, length=length, key=key, noise=noise)
        return tell_apart(self.view.sample(held), self.view.sample(simulated), overlap=True)


def signal_names(task: Task) -> tuple[str, ...]:
    """Names of the values of an observation."""
    return task.signals or tuple(f"observation[{index}]" for index in range(task.observation_size))
