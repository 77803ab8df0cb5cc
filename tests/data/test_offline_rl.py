"""D4RL's and NeoRL's layouts: what is read of them, what is made up, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from layouts import REAL, d4rl_arrays, make_dataset, neorl_arrays, write_hdf5, write_npz

from madoc import tasks
from madoc.data import load
from madoc.data.offline_rl import count_time_limits
from madoc.errors import MadocError


def without(arrays, *names):
    return {name: values for name, values in arrays.items() if name not in names}


def test_v2_keeps_every_row_and_tells_falls_from_time_limits(hopper, tmp_path):
    dataset = make_dataset(hopper)
    loaded = load(write_hdf5(tmp_path / "hopper_medium-v2.hdf5", d4rl_arrays(dataset)), hopper)
    for name, values in vars(dataset.transitions).items():
        np.testing.assert_array_equal(getattr(loaded.transitions, name), values, err_msg=name)
    np.testing.assert_array_equal(loaded.episode_starts, [0, 4, 7, 12])
    np.testing.assert_array_equal(np.flatnonzero(loaded.transitions.terminated), [6])
    np.testing.assert_array_equal(np.flatnonzero(loaded.transitions.truncated), [3, 11, 13])
    assert loaded.transitions.observation.dtype == np.float64
    assert loaded.physics == "legacy"
    assert loaded.origin.endswith("hopper_medium-v2.hdf5")
    assert loaded.true_parameters is None


def test_a_name_that_is_not_d4rls_says_nothing_about_physics(hopper, tmp_path):
    arrays = d4rl_arrays(make_dataset(hopper))
    assert load(write_hdf5(tmp_path / "hopper-expert-v4.hdf5", arrays), hopper).physics == "unknown"


def test_v0_pairs_rows_within_episodes_only(hopper, tmp_path):
    dataset = make_dataset(hopper)
    arrays = without(d4rl_arrays(dataset), "next_observations")
    loaded = load(write_hdf5(tmp_path / "made.hdf5", arrays), hopper)
    kept = [0, 1, 2, 4, 5, 7, 8, 9, 10, 12]
    np.testing.assert_array_equal(loaded.transitions.reward, kept)
    expected = dataset.transitions.next_observation[kept]
    np.testing.assert_array_equal(loaded.transitions.next_observation, expected)
    np.testing.assert_array_equal(loaded.episode_starts, [0, 3, 5, 9])
    assert not loaded.transitions.terminated.any()
    np.testing.assert_array_equal(np.flatnonzero(loaded.transitions.truncated), [2, 4, 8, 9])


def test_v0_episodes_of_one_row_vanish(hopper, tmp_path):
    arrays = without(d4rl_arrays(make_dataset(hopper, lengths=(1, 3, 1, 2))), "next_observations")
    loaded = load(write_hdf5(tmp_path / "made.hdf5", arrays), hopper)
    np.testing.assert_array_equal(loaded.transitions.reward, [1, 2, 5])
    np.testing.assert_array_equal(loaded.episode_starts, [0, 2])
    arrays = without(d4rl_arrays(make_dataset(hopper, lengths=(1, 1))), "next_observations")
    with pytest.raises(MadocError, match="episodes of two rows or more, got 2 of one row"):
        load(write_hdf5(tmp_path / "short.hdf5", arrays), hopper)


def test_time_limits_are_counted_from_the_last_end():
    ends = np.zeros(9, dtype=bool)
    ends[1] = True
    np.testing.assert_array_equal(np.flatnonzero(count_time_limits(ends, 3)), [4, 7])
    assert not len(count_time_limits(np.zeros(0, dtype=bool), 3))


def test_without_timeouts_the_tasks_time_limit_ends_episodes(hopper, tmp_path):
    arrays = d4rl_arrays(make_dataset(hopper, lengths=(1000, 1000, 40, 1000), falls=(2,)))
    for missing in (without(arrays, "timeouts"), arrays | {"timeouts": np.zeros(3040, dtype=bool)}):
        loaded = load(write_hdf5(tmp_path / "made.hdf5", missing), hopper)
        np.testing.assert_array_equal(loaded.episode_starts, [0, 1000, 2000, 2040])
        np.testing.assert_array_equal(np.flatnonzero(loaded.transitions.truncated), [999, 1999, 3039])


def test_ant_of_111_values_keeps_the_state(ant, tmp_path):
    dataset = make_dataset(ant)
    arrays = d4rl_arrays(dataset)
    for name in ("observations", "next_observations"):
        arrays[name] = np.hstack([arrays[name], np.zeros((len(dataset), 84))])
    loaded = load(write_hdf5(tmp_path / "made.hdf5", arrays), ant)
    np.testing.assert_array_equal(loaded.transitions.observation, dataset.transitions.observation)
    np.testing.assert_array_equal(loaded.transitions.next_observation, dataset.transitions.next_observation)
    arrays["observations"][5, 40] = 0.25
    with pytest.raises(MadocError, match=r"zeros .* Ant of 111, got 0.25 in row 5, column 40 of observations"):
        load(write_hdf5(tmp_path / "forces.hdf5", arrays), ant)


@pytest.mark.parametrize("missing", ["observations", "actions", "rewards", "terminals"])
def test_a_missing_array_is_named(hopper, tmp_path, missing):
    path = write_hdf5(tmp_path / "made.hdf5", without(d4rl_arrays(make_dataset(hopper)), missing))
    with pytest.raises(MadocError, match=f"no array '{missing}' in .*made.hdf5, there is: .*timeouts"):
        load(path, hopper)


def test_a_group_is_no_array(hopper, tmp_path):
    arrays = without(d4rl_arrays(make_dataset(hopper)), "actions")
    path = write_hdf5(tmp_path / "made.hdf5", arrays | {"actions/left": np.zeros(3)})
    with pytest.raises(MadocError, match="no array 'actions'"):
        load(path, hopper)


def test_refusals_speak_of_the_files_own_arrays_and_rows(hopper, tmp_path):
    arrays = without(d4rl_arrays(make_dataset(hopper)), "next_observations")
    nan = arrays["observations"].copy()
    nan[8, 2] = np.nan
    cases = {
        "got nan in row 8 of observations": {"observations": nan},
        "got 12 in row 0 of observations; a NeoRL file": {"observations": np.zeros((14, 12))},
        "3 values per action for hopper, got 2 in row 0 of actions": {"actions": np.zeros((14, 2))},
        "size 3 in row 0 of actions": {"actions": np.full((14, 3), 3.0)},
        "as many rows in rewards as in observations, got 9 and 14": {"rewards": np.zeros(9)},
        "got 4 in row 0 of terminals": {"terminals": np.full(14, 4)},
        "expected numbers in rewards": {"rewards": np.array([b"a"] * 14)},
    }
    for number, (sentence, change) in enumerate(cases.items()):
        path = write_hdf5(tmp_path / f"{number}.hdf5", arrays | change)
        with pytest.raises(MadocError, match=sentence):
            load(path, hopper)


@pytest.mark.parametrize("with_next", [True, False])
def test_an_empty_file_is_refused(hopper, tmp_path, with_next):
    arrays = {name: values[:0] for name, values in d4rl_arrays(make_dataset(hopper)).items()}
    arrays = arrays if with_next else without(arrays, "next_observations")
    with pytest.raises(MadocError, match="at least one transition for hopper, got none in"):
        load(write_hdf5(tmp_path / "made.hdf5", arrays), hopper)


@pytest.mark.parametrize("part", [0.2, 0.6, 0.99])
def test_a_file_cut_short_is_refused(hopper, tmp_path, part):
    path = write_hdf5(tmp_path / "made.hdf5", d4rl_arrays(make_dataset(hopper, lengths=(200,))))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(MadocError, match=r"cannot read .*made.hdf5 as HDF5 .*cut short"):
        load(path, hopper)


@pytest.mark.parametrize("name", list(tasks.TASKS))
def test_recorded_data_loads(name):
    path = REAL / f"{name}-expert-v4.hdf5"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    task = tasks.make(name, "modern")
    with pytest.raises(MadocError, match=r"actions in \[-1, 1\].*--clip-actions"):
        load(path, task)
    dataset = load(path, task, clip_actions=True)
    assert len(dataset) == 2000
    np.testing.assert_array_equal(dataset.episode_starts, [0, 1000])
    np.testing.assert_array_equal(np.flatnonzero(dataset.transitions.truncated), [999, 1999])
    assert not dataset.transitions.terminated.any()
    assert np.abs(dataset.transitions.action).max() == 1.0


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
def test_a_missing_array_of_neorl_is_named(hopper, tmp_path, missing):
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
