"""Charges of networks' float32 programs: norms of one pass, folded and flushed constants, overflow, sums' counts."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from extreme_networks import (
    Array,
    Extreme,
    Layer,
    batch_norm,
    clip,
    convolution,
    gemm,
    layer_norm,
    one_pass,
    plain,
    power,
    random_maps,
    random_network,
    runs,
    scale,
)
from onnx_files import OnnxFile
from torch.nn import functional

from ns_abstract.arithmetic.network_charges import gamma
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import ImageSets, Network, bound_outputs
from ns_abstract.verify.network.build import NetworkBuilder
from ns_abstract.verify.network.layers import Convolution, Matrix
from ns_abstract.verify.network.load import read_onnx
from ns_abstract.verify.network.sparse_layers import TransposedConvolution


def bounds(network: Network, low: Array, high: Array, arithmetic: Any = "float32") -> tuple[Array, Array]:
    """Lower and upper bounds [m] of the outputs over a box of images [n]."""
    lower, upper = (np.asarray(v, np.float64).reshape(1, -1) for v in (low, high))
    zero, m = np.zeros((*lower.shape, 1)), network.output_size
    rows = np.concatenate([np.eye(m), -np.eye(m)])
    images = ImageSets(zero, lower, zero, upper, lower, upper)
    found = bound_outputs(network, images, rows, np.zeros(2 * m), arithmetic=arithmetic).lower[0]
    return found[:m], -found[m:]


def outside(y: Array, low: Array, high: Array) -> Array:
    """Which outputs [B, m] are not within their bounds; no number at all is within no finite ones."""
    unbounded = np.isneginf(low) & np.isposinf(high)
    return ~(((y >= low) & (y <= high)) | unbounded)


def within(net: Extreme, folder: Path, low: Array, high: Array, seed: int = 0) -> tuple[Array, Array, int]:
    """Bounds over a box, in which all programs' values of images in it are; how many were compared."""
    file = net.write(folder / "net.onnx")
    network, runners = read_onnx(file), runs(file)
    low, high = np.asarray(low, np.float32), np.asarray(high, np.float32)
    found = bounds(network, low, high)
    rng = np.random.default_rng(seed)
    part = np.concatenate([[np.zeros(low.shape), np.ones(low.shape)], rng.random((12, *low.shape))])
    part = np.concatenate([part, rng.random((6, *low.shape)) < 0.5]).astype(np.float32)
    x, compared = np.clip(low + part * (high - low), low, high).astype(np.float32), 0
    for name, y in net.values(x, runners):
        wrong = outside(y.astype(np.float64), *found)
        assert not wrong.any(), f"{name}: {y[wrong][:3]} beside {[v[wrong.any(0)][:3] for v in found]}"
        compared += y.size
    return *found, compared


# ---------------------------------------------------------------- norms in one pass


@pytest.mark.slow
@pytest.mark.parametrize("op", [True, False])
@pytest.mark.parametrize(("mean", "spread"), [(15.1, 1e-3), (5.1, 0.02), (0.5, 1e-3), (20.0, 0.3), (300.0, 1e-3)])
def test_norms_of_one_pass(op: bool, mean: float, spread: float, tmp_path: Path) -> None:
    """Features that are nearly constant: what one pass makes of their variance may be negative."""
    x = (mean + spread * np.random.default_rng(0).normal(size=64)).astype(np.float32)
    net = Extreme((64,), [layer_norm(64, op=op)])
    low, high, _ = within(net, tmp_path, x, x)
    exact = x.astype(np.float64) - x.mean(dtype=np.float64)
    exact = exact / np.sqrt((exact**2).mean() + 1e-5)
    assert not outside(exact[None], low, high).any()
    # two passes would do: the exact network's bounds are close
    low, high = bounds(read_onnx(tmp_path / "net.onnx"), x, x, "real")
    assert (low <= exact + 1e-6).all() and (high - low < 1e-6).all()


@pytest.mark.slow
@pytest.mark.parametrize("op", [True, False])
def test_variances_below_zero(op: bool, tmp_path: Path) -> None:
    """Where one pass has no root, or one of next to nothing, nothing is known."""
    net, lost = Extreme((64,), [layer_norm(64, op=op)]), 0
    for seed in range(12):
        x = (15.103 + 1e-3 * np.random.default_rng(seed).normal(size=64)).astype(np.float32)
        within(net, tmp_path, x, x)
        lost += not bool(torch.isfinite(one_pass(torch.from_numpy(x[None]), 1e-5)).all())
    assert lost > 0


@pytest.mark.parametrize("op", ["InstanceNormalization", "GroupNorm"])
def test_norms_of_maps_in_one_pass(op: str, tmp_path: Path) -> None:
    x = 12.0 + 1e-3 * np.random.default_rng(1).normal(size=(4, 4, 4))
    f = OnnxFile((4, 4, 4))
    if op == "GroupNorm":
        # as torch exports it
        f.node("Reshape", f.last, f.constant([0, 2, -1], np.int64))
        f.node("InstanceNormalization", f.last, f.constant(np.ones(2)), f.constant(np.zeros(2)), epsilon=1e-5)
    else:
        f.node(op, f.last, f.constant(np.ones(4)), f.constant(np.zeros(4)), epsilon=1e-5)
    file = f.write(tmp_path / "net.onnx")
    low, high = bounds(read_onnx(file), x, x)
    rows = torch.from_numpy(x.astype(np.float32)).reshape(2 if op == "GroupNorm" else 4, -1)
    squares, total = torch.zeros(len(rows)), torch.zeros(len(rows))
    for k in range(rows.shape[1]):
        squares, total = squares + rows[:, k] ** 2, total + rows[:, k]
    mean = total / rows.shape[1]
    variance = squares / rows.shape[1] - mean * mean
    y = ((rows - mean[:, None]) / (variance + 1e-5).sqrt()[:, None]).reshape(1, -1).numpy()
    assert not outside(y.astype(np.float64), low, high).any()
    for run in runs(file):
        assert not outside(run(x[None].astype(np.float32)).astype(np.float64), low, high).any()


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_running_sums_over_channels(size: int, tmp_path: Path) -> None:
    """Channels that have left a window leave their rounding behind."""
    rng = np.random.default_rng(size)
    f = OnnxFile((40, 1, 2))
    f.node("LRN", size=size, alpha=float(size), beta=0.5)
    file = f.write(tmp_path / "net.onnx")
    x = rng.normal(size=(40, 1, 2)) * np.where(np.arange(40) < 12, 20.0, 1.0)[:, None, None]
    x = x.astype(np.float32)
    low, high = bounds(read_onnx(file), x, x)
    before, behind = (size - 1) // 2, size - 1 - (size - 1) // 2
    square, scale = x * x, np.ones_like(x)
    running = np.float32(1.0) + np.zeros((1, 2), np.float32)
    for k in range(-behind, 40):
        if k + behind < 40:
            running = running + square[k + behind]
        if k - before - 1 >= 0:
            running = running - square[k - before - 1]
        if k >= 0:
            scale[k] = running
    values = [(x / np.sqrt(scale)).reshape(1, -1)]
    if size % 2:
        # onnxruntime takes no other
        values += [run(x[None]) for run in runs(file)]
    squares = np.square(x, dtype=np.float64)
    sums = np.array([squares[max(0, k - before) : k + behind + 1].sum(axis=0) for k in range(40)])
    exact = (x / np.sqrt(1.0 + sums)).reshape(1, -1)
    assert np.isfinite(low).all() and np.isfinite(high).all()
    for y in (exact, *values):
        assert not outside(y.astype(np.float64), low, high).any()
    # what has left the window is seen in what comes long after it
    assert size == 1 or all(np.abs(y - exact)[:, 60:].max() > 1e-5 for y in values)


@pytest.mark.parametrize("op", [True, False])
def test_norms_over_wide_sets_stay_bounded(op: bool, tmp_path: Path) -> None:
    """A set that holds constant features has bounds where the mean is small beside what epsilon leaves."""
    low, high, _ = within(Extreme((8,), [layer_norm(8, op=op)]), tmp_path, -np.ones(8), np.ones(8))
    assert np.isfinite(low).all() and np.isfinite(high).all()


# ---------------------------------------------------------------- counts of sums


@pytest.mark.parametrize(("kernel", "stride", "dilation"), [(5, 4, 4), (5, 4, 6), (4, 2, 3), (6, 3, 2), (5, 6, 4)])
def test_counts_of_dilated_sums(kernel: int, stride: int, dilation: int) -> None:
    """No number of a transposed convolution, or of a row through a convolution, is a sum of more products."""
    taps = torch.ones((1, 1, kernel))
    met = functional.conv_transpose1d(torch.ones((1, 1, 60)), taps, None, stride, 0, 0, 1, dilation)
    most = int(met.max())
    weight = np.ones((1, 1, kernel, kernel))
    b = NetworkBuilder(Path("net.onnx"), (1, 200, 200))
    index = b.convolution(0, weight, None, (stride,) * 2, (dilation,) * 2, (0,) * 4, 1)
    layer = b.nodes[index - 1].layer
    assert isinstance(layer, Convolution) and layer.row_terms == most**2


def test_dilated_transposed_convolutions(tmp_path: Path) -> None:
    """The number in the middle is a sum of all 31 x 31 products, which a program may add one after another."""
    pads = {"pads": [480] * 4, "strides": [16, 16], "dilations": [16, 16]}
    net = Extreme((1, 31, 31), [convolution(np.ones((1, 1, 31, 31)), np.zeros(1), True, **pads)])
    x = np.full((1, 31, 31), 1.0575864, np.float32)
    low, high, _ = within(net, tmp_path, x, x)
    layer = read_onnx(tmp_path / "net.onnx").nodes[0].layer
    assert isinstance(layer, TransposedConvolution) and layer.terms >= 31 * 31
    total = np.float32(0.0)
    for _ in range(31 * 31):
        total = np.float32(total + x[0, 0, 0])
    assert abs(float(total) - 31 * 31 * float(x[0, 0, 0])) > 1e-2
    assert low[0] <= total <= high[0] and high[0] - low[0] < 0.2


def test_sums_without_a_digit_are_refused() -> None:
    with pytest.raises(InputError, match="no digit"):
        gamma(2**23)
    with pytest.raises(InputError, match="no digit"):
        gamma(torch.tensor([3.0, 2.0**24]))
    assert gamma(2**20) > 0.0 and gamma(2**30, 2.0**-53) > 0.0
    b = NetworkBuilder(Path("net.onnx"), (4,))
    layer = Matrix(((4,),), (1,), 2**23, 1, torch.ones((1, 4), dtype=torch.float64))
    with pytest.raises(InputError, match="no digit"):
        b._add(layer, 0)


# ---------------------------------------------------------------- subnormal numbers

TINY, HUGE = 2.0**-100, 2.0**100
ONE = np.ones(1)


def tiny_factors() -> dict[str, list[Layer]]:
    """Layers whose constants, or products of them, are subnormal, with factors behind that make them count."""

    def times(power: int) -> Layer:
        return scale(2.0**power * ONE, 0.0 * ONE)

    def loud(power: int) -> list[Layer]:
        # an activation between, so that no grouping overflows, nor do rows
        return [times(110), plain("Abs", torch.abs), times(power - 110)]

    half = gemm(np.full((1, 1), 2.0**-64), np.zeros(1))
    tiny = scale(-(2.0**-127) * ONE, 0.0 * ONE)
    return {
        "weights": [gemm(np.full((1, 1), 2.0**-130), np.zeros(1)), *loud(120)],
        "scale": [times(-130), *loud(120)],
        "product of weights": [half, times(-64), *loud(120)],
        "folded forwards": [times(-64), half, *loud(120)],
        "batch norm": [batch_norm(2.0**-128 * ONE, 0.0 * ONE, 0.0 * ONE, 2.0**-40 * ONE, 2.0**-60), *loud(108)],
        "leaky": [scale(-(2.0**-120) * ONE, 0.0 * ONE), leaky(2.0**-7)],
        "leaky, loud": [scale(-(2.0**-120) * ONE, 0.0 * ONE), leaky(2.0**-7), *loud(120)],
        "slope": [scale(-ONE, 0.0 * ONE), leaky(2.0**-130), *loud(120)],
        "relu": [times(-127), plain("Relu", torch.relu), *loud(120)],
        "abs": [tiny, plain("Abs", torch.abs), *loud(120)],
        "clip": [tiny, clip(-1.0, 1.0), *loud(120)],
        "square": [times(-64), power(2.0), *loud(120)],
        "root": [times(-130), power(0.5), times(64)],
        "exponential": [scale(-70.0 * ONE, 0.0 * ONE), plain("Exp", torch.exp), *loud(100)],
        "limit": [clip(2.0**-128, 1.0), *loud(120)],
    }


def leaky(alpha: float) -> Layer:
    return plain("LeakyRelu", lambda x: functional.leaky_relu(x, alpha), alpha=alpha)


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", tiny_factors())
def test_flushed_numbers(name: str, tmp_path: Path) -> None:
    """Subnormal numbers that are kept or flushed to zero, before and behind every kind of layer."""
    net = Extreme((1,), tiny_factors()[name])
    for low, high in ((1.25, 1.25), (1.25, 1.5), (-1.5, 1.25), (3000.0, 3000.0)):
        within(net, tmp_path, low * ONE, high * ONE)


def test_flushed_images(tmp_path: Path) -> None:
    """Images of subnormal numbers."""
    root = Extreme((1,), [power(0.5), scale(2.0**63 * ONE, 0.0 * ONE)])
    within(root, tmp_path, 2.0**-127 * ONE, 2.0**-127 * ONE)
    for layer in (scale(HUGE * ONE, 0.0 * ONE), gemm(np.full((1, 1), HUGE), np.zeros(1))):
        within(Extreme((1,), [layer, scale(2.0**27 * ONE, 0.0 * ONE)]), tmp_path, 2.0**-127 * ONE, 2.0**-126 * ONE)


# ---------------------------------------------------------------- overflow


def overflowing() -> dict[str, tuple[list[Layer], float]]:
    """Layers that compute numbers past float32 between, though the last one's are small, and an image."""
    shrink = scale(1e-38 * ONE, 0.0 * ONE)
    steep = scale(1e5 * ONE, 0.0 * ONE)
    mean = Layer(
        lambda f: void(f.node("ReduceMean", f.last, axes=[-1], keepdims=1)),
        lambda x: x.mean(-1, keepdim=True),
    )
    return {
        "power": ([steep, power(8.0), shrink], 1.0),
        "power at the end": ([power(8.0)], 1e5),
        "reciprocal": ([scale(2.0**-120 * ONE, 0.0 * ONE), power(-1.0), power(-1.0)], 2.0**-9),
        "exponential": ([plain("Exp", torch.exp), shrink], 89.0),
        "square": ([scale(HUGE * ONE, 0.0 * ONE), power(2.0), power(-0.5)], 1.0),
        "batch norm": ([batch_norm(1e-20 * ONE, 0.0 * ONE, 0.0 * ONE, 0.0 * ONE, 1e-20), scale(1e8 * ONE, ONE)], 1e30),
        "shifted batch norm": ([batch_norm(1e-30 * ONE, 0.0 * ONE, 1e30 * ONE, 1e-20 * ONE, 1e-20)], 1.0),
        "folded weights": ([gemm(np.full((1, 1), 1e30), np.zeros(1)), scale(1e10 * ONE, 0.0 * ONE)], 1e-20),
        "mean": ([scale(2.0**125.5 * np.ones(8), np.zeros(8)), mean, shrink], 1.0),
    }


def void(_: Any) -> None:
    return None


@pytest.mark.parametrize("name", overflowing())
def test_overflow_between(name: str, tmp_path: Path) -> None:
    layers, x = overflowing()[name]
    n = 8 if name == "mean" else 1
    low, high, _ = within(Extreme((n,), layers), tmp_path, np.full(n, x), np.full(n, x))
    assert np.isneginf(low).all() and np.isposinf(high).all()


def test_limits_of_clips_count_however_large(tmp_path: Path) -> None:
    layers = [scale(2.0**115 * ONE, 0.0 * ONE), clip(-(2.0**101), 2.0**101), scale(2.0**-101 * ONE, 0.0 * ONE)]
    low, high, _ = within(Extreme((1,), layers), tmp_path, ONE, 2.0 * ONE)
    assert 0.99 < low[0] <= 1.0 <= high[0] < 1.01
    layers[1] = clip(2.0**116, None)
    low, high, _ = within(Extreme((1,), layers), tmp_path, ONE, 1.5 * ONE)
    assert 2.0**14.99 < low[0] <= 2.0**15 <= high[0] < 2.0**15.01
    with pytest.raises(InputError, match="clips to"):
        read_onnx(Extreme((1,), [clip(2.0**127, None)]).write(tmp_path / "net.onnx"))


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        (batch_norm(ONE, ONE, ONE, 0.0 * ONE, 1e-40), "variance"),
        (batch_norm(ONE, ONE, 3e38 * ONE, ONE), "cannot compute"),
        (layer_norm(1, 1e-38), "epsilon"),
    ],
)
def test_constants_that_no_program_divides_by(layer: Layer, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read_onnx(Extreme((1,), [layer]).write(tmp_path / "net.onnx"))


# ---------------------------------------------------------------- shifts folded into the next layer


@pytest.mark.parametrize("kind", ["scale", "batch norm", "two"])
def test_shifts_that_are_folded_forwards(kind: str, tmp_path: Path) -> None:
    """x - 1000 is small where its parts are not, and a folded bias sums up the parts."""
    n = 600
    offset = np.full(n, -1000.0)
    layers = {
        "scale": [scale(np.ones(n), offset)],
        "batch norm": [batch_norm(np.ones(n), np.zeros(n), -offset, np.ones(n), 0.0)],
        "two": [scale(2.0 * np.ones(n), 2.0 * offset), scale(0.5 * np.ones(n), np.zeros(n))],
    }[kind]
    x = np.full(n, 1000.0) + np.random.default_rng(0).integers(0, 8, n) / 8192.0
    weight = np.random.default_rng(1).uniform(0.5, 1.0, (2, n)).astype(np.float32)
    net = Extreme((n,), [*layers, gemm(weight, np.zeros(2))])
    low, high, _ = within(net, tmp_path, x, x)
    bias, total = np.zeros(2, np.float32), np.zeros(2, np.float32)
    for k in range(n):
        bias, total = bias + weight[:, k] * np.float32(-1000.0), total + weight[:, k] * np.float32(x[k])
    y = total + bias
    apart = [Fraction(float(v)) - 1000 for v in x]
    exact = [sum(Fraction(float(w)) * v for w, v in zip(row, apart, strict=True)) for row in weight]
    # a folded program is off by far more than sums of the differences
    assert max(abs(float(Fraction(float(v)) - e)) for v, e in zip(y, exact, strict=True)) > 1e-3
    assert not outside(y[None].astype(np.float64), low, high).any()


def test_folded_biases_lose_sums(tmp_path: Path) -> None:
    """A folded program may lose all products but the first, and its bias none."""
    n = 4000
    weight = np.full((1, n), np.float32(0.99 * 2.0**-15 / 1000.0))
    weight[0, 0] = 1.0
    x = np.full(n, 1000.0, np.float32)
    net = Extreme((n,), [scale(np.ones(n), np.full(n, -1000.0)), gemm(weight, np.zeros(1))])
    low, high, _ = within(net, tmp_path, x, x)
    total, bias = np.float32(0.0), np.float32(0.0)
    for w in weight[0]:
        total = total + w * np.float32(1000.0)
    for w in weight[0, ::-1]:
        bias = bias - w * np.float32(1000.0)
    assert abs(float(total + bias)) > 0.1 and low[0] <= total + bias <= high[0]


# ---------------------------------------------------------------- networks at random


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 90, 30))
def test_extreme_networks(first: int, tmp_path: Path) -> None:
    compared = finite = 0
    for seed in range(first, first + 30):
        net, middle = random_network(seed)
        size = np.maximum(np.abs(middle), 0.5 * np.abs(middle).max())
        try:
            for radius in (0.0, 2.0**-20, 0.05):
                low, _, number = within(net, tmp_path, middle - radius * size, middle + radius * size, seed)
                compared, finite = compared + number, finite + bool(np.isfinite(low).all())
        except InputError:
            continue
    assert compared > 30_000 and finite > 30


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 16, 8))
def test_extreme_maps(first: int, tmp_path: Path) -> None:
    compared = 0
    for seed in range(first, first + 8):
        net, middle = random_maps(seed)
        try:
            for radius in (0.0, 0.02):
                size = radius * np.abs(middle)
                compared += within(net, tmp_path, middle - size, middle + size, seed)[2]
        except InputError:
            continue
    assert compared > 10_000
