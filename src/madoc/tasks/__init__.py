"""The robots of the paper; `TASKS` lists them by name."""

from collections.abc import Callable
from functools import cache

from madoc.errors import unknown_name
from madoc.tasks.base import ActionChannel, Task
from madoc.tasks.walking import ant, half_cheetah, hopper, walker2d

TASKS: dict[str, Callable[[str], Task]] = {
    "hopper": hopper,
    "halfcheetah": half_cheetah,
    "walker2d": walker2d,
    "ant": ant,
}


@cache
def make(name: str, physics: str = "legacy") -> Task:
    """The task of a name; the same object each time, so that its model is compiled once.

    Raises:
        MadocError: No task has that name, or `physics` is neither `legacy` nor `modern`.
    """
    if name not in TASKS:
        raise unknown_name("task", name, TASKS)
    return TASKS[name](physics)


__all__ = ["TASKS", "ActionChannel", "Task", "ant", "half_cheetah", "hopper", "make", "walker2d"]
