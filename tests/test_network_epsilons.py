"""Norms spelled out: files whose epsilon onnxruntime does not find are refused, and others are contained."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx_files import OnnxFile
from test_network_reading import at, run

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import load_network


def norm(file: Path, order: str) -> Path:
    """A root mean square norm of 30 times the image, whose epsilon matters where the image is dark alone."""
    f = OnnxFile((6,), batch=1)
    x = f.node("Mul", f.last, f.constant(30.0))
    mean, epsilon = f.node("ReduceMean", f.node("Pow", x, f.constant(2.0)), axes=[-1], keepdims=1), f.constant(1e-2)
    total = f.node("Add", epsilon, mean) if order == "epsilon first" else f.node("Add", mean, epsilon)
    f.node("Mul", f.node("Div", x, f.node("Sqrt", total)), f.constant(np.ones(6)))
    f.write(file)
    if order == "epsilon given by callers":
        model = onnx.load(str(file))
        model.graph.input.append(onnx.helper.make_tensor_value_info(epsilon, onnx.TensorProto.FLOAT, []))
        onnx.save(model, str(file))
    return file


@pytest.mark.parametrize("order", ["epsilon first", "epsilon given by callers"])
def test_lost_epsilons_are_refused(order: str, tmp_path: Path) -> None:
    """There onnxruntime takes another number, and dark images tell them apart."""
    with pytest.raises(InputError, match="takes 1e-5 for the number"):
        load_network(norm(tmp_path / "net.onnx", order))


@pytest.mark.slow
def test_epsilons_behind_the_mean_are_contained(tmp_path: Path) -> None:
    file = norm(tmp_path / "net.onnx", "epsilon last")
    for size in (1.0, 0.01, 0.001):
        point = (size * np.random.default_rng(0).uniform(size=6)).astype(np.float32)
        low, high = at(file, point)
        value = run(file, point)
        assert (low <= value).all() and (value <= high).all()
