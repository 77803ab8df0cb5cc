"""The YAML of a spec: what is no such file, how mistakes are counted, how words and numbers are read."""

import pytest

from madoc import robots
from madoc.errors import MadocError
from own_robots import ARM_SPEC, CART_SPEC, write_robot


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "robot.yaml is empty; write one with: madoc init MODEL"),
        (b"# nothing\n", "robot.yaml is empty"),
        (b"just words", "line 1: expected keys and values"),
        (b"[1, 2]", "line 1: expected keys and values"),
        (b"a: 1\n\tb: 2", "line 2: this is not YAML"),
        (b"a: [1, 2", "line 1: this is not YAML"),
        (b"a: &x 1\nb: *x", "line 1: anchors and aliases"),
        (b"a: !!python/object:os.system {}", "line 1: expected a plain value, got the tag"),
        (b"a: !mine 1", "line 1: expected a plain value, got the tag !mine"),
        (b"a: 1\n---\nb: 2", "line 2: this is not YAML"),
        (b"? [a]\n: 1", "line 1: expected a word before the colon"),
        (b"name: caf\xe9\n", "line 1: expected text in UTF-8, got byte 0xe9"),
        (b"\n\na: \x00", "this is not YAML"),
        (b"[" * 5000, "line 1: nested more than 20 deep"),
        (b"a: " + b"[" * 30 + b"]" * 30, "line 1: nested more than 20 deep"),
        (b"#" * 200_001, "has 200,001 bytes, a robot's spec at most 200,000"),
    ],
)
def test_what_is_no_yaml_of_ours(tmp_path, content, sentence):
    path = tmp_path / "robot.yaml"
    path.write_bytes(content)
    with pytest.raises(MadocError, match=sentence) as refusal:
        robots.load(path)
    assert "\n" not in str(refusal.value)


def test_several_mistakes_are_counted(tmp_path):
    spec = ARM_SPEC.replace("low: 0,", "low: no,").replace("groups: 2", "groups: x")
    with pytest.raises(MadocError, match=r"line 17: expected a number in parameters.low, got 'no' \(and 2 more\)"):
        robots.load(write_robot(tmp_path, spec))


def test_numbers_and_words_are_those_of_yaml_1_2(tmp_path):
    spec = CART_SPEC.replace("low: 0.5, high: 2", "low: 5e-1, high: 2E+0").replace("name: place", "name: on")
    task = robots.load(write_robot(tmp_path, spec)).task
    assert task.signals == ("on", "speed")
    assert (task.parameters.low, task.parameters.high) == (0.5, 2.0)
