"""CMA-ES, assembled: a black-box search of parameters, by one of two objectives.

`one-step` compares each logged next observation with the simulated one. `distribution` compares clouds of
observations whose order is unknown, the idea of "Simulator adaptation for sim-to-real learning of legged locomotion
via proprioceptive distribution matching" (arXiv 2604.11090); its distance and its search are our choice.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from pydantic import Field

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.baselines import evolution
from madoc.calibration.baselines.cma_es.mean_embedding import CosineFeatures, adjusted, cosine_features, discrepancies
from madoc.calibration.baselines.population_search import (
    SearchState,
    draw_windows,
    estimate_from_search,
    mean_with_failures,
    next_generation,
)
from madoc.identification.replay import window_residuals
from madoc.identification.windows import first_rows
from madoc.learning.cloning import Clone, continue_cloning, fresh_clone
from madoc.simulation.rollout import Walkers, begin, reset_states, roll
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, check_hyperparameters

ROWS = {"one-step": 100, "distribution": 500, "policy": 50}
"""Logged rows, or walkers, under each candidate."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Clouds:
    """What clouds are compared by.

    Attributes:
        of_pairs: Features of observations and actions: what `policy` starts are compared by.
        of_observations: Features whose change is compared for `logged` starts.
        pair: Mean of the first over logged rows; zeros until the log has been read.
        change: How the mean of the second changes in a step, over logged rows.
        read: 1 once the log has been read.
    """

    of_pairs: CosineFeatures
    of_observations: CosineFeatures
    pair: Float[np.ndarray, " features"]
    change: Float[np.ndarray, " features"]
    read: int


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Actor:
    """A clone of the behaviour, and where its rollouts stand."""

    clone: Clone
    walkers: Walkers


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CmaEsState:
    """The search; for `distribution` the clouds it compares, and who acts in them where someone does."""

    inner: SearchState
    clouds: Clouds | None
    actor: Actor | None


@dataclass(frozen=True)
class CmaEs:
    """CMA-ES over the box of parameters, all candidates of a generation in one batch.

    Attributes:
        objective: `one-step`: the mean squared error of next observations, each channel in units of its typical
            change. `distribution`: the maximum mean discrepancy of clouds; see `starts`.
        starts: Of `distribution`; None takes `logged` where states are exact, else `policy`.
            `logged`: one control step from logged states under their actions; the cloud of
            next observations should differ from that of observations as it does in the log, whichever belongs to
            which. `policy`: a clone acts from resets on, and its observations and actions should be distributed as
            the logged ones; no state needs to be rebuilt. All candidates go on from where the last best one stood.
        rows: Logged rows, or walkers, under each candidate; None takes 100 for `one-step`, 500 and 50 for the starts.
        horizon: Control steps each walker takes in a generation.
        features: Random features of a cloud.
        hidden: Units per layer of the clone.
        cloning_epochs: Epochs of behaviour cloning, before anything is simulated.
        cloning_updates: Updates in each.
        batch: Logged rows in an update.
        learning_rate: Adam's.
        population: Candidates a generation; None takes 4 + ⌊3 ln d⌋.
        tolerance: Share of each range; it stops once the search is narrower in all of them. 0 never stops.
    """

    objective: Literal["one-step", "distribution"] = "one-step"
    starts: Literal["logged", "policy"] | None = None
    rows: Count | None = None
    horizon: Annotated[int, Field(ge=2)] = 10
    features: Count = 100
    hidden: Layers = (128, 128)
    cloning_epochs: CountOrZero = 40
    cloning_updates: Count = 200
    batch: Count = 256
    learning_rate: NotNegative = 1e-3
    population: Annotated[int, Field(ge=4)] | None = None
    tolerance: NotNegative = 1e-5

    def __post_init__(self) -> None:
        check_hyperparameters(self)

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
        search = evolution.begin(np.zeros(len(problem.simulator.parameters)))
        clouds = None if self.objective == "one-step" else self._begin_clouds(problem, of_features)
        actor = self._begin_actor(problem, of_actor) if acts else None
        return CmaEsState(SearchState(search, key, 0), clouds, actor)

    def step(self, problem: CalibrationProblem, state: CmaEsState) -> tuple[CmaEsState, Epoch]:
        """One generation; before the first, epochs of cloning and one of reading the log."""
        inner, clouds, actor = state.inner, state.clouds, state.actor
        if actor is not None and actor.clone.epochs < self.cloning_epochs:
            return self._clone(problem, state, actor)
        if clouds is not None and not clouds.read:
            return replace(state, clouds=self._read(problem, clouds)), Epoch(stage="reading")
        of_candidates, of_rows, key = jax.random.split(inner.key, 3)
        candidates = evolution.ask(inner.search, of_candidates, self.population)
        if clouds is None:
            costs, spent, failures = self._one_step(problem, candidates, of_rows)
        elif actor is None:
            costs, spent, failures = self._replay(problem, clouds, candidates, of_rows)
        else:
            costs, spent, failures, actor = self._act(problem, clouds, actor, candidates, of_rows)
        inner = replace(inner, key=key, failures=inner.failures + failures)
        inner, epoch = next_generation(inner, candidates, costs, control_steps=spent, tolerance=self.tolerance)
        return CmaEsState(inner, clouds, actor), epoch

    def estimate(self, problem: CalibrationProblem, state: CmaEsState) -> Estimate:
        """Centre and covariance of the search. The covariance is the search's, no measure of uncertainty."""
        return estimate_from_search(problem, state.inner)

    def _acts(self, problem: CalibrationProblem) -> bool:
        """Whether a clone acts from resets on."""
        starts = self.starts or ("logged" if problem.states.kind == "exact" else "policy")
        return self.objective == "distribution" and starts == "policy"

    def _begin_clouds(self, problem: CalibrationProblem, key: PRNGKeyArray) -> Clouds:
        of_pairs, of_observations = jax.random.split(key)
        size, nothing = problem.simulator.task.observation_size, np.zeros(self.features)
        return Clouds(
            of_pairs=cosine_features(of_pairs, size + problem.simulator.action_size, self.features),
            of_observations=cosine_features(of_observations, size, self.features),
            pair=nothing,
            change=nothing,
            read=0,
        )

    def _begin_actor(self, problem: CalibrationProblem, key: PRNGKeyArray) -> Actor:
        of_policy, of_start = jax.random.split(key)
        simulator, logged = problem.simulator, problem.dataset.transitions
        clone = fresh_clone(logged, self.hidden, learning_rate=self.learning_rate, key=of_policy)
        rows = self.rows or ROWS["policy"]
        walkers = begin(reset_states(simulator), of_start, systems=1, rows=rows)
        # Ages spread evenly: time limits that fell together would show one age of episodes at a time.
        ages = np.arange(rows)[None] * simulator.task.max_episode_steps // rows
        walkers = replace(walkers, age=ages)
        return Actor(clone, walkers)

    def _clone(self, problem: CalibrationProblem, state: CmaEsState, actor: Actor) -> tuple[CmaEsState, Epoch]:
        of_batches, key = jax.random.split(state.inner.key)
        clone, metrics = continue_cloning(
            actor.clone,
            problem.features.pairs,
            of_batches,
            learning_rate=self.learning_rate,
            batch=self.batch,
            updates=self.cloning_updates,
        )
        following = replace(state, inner=replace(state.inner, key=key), actor=replace(actor, clone=clone))
        return following, Epoch(metrics, stage="cloning", fraction=clone.epochs / self.cloning_epochs)

    def _standardised(
        self, problem: CalibrationProblem, rows: Float[np.ndarray, "*rows values"]
    ) -> Float[np.ndarray, "*rows values"]:
        """Observations, or observations and actions, in units of the log's spread."""
        scaling, size = problem.features.standardised, rows.shape[-1]
        return (rows - scaling.pair_offset[:size]) / scaling.pair_scale[:size]

    def _read(self, problem: CalibrationProblem, clouds: Clouds) -> Clouds:
        """Mean features of logged (s, a), and how those of s change. Neither needs an order of rows.

        For `logged` starts they are those of the rows that can be rebuilt. Where it is not known which s' these have,
        the change is that of all rows.
        """
        whole = problem.dataset.transitions
        rows = whole if self._acts(problem) else whole.take(problem.states.exact()[1])
        loose = problem.dataset.disturbance.shuffled == "next_observations"
        before, after = (
            clouds.of_observations.mean(self._standardised(problem, np.asarray(part)))
            for part in ((whole if loose else rows).observation, (whole if loose else rows).next_observation)
        )
        pairs = np.concatenate([rows.observation, rows.action], axis=-1)
        return replace(
            clouds, pair=clouds.of_pairs.mean(self._standardised(problem, pairs)), change=after - before, read=1
        )

    def _one_step(
        self, problem: CalibrationProblem, candidates: Float[np.ndarray, "population d"], key: PRNGKeyArray
    ) -> tuple[Float[np.ndarray, " population"], int, int]:
        windows = draw_windows(problem, 1, self.rows or ROWS["one-step"], key)
        scale = problem.typical_change
        squared = (window_residuals(problem.simulator, windows, candidates, scale) ** 2).mean(-1)
        return mean_with_failures(squared), squared.size, int(np.isnan(squared).sum())

    def _replay(
        self,
        problem: CalibrationProblem,
        clouds: Clouds,
        candidates: Float[np.ndarray, "population d"],
        key: PRNGKeyArray,
    ) -> tuple[Float[np.ndarray, " population"], int, int]:
        """Clouds one step after logged rows, compared by how their features change from the rows themselves.

        So the draw of rows matters little; what of it still shows in the features of (s, a) is taken off as well.
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
        self,
        problem: CalibrationProblem,
        clouds: Clouds,
        actor: Actor,
        candidates: Float[np.ndarray, "population d"],
        key: PRNGKeyArray,
    ) -> tuple[Float[np.ndarray, " population"], int, int, Actor]:
        """Clouds that the clone visits under each candidate, from where the last best one left it."""
        simulator = problem.simulator
        of_actions, of_restarts = jax.random.split(key)
        rollout, after = roll(
            simulator.bind(simulator.parameters.to_physical(candidates)),
            simulator.task,
            actor.clone.policy,
            jax.tree.map(lambda part: np.repeat(part, len(candidates), axis=0), actor.walkers),
            steps=self.horizon,
            starts=reset_states(simulator),
            key=of_actions,
            restart_key=of_restarts,
        )
        seen = np.concatenate([rollout.transitions.observation, rollout.transitions.action], axis=-1)
        seen = np.where(rollout.valid[..., None], seen, np.nan)[1:]  # the first observation is where all were put
        rows = np.swapaxes(seen, 0, 1).reshape(len(candidates), -1, seen.shape[-1])
        costs = discrepancies(clouds.of_pairs(self._standardised(problem, rows)), clouds.pair)
        costs = mean_with_failures(costs[:, None])
        best = int(np.argmin(costs))
        walkers = jax.tree.map(lambda part: part[best : best + 1], after)
        return costs, rollout.valid.size, rollout.failures, replace(actor, walkers=walkers)
