import json

import pytest

from madoc.errors import MadocError
from madoc.runs.files import read_json, remove_leftovers, replacing, write_json


def test_json_round_trip(tmp_path):
    value = {"a": [1, 2.5, None, True], "µ": {"b": "text"}}
    write_json(tmp_path / "a.json", value)
    assert read_json(tmp_path / "a.json") == value


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"a": {"b": [1.0, float("inf")]}}, r"x\.json\.a\.b\[1\] is inf, expected a finite number"),
        ({"a": {1, 2}}, r"x\.json\.a is a set, expected a number, string"),
        ({"a": {(1, 2): 3}}, r"x\.json\.a has the key \(1, 2\), expected a string"),
    ],
)
def test_json_refuses_what_it_has_no_word_for(tmp_path, value, words):
    with pytest.raises(MadocError, match=words):
        write_json(tmp_path / "x.json", value)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_changes_nothing(tmp_path):
    path = tmp_path / "a"
    path.write_text("before")
    with pytest.raises(KeyError), replacing(path) as stream:
        stream.write(b"half")
        raise KeyError("midway")
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_the_disk_says_no(tmp_path):
    with pytest.raises(MadocError, match=r"could not write .*No such file"):
        write_json(tmp_path / "missing" / "a.json", 1)
    with pytest.raises(MadocError, match=r"could not read .*No such file"):
        read_json(tmp_path / "a.json")
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(MadocError, match="is not valid JSON"):
        read_json(tmp_path / "a.json")


def test_leftovers_go_and_the_rest_stays(tmp_path):
    (tmp_path / ".a.json.17.tmp").write_text("half")
    (tmp_path / "mine.tmp").write_text(json.dumps(1))
    remove_leftovers(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["mine.tmp"]
