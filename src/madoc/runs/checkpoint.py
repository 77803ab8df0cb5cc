"""Save a method's state in one `.npz` file and read the same bits back, without pickle."""

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from madoc.errors import MadocError
from madoc.runs.files import json_text, replacing

State = TypeVar("State")

FORMAT = 2
"""Version of the file's layout: one `.npy` member for each array, and `checkpoint.json` for everything else."""

_READERS: dict[str, Callable[[str], object]] = {
    "bool": lambda text: text == "True",
    "int": int,
    "float": float,
    "str": str,
}
"""Types of the Python values that a state may hold, and how to read them back, exactly, from `str(value)`."""
_ARRAYS = ("jax", "numpy", "scalar")


@dataclass(frozen=True)
class Leaf:
    """The type of a leaf of a state.

    Attributes:
        kind: `jax`, `numpy` or `scalar` (of NumPy) for arrays, `key` for random keys, `value` for Python values, and
            `static` for functions, which are not saved.
        dtype: The dtype, the name of a key's generator, or the Python type of a value.
        shape: The shape of an array or of keys.
        weak: Whether a JAX array is weakly typed, which decides dtypes of what is computed from it.
    """

    kind: str
    dtype: str = ""
    shape: tuple[int, ...] = ()
    weak: bool = False

    def __str__(self) -> str:
        shape = f" of shape {self.shape}" if self.kind in ("jax", "numpy", "key") else ""
        return {"key": "random key ", "static": "function"}.get(self.kind, "") + self.dtype + shape

    def fits(self, other: "Leaf") -> bool:
        """Whether one may take the other's place; JAX and NumPy arrays may take each other's."""
        same_kind = self.kind == other.kind or (self.kind in _ARRAYS and other.kind in _ARRAYS)
        return same_kind and self.dtype == other.dtype and self.shape == other.shape


class OtherState(MadocError):
    """A checkpoint holds the state of another method, setting or version."""


Layout = dict[str, Leaf]
"""The leaves of a state by path, for example `state.actor.layers[0].weight`."""


def layout(state: object) -> Layout:
    """The types of the leaves of a state.

    Raises:
        MadocError: A leaf is of a type that cannot be saved.
    """
    return {path: _describe(path, leaf) for path, leaf in _leaves(state)}


def difference(got: Layout, expected: Layout) -> str | None:
    """The first leaf that does not fit, in words; None if all fit."""
    for path in [*expected, *got]:
        if path not in got:
            return f"expected {path} ({expected[path]}), which is missing"
        if path not in expected:
            return f"got {path} ({got[path]}), which is not expected"
        if not got[path].fits(expected[path]):
            return f"expected {path} to be {expected[path]}, got {got[path]}"
    return None


def first_non_finite(state: object) -> str | None:
    """The path of the first leaf that holds a NaN or an infinity; None if there is none."""
    for path, leaf in _leaves(state):
        inexact = jnp.issubdtype(getattr(leaf, "dtype", type(leaf)), jnp.inexact)
        if inexact and not np.isfinite(np.asarray(leaf)).all():
            return path
    return None


def save(path: Path, state: object, extra: Mapping[str, object]) -> None:
    """Write a state, and a small JSON dictionary with it, whole or not at all.

    Arrays are written one after the other, so a large replay buffer is never copied. Equal states and extras give
    equal files.

    Raises:
        MadocError: A leaf is of a type that cannot be saved, `extra` is not strict JSON, or writing failed.
    """
    leaves = layout(state)
    about = {
        "format": FORMAT,
        "leaves": {name: asdict(leaf) for name, leaf in leaves.items() if leaf.kind != "static"},
        "values": {name: str(leaf) for name, leaf in _leaves(state) if leaves[name].kind == "value"},
        "extra": extra,
    }
    text = json_text(about, what=path.name)
    with replacing(path) as stream, zipfile.ZipFile(stream, "w") as archive:
        archive.writestr(zipfile.ZipInfo("checkpoint.json"), text)  # a ZipInfo of our own carries no clock time
        for name, leaf in _leaves(state):
            if leaves[name].kind not in ("value", "static"):
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, _to_numpy(leaf), allow_pickle=False)


def load(path: Path, like: State) -> tuple[State, dict[str, Any]]:
    """Read the state and the extra dictionary that `save` wrote.

    The structure and the functions are those of `like`, a state from the method's `init`.

    Raises:
        OtherState: The file holds the state of another method, setting or version.
        MadocError: It is missing or damaged.
    """
    if path.exists() and not path.is_file():
        raise MadocError(f"{path} is no regular file; restore it from a copy or start a new run")
    try:
        with zipfile.ZipFile(path) as archive:
            about = json.loads(archive.read("checkpoint.json"))
            if about["format"] != FORMAT:
                raise OtherState(f"{path} has format {about['format']}, expected {FORMAT}; written by another madoc")
            saved = {name: Leaf(**leaf | {"shape": tuple(leaf["shape"])}) for name, leaf in about["leaves"].items()}
            wanted = {name: leaf for name, leaf in layout(like).items() if leaf.kind != "static"}
            problem = difference(saved, wanted)
            if problem:
                raise OtherState(f"{path} does not fit this method: {problem}; different settings or another version?")
            leaves = [
                _restore(archive, name, saved[name], about["values"]) if name in saved else leaf
                for name, leaf in _leaves(like)
            ]
    except MadocError:
        raise
    except FileNotFoundError as error:
        raise MadocError(f"there is no checkpoint {path}") from error
    except Exception as error:  # damage shows as any of a dozen types, from BadZipFile to MemoryError
        raise MadocError(f"{path} is damaged ({error}); restore it from a copy or start a new run") from error
    return jax.tree.unflatten(jax.tree.structure(like), leaves), about["extra"]


def _leaves(state: object) -> list[tuple[str, object]]:
    """The leaves of a state with their paths."""
    return [("state" + jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree.leaves_with_path(state)]


def _describe(path: str, leaf: object) -> Leaf:
    """The type of a leaf."""
    if isinstance(leaf, jax.Array):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return Leaf("key", str(jax.random.key_impl(leaf)), leaf.shape)
        return Leaf("jax", leaf.dtype.name, leaf.shape, bool(leaf.aval.weak_type))
    if isinstance(leaf, np.ndarray | np.generic):
        if leaf.dtype.hasobject or leaf.dtype.names or np.dtype(leaf.dtype.name) != leaf.dtype:
            raise MadocError(f"cannot save {path}: NumPy dtype {leaf.dtype!r}; expected plain native numbers")
        return Leaf("numpy" if isinstance(leaf, np.ndarray) else "scalar", leaf.dtype.name, leaf.shape)
    if type(leaf) in (bool, int, float, str):
        return Leaf("value", type(leaf).__name__)
    if callable(leaf):
        return Leaf("static")
    raise MadocError(
        f"cannot save {path}: a {type(leaf).__name__};"
        " expected an array, a random key, a number, a string or a function"
    )


def _to_numpy(leaf: object) -> np.ndarray:
    """The numbers of a leaf in a dtype that the npy format knows."""
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    array = np.asarray(leaf)
    foreign = np.dtype(array.dtype.str) != array.dtype  # bfloat16 and the like: npy would forget what they are
    return array.view(f"u{array.dtype.itemsize}") if foreign else array


def _restore(archive: zipfile.ZipFile, name: str, leaf: Leaf, values: dict[str, str]) -> object:
    """A leaf from its member of the archive, or from the values."""
    if leaf.kind == "value":
        return _READERS[leaf.dtype](values[name])
    with archive.open(f"{name}.npy") as member:
        array = np.lib.format.read_array(member, allow_pickle=False)
    if leaf.kind == "key":
        return jax.random.wrap_key_data(jnp.asarray(array), impl=leaf.dtype)
    array = array.view(np.dtype(leaf.dtype))
    if array.shape != leaf.shape:
        raise ValueError(f"{name} has shape {array.shape}, recorded as {leaf.shape}")
    if leaf.kind != "jax":
        return array if leaf.kind == "numpy" else array[()]
    weak = jnp.full(leaf.shape, array.dtype.type(0).item())
    return weak.at[...].set(array) if leaf.weak and weak.dtype == array.dtype else jnp.asarray(array)
