"""Simulators: parameters are bound to systems, and systems step states over two batch axes."""

from madoc.simulation.base import Simulator, System
from madoc.simulation.cpu import CpuSimulator
from madoc.tasks.base import Task


def make(task: Task, *, threads: int | None = None) -> Simulator:
    """The simulator of a task, on `threads` cores (default: all this process may use).

    Raises:
        MadocError: A parameter of the task names an element that its model does not have.
    """
    return CpuSimulator(task, threads=threads)


__all__ = ["Simulator", "System", "make"]
