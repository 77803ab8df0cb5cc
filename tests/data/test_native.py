import json
from dataclasses import replace

import numpy as np
import pytest
from layouts import make_dataset, with_fields

from madoc.data import load, native, save
from madoc.errors import MadocError


def test_what_is_saved_comes_back_bit_for_bit(hopper, tmp_path):
    truth = {"gravity": -9.81, "body_mass.torso": 0.1 + 0.2}
    dataset = replace(make_dataset(hopper), physics="modern", true_parameters=truth)
    save(dataset, tmp_path / "made.npz")
    loaded = load(tmp_path / "made.npz", hopper)
    for field, values in vars(dataset.transitions).items():
        np.testing.assert_array_equal(getattr(loaded.transitions, field), values, err_msg=field)
    np.testing.assert_array_equal(loaded.episode_starts, dataset.episode_starts)
    same = {name: getattr(dataset, name) for name in ("transitions", "episode_starts")}
    assert vars(replace(loaded, **same)) == vars(dataset)
    assert [path.name for path in tmp_path.iterdir()] == ["made.npz"]


def test_metadata_is_readable_by_hand_and_has_units(hopper, tmp_path):
    truth = {"gravity": -9.81, "body_mass.torso": 3.5, "mystery.x": 1.0}
    save(replace(make_dataset(hopper), true_parameters=truth), tmp_path / "made.npz")
    with np.load(tmp_path / "made.npz", allow_pickle=False) as archive:
        metadata = json.loads(str(archive["metadata"]))
    assert metadata["version"] == 1
    assert metadata["parameter_units"] == {"gravity": "m/s²", "body_mass.torso": "kg", "mystery.x": ""}


def test_a_failed_write_leaves_what_was_there(hopper, tmp_path, monkeypatch):
    target = tmp_path / "made.npz"
    save(make_dataset(hopper), target)
    before = target.read_bytes()

    def disk_full(stream, **_arrays):
        stream.write(b"PK half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(native.np, "savez", disk_full)
    with pytest.raises(MadocError, match=r"could not write .*made.npz: No space left"):
        save(make_dataset(hopper, seed=1), target)
    assert target.read_bytes() == before
    with pytest.raises(MadocError, match="No space left"):
        save(make_dataset(hopper), tmp_path / "other.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["made.npz"]


def test_objects_are_not_written(hopper, tmp_path):
    with pytest.raises(ValueError, match="Object arrays"):
        save(with_fields(make_dataset(hopper), reward=np.array([object()] * 14)), tmp_path / "made.npz")
    assert not list(tmp_path.iterdir())


def test_where_to_write_is_checked(hopper, tmp_path):
    with pytest.raises(MadocError, match="expected a file to write to, got the directory"):
        save(make_dataset(hopper), tmp_path)
    with pytest.raises(MadocError, match=r"no folder .*nowhere to write made.npz into"):
        save(make_dataset(hopper), tmp_path / "nowhere" / "made.npz")


def rewrite(path, **changes):
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays |= changes
    np.savez(path, **{name: values for name, values in arrays.items() if values is not None})


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"metadata": np.array('{"version": 7}')}, r"expected file version 1, got 7 in .*made.npz"),
        ({"metadata": np.array("{")}, r"metadata of .*made.npz cannot be read"),
        ({"metadata": np.array("[]")}, r"metadata of .*made.npz cannot be read"),
        ({"metadata": np.array('{"version": 1}')}, r"metadata of .*made.npz cannot be read \(.*task_name"),
        ({"reward": None}, r"no array 'reward' in .*made.npz"),
        ({"reward": np.zeros(3)}, "as many rows in reward as in observation, got 3 and 14"),
        ({"episode_starts": np.array([0.0, np.nan])}, "row numbers in episode_starts"),
        ({"episode_starts": np.array([0, 99])}, "ascending episode starts from 0 to below 14"),
    ],
)
def test_a_damaged_file_is_refused(hopper, tmp_path, change, sentence):
    save(make_dataset(hopper), tmp_path / "made.npz")
    rewrite(tmp_path / "made.npz", **change)
    with pytest.raises(MadocError, match=sentence):
        load(tmp_path / "made.npz", hopper, format="madoc")


def test_data_of_another_task_is_refused(hopper, ant, tmp_path):
    save(make_dataset(hopper), tmp_path / "made.npz")
    with pytest.raises(MadocError, match="expected data of ant, got data of hopper"):
        load(tmp_path / "made.npz", ant)


@pytest.mark.parametrize("part", [0.1, 0.5, 0.99])
def test_a_file_cut_short_is_refused(hopper, tmp_path, part):
    path = tmp_path / "made.npz"
    save(make_dataset(hopper), path)
    path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
    for form in (None, "madoc", "neorl"):
        with pytest.raises(MadocError, match=r"cannot read .*made.npz as npz .*cut short"):
            load(path, hopper, format=form)


def test_a_flipped_byte_is_refused(hopper, tmp_path):
    path = tmp_path / "made.npz"
    save(make_dataset(hopper), path)
    content = bytearray(path.read_bytes())
    content[400] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(MadocError, match=r"cannot read .*made.npz as npz"):
        load(path, hopper)
