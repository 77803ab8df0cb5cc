"""Madoc: calibrate a simulator to logged robot data, learn a policy there, and show that it works in the target.

The public names, each imported when it is first asked for: `import madoc` alone is free.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from madoc import calibration, data, policies, robots, simulation, tasks
    from madoc.calibration import CalibrationProblem, CalibrationResult, Madoc
    from madoc.calibration.calibrate import calibrate
    from madoc.data import Dataset
    from madoc.errors import MadocError
    from madoc.evaluation import evaluate
    from madoc.parameters import Parameter, ParameterSpace
    from madoc.pipeline import Plan, run_all
    from madoc.policies import SAC, PolicyProblem, learn_policy, load_policy, save_policy
    from madoc.policies.behaviours import record_quality as record
    from madoc.runs.run_folder import RunFolder
    from madoc.verdict import assess

_ROOMS = ("calibration", "data", "identification", "policies", "robots", "runs", "simulation", "tasks")

_PLACES = {
    "CalibrationProblem": "calibration",
    "CalibrationResult": "calibration",
    "Dataset": "data",
    "Madoc": "calibration",
    "MadocError": "errors",
    "Parameter": "parameters",
    "ParameterSpace": "parameters",
    "Plan": "pipeline",
    "PolicyProblem": "policies",
    "RunFolder": "runs.run_folder",
    "SAC": "policies",
    "assess": "verdict",
    "calibrate": "calibration",
    "evaluate": "evaluation",
    "learn_policy": "policies",
    "load_policy": "policies",
    "record": "policies.behaviours",
    "run_all": "pipeline",
    "save_policy": "policies",
}
"""The module each public name lives in."""

_NAMES_THERE = {"record": "record_quality"}
"""What a name is called there, where it differs."""

__all__ = [
    "SAC",
    "CalibrationProblem",
    "CalibrationResult",
    "Dataset",
    "Madoc",
    "MadocError",
    "Parameter",
    "ParameterSpace",
    "Plan",
    "PolicyProblem",
    "RunFolder",
    "assess",
    "calibrate",
    "calibration",
    "data",
    "evaluate",
    "learn_policy",
    "load_policy",
    "policies",
    "record",
    "robots",
    "run_all",
    "save_policy",
    "simulation",
    "tasks",
]


def __getattr__(name: str) -> Any:
    """Import a public name the first time it is used (PEP 562)."""
    if name in _ROOMS:
        return import_module(f"madoc.{name}")
    if name not in _PLACES:
        raise AttributeError(f"module 'madoc' has no attribute {name!r}")
    value = getattr(import_module(f"madoc.{_PLACES[name]}"), _NAMES_THERE.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
