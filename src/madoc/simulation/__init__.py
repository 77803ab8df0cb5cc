"""Simulators: parameters are bound to systems, and systems step states over two batch axes."""

from madoc.simulation.base import Simulator, System
from madoc.simulation.cpu import CpuSimulator
from madoc.tasks.base import Task

FINER = 4
"""Number of timesteps that take the place of one of the model's."""


def make(task: Task, *, threads: int | None = None) -> Simulator:
    """The simulator of a task, on `threads` cores (default: all this process may use).

    Raises:
        MadocError: A parameter of the task names an element that its model does not have.
    """
    return CpuSimulator(task, threads=threads)


def with_shorter_timestep(simulator: Simulator) -> Simulator:
    """The same simulator with a timestep `FINER` times as short: a machine has none, and the model's has an error."""
    return make(simulator.task.with_time_step(1.0 / FINER, substeps=FINER))


__all__ = ["FINER", "Simulator", "System", "make", "with_shorter_timestep"]
