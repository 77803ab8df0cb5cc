"""The warnings and notes that least squares adds to an estimate."""

import numpy as np
from jaxtyping import Float

from madoc.calibration.base import CalibrationProblem
from madoc.calibration.least_squares.instruments import FilterState
from madoc.calibration.least_squares.plan import EXACT, LONG_TAILS
from madoc.calibration.least_squares.search import SearchState
from madoc.data import stride
from madoc.data.velocities import dof_names
from madoc.identification.noise import WHITE
from madoc.identification.random_forces import by_dof
from madoc.identification.systematic import EXPLAINED
from madoc.simulation import FINER

MOST_LEFT_OUT = 0.05
"""Share in [0, 1] of windows that no initial state explains; without contacts, noise alone leaves out fewer."""
FEWEST_LEFT_OUT = 3
"""Number of windows; fewer may be left out by chance, however few there are."""
TAILS = "residuals have longer tails than noise has: the intervals are too narrow, by how much is not known"
ALIKE = (
    "what the model leaves of a reading is like what it leaves of the next (a correlation of at least {:.2f}), as "
    "noise is not: the intervals are too narrow, by how much is not known"
)
PREDICTABLE = (
    "state and action explain {:.0f} % of what the model leaves of a signal, as they do not explain noise: the model "
    "lacks something, and the intervals are too narrow, by how much is not known"
)
NOT_RANDOM = (
    "forces act on the machine that the model does not have, and they are not random: state and action explain {:.0f} "
    "% of one of them; the model lacks something, and the intervals are too narrow, by how much is not known"
)
STILL_TRYING = (
    "a search with a shorter timestep was under way when it ended: with a larger budget it tells whether the model's "
    "timestep makes the residuals that are unlike noise"
)
TIMESTEP = (
    "the log does not exclude a timestep a quarter as long: the intervals also cover the estimate without the error of "
    "the model's timestep (give a shorter one in the spec to narrow them)"
)
PUSHED = (
    "random forces that the model does not have act on the machine: in each control step new ones, of which that on {} "
    "has the largest standard deviation, {:.2g} N or N·m (result.json has all, as random_forces); the estimates allow "
    "for them"
)
NOT_SETTLED = (
    "the search had not settled when it ended, and intervals do not count what is missing; take a larger budget"
)
STILL_LENGTHENING = "longer windows were under way when it ended: a larger budget may narrow the intervals"
PREDICTS = (
    "the model does not explain the log to within its noise, so the estimate is the one that predicts best over a "
    "second; its distance from the one that explains short windows best widens the intervals"
)
STILL_PREDICTING = (
    "a fit for prediction, as the model leaves more than noise, was under way when it ended: with a larger budget the "
    "estimate may predict better"
)


def about_estimated_states(problem: CalibrationProblem, search: SearchState, horizon: int) -> str:
    """A sentence that initial states were estimated, why the data needed it, and how large the noise is.

    It also says how many windows were left out because bodies touch in them.
    """
    sentence = (
        f"the initial state of each window of {horizon} control steps was estimated with the parameters, as "
        f"{_why_states_are_not_known(problem)}"
    )
    if search.without:
        sentence += f", and {search.without} windows in which bodies touch were left out"
    if not search.refining:
        return sentence
    return f"{sentence}; {_how_large(problem, search.deviation)}, and the intervals allow for it"


def about_filtered_states(problem: CalibrationProblem, search: FilterState, *, asked: bool) -> str:
    """A sentence that readings were predicted by an ensemble filter, why, and how large the noise is.

    `asked` is whether the user asked for estimated initial states.
    """
    why = "initial_states=estimated asks for it" if asked else _why_states_are_not_known(problem)
    sentence = (
        f"every reading in windows of {search.horizon} control steps was predicted by an ensemble filter from "
        f"those before it, as {why}, and bodies touch"
    )
    if not search.epochs:
        return sentence
    return f"{sentence}; {_how_large(problem, search.noise)}, and the intervals allow for it"


def about_surprises(problem: CalibrationProblem, search: FilterState) -> tuple[str, ...]:
    """Sentences on what an ensemble filter leaves that noise has not, on the timestep, and on random forces."""
    about = [TAILS] * (search.cost > LONG_TAILS) + [ALIKE.format(search.alike)] * (search.alike > WHITE)
    if search.explained_share > EXPLAINED:
        about.append((NOT_RANDOM if search.force else PREDICTABLE).format(100.0 * search.explained_share))
    about *= search.found.unlike_noise
    if search.shorter_steps.any():
        about.append(TIMESTEP)
    forces = by_dof(problem.simulator, search.found.force)
    if len(forces):
        largest = int(forces.argmax())
        about.append(PUSHED.format(dof_names(problem.simulator.task)[largest], forces[largest]))
    return tuple(about)


def _why_states_are_not_known(problem: CalibrationProblem) -> str:
    """Why the log's states do not serve as they are."""
    if problem.states.kind != "exact":
        return "states cannot be rebuilt from the data"
    if problem.dataset.disturbance.velocities == "differences":
        return "velocities are differences of positions, which are what it compares"
    if problem.dataset.disturbance.noise:
        return "the data is noisy"
    return "the log is noisy: residuals of consecutive rows alternate in sign"


def _how_large(problem: CalibrationProblem, noise: Float[np.ndarray, " channels"]) -> str:
    """The noise of the median channel."""
    rows = stride(problem.dataset)
    change = f"what a signal typically changes in {rows} row{'s' * (rows > 1)}"
    return f"the noise found is {100.0 * float(np.median(noise)):.2g} % of {change}"


def about_timestep(problem: CalibrationProblem) -> str:
    """A sentence that the parameters are those of a shorter timestep than the model's."""
    own = float(problem.simulator.task.model.opt.timestep)
    return (
        f"the log is likelier with a timestep of {own / FINER:.12g} s than with the model's of {own:.12g} s, so the "
        "parameters were estimated and tested with the shorter one, and do not make up for the error of the longer; "
        f"simulate with {own:.12g} s all the same: predictions over longer times are made with it, and madoc export "
        "keeps it"
    )


def have_long_tails(problem: CalibrationProblem, search: SearchState) -> bool:
    """Whether residuals have longer tails than noise has; not known before the first step on all windows.

    Where nothing touches, more than `MOST_LEFT_OUT` of the windows that no initial state explains are a long tail too:
    they are left out of the cost.
    """
    if not _noisy(search):
        return False
    left_out, windows = _left_out(search)
    many = left_out >= max(FEWEST_LEFT_OUT, MOST_LEFT_OUT * windows)
    smooth = problem.states.starts_known and not search.touching.any()
    return search.tail_cost > LONG_TAILS or (smooth and many)


def about_residuals(problem: CalibrationProblem, search: SearchState) -> tuple[str, ...]:
    """Sentences on windows left out and on residuals with long tails; none before the first step on all windows."""
    if not _noisy(search):
        return ()
    left_out, windows = _left_out(search)
    sentence = (
        f"windows left out: {left_out} of {windows}, as no initial state explains them as well as the others (contacts "
        "that begin there, wrong readings) or their simulation failed"
    )
    return (*([sentence] if left_out else []), *([TAILS] if have_long_tails(problem, search) else []))


def about_model_errors(horizon: int) -> str:
    """A sentence that longer windows leave more."""
    return (
        f"over {horizon} control steps residuals exceed the noise: the model lacks something that adds up (the verdict "
        "says whether its tests found what); the intervals are those of the shortest windows"
    )


def _left_out(search: SearchState) -> tuple[int, int]:
    """Number of windows that no initial state explains, and of all."""
    return len(search.rows) - search.explained, len(search.rows)


def _noisy(search: SearchState) -> bool:
    """Whether residuals of all windows are known, and are not rounding errors."""
    return bool(search.refining and search.epochs) and float(search.deviation.max()) >= EXACT
