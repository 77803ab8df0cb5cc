"""A robot's model by its name: in a checkout of MuJoCo Menagerie, or fetched by the package robot_descriptions."""

import importlib
import os
from pathlib import Path

from madoc.errors import MadocError, listed, nearest

_CACHE = "~/.cache/robot_descriptions"
"""Where robot_descriptions keeps what it has fetched, unless ROBOT_DESCRIPTIONS_CACHE names another folder."""
_OTHERS = ("scene", "mjx")
"""Parts of names of files that are a robot's surroundings, or variants of it."""


def model_of(name: str, *, menagerie: Path | None = None, download: bool = False) -> Path:
    """The model file of a robot: `name` itself where it is a path, else of the robot of that name.

    It is looked for in a checkout of MuJoCo Menagerie, which is `menagerie` or the one that robot_descriptions has
    fetched before. The network is used only where `download` says so.

    Raises:
        MadocError: There is no such robot, or more than one.
    """
    path = Path(name).expanduser()
    if path.exists() or path.suffix or len(path.parts) != 1:
        return path
    if menagerie is not None and not menagerie.expanduser().is_dir():
        raise MadocError(f"there is no folder {menagerie}; name a checkout of MuJoCo Menagerie with --menagerie")
    cache = Path(os.environ.get("ROBOT_DESCRIPTIONS_CACHE", _CACHE)) / "mujoco_menagerie"
    models = sorted((menagerie or cache).expanduser().glob("*/*.xml"))
    found = [file for file in models if file.stem == name]
    if not found:
        of_robot = [file for file in models if file.parent.name == name]
        found = [file for file in of_robot if not any(word in file.stem for word in _OTHERS)]
    if len(found) == 1:
        return found[0]
    if found:
        raise MadocError(f"{name} may be {listed([str(file) for file in found], 8)}; name the file of one of them")
    if download:
        return _fetched(name)
    known = nearest(name, [file.stem for file in models if not file.stem.startswith(_OTHERS)])
    where = f"; near it are {', '.join(known)}" if known else ""
    raise MadocError(
        f"there is no file {name}, and no robot of that name in {menagerie or cache}{where}; name a model file, a "
        "checkout of MuJoCo Menagerie with --menagerie, or let the package robot_descriptions fetch it with --download"
    )


def _fetched(name: str) -> Path:
    """The model that robot_descriptions fetches by git, MJCF before URDF."""
    try:
        known = importlib.import_module("robot_descriptions._descriptions").DESCRIPTIONS
    except ImportError:
        needed = 'pip install "madoc-calibration[robots]"'
        raise MadocError(f"fetching a robot needs the package robot_descriptions; {needed}") from None
    for kind, path in (("mj_description", "MJCF_PATH"), ("description", "URDF_PATH")):
        if f"{name}_{kind}" in known:
            try:
                return Path(getattr(importlib.import_module(f"robot_descriptions.{name}_{kind}"), path))
            except Exception as error:  # git raises what it likes where there is no network
                reason = " ".join(str(error).split())[:200]
                raise MadocError(f"could not fetch {name} ({reason}); is there a network, and git?") from error
    names = [key.removesuffix("_description").removesuffix("_mj") for key in known]
    raise MadocError(f"robot_descriptions has no robot {name}; near it are {', '.join(nearest(name, names)) or 'none'}")
