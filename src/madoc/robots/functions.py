"""A Python file that a spec names: its functions `reward`, `end` and `reset`, imported only where that is allowed."""

import hashlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.abc import SourceLoader
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float, Shaped

from madoc.errors import MadocError, NotAllowed, nearest_hint
from madoc.runs.files import read_bytes

NAMES = ("reward", "end", "reset")
"""The functions that a file may define, each in the place of the spec's key of that name."""
LARGEST = 200_000
"""Largest size of a file in bytes; a larger one is refused."""

Rows = Float[np.ndarray, "*rows"]
Argument = Shaped[np.ndarray, "..."] | dict[str, Float[np.ndarray, "..."]] | np.random.Generator | int
"""A value for every row; values by joint; what random numbers come from; or a number of episodes."""


@dataclass(frozen=True)
class PythonFile:
    """A Python file: its path in the folder of the spec, and its content."""

    name: str
    content: bytes

    @classmethod
    def read(cls, folder: Path, name: str) -> "PythonFile":
        """The file of a name inside the folder of a spec; any other is refused."""
        path = folder / name
        if Path(name).is_absolute() or not path.resolve().is_relative_to(folder.resolve()):
            raise MadocError(f"expected a Python file inside the folder of the spec, got {name}; move it there")
        if path.suffix != ".py" or not path.is_file():
            raise MadocError(f"there is no Python file {name} beside the spec; check the path")
        return cls._checked(name, read_bytes(path))

    @classmethod
    def from_json(cls, stored: object) -> "PythonFile":
        """The file that `to_json` wrote; a ValueError says what is damaged."""
        name, text, digest = (stored.get(key) if isinstance(stored, Mapping) else None for key in _STORED)
        if not (isinstance(name, str) and isinstance(text, str)):
            raise ValueError("its Python file has no name or no text")
        made = cls._checked(name, text.encode())
        if made.sha256 != digest:
            raise ValueError(f"the text of {name} is not what its checksum says")
        return made

    @classmethod
    def _checked(cls, name: str, content: bytes) -> "PythonFile":
        if len(content) > LARGEST:
            raise MadocError(f"{name} has {len(content):,} bytes, a file of functions at most {LARGEST:,}; shorten it")
        try:
            content.decode()
        except UnicodeDecodeError as error:
            raise MadocError(f"expected text in UTF-8 in {name}, got byte {content[error.start]:#x}") from error
        return cls(name, content)

    @property
    def sha256(self) -> str:
        """Checksum of the content."""
        return hashlib.sha256(self.content).hexdigest()

    def to_json(self) -> dict[str, object]:
        """The file for JSON; the checksum stands before the text, as a change is told by the first that differs."""
        return {"file": self.name, "sha256": self.sha256, "text": self.content.decode()}


_STORED = ("file", "text", "sha256")


def require_permission(name: str, where: str, *, allowed: bool) -> None:
    """Raise NotAllowed unless running a file of a spec is allowed."""
    if not allowed:
        raise NotAllowed(
            f"{where} the Python file {name}, which would be run; read it, and if you trust it pass --allow-code "
            "(in Python allow_code=True)"
        )


@dataclass(frozen=True)
class Function:
    """A function of a Python file.

    Attributes:
        file: Name of the file.
        name: `reward`, `end` or `reset`.
        call: The function itself.
        arguments: Names of its arguments, each of which is known.
    """

    file: str
    name: str
    call: Callable[..., object]
    arguments: tuple[str, ...]

    @property
    def place(self) -> str:
        """What it is called in a sentence."""
        return f"{self.file}, {self.name}"

    def __call__(self, values: Mapping[str, Argument]) -> object:
        """What the function returns; its own errors are refused with their line."""
        try:
            with np.errstate(all="ignore"):
                return self.call(**{name: values[name] for name in self.arguments})
        except Exception as error:
            raise MadocError(_failed(self.file, self.name, error)) from error

    def rows(self, values: Mapping[str, Argument], shape: tuple[int, ...]) -> Shaped[np.ndarray, "*rows"]:
        """A number for every row, float64; of `end`, true or false."""
        result = self(values)
        if self.name != "end":
            return self.checked(result, shape)
        flags = np.asarray(result)
        if flags.dtype != np.bool_:
            raise MadocError(f"{self.place}: expected an array of true and false, got {flags.dtype}; compare numbers")
        self._check_shape(flags, shape)
        return np.array(flags)

    def checked(self, result: object, shape: tuple[int, ...], what: str = "") -> Rows:
        """A copy of numbers for every row as float64; anything else is refused, named by `what`."""
        numbers = np.asarray(result)
        if numbers.dtype.kind not in "biuf":
            raise MadocError(f"{self.place}: expected an array of numbers{what}, got {numbers.dtype}")
        self._check_shape(numbers, shape, what)
        return np.array(numbers, dtype=np.float64)

    def _check_shape(self, result: Shaped[np.ndarray, "..."], shape: tuple[int, ...], what: str = "") -> None:
        if result.shape != shape:
            raise MadocError(
                f"{self.place}: expected a value for every row{what}, shape {shape}, got shape {result.shape}; compute "
                "with whole arrays, along their last axis only where an argument has one more"
            )


def read_functions(file: PythonFile, known: Mapping[str, Sequence[str]]) -> dict[str, Function]:
    """The functions of a file, which is imported; `known` are the arguments that each of `NAMES` may have.

    Raises:
        MadocError: The file cannot be imported, defines none of them, or one has an argument that is not known.
    """
    module = _imported(file)
    found = {name: getattr(module, name) for name in NAMES if hasattr(module, name)}
    if not found:
        raise MadocError(f"{file.name} defines none of the functions {', '.join(NAMES)}; define one")
    return {name: _function(file.name, name, call, known[name]) for name, call in found.items()}


def _function(file: str, name: str, call: object, known: Sequence[str]) -> Function:
    """A function with its arguments; one that is not known and has no default is refused."""
    if not inspect.isfunction(call):
        raise MadocError(f"{file}: expected {name} as a function, got {type(call).__name__}; define it with def")
    arguments = []
    for parameter in inspect.signature(call).parameters.values():
        if parameter.kind not in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            raise MadocError(f"{file}, {name}: expected arguments by name, got {parameter}; write each out")
        if parameter.name in known:
            arguments.append(parameter.name)
        elif parameter.default is parameter.empty:
            hint = nearest_hint(parameter.name, known)
            raise MadocError(f"{file}, {name}: there is nothing called {parameter.name!r} to hand to it; {hint}")
    return Function(file, name, call, tuple(arguments))


@cache
def _imported(file: PythonFile) -> ModuleType:
    """The module of a file; its errors are refused with their line."""
    name = f"madoc_episode_{file.sha256[:16]}"
    spec = importlib.util.spec_from_loader(name, _Loader(file))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses and the like look for it
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise MadocError(_failed(file.name, "its import", error)) from error
    return module


class _Loader(SourceLoader):
    """Imports the content that was read and hashed, whatever the file holds by now, and caches no bytecode."""

    def __init__(self, file: PythonFile) -> None:
        self._file = file

    def get_filename(self, fullname: str) -> str:
        return self._file.name

    def get_data(self, path: str) -> bytes:
        return self._file.content


def _failed(file: str, what: str, error: BaseException) -> str:
    """A sentence on an error inside a file, with the last of its lines that were reached."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
    reason = " ".join(str(error.msg if isinstance(error, SyntaxError) else error).split())
    where = file if line is None else f"{file}, line {line}"
    return f"{where}: {what} failed with {type(error).__name__}: {reason}"
