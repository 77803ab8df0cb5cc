import sys

import h5py
import numpy as np
import pytest
from layouts import make_dataset, write_minari

from madoc.data import load
from madoc.errors import MadocError


@pytest.fixture(autouse=True)
def minari_home(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "home"))
    return tmp_path / "home"


def test_a_directory_or_its_data_folder(hopper, tmp_path):
    dataset = make_dataset(hopper)
    folder = write_minari(tmp_path / "made", dataset)
    for path in (folder, folder / "data"):
        loaded = load(path, hopper)
        for field, values in vars(dataset.transitions).items():
            np.testing.assert_array_equal(getattr(loaded.transitions, field), values, err_msg=field)
        np.testing.assert_array_equal(loaded.episode_starts, dataset.episode_starts)


def test_an_id_on_this_machine(hopper, minari_home):
    write_minari(minari_home / "mujoco" / "hopper" / "made-v0", make_dataset(hopper))
    loaded = load("mujoco/hopper/made-v0", hopper)
    assert len(loaded) == 14
    assert loaded.origin == "mujoco/hopper/made-v0"


@pytest.mark.parametrize(
    ("environment", "physics"), [("Hopper-v5", "modern"), ("Hopper-v2", "legacy"), (None, "unknown")]
)
def test_physics_is_that_of_the_environment(hopper, tmp_path, environment, physics):
    folder = write_minari(tmp_path / "made", make_dataset(hopper), environment=environment)
    assert load(folder, hopper).physics == physics


def test_ant_v5_keeps_the_state_without_contact_forces(ant, tmp_path):
    dataset = make_dataset(ant)
    loaded = load(write_minari(tmp_path / "made", dataset, widen=78), ant)
    np.testing.assert_array_equal(loaded.transitions.observation, dataset.transitions.observation)
    np.testing.assert_array_equal(loaded.transitions.next_observation, dataset.transitions.next_observation)


def test_nothing_is_fetched_unless_asked(hopper, monkeypatch):
    import minari

    def refuse(*_arguments, **_options):
        raise ConnectionError("no network here")

    monkeypatch.setattr(minari.storage.hosting, "download_dataset", refuse)
    with pytest.raises(MadocError, match=r"no Minari dataset on this machine, is called mujoco/hopper/none-v0"):
        load("mujoco/hopper/none-v0", hopper)
    with pytest.raises(MadocError, match=r"cannot download .*'mujoco/hopper/none-v0' \(no network here\)"):
        load("mujoco/hopper/none-v0", hopper, download=True)


def test_download_is_for_ids_only(hopper, tmp_path):
    (tmp_path / "made.npz").write_bytes(b"PK")
    with pytest.raises(MadocError, match=r"only Minari ids can be downloaded, got .*made.npz of format d4rl"):
        load(tmp_path / "made.npz", hopper, format="d4rl", download=True)


def test_a_missing_library_names_its_install_command(hopper, tmp_path, monkeypatch):
    folder = write_minari(tmp_path / "made", make_dataset(hopper))
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(MadocError, match=r'pip install "minari\[hdf5\]"'):
        load(folder, hopper)


def test_refusals(hopper, ant, tmp_path):
    dataset = make_dataset(hopper)
    folder = write_minari(tmp_path / "made", dataset)
    with pytest.raises(MadocError, match="27 values per observation for ant, got 11 in row 0 of observations"):
        load(folder, ant)
    with pytest.raises(MadocError, match="got 12 in row 0 of observations"):
        load(write_minari(tmp_path / "wide", dataset, widen=1), hopper)
    (tmp_path / "other").mkdir()
    with pytest.raises(MadocError, match=r"other is no Minari dataset: there is no metadata.json"):
        load(tmp_path / "other", hopper, format="minari")


def edit(folder, change):
    with h5py.File(folder / "data" / "main_data.hdf5", "r+") as file:
        change(file["episode_2"])
    return folder


def shorten(name):
    def change(group):
        values = group[name][:-1]
        del group[name]
        group[name] = values

    return change


def test_broken_episodes_are_refused(hopper, tmp_path):
    def narrow(group):
        values = group["actions"][:, :2]
        del group["actions"]
        group["actions"] = values

    cases = {
        "one more observation than rewards, and a reward, got 5 and 5 in episode 2": shorten("observations"),
        "as many rows in actions as in rewards, got 4 and 5": shorten("actions"),
        "as many rows in truncations as in rewards, got 4 and 5": shorten("truncations"),
        "expected 3 values per row of actions in every episode, got 2 in episode 2": narrow,
        "cannot read the Minari dataset": lambda group: group.pop("rewards"),
    }
    for number, (sentence, change) in enumerate(cases.items()):
        folder = write_minari(tmp_path / str(number), make_dataset(hopper))
        with pytest.raises(MadocError, match=sentence):
            load(edit(folder, change), hopper)


def test_damage_is_refused(hopper, tmp_path):
    folder = write_minari(tmp_path / "made", make_dataset(hopper))
    data = folder / "data" / "main_data.hdf5"
    whole = data.read_bytes()
    data.write_bytes(whole[:3000])
    with pytest.raises(MadocError, match=r"cannot read .*main_data.hdf5 as HDF5 .*damaged"):
        load(folder, hopper)
    data.write_bytes(whole)
    (folder / "data" / "metadata.json").write_text("{")
    with pytest.raises(MadocError, match=r"cannot read the Minari dataset in .*JSONDecodeError"):
        load(folder, hopper)
