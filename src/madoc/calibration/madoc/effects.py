"""Groups of parameters that move the same signals, from derivatives of the simulator at states of the log."""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.madoc.grouping import by_first_appearance
from madoc.identification.linearisation import difference_points, linearise
from madoc.identification.replay import window_residuals
from madoc.identification.states import probing_windows
from madoc.identification.windows import Windows
from madoc.simulation.base import Simulator

STATES = 100
"""Logged states in each epoch of grouping."""
MOST = 8
"""Largest number of groups that is chosen; the paper's tasks have 4 to 6."""
RESAMPLINGS = 50
"""Number of resampled partitions behind a stability."""
NEGLIGIBLE = 1e-5
"""Effect, in typical changes of a signal over half a parameter's range, that is an error of the finite differences."""
UNRELATED = 1e-6
"""Smallest affinity, so that the graph of parameters stays connected."""

Moment = Float[np.ndarray, "d d"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SharedEffects:
    """What the parameters' effects have in common, in each epoch of grouping: a stretch of the log each, 0 if unseen.

    Epochs that come after the last logged state see none.
    """

    moments: Float[np.ndarray, "blocks d d"]

    def embeddings(self) -> Float[np.ndarray, "d d"]:
        """One vector for each parameter; inner products of the vectors are the affinities."""
        return embedding(self.moments.sum(0))

    def groups(self, *, count: int | None, seed: int) -> "Partition":
        """The groups by all stretches of the log that were seen."""
        seen = self.moments[self.moments.any((1, 2))]
        return partition(seen if len(seen) else self.moments, count=count, seed=seed)


@dataclass(frozen=True)
class Partition:
    """Group labels of parameters in order of first appearance, and how stable they are under resampling, at most 1."""

    labels: Int[np.ndarray, " d"]
    stability: float


def sensitivities(
    simulator: Simulator, windows: Windows, scale: Float[np.ndarray, " observation"]
) -> tuple[Float[np.ndarray, "windows values d"], int]:
    """∂ signal / ∂ parameter at mid-range, signals in multiples of `scale`, parameters in [-1, 1].

    Also the number of rows whose simulation failed; their windows are left out. It spends
    windows · (1 + 2 d) · steps control steps.
    """
    points = difference_points(np.zeros(len(simulator.parameters)))
    residuals = window_residuals(simulator, windows, points, scale)
    return linearise(points, residuals).jacobian, int((~np.isfinite(residuals).all(-1)).sum())


def see_more(effects: SharedEffects, problem: CalibrationProblem, epoch: int) -> tuple[SharedEffects, int, int]:
    """The effects of all parameters at `STATES` more states of the log; also control steps, and failed simulations."""
    epochs, count = effects.moments.shape[:2]
    every = probing_windows(problem.states, problem.dataset, problem.simulator, steps=1, count=epochs * STATES)
    seen = every.of(np.array_split(np.arange(len(every)), epochs)[epoch])
    if not len(seen):
        return effects, 0, 0
    jacobian, failures = sensitivities(problem.simulator, seen, problem.typical_change)
    moments = effects.moments.copy()
    moments[epoch] = shared_effects(jacobian)
    return replace(effects, moments=moments), len(seen) * (1 + 2 * count), failures


def shared_effects(jacobian: Float[np.ndarray, "windows values d"]) -> Moment:
    """Σ u uᵀ over windows and signals, with u = |J| / ‖J‖ of the signal's derivatives J by the parameters.

    Each signal of each state counts alike, as in a spatial sign covariance (Visuri et al. 2000): few states, such as
    those at impacts, would else decide. Derivatives count without their sign, which changes from state to state where
    parameters move the same signals.
    """
    size = np.linalg.norm(jacobian, axis=-1, keepdims=True)
    direction = np.abs(jacobian) / np.sqrt(size**2 + NEGLIGIBLE**2)
    return np.einsum("wvd,wve->de", direction, direction)


def affinity(moment: Moment) -> Moment:
    """The cosine M_ij / √(M_ii M_jj) of every pair of parameters, 1 on the diagonal."""
    deviation = np.sqrt(np.maximum(np.diag(moment), np.finfo(float).tiny))
    cosine = np.clip(moment / deviation[:, None] / deviation, UNRELATED, 1.0)
    np.fill_diagonal(cosine, 1.0)
    return cosine


def embedding(moment: Moment) -> Float[np.ndarray, "d d"]:
    """One vector for each parameter; inner products of the vectors are the affinities."""
    values, vectors = np.linalg.eigh(affinity(moment))
    return vectors[:, ::-1] * np.sqrt(np.maximum(values[::-1], 0.0))


def most_groups(parameters: int) -> int:
    """The largest number of groups that is chosen: groups have more than two parameters on average."""
    return max(1, min(MOST, (parameters - 1) // 2))


def partition(blocks: Float[np.ndarray, "blocks d d"], *, count: int | None = None, seed: int = 0) -> Partition:
    """Spectral clustering of the parameters by their affinity, from moments of consecutive stretches of the log.

    Without a `count` it is the most stable number of groups from 2 to `most_groups`, the largest of those as stable,
    or a single group if that is less than 2. The gap of the spectrum, by which the number is often chosen, mostly
    says one group.
    """
    most = most_groups(blocks.shape[-1])
    counts = [count] if count else list(range(2, most + 1)) or [1]
    found = [_with_stability(blocks, each, seed) for each in reversed(counts)]
    return max(found, key=lambda each: each.stability)


def _with_stability(blocks: Float[np.ndarray, "blocks d d"], count: int, seed: int) -> Partition:
    """The partition, and its mean adjusted Rand index with those of blocks drawn with repetition.

    Consecutive stretches are drawn, not rows: neighbouring rows are alike.
    """
    from sklearn.metrics import adjusted_rand_score  # slow to import, and only needed here

    labels, random = _clusters(blocks.sum(0), count), np.random.default_rng(seed)
    drawn = random.integers(0, len(blocks), (RESAMPLINGS, len(blocks)))
    agreement = [adjusted_rand_score(labels, _clusters(blocks[rows].sum(0), count)) for rows in drawn]
    return Partition(labels, float(np.mean(agreement)))


def _clusters(moment: Moment, count: int) -> Int[np.ndarray, " d"]:
    if count in (1, len(moment)):
        return np.arange(len(moment)) if count > 1 else np.zeros(len(moment), np.int64)
    from sklearn.cluster import SpectralClustering  # slow to import, and only needed here

    method = SpectralClustering(count, affinity="precomputed", assign_labels="cluster_qr", random_state=0)
    return by_first_appearance(method.fit_predict(affinity(moment)))
