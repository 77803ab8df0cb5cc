"""A disk that is full: one sentence each time, and with room again the same bits."""

import errno
import os
import random
import subprocess
import sys
import time

import jax
import pytest
from test_kills import TESTS, ended, epochs, told

from calibrating import go_on
from madoc import data
from madoc import robots as own
from madoc.commands.main import main
from madoc.errors import MadocError
from own_robots import SPRING_SPEC, write_robot
from robots import SPRING_TRUTH, recorded

BUDGET = 1500
METHOD = ["updates=5", "epoch_steps=100", "draws=5", "batch=32", "replay_capacity=500", "hidden=[16]"]
METHOD += ["cloning_epochs=5", "cloning_updates=5", "grouping_epochs=5", "grouping_updates=5"]
METHOD += ["agents.hidden=[16]", "agents.critic_hidden=[16]", "agents.batch=32", "agents.actor_batch=16"]


def full(*arguments):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.slow
def test_what_was_not_written_for_want_of_room_is_done_again(tmp_path, monkeypatch):
    """The disk is full at 20 moments, in each of which a file was to be forced to it."""
    go_on(str(tmp_path / "whole"), BUDGET)
    moments, force, refused = random.Random(0), os.fsync, 0
    left = 0

    def sometimes(descriptor):
        nonlocal left
        left -= 1
        return full() if left < 0 else force(descriptor)

    monkeypatch.setattr(os, "fsync", sometimes)
    while not (tmp_path / "run" / "result.json").exists():
        left = moments.randrange(6) if refused < 20 else 10**9
        try:
            go_on(str(tmp_path / "run"), BUDGET)
        except MadocError as error:
            assert "could not write" in str(error) and "No space left" in str(error)
            refused += 1
        except OSError as error:  # which the command line makes a sentence of
            assert error.errno == errno.ENOSPC
            refused += 1
    assert refused >= 5
    assert told(tmp_path / "run") == told(tmp_path / "whole")


def test_a_page_for_which_there_is_no_room_is_refused(tmp_path, monkeypatch, capsys):
    go_on(str(tmp_path / "run"), 200)
    capsys.readouterr()
    monkeypatch.setattr(os, "fsync", full)
    assert main(["report", str(tmp_path / "run")]) == 2
    assert "could not write" in (said := capsys.readouterr().err)
    assert said.count("\n") == 1
    assert not (tmp_path / "run" / "report.html").exists()


@pytest.mark.parametrize("out", ["pipe", "/dev/full"])
def test_a_page_is_written_to_no_pipe_or_device(tmp_path, capsys, out):
    go_on(str(tmp_path / "run"), 200)
    os.mkfifo(tmp_path / "pipe")
    assert main(["report", str(tmp_path / "run"), "--out", str(tmp_path / out)]) == 2
    assert "is no page of madoc report" in capsys.readouterr().err


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 4 MB, which only root can make."""
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", place], check=False).returncode:
        pytest.skip("this user cannot mount a disk")
    yield place
    subprocess.run(["umount", "--lazy", place], check=True)


def calibration(robot, log, out, *more):
    words = ["calibrate", robot, "--data", log, "--method", "madoc", "--budget", "4000", "--out", out, "--quiet"]
    return subprocess.Popen(
        [sys.executable, "-m", "madoc", *map(str, [*words, "--set", *METHOD, *more])],
        env=os.environ | {"PYTHONPATH": str(TESTS.parent / "src")},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_disk_that_is_full_at_random_moments(tmp_path, small_disk):
    robot, log = write_robot(tmp_path, SPRING_SPEC), tmp_path / "log.npz"
    data.save(recorded(own.load(robot).task, SPRING_TRUTH, 300, jax.random.key(1)), log)
    ended(calibration(robot, log, tmp_path / "whole"))
    moments, run, refused = random.Random(1), small_disk / "run", 0
    for _ in range(20):
        resume = ["--resume"] if (run / "spec.json").exists() else []
        before, process = epochs(run), calibration(robot, log, run, *resume)
        more = moments.choice([0, 1, 1, 2])
        while epochs(run) < before + more and process.poll() is None:
            time.sleep(0.005)
        time.sleep(moments.uniform(0.0, 0.2 if more else 4.0))
        subprocess.run(["dd", "if=/dev/zero", f"of={small_disk}/fill", "bs=1k"], capture_output=True, check=False)
        _, said = process.communicate(timeout=200)
        (small_disk / "fill").unlink()
        if process.returncode == 0:
            break
        assert process.returncode == 2, said
        assert said.startswith("madoc: ") and said.count("\n") == 1 and "No space left" in said
        refused += 1
    print(refused, "refusals")
    assert refused > 5
    ended(calibration(robot, log, run, "--resume"))
    assert told(run) == told(tmp_path / "whole")
