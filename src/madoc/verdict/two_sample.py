"""A classifier two-sample test of logged against simulated rows (Lopez-Paz and Oquab 2017)."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import RidgeCV
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import StratifiedKFold, cross_val_predict
from threadpoolctl import threadpool_limits

from madoc.calibration.holdout import Area
from madoc.data import Dataset
from madoc.data.dataset import spread_of, starts_after
from madoc.identification.windows import evenly
from madoc.learning.cloning import continue_cloning, fresh_clone
from madoc.learning.features import LoggedFeatures, Scaling
from madoc.learning.tanh_gaussian import TanhGaussianPolicy
from madoc.simulation.base import Simulator
from madoc.simulation.rollout import begin, reset_states, roll
from madoc.types import Transitions
from madoc.verdict.statistics import interval_of

MOST_ROWS = 1000
"""Largest number of rows of either kind: with so many, the area under the curve has a standard error of 0.013."""
RESOLUTION = 0.1
"""Standard deviation of the noise put on changes of motion, in typical ones; 0 is none. Without it a classifier would
separate rows of parameters that differ by a millionth."""
_FITTED = 5000
"""Largest number of rows to which the linear prediction is fitted."""
FOLDS = 5
TREES, LEAVES, BINS = 40, 8, 32
"""Numbers of folds, trees, leaves of a tree and bins of a feature: few, as for some hundred rows."""
ODDS_LIMIT = 10.0
"""Largest weight of a row, and one over the smallest, at least 1; weights are clipped to them."""
CLONING = (20, 200, 256, 1e-3)
"""Number of epochs of cloning, updates in each, rows of an update, and Adam's learning rate."""
_RESAMPLES = 200
"""Number of bootstrap samples of the area."""


class Sample(NamedTuple):
    """Rows as features of a classifier: what came `before` a change, and the change `after` it."""

    before: Float[np.ndarray, "rows before"]
    after: Float[np.ndarray, "rows observation"]

    def thinned(self) -> "Sample":
        """At most `MOST_ROWS`, spread evenly."""
        chosen = evenly(np.arange(len(self.before)), MOST_ROWS)
        return Sample(self.before[chosen], self.after[chosen])


def classify(real: Sample, simulated: Sample) -> Area:
    """Cross-validated area under the ROC curve; 0.5 with an interval from 0 to 1 where there are too few rows.

    The two kinds may be distributed differently before the change. Simulated rows are weighted by a second classifier's
    odds that `before` is of the log, so that only changes are compared.
    """
    samples = real.thinned(), simulated.thinned()
    rows = [len(sample.before) for sample in samples]
    if not rows[1]:
        return Area(1.0, (1.0, 1.0), rows[0])  # every simulation failed
    if min(rows) < FOLDS:
        return Area(0.5, (0.0, 1.0), sum(rows))
    label = np.repeat([True, False], rows)
    before, after = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    likely = np.clip(_unseen(before, label, None), 0.01, 0.99)
    odds = np.clip(likely / (1.0 - likely), 1.0 / ODDS_LIMIT, ODDS_LIMIT)
    weight = np.where(label, 1.0, odds / odds[~label].mean())
    scores = _unseen(np.concatenate([before, after], axis=1), label, weight)
    area = float(roc_auc_score(label, scores, sample_weight=weight))
    return Area(area, _interval(scores, label, weight), sum(rows))


def behaviour(kept: Dataset, key: PRNGKeyArray) -> TanhGaussianPolicy:
    """A clone of the policy that acted in the log, to act in the simulator where states cannot be rebuilt."""
    epochs, updates, batch, rate = CLONING
    of_policy, of_batches = jax.random.split(key)
    pairs = LoggedFeatures(kept).pairs()
    clone = fresh_clone(pairs, (64, 64), learning_rate=rate, key=of_policy)
    for epoch in range(epochs):
        of_epoch = jax.random.fold_in(of_batches, epoch)
        clone, _ = continue_cloning(clone, pairs, of_epoch, learning_rate=rate, batch=batch, updates=updates)
    return clone.policy


def rolled(
    policy: TanhGaussianPolicy,
    simulator: Simulator,
    parameters: Float[np.ndarray, " d"],
    *,
    length: int,
    key: PRNGKeyArray,
    noise: Float[np.ndarray, " observation"],
) -> Dataset:
    """Episodes of a cloned policy from the task's reset, with noise on the sensors."""
    task = simulator.task
    rows = max(1, -(-2 * MOST_ROWS // length))
    of_start, of_action, of_restart = jax.random.split(key, 3)
    starts = reset_states(simulator)
    rollout, _ = roll(
        simulator.bind(parameters[None]),
        task,
        policy,
        begin(starts, of_start, systems=1, rows=rows),
        steps=length,
        starts=starts,
        key=of_action,
        restart_key=of_restart,
    )
    flat, valid = jax.tree.map(
        lambda column: np.swapaxes(column[:, 0], 0, 1).reshape(-1, *column.shape[3:]),
        (rollout.transitions, rollout.valid),
    )
    ends = flat.terminated | flat.truncated
    ends[length - 1 :: length] = True
    ends[:-1] |= ~valid[1:]
    flat, ends = flat.take(valid), ends[valid]
    same = np.random.default_rng(0).standard_normal((len(flat) + 1, len(noise))) * noise
    noisy = Transitions(
        flat.observation + same[:-1],
        flat.action,
        flat.reward,
        flat.next_observation + same[1:],
        flat.terminated,
        ends & ~flat.terminated,
    )
    return Dataset(noisy, starts_after(ends), task.name, task.physics, "a clone in the simulator")


@dataclass(frozen=True)
class WindowView:
    """Features of rows for a classifier where one observation is not the state; fitted to the training rows.

    `before` holds observation and action of two consecutive rows, or of one where none are consecutive. `after` holds
    the change of motion over its `spread`, with noise of `RESOLUTION`, and its residual of a linear prediction from
    `before`, the `line`.
    """

    scaling: Scaling
    spread: Float[np.ndarray, " observation"]
    line: RidgeCV

    @classmethod
    def of(cls, kept: Dataset, scaling: Scaling) -> "WindowView":
        """Fit the features to a log."""
        before, after = _change_of_motion(kept, scaling)
        spread = spread_of(after)
        chosen = evenly(np.arange(len(before)), _FITTED)
        line = RidgeCV(np.logspace(-4, 2, 7)).fit(before[chosen], after[chosen] / spread)
        return cls(scaling, spread, line)

    def sample(self, dataset: Dataset) -> Sample:
        """The features of the rows of a dataset."""
        before, after = _change_of_motion(dataset, self.scaling)
        after = after / self.spread
        after = after + RESOLUTION * np.random.default_rng(len(after)).standard_normal(after.shape)
        residual = after - np.reshape(self.line.predict(before), after.shape)
        return Sample(before, np.concatenate([after, residual], axis=1))


def _change_of_motion(dataset: Dataset, scaling: Scaling) -> tuple[np.ndarray, np.ndarray]:
    """What came before each row's change of motion, and the change."""
    logged = dataset.transitions
    second = np.setdiff1d(np.arange(len(dataset)), dataset.episode_starts)
    rows = second if len(second) else np.arange(len(dataset))
    pair, moved = scaling.features(logged.take(rows))
    if not len(second):
        return pair.astype(np.float64), moved.astype(np.float64)
    earlier, moved_before = scaling.features(logged.take(second - 1))
    action = earlier[:, moved.shape[1] :]
    before = np.concatenate([pair, moved_before, action], axis=1).astype(np.float64)
    return before, moved.astype(np.float64) - moved_before


def _unseen(
    features: Float[np.ndarray, "rows features"],
    label: Bool[np.ndarray, " rows"],
    weight: Float[np.ndarray, " rows"] | None,
) -> Float[np.ndarray, " rows"]:
    """Probability that each row is a logged one, by a classifier that was not trained on it."""
    trees = HistGradientBoostingClassifier(
        max_iter=TREES, max_leaf_nodes=LEAVES, max_bins=BINS, early_stopping=False, random_state=0
    )
    folds = StratifiedKFold(FOLDS, shuffle=True, random_state=0)
    weights = None if weight is None else {"sample_weight": weight}
    with threadpool_limits(1):  # the same bits on any number of cores, and no threads that wait for each other
        chances = cross_val_predict(trees, features, label, cv=folds, params=weights, method="predict_proba")
    return np.asarray(chances)[:, 1]


def _interval(scores: np.ndarray, label: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """95 % bootstrap interval of the area, rows of each kind resampled.

    The area is the share of pairs whose row of the log has the higher score; ties count half (Hanley and McNeil 1982).
    """
    rng, order = np.random.default_rng(0), np.argsort(scores)
    label, weight = label[order], weight[order]
    ties = np.flatnonzero(np.diff(scores[order], prepend=-np.inf))
    totals = []
    for kind in (label, ~label):
        drawn = np.zeros((_RESAMPLES, len(label)))
        drawn[:, kind] = rng.multinomial(kind.sum(), np.full(kind.sum(), 1.0 / kind.sum()), _RESAMPLES)
        totals.append(np.add.reduceat(drawn * weight, ties, axis=1))
    positive, negative = totals
    below = np.cumsum(negative, axis=1) - negative / 2.0
    areas = (positive * below).sum(1) / (positive.sum(1) * negative.sum(1))
    low, high = interval_of(areas)
    return float(low), float(high)
