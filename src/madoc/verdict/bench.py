"""What estimates of one problem are judged on: the training rows, the hold-out, and ways to replay the latter."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from sklearn.neighbors import NearestNeighbors

from madoc import simulation
from madoc.calibration import CalibrationProblem
from madoc.calibration.holdout import AgainstChance, Area, Judged
from madoc.data import Dataset, stride
from madoc.diagnosis.channels import signal_names
from madoc.diagnosis.exchanged_columns import exchanged_columns
from madoc.errors import MadocError
from madoc.identification.candidate_terms import INTEGRATION
from madoc.identification.coarseness import FINER, coarseness
from madoc.identification.excitation import expected_half_widths
from madoc.identification.fitted_windows import STRIDES, WINDOWS
from madoc.identification.missing_terms import OTHER_WINDOWS, Suspicions, suspicions
from madoc.identification.states import LoggedStates, logged_states
from madoc.identification.term_tests import FEWEST
from madoc.identification.windows import consecutive_rows, evenly, horizons
from madoc.learning.features import Scaling
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.parameters import ParameterSpace
from madoc.simulation.base import Simulator
from madoc.types import named_key
from madoc.verdict.adequacy import NUMERICAL, actions_in_time, felt, in_full, is_certain, widening
from madoc.verdict.fitted_starts import MOST as MOST_FITTED
from madoc.verdict.fitted_starts import FittedReplays, fitted_replays_of, replay_steps
from madoc.verdict.prediction import MOST_WINDOWS, Replays, replays_of
from madoc.verdict.statistics import NEGLIGIBLE, better_than_chance
from madoc.verdict.two_sample import WindowView, behaviour, classify, rolled

_MOST_TERMS = 5
"""Number of missing terms that a report keeps, the most significant ones; besides them the integration step's and all
that are certain are kept, as a verdict rests on them."""
FEWEST_HELD = 10
"""Smallest number of rows held out, at least 1. With fewer, even perfect predictions could be chance."""
_NEIGHBOURS = 5000
"""Largest number of training rows among which the nearest neighbour of a row held out is searched."""
COLUMNS, COLUMNS_OF_A_VALUE = 60, 20
"""Simulations of a window that testing a model takes about, and how many more for each parameter and each degree of
freedom."""
EXCHANGED = "exchanged columns"
"""A part of judging without which nothing is tested."""
FITTING = 0.4
"""Share in (0, 1) of the time left that fitting the starts of windows of the hold-out may take."""
FEWEST_FITTED = 10
"""Smallest number of such windows, however little time is left."""
TESTING = 0.7
"""Share in (0, 1) of the time left that testing what the model lacks may take."""
_LONGEST_ROLLOUT = 1000
"""Largest length of a rollout in control steps, also where the episodes of the log are longer."""

Measure = TypeVar("Measure", bound=Judged)


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
        """Windows of the hold-out to replay from logged states, where states can be rebuilt."""
        return replays_of(self.held_out, self.simulator, self.change, horizons(self.problem.dataset))

    @cached_property
    def fitted(self) -> FittedReplays | None:
        """Windows of the hold-out whose initial states are to be fitted; None where they cannot be."""
        if self.states.kind == "unknown" or self.held_out.disturbance.shuffled != "none":
            return None
        moving, space = stride(self.problem.dataset), self.simulator.parameters
        most = self.windows_in_time(replay_steps(self.states, moving, len(space)), FITTING, MOST_FITTED)
        return fitted_replays_of(self.held_out, self.simulator, self.change, moving, most=most)

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
        return classify(self.view.sample(held), self.view.sample(simulated), overlap=True)


def _doubts(
    bench: Bench, point: Float[np.ndarray, " d"], half_widths: Float[np.ndarray, " d"]
) -> tuple[Suspicions, bool]:
    """What the log says against the model, and whether that was tested with a finer integration step.

    Where the error of the integration step explains much, it hides other terms or looks like them. These are then
    tested with steps of a quarter of the length, unless their error explains much there too. A log that tells neither
    states nor what is needed to fit them cannot be tested, nor can one without pairs of consecutive observations. Under
    a limit of time windows are as many as that allows.
    """
    problem, task = bench.problem, bench.problem.simulator.task
    ordered = bool((problem.dataset.episode_ends - problem.dataset.episode_starts > 1).any())
    told = bench.states_known or (bench.states.kind == "approximate" and ordered)
    if not told or problem.dataset.disturbance.shuffled == "next_observations":
        return Suspicions(tested=False), False
    given, most = (problem.dataset, bench.states), None
    if bench.until is not None:
        window = STRIDES * stride(problem.dataset) * (COLUMNS + COLUMNS_OF_A_VALUE * (len(point) + task.model.nv))
        most = int(TESTING * bench.rate * bench.seconds_left / window)
    enough = most is None or most >= 2 * (FEWEST + len(point))
    if not bench.begins("tests of what the model lacks", 0.0 if enough else np.inf):
        return Suspicions(tested=False), False
    if most is not None and most < WINDOWS:
        bench.left_out.append("tests on as many windows as usual")
    doubts = suspicions(*given, problem.simulator, point, half_widths, bench.change, most=most)
    doubts = replace(doubts, alternatives=in_full(doubts.alternatives, doubts.terms))
    step = felt(doubts.terms)
    if step is None or task.source is None:
        return doubts, False
    if not bench.begins("the same tests with a finer timestep", FINER * doubts.control_steps / bench.rate):
        return doubts, False
    finer = simulation.make(task.with_time_step(1.0 / FINER, substeps=FINER))
    fine = suspicions(*given, finer, point, half_widths, bench.change, of_other_model=True, most=most)
    spent = doubts.control_steps + FINER * fine.control_steps
    left = felt(fine.terms)
    if not fine.tested or (left is not None and left.explained >= NUMERICAL):
        return replace(doubts, control_steps=spent), False
    others = [replace(each, terms=False) for each in doubts.alternatives]
    others += [
        replace(each, causes=(INTEGRATION,)) if each.causes == (OTHER_WINDOWS,) else each for each in fine.alternatives
    ]
    terms = step, *(term for term in fine.terms if term.cause != INTEGRATION)
    return replace(fine, terms=terms, alternatives=tuple(others), control_steps=spent), True


def judged(
    record: Callable[..., Measure],
    bench: Bench,
    point: Float[np.ndarray, " d"],
    interval: Float[np.ndarray, "d 2"] | None,
    *,
    at: Float[np.ndarray, " d"],
    residual: Float[np.ndarray, " channels"],
    by_model: tuple[AgainstChance, ...],
    noise: Float[np.ndarray, " channels"],
    control_steps: int,
    exact: bool = False,
) -> Measure:
    """Complete a measure's record by the fields that all measures have.

    The best possible intervals are computed for parameters `at`, as if `residual` were the standard deviation of noise:
    of a single step from a logged state where states are `exact`, else of a reading. That and the sensors' `noise` are
    in typical changes of a stride.
    """
    space, problem = bench.simulator.parameters, bench.problem
    best, of_widths = _best_half_widths(bench, at, residual, noise if exact and noise.any() else None, exact=exact)
    own = best
    if interval is not None:  # to the farther end, as the other may be cut off at an end of the range
        own = np.maximum(np.abs(space.to_unit(interval.T) - point).max(0), 1e-9)
    doubts, finer = _doubts(bench, point, own)
    contradictions, of_columns = _contradictions(bench, point, at, doubts)
    coarse, of_steps = 0.0, 0
    if bench.simulator.task.source is not None and bench.begins("the length of the timestep"):
        coarse, of_steps = coarseness(problem.dataset, bench.states, problem.simulator, point, bench.change)
    ends = point[:, None] + np.outer(own, (-1.0, 1.0)) if interval is None else space.to_unit(interval.T).T
    shares = _shares(space, point[:, None] + np.outer(best, (-1.0, 1.0)), ends, own, doubts)
    signals = signal_names(bench.simulator.task)[: len(noise)]
    return record(
        split=bench.split,
        rows=len(bench.held_out),
        episodes=len(bench.held_out.episode_starts),
        estimate=dict(zip(space.names, point.tolist(), strict=True)),
        interval_shares=dict(zip(space.names, shares.tolist(), strict=True)),
        against_chance=(*by_model, *bench.model_free),
        noise=dict(zip(signals, (noise * bench.change[: len(noise)]).tolist(), strict=True)),
        control_steps=control_steps + of_widths + of_columns + of_steps + doubts.control_steps,
        missing_terms=tuple(
            term
            for place, term in enumerate(doubts.terms)
            if place < _MOST_TERMS or term.cause == INTEGRATION or is_certain(term)
        ),
        alternatives=doubts.alternatives,
        imitated=doubts.imitated,
        tested=doubts.tested and EXCHANGED not in bench.left_out,
        contradictions=contradictions,
        coarseness=coarse,
        finer=finer,
        at_end=space.at_end(point),
        base_from_contacts=bool(bench.states.placed.any()),
    )


def _best_half_widths(
    bench: Bench,
    at: Float[np.ndarray, " d"],
    residual: Float[np.ndarray, " channels"],
    sensors: Float[np.ndarray, " channels"] | None,
    *,
    exact: bool,
) -> tuple[Float[np.ndarray, " d"], int]:
    """Half of the narrowest 95 % intervals that the log allows, in [-1, 1], and the control steps simulated.

    Where states are exact but for the noise of `sensors`, windows with fitted initial states may tell more than single
    noisy steps do.
    """
    given = bench.problem.states, bench.problem.dataset, bench.problem.simulator, at
    residual = np.maximum(residual, NEGLIGIBLE) * bench.change[: len(residual)]
    half, spent = expected_half_widths(*given, residual, exact=exact)
    if sensors is None:
        return half, spent
    fitted, more = expected_half_widths(*given, np.maximum(sensors, NEGLIGIBLE) * bench.change, exact=False)
    return np.minimum(half, fitted), spent + more


def _contradictions(
    bench: Bench, point: Float[np.ndarray, " d"], at: Float[np.ndarray, " d"], doubts: Suspicions
) -> tuple[tuple[str, ...], int]:
    """Findings of the log that contradict the spec, in a sentence each, and the control steps simulated.

    Actions that seem late are none where tests at the estimate exclude it.
    """
    simulator, dataset = bench.simulator, bench.problem.dataset
    found, spent = dataset.findings, 0
    possible = simulator.task.state_from_observation is not None and bench.held_out.disturbance.shuffled == "none"
    if possible and bench.begins(EXCHANGED):
        points = np.stack([np.zeros(len(point)), point, at])
        exchanged, spent = exchanged_columns(
            bench.held_out, simulator, points, horizons(dataset)[1], bench.change, contradicts=True
        )
        found = (*exchanged, *found)
    in_time = actions_in_time(doubts.terms, simulator.control_step)
    return tuple(each.sentence for each in found if each.contradicts and not (each.late and in_time)), spent


def _shares(
    space: ParameterSpace,
    best: Float[np.ndarray, "d 2"],
    ends: Float[np.ndarray, "d 2"],
    half_widths: Float[np.ndarray, " d"],
    doubts: Suspicions,
) -> Float[np.ndarray, " d"]:
    """Shares in [0, 1] of each range that intervals cover: the best possible, or the given ones widened, if wider.

    Another estimate of other windows says that the search is not at its end, not that a parameter is open.
    """
    open_by = tuple(each for each in doubts.alternatives if each.causes != (OTHER_WINDOWS,))
    ends = ends + half_widths[:, None] * widening(open_by, space.names) * (-1.0, 1.0)
    return np.maximum(*(np.ptp(np.clip(each, -1.0, 1.0), axis=1) / 2.0 for each in (best, ends)))
