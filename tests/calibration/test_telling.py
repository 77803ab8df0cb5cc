"""Windows that tell much come early where the log shows contacts, and only there."""

import jax
import numpy as np

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem
from madoc.calibration.least_squares.telling import telling_first
from own_robots import BOUNCER, BOUNCER_SPEC, write_robot
from robots import SPRING_TRUTH, recorded, spring

TRUTH = {"body_mass.trunk": 2.0, "body_mass.leg": 0.5, "dof_damping.knee": 5.0}
CONTACT = "  - {field: contact_time, element: foot, low: 0.02, high: 0.1}\n"


def test_every_other_of_the_windows_searched_first_tells_much(tmp_path):
    model = BOUNCER.replace('size=".05" pos', 'name="foot" size=".05" pos')
    spec = BOUNCER_SPEC.replace("max_episode_steps", CONTACT + "max_episode_steps")
    task = robots.load(write_robot(tmp_path, spec, bouncer=model)).task
    problem = CalibrationProblem(
        recorded(task, TRUTH | {"contact_time.foot": 0.03}, 1200, jax.random.key(0)), simulation.make(task, threads=1)
    )
    rows = np.random.default_rng(0).permutation(np.arange(0, 1190, 10))
    ordered = telling_first(problem, rows, 8, 40, 20)
    np.testing.assert_array_equal(np.sort(ordered), np.sort(rows))
    others = ordered[1:20:2]
    np.testing.assert_array_equal(others, [row for row in rows if row not in ordered[:20:2]][:10])
    counts = problem.simulator.contacts(problem.states.states)
    changes = [[len(np.unique(counts[row : row + 9])) > 1 for row in part] for part in (ordered[:20:2], rows)]
    assert np.mean(changes[0]) > np.mean(changes[1])  # landings and jumps tell of the contact's time constant
    np.testing.assert_array_equal(telling_first(problem, rows, 8, 40, 20, ordered[:40])[:40], ordered[:40])
    np.testing.assert_array_equal(telling_first(problem, rows, 8, len(rows), 20), rows)  # all are drawn anyway


def test_nothing_changes_without_contacts():
    task = spring(max_episode_steps=100)
    problem = CalibrationProblem(recorded(task, SPRING_TRUTH, 400, jax.random.key(0)), simulation.make(task, threads=1))
    rows = np.random.default_rng(0).permutation(np.arange(0, 390, 10))
    np.testing.assert_array_equal(telling_first(problem, rows, 8, 20, 10), rows)
