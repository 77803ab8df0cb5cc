"""Other users of the machine: nothing of ours can be replaced by them, reached from elsewhere, or blocked by them."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from madoc.runs import machine

ROOT = Path(__file__).parents[2]
LISTENING = """
import subprocess
from pathlib import Path
from madoc.suites.executors import _cluster
before = set(Path("/tmp").glob("madoc-ray-*"))
with _cluster(1, None) as ray:
    ray.get(ray.remote(num_cpus=1)(lambda: 1).remote())
    told = subprocess.run(["ss", "-ltnpH"], capture_output=True, text=True, check=True).stdout
    for line in told.splitlines():
        if "ray" in line or "gcs_server" in line or "python" in line:
            print(line.split()[3].rsplit(":", 1)[0])
    for folder in set(Path("/tmp").glob("madoc-ray-*")) - before:
        print(oct(folder.stat().st_mode & 0o777))
"""

LINUX_ALONE = ("sched_getaffinity", "sched_setaffinity")
ELSEWHERE = """
import builtins, importlib, io, os, pkgutil
for name in {names}:
    delattr(os, name)
opened = io.open
def open_elsewhere(file, *arguments, **options):
    if str(file).startswith("/proc"):
        raise FileNotFoundError(file)
    return opened(file, *arguments, **options)
builtins.open = io.open = open_elsewhere
import madoc
for module in pkgutil.walk_packages(madoc.__path__, "madoc."):
    if not module.name.endswith(("__main__", "render_process")):
        importlib.import_module(module.name)
import numpy as np
simulator = madoc.simulation.make(madoc.tasks.make("hopper"))
system = simulator.bind(simulator.parameters.to_physical(np.zeros((1, len(simulator.parameters)))))
print(system.step(simulator.initial_state[None, None], np.zeros((1, 1, 3))).shape)
madoc.runs.machine.forget_peak()
print(madoc.runs.machine.peak_memory())
"""


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The user's cache, which is not there yet, and an empty temporary directory."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "temporary"))
    return tmp_path / "cache"


def mode(path):
    return path.stat().st_mode & 0o777


def test_a_folder_of_ones_own_lets_nobody_else_in(cache):
    (cache / "madoc").mkdir(parents=True)
    (cache / "madoc").chmod(0o777)
    folder = machine.own_folder("compiled", "here")
    assert folder == cache / "madoc" / "compiled" / "here"
    assert mode(cache / "madoc") == 0o700


def test_a_folder_of_another_user_is_not_taken_for_ones_own(cache, monkeypatch):
    (cache / "madoc").mkdir(parents=True)
    (cache.parent / "temporary" / "madoc-4321").mkdir()
    monkeypatch.setattr(machine, "_user", lambda: 4321)
    assert machine.own_folder("cores") is None
    monkeypatch.setattr(machine, "_held", [])
    machine.take_core()  # none is taken, and nothing is blocked
    assert machine._held == []


def test_a_link_is_no_folder_of_ones_own(cache):
    cache.mkdir()
    (cache / "madoc").symlink_to(cache.parent)
    assert machine.own_folder("cores") == cache.parent / "temporary" / f"madoc-{os.getuid()}" / "cores"


def test_compiled_code_lies_in_no_folder_of_a_suite(cache, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setattr(machine, "take_core", lambda: None)
    machine.prepare_worker()
    compiled = Path(os.environ.pop("JAX_COMPILATION_CACHE_DIR"))
    assert compiled.is_relative_to(cache)
    assert mode(compiled) == 0o700


def test_a_system_without_affinity_has_cores_too_and_none_is_taken(cache, monkeypatch):
    for name in LINUX_ALONE:
        monkeypatch.delattr(os, name, raising=False)
    assert machine.usable_cores() == os.cpu_count()
    monkeypatch.setattr(machine, "_held", [])
    machine.take_core()
    assert machine._held == []


def test_every_module_is_imported_and_a_robot_steps_where_linux_is_not():
    """As on macOS: no affinity, no /proc."""
    done = subprocess.run(
        [sys.executable, "-c", ELSEWHERE.format(names=LINUX_ALONE)],
        env=os.environ | {"PYTHONPATH": str(ROOT / "src"), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["(1,", "1,", "12)", "None"]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="the extra ray is not installed")
@pytest.mark.skipif(shutil.which("ss") is None, reason="ss is not installed")
def test_a_local_cluster_listens_to_this_machine_alone_in_a_folder_that_is_closed():
    done = subprocess.run(
        [sys.executable, "-c", LISTENING],
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        timeout=200,
        check=True,
    )
    addresses = set(done.stdout.split())
    assert len(done.stdout.split()) > 4
    assert addresses <= {"127.0.0.1", "[::ffff:127.0.0.1]", "[::1]", "0o700"}
    assert "0o700" in addresses


def test_products_of_matrices_do_not_wait_for_cores_that_others_use():
    import scipy.linalg  # noqa: F401  its BLAS is another than NumPy's

    def threads() -> list[int]:
        return [each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"]

    with threadpool_limits(2):
        before = threads()
        with machine.one_blas_thread():
            assert threads() == [1] * len(before)
        assert threads() == before == [2] * len(before)
    assert before
