import random
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from madoc.errors import MadocError
from madoc.runs import checkpoint


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Everything:
    network: Any
    arrays: Any
    values: Any


def everything(seed=0):
    key = jax.random.key(seed)
    return Everything(
        eqx.nn.MLP(3, 2, 4, 1, key=key),
        {
            "bfloat16": jnp.arange(3, dtype=jnp.bfloat16) + seed,
            "float8": jnp.ones((2, 2), jnp.float8_e4m3fn) + seed,
            "bool": jnp.array([True, bool(seed)]),
            "weak": jnp.full((3,), 0.5 + seed),
            "weak int": jnp.asarray(seed),
            "negative zero": jnp.full((2,), -0.0 if seed else 0.0),
            "keys": jax.random.split(key, 3),
            "rbg": jax.random.key(seed, impl="rbg"),
            "numpy": np.arange(6.0).reshape(2, 3) + seed,
            "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3) + seed),
            "empty": np.zeros((0, 3), np.int16),
            "scalar": np.float64(seed + 0.1),
        },
        [seed + 2**100, seed + 0.1, bool(seed), f"text {seed}", None],
    )


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert type(x) is type(y)
        if isinstance(x, jax.Array | np.ndarray | np.generic):
            assert (x.dtype, x.shape) == (y.dtype, y.shape)
            assert getattr(x, "weak_type", None) == getattr(y, "weak_type", None)
            if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
                assert np.array_equal(jax.random.key_data(x), jax.random.key_data(y))
            else:
                assert np.asarray(x).tobytes() == np.asarray(y).tobytes()
        else:
            assert x == y


def test_every_kind_of_leaf_comes_back(tmp_path):
    checkpoint.save(tmp_path / "c.npz", everything(1), {"seconds": 1.5})
    state, extra = checkpoint.load(tmp_path / "c.npz", everything(0))
    assert_same(state, everything(1))
    assert extra == {"seconds": 1.5}
    assert isinstance(state.arrays["numpy"], np.ndarray)
    assert state.arrays["numpy"].flags.writeable


def test_equal_states_give_equal_files_and_nothing_else(tmp_path):
    for name in "ab":
        checkpoint.save(tmp_path / name, everything(), {})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a", "b"]


def test_leaves_can_be_read_with_numpy_alone(tmp_path):
    checkpoint.save(tmp_path / "c.npz", {"x": np.arange(3)}, {})
    with np.load(tmp_path / "c.npz", allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["state['x']"], [0, 1, 2])


@pytest.mark.parametrize(
    ("saved", "like", "words"),
    [
        ({"a": np.zeros(3)}, {"a": np.zeros(4)}, r"expected state\['a'\] to be float64 of shape \(4,\), got"),
        ({"a": np.zeros(3)}, {"a": np.zeros(3, np.float32)}, r"to be float32 of shape \(3,\), got float64"),
        ({"a": np.zeros(3)}, {"b": np.zeros(3)}, r"expected state\['b'\] .* which is missing"),
        ({"a": 1, "b": 2}, {"a": 1}, r"got state\['b'\] \(int\), which is not expected"),
        ({"a": 1}, {"a": 1.0}, r"to be float, got int"),
        (
            {"a": jax.random.key(0)},
            {"a": jax.random.key(0, impl="rbg")},
            "random key rbg .* got random key thr",
        ),
    ],
)
def test_a_state_of_another_layout_is_refused(tmp_path, saved, like, words):
    checkpoint.save(tmp_path / "c.npz", saved, {})
    with pytest.raises(MadocError, match=rf"does not fit this method: .*{words}"):
        checkpoint.load(tmp_path / "c.npz", like)


@pytest.mark.parametrize(
    "leaf", [object(), np.array([None]), np.zeros(2, "i4,f4"), np.random.default_rng(0), 1j, b"bytes"]
)
def test_a_leaf_that_would_be_lost_is_refused(tmp_path, leaf):
    with pytest.raises(MadocError, match=r"cannot save state\['a'\]"):
        checkpoint.save(tmp_path / "c.npz", {"a": leaf}, {})
    assert not list(tmp_path.iterdir())


def test_a_failed_save_keeps_the_file_before(tmp_path):
    checkpoint.save(tmp_path / "c.npz", {"a": 1}, {})
    before = (tmp_path / "c.npz").read_bytes()
    with pytest.raises(MadocError, match=r"c\.npz\.extra\.seconds is nan, expected a finite number"):
        checkpoint.save(tmp_path / "c.npz", {"a": 2}, {"seconds": float("nan")})
    assert (tmp_path / "c.npz").read_bytes() == before


def test_a_damaged_file_is_refused_or_harmless(tmp_path):
    path = tmp_path / "c.npz"
    state = {"a": np.arange(50.0), "key": jax.random.key(0), "n": 3}
    checkpoint.save(path, state, {"seconds": 1.0})
    whole = path.read_bytes()
    pick = random.Random(0)
    for _ in range(150):
        damaged = bytearray(whole)
        damaged[pick.randrange(len(whole))] ^= 1 << pick.randrange(8)
        path.write_bytes(damaged)
        try:
            loaded, extra = checkpoint.load(path, state)
        except MadocError:
            continue
        assert_same(loaded, state)
        assert extra == {"seconds": 1.0}
    for size in (0, 1, 30, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(MadocError, match="is damaged"):
            checkpoint.load(path, state)
    with pytest.raises(MadocError, match="there is no checkpoint"):
        checkpoint.load(tmp_path / "none.npz", state)


def test_the_first_non_finite_leaf_is_named():
    assert checkpoint.first_non_finite(everything()) is None
    assert checkpoint.first_non_finite({"a": 1, "b": jnp.array([1.0, jnp.inf])}) == "state['b']"
    assert checkpoint.first_non_finite({"a": jnp.array([jnp.nan], jnp.bfloat16)}) == "state['a']"
    assert checkpoint.first_non_finite([1.0, float("nan")]) == "state[1]"
