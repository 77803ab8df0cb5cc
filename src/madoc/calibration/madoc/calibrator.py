"""Madoc: clone the behaviour policy, group the parameters if asked to, then calibrate with an agent for each group.

Jiang et al. 2024, Algorithm 1. Its equations are in the files beside this one and in `learning`. The simulator runs
freely from the task's resets; it is never set to a logged state and never differentiated, and rows (s, a, s') may come
in any order.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from madoc.calibration import free_rollouts
from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.free_rollouts import SensorNoise
from madoc.calibration.madoc import grouping, watch
from madoc.calibration.madoc.agents import AgentSettings, Mixing, draw_parameters, squashed
from madoc.calibration.madoc.grouping import Grouping, GroupingVAE, Votes
from madoc.calibration.madoc.state import Collection, MadocState, geometry
from madoc.errors import MadocError
from madoc.learning import replay
from madoc.learning.cloning import cloning_epoch, fresh_clone
from madoc.learning.expectation import Expectation, fresh_expectation, learn_expectation, noise_of_log
from madoc.learning.networks import scalars
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, check_hyperparameters

Features = Literal["residual", "raw"]
"""How discriminators see s': what it differs by from what a regression expects of (s, a), or as it is."""
PROBES = 2
"""Systems of an epoch whose rows are not learnt from but compared with each other: the actors' mean, and mid-range."""


@dataclass(frozen=True)
class Madoc:
    """Multi-agent domain calibration. `Madoc.paper()` has the paper's constants; these are leaner and faster.

    Attributes:
        mixing: How critics share the reward: `dop` is Eq. (11) and (12), as in the paper, `sum` that of Madoc-VDN,
            `independent` that of Madoc-ISAC.
        groups: `each` parameter an agent of its own (ungrouped), `learned` (by the paper's VAE), or `one` agent for all
            (Madoc-S).
        group_count: Number of groups that are learned; None takes the task's.
        window: Rows (s, a) that the discriminators see before s'; None takes 1 where an observation determines the
            state, as in the paper, else 3.
        sensor_noise: Noise put on simulated observations, as a share of a step's typical change; None estimates it from
            the log, once the regression has learnt; there is none without a regression.
        features: How discriminators see s': `residual`, what it differs by from what a regression on logged rows
            expects of (s, a), or `raw`, s' and (s, a) as they are, as in the paper.
        hidden: Units per layer of clone and VAE.
        cloning_epochs: Epochs of behaviour cloning, before anything is simulated.
        cloning_updates: Updates in each epoch of cloning.
        keep_cloning: Whether cloning continues during calibration, as in the paper.
        regression_hidden: Units per layer of the regression.
        regression_epochs: Epochs of the regression, before anything is simulated; at least one.
        regression_updates: Updates in each epoch of the regression.
        grouping_epochs: Epochs of grouping, outside the budget. One spends as many control steps as one of calibration,
            with a draw for each parameter.
        grouping_updates: Updates of the VAE in each epoch of grouping, rounded up to tens while groups are voted on.
        epoch_steps: Control steps in an epoch, rounded down to as many rows for each draw; one row for each where that
            is more. Rows of the two `PROBES` come on top.
        updates: Calibration updates in an epoch.
        draws: Parameter draws in an epoch; None takes 20 for up to `collection.FEW` parameters, else 100.
        horizon: Control steps under one draw; None takes 50 for up to `collection.FEW` parameters, else 10.
        batch: Rows in an update of cloning, regression or grouping.
        learning_rate: Adam's learning rate of clone and VAE.
        replay_capacity: Number of simulated rows that are kept.
        patience: Epochs without a smaller mismatch after which Madoc stops; 0 never stops. The mismatch is measured by
            the blur: without one (`agents.reward_size` 0) it has to be 0.
        agents: Hyperparameters of discriminators, critics and actors.
    """

    mixing: Mixing = "dop"
    groups: Grouping = "each"
    group_count: Count | None = None
    window: Count | None = None
    sensor_noise: SensorNoise = None
    features: Features = "residual"
    hidden: Layers = (128, 128)
    cloning_epochs: CountOrZero = 40
    cloning_updates: Count = 200
    keep_cloning: bool = False
    regression_hidden: Layers = (256, 256)
    regression_epochs: Count = 50
    regression_updates: Count = 200
    grouping_epochs: Count = 20
    grouping_updates: Count = 1000
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
        if self.groups != "learned" and self.group_count:
            raise MadocError(f"group_count is of groups=learned; leave it out with groups={self.groups}")
        if self.patience and not self.agents.reward_size:
            raise MadocError(
                "patience waits for a smaller mismatch, which agents.reward_size=0 leaves unmeasured: set patience=0"
            )

    @classmethod
    def paper(cls, **changes: object) -> "Madoc":
        """The paper's constants (appendix C and the authors' code): 1000 epochs of 1000 steps and updates.

        The authors' prior is a squared distance of means; Eq. (13)'s KL is kept here. Their code draws a
        parameter vector every 100 control steps of one walker; so does this, for ten walkers at a time. Networks have
        the paper's two hidden layers, where their code has three in discriminators and VAE. The VAE has no dropout, and
        the clone is kept once groups are found, where line 9 of Algorithm 1 begins it anew.
        """
        return cls(**(PAPER | changes))  # type: ignore[arg-type]

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> MadocState:
        """Fresh networks, empty buffers, rows at the task's resets.

        Raises:
            MadocError: Next observations are shuffled, or no episode of the log is as long as a window.
        """
        problem.require_pairs()
        count, groups = len(problem.simulator.parameters), self._group_count(problem)
        noise = free_rollouts.noise_deviation(problem, self.sensor_noise or 0.0, rows=1)
        collection = self._collection(problem, noise)
        window, following = collection.scaling.sizes
        of_policy, of_expectation, of_vae, of_agents, of_start, key = jax.random.split(key, 6)
        votes, expectation = None, None
        if 1 < groups < count:
            vae = GroupingVAE(count, window, following, self.hidden, key=of_vae)
            votes = grouping.begin_votes(vae, epochs=self.grouping_epochs, learning_rate=self.learning_rate)
        if self.features == "residual":
            updates = self.regression_epochs * self.regression_updates
            expectation = fresh_expectation(
                collection.logged, self.regression_hidden, updates=updates, key=of_expectation
            )
        agents = self.agents.init(window=window, observation=following, parameters=count, groups=groups, key=of_agents)
        systems, length = collection.systems + PROBES, collection.scaling.length
        return MadocState(
            clone=fresh_clone(
                problem.features.pairs(length - 1), self.hidden, learning_rate=self.learning_rate, key=of_policy
            ),
            expectation=expectation,
            noise=noise,
            grouping=votes,
            labels=np.arange(count) if groups == count else np.zeros(count, dtype=np.int64),
            agents=agents,
            rows=replay.empty(
                self.replay_capacity, pair=(window,), following=(following,), parameters=(count,), identity=()
            ),
            walkers=free_rollouts.begin_freely(
                problem, length, of_start, systems=systems, rows=collection.rows(systems)
            ),
            watch=watch.Watch(agents.average),
            key=key,
        )

    def step(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        """One epoch of cloning, of regression, of grouping where groups are to be found, or of calibration."""
        if state.clone.epochs < self.cloning_epochs:
            following, epoch = self._clone(problem, state)
        elif state.expectation is not None and state.expectation.epochs < self.regression_epochs:
            following, epoch = self._expect(problem, state, state.expectation)
        elif state.grouping is not None and state.grouped < self.grouping_epochs:
            following, epoch = self._group(problem, state, state.grouping)
        else:
            return self._calibrate(problem, state)
        return following, replace(epoch, fraction=self._prepared(following))

    def estimate(self, problem: CalibrationProblem, state: MadocState) -> Estimate:
        """The actors' deterministic output, averaged over updates, where the mismatch was lowest."""
        space, (scaled, std) = problem.simulator.parameters, squashed(state.watch.best)
        votes, voted = state.grouping, state.grouped == self.grouping_epochs
        groups = (np.flatnonzero(state.labels == label).tolist() for label in np.unique(state.labels))
        return Estimate(
            mean=space.to_physical(scaled),
            std=std * (space.high - space.low) / 2.0,
            groups=tuple(tuple(group) for group in groups),
            group_stability=grouping.agreement(votes.schemes) if voted and votes else None,
            failures=state.failures,
            warnings=(*watch.warnings(state.watch, scaled, space), *self._collection(problem, state.noise).warnings),
            settled=watch.settled(state.watch),
            embeddings=np.asarray(votes.vae.embeddings(), np.float64) if votes and state.grouped else None,
        )

    def _collection(self, problem: CalibrationProblem, noise: Float[np.ndarray, " observation"]) -> Collection:
        """How rows of this problem are simulated; what is None in the hyperparameters is chosen here."""
        window = self._length(problem)
        systems, horizon = geometry(len(problem.simulator.parameters))
        scaling, logged = problem.features.windows("raw" if self.features == "raw" else "standardised", window)
        return Collection(
            problem,
            systems=self.draws or systems,
            steps=(self.horizon or horizon) + window - 1,
            epoch_steps=self.epoch_steps,
            scaling=scaling,
            logged=logged,
            noise=noise,
        )

    def _length(self, problem: CalibrationProblem) -> int:
        """Rows that discriminators see; as many as the clone, which has to tell the state as they do."""
        return self.window or free_rollouts.rows_compared(problem)

    def _group_count(self, problem: CalibrationProblem) -> int:
        """Number of groups."""
        count = len(problem.simulator.parameters)
        if self.groups != "learned":
            return 1 if self.groups == "one" else count
        return min(count, self.group_count or problem.simulator.task.groups)

    def _prepared(self, state: MadocState) -> float:
        """Share of the epochs of cloning, regression and grouping that are done."""
        done = [state.clone.epochs, state.expectation.epochs if state.expectation else 0, state.grouped]
        regression = self.regression_epochs if state.expectation else 0
        return sum(done) / (self.cloning_epochs + regression + (self.grouping_epochs if state.grouping else 0))

    def _likeness(self, state: MadocState) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """How much rows look like logged ones: by what the regression leaves of s', or else by the judges' reward."""
        expectation = state.expectation
        if expectation is None:
            return lambda *rows: np.asarray(self.agents.reward(state.agents, *map(jnp.asarray, rows)))
        return lambda window, following: -np.arcsinh(np.abs(expectation.left(window, following))).mean(-1)

    def _clone(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        clone, key, epoch = cloning_epoch(
            state.clone,
            problem.features.pairs(self._length(problem) - 1),
            state.key,
            learning_rate=self.learning_rate,
            batch=self.batch,
            updates=self.cloning_updates,
            epochs=self.cloning_epochs,
        )
        return replace(state, clone=clone, key=key), epoch

    def _expect(
        self, problem: CalibrationProblem, state: MadocState, expectation: Expectation
    ) -> tuple[MadocState, Epoch]:
        of_batches, key = jax.random.split(state.key)
        collection = self._collection(problem, state.noise)
        expectation, loss = learn_expectation(
            expectation,
            collection.logged,
            of_batches,
            batch=self.batch,
            updates=self.regression_updates,
            epochs=self.regression_epochs,
        )
        following = replace(state, expectation=expectation, key=key)
        if expectation.epochs == self.regression_epochs and self.sensor_noise is None:
            noise = noise_of_log(problem.dataset, problem.features, collection.scaling.length, expectation)
            following = replace(following, noise=noise)
        return following, Epoch({"regression_loss": float(loss)}, stage="regression")

    def _group(self, problem: CalibrationProblem, state: MadocState, votes: Votes) -> tuple[MadocState, Epoch]:
        count, collection = len(problem.simulator.parameters), self._collection(problem, state.noise)
        of_draws, of_start, of_action, of_restart, of_batches, key = jax.random.split(state.key, 6)
        draws, length = grouping.one_at_a_time(of_draws, count), collection.scaling.length
        walkers = free_rollouts.begin_freely(
            problem, length, of_start, systems=count, rows=collection.rows(count), spread=False
        )
        rollout, _ = free_rollouts.roll_freely(
            problem,
            state.clone.policy,
            draws,
            walkers,
            steps=collection.steps,
            noise=state.noise,
            keys=(of_action, of_restart),
        )
        rows = collection.remember(state.rows, rollout, draws, np.arange(count), collection.scaling.changes)
        grouped = state.grouped + 1
        voting = grouped > self.grouping_epochs - grouping.voting_epochs(self.grouping_epochs)
        votes, loss = grouping.learn_votes(
            votes,
            free_rollouts.require_rows(rows, "madoc", collection.scaling.length),
            of_batches,
            learning_rate=self.learning_rate,
            batch=self.batch,
            updates=self.grouping_updates,
            groups=self._group_count(problem) if voting else None,
            seed=grouped,
        )
        done = grouped == self.grouping_epochs
        following = replace(
            state,
            grouping=votes,
            labels=grouping.vote(votes.schemes) if done else state.labels,
            rows=replay.clear(rows) if done else rows,
            key=key,
            grouped=grouped,
            failures=state.failures + rollout.failures,
        )
        steps = rollout.valid.size
        return following, Epoch({"grouping_loss": loss}, control_steps=steps, unbudgeted=steps, stage="grouping")

    def _calibrate(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        of_draws, of_action, of_restart, of_updates, key = jax.random.split(state.key, 5)
        collection, expectation = self._collection(problem, state.noise), state.expectation
        draws = np.asarray(draw_parameters(state.agents.actors, of_draws, collection.systems)[0], dtype=np.float64)
        probes = np.stack([squashed(state.agents.actors)[0], np.zeros(draws.shape[1])])
        everything, walkers = free_rollouts.roll_freely(
            problem,
            state.clone.policy,
            np.concatenate([draws, probes]),
            state.walkers,
            steps=collection.steps,
            noise=state.noise,
            keys=(of_action, of_restart),
        )
        rollout, probed = (everything.of_systems(part) for part in (slice(len(draws)), slice(len(draws), None)))
        identity = np.zeros(len(draws), np.int64)
        at_mean, at_middle = collection.mean_of(probed, self._likeness(state))
        described = (expectation.left,) if expectation else ()
        rows = collection.remember(state.rows, rollout, draws, identity, *described)
        logged = (collection.logged[0], expectation.logged) if expectation else collection.logged
        agents, device_metrics = self.agents.update(
            state.agents,
            free_rollouts.require_rows(rows, "madoc", collection.scaling.length),
            logged,
            jnp.asarray(grouping.members(state.labels, self._group_count(problem))),
            of_updates,
            mixing=self.mixing,
            count=self.updates,
        )
        metrics = scalars(device_metrics)
        gain = float(np.nan_to_num(at_mean - at_middle))
        watched = watch.observe(state.watch, metrics, agents.average, gain, self.agents)
        following = replace(
            state,
            agents=agents,
            rows=rows,
            walkers=walkers,
            watch=watched,
            key=key,
            failures=state.failures + everything.failures,
        )
        metrics |= {"mismatch": watched.mismatch, "failures": float(following.failures)}
        if self.keep_cloning:
            following, cloning = self._clone(problem, following)
            metrics |= cloning.metrics
        stalled = watch.stalled(watched, self.patience) if self.patience else None
        return following, Epoch(metrics, control_steps=everything.valid.size, converged=stalled)


PAPER: dict[str, object] = {
    "groups": "learned",
    "features": "raw",
    "hidden": (256, 256),
    "cloning_epochs": 100,
    "cloning_updates": 1000,
    "keep_cloning": True,
    "grouping_epochs": 200,
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
        entropy_weight=0.05,
        prior_rate=1e-3,
        average_rate=1.0,
        baseline=False,
        reward_size=0.0,
    ),
}
"""Hyperparameters of the paper (appendix C, and the authors' code) that differ from the defaults."""
