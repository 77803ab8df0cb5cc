"""The ONNX graph of a policy acts as the NumPy policy does."""

import itertools
import sys

import numpy as np
import pytest

from madoc.errors import MadocError
from madoc.export.onnx_policy import save_onnx
from madoc.numpy_policy import NumpyPolicy


def policy(sizes=(5, 16, 8, 6)):
    """Random weights; the last layer has means and deviations of three actions."""
    generator = np.random.default_rng(0)
    pairs = list(itertools.pairwise(sizes))
    return NumpyPolicy(
        "hopper",
        tuple(generator.normal(size=pair).astype(np.float32) for pair in pairs),
        tuple(generator.normal(size=pair[1]).astype(np.float32) for pair in pairs),
        generator.normal(size=sizes[0]).astype(np.float32),
        generator.uniform(0.5, 2.0, size=sizes[0]).astype(np.float32),
    )


@pytest.mark.parametrize("sizes", [(5, 16, 8, 6), (3, 2)])
def test_the_graph_acts_as_the_policy_does(tmp_path, sizes):
    pytest.importorskip("onnx", reason="onnx is not installed")
    from onnx.reference import ReferenceEvaluator

    save_onnx(policy(sizes), tmp_path / "policy.onnx")
    observation = np.random.default_rng(1).normal(size=(7, sizes[0])).astype(np.float32)
    (action,) = ReferenceEvaluator(str(tmp_path / "policy.onnx")).run(None, {"observation": observation})
    assert action.shape == (7, sizes[-1] // 2)
    np.testing.assert_allclose(action, policy(sizes).act(observation), atol=1e-5)


def test_without_the_package_it_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MadocError, match=r'pip install "madoc-calibration\[onnx\]"'):
        save_onnx(policy(), tmp_path / "policy.onnx")
    assert list(tmp_path.iterdir()) == []
