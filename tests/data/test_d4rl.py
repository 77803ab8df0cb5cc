import numpy as np
import pytest
from layouts import REAL, d4rl_arrays, make_dataset, write_hdf5

from madoc import tasks
from madoc.data import load
from madoc.data.d4rl import count_time_limits
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
