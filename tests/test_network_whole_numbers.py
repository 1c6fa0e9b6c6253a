"""Networks that take uint8 numbers: what is read, what is refused, and that bounds hold every picture of 8 bits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto
from onnx_files import OnnxFile, image_sets, session

from ns_abstract.api.frame_pictures import PropertySource
from ns_abstract.api.network_question import Question
from ns_abstract.io.errors import InputError
from ns_abstract.verify.eight_bit import rounded, rounded_sets
from ns_abstract.verify.interop import write_vnnlib
from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import bound_outputs, load_network
from ns_abstract.verify.network.load import onnx_runner
from ns_abstract.verify.preprocess import parse_preprocess

SIZE = 6
WHOLE = {"range": [0, 255], "layout": "NHWC"}


def network_file(file: Path, move: bool = True, between: str | None = None) -> Path:
    """A small network of pictures [1, 6, 6, 3] of uint8 numbers; ``between``: an operator before they are cast."""
    f = OnnxFile((SIZE, SIZE, 3), batch=1)
    f.kind = TensorProto.UINT8
    if move:
        f.node("Transpose", perm=[0, 3, 1, 2])
    if between is not None:
        f.node(between, f.last, f.constant(3, np.uint8))
    f.node("Cast", to=TensorProto.FLOAT)
    if not move:
        f.node("Transpose", perm=[0, 3, 1, 2])
    f.node("Mul", f.last, f.constant(1.0 / 255.0))
    f.conv(3, 4)
    f.node("Relu")
    f.node("Flatten")
    f.gemm(4 * (SIZE - 2) ** 2, 3)
    return f.write(file)


@pytest.mark.parametrize("move", [False, True])
@pytest.mark.parametrize("arithmetic", ["float32", "real"])
def test_bounds_hold_every_picture_of_8_bits(move: bool, arithmetic: Any, tmp_path: Path) -> None:
    preprocess = parse_preprocess(WHOLE)
    file = network_file(tmp_path / "net.onnx", move)
    network = load_network(file, **preprocess.loading(None))
    assert network.whole_numbers
    model, run = NetworkModel(network, preprocess, 1 << 28, arithmetic), session(file)
    rng = np.random.default_rng(0)
    shape = (1, SIZE, SIZE, 3)
    b, a = rng.uniform(0.1, 0.9, shape).astype(np.float32), (0.02 * rng.normal(size=(*shape, 2))).astype(np.float32)
    reach = np.abs(a).sum(-1) + np.float32(1e-6)
    linear, lower, upper = rounded_sets((a, b, a, b), b - reach, b + reach)
    rows = np.concatenate([np.eye(3), -np.eye(3)])
    bounds = bound_outputs(network, model.input_sets(linear, lower, upper), rows, np.zeros(6), arithmetic=arithmetic)
    assert np.isfinite(bounds.lower).all()
    p = rng.uniform(-1.0, 1.0, (200, 2))
    images = rounded(b + np.einsum("hwcd,nd->nhwc", a[0], p))
    values = run(np.rint(255.0 * images).astype(np.uint8)).astype(np.float64)
    if arithmetic == "float32":
        np.testing.assert_array_equal(model.outputs(images), values)
    else:
        np.testing.assert_allclose(model.outputs(images), values, atol=1e-5)
        values = model.outputs(images)
    below = values @ rows.T - bounds.lower[0]
    assert (below >= 0.0).all() and (below.min(axis=0) < np.ptp(below, axis=0)).all()


def test_pictures_of_levels_go_in_as_they_are(tmp_path: Path) -> None:
    """Every level, whose quotient by 255 is rounded, comes back."""
    file = network_file(tmp_path / "net.onnx")
    network = load_network(file, **parse_preprocess(WHOLE).loading(None))
    levels = np.resize(np.arange(256, dtype=np.uint8), (3, SIZE, SIZE, 3))
    images = rounded(levels / 255.0)
    model = NetworkModel(network, parse_preprocess(WHOLE), 1 << 28)
    np.testing.assert_array_equal(model.outputs(images), session(file)(levels))
    run = onnx_runner(file, network.output, network.input_shape)
    np.testing.assert_array_equal(run(levels[:1].astype(np.float64)), session(file)(levels[:1])[0])


@pytest.mark.parametrize("operator", ["Add", "Mul", "Div"])
def test_integers_are_not_computed_with(operator: str, tmp_path: Path) -> None:
    """200 + 100 is 44 in uint8."""
    with pytest.raises(InputError, match="computes with uint8 numbers"):
        load_network(network_file(tmp_path / "net.onnx", True, operator), whole_numbers=True)


@pytest.mark.parametrize("preprocess", [{"layout": "NHWC"}, WHOLE | {"mean": [1, 0, 0]}, WHOLE | {"std": [2, 1, 1]}])
def test_other_numbers_are_refused(preprocess: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a uint8 tensor"):
        load_network(network_file(tmp_path / "net.onnx"), **parse_preprocess(preprocess).loading(None))


def test_pictures_of_floats_are_refused(tmp_path: Path) -> None:
    value = {"type": "classification", "label": 0, "preprocess": WHOLE}
    question = Question(network_file(tmp_path / "net.onnx"), PropertySource.of(value))
    with pytest.raises(InputError, match="--picture 8-bit"):
        question.searched(1 << 28, "float32", "float")
    assert question.searched(1 << 28, "float32", "8-bit").network.whole_numbers


def test_instances_for_other_verifiers_are_refused(tmp_path: Path) -> None:
    network = load_network(network_file(tmp_path / "net.onnx"), **parse_preprocess(WHOLE).loading(None))
    with pytest.raises(InputError, match="export the network with a float input"):
        write_vnnlib(network, image_sets((SIZE, SIZE, 3), 1, 1, 0.1, 0.1), np.eye(3), np.zeros(3), tmp_path / "a")
