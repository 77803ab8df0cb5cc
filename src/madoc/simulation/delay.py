"""Actions that take effect late: which past action holds in which physics step of a control step."""

import numpy as np
from jaxtyping import Float


def delay_weights(
    delay: Float[np.ndarray, " systems"], *, control_step: float, physics_steps: int, pending: int
) -> Float[np.ndarray, "systems physics_steps actions"]:
    """Weight of each action, newest first, in the control of each physics step of a control step.

    The action chosen m control steps ago, at -m T, takes effect at τ - m T and holds until the next one does. In the
    physics step where the switch falls, the two are blended by the time each holds, so that what follows changes
    continuously with the delay.

    Args:
        delay: τ of each system in seconds, at most `pending` control steps.
        control_step: T in seconds.
        physics_steps: Number of physics steps per control step.
        pending: Number of past actions in a state, besides the newest.
    """
    step = control_step / physics_steps
    ends = step * np.arange(1, physics_steps + 1)
    effect = delay[:, None] - control_step * np.arange(pending + 1)
    # Share of each physics step in which the m-th newest action, or a newer one, has taken effect.
    reached = np.clip((ends[None, :, None] - effect[:, None, :]) / step, 0.0, 1.0)
    reached[..., -1] = 1.0
    return np.diff(reached, axis=-1, prepend=0.0)


def blend(
    weights: Float[np.ndarray, "systems physics_steps actions"],
    actions: Float[np.ndarray, "systems rows actions action"],
) -> Float[np.ndarray, "systems rows physics_steps action"]:
    """The action in each physics step; the sum is taken term by term, so its bits do not depend on the batch."""
    terms = weights[:, None, :, :, None] * actions[:, :, None]
    total = terms[..., 0, :]
    for index in range(1, terms.shape[-2]):
        total = total + terms[..., index, :]
    return total
