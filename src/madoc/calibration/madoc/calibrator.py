"""Madoc: clone the behaviour policy, group the parameters if asked to, then calibrate with an agent for each group.

Jiang et al. 2024, Algorithm 1. Its equations are in the files beside this one and in `learning`.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from madoc.calibration.base import CalibrationProblem, Estimate
from madoc.calibration.madoc import effects, grouping, innovations, watch
from madoc.calibration.madoc.actors import draw_parameters, squashed
from madoc.calibration.madoc.agents import OF_CHANGES, OF_INNOVATIONS, Agents, AgentSettings, Resolution
from madoc.calibration.madoc.beginning import first_actors, sentence, told
from madoc.calibration.madoc.collection import Collection, Features, StartMode, geometry
from madoc.calibration.madoc.effects import SharedEffects
from madoc.calibration.madoc.grouping import Grouping, GroupingVAE, Votes
from madoc.calibration.madoc.paper import PAPER
from madoc.calibration.madoc.state import MadocState
from madoc.calibration.madoc.value_decomposition import Mixing
from madoc.calibration.sensing import SensorNoise, noise_deviation, rows_compared
from madoc.errors import MadocError
from madoc.learning import replay
from madoc.learning.cloning import cloning_epoch, fresh_clone
from madoc.learning.networks import scalars
from madoc.simulation.rollout import out_of_step
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, check_hyperparameters


@dataclass(frozen=True)
class Madoc:
    """Multi-agent domain calibration. `Madoc.paper()` has the paper's constants; these are leaner and faster.

    Attributes:
        mixing: How critics learn what their group is worth. `counterfactual` compares the reward of a row with what it
            is if the group alone is set back to the centre of its actor; it needs innovations (see `features`), and is
            `dop` until there are any. `dop` is Eq. (11) and (12), as in the paper. `sum` is that of Madoc-VDN,
            `independent` that of Madoc-ISAC.
        groups: `each` parameter an agent of its own (ungrouped), `physics` (an agent for parameters that move the same
            signals, by derivatives of the simulator), `learned` (by the paper's VAE), or `one` agent for all (Madoc-S).
        group_count: Number of groups; None takes the most stable number, or that of the task for `learned`.
        starts: `policy` (the clone acts from resets on, as in the paper), `logged` (short rollouts of the clone from
            logged states; hidden velocities are taken from positions) or `replay` (one step from each logged state and
            action). None, as `madoc-local` has it, takes `logged` where states are known, else `policy`.
        window: Rows (s, a) that the discriminators see before s'; None takes 1 where an observation determines the
            state, as in the paper, else 3.
        sensor_noise: Noise put on simulated observations, as a share of a step's typical change. None takes the share
            that the data declares, `estimated` estimates the noise from the data.
        features: How discriminators see s': `standardised` (s' - s), `innovations` (s' - s, and once simulated rows are
            where logged ones are, what s' differs by from the simulator's prediction at a recent estimate) or `raw` (s'
            and (s, a) as they are, as in the paper). None takes `innovations` where an observation determines the
            state, else `standardised`.
        hidden: Units per layer of clone and VAE.
        cloning_epochs: Epochs of behaviour cloning, before anything is simulated.
        cloning_updates: Updates in each epoch of cloning.
        keep_cloning: Whether cloning continues during calibration, as in the paper.
        grouping_epochs: Epochs of grouping, outside the budget. One spends at most 100 · (1 + 2 d) control steps by
            physics, and as one of calibration, with a draw for each of d parameters, if groups are learned.
        grouping_updates: Updates of the VAE in each epoch of grouping, rounded up to tens while groups are voted on.
        epoch_steps: Control steps of rollouts in an epoch, rounded down to as many rows for each draw; one row for each
            where that is more. Predictions for innovations take as many again, and those of logged rows at a new
            reference, with derivatives of a few, come on top.
        updates: Calibration updates in an epoch.
        draws: Parameter draws in an epoch; None takes 100, of `policy` 20 for up to `FEW` parameters.
        horizon: Control steps under one draw; None takes 1 for `replay`, 5 for `logged`, for `policy` 10, or 50 for up
            to `FEW` parameters.
        batch: Rows in an update of cloning or grouping.
        learning_rate: Adam's learning rate of clone and VAE.
        replay_capacity: Number of simulated rows that are kept.
        patience: Epochs without a smaller mismatch after which Madoc stops; 0 never stops. The mismatch is measured by
            the blur: without one (`agents.reward_size` 0) it has to be 0.
        agents: Hyperparameters of discriminators, critics and actors.
    """

    mixing: Mixing = "counterfactual"
    groups: Grouping = "each"
    group_count: Count | None = None
    starts: StartMode | None = "policy"
    window: Count | None = None
    sensor_noise: SensorNoise = None
    features: Features | None = None
    hidden: Layers = (128, 128)
    cloning_epochs: CountOrZero = 40
    cloning_updates: Count = 200
    keep_cloning: bool = False
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
        if self.groups in ("one", "each") and self.group_count:
            raise MadocError(f"group_count is of groups=physics or learned; leave it out with groups={self.groups}")
        if self.patience and not self.agents.reward_size:
            raise MadocError(
                "patience waits for a smaller mismatch, which agents.reward_size=0 leaves unmeasured: set patience=0"
            )
        if self.starts == "replay" and self.horizon not in (None, 1):
            raise MadocError(f"starts=replay replays single steps: expected horizon 1 or none, got {self.horizon}")
        if self.starts == "replay" and self.keep_cloning:
            raise MadocError("starts=replay replays logged actions, without a clone: set keep_cloning=false")
        if self.starts == "replay" and self.window not in (None, 1):
            raise MadocError(f"starts=replay replays single steps: expected window 1 or none, got {self.window}")

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
        """Fresh networks, empty buffers, rows at their starts.

        Raises:
            MadocError: Rows are to start at logged states, or discriminators to see innovations, but the log's states
                cannot be rebuilt.
        """
        count, groups = len(problem.simulator.parameters), self._group_count(problem)
        collection = self.collection(problem)
        window, following = collection.scaling.sizes
        of_policy, of_vae, of_agents, of_start, of_slopes, key = jax.random.split(key, 6)
        found: Votes | SharedEffects | None = None
        if 1 < groups < count and self.groups == "physics":
            found = SharedEffects(np.zeros((self.grouping_epochs, count, count)))
        elif 1 < groups < count:
            vae = GroupingVAE(count, window, following, self.hidden, key=of_vae)
            found = grouping.begin_votes(vae, epochs=self.grouping_epochs, learning_rate=self.learning_rate)
        seen = self._sees_innovations(problem, collection)
        reference = innovations.no_reference(problem, collection.scaling.scaling, of_slopes) if seen else None
        agents = self._fresh_agents(problem, OF_CHANGES, of_agents)
        logged, time_limit = problem.dataset.transitions, problem.simulator.task.max_episode_steps
        return MadocState(
            clone=fresh_clone(logged, self.hidden, learning_rate=self.learning_rate, key=of_policy),
            grouping=found,
            stability=0.0,
            labels=np.arange(count) if groups == count else np.zeros(count, dtype=np.int64),
            agents=agents,
            rows=collection.empty_rows(self.replay_capacity),
            walkers=out_of_step(collection.begin(collection.systems, of_start), time_limit),
            reference=reference,
            watch=watch.begin_watch(agents.average),
            key=key,
            grouped=0,
            failures=0,
        )

    def step(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        """One epoch of cloning, of grouping where groups are to be found, or of calibration."""
        if self.starts != "replay" and state.clone.epochs < self.cloning_epochs:
            return self._clone(problem, state)
        if state.grouped < self.grouping_epochs and isinstance(state.grouping, SharedEffects):
            return self._see_effects(problem, state, state.grouping)
        if state.grouped < self.grouping_epochs and isinstance(state.grouping, Votes):
            return self._learn_votes(problem, state, state.grouping)
        return self._calibrate(problem, state)

    def estimate(self, problem: CalibrationProblem, state: MadocState) -> Estimate:
        """The actors' deterministic output, averaged over updates, where the mismatch was lowest."""
        space, (scaled, std) = problem.simulator.parameters, squashed(state.watch.best)
        collection = self.collection(problem)
        may_start = collection.mode == "policy" and problem.states.starts_known
        groups = (np.flatnonzero(state.labels == label).tolist() for label in np.unique(state.labels))
        return Estimate(
            mean=space.to_physical(scaled),
            std=std * (space.high - space.low) / 2.0,
            groups=tuple(tuple(group) for group in groups),
            group_stability=state.stability if state.grouped == self.grouping_epochs else None,
            failures=state.failures,
            warnings=(
                *watch.warnings(state.watch, scaled, space.names, may_start_logged=may_start),
                *self._of_features(problem, collection, state),
                *collection.warnings,
            ),
            settled=watch.settled(state.watch),
            began=sentence(problem),
        )

    def embeddings(self, problem: CalibrationProblem, state: MadocState) -> np.ndarray | None:
        """A vector for each parameter, from its effects or the VAE's encoder; None before any grouping."""
        return state.grouping.embeddings() if state.grouping is not None and state.grouped else None

    def collection(self, problem: CalibrationProblem) -> Collection:
        """How rows of this problem are simulated; what is None in the hyperparameters is chosen here."""
        mode = self.starts or ("logged" if problem.states.starts_known else "policy")
        window = self.window or (1 if mode == "replay" else rows_compared(problem))
        systems, horizon = geometry(mode, len(problem.simulator.parameters))
        kind: Literal["standardised", "raw"] = "raw" if self.features == "raw" else "standardised"
        scaling, logged = problem.features.windows(kind, window)
        return Collection(
            problem,
            mode,
            systems=self.draws or systems,
            steps=(self.horizon or horizon) + window - 1,
            epoch_steps=self.epoch_steps,
            scaling=scaling,
            logged=logged,
            noise=noise_deviation(problem, self.sensor_noise),
        )

    def _sees_innovations(self, problem: CalibrationProblem, collection: Collection) -> bool:
        if self.features not in (None, "innovations"):
            return False
        reason = innovations.obstacle(problem, collection.scaling.length, collection.noise)
        if reason and self.features:
            raise MadocError(f"features=innovations cannot be had here: {reason}; leave features= out")
        return not reason

    def _of_features(self, problem: CalibrationProblem, collection: Collection, state: MadocState) -> tuple[str, ...]:
        """Why discriminators saw changes of s' throughout, in a sentence; none where they were asked to."""
        if self.features not in (None, "innovations") or not watch.settled(state.watch):
            return ()
        if state.reference is None:
            reason = innovations.obstacle(problem, collection.scaling.length, collection.noise)
        elif state.reference.age < 0:
            apart = state.watch.overlap < innovations.OVERLAP
            reason = "simulated rows were too seldom where logged ones are" if apart else "no row could be predicted"
        else:
            return ()
        return (f"discriminators saw changes of s' and no innovations, which are sharper: {reason}",)

    def _fresh_agents(self, problem: CalibrationProblem, resolution: Resolution, key: PRNGKeyArray) -> Agents:
        window, observation = self.collection(problem).scaling.sizes
        return self.agents.init(
            window=window,
            observation=observation,
            actors=first_actors(problem),
            groups=self._group_count(problem),
            resolution=resolution,
            key=key,
        )

    def _begun_again(self, problem: CalibrationProblem, state: MadocState, key: PRNGKeyArray) -> Agents:
        """The agents where innovations begin: the same actors, fresh networks, as theirs have learnt of s' - s."""
        kept = ("actors", "prior", "average", "updates", "actor_optimiser")
        fresh = self._fresh_agents(problem, OF_INNOVATIONS, key)
        return replace(fresh, **{name: getattr(state.agents, name) for name in kept})

    def _group_count(self, problem: CalibrationProblem) -> int:
        """Number of groups, or the most that can be chosen by physics."""
        count = len(problem.simulator.parameters)
        if self.groups in ("one", "each"):
            return 1 if self.groups == "one" else count
        most = effects.most_groups(count) if self.groups == "physics" else problem.simulator.task.groups
        return min(count, self.group_count or most)

    def _prepared(self, state: MadocState) -> float:
        """Share of the epochs of cloning and grouping that are done."""
        cloning = 0 if self.starts == "replay" else self.cloning_epochs
        finding = self.grouping_epochs if state.grouping is not None else 0
        return min(1.0, (min(state.clone.epochs, cloning) + state.grouped) / max(1, cloning + finding))

    def _clone(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        clone, key, epoch = cloning_epoch(
            state.clone,
            problem.features.pairs,
            state.key,
            learning_rate=self.learning_rate,
            batch=self.batch,
            updates=self.cloning_updates,
            epochs=self.cloning_epochs,
        )
        following = replace(state, clone=clone, key=key)
        return following, replace(epoch, fraction=self._prepared(following))

    def _see_effects(
        self, problem: CalibrationProblem, state: MadocState, found: SharedEffects
    ) -> tuple[MadocState, Epoch]:
        of_resampling, key = jax.random.split(state.key)
        found, steps, failures = effects.see_more(found, problem, state.grouped)
        following = replace(
            state, grouping=found, key=key, grouped=state.grouped + 1, failures=state.failures + failures
        )
        if following.grouped == self.grouping_epochs:
            seed = int(jax.random.randint(of_resampling, (), 0, 2**31 - 1))
            groups = found.groups(count=self.group_count, seed=seed)
            following = replace(following, labels=groups.labels, stability=groups.stability)
        return following, self._of_grouping(following, {"stability": following.stability}, steps)

    def _learn_votes(self, problem: CalibrationProblem, state: MadocState, votes: Votes) -> tuple[MadocState, Epoch]:
        count, collection = len(problem.simulator.parameters), self.collection(problem)
        of_draws, of_start, of_action, of_restart, of_batches, key = jax.random.split(state.key, 6)
        draws, walkers = grouping.one_at_a_time(of_draws, count), collection.begin(count, of_start)
        rollout, _ = collection.roll(state.clone.policy, draws, walkers, (of_action, of_restart))
        rows = _some(collection.remember(state.rows, rollout, draws, np.arange(count)), collection)
        grouped = state.grouped + 1
        voting = grouped > self.grouping_epochs - grouping.voting_epochs(self.grouping_epochs)
        votes, loss = grouping.learn_votes(
            votes,
            rows,
            of_batches,
            learning_rate=self.learning_rate,
            batch=self.batch,
            updates=self.grouping_updates,
            groups=self._group_count(problem) if voting else None,
            seed=grouped,
            state_at=None if collection.scaling.scaling.difference else collection.scaling.last_row,
        )
        done = grouped == self.grouping_epochs
        following = replace(
            state,
            grouping=votes,
            labels=grouping.vote(votes.schemes) if done else state.labels,
            stability=grouping.agreement(votes.schemes) if done else 0.0,
            rows=replay.clear(rows) if done else rows,
            key=key,
            grouped=grouped,
            failures=state.failures + rollout.failures,
        )
        return following, self._of_grouping(following, {"grouping_loss": loss}, rollout.valid.size)

    def _of_grouping(self, following: MadocState, metrics: dict[str, float], steps: int) -> Epoch:
        fraction = self._prepared(following)
        return Epoch(metrics, control_steps=steps, unbudgeted=steps, stage="grouping", fraction=fraction)

    def _calibrate(self, problem: CalibrationProblem, state: MadocState) -> tuple[MadocState, Epoch]:
        of_draws, of_start, of_action, of_restart, of_reference, of_networks, of_updates, key = jax.random.split(
            state.key, 8
        )
        collection = self.collection(problem)
        systems, fresh = collection.systems, collection.mode == "logged"
        draws = np.asarray(draw_parameters(state.agents.actors, of_draws, systems)[0], dtype=np.float64)
        walkers = collection.begin(systems, of_start) if fresh else state.walkers
        rollout, walkers = collection.roll(state.clone.policy, draws, walkers, (of_action, of_restart))
        agents, watched, reference, rows = state.agents, state.watch, state.reference, state.rows
        logged, described, resolution = collection.logged, None, OF_CHANGES
        steps, failures, unit = rollout.valid.size, rollout.failures, 1.0
        if reference is not None and (reference.age >= 0 or innovations.may_begin(problem, watched)):
            scaling, actors = collection.scaling.scaling, agents.actors
            seen = innovations.seen(problem, scaling, reference, actors, draws, rollout, of_reference)
            steps, failures = steps + seen.control_steps, failures + seen.failures
            if seen.following is not None:
                if reference.age < 0:
                    agents, watched = self._begun_again(problem, state, of_networks), watch.begin_again(watched)
                rows = replay.clear(rows) if seen.reference.age == 0 else rows
                reference, described, resolution = seen.reference, seen.following, OF_INNOVATIONS
                logged = reference.pair, reference.following
                unit = reference.size
        rows = _some(collection.remember(rows, rollout, draws, np.zeros(systems, np.int64), described), collection)
        agents, device_metrics = self.agents.update(
            agents,
            rows,
            logged,
            jnp.asarray(grouping.members(state.labels, self._group_count(problem))),
            of_updates,
            mixing=self.mixing,
            resolution=resolution,
            count=self.updates,
            told=told(problem),
            slopes=reference.slopes if reference is not None and described is not None else None,
        )
        metrics = scalars(device_metrics)
        watched = watch.observe(
            watched,
            metrics,
            agents.average,
            steered_to=self.agents.reward_size,
            blur_range=(resolution.smallest, resolution.largest),
            unit=unit,
        )
        following = replace(
            state,
            agents=agents,
            rows=rows,
            walkers=state.walkers if fresh else walkers,
            reference=reference,
            watch=watched,
            key=key,
            failures=state.failures + failures,
        )
        metrics |= {"mismatch": watched.mismatch, "failures": float(following.failures)}
        if self.keep_cloning:
            following, cloning = self._clone(problem, following)
            metrics |= cloning.metrics
        stalled = watch.stalled(watched, self.patience) if self.patience else None
        return following, Epoch(metrics, control_steps=steps, converged=stalled)


def _some(rows: replay.Replay, collection: Collection) -> replay.Replay:
    """The rows simulated so far.

    Raises:
        MadocError: There are none.
    """
    if not int(rows.written):
        raise MadocError(
            f"madoc: every row simulated so far diverged or ended within {collection.scaling.length} steps, so "
            "there is nothing to compare with the log; narrow the ranges of the parameters"
        )
    return rows
