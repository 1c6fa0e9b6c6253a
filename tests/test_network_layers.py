"""Every layer rule: read like onnxruntime reads it, contained under attack, tight, and in each mode."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from onnx_files import OnnxFile, attack, boxed, image_sets, session

from ns_abstract.verify.network import ImageSets, bound_outputs, load_network, max_pool_propagation
from ns_abstract.verify.network.layers import Convolution, LeakyRelu, Matrix, ScaleLayer, Sum
from ns_abstract.verify.network.max_pooling import WindowInputs
from ns_abstract.verify.network.relaxations import MaxPoolPlanes

Build = Callable[[OnnxFile], object]


def _plain(f: OnnxFile) -> None:
    f.conv(3, 4, pads=[1, 1, 1, 1])
    f.node("Relu")
    f.conv(4, 4)
    f.node("Relu")
    f.conv(4, 2)


def _strides(f: OnnxFile) -> None:
    f.conv(3, 4, strides=[2, 1], pads=[0, 1, 2, 1])
    f.node("Relu")
    f.conv(4, 3, k=2, strides=[2, 3], dilations=[1, 2], pads=[1, 0, 0, 1])


def _groups(f: OnnxFile) -> None:
    f.conv(3, 6, k=1)
    f.node("Relu")
    f.conv(6, 4, groups=2, auto_pad="SAME_UPPER", strides=[2, 2])
    f.node("Relu")
    f.conv(4, 4, groups=4, auto_pad="SAME_LOWER", bias=False)


def _gemm(f: OnnxFile) -> None:
    f.node("Flatten", axis=1)
    f.gemm(3 * 7 * 8, 12)
    f.node("Relu")
    f.node("Gemm", f.last, f.weights(12, 6), f.weights(1, 6), alpha=0.5, beta=-2.0)
    f.node("Relu")
    f.node("MatMul", f.last, f.weights(6, 3))


def _residual(f: OnnxFile) -> None:
    stem = f.conv(3, 4, pads=[1, 1, 1, 1], strides=[2, 2])
    f.node("Relu")
    f.conv(4, 4, pads=[1, 1, 1, 1])
    f.node("Relu")
    branch = f.conv(4, 4, pads=[1, 1, 1, 1])
    f.last = stem
    short = f.conv(4, 4, k=1)
    f.node("Add", branch, short)
    total = f.node("Relu")
    f.conv(4, 4, pads=[1, 1, 1, 1])
    f.node("Sub", f.last, total)
    f.node("Add", f.last, f.last)
    f.node("Relu")
    f.conv(4, 2)


def _batch_norm(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node(
        "BatchNormalization",
        f.last,
        f.weights(4),
        f.weights(4),
        f.weights(4),
        f.constant(f.rng.uniform(0.1, 2, 4)),
        epsilon=1e-3,
    )
    f.node("Relu")
    f.conv(4, 2)


def _constants(f: OnnxFile) -> None:
    f.node("Sub", f.last, f.weights(1, 3, 1, 1))
    f.node("Div", f.last, f.constant(f.rng.uniform(0.5, 2, (3, 1, 1))))
    f.node("Add", f.constant(0.25), f.last)
    f.node("Sub", f.constant(0.5), f.last)
    f.node("Mul", f.last, f.weights(3, 7, 8))
    f.node("Neg")
    f.conv(3, 3)
    f.node("Relu")
    f.conv(3, 2)


def _average(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("Relu")
    f.node("AveragePool", kernel_shape=[2, 3], strides=[1, 2], pads=[1, 1, 0, 1], count_include_pad=1)
    f.conv(4, 4, k=1)
    f.node("Relu")
    f.node("AveragePool", kernel_shape=[3, 2], strides=[2, 1], pads=[1, 0, 2, 1])
    f.conv(4, 3, k=1)
    f.node("Relu")
    f.node("GlobalAveragePool")
    f.node("Flatten")
    f.gemm(3, 2)


def _reduce_mean(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("LeakyRelu", alpha=0.2)
    f.node("ReduceMean", axes=[2, 3], keepdims=0)
    f.gemm(4, 2)


def _max(f: OnnxFile) -> None:
    f.conv(3, 3)
    f.node("MaxPool", kernel_shape=[2, 2], strides=[2, 2])
    f.conv(3, 2, k=2)


def _max_overlap(f: OnnxFile) -> None:
    f.conv(3, 2)
    f.node("MaxPool", kernel_shape=[3, 2], strides=[2, 1], auto_pad="SAME_UPPER")
    f.node("MaxPool", kernel_shape=[2, 2], strides=[1, 1], pads=[1, 0, 0, 1])
    f.conv(2, 2, k=2)


def _max_dilated(f: OnnxFile) -> None:
    f.conv(3, 2, k=1)
    f.node("MaxPool", kernel_shape=[2, 3], strides=[2, 2], dilations=[2, 2], pads=[1, 2, 1, 1])
    f.conv(2, 2, k=2)


def _max_stem(f: OnnxFile) -> None:
    """As in a residual network: behind ReLUs, overlapping, padded, and read twice."""
    f.conv(3, 4, pads=[1, 1, 1, 1])
    f.node("Relu")
    pooled = f.node("MaxPool", kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
    f.conv(4, 4, pads=[1, 1, 1, 1])
    f.node("Relu")
    f.conv(4, 4, pads=[1, 1, 1, 1])
    f.node("Add", f.last, pooled)
    f.node("Relu")
    f.node("GlobalMaxPool")
    f.node("Flatten")
    f.gemm(4, 3)


def _max_wide(f: OnnxFile) -> None:
    """A window of more numbers than are compared in pairs."""
    f.conv(3, 3, k=1)
    f.node("MaxPool", kernel_shape=[6, 7], strides=[1, 1])
    f.node("MaxPool", kernel_shape=[1, 2], strides=[2, 1])
    f.conv(3, 2, k=1)


def _pads(f: OnnxFile) -> None:
    f.node("Pad", f.last, f.constant([0, 0, 1, 2, 0, 0, 0, 1], np.int64), f.constant(0.5))
    f.conv(3, 3)
    f.node("Relu")
    f.node("Pad", f.last, f.constant([0, 0, 0, 1, 0, 0, 2, 0], np.int64), mode="reflect")
    f.conv(3, 2)
    f.node("Pad", f.last, f.constant([0, 0, 2, 0, 0, 0, 0, 3], np.int64), mode="edge")
    f.conv(2, 2)
    f.node("Relu")
    f.node("Pad", f.last, f.constant([0, 1, 0, 0, 0, 0, 0, 0], np.int64), f.constant(-0.5))
    f.conv(3, 2)


def _shapes(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("Transpose", perm=[0, 2, 3, 1])
    f.node("Relu")
    f.node("Reshape", f.last, f.constant([0, -1], np.int64))
    f.gemm(5 * 6 * 4, 12)
    f.node("Relu")
    f.node("Reshape", f.last, f.constant([-1, 3, 2, 2], np.int64))
    f.conv(3, 2, k=2, pads=[1, 0, 0, 1])
    f.node("Unsqueeze", f.last, f.constant([1], np.int64))
    f.node("Squeeze", f.last, f.constant([1], np.int64))
    f.node("Identity")
    f.node("Dropout")
    f.node("Slice", f.last, f.constant([0, 1], np.int64), f.constant([2, 9], np.int64), f.constant([2, 3], np.int64))


def _concat(f: OnnxFile) -> None:
    one = f.conv(3, 2, pads=[1, 1, 1, 1])
    f.last = "image"
    f.conv(3, 3, k=1)
    two = f.node("Relu")
    f.node("Concat", one, two, axis=1)
    three = f.conv(5, 2)
    f.node("Relu")
    f.node("Concat", f.last, three, axis=-1)
    f.conv(2, 2)


def _leaky(f: OnnxFile) -> None:
    f.conv(3, 4)
    f.node("LeakyRelu", alpha=0.1)
    f.conv(4, 4)
    f.node("LeakyRelu", alpha=0.3)
    f.conv(4, 2)


def _sigmoid(f: OnnxFile) -> None:
    f.conv(3, 3)
    f.node("Sigmoid")
    f.conv(3, 3)
    f.node("Tanh")
    f.conv(3, 2)
    f.node("Sigmoid")


def _constant_node(f: OnnxFile) -> None:
    from onnx import numpy_helper

    f.conv(3, 2)
    before = f.last
    value = f.node("Constant", before, value=numpy_helper.from_array(np.float32(0.75)))
    f.nodes[-1].ClearField("input")
    f.node("Mul", before, value)
    f.node("Relu")
    f.conv(2, 2)


CASES: dict[str, Build] = {
    name[1:]: build
    for name, build in list(globals().items())
    if name.startswith("_") and callable(build) and getattr(build, "__module__", "") == __name__
}
#: How much wider than what the attack reached a bound may be, (nominal - bound) / (nominal - reached) with
#: rounding left out, for narrow sets: a rise means that a rule became looser.
LEDGER = {
    "max": 1.6,
    "max_overlap": 1.7,
    "max_dilated": 1.6,
    "max_wide": 2.5,
    "gemm": 1.5,
    "plain": 1.6,
    "pads": 1.8,
    "groups": 2.4,
}
SHAPE = (3, 7, 8)


def written(name: str, folder: Path, seed: int = 0) -> Path:
    f = OnnxFile(SHAPE, seed)
    CASES[name](f)
    return f.write(folder / f"{name}.onnx")


def rows_for(size: int, k: int = 4, seed: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(k, size))
    rows[0] = 0.0
    rows[0, rng.integers(size)] = 1.0
    return rows


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", CASES)
def test_read_like_onnxruntime(name: str, tmp_path: Path) -> None:
    for seed in range(3):
        file = written(name, tmp_path, seed)
        network, run = load_network(file), session(file)
        x = np.random.default_rng(seed).normal(size=(5, *SHAPE)).astype(np.float32)
        expected = run(x)
        np.testing.assert_allclose(network(torch.from_numpy(x)).numpy(), expected, rtol=2e-5, atol=2e-6)
        np.testing.assert_allclose(network(torch.from_numpy(x).double()).numpy(), expected, rtol=2e-5, atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(("d", "radius", "slack"), [(1, 0.1, 0.01), (2, 0.5, 0.3), (3, 0.003, 1e-7)])
def test_contained_under_attack(name: str, d: int, radius: float, slack: float, tmp_path: Path) -> None:
    # another network and other images at every number of parameters
    seed, compared = d, 0
    file = written(name, tmp_path, seed)
    network, run = load_network(file), session(file)
    rows = rows_for(network.output_size)
    offset = np.arange(4.0)
    images = image_sets(SHAPE, 2, d, radius, slack, seed)
    found = [bound_outputs(network, sets, rows, offset) for sets in (images, boxed(images))]
    for cell in range(2):
        least, count = attack(network, run, images, cell, rows)
        compared += count
        for bounds in found:
            assert np.isfinite(bounds.lower[cell]).all()
            assert (bounds.lower[cell] <= least + offset).all()
    # one row's plane, at every corner and in the middle
    for bounds in found:
        assert (bounds.b - np.abs(bounds.a).sum(-1) <= bounds.lower + 1e-9 * np.abs(bounds.lower)).all()
    assert compared > 250


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", CASES)
def test_planes_hold_at_every_parameter(name: str, tmp_path: Path) -> None:
    file = written(name, tmp_path)
    network, run = load_network(file), session(file)
    rows = rows_for(network.output_size)
    images = image_sets(SHAPE, 1, 2, 0.2, 0.02, 3)
    bounds = bound_outputs(network, images, rows, np.zeros(4))
    rng = np.random.default_rng(0)
    for _ in range(10):
        p = rng.uniform(-1, 1, 2)
        at = ImageSets(
            images.a_lower * 0,
            images.b_lower + images.a_lower @ p,
            images.a_upper * 0,
            images.b_upper + images.a_upper @ p,
            images.lower,
            images.upper,
        )
        least, _ = attack(network, run, at, 0, rows, 8, 3)
        assert (bounds.a[0] @ p + bounds.b[0] <= least).all()


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", CASES)
def test_narrow_sets_have_tight_bounds(name: str, tmp_path: Path) -> None:
    worst = 0.0
    for seed in range(3):
        file = written(name, tmp_path, seed)
        network, run = load_network(file), session(file)
        rows = rows_for(network.output_size)
        images = image_sets(SHAPE, 1, 2, 0.02, 0.005, seed)
        nominal = (
            rows @ network(torch.from_numpy(0.5 * (images.b_lower + images.b_upper)).reshape(1, *SHAPE))[0].numpy()
        )
        least, _ = attack(network, run, images, 0, rows, 32, 20)
        lower = bound_outputs(network, images, rows, np.zeros(4)).lower[0]
        middle = 0.5 * (images.b_lower + images.b_upper)
        zero = np.zeros_like(images.a_lower)
        single = bound_outputs(network, ImageSets(zero, middle, zero, middle, middle, middle), rows, np.zeros(4))
        moves = nominal - least > 1e-4
        assert (nominal - lower)[~moves].max(initial=0.0) < 1e-2
        worst = max(worst, float(((single.lower[0] - lower)[moves] / (nominal - least)[moves]).max(initial=0.0)))
    assert 0.0 < worst <= LEDGER.get(name, 1.4), worst


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", CASES)
def test_a_single_image_has_bounds_of_rounding_size(name: str, tmp_path: Path) -> None:
    file = written(name, tmp_path)
    network, run = load_network(file), session(file)
    rows = rows_for(network.output_size)
    x = np.random.default_rng(1).normal(size=(1, network.input_size)).astype(np.float32).astype(np.float64)
    zero = np.zeros((1, network.input_size, 2))
    bounds = bound_outputs(network, ImageSets(zero, x, zero, x, x, x), rows, np.zeros(4))
    y = rows @ run(x.astype(np.float32).reshape(1, *SHAPE))[0].astype(np.float64)
    assert (bounds.lower[0] <= y).all()
    assert (bounds.lower[0] >= y - 3e-3 * (1 + np.abs(y))).all()


# ---------------------------------------------------------------- mutants: the attack finds wrong rules


def _lines_without_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    def band(self, lower, upper):
        found = original(self, lower, upper)
        return type(found)(found.lower_slope, found.lower_offset, found.upper_slope, 0.0 * found.upper_offset)

    original = LeakyRelu.lines
    monkeypatch.setattr(LeakyRelu, "lines", band)


def _steep_lower_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def lines(self, lower, upper):
        found = original(self, lower, upper)
        raised = torch.where(self.unstable(lower, upper), 0.5 * found.upper_offset, found.lower_offset)
        return type(found)(found.lower_slope, raised, found.upper_slope, found.upper_offset)

    original = LeakyRelu.lines
    monkeypatch.setattr(LeakyRelu, "lines", lines)


def _lost_bias(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Matrix, "bias", None)


def _shifted_window(monkeypatch: pytest.MonkeyPatch) -> None:
    def backward(self, rows):
        rows.y = rows.y + 1
        return original(self, rows)

    original = Convolution.backward
    monkeypatch.setattr(Convolution, "backward", backward)


def _sum_of_signs(monkeypatch: pytest.MonkeyPatch) -> None:
    def backward(self, rows):
        found = original(self, rows)
        return [found[0], type(found[1])(-found[1].value, found[1].y, found[1].x)]

    original = Sum.backward
    monkeypatch.setattr(Sum, "backward", backward)


def _unscaled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ScaleLayer, "backward", lambda self, rows: [rows])


def _level_too_low(monkeypatch: pytest.MonkeyPatch) -> None:
    def planes(window, apart):
        found = original(window, apart)
        return found._replace(high=found.high - 0.5 * (found.high - found.low))

    original = max_pool_propagation.upper_planes
    monkeypatch.setattr(max_pool_propagation, "upper_planes", planes)


def _rivals_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    def apart(self):
        return torch.where(self.inside[:, :, None], original(self) - 5.0, original(self))

    original = WindowInputs.relaxation_gap
    monkeypatch.setattr(WindowInputs, "relaxation_gap", apart)


def _last_of_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    def backward(self, rows, layer, cell, total):
        return original(self._replace(winner=0 * self.winner), rows, layer, cell, total)

    original = MaxPoolPlanes.backward
    monkeypatch.setattr(MaxPoolPlanes, "backward", backward)


def _narrow_magnitude(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Convolution, "magnitude", lambda self, inputs: 0.0 * self.apply(inputs))


MUTANTS = {
    "chord without offset": (_lines_without_gap, "plain"),
    "lower line too high": (_steep_lower_line, "plain"),
    "bias forgotten": (_lost_bias, "gemm"),
    "window shifted": (_shifted_window, "plain"),
    "wrong sign of a branch": (_sum_of_signs, "residual"),
    "scale not passed back": (_unscaled, "batch_norm"),
    "radius without absolute values": (_narrow_magnitude, "plain"),
    "upper plane of a maximum too low": (_level_too_low, "max"),
    "numbers above the winner left out": (_rivals_forgotten, "max"),
    "rows of a maximum go to the first of a window": (_last_of_a_window, "max_overlap"),
}


def _caught(name: str, tmp_path: Path, mutate: Callable[[pytest.MonkeyPatch], None], seeds: int = 4) -> bool:
    """Whether some bound is broken, or a set is seen to contradict itself."""
    for seed, (radius, slack) in itertools.product(range(seeds), ((0.3, 0.1), (0.1, 0.5), (0.05, 0.01))):
        file = written(name, tmp_path, seed)
        network, run = load_network(file), session(file)
        rows = rows_for(network.output_size)
        images = image_sets(SHAPE, 1, 2, radius, slack, seed)
        least, _ = attack(network, run, images, 0, rows)
        with pytest.MonkeyPatch.context() as patch:
            mutate(patch)
            lower = bound_outputs(network, images, rows, np.zeros(4)).lower[0]
        if not (lower <= least).all() or not np.isfinite(lower).all():
            return True
    return False


@pytest.mark.slow
@pytest.mark.parametrize("mutant", MUTANTS)
def test_attack_catches(mutant: str, tmp_path: Path) -> None:
    mutate, name = MUTANTS[mutant]
    assert _caught(name, tmp_path, mutate)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({name for _, name in MUTANTS.values()}))
def test_attack_catches_nothing_else(name: str, tmp_path: Path) -> None:
    assert not _caught(name, tmp_path, lambda patch: None, 2)
