"""NPE: neural posterior estimation on rollouts of a cloned policy, for data whose states cannot be had.

BayesSim (Ramos et al. 2019) and NPDR (Muratore et al. 2022) condition a density on summaries of rollouts. Here
summaries are moments of an emulator of the next row, which do not depend on where the clone goes; the density is a
flow, and proposals are cut off to the posterior's region (Deistler et al. 2022). Nothing is set to a logged state, and
the simulator is never differentiated.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray, PyTree
from pydantic import Field

from madoc.calibration import free_rollouts
from madoc.calibration.base import CalibrationProblem, Estimate, at_end_of_range
from madoc.calibration.baselines.npe import moments, posterior
from madoc.calibration.baselines.npe.moments import Cosines, Emulator, Sets
from madoc.calibration.baselines.npe.posterior import Belief
from madoc.calibration.free_rollouts import SensorNoise
from madoc.learning import replay
from madoc.learning.cloning import Clone, cloning_epoch, fresh_clone
from madoc.learning.features import HIDDEN_WINDOW
from madoc.learning.networks import falling_adam
from madoc.simulation.rollout import Rollout, Walkers
from madoc.types import Count, CountOrZero, Epoch, Layers, NotNegative, Positive, check_hyperparameters

WIDTHS = (1.0, 2.0, 4.0)
"""Widths of the kernels whose features next observations have, in units of √dimensions."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NpeState:
    """Everything that NPE carries.

    Attributes:
        rows: Simulated rows that the emulator is trained on.
        features: Features of next observations, used where they belong to unknown rows.
        sets: Moments of this round's draws, each in two halves.
        points: This round's draws, scaled to [-1, 1].
        collected: Epochs of simulation in this round.
        fitted: Epochs of training since; at the end of training a round begins.
        trained: Whether the emulator has been trained.
        low: Lower ends of the box that is drawn from.
        high: Its upper ends.
        failures: Simulated rows that failed.
    """

    clone: Clone
    walkers: Walkers
    emulator: Emulator
    optimiser: PyTree
    rows: replay.Replay
    features: Cosines
    sets: Sets
    points: Float[np.ndarray, "draws d"]
    collected: int
    fitted: int
    trained: int
    low: Float[np.ndarray, " d"]
    high: Float[np.ndarray, " d"]
    belief: Belief
    key: PRNGKeyArray
    failures: int = 0


@dataclass(frozen=True)
class Npe:
    """Rounds of simulation under draws from a box, of a posterior, and of training the emulator on what was simulated.

    A draw's moments are computed before the emulator has seen its rows, so that the posterior knows how it errs. Where
    one row tells a state, or rows have lost their order, a window is one row, else `HIDDEN_WINDOW`.

    Attributes:
        draws: Draws in an epoch of simulation.
        rows: Rows under each draw, in two halves.
        horizon: Control steps of each row in an epoch; rows go on from where the last draw left them.
        epochs: Epochs of simulation in a round. Of their draws the posterior is learnt.
        hidden: Units per layer of clone and emulator.
        fitting_epochs: Epochs of training the emulator in a round.
        updates: Updates in each of them.
        batch: Simulated rows in an update.
        learning_rate: Adam's learning rate; the emulator's falls to 0 in each round.
        replay_capacity: Simulated rows that the emulator is trained on, the latest.
        features: Cosine features of next observations, used where it is not known which row they belong to.
        flow_layers: Layers of the flow.
        flow_width: Units in each.
        flow_updates: Updates of the flow in a round.
        samples: Samples of the posterior.
        widening: Width of the box that is drawn from, in widths of nearly all of the posterior.
        smallest_half: Smallest half-width of that box, as a share of that of the prior's.
        cloning_epochs: Epochs of behaviour cloning, before anything is simulated.
        cloning_updates: Updates in each epoch of cloning.
        cloning_batch: Logged rows in an update of the clone.
        sensor_noise: Noise put on simulated observations, as a share of a step's typical change; None estimates it from
            the log.
    """

    draws: Annotated[int, Field(ge=2)] = 50
    rows: Annotated[int, Field(ge=2)] = 2
    horizon: Annotated[int, Field(ge=HIDDEN_WINDOW)] = 50
    epochs: Count = 6
    hidden: Layers = (128, 128)
    fitting_epochs: Count = 20
    updates: Count = 250
    batch: Count = 512
    learning_rate: NotNegative = 1e-3
    replay_capacity: Count = 80_000
    features: Count = 200
    flow_layers: Count = 3
    flow_width: Count = 32
    flow_updates: Count = 400
    samples: Annotated[int, Field(ge=2)] = 2000
    widening: Positive = 2.0
    smallest_half: Positive = 0.1
    cloning_epochs: CountOrZero = 40
    cloning_updates: Count = 200
    cloning_batch: Count = 256
    sensor_noise: SensorNoise = None

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    def init(self, problem: CalibrationProblem, key: PRNGKeyArray) -> NpeState:
        """Fresh networks, the whole box to draw from, rows at resets."""
        of_clone, of_emulator, of_features, of_start, key = jax.random.split(key, 5)
        simulator, length = problem.simulator, free_rollouts.rows_compared(problem)
        size, count = simulator.task.observation_size, len(simulator.parameters)
        window = length * (size + simulator.action_size)
        emulator = moments.fresh_emulator(window, size, count, self.hidden, of_emulator)
        kept = size + (self.features if moments.unpaired(problem) else count)
        sets, box = (self.epochs * self.draws, 2), np.ones(count)
        return NpeState(
            clone=fresh_clone(
                problem.features.pairs(length - 1), self.hidden, learning_rate=self.learning_rate, key=of_clone
            ),
            walkers=free_rollouts.begin_freely(problem, length, of_start, systems=self.draws, rows=self.rows),
            emulator=emulator,
            optimiser=self._optimiser(emulator),
            rows=replay.empty(self.replay_capacity, window=(window,), following=(size,), scaled=(count,)),
            features=moments.cosines(of_features, size, self.features, WIDTHS),
            sets=Sets(np.zeros((*sets, kept)), np.zeros((*sets, kept, count)), np.zeros(sets)),
            points=np.zeros((self.epochs * self.draws, count)),
            collected=0,
            fitted=0,
            trained=0,
            low=-box,
            high=box,
            belief=posterior.prior_belief(count),
            key=key,
        )

    def step(self, problem: CalibrationProblem, state: NpeState) -> tuple[NpeState, Epoch]:
        """One epoch of cloning, of simulation, or of training the emulator on what was simulated."""
        if state.clone.epochs < self.cloning_epochs:
            return self._clone(problem, state)
        return (self._simulate if state.collected < self.epochs else self._fit)(problem, state)

    def estimate(self, problem: CalibrationProblem, state: NpeState) -> Estimate:
        """Mean, covariance and 95 % intervals of the posterior."""
        space, belief = problem.simulator.parameters, state.belief
        half = (space.high - space.low) / 2.0
        covariance = half[:, None] * belief.covariance * half
        warnings = posterior.doubts(belief, space.names)
        return Estimate(
            mean=space.to_physical(belief.mean),
            std=np.sqrt(np.diag(covariance)),
            failures=state.failures,
            warnings=(*warnings, *at_end_of_range(belief.mean, space)),
            covariance=covariance,
            interval=np.stack([space.to_physical(end) for end in belief.interval.T], axis=-1),
            settled=not warnings,
        )

    def _optimiser(self, emulator: Emulator) -> PyTree:
        """Its state before a round of training."""
        return falling_adam(self.learning_rate, self._horizon).init(eqx.filter(emulator, eqx.is_array))

    @property
    def _horizon(self) -> int:
        return self.updates * self.fitting_epochs

    def _clone(self, problem: CalibrationProblem, state: NpeState) -> tuple[NpeState, Epoch]:
        clone, key, epoch = cloning_epoch(
            state.clone,
            problem.features.pairs(free_rollouts.rows_compared(problem) - 1),
            state.key,
            learning_rate=self.learning_rate,
            batch=self.cloning_batch,
            updates=self.cloning_updates,
            epochs=self.cloning_epochs,
        )
        return replace(state, clone=clone, key=key), epoch

    def _simulate(self, problem: CalibrationProblem, state: NpeState) -> tuple[NpeState, Epoch]:
        """Rows under draws from the box; after a round of them the posterior, once the emulator is trained."""
        of_draws, of_actions, of_restarts, of_posterior, key = jax.random.split(state.key, 5)
        uniform = np.asarray(jax.random.uniform(of_draws, (self.draws, len(state.low))), np.float64)
        points = state.low + (state.high - state.low) * uniform
        rollout, walkers = free_rollouts.roll_freely(
            problem,
            state.clone.policy,
            points,
            state.walkers,
            steps=self.horizon,
            noise=free_rollouts.noise_deviation(problem, self.sensor_noise, free_rollouts.rows_compared(problem)),
            keys=(of_actions, of_restarts),
        )
        state = self._collect(problem, state, rollout, points)
        state = replace(state, walkers=walkers, key=key, failures=state.failures + rollout.failures)
        if state.collected == self.epochs and state.trained:
            state = self._infer(problem, state, of_posterior)
        belief, width = state.belief, float((state.high - state.low).mean() / 2.0)
        metrics = {"width": width, "misfit": belief.misfit / max(belief.usual_misfit, 1e-9)}
        return state, Epoch(metrics, control_steps=rollout.valid.size)

    def _collect(
        self, problem: CalibrationProblem, state: NpeState, rollout: Rollout, points: Float[np.ndarray, "draws d"]
    ) -> NpeState:
        """The state with one more epoch's moments, computed before its rows join those of the emulator.

        Raises:
            MadocError: No window has been whole so far.
        """
        scaling, _ = problem.features.windows("standardised", free_rollouts.rows_compared(problem))
        window, following, valid = free_rollouts.windows_of(rollout, scaling)
        sets, place = state.sets, slice(state.collected * self.draws, (state.collected + 1) * self.draws)
        if state.trained:
            fresh = moments.set_moments(
                problem,
                state.emulator,
                state.features,
                *(moments.by_halves(part) for part in (window, following, valid)),
            )
            sets = jax.tree.map(lambda old, new: _written(old, place, new), sets, fresh)
        scaled = np.broadcast_to(points[:, None], (*valid.shape, points.shape[1]))
        columns = {"window": window, "following": following, "scaled": scaled}
        rows = replay.add(
            state.rows, {name: replay.flatten_rows(part, 3) for name, part in columns.items()}, valid.reshape(-1)
        )
        free_rollouts.require_rows(rows, "npe", scaling.length)
        written = _written(state.points, place, points)
        return replace(state, rows=rows, sets=sets, points=written, collected=state.collected + 1)

    def _infer(self, problem: CalibrationProblem, state: NpeState, key: PRNGKeyArray) -> NpeState:
        """The posterior of this round's draws, and the box to draw from next."""
        whole = np.flatnonzero(state.sets.rows.min(1) > 0)
        if len(whole) < 2:
            return state
        whole = np.resize(whole, len(state.points))  # JAX compiles anew for each number of draws
        middle, half = (np.asarray(part, np.float64) for part in (state.emulator.middle, state.emulator.half))
        samples, misfit, usual_misfit = posterior.posterior_samples(
            jax.tree.map(lambda part: part[whole], state.sets),
            ((state.points - middle) / half)[whole],
            moments.logged_moments(problem, state.emulator, state.features),
            key,
            layers=self.flow_layers,
            width=self.flow_width,
            updates=self.flow_updates,
            learning_rate=self.learning_rate,
            count=self.samples,
        )
        samples = np.clip(middle + half * samples, -1.0, 1.0)
        low, high = posterior.truncated_box(samples, self.widening, self.smallest_half)
        belief = posterior.belief_of(samples, misfit, usual_misfit, state.belief.rounds + 1)
        return replace(state, belief=belief, low=low, high=high)

    def _fit(self, problem: CalibrationProblem, state: NpeState) -> tuple[NpeState, Epoch]:
        """One epoch of training the emulator; before a round's first it moves to the box that is drawn from next."""
        of_batches, key = jax.random.split(state.key)
        emulator, optimiser = state.emulator, state.optimiser
        if not state.fitted:
            emulator = emulator if state.trained else moments.standardised(emulator, state.rows)
            emulator = moments.moved(emulator, (state.high + state.low) / 2.0, (state.high - state.low) / 2.0)
            optimiser = self._optimiser(emulator)
        emulator, optimiser, loss = moments.train(
            emulator,
            optimiser,
            state.rows,
            of_batches,
            learning_rate=self.learning_rate,
            updates=self.updates,
            horizon=self._horizon,
            batch=self.batch,
        )
        fitted = (state.fitted + 1) % self.fitting_epochs
        collected = state.collected if fitted else 0
        state = replace(
            state, emulator=emulator, optimiser=optimiser, trained=1, fitted=fitted, collected=collected, key=key
        )
        return state, Epoch({"emulation_loss": float(loss)}, stage="fitting")


def _written(old: Float[np.ndarray, "draws *"], place: slice, new: Float[np.ndarray, "some *"]) -> np.ndarray:
    """A copy with other values in a place."""
    changed = old.copy()
    changed[place] = new
    return changed
