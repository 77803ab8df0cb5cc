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
    *(
        "madoc-local.hidden=[16]",
        "madoc-local.cloning_epochs=3",
        "madoc-local.cloning_updates=5",
        "madoc-local.grouping_epochs=3",
    ),
    *(
        "madoc-local.grouping_updates=5",
        "madoc-local.epoch_steps=100",
        "madoc-local.updates=5",
        "madoc-local.draws=5",
        "madoc-local.batch=32",
    ),
    *("madoc-local.replay_capacity=500", "madoc-local.agents.hidden=[16]", "madoc-local.agents.critic_hidden=[16]"),
    *("madoc-local.agents.batch=32", "madoc-local.agents.actor_batch=16"),
]
"""Every stage of madoc in epochs of milliseconds."""

if __name__ == "__main__":
    TASKS["spring"] = listed
    sys.exit(main())
