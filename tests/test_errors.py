"""Sentences of errors."""

import pytest

from madoc.errors import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("left knee, 0.5 N·m/rad – ok", "left knee, 0.5 N·m/rad – ok"),
        ("two\nlines\tof text", "two\nlines\tof text"),
        ("\x1b[31mred", "\\u001b[31mred"),
        ("knee\u202eeenk", "knee\\u202eeenk"),
        ("a\x85b\u2066c\ufeff", "a\\u0085b\\u2066c\\ufeff"),
    ],
)
def test_what_a_terminal_or_a_page_would_obey_is_written_as_a_number(text, shown):
    assert printable(text) == shown
