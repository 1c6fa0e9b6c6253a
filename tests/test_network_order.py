"""Networks that sense the order of sums, precision or a library: two programs that are float32 both disagree on them.

Such networks behave well where they are tested and otherwise where they are deployed (arXiv 2506.01054). Their bounds
hold both, so none is certified.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import torch
from extreme_networks import Array, Extreme, Layer, batch_norm, flushing, gemm, layer_norm, plain, power, runs, scale
from onnx_files import OnnxFile
from test_network_charges import bounds, outside

from ns_abstract.verify.network.load import read_onnx

Exact = Callable[[list[Any]], list[Any]]
BIG = 2.0**24
ONE = np.ones(1)


@dataclass
class Sensing:
    """A network, an image on which programs disagree, and the value there of the exact network (200 bits)."""

    image: Array
    layers: list[Layer]
    exact: Exact
    #: other float32 programs than onnxruntime, torch and sums in some order
    other: Callable[[Array], Array] | None = None
    #: whether the bounds of the exact network are close
    tight: bool = True


def spelled(write: Callable[[OnnxFile, str], object], step: Callable[[torch.Tensor], torch.Tensor]) -> Layer:
    """Several nodes that read the same value."""
    return Layer(lambda f: void(write(f, f.last)), step)


def void(_: object) -> None:
    return None


def plus(value: float, n: int = 1) -> Layer:
    return scale(np.ones(n), np.full(n, value))


def times(value: float, n: int = 1) -> Layer:
    return scale(np.full(n, value), np.zeros(n))


def decision(n: int = 1) -> list[Layer]:
    """1000 where the value is above 1 / 2."""
    return [plus(-0.5, n), plain("Relu", torch.relu), times(2000.0, n)]


def decided(values: list[Any]) -> list[Any]:
    return [2000 * max(v - 0.5, 0) for v in values]


def sensing() -> dict[str, Sensing]:
    """Twenty networks."""
    absorbing = [plus(BIG), plus(-BIG)]
    cancelling = gemm(np.array([[BIG, 1.0, -BIG]]), np.zeros(1))
    many = gemm(np.concatenate([[BIG], np.ones(1000)])[None], np.array([-BIG]))
    nth = np.float32(1.0 / 3.0)
    square = float(np.float32(nth * nth))
    wide = 4e6
    third, factor = mpmath.mpf(float(nth)), np.float32(0.7)

    def fused(x: Array) -> Array:
        # a product and a difference in one operation
        return (2.0**30 * (x.astype(np.float64) ** 2 - square)).astype(np.float32)

    def mean_first(f: OnnxFile, x: str) -> None:
        f.node("Sub", f.node("ReduceMean", x, axes=[-1]), x)

    def one_pass_variance(f: OnnxFile, x: str) -> None:
        mean = f.node("ReduceMean", x, axes=[-1])
        f.node("Sub", f.node("ReduceMean", f.node("Mul", x, x), axes=[-1]), f.node("Mul", mean, mean))

    def inner(f: OnnxFile, x: str) -> None:
        column = f.node("Unsqueeze", f.node("Mul", x, f.constant([1.0, 1.0, -1.0])), f.constant([-1], np.int64))
        row = f.node("Unsqueeze", x, f.constant([1], np.int64))
        f.node("Flatten", f.node("MatMul", row, column))

    def variance(x: list[Any]) -> list[Any]:
        mean = mpmath.fsum(x) / len(x)
        return [mpmath.fsum(v * v for v in x) / len(x) - mean * mean]

    def norm(x: list[Any]) -> list[Any]:
        mean, eps = mpmath.fsum(x) / len(x), mpmath.mpf(float(np.float32(1e-5)))
        root = mpmath.sqrt(mpmath.fsum((v - mean) ** 2 for v in x) / len(x) + eps)
        return [(v - mean) / root for v in x]

    def softmax(x: list[Any]) -> list[Any]:
        total = mpmath.fsum(mpmath.exp(v) for v in x)
        return [mpmath.exp(v) / total for v in x]

    near = 15.103 + 1e-3 * np.random.default_rng(3).normal(size=64)
    return {
        "absorbed by 2^24": Sensing(ONE, absorbing, lambda x: x),
        "absorbed by 2^60": Sensing(3.0 * ONE, [plus(2.0**60), plus(-(2.0**60))], lambda x: x, tight=False),
        "absorbed, then decided": Sensing(ONE, [*absorbing, *decision()], decided),
        "order of three": Sensing(np.ones(3), [cancelling], lambda x: [BIG * x[0] + x[1] - BIG * x[2]]),
        "order of three, then decided": Sensing(
            np.ones(3), [cancelling, *decision()], lambda x: decided([BIG * x[0] + x[1] - BIG * x[2]])
        ),
        "a thousand after a large one": Sensing(
            np.ones(1001), [many], lambda x: [BIG * x[0] + mpmath.fsum(x[1:]) - BIG]
        ),
        "mean of equal numbers": Sensing(
            np.full(10, 0.1), [spelled(mean_first, lambda x: x.mean(-1, keepdim=True) - x), times(BIG, 10)],
            lambda x: [BIG * (mpmath.fsum(x) / 10 - v) for v in x],
            lambda x: np.float32(BIG) * (_sequential(x) / np.float32(10.0) - x),
        ),
        "fused product and difference": Sensing(
            ONE * nth, [power(2.0), plus(-square), times(2.0**30)], lambda x: [2**30 * (third * third - square)], fused
        ),
        "a third of three times": Sensing(
            ONE * 0.7, [spelled(
                lambda f, x: f.node("Sub", f.node("Div", f.node("Mul", x, f.constant(7.0)), f.constant(7.0)), x),
                lambda x: x * 7.0 / 7.0 - x,
            ), times(2.0**27)],
            lambda x: [0 * v for v in x],
            lambda x: np.float32(2.0**27) * (x * np.float32(7.0) * np.float32(1.0 / 7.0) - x),
        ),
        "reciprocal and product": Sensing(
            ONE * 41.0, [spelled(
                lambda f, x: f.node("Mul", x, f.node("Reciprocal", x)), lambda x: x * x.reciprocal()
            ), plus(-1.0), times(BIG)],
            lambda x: [0 * v for v in x],
        ),
        "softmax of huge logits": Sensing(
            np.array([1.0, 0.0]), [plus(BIG, 2), plain("Softmax", lambda x: torch.softmax(x, -1), axis=-1)],
            softmax,
        ),
        "logarithm of a share": Sensing(
            np.array([3.0, 3.5]), [plus(2.0**22, 2), plus(0.25, 2),
                                   plain("LogSoftmax", lambda x: torch.log_softmax(x, -1), axis=-1), times(BIG, 2)],
            lambda x: [BIG * mpmath.log(v) for v in softmax(x)],
        ),
        "norm of nearly equal features": Sensing(near, [layer_norm(64)], norm),
        "norm of nearly equal features, spelled out": Sensing(near, [layer_norm(64, op=False)], norm),
        "variance in one pass": Sensing(
            1000.0 + np.array([0.01, -0.01, 0.02, 0.0]),
            [spelled(one_pass_variance, lambda x: (x * x).mean(-1, True) - x.mean(-1, True) ** 2), times(1000.0)],
            lambda x: [1000 * v for v in variance(x)],
        ),
        "what a sigmoid leaves of 1": Sensing(
            17.0 * ONE, [plain("Sigmoid", torch.sigmoid), scale(-ONE, ONE), times(2.0**25)],
            lambda x: [2**25 / (1 + mpmath.exp(v)) for v in x],
        ),
        "exponentials that undo each other": Sensing(
            0.7 * ONE, [spelled(
                lambda f, x: f.node("Mul", f.node("Exp", x), f.node("Exp", f.node("Neg", x))),
                lambda x: x.exp() * (-x).exp(),
            ), plus(-1.0), times(2.0**25)],
            lambda x: [0 * v for v in x],
            lambda x: np.float32(2.0**25) * (np.exp(x) * np.exp(-x) - np.float32(1.0)),
        ),
        "a root squared": Sensing(
            2.0 * ONE, [spelled(
                lambda f, x: f.node("Sub", f.node("Mul", f.node("Sqrt", x), f.node("Sqrt", x)), x),
                lambda x: x.sqrt() * x.sqrt() - x,
            ), times(BIG)],
            lambda x: [0 * v for v in x],
        ),
        "batch normalisation of a large mean": Sensing(
            ONE * (wide + 0.5), [batch_norm(factor * ONE, ONE, wide * ONE, ONE, 0.0)],
            lambda x: [(v - wide) * mpmath.mpf(float(factor)) + 1 for v in x],
            # folded: a factor and an offset
            lambda x: x * factor + (np.float32(1.0) - np.float32(wide) * factor),
        ),
        "scales that flush between": Sensing(
            ONE, [times(2.0**-80), times(2.0**-80), times(2.0**80), times(2.0**80)], lambda x: x
        ),
        "subnormal weights": Sensing(ONE * 1.5, [times(2.0**-130), times(2.0**120), times(2.0**10)], lambda x: x),
        "inner product of values": Sensing(
            np.array([4096.0, 1.0, 4096.0]), [spelled(
                inner, lambda x: (x[:, None] @ (x * torch.tensor([1.0, 1.0, -1.0]))[..., None]).flatten(1)
            )],
            lambda x: [x[0] * x[0] + x[1] * x[1] - x[2] * x[2]],
            lambda x: (x[:, :1] * x[:, :1] + x[:, 1:2] * x[:, 1:2]) - x[:, 2:] * x[:, 2:],
        ),
    }  # fmt: skip


def _sequential(x: Array) -> Array:
    total = np.zeros((len(x), 1), np.float32)
    for k in range(x.shape[1]):
        total = total + x[:, k : k + 1]
    return total


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", sensing())
def test_networks_that_sense_their_program(name: str, tmp_path: Path) -> None:
    """Every program and the exact network are within the bounds, and they are far from each other."""
    net = sensing()[name]
    image = np.asarray(net.image, np.float32)
    model = Extreme(image.shape, net.layers)
    file = model.write(tmp_path / "net.onnx")
    network, x = read_onnx(file), image[None]
    with mpmath.workprec(200):
        exact = net.exact([mpmath.mpf(float(v)) for v in image])
        values = [("exact", np.array([[float(v) for v in exact]]))]
        low, high = bounds(network, image, image, "real")
        inside = [mpmath.mpf(a) <= v <= mpmath.mpf(b) for a, v, b in zip(low, exact, high, strict=True)]
    assert all(inside) and (not net.tight or (high - low <= 1e-3 * (1.0 + np.abs(low))).all())
    values += [(program, y.astype(np.float64)) for program, y in model.values(x, runs(file))]
    if net.other:
        for flushed in (False, True):
            with flushing(flushed), np.errstate(all="ignore"):
                values.append(("other", net.other(x).astype(np.float64)))
    low, high = bounds(network, image, image)
    for program, y in values:
        assert not outside(y, low, high).any(), f"{program}: {y} beside {low} to {high}"
    every = np.concatenate([y for _, y in values])
    # not one number, or not a number at all
    assert (~(np.ptp(every, 0) < 0.05)).any(), every
