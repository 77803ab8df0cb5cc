"""A joint distribution of calibrated models as a table of draws, and the source of a function that puts one to use.

Ranges lose how parameters depend on each other, and stock randomization draws each by itself. A table of draws keeps
it: a row is one model.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Num

from madoc.runs.files import replacing

SOURCE = '''"""Draws of a calibrated model: a row of draws.npz is a model out of the joint distribution of its estimate.

`model` is a mujoco.MjModel of model.xml beside this file. Whole rows are put in, so that parameters keep their
correlations, and so do the constants that MuJoCo derives from them: mj_setConst need not be called.
"""

from functools import cache
from pathlib import Path

import numpy as np

TABLE = Path(__file__).with_name("draws.npz")


@cache
def read(table=TABLE):
    """The table, read once: arrays by name."""
    with np.load(table) as stored:
        return {name: stored[name] for name in stored.files}


def count(table=TABLE):
    """How many draws there are."""
    return len(read(table)["values"])


def around(table=TABLE):
    """Names of the parameters that are not in a model: delays in s, biases of sensors."""
    return read(table)["around"].tolist()


def put(model, row, table=TABLE):
    """Put one draw into a mujoco.MjModel, and return the values of its parameters by name.

    Those of `around` are not in a model: put them around it.
    """
    stored = read(table)
    for field in stored["fields"]:
        owner, name = (model.opt, "gravity") if field == "opt.gravity" else (model, field)
        getattr(owner, name).reshape(-1)[stored[f"places/{field}"]] = stored[f"numbers/{field}"][row]
    return dict(zip(stored["names"].tolist(), stored["values"][row].tolist()))


def randomized(environment, table=TABLE):
    """A Gymnasium environment of MuJoCo whose model is another draw in every episode."""
    import gymnasium

    class Randomized(gymnasium.Wrapper):
        random = np.random.default_rng()

        def reset(self, *, seed=None, options=None):
            if seed is not None:
                self.random = np.random.default_rng(seed)
            put(self.unwrapped.model, self.random.integers(count(table)), table)
            return super().reset(seed=seed, options=options)

    return Randomized(environment)


def domain_randomize(model, rng, table=TABLE):
    """Batched models for MuJoCo Playground 0.2: a row for each key of `rng`, as (model, in_axes) of an mjx.Model."""
    import jax
    import jax.numpy as jnp

    stored = read(table)
    rows = jax.vmap(lambda key: jax.random.randint(key, (), 0, len(stored["values"])))(rng)
    changed = {}
    for field in stored["fields"].tolist():
        part = model.opt.gravity if field == "opt.gravity" else getattr(model, field, None)
        numbers = stored[f"numbers/{field}"]
        if part is None or numbers.dtype.kind != "f":
            continue  # MJX has no boxes for finding contacts, and its whole numbers are fixed
        drawn = jnp.asarray(numbers, part.dtype)[rows]
        flat = jnp.broadcast_to(jnp.asarray(part).reshape(-1), (len(rows), part.size))
        changed[field] = flat.at[:, stored[f"places/{field}"]].set(drawn).reshape(len(rows), *part.shape)
    in_axes = jax.tree_util.tree_map(lambda part: None, model).tree_replace({field: 0 for field in changed})
    return model.tree_replace(changed), in_axes
'''
"""The file `draws.py` of an export: it needs NumPy alone, JAX for Playground, and Gymnasium for its environments."""


def save_draws(
    folder: Path,
    names: Sequence[str],
    around: Sequence[str],
    values: Float[np.ndarray, "draws parameters"],
    numbers: Mapping[str, tuple[Int[np.ndarray, " numbers"], Num[np.ndarray, "draws numbers"]]],
) -> tuple[Path, Path]:
    """Write `draws.npz` and `draws.py` into a folder: the values of every draw, in the units of the parameters.

    Of the parameters, those `around` are not in a model; `numbers` are, by array of the model, the places that change
    and their numbers in every draw.
    """
    table, source = folder / "draws.npz", folder / "draws.py"
    stored = {"names": np.array(names), "around": np.array(around, dtype=str), "values": values}
    stored["fields"] = np.array(list(numbers), dtype=str)
    for field, (places, rows) in numbers.items():
        stored |= {f"places/{field}": places, f"numbers/{field}": rows}
    with replacing(table) as stream:
        np.savez_compressed(stream, allow_pickle=False, **stored)
    with replacing(source) as stream:
        stream.write(SOURCE.encode())
    return table, source
