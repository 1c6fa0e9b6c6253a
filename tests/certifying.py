"""Small networks and stand-ins for the tests of certificates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def write_onnx(
    file: Path, shape: tuple[int, ...], nodes: Sequence[Any], weights: dict[str, np.ndarray], outputs: int
) -> Path:
    """A model with input ``image`` [N, *shape] and output ``y`` [N, outputs]."""
    graph = helper.make_graph(
        list(nodes),
        "net",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["N", *shape])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["N", outputs])],
        [numpy_helper.from_array(np.asarray(v, np.float32), name) for name, v in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    file.write_bytes(model.SerializeToString())
    return file


def classifier(file: Path, size: int = 16, classes: int = 3, seed: int = 0, gain: float = 4.0) -> Path:
    """Convolution, ReLU and two linear layers with random weights, which look at differences of brightness."""
    rng = np.random.default_rng(seed)
    side = size // 2
    kernel = rng.normal(size=(4, 3, 4, 4))
    kernel -= kernel.mean(axis=(1, 2, 3), keepdims=True)
    weights = {
        "k": 0.3 * kernel,
        "c": np.zeros(4),
        "w": gain * rng.normal(size=(12, 4 * side * side)) / side,
        "b": rng.normal(size=12) * 0.1,
        "v": rng.normal(size=(classes, 12)) * 0.5,
        "d": np.zeros(classes),
    }
    nodes = [
        helper.make_node("Conv", ["image", "k", "c"], ["h0"], kernel_shape=[4, 4], strides=[2, 2], pads=[1, 1, 1, 1]),
        helper.make_node("Relu", ["h0"], ["h1"]),
        helper.make_node("Flatten", ["h1"], ["h2"]),
        helper.make_node("Gemm", ["h2", "w", "b"], ["h3"], transB=1),
        helper.make_node("Relu", ["h3"], ["h4"]),
        helper.make_node("Gemm", ["h4", "v", "d"], ["y"], transB=1),
    ]
    return write_onnx(file, (3, size, size), nodes, weights, classes)


def linear(file: Path, rows: np.ndarray, offset: np.ndarray, size: int) -> Path:
    """``y = rows @ image + offset`` for rows [k, 3 size size]."""
    nodes = [
        helper.make_node("Flatten", ["image"], ["x"]),
        helper.make_node("Gemm", ["x", "w", "b"], ["y"], transB=1),
    ]
    return write_onnx(file, (3, size, size), nodes, {"w": rows, "b": offset}, len(rows))
