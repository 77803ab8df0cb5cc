"""Madoc: calibrate a simulator to logged robot data, learn a policy there, and show that it works in the target.

The public names are those of `__init__.pyi`, each imported when it is first used, so `import madoc` alone is free. It
makes `gymnasium.make("madoc/Hopper")` work, whichever of the two packages is imported first.
"""

import ast
import importlib.util
import sys
from collections.abc import Callable
from importlib.abc import MetaPathFinder
from pathlib import Path


def lazily(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package that imports its names when they are first used (PEP 562).

    The names are those that its stub, the file `__init__.pyi`, imports, so type checkers and readers see them there.
    """
    stub = Path(sys.modules[package].__file__ or "").with_suffix(".pyi")
    places: dict[str, tuple[str, str]] = {}
    for line in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(line, ast.ImportFrom):
            for alias in line.names:
                place = (line.module, alias.name) if line.module else (alias.name, "")
                places[alias.asname or alias.name] = place

    def get(name: str) -> object:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, attribute = places[name]
        found = importlib.import_module(f"{package}.{module}")
        value = getattr(found, attribute) if attribute else found
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: sorted({*vars(sys.modules[package]), *places}), [*places]


__getattr__, __dir__, __all__ = lazily(__name__)

ENVIRONMENTS = {"Hopper": "hopper", "HalfCheetah": "halfcheetah", "Walker2d": "walker2d", "Ant": "ant"}
"""Names of the Gymnasium environments below `madoc/`, and the robots that they are."""
EPISODE_STEPS = 1000
"""Control steps after which Gymnasium truncates an episode of any of them."""


def register_environments() -> None:
    """Make the robots known to `gymnasium.make` as `madoc/Hopper` and so on; a second call changes nothing."""
    import gymnasium

    for name, task in ENVIRONMENTS.items():
        if f"madoc/{name}" not in gymnasium.registry:
            gymnasium.register(
                f"madoc/{name}",
                entry_point="madoc.gymnasium_environment:CalibratedEnvironment",
                vector_entry_point="madoc.gymnasium_environment:CalibratedVectorEnvironment",
                max_episode_steps=EPISODE_STEPS,
                kwargs={"task": task},
            )


class _AfterGymnasium(MetaPathFinder):
    """Registers the environments right after Gymnasium has been imported, which knows no plugins of its own."""

    def find_spec(self, fullname, path, target=None):
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module) -> None:
                execute(module)
                register_environments()

            spec.loader.exec_module = execute_and_register
        return spec


if "gymnasium" in sys.modules:
    register_environments()
else:
    sys.meta_path.insert(0, _AfterGymnasium())
