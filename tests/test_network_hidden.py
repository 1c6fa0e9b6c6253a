"""Operators are read rightly beside large outputs, and where a comparison with onnxruntime cannot tell."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper
from onnx_files import OnnxFile
from test_network_reading import at, run

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import load_network
from ns_abstract.verify.network.comparison import compare
from ns_abstract.verify.network.load import read_onnx
from ns_abstract.verify.network.onnx_fold import fold

#: What the outputs beside are multiplied by.
LARGE = 4096.0


def beside_large(f: OnnxFile, name: str, size: int) -> None:
    """Make the output the numbers of ``name``, with large ones behind them."""
    f.node("Flatten", name)
    small = f.last
    f.node("Flatten", "image")
    f.node("Mul", f.last, f.constant(LARGE))
    f.node("Concat", small, f.last, axis=1)
    assert size == int(np.prod(f.shape))


def holds(file: Path, x: np.ndarray) -> float:
    """Check that bounds at one image hold what onnxruntime computes; the greatest width of the first output."""
    low, high = at(file, x)
    value = run(file, x)
    assert (low <= value).all() and (value <= high).all()
    return float((high - low)[0])


@pytest.mark.parametrize("wrong", [0.0, 0.01])
def test_small_outputs_beside_large_ones_are_compared(wrong: float, tmp_path: Path) -> None:
    f = OnnxFile((4,))
    beside_large(f, f.node("Tanh", "image"), 4)
    file = f.write(tmp_path / "net.onnx")

    def program(image: np.ndarray) -> np.ndarray:
        return run(file, image[0]) + wrong * (np.arange(8) == 2)

    images = [np.random.default_rng(seed).normal(size=(1, 4)) for seed in range(3)]
    with pytest.raises(InputError, match=r"outputs differ by 0\.01") if wrong else nullcontext():
        compare(read_onnx(file), program, images)


@pytest.mark.parametrize("before", [0, 1, 2])
@pytest.mark.parametrize("op", ["Sum", "Max", "Min"])
def test_a_value_behind_constants_counts_once(op: str, before: int, tmp_path: Path) -> None:
    f = OnnxFile((4,), seed=before)
    constants = [f.constant(f.rng.normal(size=4)) for _ in range(2)]
    tanh = f.node("Tanh", "image")
    beside_large(f, f.node(op, *constants[:before], "image", *constants[before:], tanh), 4)
    file = f.write(tmp_path / "net.onnx")
    for seed in range(3):
        assert holds(file, np.random.default_rng(seed).normal(size=4).astype(np.float32)) < 1e-4


@pytest.mark.parametrize("op", ["InstanceNormalization", "LayerNormalization"])
def test_a_norm_of_one_number_is_rounded(op: str, tmp_path: Path) -> None:
    """Programs take scale times mean from the bias first, and what is left of a number less itself is no zero."""
    f = OnnxFile((8, 1, 1))
    constants = [f.constant(f.rng.normal(size=8 if op.startswith("I") else 1)) for _ in range(2)]
    f.node(op, "image", *constants, epsilon=1e-5)
    file = f.write(tmp_path / "net.onnx")
    for seed in range(20):
        x = np.random.default_rng(seed).normal(size=(8, 1, 1)).astype(np.float32)
        assert holds(file, x) < 0.02


def test_means_of_windows_past_the_pads_are_refused_where_programs_differ(tmp_path: Path) -> None:
    """Before operator set 19 onnxruntime divides by the whole window, also by what lies past the pads."""
    given: dict[str, Any] = {"kernel_shape": [3], "strides": [3], "pads": [1, 0], "ceil_mode": 1}
    for opset, counted in ((17, 0), (19, 1), (17, 1)):
        f = OnnxFile((2, 6), opset=opset)
        f.node("AveragePool", count_include_pad=counted, **given)
        file = f.write(tmp_path / "net.onnx")
        if opset < 19 and counted:
            with pytest.raises(InputError, match="count_include_pad = 1: programs divide by different numbers"):
                load_network(file)
        else:
            assert holds(file, np.random.default_rng(0).normal(size=(2, 6)).astype(np.float32)) < 1e-4


@pytest.mark.parametrize("scales", [(0.7, 3.0), (0.3, 0.6), (1.5, 1.0)])
def test_nearest_pixels_before_operator_set_11(scales: tuple[float, float], tmp_path: Path) -> None:
    f = OnnxFile((2, 4, 5), opset=10)
    beside_large(f, f.node("Resize", "image", f.constant([1.0, 1.0, *scales]), mode="nearest"), 40)
    x = np.random.default_rng(0).normal(size=(2, 4, 5)).astype(np.float32)
    assert holds(f.write(tmp_path / "net.onnx"), x) < 1e-4


def test_axes_that_count_from_the_end_are_refused_before_the_file_is_run(tmp_path: Path) -> None:
    """onnxruntime ends the process by some of them; by these it fails."""
    f = OnnxFile((2, 5, 3), opset=19)
    f.node("Resize", "image", "", "", f.constant([3, 4], np.int64), axes=[-2, -1], mode="nearest")
    with pytest.raises(InputError, match=r"axes = \[-2, -1\] is not supported"):
        load_network(f.write(tmp_path / "net.onnx"))


@pytest.mark.parametrize("op", ["ScatterElements", "ScatterND"])
def test_constants_are_not_scattered_by_products(op: str) -> None:
    """The reference operators put the factors where products belong."""
    f = OnnxFile((4,), opset=18)
    f.node(op, "data", "indices", "updates", reduction="mul")
    given = [np.full((2, 2), 3.0, np.float32), np.array([[0, 1]]), np.array([[2.0, 5.0]], np.float32)]
    with pytest.raises(InputError, match="reduction = mul"):
        fold(f.nodes[-1], given if op == "ScatterElements" else [given[0], given[1], given[2][0, 0]], 18)


@pytest.mark.parametrize("op", ["ReduceL1", "ReduceL2", "ReduceSumSquare", "ReduceSum"])
def test_sums_over_no_axis(op: str, tmp_path: Path) -> None:
    """onnxruntime takes sizes and squares all the same, the reference operators do not."""
    f = OnnxFile((4,), opset=18)
    beside_large(f, f.node(op, "image", noop_with_empty_axes=1), 4)
    file = f.write(tmp_path / "net.onnx")
    if op == "ReduceSum":
        assert holds(file, np.array([-1.0, 2.0, -3.0, 0.5], np.float32)) < 1e-4
        return
    with pytest.raises(InputError, match="noop_with_empty_axes = 1: programs differ"):
        load_network(file)
    if op != "ReduceSumSquare":
        with pytest.raises(InputError, match="noop_with_empty_axes = 1: programs differ"):
            fold(f.nodes[0], [np.array([-1.0], np.float32)], 18)


def test_constants_are_not_taken_backwards_from_before_the_first() -> None:
    """The format begins with the first number then, the reference operators with none."""
    f = OnnxFile((4,))
    f.node("Slice", "data", "starts", "ends", "axes", "steps")
    data, *rest = (np.arange(4.0, dtype=np.float32), *(np.array([v]) for v in (-7, -9, 0, -1)))
    with pytest.raises(InputError, match=r"starts \[-7\] with steps \[-1\]"):
        fold(f.nodes[-1], [data, *rest], 17)
    rest[0] = np.array([-1])
    assert fold(f.nodes[-1], [data, *rest], 17)[0].tolist() == [3.0, 2.0, 1.0, 0.0]


@pytest.mark.parametrize("op", ["Max", "Where"])
def test_shapes_that_do_not_fit_are_named(op: str, tmp_path: Path) -> None:
    f = OnnxFile((4,))
    other = f.node("Gemm", "image", f.weights(3, 4), transB=1)
    f.node(op, *([f.constant([True], bool)] if op == "Where" else []), "image", other)
    f.write(tmp_path / "net.onnx")
    with pytest.raises(InputError, match=r"shapes .*4 and .*3 do not fit"):
        load_network(tmp_path / "net.onnx")


# ---------------------------------------------------------------- types


@pytest.mark.parametrize("kind", [TensorProto.INT8, TensorProto.UINT8, TensorProto.INT16, TensorProto.UINT16])
def test_steps_without_a_zero_have_the_type_that_the_node_names(kind: int, tmp_path: Path) -> None:
    """Where their range ends lies far from every input that the reading is compared at."""
    f = OnnxFile((2,), opset=21)
    scale = f.constant(100.0)
    f.node("QuantizeLinear", f.node("Relu"), scale, output_dtype=kind)
    f.node("DequantizeLinear", f.last, scale)
    file = f.write(tmp_path / "net.onnx")
    for value in (-5.0, 3.0, 12_000.0, 20_000.0, 30_000.0, 4e6, 7e6):
        point = np.full(2, value, np.float32)
        low, high = at(file, point)
        found = run(file, point)
        assert (low <= found).all() and (found <= high).all() and (high - low < 4e3).all(), value


def test_a_zero_of_another_type_than_the_steps_is_refused(tmp_path: Path) -> None:
    f = OnnxFile((2,), opset=21)
    given = [f.constant(0.1), f.constant(0, np.uint8)]
    f.node("QuantizeLinear", f.last, *given, output_dtype=TensorProto.INT8)
    f.node("DequantizeLinear", f.last, *given)
    with pytest.raises(InputError, match="output_dtype = int8, its zero has type uint8"):
        read_onnx(f.write(tmp_path / "net.onnx"))


def _limit(f: OnnxFile, limit: str) -> None:
    f.node("Clip", "image", "", f.node("Cast", limit, to=TensorProto.FLOAT))


def _stored_limit(kind: int) -> Callable[[OnnxFile], None]:
    """A limit of Clip that no input reaches at which the reading is compared."""

    def build(f: OnnxFile) -> None:
        f.constants.append(helper.make_tensor("limit", kind, [], [4e4 if kind == TensorProto.BFLOAT16 else 3.0]))
        _limit(f, "limit")

    return build


def _cast_limit(kind: int) -> Callable[[OnnxFile], None]:
    return lambda f: _limit(f, f.node("Cast", f.constant(40_010.0), to=kind))


def _node_limit(f: OnnxFile) -> None:
    value = helper.make_tensor("", TensorProto.BFLOAT16, [], [4e4])
    f.nodes.append(helper.make_node("Constant", [], ["limit"], value=value))
    _limit(f, "limit")


def _four_bits(f: OnnxFile) -> None:
    f.constants.append(helper.make_tensor("zero", TensorProto.INT4, [], [0]))
    scale = f.constant(1000.0)
    f.node("QuantizeLinear", f.last, scale, "zero")
    f.node("DequantizeLinear", f.last, scale, "zero")


OTHER_TYPES: dict[str, tuple[Callable[[OnnxFile], None], str]] = {
    "bfloat16 stored": (_stored_limit(TensorProto.BFLOAT16), "initializer limit: has type BFLOAT16"),
    "bfloat16 of a node": (_node_limit, "Constant.*has type BFLOAT16"),
    "float8 stored": (_stored_limit(TensorProto.FLOAT8E4M3FN), "has type FLOAT8E4M3FN"),
    "cast to bfloat16": (_cast_limit(TensorProto.BFLOAT16), "Cast.*has type BFLOAT16"),
    "cast to float8": (_cast_limit(TensorProto.FLOAT8E5M2), "Cast.*has type FLOAT8E5M2"),
    "cast to 4 bits": (_cast_limit(TensorProto.INT4), "Cast.*has type INT4"),
    "a zero of 4 bits": (_four_bits, "QuantizeLinear.*reads numbers of 4 bits"),
}


@pytest.mark.parametrize("name", OTHER_TYPES)
def test_types_that_numpy_holds_otherwise_are_refused(name: str, tmp_path: Path) -> None:
    build, words = OTHER_TYPES[name]
    f = OnnxFile((2,), opset=21)
    build(f)
    with pytest.raises(InputError, match=words):
        load_network(f.write(tmp_path / "net.onnx"))


@pytest.mark.parametrize("kind", [TensorProto.INT4, TensorProto.UINT4])
def test_weights_of_4_bits_are_read(kind: int, tmp_path: Path) -> None:
    f = OnnxFile((4,), opset=21)
    f.constants.append(helper.make_tensor("weights", kind, [4], [7, 3, 0, 5]))
    f.node("Mul", "image", f.node("DequantizeLinear", "weights", f.constant(0.5)))
    low, high = at(f.write(tmp_path / "net.onnx"), np.ones(4, np.float32))
    wanted = np.array([3.5, 1.5, 0.0, 2.5])
    assert (low <= wanted).all() and (wanted <= high).all() and (high - low < 1e-5).all()


def test_operator_sets_that_are_stated_twice_are_refused(tmp_path: Path) -> None:
    for sets, good in (((("", 17),), True), ((("ai.onnx", 17), ("", 17)), True), ((("", 12), ("ai.onnx", 13)), False)):
        f = OnnxFile((2, 3))
        f.node("Softmax", axis=-1)
        model = f.model()
        del model.opset_import[:]
        model.opset_import.extend(helper.make_opsetid(domain, version) for domain, version in sets)
        (tmp_path / "net.onnx").write_bytes(model.SerializeToString())
        with nullcontext() if good else pytest.raises(InputError, match="states the operator sets 12, 13"):
            read_onnx(tmp_path / "net.onnx")


def test_constants_that_are_stored_twice_are_refused(tmp_path: Path) -> None:
    f = OnnxFile((4,))
    f.node("Mul", f.last, f.constant(2.0))
    f.constants.append(helper.make_tensor(f.constants[0].name, TensorProto.FLOAT, [], [3.0]))
    with pytest.raises(InputError, match="initializer c0: is stored twice"):
        read_onnx(f.write(tmp_path / "net.onnx"))


def test_norms_that_are_computed_in_half_precision_are_refused(tmp_path: Path) -> None:
    for kind, good in ((TensorProto.FLOAT, True), (TensorProto.FLOAT16, False), (TensorProto.BFLOAT16, False)):
        f = OnnxFile((4,))
        f.node("LayerNormalization", f.last, f.constant(np.ones(4)), stash_type=kind)
        file = f.write(tmp_path / "net.onnx")
        if good:
            load_network(file)
            continue
        with pytest.raises(InputError, match=f"stash_type = {kind}"):
            load_network(file)
