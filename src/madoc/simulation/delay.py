"""Actions that take effect late: how much of which past action acts in which physics step of a control step."""

import numpy as np
from jaxtyping import Float

LAGS = 6.0
"""Time constants after which a lag has followed a command: 0.2 % of it are missing."""


def pending_actions(delay: float, lag: float, control_step: float) -> int:
    """Number of past actions that still act under a delay and a lag of so many seconds."""
    return int(np.ceil((delay + LAGS * lag) / control_step - 1e-9))


def action_weights(
    delay: Float[np.ndarray, "systems values"],
    lag: Float[np.ndarray, "systems values"],
    *,
    control_step: float,
    physics_steps: int,
    pending: int,
) -> Float[np.ndarray, "systems physics_steps actions values"]:
    """Weight of each action, newest first, in the control of each physics step of a control step.

    The action chosen m control steps ago, at -m T, takes effect at τ - m T and holds until the next one does. Behind
    that a lag of first order follows with the time constant λ: of a change at time 0 it has followed 1 - exp(-t / λ) at
    time t. What acts in a physics step is the mean over that step, so that what follows changes continuously with the
    delay and the lag. The oldest action has what is left.

    Args:
        delay: τ of each system and value of an action, in seconds, at most `pending` control steps.
        lag: λ of each, in seconds; 0 for none.
        control_step: T in seconds.
        physics_steps: Number of physics steps per control step.
        pending: Number of past actions in a state, besides the newest.
    """
    step = control_step / physics_steps
    ends = step * np.arange(1, physics_steps + 1)[:, None, None]
    effect = delay[:, None, None] - control_step * np.arange(pending + 1)[:, None]
    # Share of each physics step in which the m-th newest action, or a newer one, has taken effect.
    reached = np.clip((ends - effect) / step, 0.0, 1.0)
    if lag.any():
        constant = np.where(lag > 0.0, lag, np.inf)[:, None, None]
        to_go = (np.exp(-np.maximum(since, 0.0) / constant) for since in (ends - step - effect, ends - effect))
        behind = lag[:, None, None] / step * np.subtract(*to_go)  # 0 without a lag
        reached = reached - behind
    reached[:, :, -1] = 1.0
    return np.diff(reached, axis=2, prepend=0.0)


def blend(
    weights: Float[np.ndarray, "systems physics_steps actions values"],
    actions: Float[np.ndarray, "systems rows actions action"],
) -> Float[np.ndarray, "systems rows physics_steps action"]:
    """The action in each physics step; the sum is taken term by term, so its bits do not depend on the batch.

    Weights of a single value are those of all values of an action.
    """
    total = weights[:, None, :, 0] * actions[:, :, None, 0]
    for index in range(1, weights.shape[2]):
        total += weights[:, None, :, index] * actions[:, :, None, index]
    return total
