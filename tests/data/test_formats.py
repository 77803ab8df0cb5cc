import jax
import numpy as np
import pytest
from layouts import d4rl_arrays, make_dataset, write, write_hdf5

from madoc.data import FORMATS, load
from madoc.data.formats import recognise
from madoc.errors import MadocError


@pytest.mark.parametrize("form", list(FORMATS))
def test_every_format_is_recognised(hopper, tmp_path, form):
    assert recognise(write(form, tmp_path, make_dataset(hopper))) == form


@pytest.mark.parametrize("form", list(FORMATS))
def test_the_same_transitions_and_key_give_the_same_rows_in_every_format(hopper, tmp_path, form):
    dataset = make_dataset(hopper, lengths=(5, 2, 6, 3, 4, 7), falls=(0, 4))
    path = write(form, tmp_path, dataset)
    drawn = load(path, hopper, max_transitions=11, key=jax.random.key(7))
    expected = load(write("madoc", tmp_path, dataset), hopper, max_transitions=11, key=jax.random.key(7))
    assert len(drawn) == 11
    for field, values in vars(expected.transitions).items():
        np.testing.assert_array_equal(getattr(drawn.transitions, field), values, err_msg=field)
    np.testing.assert_array_equal(drawn.episode_starts, expected.episode_starts)


@pytest.mark.parametrize("form", list(FORMATS))
def test_no_format_pairs_observations_of_two_episodes(hopper, tmp_path, form):
    loaded = load(write(form, tmp_path, make_dataset(hopper)), hopper)
    rows = loaded.transitions
    for start, end in zip(loaded.episode_starts, loaded.episode_ends, strict=True):
        np.testing.assert_array_equal(rows.next_observation[start : end - 1], rows.observation[start + 1 : end])
        assert (rows.terminated | rows.truncated)[start:end].nonzero()[0].tolist() == [end - start - 1]


def test_the_content_counts_not_the_name(hopper, tmp_path):
    path = write_hdf5(tmp_path / "data.npz", d4rl_arrays(make_dataset(hopper)))
    assert len(load(str(path), hopper)) == 14


def test_an_explicit_format_overrides_the_glance(hopper, tmp_path):
    path = write("neorl", tmp_path, make_dataset(hopper))
    with pytest.raises(MadocError, match=r"cannot read .*neorl.npz as HDF5"):
        load(path, hopper, format="d4rl")
    with pytest.raises(MadocError, match=r"no array 'observation' in .*neorl.npz"):
        load(path, hopper, format="madoc")
    path = write("d4rl", tmp_path, make_dataset(hopper))
    with pytest.raises(MadocError, match=r"made-v2.hdf5 is not an npz file"):
        load(path, hopper, format="neorl")


@pytest.mark.parametrize("form", [None, *FORMATS])
def test_what_is_not_there_is_refused(hopper, tmp_path, form):
    with pytest.raises(MadocError, match=r"no file .*missing.npz"):
        load(tmp_path / "missing.npz", hopper, format=form)


@pytest.mark.parametrize("form", [None, "d4rl", "neorl", "madoc"])
def test_a_directory_and_an_empty_file_are_refused(hopper, tmp_path, form):
    with pytest.raises(MadocError, match="expected a file, got the directory"):
        load(tmp_path, hopper, format=form)
    (tmp_path / "empty.npz").touch()
    with pytest.raises(MadocError, match=r"empty.npz is empty"):
        load(tmp_path / "empty.npz", hopper, format=form)


def test_unknown_formats_are_refused_with_a_list(hopper, tmp_path):
    (tmp_path / "data.csv").write_text("a,b\n1,2\n")
    with pytest.raises(MadocError, match=r"format of .*data.csv; pass --format with one of: d4rl .*madoc"):
        load(tmp_path / "data.csv", hopper)
    with pytest.raises(MadocError, match="unknown format 'csv'; there are: d4rl, neorl, minari, madoc"):
        load(tmp_path / "data.csv", hopper, format="csv")
    np.savez(tmp_path / "other.npz", states=np.zeros(3))
    with pytest.raises(MadocError, match=r"cannot tell the format of .*other.npz"):
        load(tmp_path / "other.npz", hopper)


def test_drawing_needs_a_key(hopper, tmp_path):
    with pytest.raises(MadocError, match="needs a key, got none"):
        load(write("madoc", tmp_path, make_dataset(hopper)), hopper, max_transitions=3)
