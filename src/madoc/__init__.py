"""Madoc: calibrate a simulator to logged robot data, learn a policy there, and show that it works in the target.

The public names are those of `__init__.pyi`. Each is imported when it is first used, so that `import madoc` loads no
JAX and no MuJoCo. It registers the robots as Gymnasium environments: `gymnasium.make("madoc/Hopper")`.
"""

import ast
import contextlib
import importlib
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path


def lazily(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package that imports a name when it is first used (PEP 562).

    The names are those that the package's stub `__init__.pyi` imports, where type checkers and readers see them.
    """
    stub = Path(sys.modules[package].__file__ or "").with_suffix(".pyi")
    places: dict[str, tuple[str, str]] = {}
    for line in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(line, ast.ImportFrom):
            for alias in line.names:
                places[alias.name] = (line.module, alias.name) if line.module else (alias.name, "")

    def get(name: str) -> object:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, attribute = places[name]
        imported = importlib.import_module(f"{package}.{module}")
        value = getattr(imported, attribute) if attribute else imported
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: sorted({*vars(sys.modules[package]), *places}), [*places]


__getattr__, __dir__, __all__ = lazily(__name__)

try:
    __version__ = metadata.version("madoc-calibration")
except metadata.PackageNotFoundError:  # its files without their package, as copied to a robot's computer
    __version__ = "unknown"

ENVIRONMENTS = {"Hopper": "hopper", "HalfCheetah": "halfcheetah", "Walker2d": "walker2d", "Ant": "ant"}
"""The robots by the names of their Gymnasium environments: `hopper` is `madoc/Hopper`."""
EPISODE_STEPS = 1000
"""Control steps of an episode in these environments; Gymnasium truncates it then."""

# A robot's computer, where only NumPy is installed, needs `madoc.numpy_policy` but no environments.
with contextlib.suppress(ModuleNotFoundError):
    import gymnasium

    for _name, _task in ENVIRONMENTS.items():
        gymnasium.register(
            f"madoc/{_name}",
            entry_point="madoc.gymnasium_environment:CalibratedEnvironment",
            vector_entry_point="madoc.gymnasium_environment:CalibratedVectorEnvironment",
            max_episode_steps=EPISODE_STEPS,
            kwargs={"task": _task},
        )
