"""The versions on which results depend, as installed."""

import platform
from importlib import metadata

_PACKAGES = {"madoc": ("madoc-calibration",), "jax": ("jax",), "mujoco": ("mujoco-core", "mujoco")}
"""What results depend on, and where its version is found: since 4.0 MuJoCo's library is in a package of its own."""


def versions() -> dict[str, str]:
    """Versions of Python and of the packages on which the results of a run depend, by name."""
    installed = {"python": platform.python_version()}
    for name, packages in _PACKAGES.items():
        found = (_version(package) for package in packages)
        installed[name] = next((version for version in found if version), "not installed")
    return installed


def _version(package: str) -> str:
    """Version of an installed package, empty where there is none of that name."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
