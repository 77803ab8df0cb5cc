"""Systems at a task's nominal values, whatever its parameters."""

from collections.abc import Callable

import numpy as np
import pytest

from madoc.simulation.cpu import CpuSimulator, CpuSystem
from madoc.tasks.base import Task


@pytest.fixture
def nominal() -> Callable[[Task], CpuSystem]:
    """One system with the task's own model, nothing written into it."""

    def build(task: Task) -> CpuSystem:
        return CpuSystem(
            CpuSimulator(task, threads=1), [[task.compile()]], np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1))
        )

    return build
