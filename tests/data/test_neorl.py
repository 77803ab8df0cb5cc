from dataclasses import replace

import numpy as np
import pytest
from layouts import make_dataset, neorl_arrays, write_npz

from madoc.data import load
from madoc.errors import MadocError


@pytest.mark.parametrize("name", ["hopper", "ant"])
def test_the_root_is_dropped_and_time_limits_are_no_falls(request, tmp_path, name):
    task = request.getfixturevalue(name)
    dataset = make_dataset(task)
    arrays = neorl_arrays(dataset)
    if name == "ant":
        for key in ("obs", "next_obs"):
            arrays[key] = np.hstack([arrays[key][:, :1], arrays[key]])
    loaded = load(write_npz(tmp_path / "made.npz", arrays), task)
    for field, values in vars(dataset.transitions).items():
        np.testing.assert_array_equal(getattr(loaded.transitions, field), values, err_msg=field)
    np.testing.assert_array_equal(np.flatnonzero(loaded.transitions.terminated), [6])
    np.testing.assert_array_equal(np.flatnonzero(loaded.transitions.truncated), [3, 11, 13])
    np.testing.assert_array_equal(loaded.episode_starts, dataset.episode_starts)
    assert loaded.physics == "legacy"


@pytest.mark.parametrize("index", [[0, 4, 7, 12], [4, 7, 12, 14], [0, 4, 7, 12, 14], [4, 12]])
def test_index_holds_starts_or_ends(hopper, tmp_path, index):
    arrays = neorl_arrays(make_dataset(hopper)) | {"index": np.array(index)}
    loaded = load(write_npz(tmp_path / "made.npz", arrays), hopper)
    np.testing.assert_array_equal(loaded.episode_starts, [0, 4, 7, 12])


def test_an_episode_that_index_ends_without_done_is_truncated(hopper, tmp_path):
    arrays = neorl_arrays(make_dataset(hopper))
    arrays["done"] = np.zeros_like(arrays["done"])
    loaded = load(write_npz(tmp_path / "made.npz", arrays), hopper)
    np.testing.assert_array_equal(np.flatnonzero(loaded.transitions.truncated), [3, 6, 11, 13])
    assert not loaded.transitions.terminated.any()


def test_refusals(hopper, tmp_path):
    arrays = neorl_arrays(make_dataset(hopper))
    nan = arrays["next_obs"].copy()
    nan[3, 0] = 0.0
    nan[3, 4] = np.inf
    cases = {
        r"expected 12 values .* hopper \(NeoRL keeps .* got 11 in row 0 of next_obs": {"next_obs": np.zeros((14, 11))},
        "got 13 in row 0 of obs; is this file of hopper": {"obs": np.zeros((14, 13))},
        "got inf in row 3 of next_obs": {"next_obs": nan},
        "3 values per action for hopper, got 6 in row 0 of action": {"action": np.zeros((14, 6))},
        "as many rows in reward as in obs, got 13 and 14": {"reward": np.zeros((13, 1))},
        "row numbers from 0 to 14, got 15 in row 1 of index": {"index": np.array([4, 15])},
        "got 0.5 in row 0 of done": {"done": np.full((14, 1), 0.5)},
    }
    for sentence, change in cases.items():
        with pytest.raises(MadocError, match=sentence):
            load(write_npz(tmp_path / "made.npz", arrays | change), hopper)
    with pytest.raises(MadocError, match=r"falls and time limits of a NeoRL file cannot be distinguished"):
        load(write_npz(tmp_path / "made.npz", arrays), replace(hopper, state_from_observation=None))
    with pytest.raises(MadocError, match="at least one transition"):
        empty = {name: values[:0] for name, values in arrays.items()}
        load(write_npz(tmp_path / "made.npz", empty), hopper)


@pytest.mark.parametrize("missing", ["action", "reward", "done", "index"])
def test_a_missing_array_is_named(hopper, tmp_path, missing):
    arrays = neorl_arrays(make_dataset(hopper))
    del arrays[missing]
    with pytest.raises(MadocError, match=f"no array '{missing}' in .*made.npz, there is: .*obs"):
        load(write_npz(tmp_path / "made.npz", arrays), hopper)


def test_pickled_objects_are_never_read(hopper, tmp_path):
    arrays = neorl_arrays(make_dataset(hopper)) | {"done": np.array([{"a": 1}] * 14, dtype=object)}
    path = tmp_path / "made.npz"
    np.savez(path, allow_pickle=True, **arrays)
    with pytest.raises(MadocError, match=r"cannot read .*made.npz as npz .*Python objects"):
        load(path, hopper)
