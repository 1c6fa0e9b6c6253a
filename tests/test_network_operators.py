"""Operators beside the plain layers: read like onnxruntime reads them, contained under attack, and tight."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from flint import arb
from onnx import helper
from onnx_files import OnnxFile, attack, image_sets, session

from ns_abstract.verify.network import ImageSets, bound_outputs, composite_activations, load_network
from ns_abstract.verify.network.bilinear import Product, ProductPlanes
from ns_abstract.verify.network.coefficients import Coefficients, grid
from ns_abstract.verify.network.layers import Gather
from ns_abstract.verify.network.scalar_function import ScalarFunction
from ns_abstract.verify.network.sparse_layers import PairwiseDifferences, SparseMatrix, TransposedConvolution

SHAPE = (3, 6, 6)
Build = Callable[[OnnxFile], object]


def _between(*inputs: object, op: str, **attributes: object) -> Build:
    """A function of every number between two convolutions."""

    def build(f: OnnxFile) -> None:
        f.conv(3, 3)
        names = [f.constant(v) if v is not None else "" for v in inputs]
        f.node(op, f.last, *names, **attributes)
        f.conv(3, 2)

    return build


def _silu(f: OnnxFile) -> None:
    x = f.conv(3, 3)
    f.node("Mul", x, f.node("Sigmoid"))
    f.conv(3, 2)


def _gelu(f: OnnxFile) -> None:
    x = f.conv(3, 3)
    f.node("Div", x, f.constant(np.sqrt(2.0)))
    f.node("Erf")
    f.node("Add", f.last, f.constant(1.0))
    f.node("Mul", x, f.last)
    f.node("Mul", f.last, f.constant(0.5))
    f.conv(3, 2)


def _squeeze_excite(f: OnnxFile) -> None:
    x = f.conv(3, 4)
    f.node("GlobalAveragePool")
    f.conv(4, 4, k=1)
    f.node("HardSigmoid")
    f.node("Mul", x, f.last)
    f.conv(4, 2)


def _product(f: OnnxFile) -> None:
    one = f.conv(3, 3)
    f.last = "image"
    f.node("Mul", one, f.conv(3, 3))
    f.node("Relu")
    f.conv(3, 2)


def _softmax(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("ReduceMean", axes=[2, 3], keepdims=0)
    f.node("Softmax", axis=1)
    f.gemm(4, 3)


def _log_softmax(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("ReduceMean", axes=[2, 3], keepdims=0)
    f.node("LogSoftmax", axis=-1)


def _layer_norm(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("Flatten")
    f.gemm(64, 8)
    f.node("LayerNormalization", f.last, f.weights(8), f.weights(8), axis=-1, epsilon=1e-5)
    f.node("Relu")
    f.gemm(8, 3)


def _layer_norm_in_steps(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("Flatten")
    x = f.gemm(64, 8)
    centred = f.node("Sub", x, f.node("ReduceMean", x, axes=[-1]))
    f.node("Pow", centred, f.constant(2.0))
    f.node("ReduceMean", axes=[-1])
    f.node("Add", f.last, f.constant(1e-5))
    f.node("Div", centred, f.node("Sqrt"))
    f.gemm(8, 3)


def _instance_norm(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("InstanceNormalization", f.last, f.weights(4), f.weights(4), epsilon=1e-5)
    f.node("Relu")
    f.conv(4, 2)


def _local_response(f: OnnxFile) -> None:
    f.conv(3, 7)
    f.node("Relu")
    f.node("LRN", size=3, alpha=0.3, beta=0.75, bias=0.9)
    f.node("Conv", f.last, f.weights(4, 7, 1, 1))
    # windows of more channels than there are
    f.node("LRN", size=11, alpha=2.0, beta=0.5)
    f.node("Conv", f.last, f.weights(2, 4, 1, 1))


def _fractional_power(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("Add", f.node("Relu"), f.constant(0.4))
    f.node("Pow", f.last, f.constant(1.3))
    f.node("Pow", f.last, f.constant(-0.2))
    f.conv(4, 2)


def _transposed(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("Relu")
    more = {"strides": [2, 1], "pads": [1, 0, 0, 1], "output_padding": [1, 0]}
    f.node("ConvTranspose", f.last, f.weights(4, 3, 3, 2), f.weights(3), **more)
    f.node("Relu")
    f.conv(3, 2)
    f.node("ConvTranspose", f.last, f.weights(2, 1, 2, 2), strides=[2, 2], group=2)


def _resize(f: OnnxFile) -> None:
    f.batch = 1
    f.conv(3, 4)
    f.node("Relu")
    nearest = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    f.node("Resize", f.last, "", f.constant([1, 1, 2, 2]), mode="nearest", **nearest)
    f.conv(4, 3)
    f.node("Resize", f.last, "", "", f.constant([1, 3, 7, 9], np.int64), mode="linear")
    f.conv(3, 2)


def _split(f: OnnxFile) -> None:
    f.conv(3, 6)
    f.node("Relu")
    f.nodes.append(helper.make_node("Split", [f.last], ["one", "two"], axis=1))
    f.node("Mul", "one", "two")
    f.conv(3, 2)


def _attention(f: OnnxFile) -> None:
    f.batch = 1
    f.conv(3, 4, k=2, strides=[3, 3])
    f.node("Reshape", f.last, f.constant([1, 4, -1], np.int64))
    x = f.node("Transpose", perm=[0, 2, 1])
    q, k, v = (f.node("MatMul", x, f.weights(4, 4)) for _ in range(3))
    f.node("MatMul", q, f.node("Transpose", k, perm=[0, 2, 1]))
    f.node("Softmax", axis=-1)
    f.node("Add", x, f.node("MatMul", f.last, v))
    f.node("Gather", f.last, f.constant(0, np.int64), axis=1)


def _extremes(f: OnnxFile) -> None:
    one = f.conv(3, 3)
    f.last = "image"
    f.node("Max", one, f.conv(3, 3))
    f.node("Min", f.last, f.constant(0.5))
    f.node("Abs")
    f.conv(3, 2)


def _rounded_up(f: OnnxFile) -> None:
    f.conv(3, 3, k=2)
    f.node("MaxPool", kernel_shape=[2, 2], strides=[2, 2], ceil_mode=1)
    f.node("AveragePool", kernel_shape=[2, 2], strides=[2, 2], ceil_mode=1)
    f.conv(3, 2, k=1)


def _blocks(f: OnnxFile) -> None:
    f.conv(3, 8)
    f.node("DepthToSpace", blocksize=2, mode="CRD")
    f.node("Relu")
    f.node("SpaceToDepth", blocksize=2)
    backwards = [f.constant([v], np.int64) for v in (-1, -100, 3, -1)]
    f.node("Slice", f.last, *backwards)
    f.conv(8, 2)


def _means(f: OnnxFile) -> None:
    x = f.conv(3, 4)
    f.node("Sub", x, f.node("ReduceMean", axes=[1], keepdims=1))
    f.node("Relu")
    f.node("ReduceMax", axes=[3], keepdims=0)
    f.node("Gather", f.last, f.constant([0, 2, 2], np.int64), axis=1)
    f.node("ReduceSum", f.last, f.constant([2], np.int64), keepdims=0)


def _token(f: OnnxFile) -> None:
    f.batch = 1
    f.conv(3, 4)
    f.node("Reshape", f.last, f.constant([1, 4, 16], np.int64))
    f.node("Transpose", perm=[2, 0, 1])
    f.node("Concat", f.weights(1, 1, 4), f.last, axis=0)
    f.node("Relu")
    f.node("Slice", f.last, f.constant([0], np.int64), f.constant([3], np.int64), f.constant([0], np.int64))
    f.node("Where", f.constant(np.eye(3, 4).reshape(3, 1, 4), bool), f.last, f.constant(0.5))
    f.node("Reshape", f.last, f.constant([1, 12], np.int64))
    f.gemm(12, 3)


def _masked(f: OnnxFile, mask: np.ndarray, scale: float = 1.0) -> None:
    """Attention of four tokens of which some see others only."""
    f.batch = 1
    f.conv(3, 4, k=2, strides=[3, 3])
    f.node("Reshape", f.last, f.constant([1, 4, -1], np.int64))
    x = f.node("Transpose", perm=[0, 2, 1])
    q, k, v = (f.node("MatMul", x, f.weights(4, 4, scale=scale)) for _ in range(3))
    f.node("MatMul", q, f.node("Transpose", k, perm=[0, 2, 1]))
    f.node("Add", f.last, f.constant(mask))
    shares = f.node("Softmax", axis=-1)
    f.node("Where", f.node("IsNaN"), f.constant(0.0), shares)
    f.node("Add", x, f.node("MatMul", f.last, v))
    f.node("Gather", f.last, f.constant(2, np.int64), axis=1)


_CAUSAL = np.triu(np.ones((4, 4), np.float32), 1)


def _masked_by_infinity(f: OnnxFile) -> None:
    _masked(f, np.where(_CAUSAL, -np.inf, 0.25 * _CAUSAL.T), scale=4.0)


def _masked_by_the_least_number(f: OnnxFile) -> None:
    _masked(f, np.where(_CAUSAL.T, np.finfo(np.float32).min, 0.0)[::-1])


def _masked_by_a_hundred(f: OnnxFile) -> None:
    _masked(f, -100.0 * np.array([[0, 1, 1, 0], [1, 0, 0, 1], [1, 0, 0, 0], [0, 1, 1, 1]]))


def _sharp(f: OnnxFile) -> None:
    _masked(f, np.zeros((4, 4)), scale=6.0)


def _einsum(f: OnnxFile) -> None:
    f.batch = 1
    x = f.conv(3, 4, k=2, strides=[2, 2])
    f.node("Einsum", x, f.weights(4, 3), equation="bchw,cd->bhdw")
    f.node("Einsum", f.last, f.weights(3, 2, 3), equation="bhdw,hkd->bkw")
    f.node("Einsum", x, f.last, equation="bchw,bkw->bkcw")
    f.node("Relu")
    f.node("Einsum", f.last, equation="bkcw -> bck")
    f.node("Einsum", f.weights(5, 2), f.last, equation="ak,bck->bac")
    f.node("Relu")
    f.node("Flatten")
    f.gemm(20, 3)


def _line(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("Reshape", f.last, f.constant([0, 4, -1], np.int64))
    f.node("Conv", f.last, f.weights(6, 2, 3), f.weights(6), group=2, pads=[1, 0], strides=[2], dilations=[2])
    f.node("Relu")
    f.node("AveragePool", kernel_shape=[3], strides=[2], pads=[1, 1])
    f.node("ConvTranspose", f.last, f.weights(6, 3, 2), strides=[2], output_padding=[1])
    f.node("MaxPool", kernel_shape=[2], ceil_mode=1, strides=[2])
    f.node("Conv", f.last, f.weights(2, 3, 2), auto_pad="SAME_UPPER")
    f.node("GlobalAveragePool")


def _taken(f: OnnxFile) -> None:
    f.batch, f.opset = 1, 19
    x = f.conv(3, 3)
    f.node("Relu")
    f.node("GatherND", f.last, f.constant([[0, 2], [0, -1], [-1, 0]], np.int64))
    f.node("Unsqueeze", f.last, f.constant([0], np.int64))
    f.node("Pad", f.last, f.constant([0, 0, 2, 1, 0, 1, 0, 3], np.int64), mode="wrap")
    f.node("Resize", f.last, "", "", f.constant([1, 4, 7, 9], np.int64), mode="cubic", cubic_coeff_a=-0.5)
    f.conv(4, 2)
    f.node("Add", f.last, f.node("ReduceL1", x, f.constant([1, 2, 3], np.int64)))


def _normalised(f: OnnxFile) -> None:
    f.conv(3, 4)
    x = f.node("ReduceMean", axes=[2, 3], keepdims=0)
    norm = f.node("Clip", f.node("ReduceL2", axes=[1], keepdims=1), f.constant(1e-12))
    f.node("Div", x, norm)
    f.node("Add", f.last, f.node("ReduceSumSquare", x, axes=[1]))
    f.node("Softsign")
    f.gemm(4, 3)


CASES: dict[str, Build] = {
    "clip": _between(-0.5, 0.7, op="Clip"),
    "clip below": _between(-0.5, op="Clip"),
    "hard sigmoid": _between(op="HardSigmoid"),
    "hard swish": _between(op="HardSwish"),
    "elu": _between(op="Elu", alpha=1.3),
    "celu": _between(op="Celu", alpha=0.7),
    "selu": _between(op="Selu"),
    "softplus": _between(op="Softplus"),
    "erf": _between(op="Erf"),
    "exp": _between(op="Exp"),
    "prelu": _between(np.array([0.2, -0.5, 1.5]).reshape(3, 1, 1), op="PRelu"),
    "cube": _between(3.0, op="Pow"),
    **{
        name[1:].replace("_", " "): build
        for name, build in list(globals().items())
        if name.startswith("_")
        and name not in ("_between", "_masked")
        and callable(build)
        and getattr(build, "__module__", "") == __name__
    },
}


def written(name: str, folder: Path, seed: int = 0) -> Path:
    f = OnnxFile(SHAPE, seed)
    CASES[name](f)
    return f.write(folder / "net.onnx")


def _rows(size: int) -> np.ndarray:
    return np.random.default_rng(5).normal(size=(3, size))


#: How much wider than what the attack reached a bound of a narrow set may be.
LEDGER = {"layer norm in steps": 3.0, "attention": 2.6}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_contained_under_attack(name: str, tmp_path: Path) -> None:
    file = written(name, tmp_path)
    network, run = load_network(file), session(file)
    x = np.random.default_rng(0).normal(size=(3, *SHAPE)).astype(np.float32)
    np.testing.assert_allclose(network(torch.from_numpy(x)).numpy(), run(x), rtol=2e-5, atol=5e-6)
    rows = _rows(network.output_size)
    for d, radius, slack in ((2, 0.1, 0.01), (1, 0.5, 0.2), (2, 0.003, 1e-7)):
        images = image_sets(SHAPE, 1, d, radius, slack, 1)
        bounds = bound_outputs(network, images, rows, np.zeros(3))
        least, compared = attack(network, run, images, 0, rows, 48, 8)
        assert (bounds.lower[0] <= least).all() and np.isfinite(bounds.lower).all()
        assert compared > 40
        assert (bounds.b - np.abs(bounds.a).sum(-1) <= bounds.lower + 1e-9 * np.abs(bounds.lower)).all()


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", CASES)
def test_narrow_sets_have_tight_bounds(name: str, tmp_path: Path) -> None:
    file = written(name, tmp_path)
    network, run = load_network(file), session(file)
    rows = _rows(network.output_size)
    images = image_sets(SHAPE, 1, 2, 0.01, 1e-4, 1)
    middle = 0.5 * (images.b_lower + images.b_upper)
    nominal = rows @ network(torch.from_numpy(middle).reshape(1, *SHAPE))[0].numpy()
    least, _ = attack(network, run, images, 0, rows, 48, 12)
    lower = bound_outputs(network, images, rows, np.zeros(3)).lower[0]
    assert (nominal - lower).max() <= LEDGER.get(name, 2.0) * (nominal - least).max() + 1e-3


# ---------------------------------------------------------------- planted faults: the attack finds wrong rules


def _slopes_exchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    def plane(self, x, y):
        found = original(self, x, y)
        return ProductPlanes(found.second, found.first, found.low, found.high)

    original = Product.plane
    monkeypatch.setattr(Product, "plane", plane)


def _touching_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def extreme(cuts, line, side):
        height = cuts.value - line * cuts.z
        return height[len(height) // 2]

    monkeypatch.setattr(ScalarFunction, "_extreme", staticmethod(extreme))


def _sparse_not_passed_back(monkeypatch: pytest.MonkeyPatch) -> None:
    def backward(self, rows):
        found = original(self, rows)
        return [type(found[0])(0.9 * found[0].value, found[0].y, found[0].x), *found[1:]]

    original = SparseMatrix.backward
    monkeypatch.setattr(SparseMatrix, "backward", backward)


def _transposed_shifted(monkeypatch: pytest.MonkeyPatch) -> None:
    def backward(self, rows):
        (found,) = original(self, rows)
        return [type(found)(np.ascontiguousarray(found.value[..., ::-1]), found.y, found.x)]

    original = TransposedConvolution.backward
    monkeypatch.setattr(TransposedConvolution, "backward", backward)


MUTANTS = {
    "slopes exchanged": (_slopes_exchanged, "product"),
    "line through the middle": (_touching_line, "silu"),
    "sparse rows too small": (_sparse_not_passed_back, "resize"),
    "transposed rows turned": (_transposed_shifted, "transposed"),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_attack_catches(mutant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mutate, name = MUTANTS[mutant]
    file = written(name, tmp_path)
    network, run = load_network(file), session(file)
    rows = _rows(network.output_size)
    images = image_sets(SHAPE, 1, 2, 0.3, 0.1, 1)
    least, _ = attack(network, run, images, 0, rows, 48, 12)
    # planes of a narrow set, where a wrong rule cannot hide in their room
    narrow = image_sets(SHAPE, 1, 2, 0.02, 1e-6, 1)
    p = np.array(list(itertools.product((-0.9, 0.9), repeat=2)))
    x = 0.5 * (narrow.b_lower + narrow.b_upper) + p @ (0.5 * (narrow.a_lower + narrow.a_upper))[0].T
    y = run(x.astype(np.float32).reshape(-1, *SHAPE)).astype(np.float64) @ rows.T

    def hold() -> bool:
        lower = bound_outputs(network, images, rows, np.zeros(3)).lower[0]
        planes = bound_outputs(network, narrow, rows, np.zeros(3))
        below = p @ planes.a[0].T + planes.b[0] <= y
        return bool((lower <= least).all() and np.isfinite(lower).all() and below.all())

    assert hold()
    mutate(monkeypatch)
    assert not hold()


@pytest.mark.parametrize("window", [(1, 1), (2, 3), (4, 5)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rows_of_gathered_numbers_are_those_of_the_matrix(window: tuple[int, int], dtype: type) -> None:
    """Windows that lie partly outside, numbers that are taken twice and constants."""
    rng = np.random.default_rng(0)
    shape, before = (3, 4, 5), (2, 7)
    index = rng.integers(-1, 14, int(np.prod(shape)))
    layer = Gather((before,), shape, 14, 1, torch.from_numpy(index), 0.5)
    value = rng.integers(-9, 9, (6, 3, *window)).astype(dtype)
    y, x = (rng.integers(1 - side, size, 6) for side, size in zip(window, shape[1:], strict=True))
    matrix = (index[:, None] == np.arange(14)).astype(dtype)
    whole = np.zeros((6, *shape), dtype)
    for r, c, i, j in np.ndindex(6, 3, *window):
        if 0 <= y[r] + i < 4 and 0 <= x[r] + j < 5:
            whole[r, c, y[r] + i, x[r] + j] = value[r, c, i, j]
    (rows,) = layer.backward(Coefficients(value, y, x))
    assert rows.value.dtype == dtype and (rows.value.reshape(6, -1) == whole.reshape(6, -1) @ matrix).all()


@pytest.mark.parametrize(("shape", "axis"), [((4,), 0), ((3, 2), 0), ((3, 2), 1), ((2, 3, 4), 1), ((5, 1), 1)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_differences_are_those_of_the_matrix(shape: tuple[int, ...], axis: int, dtype: torch.dtype) -> None:
    count, size = shape[axis], int(np.prod(shape))
    layer = PairwiseDifferences((shape,), (*shape, count), count + 4, 2 * count, axis)
    # by the definition, entry by entry
    matrix = np.zeros((size * count, size))
    for place in np.ndindex(*shape):
        for j in range(count):
            other = (*place[:axis], j, *place[axis + 1 :])
            row = np.ravel_multi_index((*place, j), (*shape, count))
            matrix[row, np.ravel_multi_index(other, shape)] += 1.0
            matrix[row, np.ravel_multi_index(place, shape)] -= 1.0
    rng = np.random.default_rng(0)
    # small whole numbers: sums are exact
    x = torch.from_numpy(rng.integers(-9, 9, (2, *shape)).astype(np.float64))
    value = rng.integers(-9, 9, (3, size * count)).astype(np.float32 if dtype == torch.float32 else np.float64)
    assert (layer.apply([x]).flatten(1).numpy() == x.flatten(1).numpy() @ matrix.T).all()
    assert (layer.magnitude([x.abs()]).flatten(1).numpy() == x.abs().flatten(1).numpy() @ np.abs(matrix).T).all()
    (found,) = layer.backward(Coefficients.whole(value.reshape(3, *grid(layer.shape))))
    assert found.value.dtype == value.dtype
    assert (found.value.reshape(3, -1) == value @ matrix).all()


@pytest.mark.parametrize("gap", [29.5, 31.0, 60.0, 200.0])
def test_shares_past_the_cap_are_charged(gap: float, tmp_path: Path) -> None:
    """The share of a number far below the others is not lost, in real arithmetic either."""
    f = OnnxFile((3,))
    f.node("Add", f.last, f.constant([gap, 0.0, 1.0]))
    f.node("Softmax", axis=1)
    network = load_network(f.write(tmp_path / "net.onnx"))
    b = np.zeros((1, 3))
    images = ImageSets(np.zeros((1, 3, 1)), b, np.zeros((1, 3, 1)), b, b, b)
    rows = np.concatenate([np.eye(3), -np.eye(3)])
    found = bound_outputs(network, images, rows, np.zeros(6), arithmetic="real").lower[0]
    values = [arb(v).exp() for v in (float(np.float32(gap)), 0, 1)]
    shares = [v / sum(values, arb(0)) for v in values]
    for k, share in enumerate(shares):
        assert arb(found[k]) <= share and arb(found[3 + k]) <= -share
        assert float((share - arb(found[k])).upper()) < 2e-12 and float((-share - arb(found[3 + k])).upper()) < 2e-12
    # what the layers compute without their roundings, from the side of the smallest number
    cap, gaps = composite_activations.CAP, torch.tensor([gap, 0.0, 1.0], dtype=torch.float64)
    total = composite_activations.CappedExp((1,)).function(gaps).sum().clamp(max=float(np.exp(cap)))
    layer = composite_activations.SoftmaxReciprocal((1,))
    off = abs(arb(float(layer.function(total))) - shares[1])
    assert off <= float(torch.as_tensor(layer.missing(total, total))) + 2.0**-50 * float(layer.function(total))


def test_positions_of_resized_maps_are_charged(tmp_path: Path) -> None:
    """Positions that are computed in float32 give weights to numbers that real ones do not reach."""
    f = OnnxFile((1, 1, 4), batch=1)
    size = f.constant([1, 1, 1, 10], np.int64)
    f.node("Resize", f.last, "", "", size, mode="linear", coordinate_transformation_mode="align_corners")
    network = load_network(f.write(tmp_path / "net.onnx"))
    x = np.array([[1.0, 0.0, 1.0, 0.0]])
    images = ImageSets(np.zeros((1, 4, 1)), x, np.zeros((1, 4, 1)), x, x, x)
    found = bound_outputs(network, images, np.concatenate([np.eye(10), -np.eye(10)]), np.zeros(20)).lower[0]
    for step in (np.float32(1.0 / 3.0), np.nextafter(np.float32(1.0 / 3.0), np.float32(0.0))):
        place = (np.arange(10, dtype=np.float32) * step).astype(np.float32)
        low = np.minimum(np.floor(place), 2).astype(int)
        part = place - low.astype(np.float32)
        y = ((1 - part) * x[0, low].astype(np.float32) + part * x[0, low + 1].astype(np.float32)).astype(np.float64)
        assert (found[:10] <= y).all() and (found[10:] <= -y).all()
    assert (-found[10:] - found[:10]).max() < 1e-5


def test_a_domain_that_is_left_is_unknown(tmp_path: Path) -> None:
    f = OnnxFile(SHAPE)
    f.node("Flatten")
    f.gemm(108, 3)
    f.node("Sigmoid")
    f.node("Sub", f.last, f.constant(0.5))
    f.node("Abs")
    f.node("Add", f.last, f.constant(1e-3))
    f.node("Sub", f.last, f.constant(2e-3))
    f.node("Mul", f.last, f.last)
    f.node("Sub", f.last, f.constant(1e-9))
    f.node("Reciprocal")
    network = load_network(f.write(tmp_path / "net.onnx"))
    images = image_sets(SHAPE, 1, 1, 1.0, 0.5)
    assert (bound_outputs(network, images, np.eye(3), np.zeros(3)).lower == -np.inf).all()
