import io
import sys

import pytest

from madoc.runs import progress
from madoc.runs.progress import Moment


class Terminal(io.StringIO):
    def isatty(self):
        return True


def work(quiet=False):
    with progress.display("Madoc", unit="control steps", quiet=quiet) as show:
        for step in range(20):
            stage = "cloning" if step < 5 else "learning"
            show(Moment(step / 20, 100 * step, stage, {"a": step, "b": 0.5, "c": 1e-9, "d": 7}))


def test_plain_lines_at_stage_changes_and_at_the_end(capsys):
    work()
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == ""
    assert len(lines) == 3
    assert lines[0].startswith("Madoc cloning: 0%, 0 control steps, - control steps/s, 0:00 elapsed")
    assert lines[1].startswith("Madoc learning: 25%, 500 control steps")
    assert lines[2].startswith("Madoc learning: 95%, 1,900 control steps")
    assert lines[2].endswith("a 19, b 0.5, c 1e-09")


def test_a_bar_on_a_terminal(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERM", "xterm")
    work()
    assert "Madoc" in terminal.getvalue()
    assert "95%" in terminal.getvalue()
    assert "a 19  b 0.5  c 1e-09" in terminal.getvalue()


def test_quiet_says_nothing(capsys):
    work(quiet=True)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("total", [30, 0])
def test_a_bar_of_known_size(capsys, total):
    with progress.bar("recording [hopper]", total=total, unit="rows") as advance:
        for _ in range(3):
            advance(total // 3)
    assert f"recording [hopper]: 100%, {total} rows" in capsys.readouterr().err.splitlines()[-1]


def test_work_of_unknown_length_shows_the_time_it_has_taken_and_no_share_that_is_done(monkeypatch, capsys):
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with progress.waiting("judging [arm]") as tell:
        assert capsys.readouterr().err == "judging [arm]: begun\n"
        tell("its columns")
        assert capsys.readouterr().err == "judging [arm]: its columns\n"
        now = 75.0
    assert capsys.readouterr().err == "judging [arm]: done, 1:15 elapsed\n"
    with progress.waiting("judging [arm]", quiet=True):
        pass
    assert capsys.readouterr().err == ""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with progress.waiting("judging [arm]"):
        pass
    assert "judging [arm]" in terminal.getvalue() and "%" not in terminal.getvalue()


def test_time_left_follows_the_recent_pace(monkeypatch, capsys):
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with progress.display("x", unit="steps") as show:
        show(Moment(0.5, 5000))  # a resumed run starts in the middle
        for fraction, done in [(0.6, 6000), (0.7, 7000)]:
            now += 10.0
            show(Moment(fraction, done))
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "x: 70%, 7,000 steps, 100 steps/s, 0:20 elapsed, 0:30 left"


def test_slow_work_has_a_rate_from_its_beginning_and_the_time_left_that_is_known(monkeypatch, capsys):
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with progress.display("suite", unit="cells") as show:
        show(Moment(0.0, 0))
        for hour, done in ((1, 2), (2, 3)):
            now = 3600.0 * hour
            show(Moment(done / 10, done))
        now = 2.5 * 3600  # nothing was done for half an hour
        show(Moment(0.3, 3, seconds_left=600.0))
    assert "1.2 cells/h, 2:30:00 elapsed, 10:00 left" in capsys.readouterr().err.splitlines()[-1]
