"""Madoc, assembled: clone the behaviour, group the parameters, then calibrate them group by group.

Jiang et al. 2024, Algorithm 1. Every equation it uses lives in a file of its own beside this one or in `learning`.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.madoc import grouping, watch
from madoc.calibration.madoc.actors import draw_parameters
from madoc.calibration.madoc.agents import BLUR_RANGE, Agents, AgentSettings
from madoc.calibration.madoc.collection import Features, StartMode, collect, empty_rows, remember, sensed, starts_of
from madoc.calibration.madoc.grouping import GroupingVAE
from madoc.calibration.madoc.sensing import noise_deviation, observation_warnings, window_length
from madoc.calibration.madoc.value_decomposition import Mixing
from madoc.calibration.madoc.watch import Watch
from madoc.errors import MadocError
from madoc.learning import replay
from madoc.learning.cloning import Clone, continue_cloning, fresh_clone
from madoc.learning.networks import adam, scalars
from madoc.learning.window_features import WindowScaling
from madoc.simulation.rollout import Walkers, begin
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, check_hyperparameters

Grouping = Literal["learned", "one", "each"]
GEOMETRY = {"policy": (20, 50), "logged": (100, 5), "replay": (100, 1)}
"""Parameter draws per epoch, and control steps of a row under one draw, by start mode."""
PAPER: dict[str, Any] = {
    "starts": "policy",
    "features": "raw",
    "hidden": (256, 256),
    "cloning_epochs": 100,
    "cloning_updates": 1000,
    "keep_cloning": True,
    "grouping_epochs": 200,
    "grouping_updates": 1000,
    "updates": 1000,
    "draws": 10,
    "horizon": 100,
    "learning_rate": 3e-4,
    "replay_capacity": 1_000_000,
    "patience": 0,
    "agents": AgentSettings(
        hidden=(256, 256),
        pair_bound=2.0,
        weigh_overlap=False,
        judge_rate=1.0,
        dropout=0.2,
        actor_batch=256,
        critic_rate=3e-4,
        actor_rate=3e-4,
        prior_rate=1e-3,
        reward_size=0.0,
    ),
}
"""Hyperparameters of the paper (appendix C, and the authors' code) that differ from the defaults."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MadocState:
    """Everything Madoc carries. `labels` are the parameters' groups, `grouped` counts epochs of grouping."""

    clone: Clone
    vae: GroupingVAE
    vae_optimiser: PyTree
    schemes: Int[np.ndarray, "votes d"]
    labels: Int[np.ndarray, " d"]
    agents: Agents
    rows: replay.Replay
    walkers: Walkers
    watch: Watch
    key: PRNGKeyArray
    grouped: int
    failures: int


@dataclass(frozen=True)
class Madoc:
    """Multi-agent domain calibration. `Madoc.paper()` has the paper's constants; these are leaner and faster.

    Attributes:
        mixing: `dop` (Madoc), `sum` (Madoc-VDN) or `independent` (Madoc-ISAC).
        groups: `learned`, `one` agent for all (Madoc-S), or `each` parameter its own (ungrouped).
        group_count: Learned groups; None takes the task's own number.
        starts: `policy` (free running from resets, the paper's), `logged` (short rollouts from logged states
            under the clone; velocities from positions where they are hidden) or `replay` (one step from logged state
            and action). None takes `logged` where states are known, else `policy`.
        window: Rows (s, a) that the discriminators see before s'; None takes 1 where an observation determines the
            state, as the paper does, else 3.
        sensor_noise: Put on simulated observations, as a share of a step's typical change; None takes the share that
            the data declares, `estimated` estimates it from the data.
        features: `standardised` (s, a) and s' - s, or `raw` as the paper's.
        hidden: Units per layer of clone and VAE.
        cloning_epochs: Epochs of behaviour cloning, before anything is simulated.
        cloning_updates: Updates in each.
        keep_cloning: Go on cloning during calibration, as the paper does.
        grouping_epochs: Epochs of grouping; each spends `epoch_steps` control steps.
        grouping_updates: Updates in each.
        epoch_steps: Control steps an epoch.
        updates: Calibration updates an epoch.
        draws: Parameter draws an epoch; None takes 20, 100, 100 for `policy`, `logged`, `replay`.
        horizon: Control steps under one draw; None takes 50, 5, 1 for `policy`, `logged`, `replay`.
        batch: Rows a cloning or grouping update.
        learning_rate: Adam's, for clone and VAE.
        replay_capacity: Simulated rows kept.
        patience: Epochs without a smaller mismatch after which it stops; 0 never stops.
        agents: How discriminators, critics and actors learn.
    """

    mixing: Mixing = "dop"
    groups: Grouping = "learned"
    group_count: Count | None = None
    starts: StartMode | None = None
    window: Count | None = None
    sensor_noise: NotNegative | Literal["estimated"] | None = None
    features: Features = "standardised"
    hidden: Layers = (128, 128)
    cloning_epochs: CountOrZero = 40
    cloning_updates: Count = 200
    keep_cloning: bool = False
    grouping_epochs: Count = 10
    grouping_updates: Count = 200
    epoch_steps: Count = 1000
    updates: Count = 100
    draws: Count | None = None
    horizon: Count | None = None
    batch: Count = 256
    learning_rate: NotNegative = 1e-3
    replay_capacity: Count = 50_000
    patience: CountOrZero = 150
    agents: AgentSettings = field(default_factory=AgentSettings)

    def __post_init__(self) -> None:
        check_hyperparameters(self)
        if self.starts == "replay" and self.horizon not in (None, 1):
            raise MadocError(f"starts=replay replays single steps: expected horizon 1 or none, got {self.horizon}")
        if self.starts == "replay" and self.window not in (None, 1):
            raise MadocError(f"starts=replay replays single steps: expected window 1 or none, got {self.window}")

    @classmethod
    def paper(cls, **changes: Any) -> "Madoc":
        """The paper's constants (appendix C and the authors' code): 1000 epochs of 1000 steps and updates.

        The authors' prior is a squared distance of means; Eq. (13)'s KL is kept here. Their code draws a
        parameter vector every 100 control steps of one walker; so does this, for ten walkers at a time.
        """
        return cls(**(PAPER | changes))

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> MadocState:
        """Fresh networks, empty buffers, rows at their starts.

        Raises:
            MadocError: Rows are to start at logged states, but those cannot be rebuilt.
        """
        task, simulator = problem.simulator.task, problem.simulator
        count = len(simulator.parameters)
        scaling, _ = self._windows(problem)
        window, following = scaling.sizes
        groups = self._group_count(problem)
        of_policy, of_vae, of_agents, of_start, key = jax.random.split(key, 5)
        vae = GroupingVAE(count, window, following, self.hidden, key=of_vae)
        agents = self.agents.init(window=window, observation=following, parameters=count, groups=groups, key=of_agents)
        return MadocState(
            clone=fresh_clone(
                problem.dataset.transitions, self.hidden, learning_rate=self.learning_rate, key=of_policy
            ),
            vae=vae,
            vae_optimiser=adam(self.learning_rate).init(eqx.filter(vae, eqx.is_array)),
            schemes=np.zeros((max(1, self.grouping_epochs // 20), count), dtype=np.int64),
            labels=np.arange(count) if groups == count else np.zeros(count, dtype=np.int64),
            agents=agents,
            rows=empty_rows(problem, scaling, self.replay_capacity),
            walkers=_out_of_step(self._begin(problem, self._geometry(problem)[0], of_start), task.max_episode_steps),
            watch=watch.begin_watch(agents.average),
            key=key,
            grouped=0,
            failures=0,
        )

    def step(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        """One epoch of whichever stage is due."""
        do = {"cloning": self._clone, "grouping": self._group, "calibrating": self._calibrate}
        return do[self._stage(state)](problem, state)

    def estimate(self, problem: CalibrationProblem, state: MadocState) -> Estimate:
        """The actors' deterministic output, averaged over updates, where the mismatch was lowest."""
        space, best, starts = problem.simulator.parameters, state.watch.best, self._start_mode(problem)
        scaled, std = np.tanh(np.asarray(best.mean, np.float64)), np.exp(np.asarray(best.log_std, np.float64))
        groups = (np.flatnonzero(state.labels == label).tolist() for label in np.unique(state.labels))
        return Estimate(
            mean=space.to_physical(scaled),
            std=(1.0 - scaled**2) * std * (space.high - space.low) / 2.0,
            groups=tuple(tuple(group) for group in groups),
            failures=state.failures,
            warnings=(
                *watch.warnings(state.watch, scaled, space.names),
                *observation_warnings(problem, self._window(problem), self._deviation(problem), starts),
            ),
        )

    def embeddings(self, problem: CalibrationProblem, state: MadocState) -> np.ndarray | None:
        """The VAE's embedding of each parameter, once it has been trained."""
        return np.asarray(state.vae.embeddings(), dtype=np.float64) if state.grouped else None

    def _stage(self, state: MadocState) -> str:
        """What the next epoch does."""
        if self._will_clone and state.clone.epochs < self.cloning_epochs:
            return "cloning"
        if 1 < len(state.agents.critics.weight) < len(state.labels) and state.grouped < self.grouping_epochs:
            return "grouping"
        return "calibrating"

    @property
    def _will_clone(self) -> bool:
        return self.starts != "replay"

    def _start_mode(self, problem: CalibrationProblem) -> StartMode:
        return self.starts or ("logged" if problem.states.starts_known else "policy")

    def _geometry(self, problem: CalibrationProblem) -> tuple[int, int]:
        """Draws, and control steps of a row: `horizon` of them end a window."""
        draws, horizon = GEOMETRY[self._start_mode(problem)]
        return self.draws or draws, (self.horizon or horizon) + self._window(problem) - 1

    def _window(self, problem: CalibrationProblem) -> int:
        return window_length(problem, self.window, self._start_mode(problem))

    def _windows(self, problem: CalibrationProblem) -> tuple[WindowScaling, tuple[Array, Array]]:
        return problem.features.windows(self.features, self._window(problem))

    def _deviation(self, problem: CalibrationProblem) -> Float[np.ndarray, " observation"]:
        return noise_deviation(problem, self.sensor_noise)

    def _group_count(self, problem: CalibrationProblem) -> int:
        count = len(problem.simulator.parameters)
        chosen = {"one": 1, "each": count, "learned": self.group_count or problem.simulator.task.groups}
        return min(count, chosen[self.groups])

    def _begin(self, problem: CalibrationProblem, systems: int, key: PRNGKeyArray) -> Walkers:
        rows = max(1, self.epoch_steps // (systems * self._geometry(problem)[1]))
        return begin(starts_of(problem, self._start_mode(problem)), key, systems=systems, rows=rows)

    def _clone(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        of_batches, key = jax.random.split(state.key)
        clone, metrics = continue_cloning(
            state.clone,
            problem.features.pairs,
            of_batches,
            learning_rate=self.learning_rate,
            batch=self.batch,
            updates=self.cloning_updates,
        )
        epoch = Epoch(metrics, stage="cloning", fraction=clone.epochs / max(1, self.cloning_epochs))
        return replace(state, clone=clone, key=key), epoch

    def _group(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        count = len(problem.simulator.parameters)
        of_draws, of_start, of_action, of_restart, of_batches, key = jax.random.split(state.key, 6)
        scaling, _ = self._windows(problem)
        draws = grouping.one_at_a_time(of_draws, count)
        rollout, _ = collect(
            problem,
            self._start_mode(problem),
            state.clone.policy,
            draws,
            self._begin(problem, count, of_start),
            steps=self._geometry(problem)[1],
            keys=(of_action, of_restart),
        )
        rollout = sensed(rollout, self._deviation(problem), jax.random.fold_in(of_action, 1))
        rows = remember(state.rows, scaling, rollout, draws=draws, identity=np.arange(count))
        vae, optimiser_state, metrics = grouping.train(
            state.vae,
            state.vae_optimiser,
            rows,
            of_batches,
            optimiser=adam(self.learning_rate),
            batch=self.batch,
            count=self.grouping_updates,
        )
        grouped, schemes = state.grouped + 1, state.schemes
        if grouped > self.grouping_epochs - len(schemes):
            scheme = grouping.cluster(vae.embeddings(), self._group_count(problem), seed=grouped)
            schemes = np.concatenate([schemes[1:], scheme[None]])
        done = grouped == self.grouping_epochs
        following = replace(
            state,
            vae=vae,
            vae_optimiser=optimiser_state,
            schemes=schemes,
            labels=grouping.vote(schemes) if done else state.labels,
            rows=replay.clear(rows) if done else rows,
            key=key,
            grouped=grouped,
            failures=state.failures + rollout.failures,
        )
        return following, Epoch(scalars(metrics), control_steps=rollout.valid.size, stage="grouping")

    def _calibrate(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        of_draws, of_start, of_action, of_restart, of_updates, key = jax.random.split(state.key, 6)
        systems, steps = self._geometry(problem)
        scaling, logged = self._windows(problem)
        draws = np.asarray(draw_parameters(state.agents.actors, of_draws, systems)[0], dtype=np.float64)
        fresh = self._start_mode(problem) == "logged"
        rollout, walkers = collect(
            problem,
            self._start_mode(problem),
            state.clone.policy,
            draws,
            self._begin(problem, systems, of_start) if fresh else state.walkers,
            steps=steps,
            keys=(of_action, of_restart),
        )
        rollout = sensed(rollout, self._deviation(problem), jax.random.fold_in(of_action, 1))
        rows = remember(state.rows, scaling, rollout, draws=draws, identity=np.zeros(systems, np.int64))
        agents, device_metrics = self.agents.update(
            state.agents,
            rows,
            logged,
            jnp.asarray(grouping.members(state.labels, self._group_count(problem))),
            of_updates,
            mixing=self.mixing,
            count=self.updates,
        )
        metrics = scalars(device_metrics)
        watched = watch.observe(
            state.watch, metrics, agents.average, steered_to=self.agents.reward_size, blur_range=BLUR_RANGE
        )
        following = replace(
            state,
            agents=agents,
            rows=rows,
            walkers=state.walkers if fresh else walkers,
            watch=watched,
            key=key,
            failures=state.failures + rollout.failures,
        )
        metrics |= {"mismatch": watched.mismatch, "failures": float(following.failures)}
        if self.keep_cloning and self._will_clone:
            cloned, cloning = self._clone(problem, following)
            following, metrics = cloned, metrics | cloning.metrics
        stalled = watch.stalled(watched, self.patience) if self.patience else None
        return following, Epoch(metrics, control_steps=rollout.valid.size, converged=stalled)


def _out_of_step(walkers: Walkers, max_age: int) -> Walkers:
    """Walkers whose ages are spread evenly, so that they do not reach the time limit together."""
    count = walkers.age.size
    return replace(walkers, age=(np.arange(count) * max_age // count).reshape(walkers.age.shape))
