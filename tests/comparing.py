"""The spring as a robot of the command line, small enough to compare methods in seconds; tests kill it."""

import sys
from dataclasses import replace

from madoc.commands.main import main
from madoc.tasks import TASKS
from robots import spring


def listed(physics):
    """The spring as `madoc.tasks` would list it."""
    return replace(spring(max_episode_steps=100), physics=physics, velocities=1)


TINY = [
    *("madoc.hidden=[16]", "madoc.cloning_epochs=3", "madoc.cloning_updates=5", "madoc.grouping_epochs=3"),
    *("madoc.grouping_updates=5", "madoc.epoch_steps=100", "madoc.updates=5", "madoc.draws=5", "madoc.batch=32"),
    *("madoc.replay_capacity=500", "madoc.agents.hidden=[16]", "madoc.agents.critic_hidden=[16]"),
    *("madoc.agents.batch=32", "madoc.agents.actor_batch=16"),
]
"""Every stage of madoc in epochs of milliseconds."""

if __name__ == "__main__":
    TASKS["spring"] = listed
    sys.exit(main())
