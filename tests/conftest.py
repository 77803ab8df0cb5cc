"""Strictness for the whole suite, and what tests of equations share."""

import gc
import os
from pathlib import Path

import equinox as eqx
import jax
import jax.monitoring
import pytest

import shapes

# What one worker, or a process that a test starts, has compiled the others load.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "compiled"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
# Tests run a program a few times: optimising it takes longer than that saves. Fusion emitters are most of compiling.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of each worker: there is one for each core
os.environ["MUJOCO_GL"] = "disable"  # only tests of pictures draw any
os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"  # for the processes that tests start
jax.config.update("jax_numpy_rank_promotion", "raise")
if os.environ.get("SHAPES", "1") != "0":
    shapes.check("madoc")  # annotated shapes and types
gc.set_threshold(100_000, 20, 100)  # tracing makes very many objects, nearly all of which stay

_TRACE_EVENT = "/jax/core/compile/jaxpr_trace_duration"
_traces: list[str] = []


def _listen(event: str, duration: float, **_: object) -> None:
    if event == _TRACE_EVENT:
        _traces.append(event)


jax.monitoring.register_event_duration_secs_listener(_listen)


@pytest.fixture(params=["jitted", pytest.param("eager", marks=pytest.mark.slow)])
def compiled(request):
    """Wraps a function under test: jitted, or as it is."""
    return eqx.filter_jit if request.param == "jitted" else lambda function: function


@pytest.fixture
def traced():
    """How many functions JAX has traced so far: unchanged over calls that reuse what was traced."""
    return lambda: len(_traces)
