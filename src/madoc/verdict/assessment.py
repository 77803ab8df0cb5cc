"""An estimate on rows that no method has seen: all numbers that a verdict is made of."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from madoc.identification import noise as sensors
from madoc.identification.states import logged_states
from madoc.verdict.bench import Bench, signal_names
from madoc.verdict.fitted_starts import FITTED, FittedReplays
from madoc.verdict.identifiability import half_widths, open_shares
from madoc.verdict.prediction import Replays, nearby_best
from madoc.verdict.statistics import better_than_chance, interval_of, resampled
from madoc.verdict.systematic import autocorrelation, explained
from madoc.verdict.two_sample import Told, replayed, tell_apart

NEGLIGIBLE = 1e-3
"""Of a step's typical change. No sensor is as good, and no use of a model notices."""
_ROUNDING = 1e-6
"""Of a step's change: what MuJoCo's solver leaves at contacts is smaller."""


@dataclass(frozen=True)
class Assessment:
    """What the hold-out says of an estimate.

    Attributes:
        measure: `prediction` or `two-sample`.
        names: Of the parameters.
        unit: The estimate in [-1, 1].
        relative: Prediction error over that of mid-range, mean over horizons, and its 95 % interval; or the areas
            under the curve of the classifier, less ½.
        relative_interval: The same.
        best: The smallest such number anywhere near; that of noise alone, if that is larger.
        errors: Mean |residual| at each horizon, in steps' changes: of `mid-range`, `estimate`, `nearby best`, `noise`.
        explained: Share of the nearby best's residuals that state and action say.
        autocorrelation: Of the nearby best's residuals.
        shares: Of each range that its 95 % interval covers.
        skill: How much better than chance next observations are predicted, and ...
        chance: ... how often chance does as well.
        areas: Under the classifier's curve: of mid-range and the estimate.
        report: All of it as JSON, more besides.
        control_steps: Simulated for it.
    """

    measure: str
    names: tuple[str, ...]
    unit: Float[np.ndarray, " d"]
    relative: float
    relative_interval: tuple[float, float]
    best: float
    errors: dict[str, dict[int, float]]
    explained: float
    autocorrelation: float
    shares: Float[np.ndarray, " d"]
    skill: float
    chance: float
    areas: dict[str, Told]
    report: dict[str, Any]
    control_steps: int

    @property
    def score(self) -> float:
        """What estimates of one problem are compared by; less is better."""
        return self.relative


def sensor_noise(bench: Bench) -> Float[np.ndarray, " observation"]:
    """Deviation of the sensors' noise in their units, without an estimate.

    Where states can be rebuilt, it is that of the best parameters near mid-range.
    """
    if not bench.rebuilds:
        return sensors.difference_noise(bench.split.kept)
    middle = np.zeros((1, len(bench.simulator.parameters)))
    points = np.concatenate([middle, nearby_best(bench.replays, middle[0])[0]])
    sizes = bench.replays.magnitudes(bench.replays.residuals(points)).mean((0, -1))
    best = points[int(np.argmin(_over_first(sizes)))]
    return _what_is_left(bench, best).deviation * bench.scaling.next_scale


def assess(bench: Bench, mean: Float[np.ndarray, " d"], interval: Float[np.ndarray, "d 2"] | None = None) -> Assessment:
    """Judge an estimate in physical units by the hold-out.

    Raises:
        MadocError: No state of the hold-out can be rebuilt though the robot's observations determine it.
    """
    unit = np.clip(bench.simulator.parameters.to_unit(mean), -1.0, 1.0)
    if bench.rebuilds:
        return _by_prediction(bench, unit, interval)
    return _by_rows(bench, unit, interval) if bench.fitted is None else _by_fit(bench, bench.fitted, unit, interval)


def _by_prediction(bench: Bench, unit: np.ndarray, interval: np.ndarray | None) -> Assessment:
    replays, simulator, scale = bench.replays, bench.simulator, bench.scaling.next_scale
    nearby, spent = nearby_best(replays, unit)
    points = np.concatenate([np.zeros((1, len(unit))), unit[None], nearby])
    residuals = replays.residuals(points)
    size = replays.magnitudes(residuals)
    means, draws = size.mean((0, -1)), resampled(size.mean(-1), replays.episodes)
    relative = _over_first(means)
    best = 1 + int(np.argmin(relative[1:]))
    left = _what_is_left(bench, points[best])
    noisy = replays.noise_floor(bench.split.held, points[best], left.deviation)
    floor = replays.magnitudes(noisy)[:, 0]
    noise_alone = _over_first(np.stack([means[0], floor.mean((0, -1))]))[1]
    half, probing = half_widths(bench.problem, points[best], np.maximum(left.size, NEGLIGIBLE))
    named = {"mid-range": size[:, 0], "estimate": size[:, 1], "nearby best": size[:, best], "noise": floor}
    low, high = interval_of(_over_first(draws)[:, 1])
    space, signals = simulator.parameters, signal_names(simulator.task)
    return _assembled(
        bench,
        unit,
        relative=(float(relative[1]), (float(low), float(high))),
        best=float(max(relative[best], min(relative[1], noise_alone))),
        errors={
            name: dict(zip(replays.horizons, kind.mean((0, -1)).tolist(), strict=True)) for name, kind in named.items()
        },
        explained_share=max(left.explained, _said_of_the_end(bench, residuals[best])),
        correlation=left.autocorrelation,
        shares=open_shares(half, interval, space.high - space.low),
        follows={
            "the simulator at mid-range": bench.follows(_simulated(bench, points[0])),
            "the simulator at the best parameters nearby": bench.follows(_simulated(bench, points[best])),
            **bench.model_free,
        },
        areas={
            name: tell_apart(*replayed(replays, bench.scaling, part, noisy[0]), overlap=False)
            for name, part in (("mid-range", residuals[0]), ("estimate", residuals[1]))
        },
        more={
            "horizons": list(replays.horizons),
            "windows": len(replays.windows),
            "failed_windows": int((~np.isfinite(residuals[1]).all((1, 2))).sum()),
            "prediction": {name: _by_horizon(kind, replays, signals) for name, kind in named.items()},
            "noise": dict(zip(signals, (left.deviation * scale).tolist(), strict=True)),
        },
        spent=spent + residuals[..., 0].size + noisy[..., 0].size * 2 + left.control_steps + probing,
    )


@dataclass(frozen=True)
class _Left:
    """What single steps leave over, in steps' changes: how large, and whether it is noise."""

    size: Float[np.ndarray, " observation"]
    explained: float
    autocorrelation: float
    deviation: Float[np.ndarray, " observation"]
    control_steps: int


def _said_of_the_end(bench: Bench, residuals: Float[np.ndarray, "windows steps observation"]) -> float:
    """The share of residuals after the longest horizon that start and actions say: small errors add up there."""
    replays = bench.replays
    done = np.isfinite(residuals[:, -1]).all(-1)
    end = sensors.clipped(residuals[done, -1])
    if not done.any() or np.sqrt((end**2).mean(0)).max() <= _ROUNDING:
        return 0.0
    actions = replays.windows.actions.reshape(len(done), -1)
    return explained(np.concatenate([replays.observation, actions], axis=1)[done], end)[0]


def _what_is_left(bench: Bench, unit: np.ndarray) -> _Left:
    held, rows, scale = bench.split.held, bench.judged_rows, bench.scaling.next_scale
    followed = np.asarray(held.transitions.next_observation)[rows]
    single = sensors.clipped((_simulated(bench, unit) - followed) / scale)
    first = np.flatnonzero((np.diff(rows) == 1) & ~np.isin(rows[1:], held.episode_starts))
    size = np.sqrt((single**2).mean(0))
    share, said = 0.0, np.zeros_like(single)
    if size.max() > _ROUNDING:
        share, said = explained(bench.scaling.features(held.transitions.take(rows))[0], single)
    deviation, spent = np.zeros(len(scale)), len(rows)
    if len(first):
        slopes = sensors.own_slopes(bench.simulator, held, unit, rows[first], scale)
        deviation = sensors.consecutive_noise((single - said)[first], (single - said)[first + 1], slopes)
        spent += len(first) * (1 + len(scale))
    return _Left(size, share, autocorrelation(single[first], single[first + 1]), deviation, spent)


def _by_fit(bench: Bench, replays: FittedReplays, unit: np.ndarray, interval: np.ndarray | None) -> Assessment:
    """Where velocities are hidden: starts fitted to one stretch under each estimate, the next stretch predicted."""
    simulator, space = bench.simulator, bench.simulator.parameters
    points = np.stack([np.zeros(len(unit)), unit])
    residuals = replays.residuals(points, replays.starts(points))
    size = replays.magnitudes(residuals)
    deviation = replays.deviation(residuals[1])
    alone = replays.with_noise_alone(unit, residuals[1], deviation, jax.random.fold_in(bench.key, 2))
    floor = replays.magnitudes(alone)[:, 0]
    low, high = interval_of(_over_first(resampled(size.mean(-1), replays.episodes))[:, 1])
    relative = float(_over_first(size.mean((0, -1)))[1])
    half, probing = half_widths(bench.problem, unit, np.maximum(deviation, NEGLIGIBLE))
    named = {"mid-range": size[:, 0], "estimate": size[:, 1], "nearby best": size[:, 1], "noise": floor}
    signals = signal_names(simulator.task)
    return _assembled(
        bench,
        unit,
        relative=(relative, (float(low), float(high))),
        best=relative,
        errors={
            name: dict(zip(replays.horizons, kind.mean((0, -1)).tolist(), strict=True)) for name, kind in named.items()
        },
        explained_share=_said_of_the_last(replays, residuals[1]),
        correlation=0.0,
        shares=open_shares(half, interval, space.high - space.low),
        follows={"the simulator at the estimate": _follows_behind(replays, residuals[1]), **bench.model_free},
        areas={},
        more={
            "horizons": list(replays.horizons),
            "windows": len(replays.readings),
            "fitted_steps": FITTED,
            "failed_windows": int((~np.isfinite(residuals[1]).all((1, 2))).sum()),
            "prediction": {name: _by_horizon(kind, replays, signals) for name, kind in named.items()},
            "noise": dict(zip(signals, (deviation * bench.scaling.next_scale).tolist(), strict=True)),
        },
        spent=3 * replays.fit_cost + residuals[:, :, 1:, 0].size + alone[:, :, 1:, 0].size + probing,
    )


def _said_of_the_last(replays: FittedReplays, residuals: Float[np.ndarray, "windows readings channels"]) -> float:
    """The share of the last residuals that readings of the start and actions say."""
    done = np.isfinite(residuals).all((1, 2))
    last = sensors.clipped(residuals[done, -1])
    if not done.any() or np.sqrt((last**2).mean(0)).max() <= _ROUNDING:
        return 0.0
    readings = replays.readings
    known = [readings.observed[:, 0], readings.observed[:, 1], readings.actions.reshape(len(done), -1)]
    return explained(np.concatenate(known, axis=1)[done], last)[0]


def _follows_behind(
    replays: FittedReplays, residuals: Float[np.ndarray, "windows readings channels"]
) -> dict[str, float]:
    """How far the readings right behind the fitted stretch are predicted better than chance would."""
    observed, scale = replays.readings.observed, replays.readings.scale
    spread = np.maximum(observed.std((0, 1)), 1e-8)
    followed = observed[:, FITTED + 1]
    ahead = residuals[:, FITTED + 1]
    guess = np.where(np.isfinite(ahead), followed + ahead * scale, observed[:, FITTED])
    return better_than_chance(guess / spread, followed / spread, replays.episodes)


def _by_rows(bench: Bench, unit: np.ndarray, interval: np.ndarray | None) -> Assessment:
    """Where no state can be rebuilt: rows of rollouts under a clone against rows of the log."""
    scale = bench.scaling.next_scale
    deviation = sensors.difference_noise(bench.split.kept)
    areas = {"mid-range": bench.middle_apart, "estimate": bench.rolled_apart(unit)}
    half, probing = half_widths(bench.problem, unit, np.maximum(deviation / scale, NEGLIGIBLE))
    space = bench.simulator.parameters
    told = areas["estimate"]
    return _assembled(
        bench,
        unit,
        relative=(told.area - 0.5, (told.low - 0.5, told.high - 0.5)),
        best=0.0,
        errors={},
        explained_share=0.0,
        correlation=0.0,
        shares=open_shares(half, interval, space.high - space.low),
        follows=bench.model_free,
        areas=areas,
        more={"noise": dict(zip(signal_names(bench.simulator.task), deviation.tolist(), strict=True))},
        spent=probing,
    )


def _assembled(
    bench: Bench,
    unit: np.ndarray,
    *,
    relative: tuple[float, tuple[float, float]],
    best: float,
    errors: dict[str, dict[int, float]],
    explained_share: float,
    correlation: float,
    shares: np.ndarray,
    follows: dict[str, dict[str, float]],
    areas: dict[str, Told],
    more: dict[str, Any],
    spent: int,
) -> Assessment:
    """The numbers, and the same as JSON."""
    clearest = min(follows, key=lambda name: (follows[name]["p"], -follows[name]["skill"]))
    names = bench.simulator.parameters.names
    report = {
        "split": bench.split.sentence,
        "rows": len(bench.split.held),
        "episodes": len(bench.split.held.episode_starts),
        "measure": bench.measure,
        "relative": relative[0],
        "relative_interval": list(relative[1]),
        "nearby_best": best,
        **more,
        "residuals": {"explained": explained_share, "autocorrelation": correlation},
        "interval_share_of_range": dict(zip(names, shares.tolist(), strict=True)),
        "follows": {"clearest": clearest, **follows},
        "two_sample": {name: {"area": told.area, "interval": [told.low, told.high]} for name, told in areas.items()},
        "control_steps": spent,
    }
    return Assessment(
        measure=bench.measure,
        names=names,
        unit=unit,
        relative=relative[0],
        relative_interval=relative[1],
        best=best,
        errors=errors,
        explained=explained_share,
        autocorrelation=correlation,
        shares=shares,
        skill=follows[clearest]["skill"],
        chance=follows[clearest]["p"] * len(follows),
        areas=areas,
        report=report,
        control_steps=spent,
    )


def _over_first(errors: Float[np.ndarray, "*draws points horizons"]) -> Float[np.ndarray, "*draws points"]:
    """Each point's error over the first's, mean over horizons; 1 where the first's is negligible."""
    first = errors[..., :1, :]
    nothing = first <= NEGLIGIBLE
    return np.asarray(
        np.where(nothing, np.maximum(1.0, errors / NEGLIGIBLE), errors / np.where(nothing, 1.0, first))
    ).mean(-1)


def _simulated(bench: Bench, unit: np.ndarray) -> Float[np.ndarray, "rows observation"]:
    """What the simulator makes of the judged rows."""
    held, simulator = bench.split.held, bench.simulator
    states, rows = logged_states(held, simulator.task)
    states = states[np.searchsorted(rows, bench.judged_rows)]
    system = simulator.bind(simulator.parameters.to_physical(unit)[None])
    action = np.asarray(held.transitions.action)[bench.judged_rows]
    return np.asarray(system.observe(system.step(system.unbiased(states[None]), action[None]))[0])


def _by_horizon(
    size: Float[np.ndarray, "windows horizons observation"], replays: Replays | FittedReplays, signals: tuple[str, ...]
) -> Any:
    """Mean errors of one point: at each horizon with its interval, and of each signal."""
    draws = resampled(size.mean(-1), replays.episodes)
    low, high = interval_of(draws)
    return [
        {
            "horizon": horizon,
            "error": float(size[:, index].mean()),
            "interval": [float(low[index]), float(high[index])],
            "by_signal": dict(zip(signals, size[:, index].mean(0).tolist(), strict=True)),
        }
        for index, horizon in enumerate(replays.horizons)
    ]
