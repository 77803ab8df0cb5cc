"""A learnt policy as ONNX, for runtimes other than NumPy."""

from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from madoc.errors import needing
from madoc.numpy_policy import NumpyPolicy
from madoc.runs.files import replacing

if TYPE_CHECKING:
    from onnx import ModelProto

OPSET = 17
"""Version of the operator set; all operators used here are older, and ONNX Runtime has read it since 2022."""


def save_onnx(policy: NumpyPolicy, path: Path) -> None:
    """Write the deterministic action of a policy as a graph from `observation` to `action` in [-1, 1], float32.

    The first axis of both is the batch.

    Raises:
        MadocError: The package onnx is not installed, or the file cannot be written.
    """
    with needing("ONNX files need the package onnx;", "madoc-calibration[onnx]"):
        import onnx
    model = _model(policy, onnx)
    onnx.checker.check_model(model, full_check=True)
    with replacing(path) as stream:
        stream.write(model.SerializeToString())


def _model(policy: NumpyPolicy, onnx: ModuleType) -> "ModelProto":
    """(observation - offset) / scale, hidden layers with ReLU, the half of the last one that is the mean, tanh."""
    make, constants, nodes = onnx.helper.make_node, {}, []
    constants["offset"], constants["scale"] = policy.offset, policy.scale
    nodes.append(make("Sub", ["observation", "offset"], ["centred"]))
    nodes.append(make("Div", ["centred", "scale"], ["features_0"]))
    actions = policy.weights[-1].shape[1] // 2
    last = len(policy.weights) - 1
    for layer, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        used = actions if layer == last else weight.shape[1]
        constants[f"weight_{layer}"], constants[f"bias_{layer}"] = weight[:, :used], bias[:used]
        out = "mean" if layer == last else f"linear_{layer}"
        nodes.append(make("Gemm", [f"features_{layer}", f"weight_{layer}", f"bias_{layer}"], [out]))
        if layer != last:
            nodes.append(make("Relu", [out], [f"features_{layer + 1}"]))
    nodes.append(make("Tanh", ["mean"], ["action"]))
    floats = onnx.TensorProto.FLOAT
    graph = onnx.helper.make_graph(
        nodes,
        f"policy_of_{policy.task_name}",
        [onnx.helper.make_tensor_value_info("observation", floats, ["batch", len(policy.offset)])],
        [onnx.helper.make_tensor_value_info("action", floats, ["batch", actions])],
        [onnx.numpy_helper.from_array(value.astype("float32", order="C"), name) for name, value in constants.items()],
    )
    model = onnx.helper.make_model(
        graph, producer_name="madoc", opset_imports=[onnx.helper.make_opsetid("", OPSET)], ir_version=8
    )
    onnx.helper.set_model_props(model, {"task": policy.task_name, "action": "in [-1, 1], deterministic"})
    return model
