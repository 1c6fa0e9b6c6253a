"""What networks are read as: one output, constants that rounding changes, functions with the file's own numbers."""

from __future__ import annotations

import gzip
import itertools
from fractions import Fraction
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from mpmath import mp
from onnx import TensorProto, helper, numpy_helper
from onnx_files import OnnxFile

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import ImageSets, bound_outputs, byte_sums, load_network
from ns_abstract.verify.network.byte_sums import bytes_are_summed_exactly
from ns_abstract.verify.network.interpolation import nearest_pixels
from ns_abstract.verify.network.load import onnx_runner, read_onnx
from ns_abstract.verify.vnnlib import load_query, load_vnnlib

CASES = Path(__file__).resolve().parents[2] / "shared" / "data" / "network_cases"


def at(file: Path, x: np.ndarray, arithmetic: str = "float32", **given: object) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the outputs at one input."""
    network = load_network(file, **given)  # type: ignore[arg-type]
    flat = np.asarray(x, np.float64).reshape(1, -1)
    still = np.zeros((1, flat.shape[1], 1))
    images = ImageSets(still, flat, still, flat, flat, flat)
    size = network.output_size
    rows = np.concatenate([np.eye(size), -np.eye(size)])
    found = bound_outputs(network, images, rows, np.zeros(2 * size), arithmetic=arithmetic).lower[0]  # type: ignore[arg-type]
    return found[:size], -found[size:]


def run(file: Path, x: np.ndarray, output: str = "") -> np.ndarray:
    return onnx_runner(file, output, np.shape(x))(np.asarray(x, np.float32)[None]).astype(np.float64)


# ---------------------------------------------------------------- one output


def beside(tmp_path: Path, kind: int, *ops: str) -> tuple[Path, str, str]:
    """Scores [N, 3], and what ``ops`` make of them, as a second output of type ``kind``."""
    f = OnnxFile((2, 3, 3))
    f.node("Flatten")
    scores = f.gemm(18, 3)
    for op in ops:
        f.node(op, **({"axis": 1} if op in ("Softmax", "ArgMax") else {}))
    other = f.last
    f.last = scores
    model = f.model()
    model.graph.output.append(helper.make_tensor_value_info(other, kind, None))
    (tmp_path / "net.onnx").write_bytes(model.SerializeToString())
    return tmp_path / "net.onnx", scores, other


def test_several_outputs_are_refused_and_one_is_picked(tmp_path: Path) -> None:
    file, scores, other = beside(tmp_path, TensorProto.FLOAT, "Softmax")
    with pytest.raises(InputError, match=f"has 2 outputs: {scores} .*, {other} ") as caught:
        load_network(file)
    assert '"output"' in (caught.value.fix or "")
    with pytest.raises(InputError, match="has no output 'nothing'"):
        load_network(file, output="nothing")
    x = np.random.default_rng(0).normal(size=(2, 3, 3)).astype(np.float32)
    for name in (scores, other):
        low, high = at(file, x, output=name)
        value = run(file, x, name)
        assert low.shape == (3,) and (low <= value).all() and (value <= high).all() and (high - low < 1e-3).all()


def test_only_what_the_output_depends_on_is_read(tmp_path: Path) -> None:
    file, scores, other = beside(tmp_path, TensorProto.FLOAT, "Sin", "Floor")
    assert load_network(file, output=scores).output_size == 3
    with pytest.raises(InputError, match="Sin"):
        load_network(file, output=other)


def test_a_label_beside_the_scores_needs_no_choice(tmp_path: Path) -> None:
    file, scores, other = beside(tmp_path, TensorProto.INT64, "ArgMax")
    assert load_network(file).output == scores
    with pytest.raises(InputError, match="ArgMax") as caught:
        load_network(file, output=other)
    assert scores in str(caught.value)


def test_masks_and_indices_that_nobody_reads_are_left_out(tmp_path: Path) -> None:
    f = OnnxFile((2, 4, 4))
    f.nodes.append(helper.make_node("MaxPool", ["image"], ["p", "i"], kernel_shape=[2, 2], strides=[2, 2]))
    f.nodes.append(helper.make_node("Dropout", ["p"], ["y", "m"]))
    f.last = "y"
    model = f.model()
    model.graph.output.append(helper.make_tensor_value_info("m", TensorProto.BOOL, None))
    (tmp_path / "net.onnx").write_bytes(model.SerializeToString())
    x = np.random.default_rng(0).normal(size=(2, 4, 4)).astype(np.float32)
    low, high = at(tmp_path / "net.onnx", x)
    assert np.abs(low - run(tmp_path / "net.onnx", x, "y")).max() < 1e-5 and (low <= high).all()


@pytest.mark.parametrize("declared", [(2, 2), (3, 4), (2, 4), (4, 3)])
def test_the_declared_variables_are_the_networks(declared: tuple[int, int], tmp_path: Path) -> None:
    inputs, outputs = declared
    lines = [f"(declare-const X_{k} Real)(assert (<= X_{k} 1))(assert (>= X_{k} 0))" for k in range(inputs)]
    lines += [f"(declare-const Y_{k} Real)" for k in range(outputs)]
    file = tmp_path / "p.vnnlib"
    file.write_text("\n".join([*lines, "(assert (<= Y_0 1))"]))
    (tmp_path / "q.VNNLIB.gz").write_bytes(gzip.compress(file.read_bytes()))
    for path, read in itertools.product(
        (file, tmp_path / "q.VNNLIB.gz"), (lambda p: load_vnnlib(p, 4, 2), lambda p: load_query(p, 2, 4)[0])
    ):
        if declared == (2, 4):
            read(path)
            continue
        with pytest.raises(InputError, match=r"declares|X_2"):
            read(path)


# ---------------------------------------------------------------- files


def test_a_fixed_batch_is_read_item_by_item(tmp_path: Path) -> None:
    f = OnnxFile((2, 4, 4), batch=4)
    f.conv(2, 3)
    f.node("Relu")
    f.node("Reshape", f.last, f.constant([4, -1], np.int64))
    f.gemm(12, 3)
    x = np.random.default_rng(0).normal(size=(2, 4, 4)).astype(np.float32)
    low, high = at(f.write(tmp_path / "net.onnx"), x)
    value = run(tmp_path / "net.onnx", x)
    assert value.shape == (3,) and (low <= value).all() and (value <= high).all() and (high - low < 1e-3).all()
    f.node("ReduceSum", f.last, f.constant([0], np.int64))
    with pytest.raises(InputError, match="batch of 4"):
        load_network(f.write(tmp_path / "net.onnx"))


@pytest.mark.parametrize("shape", [[1, -1], [2, -1], [-1, 9]])
def test_reshapes_that_mix_a_fixed_batch_are_refused(shape: list[int], tmp_path: Path) -> None:
    f = OnnxFile((2, 3, 3), batch=4)
    f.node("Reshape", f.last, f.constant(shape, np.int64))
    f.node("Relu")
    with pytest.raises(InputError, match=r"mixes the 4 items|batch"):
        load_network(f.write(tmp_path / "net.onnx"))


def test_an_input_without_a_batch_is_one_item(tmp_path: Path) -> None:
    f = OnnxFile((8,), batch=12)
    f.node("Reshape", f.last, f.constant([1, 96], np.int64))
    f.gemm(96, 2)
    x = np.random.default_rng(0).normal(size=(12, 8)).astype(np.float32)
    low, high = at(f.write(tmp_path / "net.onnx"), x)
    value = run(tmp_path / "net.onnx", x)
    assert (low <= value).all() and (value <= high).all() and (high - low < 1e-3).all()


def test_free_sizes_are_those_of_the_pictures(tmp_path: Path) -> None:
    f = OnnxFile((3, "H", "W"), batch=-1)  # type: ignore[arg-type]
    f.conv(3, 2)
    f.node("GlobalAveragePool")
    f.node("Flatten")
    file = f.write(tmp_path / "net.ONNX")
    with pytest.raises(InputError, match=r"preprocess\.resize"):
        load_network(file)
    x = np.random.default_rng(0).normal(size=(3, 5, 7)).astype(np.float32)
    low, high = at(file, x, picture=(5, 7))
    value = run(file, x)
    assert (low <= value).all() and (value <= high).all()


def test_packed_models_and_local_functions(tmp_path: Path) -> None:
    f = OnnxFile((4,))
    f.gemm(4, 3)
    f.nodes.append(helper.make_node("Twice", [f.last], ["y"], domain="own"))
    f.last = "y"
    model = f.model()
    body = [helper.make_node("Relu", ["a"], ["b"]), helper.make_node("Add", ["b", "b"], ["c"])]
    model.opset_import.append(helper.make_opsetid("own", 1))
    model.functions.append(helper.make_function("own", "Twice", ["a"], ["c"], body, [helper.make_opsetid("", 17)]))
    file = tmp_path / "net.onnx.gz"
    file.write_bytes(gzip.compress(model.SerializeToString()))
    x = np.random.default_rng(0).normal(size=4).astype(np.float32)
    low, high = at(file, x)
    assert (low <= run(file, x)).all() and (run(file, x) <= high).all()
    # thirty functions, each of which calls the next one twice
    for k in range(30):
        calls = [helper.make_node(f"F{k + 1}", ["a"], [n], domain="own") for n in ("b", "c")]
        model.functions.append(
            helper.make_function("own", f"F{k}", ["a"], ["c"], calls, [helper.make_opsetid("own", 1)])
        )
    model.graph.node.append(helper.make_node("F0", ["y"], ["z"], domain="own"))
    (tmp_path / "bomb.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(InputError, match="nodes together"):
        load_network(tmp_path / "bomb.onnx")


@pytest.mark.parametrize("domain", ["", "ai.onnx", "ai.onnx.ml", "com.microsoft", "com.ms.internal.nhwc"])
def test_functions_that_replace_operators_are_refused(domain: str, tmp_path: Path) -> None:
    """onnxruntime calls its own operator of that name, which differs from the function where no probe looks."""
    f = OnnxFile((4,))
    f.nodes.append(helper.make_node("Gelu", ["image"], ["y"], domain=domain))
    f.last = "y"
    model = f.model()
    model.opset_import.extend([helper.make_opsetid(domain, 1)] * (domain != ""))
    body = [helper.make_node("Relu", ["a"], ["b"])]
    model.functions.append(helper.make_function(domain, "Gelu", ["a"], ["b"], body, [helper.make_opsetid("", 17)]))
    (tmp_path / "net.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(InputError, match="operators of runtimes"):
        load_network(tmp_path / "net.onnx")


def test_attributes_that_are_given_twice_are_refused(tmp_path: Path) -> None:
    """Of a constant onnxruntime takes the first value; the last one would be read."""
    f = OnnxFile((4,))
    f.nodes.append(
        helper.make_node("Constant", [], ["scale"], value=numpy_helper.from_array(np.array(1.0, np.float32), ""))
    )
    f.node("Mul", "image", "scale")
    model = f.model()
    again = helper.make_attribute("value", numpy_helper.from_array(np.array(1.0001, np.float32), ""))
    model.graph.node[0].attribute.append(again)
    (tmp_path / "net.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(InputError, match="attribute value is given twice"):
        load_network(tmp_path / "net.onnx")
    model.graph.node[0].attribute[0].ref_attr_name = "of a function"
    del model.graph.node[0].attribute[1]
    (tmp_path / "net.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(InputError, match="refers to one of a function"):
        load_network(tmp_path / "net.onnx")


def test_functions_have_default_attributes(tmp_path: Path) -> None:
    """A slope that a call leaves out, by way of another function, is the function's and not the operator's of 0.01."""
    f = OnnxFile((4,))
    f.nodes.append(helper.make_node("Outer", ["image"], ["y"], domain="own"))
    f.last = "y"
    model = f.model()
    own, plain = helper.make_opsetid("own", 1), helper.make_opsetid("", 17)
    model.opset_import.append(own)
    leaky = helper.make_node("LeakyRelu", ["a"], ["b"])
    leaky.attribute.append(onnx.AttributeProto(name="alpha", ref_attr_name="alpha", type=onnx.AttributeProto.FLOAT))
    inner = helper.make_function("own", "Inner", ["a"], ["b"], [leaky], [plain])
    inner.attribute_proto.append(helper.make_attribute("alpha", 0.010005))
    call = helper.make_node("Inner", ["a"], ["b"], domain="own")
    model.functions.extend([inner, helper.make_function("own", "Outer", ["a"], ["b"], [call], [own])])
    file = tmp_path / "net.onnx"
    file.write_bytes(model.SerializeToString())
    x = np.array([-1.0, -0.5, 0.5, 1.0], np.float32)
    low, high = at(file, x)
    assert (low <= run(file, x)).all() and (run(file, x) <= high).all()


# ---------------------------------------------------------------- constants


def orders(values: np.ndarray) -> np.ndarray:
    """Sums of float32 numbers as programs may order them."""
    forwards, backwards = np.float32(0.0), np.float32(0.0)
    for v in values:
        forwards = np.float32(forwards + v)
    for v in values[::-1]:
        backwards = np.float32(backwards + v)
    return np.array([forwards, backwards, values.sum(dtype=np.float32), np.sort(values).sum(dtype=np.float32)])


def cancelling(seed: int, n: int = 401) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=n).astype(np.float32) * np.float32(2.0**20)
    v[-1] = -np.float32(v[:-1].astype(np.float64).sum())
    return v


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("use", ["Mul", "Add", "Sub", "Gemm", "MatMul", "Conv"])
def test_folded_sums_hold_for_every_order(use: str, seed: int, tmp_path: Path) -> None:
    """A sum of constants that cancels, times another constant, read by each kind of layer."""
    f = OnnxFile((1, 1, 1) if use == "Conv" else (1,))
    v = cancelling(seed)
    x = f.last
    f.node("ReduceSum", f.constant(v[None]), f.constant([1], np.int64))
    f.node("Mul", f.last, f.constant(0.5))
    c = f.node("Reshape", f.last, f.constant([1, 1, 1, 1] if use == "Conv" else [1, 1], np.int64))
    f.node(use, x, c)
    file = f.write(tmp_path / "net.onnx")
    given = np.ones(f.shape, np.float32) * 3.0
    exact = float(sum(map(Fraction, v.tolist())) / 2)
    floats = orders(v).astype(np.float64) * 0.5
    result = {"Add": lambda c: 3.0 + c, "Sub": lambda c: 3.0 - c}.get(use, lambda c: 3.0 * c)
    low, high = at(file, given)
    for c in (*floats, exact):
        assert low[0] <= result(c) <= high[0], (c, low, high)
    assert len(set(floats)) > 1
    low, high = at(file, given, "real")
    assert low[0] <= result(exact) <= high[0] and high[0] - low[0] < 1e-3 * (1.0 + abs(exact))


@pytest.mark.parametrize(
    "op", ["Div", "Sqrt", "Exp", "Pow", "ReduceMean", "MatMul", "Sin", "Reciprocal", "Tanh", "ReduceL2"]
)
def test_folded_functions_hold_their_exact_value(op: str, tmp_path: Path) -> None:
    f = OnnxFile((1,))
    x, v = f.last, np.array([[0.3, 1.7, 0.9]], np.float32)
    c = f.constant(v)
    numbers = [mp.mpf(float(w)) for w in v[0]]
    with mp.workprec(200):
        if op == "Div":
            f.node("Div", c, f.constant([[3.0]]))
            exact = [w / 3 for w in numbers]
        elif op == "Pow":
            f.node("Pow", c, f.constant([[2.0]]))
            exact = [w * w for w in numbers]
        elif op == "ReduceMean":
            f.node("ReduceMean", c, axes=[1], keepdims=1)
            exact = [sum(numbers) / 3]
        elif op == "ReduceL2":
            f.node("ReduceL2", c, axes=[1], keepdims=1)
            exact = [mp.sqrt(sum(w * w for w in numbers))]
        elif op == "MatMul":
            f.node("MatMul", c, f.constant(v.T))
            exact = [sum(w * w for w in numbers)]
        else:
            f.node(op, c)
            name = {"Reciprocal": lambda w: 1 / w}.get(op) or getattr(mp, op.lower())
            exact = [name(w) for w in numbers]
        f.node("Mul", x, f.last)
        file = f.write(tmp_path / "net.onnx")
        for arithmetic in ("real", "float32"):
            low, high = at(file, np.ones(1), arithmetic)
            assert all(mp.mpf(float(a)) <= w <= mp.mpf(float(b)) for a, w, b in zip(low, exact, high, strict=True))
            assert (high - low < (1e-11 if arithmetic == "real" else 1e-4)).all()


def test_exact_constants_stay_exact(tmp_path: Path) -> None:
    """Sizes that go through floats decide shapes; a constant that may fall either way does not."""
    f = OnnxFile((1, 2, 2))
    x = f.last
    f.node("Mul", f.constant([2.0, 2.0]), f.constant([3.0, 2.5]))
    f.node("Floor")
    f.node("Cast", to=TensorProto.INT64)
    f.node("Concat", f.constant([1, 1], np.int64), f.last, axis=0)
    f.node("Resize", x, "", "", f.last, mode="nearest")
    assert load_network(f.write(tmp_path / "net.onnx")).output_shape == (1, 6, 5)
    f.node("Mul", f.constant([0.1]), f.constant([30.0]))
    f.node("Floor")
    f.node("Mul", x, f.last)
    with pytest.raises(InputError, match="either way"):
        load_network(f.write(tmp_path / "net.onnx"))


@pytest.mark.parametrize("name", ["constant_reduction", "gelu_constant_real"])
@pytest.mark.parametrize("arithmetic", ["float32", "real"])
def test_published_cases(name: str, arithmetic: str) -> None:
    if not CASES.exists():
        pytest.skip("the networks of ../shared/data/network_cases are not there")
    file, x = CASES / name / "network.onnx", np.load(CASES / name / "x.npy")
    low, high = at(file, x, arithmetic)
    if arithmetic == "float32":
        value = run(file, x[0])
        assert (low <= value).all() and (value <= high).all()
    if name == "gelu_constant_real":
        with mp.workprec(200):
            parts = {
                t.name: mp.mpf(float(numpy_helper.to_array(t).reshape(-1)[0]))
                for t in onnx.load(file).graph.initializer
            }
            z = mp.mpf(float(x.reshape(-1)[0])) - parts["c1"]
            exact = (z * (mp.erf(z * parts["c4"]) + parts["c7"]) * parts["c10"] - parts["c12"]) * parts["c14"]
            assert mp.mpf(float(low[0])) <= exact <= mp.mpf(float(high[0]))


# ---------------------------------------------------------------- functions


@pytest.mark.slow_cases
@pytest.mark.parametrize("shift", [0.0, 1.0, -3.0, 200.0])
def test_gelu_keeps_the_files_constants(shift: float, tmp_path: Path) -> None:
    f = OnnxFile((1,))
    x, rate = f.last, np.float32(np.sqrt(0.5) * (1.0 + shift * 2.0**-24))
    f.node("Mul", x, f.constant(rate))
    f.node("Erf")
    f.node("Add", f.last, f.constant(1.0))
    f.node("Mul", x, f.last)
    f.node("Mul", f.last, f.constant(0.5))
    file = f.write(tmp_path / "net.onnx")
    for z in (-2.0, 0.3, 1.0, 3.7):
        low, high = at(file, np.array([z]), "real")
        with mp.workprec(200):
            z = mp.mpf(float(np.float64(z)))
            exact = z * (mp.erf(z * mp.mpf(float(rate))) + 1) / 2
            assert mp.mpf(float(low[0])) <= exact <= mp.mpf(float(high[0])) and high[0] - low[0] < 1e-11


@pytest.mark.parametrize("divides", [True, False])
def test_hard_swish_keeps_the_files_constants(divides: bool, tmp_path: Path) -> None:
    f = OnnxFile((1,))
    x, sixth = f.last, np.float32(1.0 / 6.0)
    f.node("Add", x, f.constant(3.0))
    f.node("Clip", f.last, f.constant(0.0), f.constant(6.0))
    f.node("Mul", x, f.last)
    f.node("Div" if divides else "Mul", f.last, f.constant(6.0 if divides else sixth))
    file = f.write(tmp_path / "net.onnx")
    for z in (-3.5, -2.9999999, 0.7, 2.99999, 8.0):
        low, high = at(file, np.array([z]), "real")
        by = Fraction(1, 6) if divides else Fraction(float(sixth))
        exact = Fraction(z) * min(max(Fraction(z) + 3, Fraction(0)), Fraction(6)) * by
        assert Fraction(float(low[0])) <= exact <= Fraction(float(high[0])) and high[0] - low[0] < 1e-11


@pytest.mark.parametrize("alpha", [1.0 / 6.0, 0.16666, 0.2])
def test_hard_sigmoid_gates_keep_the_files_constants(alpha: float, tmp_path: Path) -> None:
    f = OnnxFile((1,))
    x = f.last
    f.node("HardSigmoid", alpha=alpha, beta=0.5)
    f.node("Mul", x, f.last)
    file, a = f.write(tmp_path / "net.onnx"), Fraction(float(np.float32(alpha)))
    for z in (-4.0, -2.9999, 0.1, 2.4999, 5.0):
        low, high = at(file, np.array([z]), "real")
        exact = Fraction(z) * min(max(a * Fraction(z) + Fraction(1, 2), Fraction(0)), Fraction(1))
        assert Fraction(float(low[0])) <= exact <= Fraction(float(high[0])) and high[0] - low[0] < 1e-11


@pytest.mark.slow_cases
@pytest.mark.parametrize("beta", [1.0, 1.3, 7.0])
@pytest.mark.parametrize("limit", [17.0, 20.0])
def test_softplus_switches_where_the_file_says(beta: float, limit: float, tmp_path: Path) -> None:
    f = OnnxFile((1,))
    x = f.last
    f.node("Mul", x, f.constant(beta))
    scaled = f.last
    above = f.node("Greater", scaled, f.constant(limit))
    f.node("Softplus", scaled)
    curved = f.node("Div", f.last, f.constant(beta))
    f.node("Where", above, x, curved)
    file, b = f.write(tmp_path / "net.onnx"), float(np.float32(beta))
    for z in (limit / b * 0.999, limit / b * 1.001, 2.0 * limit / b):
        z = float(np.float32(z))
        low, high = at(file, np.array([z]), "real")
        with mp.workprec(200):
            u = mp.mpf(z) * mp.mpf(b)
            exact = mp.mpf(z) if u > limit else mp.log(1 + mp.exp(u)) / mp.mpf(b)
            assert mp.mpf(float(low[0])) <= exact <= mp.mpf(float(high[0])) and high[0] - low[0] < 1e-5


# ---------------------------------------------------------------- resizing


@pytest.mark.slow_cases
@pytest.mark.parametrize("coordinates", ["half_pixel", "pytorch_half_pixel", "asymmetric", "align_corners"])
@pytest.mark.parametrize("mode", ["floor", "ceil", "round_prefer_floor", "round_prefer_ceil"])
def test_nearest_pixels_are_onnxruntimes(coordinates: str, mode: str, tmp_path: Path) -> None:
    sizes = [(n, m) for n in (1, 2, 7, 14, 20, 29, 47) for m in (1, 3, 12, 30, 46, 50)]
    for n, m in sizes:
        f = OnnxFile((1, 1, n))
        f.node(
            "Resize", f.last, "", "", f.constant([1, 1, 1, m], np.int64),
            mode="nearest", coordinate_transformation_mode=coordinates, nearest_mode=mode,
        )  # fmt: skip
        taken = run(f.write(tmp_path / "net.onnx"), np.arange(n, dtype=np.float32).reshape(1, 1, n))
        assert np.array_equal(nearest_pixels(n, m, coordinates, mode, m / n), taken), (n, m)


@pytest.mark.parametrize(("n", "m"), [(14, 46), (20, 12), (7, 1)])
def test_resized_networks_are_read(n: int, m: int, tmp_path: Path) -> None:
    f = OnnxFile((1, 1, n))
    f.node("Resize", f.last, "", "", f.constant([1, 1, 1, m], np.int64), mode="nearest", nearest_mode="floor")
    x = np.arange(n, dtype=np.float32).reshape(1, 1, n)
    low, _ = at(f.write(tmp_path / "net.onnx"), x)
    assert np.abs(low - run(tmp_path / "net.onnx", x)).max() < 1e-3


# ---------------------------------------------------------------- the comparison with onnxruntime


@pytest.mark.parametrize("threshold", [10.0, -30.0, 250.0])
def test_the_comparison_reaches_units_that_pictures_do_not(threshold: float, tmp_path: Path) -> None:
    """A reading that is wrong only where a unit is open that is closed for all pictures."""
    from ns_abstract.verify.network import load

    f = OnnxFile((4,))
    f.node("Sub", f.last, f.constant(threshold))
    f.node("Neg") if threshold < 0.0 else None
    f.node("Relu")
    f.gemm(4, 2)
    file = f.write(tmp_path / "net.onnx")
    good = onnx_runner(file, "", (4,))
    network = load_network(file)

    def wrong(image: np.ndarray) -> np.ndarray:
        bent = np.maximum((image - threshold) * np.sign(threshold), 0.0).sum()
        return good(image) + np.float32(bent)

    load.compare(network, good, load.probes(network)[1], usual=False)
    with pytest.raises(InputError, match="something else when run"):
        load.compare(network, wrong, load.probes(network)[1], usual=False)


def test_a_network_whose_float32_is_far_from_exact_is_still_read(tmp_path: Path) -> None:
    f = OnnxFile((2,))
    f.node("Add", f.last, f.constant(2.0**20))
    f.node("Sub", f.last, f.constant(2.0**20))
    f.node("Mul", f.last, f.constant(3.0))
    assert load_network(f.write(tmp_path / "net.onnx")).output_size == 2
    assert torch.get_default_dtype() == torch.float32


# ---------------------------------------------------------------- quantised files


def quantised(f: OnnxFile, x: str, scale: float, zero: int, kind: type = np.uint8) -> str:
    """A value rounded to steps."""
    given = [f.constant(scale), f.constant(zero, kind)]
    f.node("QuantizeLinear", x, *given)
    return f.node("DequantizeLinear", f.last, *given)


def integer_constants(f: OnnxFile, rng: np.random.Generator, shape: tuple[int, ...], step: float) -> tuple[str, str]:
    """Weights of 8 bits (7, if sums of bytes saturate) and a bias of 32 bits for 6 results, for steps of ``step``."""
    fine, most = f.constant(0.005), 127 if bytes_are_summed_exactly() else 64
    w = f.node("DequantizeLinear", f.constant(rng.integers(-most, most + 1, shape), np.int8), fine)
    bias = f.constant(rng.integers(-2000, 2000, 6), np.int32)
    return w, f.node("DequantizeLinear", bias, f.constant(np.float32(0.005) * np.float32(step)))


@pytest.mark.parametrize("axis", [None, 0])
def test_stored_integers_are_weights(axis: int | None, tmp_path: Path) -> None:
    f, rng = OnnxFile((4,)), np.random.default_rng(0)
    x, q = f.last, rng.integers(-128, 128, (3, 4)).astype(np.int8)
    scale = rng.uniform(0.01, 0.1, 3 if axis == 0 else ()).astype(np.float32)
    zero = rng.integers(-5, 5, scale.shape).astype(np.int8)
    given = [f.constant(q, np.int8), f.constant(scale), f.constant(zero, np.int8)]
    w = f.node("DequantizeLinear", *given, axis=0)
    f.node("Gemm", x, w, transB=1)
    file, point = f.write(tmp_path / "net.onnx"), rng.normal(size=4).astype(np.float32)
    exact = [
        sum((int(q[i, j]) - int(np.reshape(zero, -1)[i if axis == 0 else 0]))
            * Fraction(float(np.reshape(scale, -1)[i if axis == 0 else 0])) * Fraction(float(point[j]))
            for j in range(4))
        for i in range(3)
    ]  # fmt: skip
    for arithmetic in ("real", "float32"):
        low, high = at(file, point, arithmetic)
        assert all(Fraction(float(a)) <= w <= Fraction(float(b)) for a, w, b in zip(low, exact, high, strict=True))
        assert (high - low < (1e-12 if arithmetic == "real" else 1e-4)).all()
    value = run(file, point)
    assert (low <= value).all() and (value <= high).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_values_that_are_rounded_to_steps_are_contained(seed: int, tmp_path: Path) -> None:
    f = OnnxFile((4,), seed=seed)
    x, rng = quantised(f, f.last, 0.05, 128), np.random.default_rng(seed)
    f.node("Gemm", x, *integer_constants(f, rng, (6, 4), 0.05), transB=1)
    f.node("Relu")
    quantised(f, f.last, 0.03, 0)
    f.gemm(6, 2)
    file = f.write(tmp_path / "net.onnx")
    for _ in range(40):
        point = rng.normal(size=4).astype(np.float32) * 4.0
        low, high = at(file, point)
        value = run(file, point)
        assert (low <= value).all() and (value <= high).all() and (high - low < 1.0).all()


def product_of_steps(file: Path, product: str, floats: str, before: str = "", behind: str = "") -> Path:
    """Values of 8 bits times constants, rounded to steps again unless ``behind`` is "end".

    ``floats``: which of the constants are no stored integers.
    """
    f, rng = OnnxFile((8, 1, 1) if product == "Conv" else (8,)), np.random.default_rng(0)
    x = quantised(f, f.last, 0.02, 128)
    if before:
        f.last = x
        x = f.node(before, **({"perm": [0, 1, 2, 3]} if before == "Transpose" and product == "Conv" else {}))
    shape = (6, 8, 1, 1) if product == "Conv" else (6, 8)
    w, b = integer_constants(f, rng, shape if product != "MatMul" else (8, 6), 0.02)
    if "weights" in floats:
        w = f.constant(rng.normal(size=shape if product != "MatMul" else (8, 6)))
    if "bias" in floats:
        b = f.constant(rng.normal(size=6))
    if product == "MatMul":
        f.node("MatMul", x, w)
        if floats:
            f.node("Add", f.last, b)
    else:
        f.node(
            product,
            x,
            w,
            *([b] if behind != "BatchNormalization" else []),
            **({"transB": 1} if product == "Gemm" else {}),
        )
    if behind == "BatchNormalization":
        f.node(behind, f.last, *(f.constant(v) for v in rng.uniform(0.5, 1.0, (4, 6))))
    elif behind not in ("", "end"):
        f.node(behind)
    if behind != "end":
        quantised(f, f.last, 0.05, 128)
    return f.write(file)


PRODUCTS_OF_STEPS = [
    ("Gemm", "weights", "", ""), ("Gemm", "bias", "", ""), ("Gemm", "weights", "Identity", ""),
    ("Conv", "weights", "Transpose", ""), ("Conv", "bias", "", "Relu"), ("Conv", "", "", "BatchNormalization"),
    ("MatMul", "bias", "", ""), ("MatMul", "weights, bias", "Identity", "Relu"),
]  # fmt: skip


@pytest.mark.parametrize("product, floats, before, behind", PRODUCTS_OF_STEPS)
def test_floats_that_onnxruntime_rounds_are_refused(
    product: str, floats: str, before: str, behind: str, tmp_path: Path
) -> None:
    """It stores such weights in 8 bits and rounds the bias, and its outputs leave the bounds."""
    with pytest.raises(InputError, match="which gives steps again"):
        load_network(product_of_steps(tmp_path / "net.onnx", product, floats, before, behind))


@pytest.mark.parametrize("product, behind", [("Gemm", ""), ("Gemm", "end"), ("Conv", "Relu"), ("MatMul", "")])
@pytest.mark.parametrize("kind", ["scale", "zero", "alpha"])
def test_a_bias_whose_scale_onnxruntime_does_not_read_is_refused(
    kind: str, product: str, behind: str, tmp_path: Path
) -> None:
    """It takes the product of the scales of steps and weights, and its outputs leave the bounds."""
    file = product_of_steps(tmp_path / "net.onnx", product, "sum" if product == "MatMul" else "", "", behind)
    load_network(file)
    model = onnx.load(file)
    made = {name: node for node in model.graph.node for name in node.output}
    reader = next(node for node in model.graph.node if node.op_type == ("Add" if product == "MatMul" else product))
    bias = made[reader.input[-1]]
    if product == "Gemm" and kind == "alpha":
        reader.attribute.append(helper.make_attribute("alpha", 0.5))
    elif kind == "scale":
        model.graph.initializer.append(numpy_helper.from_array(np.array(1.05e-4, np.float32), "other"))
        bias.input[1] = "other"
    else:
        model.graph.initializer.append(numpy_helper.from_array(np.array(1, np.int32), "other"))
        bias.input.append("other")
    file.write_bytes(model.SerializeToString())
    with pytest.raises(InputError, match="whose bias has another scale"):
        load_network(file)


@pytest.mark.parametrize("product, floats, behind", [("Gemm", "weights, bias", "end"), ("Conv", "weights, bias", "end"),
    ("Gemm", "", ""), ("Conv", "", "Relu"), ("MatMul", "", "")])  # fmt: skip
def test_products_of_steps_that_are_not_rounded_are_contained(
    product: str, floats: str, behind: str, tmp_path: Path
) -> None:
    file = product_of_steps(tmp_path / "net.onnx", product, floats, "", behind)
    size = (8, 1, 1) if product == "Conv" else (8,)
    for point in 2.0 * np.random.default_rng(1).normal(size=(20, *size)).astype(np.float32):
        low, high = at(file, point)
        value = run(file, point)
        assert (low <= value).all() and (value <= high).all()


def sums_at_their_ends(file: Path, product: str, most: int, steps: type, stored: type = np.int8) -> np.ndarray:
    """A product of 64 values with weights all ``most``, and inputs at both ends of the steps."""
    f = OnnxFile((64, 1, 1) if product == "Conv" else (64,))
    shape = {"Conv": (6, 64, 1, 1), "MatMul": (64, 6), "Gemm": (6, 64)}[product]
    w = f.node("DequantizeLinear", f.constant(np.full(shape, most), stored), f.constant(0.01))
    x = quantised(f, "image", 0.02, 0, steps)
    f.node(product, x, w, **({"transB": 1} if product == "Gemm" else {}))
    quantised(f, f.last, 2.0, 0, steps)
    f.write(file)
    return np.stack([np.full((64, *shape[2:]), end, np.float32) for end in (-9.0, 9.0)])


@pytest.mark.parametrize("product", ["Conv", "MatMul", "Gemm"])
@pytest.mark.parametrize("most, stored", [(127, np.int8), (-128, np.int8), (64, np.int8), (255, np.uint8)])
@pytest.mark.parametrize("steps", [np.int8, np.uint8])
def test_sums_of_bytes_are_contained_or_refused(
    product: str, most: int, stored: type, steps: type, tmp_path: Path
) -> None:
    """onnxruntime saturates sums of pairs where the processor cannot add products of bytes in 32 bits."""
    file = tmp_path / "net.onnx"
    points = sums_at_their_ends(file, product, most, steps, stored)
    if abs(most) > 64 and stored is np.int8 and not bytes_are_summed_exactly():
        with pytest.raises(InputError, match="int8 weights beyond 64, whose products saturate"):
            read_onnx(file)
        return
    for point in points:
        low, high = at(file, point)
        value = run(file, point)
        assert (low <= value).all() and (value <= high).all()


def test_bytes_are_refused_where_their_sums_saturate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(byte_sums, "bytes_are_summed_exactly", lambda: False)
    file = tmp_path / "net.onnx"
    for most, stored in ((64, np.int8), (-64, np.int8), (255, np.uint8)):
        sums_at_their_ends(file, "Gemm", most, np.uint8, stored)
        read_onnx(file)
    for most in (65, -128):
        sums_at_their_ends(file, "Gemm", most, np.uint8)
        with pytest.raises(InputError, match=r"int8 weights beyond 64.*saturate") as caught:
            read_onnx(file)
        assert "reduce_range" in (caught.value.fix or "")
    f = OnnxFile((4,))
    f.node(
        "Gemm", f.last, f.node("DequantizeLinear", f.constant(np.full((3, 4), 127), np.int8), f.constant(0.1)), transB=1
    )
    read_onnx(f.write(file))


@pytest.mark.parametrize("through", ["", "Identity"])
def test_signed_second_operands_are_refused_where_sums_saturate(
    through: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(byte_sums, "bytes_are_summed_exactly", lambda: False)
    for kind, refused in ((np.uint8, False), (np.int8, True)):
        f = OnnxFile((4,))
        first = quantised(f, f.node("Reshape", "image", f.constant([1, 2, 2], np.int64)), 0.1, 0, kind)
        second = f.node(through, first) if through else first
        f.node("MatMul", first, second)
        f.node("Flatten")
        f.write(tmp_path / "net.onnx")
        if refused:
            with pytest.raises(InputError, match=r"int8 values to MatMul .* as its second operand"):
                read_onnx(tmp_path / "net.onnx")
        else:
            read_onnx(tmp_path / "net.onnx")


def bytes_times_values(file: Path, through: str, product: str, integers: type = np.int8) -> Path:
    """Values near 1/2 times a matrix of stored integers, and a constant that hides small differences."""
    f, rng = OnnxFile((8,)), np.random.default_rng(0)
    # the first that stores 16 bits
    f.opset = 21 if integers is np.int16 else f.opset
    x = f.node("Sigmoid")
    if through == "steps":
        x = quantised(f, x, 1.0 / 255.0, 0)
    most = 127 if bytes_are_summed_exactly() else 64
    given = [f.constant(rng.integers(-most, most + 1, (8, 8)), integers), f.constant(0.001), f.constant(0, integers)]
    w = f.node("DequantizeLinear", *given)
    if through not in ("", "steps"):
        w = f.node(through, w)
    if product == "Gemm transB":
        f.node("Gemm", x, w, transB=1)
    else:
        f.node(product, x, w)
    f.node("Add", f.last, f.constant(np.full(8, 10.0)))
    return f.write(file)


@pytest.mark.parametrize("through, product", [("", "MatMul"), ("", "Gemm"), ("Transpose", "MatMul"),
    ("Identity", "MatMul"), ("Transpose", "Gemm transB")])  # fmt: skip
def test_bytes_that_multiply_values_are_refused(through: str, product: str, tmp_path: Path) -> None:
    """There onnxruntime rounds the values, too, and its outputs leave the bounds."""
    with pytest.raises(InputError, match="8-bit weights"):
        load_network(bytes_times_values(tmp_path / "net.onnx", through, product))


@pytest.mark.slow
@pytest.mark.parametrize("through, product, integers", [("", "Gemm transB", np.int8), ("steps", "MatMul", np.int8),
    ("steps", "MatMul", np.uint8), ("", "MatMul", np.int16)])  # fmt: skip
def test_integers_that_multiply_as_stored_are_contained(
    through: str, product: str, integers: type, tmp_path: Path
) -> None:
    file = bytes_times_values(tmp_path / "net.onnx", through, product, integers)
    for point in np.random.default_rng(1).normal(size=(20, 8)).astype(np.float32):
        low, high = at(file, point)
        value = run(file, point)
        assert (low <= value).all() and (value <= high).all()


def test_integers_that_are_read_as_values_are_refused(tmp_path: Path) -> None:
    f = OnnxFile((4,))
    x = f.last
    f.node("QuantizeLinear", x, f.constant(0.1), f.constant(0, np.uint8))
    integers = f.last
    f.node("DequantizeLinear", integers, f.constant(0.2), f.constant(0, np.uint8))
    with pytest.raises(InputError, match="another scale"):
        load_network(f.write(tmp_path / "net.onnx"))
    f.node("Identity", integers)
    with pytest.raises(InputError, match="reads integers"):
        load_network(f.write(tmp_path / "net.onnx"))


def softmax_between_steps(file: Path, through: str, before: bool, integers: type) -> Path:
    f = OnnxFile((2, 8))
    # 16 bits are of operator set 21
    f.opset = 21 if integers is np.uint16 else f.opset
    x = quantised(f, f.last, 0.02, 128, integers) if before else f.last
    if through:
        x = f.node(through, x)
    f.node("Softmax", x, axis=-1)
    quantised(f, f.last, 1.0 / 255.0, 0, integers)
    return f.write(file)


@pytest.mark.parametrize("through", ["", "Identity", "Transpose"])
def test_a_softmax_between_steps_of_8_bits_is_refused(through: str, tmp_path: Path) -> None:
    """There onnxruntime takes exponentials from a table of integers, and its outputs leave the bounds."""
    with pytest.raises(InputError, match=r"\(Softmax\) of steps to 8 bits"):
        load_network(softmax_between_steps(tmp_path / "net.onnx", through, True, np.uint8))


@pytest.mark.parametrize("before, integers", [(False, np.uint8), (True, np.uint16)])
def test_a_softmax_that_is_computed_in_floats_is_contained(before: bool, integers: type, tmp_path: Path) -> None:
    file = softmax_between_steps(tmp_path / "net.onnx", "", before, integers)
    for point in 2.0 * np.random.default_rng(2).normal(size=(10, 2, 8)).astype(np.float32):
        low, high = at(file, point)
        value = run(file, point)
        assert (low <= value).all() and (value <= high).all()
