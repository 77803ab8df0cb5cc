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
from madoc.calibration.madoc.sensing import noise_deviation, said_of_observations, window_length
from madoc.calibration.madoc.value_decomposition import Mixing
from madoc.calibration.madoc.watch import Watch
from madoc.errors import MadocError, check_at_least
from madoc.learning import replay
from madoc.learning.cloning import clone
from madoc.learning.networks import adam, scalars
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.learning.window_features import WindowScaling
from madoc.simulation.rollout import Walkers, begin
from madoc.types import Epoch

Grouping = Literal["learned", "one", "each"]
GEOMETRY = {"policy": (20, 50), "logged": (100, 5), "replay": (100, 1)}
"""Parameter draws an epoch, and control steps a row lives under one draw, by start mode."""
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
    """Everything Madoc carries. `labels` are groups by parameter; counts are epochs done of each stage."""

    policy: TanhGaussianPolicy
    policy_optimiser: PyTree
    vae: GroupingVAE
    vae_optimiser: PyTree
    schemes: Int[np.ndarray, "votes d"]
    labels: Int[np.ndarray, " d"]
    agents: Agents
    rows: replay.Replay
    walkers: Walkers
    watch: Watch
    key: PRNGKeyArray
    cloned: int
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
            and action).
        window: Rows (s, a) that the discriminators see before s'; None takes 1 where an observation determines the
            state, as the paper does, else 3.
        sensor_noise: Put on simulated observations, as a share of a step's typical change; None takes what the data
            says of itself, `estimated` looks for it in the data.
        features: `standardised` (s, a) and s' - s, or `raw` as the paper's.
        hidden: Units per layer of clone and VAE.
        cloning_epochs: Epochs of behaviour cloning, before anything is simulated.
        cloning_updates: Updates in each.
        keep_cloning: Go on cloning during calibration, as the paper does.
        grouping_epochs: Epochs of grouping; each spends `epoch_steps` control steps.
        grouping_updates: Updates in each.
        epoch_steps: Control steps an epoch.
        updates: Calibration updates an epoch.
        draws: Parameter draws an epoch; None takes 20, 100, 100 for the three starts.
        horizon: Control steps under one draw; None takes 50, 5, 1 for the three starts.
        batch: Rows a cloning or grouping update.
        learning_rate: Adam's, for clone and VAE.
        replay_capacity: Simulated rows kept.
        patience: Epochs without a smaller mismatch after which it stops; 0 never stops.
        agents: How discriminators, critics and actors learn.
    """

    mixing: Mixing = "dop"
    groups: Grouping = "learned"
    group_count: int | None = None
    starts: StartMode = "logged"
    window: int | None = None
    sensor_noise: float | Literal["estimated"] | None = None
    features: Features = "standardised"
    hidden: tuple[int, ...] = (128, 128)
    cloning_epochs: int = 40
    cloning_updates: int = 200
    keep_cloning: bool = False
    grouping_epochs: int = 10
    grouping_updates: int = 200
    epoch_steps: int = 1000
    updates: int = 100
    draws: int | None = None
    horizon: int | None = None
    batch: int = 256
    learning_rate: float = 1e-3
    replay_capacity: int = 50_000
    patience: int = 150
    agents: AgentSettings = field(default_factory=AgentSettings)

    def __post_init__(self) -> None:
        counts = (
            "group_count",
            "window",
            "hidden",
            "grouping_epochs",
            "epoch_steps",
            "updates",
            "draws",
            "horizon",
            "batch",
        )
        check_at_least(self, **dict.fromkeys((*counts, "cloning_updates", "grouping_updates", "replay_capacity"), 1))
        check_at_least(self, cloning_epochs=0, learning_rate=0.0, patience=0)
        if self.starts == "replay" and self.horizon not in (None, 1):
            raise MadocError(f"starts=replay replays single steps: expected horizon 1 or none, got {self.horizon}")
        if self.starts == "replay" and self.window not in (None, 1):
            raise MadocError(f"starts=replay replays single steps: expected window 1 or none, got {self.window}")
        if isinstance(self.sensor_noise, float | int) and not (
            np.isfinite(self.sensor_noise) and self.sensor_noise >= 0
        ):
            raise MadocError(f"expected sensor_noise of 0 or more, got {self.sensor_noise}")

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
        count, observation, action = len(simulator.parameters), task.observation_size, simulator.action_size
        scaling, _ = self._windows(problem)
        window, following = scaling.sizes
        groups = self._group_count(problem)
        of_policy, of_vae, of_agents, of_start, key = jax.random.split(key, 5)
        logged = np.asarray(problem.dataset.transitions.observation)
        policy = TanhGaussianPolicy(
            observation,
            action,
            self.hidden,
            key=of_policy,
            offset=logged.mean(0),
            scale=np.maximum(logged.std(0), 1e-3),
        )
        vae = GroupingVAE(count, window, following, self.hidden, key=of_vae)
        agents = self.agents.init(
            window=window,
            observation=following,
            parameters=count,
            groups=groups,
            key=of_agents,
        )
        return MadocState(
            policy=policy,
            policy_optimiser=adam(self.learning_rate).init(eqx.filter(policy, eqx.is_array)),
            vae=vae,
            vae_optimiser=adam(self.learning_rate).init(eqx.filter(vae, eqx.is_array)),
            schemes=np.zeros((max(1, self.grouping_epochs // 20), count), dtype=np.int64),
            labels=np.arange(count) if groups == count else np.zeros(count, dtype=np.int64),
            agents=agents,
            rows=empty_rows(problem, scaling, self.replay_capacity),
            walkers=_out_of_step(self._begin(problem, self._geometry(problem)[0], of_start), task.max_episode_steps),
            watch=watch.begin_watch(agents.average),
            key=key,
            cloned=0,
            grouped=0,
            failures=0,
        )

    def step(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        """One epoch of whichever stage is due."""
        do = {"cloning": self._clone, "grouping": self._group, "calibrating": self._calibrate}
        return do[self._stage(state)](problem, state)

    def estimate(self, problem: CalibrationProblem, state: MadocState) -> Estimate:
        """The actors' deterministic output, averaged over updates, where the mismatch was lowest."""
        space, best = problem.simulator.parameters, state.watch.best
        unit, std = np.tanh(np.asarray(best.mean, np.float64)), np.exp(np.asarray(best.log_std, np.float64))
        groups = (np.flatnonzero(state.labels == label).tolist() for label in np.unique(state.labels))
        return Estimate(
            mean=space.to_physical(unit),
            std=(1.0 - unit**2) * std * (space.high - space.low) / 2.0,
            groups=tuple(tuple(group) for group in groups),
            failures=state.failures,
            warnings=(
                *watch.warnings(state.watch, unit, space.names),
                *said_of_observations(problem, self._window(problem), self._deviation(problem), self.starts),
            ),
        )

    def embeddings(self, problem: CalibrationProblem, state: MadocState) -> np.ndarray | None:
        """The VAE's embedding of each parameter, once it has been trained."""
        return np.asarray(state.vae.embeddings(), dtype=np.float64) if state.grouped else None

    def _stage(self, state: MadocState) -> str:
        """What the next epoch does."""
        if self._will_clone and state.cloned < self.cloning_epochs:
            return "cloning"
        if 1 < len(state.agents.critics.weight) < len(state.labels) and state.grouped < self.grouping_epochs:
            return "grouping"
        return "calibrating"

    @property
    def _will_clone(self) -> bool:
        return self.starts != "replay"

    def _geometry(self, problem: CalibrationProblem) -> tuple[int, int]:
        """Draws, and control steps of a row: `horizon` of them end a window."""
        draws, horizon = GEOMETRY[self.starts]
        return self.draws or draws, (self.horizon or horizon) + self._window(problem) - 1

    def _window(self, problem: CalibrationProblem) -> int:
        return window_length(problem, self.window, self.starts)

    def _windows(self, problem: CalibrationProblem) -> tuple[WindowScaling, tuple[Array, Array]]:
        return problem.windows(self.features, self._window(problem))

    def _deviation(self, problem: CalibrationProblem) -> Float[np.ndarray, " observation"]:
        return noise_deviation(problem, self.sensor_noise)

    def _group_count(self, problem: CalibrationProblem) -> int:
        count = len(problem.simulator.parameters)
        chosen = {"one": 1, "each": count, "learned": self.group_count or problem.simulator.task.groups}
        return min(count, chosen[self.groups])

    def _begin(self, problem: CalibrationProblem, systems: int, key: PRNGKeyArray) -> Walkers:
        rows = max(1, self.epoch_steps // (systems * self._geometry(problem)[1]))
        return begin(starts_of(problem, self.starts), key, systems=systems, rows=rows)

    def _clone(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        of_batches, key = jax.random.split(state.key)
        policy, optimiser_state, metrics = clone(
            state.policy,
            state.policy_optimiser,
            problem.pairs,
            of_batches,
            optimiser=adam(self.learning_rate),
            batch=self.batch,
            count=self.cloning_updates,
        )
        cloned = {"policy": policy, "policy_optimiser": optimiser_state, "cloned": state.cloned + 1}
        following = replace(state, key=key, **cloned)
        return following, Epoch(
            scalars(metrics), stage="cloning", fraction=following.cloned / max(1, self.cloning_epochs)
        )

    def _group(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        count = len(problem.simulator.parameters)
        of_draws, of_start, of_action, of_restart, of_batches, key = jax.random.split(state.key, 6)
        scaling, _ = self._windows(problem)
        draws = grouping.one_at_a_time(of_draws, count)
        rollout, _ = collect(
            problem,
            self.starts,
            state.policy,
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
        fresh = self.starts == "logged"
        rollout, walkers = collect(
            problem,
            self.starts,
            state.policy,
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
            following, metrics = replace(cloned, cloned=state.cloned), metrics | cloning.metrics
        stalled = watch.stalled(watched, self.patience) if self.patience else None
        return following, Epoch(metrics, control_steps=rollout.valid.size, converged=stalled)


def _out_of_step(walkers: Walkers, max_age: int) -> Walkers:
    """Rows that did not all start at once: ages spread evenly, so that time limits do not fall together."""
    count = walkers.age.size
    return replace(walkers, age=(np.arange(count) * max_age // count).reshape(walkers.age.shape))
