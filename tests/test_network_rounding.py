"""Rounding of networks: float32 sums in every order and exact arithmetic obey the bounds, at tolerance zero."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from onnx_files import OnnxFile, image_sets, session

from ns_abstract.io.errors import InputError
from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import ImageSets, Network, bound_outputs, load_network
from ns_abstract.verify.network.bounds import NetworkBounds
from ns_abstract.verify.network.rounding import partial_sums
from ns_abstract.verify.preprocess import Preprocess

Layers = list[tuple[np.ndarray, np.ndarray]]
#: A product that is lost when it is added to 1 in float32, and 1 stays.
LOST = 2.0**-24 * (1.0 - 2.0**-10)


def still(x: np.ndarray) -> ImageSets:
    """Single images [m, n]."""
    x = np.asarray(x, np.float32).astype(np.float64)
    zero = np.zeros((*x.shape, 1))
    return ImageSets(zero, x, zero, x, x, x)


def network_of(layers: Layers, folder: Path, relu: bool = True) -> tuple[Network, Path]:
    """A ReLU (or linear) network with these weights [out, in] and biases."""
    f = OnnxFile((layers[0][0].shape[1],))
    for k, (weight, bias) in enumerate(layers):
        if k and relu:
            f.node("Relu")
        f.node("Gemm", f.last, f.constant(weight), f.constant(bias), transB=1)
    file = f.write(folder / "net.onnx")
    return load_network(file), file


def in_order(layers: Layers, x: np.ndarray, order: Callable[[int], np.ndarray]) -> np.ndarray:
    """Float32 outputs for one image [n], with sums one product after another in an order of ``order(terms)``."""
    x = x.astype(np.float32)
    for k, (weight, bias) in enumerate(layers):
        x = np.maximum(x, np.float32(0.0)) if k else x
        terms = np.concatenate([weight.astype(np.float32) * x, bias.astype(np.float32)[:, None]], axis=1)
        total = np.zeros(len(weight), np.float32)
        for at in order(terms.shape[1]):
            total = total + terms[:, at]
        x = total
    return x.astype(np.float64)


def exact(layers: Layers, x: np.ndarray, relu: bool = True) -> list[Fraction]:
    """Outputs for one image in exact arithmetic."""
    z = [v if isinstance(v, Fraction) else Fraction(float(v)) for v in x]
    for k, (weight, bias) in enumerate(layers):
        z = [max(v, Fraction(0)) for v in z] if k and relu else z
        weight, bias = weight.astype(np.float32), bias.astype(np.float32)
        z = [
            sum((Fraction(float(w)) * v for w, v in zip(row, z, strict=True)), Fraction(float(b)))
            for row, b in zip(weight, bias, strict=True)
        ]
    return z


def losing(depth: int, terms: int) -> Layers:
    """Layers whose sums lose all products but the first, if they are added one after another."""
    weight = np.full((terms + 1, terms + 1), LOST)
    weight[:, 0] = 1.0
    # what follows the 1 is the same from layer to layer
    return [(weight, np.zeros(terms + 1))] * depth


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1, 2, 3])
def test_sums_that_lose_as_much_as_they_can(depth: int, tmp_path: Path) -> None:
    layers = losing(depth, 120)
    network, _ = network_of(layers, tmp_path)
    x = np.ones(121)
    rows = np.concatenate([np.eye(121), -np.eye(121)])
    lower = bound_outputs(network, still(x[None]), rows, np.zeros(242)).lower[0]
    y = in_order(layers, x, np.arange)
    lost = np.array([float(v) for v in exact(layers, x)]) - y
    assert (lower <= rows @ y).all()
    # the sums are nearly as bad as any can be, so that the charge is not much more than is needed
    charge = np.array([float(v) for v in exact(layers, x)]) - lower[:121]
    assert (lost > 0.85 * charge).all()


def test_sums_that_cancel(tmp_path: Path) -> None:
    """What is lost is relative to the largest partial sum, however small the sum is."""
    weight = np.full((1, 122), LOST)
    weight[0, 0], weight[0, 121] = 1.0, -1.0
    layers = [(weight, np.zeros(1))]
    network, _ = network_of(layers, tmp_path)
    y = in_order(layers, np.ones(122), np.arange)
    assert y[0] == 0.0 and float(exact(layers, np.ones(122))[0]) > 100 * LOST
    rows = np.array([[1.0], [-1.0]])
    lower = bound_outputs(network, still(np.ones((1, 122))), rows, np.zeros(2)).lower[0]
    assert (lower <= rows @ y).all()
    # the products' sizes together are twice the largest partial sum
    assert float(exact(layers, np.ones(122))[0]) - lower[0] < 1.5 * 123 * 2.0**-24


def test_sums_that_start_with_what_is_added(tmp_path: Path) -> None:
    """A program may start a layer's sums with a branch that is added behind them."""
    f = OnnxFile((121,))
    small = np.full((121, 121), LOST)
    start = f.node("Relu")
    f.node("Gemm", start, f.constant(small), f.constant(np.zeros(121)), transB=1)
    f.node("Add", f.last, start)
    network = load_network(f.write(tmp_path / "skip.onnx"))
    lower = bound_outputs(network, still(np.ones((1, 121))), np.eye(121)[:1], np.zeros(1)).lower[0]
    total = np.float32(1.0)
    for _ in range(121):
        total = total + np.float32(LOST)
    assert total == 1.0 and lower[0] <= 1.0
    assert 1.0 + 121 * LOST - lower[0] < 1.5 * 121 * 2.0**-24


def random_layers(sizes: tuple[int, ...], seed: int, scale: float = 2.0) -> Layers:
    rng = np.random.default_rng(seed)
    return [
        (
            (scale * rng.normal(size=(b, a)) / np.sqrt(a)).astype(np.float32).astype(np.float64),
            rng.normal(size=b).astype(np.float32).astype(np.float64),
        )
        for a, b in itertools.pairwise(sizes)
    ]


@pytest.mark.parametrize("seed", range(3))
def test_every_order_of_summation(seed: int, tmp_path: Path) -> None:
    layers = random_layers((30, 40, 40, 40, 4), seed)
    network, file = network_of(layers, tmp_path)
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(6, 30)).astype(np.float32)
    rows = np.concatenate([np.eye(4), -np.eye(4)])
    lower = bound_outputs(network, still(x), rows, np.zeros(8)).lower
    orders: list[Callable[[int], np.ndarray]] = [np.arange, lambda n: np.arange(n)[::-1]]
    orders += [lambda n, k=k: np.random.default_rng(k).permutation(n) for k in range(10)]
    run = session(file)
    for cell, image in enumerate(x):
        values = [in_order(layers, image, order) for order in orders]
        with torch.no_grad():
            values.append(network(torch.from_numpy(image[None]))[0].double().numpy())
        values.append(run(image[None])[0].astype(np.float64))
        for y in values:
            assert (lower[cell] <= rows @ y).all()
        assert all(
            Fraction(float(low)) <= s * v for low, (s, v) in zip(lower[cell], signed(layers, image), strict=True)
        )


def signed(layers: Layers, x: np.ndarray, relu: bool = True) -> list[tuple[int, Fraction]]:
    y = exact(layers, x, relu)
    return [(1, v) for v in y] + [(-1, v) for v in y]


@pytest.mark.parametrize(("large", "relu"), [(1.0, True), (2.0**10, False)])
def test_exact_network_at_single_images(large: float, relu: bool, tmp_path: Path) -> None:
    """Bounds of the exact network hold in exact arithmetic, to float64's last bits where numbers cancel."""
    worst = 0.0
    for seed in range(4):
        layers = random_layers((20, 30, 30, 3), seed)
        # huge numbers in the middle that cancel behind
        layers[1] = (np.concatenate([large * layers[1][0][:15], large * layers[1][0][:15]]), layers[1][1])
        layers[2] = (layers[2][0] * np.repeat([1.0, -1.0], 15)[None], layers[2][1])
        layers[2][0][:, 15:] = -layers[2][0][:, :15]
        network, _ = network_of(layers, tmp_path, relu)
        x = np.random.default_rng(seed).normal(size=(4, 20)).astype(np.float32)
        rows = np.concatenate([np.eye(3), -np.eye(3)])
        real = bound_outputs(network, still(x), rows, np.zeros(6), arithmetic="real").lower
        single = bound_outputs(network, still(x), rows, np.zeros(6)).lower
        assert (single < real).all()
        for cell, image in enumerate(x):
            for low, (s, v) in zip(real[cell], signed(layers, image, relu), strict=True):
                assert Fraction(float(low)) <= s * v
                worst = max(worst, float(s * v - Fraction(float(low))))
    assert worst < 1e-9 * large


def test_exact_network_over_sets(tmp_path: Path) -> None:
    """Bounds and planes of the exact network hold in exact arithmetic at points of sets."""
    rng = np.random.default_rng(0)
    for seed in range(3):
        layers = random_layers((12, 20, 20, 3), seed)
        network, _ = network_of(layers, tmp_path)
        images = image_sets((12,), 3, 2, 0.1, 0.01, seed)
        found = bound_outputs(network, images, np.eye(3), np.zeros(3), arithmetic="real")
        single = bound_outputs(network, images, np.eye(3), np.zeros(3))
        assert (found.lower > single.lower).mean() > 0.8
        for cell in range(3):
            for _ in range(12):
                p = rng.choice([-1.0, -0.5, 0.0, 0.25, 1.0], 2)
                low = np.maximum(images.a_lower[cell] @ p + images.b_lower[cell], images.lower[cell])
                high = np.minimum(images.a_upper[cell] @ p + images.b_upper[cell], images.upper[cell])
                x = low + rng.choice([0.25, 0.5, 0.75], 12) * (high - low)
                for k, v in enumerate(exact(layers, x)):
                    plane = sum(
                        (Fraction(float(a)) * Fraction(float(q)) for a, q in zip(found.a[cell, k], p, strict=True)),
                        Fraction(float(found.b[cell, k])),
                    )
                    assert Fraction(float(found.lower[cell, k])) <= v
                    assert plane <= v


def test_charge_does_not_grow_with_the_rows_own_rounding(tmp_path: Path) -> None:
    """Rows in float32 cost next to nothing on a single image, however large its numbers are."""
    layers = random_layers((60, 80, 80, 2), 1)
    layers[0] = (layers[0][0] * 1000.0, layers[0][1])
    network, _ = network_of(layers, tmp_path)
    x = np.random.default_rng(1).normal(size=(3, 60)).astype(np.float32)
    rows = np.concatenate([np.eye(2), -np.eye(2)])
    lower = bound_outputs(network, still(x), rows, np.zeros(4), arithmetic="real").lower
    y = network(torch.from_numpy(x).double()).numpy() @ rows.T
    assert (y - lower).max() < 1e-9 * np.abs(y).max()


def residual(folder: Path, blocks: int, seed: int = 0) -> Path:
    """A deep residual network: stem, ``blocks`` blocks of two convolutions and a linear layer."""
    f = OnnxFile((3, 8, 8), seed)
    f.conv(3, 8, pads=[1, 1, 1, 1])
    f.node("Relu")
    for _ in range(blocks):
        before = f.last
        f.conv(8, 8, pads=[1, 1, 1, 1])
        f.node("Relu")
        f.conv(8, 8, pads=[1, 1, 1, 1])
        f.node("Add", f.last, before)
        f.node("Relu")
    f.node("GlobalAveragePool")
    f.node("Flatten")
    f.gemm(8, 3)
    return f.write(folder / "deep.onnx")


@pytest.mark.slow
def test_small_margin_of_a_deep_network(tmp_path: Path) -> None:
    """One image of a network with 21 convolutions has its float32 outputs bounded within a part in a thousand."""
    file = residual(tmp_path, 10)
    network, run = load_network(file), session(file)
    x = np.random.default_rng(0).uniform(size=(2, 192)).astype(np.float32)
    y = run(x.reshape(2, 3, 8, 8)).astype(np.float64)
    rows = np.concatenate([np.eye(3), -np.eye(3)])
    lower = bound_outputs(network, still(x), rows, np.zeros(6)).lower
    assert (lower <= y @ rows.T).all()
    assert (y @ rows.T - lower).max() < 1e-3 * np.abs(y).max()


def test_rounding_counts_the_largest_image_of_a_set(tmp_path: Path) -> None:
    """At the bright end of a set sums lose more than in its middle; planes allow for that."""
    layers = [(weight[:2], bias[:2]) for weight, bias in losing(1, 120)]
    network, _ = network_of(layers, tmp_path)
    half = np.full((1, 121), 0.5)
    images = ImageSets(half[..., None], half, half[..., None], half, 0.0 * half, 2.0 * half)
    found = bound_outputs(network, images, np.eye(2), np.zeros(2))
    y = in_order(layers, np.ones(121), np.arange)
    assert (found.a[0, :, 0] + found.b[0] <= y).all()


def test_zeros_are_added_without_rounding(tmp_path: Path) -> None:
    """Units that are off for certain do not count as terms of the next layer's sums, those that may be on do."""
    rng = np.random.default_rng(0)
    first = np.eye(121), np.concatenate([np.zeros(61), np.full(60, -2.0)])
    layers = [first, *losing(1, 120)]
    network, _ = network_of(layers, tmp_path)
    images = still(np.ones((1, 121)))
    lower = bound_outputs(network, images, np.eye(121), np.zeros(121)).lower[0]
    for order in (np.arange, rng.permutation):
        assert (lower <= in_order(layers, np.ones(121), order)).all()
    dense = network_of([(first[0], np.zeros(121)), layers[1]], tmp_path)[0]
    more = bound_outputs(dense, images, np.eye(121), np.zeros(121)).lower[0]
    lost = [float(v) - low for v, low in zip(exact(layers, np.ones(121)), lower, strict=True)]
    assert max(lost) < 0.8 * (exact([(first[0], np.zeros(121)), layers[1]], np.ones(121))[0] - Fraction(more[0]))


def test_units_that_may_be_on_are_terms(tmp_path: Path) -> None:
    """Units that are on in part of a set only are terms of the next layer's sums."""
    first = np.eye(120), np.full(120, -0.75)
    # every product of a unit that is on is rounded up to twice what it is
    second = np.full((2, 120), 4.0 * 2.0**-24 * (1.0 + 2.0**-10))
    layers = [first, (second, np.ones(2))]
    network, _ = network_of(layers, tmp_path)
    half = np.full((1, 120), 0.5)
    images = ImageSets(half[..., None], half, half[..., None], half, 0.0 * half, 2.0 * half)
    found = bound_outputs(network, images, -np.eye(2), np.zeros(2))
    y = in_order(layers, np.ones(120), lambda n: np.roll(np.arange(n), 1))
    assert (y - 1.0 > 1.9 * (float(exact(layers, np.ones(120))[0]) - 1.0)).all()
    assert (found.a[0, :, 0] + found.b[0] <= -y).all()


@pytest.mark.slow
@pytest.mark.parametrize("double", [False, True])
def test_rounding_of_rows_over_sets(double: bool, tmp_path: Path) -> None:
    """Of a linear network, the least value in exact arithmetic is not exceeded, whatever rows of outputs are."""
    for seed in range(3):
        layers = random_layers((10, 30, 30, 5), seed)
        network, _ = network_of(layers, tmp_path, relu=False)
        a = np.random.default_rng(seed).normal(size=(1, 10, 3))
        b = np.zeros((1, 10))
        reach = np.abs(a).sum(-1)
        images = ImageSets(a, b, a, b, np.nextafter(-reach, -np.inf), np.nextafter(reach, np.inf))
        for sign in (1.0, -1.0):
            cells = NetworkBounds(network, images, 1 << 30, "real")
            if not double:
                cells.intermediate.relaxations.pop()
            found = cells.outputs(sign * np.eye(5), np.zeros(5))
            corners = [np.array(p) for p in itertools.product([-1.0, 1.0], repeat=3)]
            for k in range(5):
                least = []
                for p in corners:
                    x = [
                        sum((Fraction(float(v)) * Fraction(float(q)) for v, q in zip(row, p, strict=True)), Fraction(0))
                        for row in a[0]
                    ]
                    least.append(Fraction(sign) * exact(layers, np.array(x, object), relu=False)[k])
                assert Fraction(float(found.lower[0, k])) <= min(least)


def test_rows_of_outputs_take_float64_weights(tmp_path: Path) -> None:
    """Means of 61 numbers: one by 61 as float32 has it is less by nearly half a unit."""
    f = OnnxFile((1, 1, 61))
    f.node("AveragePool", kernel_shape=[1, 61])
    f.node("Flatten")
    network = load_network(f.write(tmp_path / "mean.onnx"))
    a = np.ones((1, 61, 1))
    b = np.zeros((1, 61))
    images = ImageSets(a, b, a, b, b - 1.0, b + 1.0)
    found = bound_outputs(network, images, np.eye(1), np.zeros(1), arithmetic="real")
    # what the sums of columns are charged
    assert -1.0 - 2.0**-24 < found.lower[0, 0] <= -1.0


@pytest.mark.parametrize("blocks", [1, 3])
def test_rows_of_outputs_in_float64_are_tighter(blocks: int, tmp_path: Path) -> None:
    """Over small sets float32 rows lose more than the images move; no run in float64 is outside."""
    network = load_network(residual(tmp_path, blocks))
    images = image_sets((3, 8, 8), 1, 2, 1e-9, 1e-12, 1)
    rows = np.concatenate([np.eye(3), -np.eye(3)])
    widths = []
    for double in (False, True):
        cells = NetworkBounds(network, images, 1 << 30, "real")
        if not double:
            cells.intermediate.relaxations.pop()
        found = cells.outputs(rows, np.zeros(6))
        rng = np.random.default_rng(0)
        for p in rng.choice([-1.0, 1.0], (50, 2)):
            x = 0.5 * ((images.a_lower[0] + images.a_upper[0]) @ p + images.b_lower[0] + images.b_upper[0])
            y = rows @ network(torch.from_numpy(x).reshape(1, 3, 8, 8))[0].numpy()
            # a float64 run's own rounding
            room = 2.0**-44 * (1.0 + np.abs(y))
            assert (found.lower[0] <= y + room).all() and (found.a[0] @ p + found.b[0] <= y + room).all()
        widths.append(-(found.lower[0, :3] + found.lower[0, 3:]).mean())
    assert widths[1] < widths[0]


def _all_together(values: tuple[float, ...]) -> float:
    """The most that the sizes of all partial sums may be together, over all orders and trees."""

    @functools.cache
    def within(mask: int) -> float:
        parts = [k for k in range(len(values)) if mask >> k & 1]
        if len(parts) < 2:
            return 0.0
        best, one = 0.0, (mask - 1) & mask
        while one:
            best = max(best, within(one) + within(mask ^ one))
            one = (one - 1) & mask
        return abs(sum(values[k] for k in parts)) + best

    return within((1 << len(values)) - 1)


def _bounded(values: np.ndarray) -> float:
    sides = np.clip(values, 0.0, None), np.clip(-values, 0.0, None)
    peak, squares = (max(float((v**k).sum()) for v in sides) for k in (1, 2))
    given = (torch.tensor(v, dtype=torch.float64) for v in (peak, squares, abs(float(values.sum()))))
    return float(partial_sums(len(values) - 1, *given))


def test_partial_sums_of_every_order() -> None:
    rng = np.random.default_rng(0)
    for k in range(60):
        values = rng.normal(size=int(rng.integers(2, 9))) * np.exp(rng.uniform(0, k % 4) * rng.normal())
        if k % 3 == 0:
            values = np.abs(values)
        elif k % 3 == 1:
            values = rng.choice([-1.0, 1.0, 1.0, 0.01], len(values))
        assert _all_together(tuple(values)) <= _bounded(values)
    assert _bounded(np.zeros(5)) == 0.0


def test_partial_sums_are_nearly_reached() -> None:
    """Equal numbers lose a half of as many times their sum, those that cancel no more in each part."""
    for n in (100, 1000):
        for values in (np.ones(n), np.repeat([1.0, -1.0], n // 2)):
            chain = np.abs(np.cumsum(values)).sum() - 1.0
            assert chain <= _bounded(values) <= 1.5 * chain


def test_scales_that_may_be_folded(tmp_path: Path) -> None:
    """Where a scale and a layer are connected without an activation between, and only there."""
    f = OnnxFile((2, 4, 4))
    f.conv(2, 2, pads=[1, 1, 1, 1])
    f.node("Relu")
    f.conv(2, 2, pads=[1, 1, 1, 1])
    f.node("Transpose", perm=[0, 1, 3, 2])
    f.node("Mul", f.last, f.constant([[[2.0]], [[3.0]]]))
    f.node("Relu")
    f.conv(2, 2)
    network = load_network(f.write(tmp_path / "net.onnx"))
    kinds = [type(node.layer).__name__ for node in network.nodes]
    assert kinds == ["Convolution", "LeakyRelu", "Convolution", "Gather", "ScaleLayer", "LeakyRelu", "Convolution"]
    assert network.scaled == {3, 4, 5}


def test_other_words_are_no_arithmetic(tmp_path: Path) -> None:
    """The exact network alone was bounded under them, and reports named every float32 evaluation."""
    network, _ = network_of([(np.full((2, 64), 0.1), np.zeros(2))], tmp_path)
    for word in ("Float32", "half", "", None, 3, ["float32"]):
        with pytest.raises(InputError, match="network_arithmetic: found"):
            NetworkModel(network, Preprocess(), 1 << 28, word)  # type: ignore[arg-type]
    images, rows = still(np.linspace(0.0, 1.0, 64)[None]), np.eye(2)
    usual, real, other = (
        bound_outputs(network, images, rows, np.zeros(2), arithmetic=word).lower  # type: ignore[arg-type]
        for word in ("float32", "real", "Float32")
    )
    assert (real > usual).all() and (other == usual).all()
