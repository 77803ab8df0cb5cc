"""CMA-ES: a black-box search for parameters, by one of two objectives.

`one-step` compares each logged next observation with the simulated one. `distribution` compares clouds of
observations whose order is unknown, the idea of "Simulator adaptation for sim-to-real learning of legged locomotion
via proprioceptive distribution matching" (arXiv 2604.11090); the distance and the search are our choice.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from pydantic import Field

from madoc.calibration import free_rollouts
from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.baselines.population_search import (
    Candidates,
    Costs,
    Evolution,
    SearchState,
    estimate_from_search,
    mean_with_failures,
    next_generation,
    replay_residuals,
)
from madoc.calibration.free_rollouts import SensorNoise
from madoc.errors import MadocError
from madoc.identification.windows import first_rows
from madoc.learning.cloning import Clone, cloning_epoch, fresh_clone
from madoc.learning.features import HIDDEN_WINDOW
from madoc.simulation.rollout import Walkers
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, check_hyperparameters

WIDTHS = (0.5, 1.0, 2.0)
"""Widths of the kernels, in units of √dimensions, which is about the typical distance of standardised rows."""
_ROWS_AT_ONCE = 10_000
"""Largest number of rows whose features are in memory at a time."""
RIDGE = 1e-3
"""Ridge of the covariance of features, as a share of their mean variance."""
_SMALLEST_VARIANCE = 1e-12
"""Smallest ridge of the covariance of features, for features that do not vary."""
_SLOPE_RIDGE = 1e-6
"""Ridge of the mean squares of covariates, which are cosines: those that hardly vary then explain nothing."""

Evaluation = tuple[Costs, int, int]
"""Cost of each candidate, control steps spent, and number of simulations that failed."""
ROWS = {"one-step": 100, "distribution": 500, "policy": 50}
"""Default number under each candidate of logged rows (`one-step`, `distribution`) or of walkers (`policy`)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CosineFeatures:
    """φ(x) = cos(x W + b) of standardised rows x: random Fourier features (Rahimi and Recht 2007)."""

    frequencies: Float[np.ndarray, "dimensions features"]
    phases: Float[np.ndarray, " features"]

    def __call__(self, rows: Float[np.ndarray, "*rows dimensions"]) -> Float[np.ndarray, "*rows features"]:
        """Features of rows."""
        return np.cos(rows @ self.frequencies + self.phases)

    def mean(self, rows: Float[np.ndarray, "rows dimensions"]) -> Float[np.ndarray, " features"]:
        """Mean features of many rows."""
        parts = np.array_split(rows, max(1, len(rows) // _ROWS_AT_ONCE))
        return np.sum([self(part).sum(0) for part in parts], axis=0) / len(rows)


def cosine_features(key: PRNGKeyArray, dimensions: int, count: int) -> CosineFeatures:
    """Random frequencies of Gaussian kernels of each width in turn, uniform phases."""
    of_frequencies, of_phases = jax.random.split(key)
    frequencies = np.asarray(jax.random.normal(of_frequencies, (dimensions, count)), np.float64)
    widths = np.sqrt(dimensions) * np.resize(WIDTHS, count)
    phases = np.asarray(jax.random.uniform(of_phases, (count,), maxval=2.0 * np.pi), np.float64)
    return CosineFeatures(frequencies / widths, phases)


def discrepancies(
    features: Float[np.ndarray, "clouds rows features"], wanted: Float[np.ndarray, " features"]
) -> Float[np.ndarray, " clouds"]:
    """Squared Mahalanobis distance n (m - w)ᵀ S⁻¹ (m - w) of the mean m of each cloud of n rows from the wanted w.

    It is a kernel Hotelling statistic (Harchaoui, Bach and Moulines 2008). S is the covariance of rows about the mean
    of their cloud, pooled over clouds, with a small ridge. Rows that failed (NaN) are left out of the mean but counted
    in n, so that no cloud comes nearer by failing; the distance of a cloud in which all rows failed is NaN.
    """
    valid = np.isfinite(features).all(-1)
    count = valid.sum(1)
    mean = np.where(valid[..., None], features, 0.0).sum(1) / np.where(count > 0, count, np.nan)[:, None]
    off = (features - mean[:, None])[valid]
    covariance = off.T @ off / max(1, len(off))
    ridge = RIDGE * np.trace(covariance) / len(covariance) + _SMALLEST_VARIANCE
    gap = mean - wanted
    solved = np.linalg.solve(covariance + ridge * np.eye(len(covariance)), np.nan_to_num(gap).T).T
    return np.where(count > 0, features.shape[1], np.nan) * (gap * solved).sum(-1)


def adjusted(
    features: Float[np.ndarray, "clouds rows features"], covariates: Float[np.ndarray, "rows covariates"]
) -> Float[np.ndarray, "clouds rows features"]:
    """Features of drawn rows, corrected for the chance difference between the draw and the whole log.

    The mean of the covariates over the whole log is 0, so that their mean in a draw, times the slopes of features on
    them, is chance. This is the regression estimator of survey sampling (Särndal et al. 1992, section 6.4). Each cloud
    has its own slopes, from the rows that failed in no cloud.
    """
    whole = np.isfinite(features).all((0, 2))
    if not whole.any():
        return features
    design = np.concatenate([np.ones((whole.sum(), 1)), covariates[whole]], axis=1)
    squares = design.T @ design / len(design)
    slopes = np.linalg.solve(squares + _SLOPE_RIDGE * np.eye(len(squares)), design.T @ features[:, whole] / len(design))
    return features - covariates @ slopes[:, 1:]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Clouds:
    """The features by which clouds are compared, and their means over the log.

    Attributes:
        of_pairs: Features of observations and actions, compared for `policy` starts; of windows of both where
            one row tells no state.
        of_observations: Features of observations, whose change is compared for `logged` starts.
        pair: Mean of the features of pairs over logged rows; zeros until the log has been read.
        change: Change in a step of the mean of the features of observations, over logged rows.
        read: 1 once the log has been read.
    """

    of_pairs: CosineFeatures
    of_observations: CosineFeatures
    pair: Float[np.ndarray, " features"]
    change: Float[np.ndarray, " features"]
    read: int = 0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Actor:
    """A clone of the behaviour policy, and the rows that it acts in."""

    clone: Clone
    walkers: Walkers


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CmaEsState:
    """The search, the clouds that `distribution` compares, and the actor of its `policy` starts."""

    inner: SearchState
    clouds: Clouds | None
    actor: Actor | None


@dataclass(frozen=True)
class CmaEs:
    """CMA-ES over the box of parameters, all candidates of a generation in one batch.

    Attributes:
        objective: `one-step`: the mean squared error of next observations, each channel in units of its typical
            change. `distribution`: the distance of clouds of observations (`discrepancies`); see `starts`.
        starts: Rollouts of `distribution`; None takes `logged` where states are exact, else `policy`.
            `logged`: one control step from logged states under their actions; the cloud of next observations is to
            differ from that of observations as it does in the log, whichever belong together. `policy`: a clone acts
            from resets on, and its observations and actions are to be distributed as the logged ones; no state needs
            to be rebuilt. All candidates go on from where the best one of the last generation stopped.
        rows: Logged rows, or walkers, under each candidate; None takes 100 for `one-step`, 500 and 50 for the starts.
        horizon: Control steps of each walker in a generation.
        features: Number of random features of a cloud.
        hidden: Units per layer of the clone.
        cloning_epochs: Epochs of behaviour cloning, before anything is simulated.
        cloning_updates: Updates in each epoch of cloning.
        batch: Logged rows in an update.
        learning_rate: Adam's learning rate.
        population: Candidates in a generation; None takes 4 + ⌊3 ln d⌋.
        tolerance: Largest deviation of the search, as a share of each range, at which it stops; 0 never stops.
        sensor_noise: Noise put on what a clone does, as a share of a step's typical change; None estimates it from the
            log.
    """

    objective: Literal["one-step", "distribution"] = "one-step"
    starts: Literal["logged", "policy"] | None = None
    rows: Count | None = None
    horizon: Annotated[int, Field(ge=HIDDEN_WINDOW)] = 10
    features: Count = 100
    hidden: Layers = (128, 128)
    cloning_epochs: CountOrZero = 40
    cloning_updates: Count = 200
    batch: Count = 256
    learning_rate: NotNegative = 1e-3
    population: Annotated[int, Field(ge=4)] | None = None
    tolerance: NotNegative = 1e-5
    sensor_noise: SensorNoise = None

    def __post_init__(self) -> None:
        check_hyperparameters(self)
        if self.starts and self.objective == "one-step":
            raise MadocError("starts is of objective=distribution (cma-es-distribution): leave it out of one-step")

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> CmaEsState:
        """The search about mid-range; features, clone and walkers where they are needed.

        Raises:
            MadocError: States are needed and none can be rebuilt, or pairs are and the next observations are shuffled.
        """
        if self.objective == "one-step":
            problem.require_pairs()
        acts = self._acts(problem)
        if not acts:
            first_rows(problem.dataset, problem.states.exact()[1], 1)
        of_features, of_actor, key = jax.random.split(key, 3)
        window, size, clouds, actor = self._window(problem), problem.simulator.task.observation_size, None, None
        if self.objective == "distribution":
            of_pairs, of_observations = jax.random.split(of_features)
            pairs = cosine_features(of_pairs, window * (size + problem.simulator.action_size), self.features)
            nothing = np.zeros(self.features)
            clouds = Clouds(pairs, cosine_features(of_observations, size, self.features), nothing, nothing)
        if acts:
            of_policy, of_start = jax.random.split(of_actor)
            seen = problem.features.pairs(window - 1)
            clone = fresh_clone(seen, self.hidden, learning_rate=self.learning_rate, key=of_policy)
            walkers = free_rollouts.begin_freely(problem, window, of_start, systems=1, rows=self.rows or ROWS["policy"])
            actor = Actor(clone, walkers)
        search = Evolution.about(np.zeros(len(problem.simulator.parameters)))
        return CmaEsState(SearchState(search, key), clouds, actor)

    def step(self, problem: CalibrationProblem, state: CmaEsState) -> tuple[CmaEsState, Epoch]:
        """One generation. Before the first there are epochs of cloning, and one in which the log is read."""
        inner, clouds, actor = state.inner, state.clouds, state.actor
        if actor is not None and actor.clone.epochs < self.cloning_epochs:
            return self._clone(problem, state, actor)
        if clouds is not None and not clouds.read:
            return replace(state, clouds=self._read(problem, clouds)), Epoch(stage="reading")
        of_candidates, of_rows, key = jax.random.split(inner.key, 3)
        candidates = inner.search.ask(of_candidates, self.population)
        if clouds is None:
            residuals = replay_residuals(problem, candidates, of_rows, steps=1, windows=self.rows or ROWS["one-step"])
            squared = (residuals**2).mean(-1)
            costs, spent, failures = mean_with_failures(squared), squared.size, int(np.isnan(squared).sum())
        elif actor is None:
            costs, spent, failures = self._replay(problem, clouds, candidates, of_rows)
        else:
            (costs, spent, failures), actor = self._act(problem, clouds, actor, candidates, of_rows)
        inner, epoch = next_generation(
            inner, candidates, costs, key, control_steps=spent, failures=failures, tolerance=self.tolerance
        )
        return CmaEsState(inner, clouds, actor), epoch

    def estimate(self, problem: CalibrationProblem, state: CmaEsState) -> Estimate:
        """Centre and covariance of the search; the covariance does not measure uncertainty."""
        return estimate_from_search(problem, state.inner)

    def _acts(self, problem: CalibrationProblem) -> bool:
        """Whether rollouts are those of a clone from resets."""
        starts = self.starts or ("logged" if problem.states.kind == "exact" else "policy")
        return self.objective == "distribution" and starts == "policy"

    def _window(self, problem: CalibrationProblem) -> int:
        """Rows that are compared at a time."""
        return free_rollouts.rows_compared(problem) if self._acts(problem) else 1

    def _clone(self, problem: CalibrationProblem, state: CmaEsState, actor: Actor) -> tuple[CmaEsState, Epoch]:
        clone, key, epoch = cloning_epoch(
            actor.clone,
            problem.features.pairs(self._window(problem) - 1),
            state.inner.key,
            learning_rate=self.learning_rate,
            batch=self.batch,
            updates=self.cloning_updates,
            epochs=self.cloning_epochs,
        )
        following = replace(state, inner=replace(state.inner, key=key), actor=replace(actor, clone=clone))
        return following, epoch

    def _standardised(
        self, problem: CalibrationProblem, rows: Float[np.ndarray, "*rows values"]
    ) -> Float[np.ndarray, "*rows values"]:
        """Observations, or observations and actions, in units of the log's spread."""
        scaling, size = problem.features.standardised, rows.shape[-1]
        return (rows - scaling.pair_offset[:size]) / scaling.pair_scale[:size]

    def _read(self, problem: CalibrationProblem, clouds: Clouds) -> Clouds:
        """Mean features of logged (s, a), and the change of those of s. Neither depends on the order of rows.

        For `logged` starts, these are means over the rows whose state can be rebuilt. Where next observations are
        shuffled, it is not known which belong to those rows, and the change is that of all rows.
        """
        whole = problem.dataset.transitions
        rows = whole if self._acts(problem) else whole.take(problem.states.exact()[1])
        changing = whole if problem.dataset.disturbance.shuffled == "next_observations" else rows
        before, after = (
            clouds.of_observations.mean(self._standardised(problem, np.asarray(part)))
            for part in (changing.observation, changing.next_observation)
        )
        if self._window(problem) > 1:
            pairs = np.asarray(problem.features.windows("standardised", self._window(problem))[1][0])
        else:
            pairs = self._standardised(problem, np.concatenate([rows.observation, rows.action], axis=-1))
        return replace(clouds, pair=clouds.of_pairs.mean(pairs), change=after - before, read=1)

    def _replay(
        self, problem: CalibrationProblem, clouds: Clouds, candidates: Candidates, key: PRNGKeyArray
    ) -> Evaluation:
        """Clouds one step after drawn logged rows, compared by the change of their features from those rows.

        The change depends little on which rows were drawn; the part that features of (s, a) explain is removed.
        """
        simulator = problem.simulator
        states, logged = problem.states.exact()
        chosen = np.asarray(jax.random.randint(key, (self.rows or ROWS["distribution"],), 0, len(logged)))
        state, action = (
            np.ascontiguousarray(np.broadcast_to(part, (len(candidates), *part.shape)))
            for part in (states[chosen], np.asarray(problem.dataset.transitions.action)[logged[chosen]])
        )
        system = simulator.bind(simulator.parameters.to_physical(candidates))
        state = system.unbiased(state)
        following = system.step(state, action)
        seen, seen_after = system.observe(state), system.observe(following)
        before, after = (clouds.of_observations(self._standardised(problem, part)) for part in (seen, seen_after))
        pairs = np.concatenate([seen[0], action[0]], axis=-1)
        covariates = clouds.of_pairs(self._standardised(problem, pairs)) - clouds.pair
        costs = discrepancies(adjusted(after - before, covariates), clouds.change)
        failed = ~np.isfinite(following).all(-1)
        return mean_with_failures(costs[:, None]), failed.size, int(failed.sum())

    def _act(
        self, problem: CalibrationProblem, clouds: Clouds, actor: Actor, candidates: Candidates, key: PRNGKeyArray
    ) -> tuple[Evaluation, Actor]:
        """Clouds that the clone visits under each candidate, from where the best one of the last generation stopped."""
        of_actions, of_restarts = jax.random.split(key)
        length = self._window(problem)
        rollout, after = free_rollouts.roll_freely(
            problem,
            actor.clone.policy,
            candidates,
            jax.tree.map(lambda part: np.repeat(part, len(candidates), axis=0), actor.walkers),
            steps=self.horizon,
            noise=free_rollouts.noise_deviation(problem, self.sensor_noise, length),
            keys=(of_actions, of_restarts),
        )
        windows, _, whole = free_rollouts.windows_of(rollout, problem.features.windows("standardised", length)[0])
        windows = np.where(whole[..., None], windows, np.nan)[free_rollouts.without_starts(length)]
        rows = np.swapaxes(windows, 0, 1).reshape(len(candidates), -1, windows.shape[-1])
        costs = discrepancies(clouds.of_pairs(rows), clouds.pair)
        costs = mean_with_failures(costs[:, None])
        best = int(np.argmin(costs))
        walkers = jax.tree.map(lambda part: part[best : best + 1], after)
        return (costs, rollout.valid.size, rollout.failures), replace(actor, walkers=walkers)
