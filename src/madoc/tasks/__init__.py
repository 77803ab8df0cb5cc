"""Robots and what is asked of them. One file a robot; `TASKS` finds them by name."""

from collections.abc import Callable

from madoc.errors import unknown_name
from madoc.tasks.ant import ant
from madoc.tasks.base import ActionChannel, Task
from madoc.tasks.half_cheetah import half_cheetah
from madoc.tasks.hopper import hopper
from madoc.tasks.walker2d import walker2d

TASKS: dict[str, Callable[[str], Task]] = {
    "hopper": hopper,
    "halfcheetah": half_cheetah,
    "walker2d": walker2d,
    "ant": ant,
}


def make(name: str, physics: str = "legacy") -> Task:
    """A task by name.

    Raises:
        MadocError: No task has that name, or `physics` is neither `legacy` nor `modern`.
    """
    if name not in TASKS:
        raise unknown_name("task", name, TASKS)
    return TASKS[name](physics)


__all__ = ["TASKS", "ActionChannel", "Task", "ant", "half_cheetah", "hopper", "make", "walker2d"]
