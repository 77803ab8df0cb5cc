"""How late, how strongly and in which direction each joint's acceleration follows its action, from the log alone."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import orth
from scipy.signal import correlate

from madoc.data import Dataset
from madoc.data.findings import Finding
from madoc.diagnosis.channels import action_names
from madoc.identification.states import LoggedStates
from madoc.identification.windows import evenly
from madoc.simulation.base import Simulator
from madoc.simulation.response import DrivenJoint, driven_joints, responses

LONGEST = 0.3
"""s; a lag is looked for up to this."""
LATE = 0.25
"""Lag in control steps; a shorter one is not told."""
CERTAIN = 5.0
"""Standard errors by which a lag or a response has to differ from 0 before it is told."""
FAR = 3.0
"""Ratio of the logged response to the nearest that the model has; a ratio above this, or below its inverse, is told."""
_TAPS = 2
"""Number of rows on either side of the correlation's peak over which the response is resolved."""
_EARLIER = 2
"""Number of rows by which the state that stands for a row's own is earlier: the fewest that share no reading."""
_BLOCKS = 12
"""Number of parts of the log that are left out, one at a time, for standard errors."""
_FEWEST = 8
"""Number of rows for each coefficient of the regression; with fewer nothing is said."""
_EXPLAINED = 0.1
"""Share in [0, 1] of the acceleration's variance, beyond what the state explains, that an action has to explain."""
_FEW = 6
"""Number of joints up to which products of their speeds, as in centrifugal forces, are part of the state."""
_RIDGE = 1e-10
"""Smallest eigenvalue of the regression's products, relative to the rows: columns may be constant, or alike."""
_ROWS = 32
"""Number of logged rows at which the model's response is computed."""
_UNIT_ERRORS = {
    180.0 / np.pi: "degrees for radians",
    1000.0: "thousandths, as mm or mN·m, for the whole unit",
    100.0: "cm for m",
    30.0 / np.pi: "rpm for rad/s",
}
"""Mistakes of a unit by the ratio, or its inverse, of the logged response to the model's."""


@dataclass(frozen=True)
class Response:
    """The response of a joint's acceleration to its action, with standard errors from leaving out parts of the log.

    Two regressions estimate it: see `measured_responses`.

    Attributes:
        joint: The joint and its action.
        gain: Change of the joint's velocity in a control step over that of the action, in [-1, 1]: that of the two
            estimates which is nearer to 0, or 0 if their signs differ.
        larger_gain: The other estimate.
        gain_error: The larger standard error of the two.
        lag: Time from an action to the acceleration it causes, beyond that of a command held for a control step, s. Of
            two estimates as for the gain. It is 0 where the gain is 0, and where actions of different rows act in
            different directions, so that their mean is no delay.
        larger_lag: The other estimate, s.
        lag_error: The larger standard error of the two, s.
        share: Share in [0, 1] of the acceleration's variance, beyond what the state explains, that the action explains;
            the smaller one.
    """

    joint: DrivenJoint
    gain: float
    larger_gain: float
    gain_error: float
    lag: float
    larger_lag: float
    lag_error: float
    share: float

    @property
    def certain(self) -> bool:
        """Whether the joint answers its action at all."""
        return self.share > _EXPLAINED and abs(self.gain) > CERTAIN * self.gain_error


def response_findings(
    dataset: Dataset,
    simulator: Simulator,
    logged: LoggedStates,
    points: Float[np.ndarray, "points d"],
    *,
    late_speeds: bool = False,
) -> list[Finding]:
    """Findings on actions that come late, push the wrong way, or push far more or less than the model can.

    Directions and sizes of the model's responses are those at the `points`, in [-1, 1]. Where logged speeds are known
    to come late (`late_speeds`), actions seem to as well.
    """
    measured = tuple(one for one in measured_responses(dataset, simulator) if one.certain)
    if not measured:
        return []
    names = action_names(simulator.task)
    findings = []
    if not late_speeds:
        findings = [finding for one in measured for finding in _lag_findings(one, names[one.joint.action], simulator)]
    if not logged.starts_known:
        return findings
    chosen = evenly(np.arange(len(logged.rows)), _ROWS)
    actions = np.asarray(dataset.transitions.action, np.float64)[logged.rows[chosen]]
    joints = tuple(one.joint for one in measured)
    modelled = responses(simulator, logged.states[chosen], actions, points, joints)
    for one, gains in zip(measured, modelled.T, strict=True):
        findings += _gain_findings(one, names[one.joint.action], gains[np.isfinite(gains)])
    return findings


def _lag_findings(response: Response, action: str, simulator: Simulator) -> list[Finding]:
    """A warning where a lag is certain, and no calibrated delay can stand for it."""
    step, lag, error = simulator.control_step, response.lag, response.lag_error
    timed = [row for row in simulator.parameters.parameters if row.kind.of_all]
    delays = [row for row in timed if not row.elements or action in row.elements]
    covered = any(row.low <= max(lag, response.larger_lag) and lag <= row.high for row in delays)
    if lag < max(LATE * step, CERTAIN * error) or covered:
        return []
    what = (
        f"the acceleration of {response.joint.joint} follows it {lag:.3g} ± {2.0 * error:.1g} s late ({lag / step:.2g} "
        "rows)"
    )
    low, high = max(0.0, lag - 2.0 * step), lag + 2.0 * step
    own = f", element: {action}" if any(row.elements for row in timed) else ""
    remedy = f"{{field: action_delay{own}, low: {0.0 if low < step else low:.2g}, high: {high:.2g}}}"
    known = any(row.field == "action_delay" for row in delays)
    verb = "widen the range of the delay to" if known else "add the parameter"
    alike = "a limit of speed, a lag of the motor, a filter on the log or an elastic transmission"
    do = f"if it is a delay, {verb} {remedy}; {alike} would look alike"
    return [Finding("warning", what, action, do)]


def _gain_findings(response: Response, action: str, modelled: Float[np.ndarray, " points"]) -> list[Finding]:
    """A warning where the measured response has the other sign than the model's, or another order of magnitude."""
    if not len(modelled) or not (modelled.min() > 0.0 or modelled.max() < 0.0):
        return []
    measured, joint = response.gain, response.joint.joint
    if measured * modelled.sum() < 0:
        what = f"it accelerates {joint} the other way than in the model"
        return [
            Finding("warning", what, action, f"reverse its sign, or that of {joint}, in the spec or in the log", True)
        ]
    least, most = np.abs(modelled).min(), np.abs(modelled).max()
    size, larger = abs(measured), abs(response.larger_gain)
    told, bound = (size, most) if size > most else (larger, least)  # the estimate nearer to the model's, and that
    if not (size >= FAR * most or larger <= least / FAR):
        return []
    factors = ((each, text) for factor, text in _UNIT_ERRORS.items() for each in (factor, 1.0 / factor))
    mistake = next((text for each, text in factors if least / 1.5 < told / each < 1.5 * most), "")
    what = f"it accelerates {joint} {told / bound:.2g} times as much as anywhere in the ranges of the parameters"
    what += f": {mistake}?" if mistake else ""
    do = "look at the units of the spec and of the log, and at the ranges"
    return [Finding("warning", what, action, do, contradicts=True, rough=True)]


@dataclass(frozen=True)
class _Motion:
    """Rows of a log that have a row before them: what the robot did, and what can explain it.

    Attributes:
        rows: The rows, ascending.
        state: Constant, positions, velocities, and functions of them, one column each.
        change: Change of each joint's velocity in a control step, joint units per s.
        ahead: Time by which `change` is early, in control steps: half of one if positions were differentiated twice.
    """

    rows: Int[np.ndarray, " rows"]
    state: Float[np.ndarray, "rows features"]
    change: Float[np.ndarray, "rows joints"]
    ahead: Float[np.ndarray, " joints"]


def measured_responses(dataset: Dataset, simulator: Simulator) -> tuple[Response, ...]:
    """The response of every joint that has an action of its own and whose position or velocity is logged.

    The change of velocity is regressed on the state and on the action of some rows before. Which rows is found by the
    cross-correlation of the two, both cleared of what the state explains. Only actions at or before a row are taken, as
    those after it depend on the motion where a controller chose them.

    A noisy state leaves part of what earlier actions did to their own effect, and its noise is in the change too. So
    there is a second regression by instrumental variables (two-stage least squares): the state enters as predicted from
    the state two rows before, with whose noise it has none in common even where speeds are differences of the last two
    positions. Its lags come out too early where a controller computes actions from noisy readings, and wrong where
    contacts make the prediction poor. So only what both regressions tell counts.
    """
    driven = _motion(dataset, simulator)
    if driven is None:
        return ()
    joints, motion = driven
    action = np.asarray(dataset.transitions.action, np.float64)
    peaks = _peaks(motion, action[motion.rows][:, [joint.action for joint in joints]], simulator.control_step)
    windows = [np.arange(max(0, peak - _TAPS), peak + _TAPS + 1) for peak in peaks]
    age = motion.rows - dataset.episode_starts[dataset.episode_of(motion.rows)]
    kept = np.flatnonzero(age >= max(_EARLIER + 1, *(window[-1] for window in windows)))
    if len(kept) < _FEWEST * (motion.state.shape[1] + sum(len(window) for window in windows)):
        return ()
    products, scale = _products(motion, kept, action, windows, joints)
    ends = motion.state.shape[1] + np.cumsum([0, *map(len, windows)])
    owns = [np.arange(*each) for each in pairwise(ends)]
    regressions = [_regressed(products, scale, owns, rows=len(kept), staged=staged) for staged in (False, True)]
    found = []
    for at, (joint, own) in enumerate(zip(joints, owns, strict=True)):
        both = []
        for estimates, shares in regressions:
            taps = estimates[:, own, at]
            gains = taps.sum(-1)
            taken = np.full(len(gains), motion.ahead[at])
            taken = np.divide(taps @ windows[at], gains, out=taken, where=gains != 0.0)
            lags = simulator.control_step * (taken - motion.ahead[at])
            delayed = windows[at][0] <= taken[0] <= windows[at][-1]
            both.append((gains[0], _jackknife(gains), lags[0] * delayed, _jackknife(lags), shares[at]))
        gain, gain_error, lag, lag_error, share = zip(*both, strict=True)
        told = *_smaller_first(*gain), max(gain_error), *_smaller_first(*lag), max(lag_error), min(share)
        found.append(Response(joint, *map(float, told)))
    return tuple(found)


def _smaller_first(one: float, other: float) -> tuple[float, float]:
    """Two numbers, the one nearer to 0 first; 0 comes in its place if their signs differ."""
    near, far = sorted((one, other), key=abs)
    return (near if one * other > 0.0 else 0.0), far


def _motion(dataset: Dataset, simulator: Simulator) -> tuple[tuple[DrivenJoint, ...], _Motion] | None:
    """The joints that actions drive and whose motion is logged, and that motion; None of none."""
    task = simulator.task
    rows = np.setdiff1d(np.arange(len(dataset)), dataset.episode_starts)
    if task.posture is None or not len(rows):
        return None
    measured = task.observation_size - task.velocities  # the others were derived from positions
    logged = dataset.transitions
    now, then = (
        np.asarray(task.posture(np.asarray(part, np.float64)[:, :measured]))
        for part in (logged.observation, logged.next_observation)
    )
    before, now, then = now[rows - 1], now[rows], then[rows]
    seen = ~np.isnan(now).any(0)
    joints, changes, speeds, ahead = [], [], [], []
    for joint in driven_joints(simulator):
        position, velocity = joint.position, joint.velocity
        if seen[velocity]:
            change, speed = then[:, velocity] - now[:, velocity], now[:, velocity]
        elif seen[position]:
            speed = (now[:, position] - before[:, position]) / simulator.control_step
            change = (then[:, position] - now[:, position]) / simulator.control_step - speed
        else:
            continue
        joints.append(joint)
        changes.append(change)
        speeds.append(speed)
        ahead.append(0.0 if seen[velocity] else 0.5)
    if not joints:
        return None
    angles = [now[:, joint.position] for joint in joints if joint.hinge and seen[joint.position]]
    inertial = [one * other for at, one in enumerate(speeds[:_FEW]) for other in speeds[at:_FEW]]
    functions = [*np.sign(speeds), *np.sin(angles), *np.cos(angles), *inertial]
    columns = [np.ones(len(rows)), *now[:, seen].T, *speeds, *functions]
    return tuple(joints), _Motion(rows, np.stack(columns, axis=-1), np.stack(changes, axis=-1), np.array(ahead))


def _peaks(motion: _Motion, action: Float[np.ndarray, "rows joints"], control_step: float) -> list[int]:
    """The lags in rows at which each joint's acceleration correlates most with its action, in absolute value."""
    basis = orth(motion.state / np.maximum(np.abs(motion.state).max(0), np.finfo(float).tiny))
    changes, actions = (columns - basis @ (basis.T @ columns) for columns in (motion.change, action))
    longest = int(np.ceil(LONGEST / control_step))
    cuts = np.flatnonzero(np.diff(motion.rows) > 1) + 1
    peaks = []
    for change, moved in zip(changes.T, actions.T, strict=True):
        total = np.zeros(longest + 1)
        for response, cause in zip(np.split(change, cuts), np.split(moved, cuts), strict=True):
            lagged = correlate(response, cause)[len(cause) - 1 :][: longest + 1]
            total[: len(lagged)] += lagged
        peaks.append(int(np.argmax(np.abs(total))))
    return peaks


def _products(
    motion: _Motion,
    kept: Int[np.ndarray, " some"],
    action: Float[np.ndarray, "all action"],
    windows: list[Int[np.ndarray, " _"]],
    joints: tuple[DrivenJoint, ...],
) -> tuple[Float[np.ndarray, "parts columns columns"], Float[np.ndarray, " columns"]]:
    """Products of earlier state, actions, state and changes over these rows of the motion, one part after the other.

    Columns are over their root mean squares, which come second; those of changes are in their own unit.
    """

    def columns(part: np.ndarray) -> np.ndarray:
        rows = motion.rows[part]
        earlier = motion.state[np.searchsorted(motion.rows, rows - _EARLIER)]
        taps = [action[rows[:, None] - window, joint.action] for window, joint in zip(windows, joints, strict=True)]
        return np.concatenate([earlier, *taps, motion.state[part], motion.change[part]], axis=1)

    parts = np.stack([block.T @ block for block in map(columns, np.array_split(kept, _BLOCKS))])
    scale = np.sqrt(np.diagonal(parts.sum(0)) / len(kept))
    scale[scale == 0.0] = scale[-len(joints) :] = 1.0
    return parts / (scale[:, None] * scale), scale


def _regressed(
    products: Float[np.ndarray, "parts columns columns"],
    scale: Float[np.ndarray, " columns"],
    owns: list[Int[np.ndarray, " _"]],
    *,
    rows: int,
    staged: bool,
) -> tuple[Float[np.ndarray, "estimates terms joints"], Float[np.ndarray, " joints"]]:
    """The coefficients of every joint's change, of the whole log and without each of its parts; and actions' shares.

    It is ordinary least squares or, if `staged`, that in two stages, of which both leave the part out: the design's
    columns as the instruments predict them, and the changes as those predict them. The design is the state and, in the
    places that each joint `owns`, the actions; instruments are the earlier state and the actions. Products are of so
    many `rows`, their columns over `scale`.
    """
    states, actions = int(owns[0][0]), np.concatenate(owns)
    instruments, design = (np.append(first + np.arange(states), actions) for first in (0, states + len(actions)))
    whole, count, changes = products.sum(0), len(design), np.arange(len(scale) - len(owns), len(scale))
    targets = np.append(design, changes)

    def solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
        return np.linalg.solve(matrix + _RIDGE * rows * np.eye(len(matrix)), right)

    def predicted(of: np.ndarray) -> np.ndarray:
        """Products of the design's columns, as the instruments predict them, with each other and with the changes."""
        if not staged:
            return of[np.ix_(design, targets)]
        mixed = of[np.ix_(instruments, targets)]
        return np.asarray(mixed[:, :count].T @ solved(of[np.ix_(instruments, instruments)], mixed))

    everything = predicted(whole)
    estimates = np.stack(
        [
            solved(each[:, :count], each[:, count:])
            for each in (everything, *(predicted(whole - part) for part in products))
        ]
    )
    shares = []
    for at, own in enumerate(owns):
        others, right = np.setdiff1d(np.arange(count), own), everything[:, count + at]
        without = solved(everything[np.ix_(others, others)], right[others])
        left = whole[changes[at], changes[at]] - np.array([right[others] @ without, right @ estimates[0, :, at]])
        shares.append(float(1.0 - left[1] / max(left[0], np.finfo(float).tiny)))
    return estimates / scale[design, None], np.array(shares)


def _jackknife(values: Float[np.ndarray, " estimates"]) -> float:
    """The standard error of the first value from the others, each of which leaves one part of the log out."""
    without = values[1:]
    return float(np.sqrt((len(without) - 1) * without.var()))
