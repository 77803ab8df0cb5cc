"""A ring buffer of rows on the device, written by jitted calls and sampled inside jitted updates."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, PRNGKeyArray


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Replay:
    """The last `capacity` rows of named columns, float32 on the device.

    Attributes:
        rows: Columns of shape (capacity, ...).
        written: How many rows were ever written.
    """

    rows: dict[str, Array]
    written: Int[Array, ""]

    @property
    def capacity(self) -> int:
        """Rows it can hold."""
        return jax.tree.leaves(self.rows)[0].shape[0]


def empty(capacity: int, **columns: tuple[int, ...]) -> Replay:
    """A replay of named columns, each given by the shape of one row; () is a scalar."""
    rows = {name: jnp.zeros((capacity, *shape), jnp.float32) for name, shape in columns.items()}
    return Replay(rows, jnp.zeros((), jnp.int32))


@partial(jax.jit, donate_argnums=0)
def add(replay: Replay, rows: Mapping[str, Array | np.ndarray], valid: Bool[Array, " batch"]) -> Replay:
    """Write the valid rows of a batch over the oldest ones. The replay given is consumed."""
    position = replay.written + jnp.cumsum(valid) - 1
    written = replay.written + valid.sum(dtype=jnp.int32)
    # Of rows that would land on one place only the last is written: a scatter's order is undefined.
    kept = valid & (position >= written - replay.capacity)
    index = jnp.where(kept, position % replay.capacity, replay.capacity)
    ring = jax.tree.map(lambda column, new: column.at[index].set(new, mode="drop"), replay.rows, rows)
    return Replay(ring, written)


def clear(replay: Replay) -> Replay:
    """The same buffer without rows."""
    return Replay(replay.rows, jnp.zeros((), jnp.int32))


def sample(replay: Replay, key: PRNGKeyArray, *shape: int) -> dict[str, Array]:
    """Rows drawn uniformly with replacement, with leading axes of this shape."""
    return take(replay.rows, draw(replay, key, *shape))


def draw(replay: Replay, key: PRNGKeyArray, *shape: int) -> Int[Array, "..."]:
    """Indices of rows, uniform with replacement: drawing those of many updates together is faster."""
    return jax.random.randint(key, shape, 0, jnp.minimum(replay.written, replay.capacity))


def take(rows: Mapping[str, Array], index: Int[Array, "..."]) -> dict[str, Array]:
    """The rows of every column at these indices."""
    return {name: column[index] for name, column in rows.items()}


def flatten_rows(column: np.ndarray, leading: int) -> np.ndarray:
    """Merge the first `leading` axes of a float column; for replay, in float32."""
    return np.asarray(column.reshape(-1, *column.shape[leading:]), dtype=np.float32)
