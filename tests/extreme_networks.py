"""Networks of a few layers with extreme constants, and the float32 programs that people run for them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from onnx_files import OnnxFile
from torch.nn import functional

Array = np.ndarray
Step = Callable[[torch.Tensor], torch.Tensor]


@contextlib.contextmanager
def flushing(on: bool = True) -> Iterator[None]:
    """Subnormal numbers are flushed to zero by this thread, where the processor can."""
    torch.set_flush_denormal(on)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def runs(file: Path) -> list[Callable[[Array], Array]]:
    """onnxruntime with all optimisations and with none, on this thread, so that it flushes as the thread does."""
    levels = onnxruntime.GraphOptimizationLevel
    found = []
    for level in (levels.ORT_ENABLE_ALL, levels.ORT_DISABLE_ALL):
        options = onnxruntime.SessionOptions()
        options.log_severity_level, options.intra_op_num_threads = 4, 1
        options.graph_optimization_level = level
        opened = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        name = opened.get_inputs()[0].name

        def run(x: Array, opened: Any = opened, name: str = name) -> Array:
            return np.asarray(opened.run(None, {name: x})[0]).reshape(len(x), -1)

        found.append(run)
    return found


def in_order(matrix: Array, x: Array, bias: Array, order: Array) -> Array:
    """Float32 sums [B, out] of products, one after another."""
    total = np.zeros((len(x), len(matrix)), np.float32)
    for k in order:
        total = total + x[:, k, None] * matrix[None, :, k]
    return total + bias


@dataclass
class Layer:
    """One step: its ONNX nodes, torch's evaluation and, for sums and scales, the float32 constants."""

    write: Callable[[OnnxFile], None]
    step: Step
    matrix: tuple[Array, Array] | None = None
    scale: tuple[Array, Array] | None = None
    kind: str = ""
    epsilon: float = 0.0


def gemm(w: Array, b: Array) -> Layer:
    w, b = w.astype(np.float32), b.astype(np.float32)

    def write(f: OnnxFile) -> None:
        f.node("Gemm", f.last, f.constant(w), f.constant(b), transB=1)

    return Layer(write, lambda x: x @ torch.from_numpy(w).T + torch.from_numpy(b), matrix=(w, b), kind="gemm")


def scale(factor: Array, offset: Array, shift_first: bool = False) -> Layer:
    a, t = (np.asarray(v, np.float32) for v in (factor, offset))
    one, two = (torch.from_numpy(v) for v in (a, t))

    def write(f: OnnxFile) -> None:
        steps = [("Mul", a), ("Add", t)]
        for op, value in reversed(steps) if shift_first else steps:
            f.node(op, f.last, f.constant(value))

    if shift_first:
        return Layer(write, lambda x: (x + two) * one, kind="shift, scale")
    return Layer(write, lambda x: x * one + two, scale=(a, t), kind="scale")


def batch_norm(gain: Array, shift: Array, mean: Array, variance: Array, epsilon: float = 1e-5) -> Layer:
    parts = [np.asarray(v, np.float32) for v in (gain, shift, mean, variance)]
    g, s, m, v = (torch.from_numpy(p) for p in parts)

    def write(f: OnnxFile) -> None:
        f.node("BatchNormalization", f.last, *(f.constant(p) for p in parts), epsilon=epsilon)

    def step(x: torch.Tensor) -> torch.Tensor:
        if x.ndim == 4:
            return functional.batch_norm(x, m, v, g, s, eps=epsilon)
        return (x - m) * torch.rsqrt(v + epsilon) * g + s

    return Layer(write, step, kind="batch norm")


def plain(op: str, step: Step, **attributes: Any) -> Layer:
    return Layer(lambda f: void(f.node(op, **attributes)), step, kind=op)


def void(_: Any) -> None:
    return None


def clip(least: float | None, most: float | None) -> Layer:
    def write(f: OnnxFile) -> None:
        f.node("Clip", f.last, "" if least is None else f.constant(least), "" if most is None else f.constant(most))

    return Layer(write, lambda x: x.clamp(least, most), kind="clip")


def power(exponent: float) -> Layer:
    return Layer(lambda f: void(f.node("Pow", f.last, f.constant(exponent))), lambda x: x**exponent, kind="power")


def one_pass(x: torch.Tensor, epsilon: float) -> torch.Tensor:
    """A norm over the last axis, its variance as mean of squares less square of the mean."""
    n, total, squares = x.shape[-1], torch.zeros(len(x)), torch.zeros(len(x))
    for k in range(n):
        total, squares = total + x[:, k], squares + x[:, k] * x[:, k]
    mean = total / n
    return (x - mean[:, None]) / (squares / n - mean * mean + epsilon).sqrt()[:, None]


def layer_norm(n: int, epsilon: float = 1e-5, op: bool = True) -> Layer:
    def write(f: OnnxFile) -> None:
        if op:
            f.node("LayerNormalization", f.last, f.constant(np.ones(n)), f.constant(np.zeros(n)), epsilon=epsilon)
            return
        x = f.last
        apart = f.node("Sub", x, f.node("ReduceMean", x, axes=[-1]))
        f.node("ReduceMean", f.node("Pow", apart, f.constant(2.0)), axes=[-1])
        f.node("Div", apart, f.node("Sqrt", f.node("Add", f.last, f.constant(epsilon))))

    return Layer(write, lambda x: functional.layer_norm(x, (n,), eps=epsilon), epsilon=epsilon)


def folded(layers: list[Layer], forwards: bool) -> list[Layer]:
    """Scales folded into the sums behind them, or before them, with float32 constants."""
    found: list[Layer] = []
    for layer in layers:
        before = found[-1] if found else None
        with np.errstate(all="ignore"):
            if forwards and before and before.scale and layer.matrix:
                (a, t), (w, b) = before.scale, layer.matrix
                t = np.broadcast_to(t, w.shape[1]).astype(np.float32)
                found[-1] = gemm(w * a, in_order(w, t[None], np.float32(0.0) * b, np.arange(len(t)))[0] + b)
                continue
            if not forwards and before and before.matrix and layer.scale:
                (w, b), (a, t) = before.matrix, layer.scale
                a = np.broadcast_to(a, len(w)).astype(np.float32)
                found[-1] = gemm(a[:, None] * w, a * b + t)
                continue
        found.append(layer)
    return found


@dataclass
class Extreme:
    """A network of layers on images [n] or [c, h, w]."""

    shape: tuple[int, ...]
    layers: list[Layer]

    def write(self, file: Path) -> Path:
        f = OnnxFile(self.shape)
        for layer in self.layers:
            layer.write(f)
        return f.write(file)

    def values(self, x: Array, runners: list[Callable[[Array], Array]]) -> Iterator[tuple[str, Array]]:
        """(program, outputs [B, out]) of float32 programs for images [B, *shape], flushing or not."""
        order = np.random.default_rng(0).permutation

        def ordered(layer: Layer) -> Step:
            if layer.matrix is None:
                return layer.step
            w, b = layer.matrix
            return lambda v: torch.from_numpy(in_order(w, v.numpy(), b, order(w.shape[1])))

        def single(layer: Layer) -> Step:
            return partial(one_pass, epsilon=layer.epsilon) if layer.epsilon else layer.step

        with torch.no_grad(), np.errstate(all="ignore"):
            for flushed in (False, True):
                with flushing(flushed):
                    found = [(name, run(x)) for name, run in zip(("onnxruntime", "plain"), runners, strict=False)]
                    found.append(("torch", through(self.layers, x, lambda layer: layer.step)))
                    found.append(("one pass", through(self.layers, x, single)))
                    found.append(("in order", through(self.layers, x, ordered)))
                    for forwards in (False, True):
                        name = "folded " + ("forwards" if forwards else "backwards")
                        found.append((name, through(folded(self.layers, forwards), x, ordered)))
                yield from ((name + " flushed" * flushed, value) for name, value in found)


def through(layers: list[Layer], x: Array, step: Callable[[Layer], Step]) -> Array:
    value = torch.from_numpy(x)
    for layer in layers:
        value = step(layer)(value)
    return value.reshape(len(x), -1).numpy().copy()


# ---------------------------------------------------------------- networks at random

#: Powers of two of extreme constants.
EXTREMES = (0, 0, 0, 1, -1, 10, -20, 40, -40, 60, -60, 100, -100, 120, -120, -127, -130, -140)


def _constants(rng: np.random.Generator, shape: tuple[int, ...], power: int) -> Array:
    value = np.ldexp(rng.normal(size=shape), power)
    if rng.random() < 0.3:
        value = value * np.where(rng.random(shape) < 0.3, np.ldexp(1.0, int(rng.choice(EXTREMES)) // 4), 1.0)
    return np.clip(value, -1e37, 1e37).astype(np.float32)


def random_layer(rng: np.random.Generator, n: int, power: int) -> Layer:
    """A layer on vectors of ``n`` numbers whose constants are about 2^power."""
    kind = int(rng.integers(0, 26))
    if kind < 4:
        w = _constants(rng, (n, n), power)
        if rng.random() < 0.3:
            w[:, 1::2] = -w[:, ::2][:, : w[:, 1::2].shape[1]]
        return gemm(w, _constants(rng, (n,), power + int(rng.integers(-3, 4))))
    if kind < 8:
        return scale(_constants(rng, (n,), power), _constants(rng, (n,), power), bool(rng.random() < 0.3))
    if kind == 8:
        parts = _constants(rng, (n,), power), _constants(rng, (n,), power // 2), _constants(rng, (n,), 0)
        return batch_norm(*parts, np.abs(_constants(rng, (n,), int(rng.choice([-20, 0, 20, 80])))))
    if kind == 9:
        return plain("Relu", torch.relu)
    if kind == 10:
        alpha = float(np.float32(rng.choice([0.01, 2.0**-60, 2.0**-130])))
        return plain("LeakyRelu", lambda x: functional.leaky_relu(x, alpha), alpha=alpha)
    if kind == 11:
        return power_layer(rng)
    if kind == 12:
        limit = float(np.float32(np.ldexp(rng.normal(), int(rng.choice(EXTREMES)))))
        return clip(*((limit, None), (None, limit), (-abs(limit), abs(limit)))[int(rng.integers(3))])
    if kind in (13, 14):
        return layer_norm(n, float(rng.choice([1e-5, 1e-12])), bool(rng.random() < 0.5))
    simple = (
        ("Abs", torch.abs, {}),
        ("Exp", torch.exp, {}),
        ("Sigmoid", torch.sigmoid, {}),
        ("Elu", functional.elu, {}),
        ("Softplus", lambda x: torch.log(1.0 + torch.exp(-x.abs())) + torch.relu(x), {}),
        ("HardSwish", functional.hardswish, {}),
        ("HardSigmoid", lambda x: (x * np.float32(0.2) + 0.5).clamp(0.0, 1.0), {"alpha": 0.2}),
        ("Softmax", lambda x: torch.softmax(x, -1), {"axis": -1}),
    )
    if kind - 15 < len(simple):
        op, step, attributes = simple[kind - 15]
        return plain(op, step, **attributes)
    return joined(str(rng.choice(["gate", "square", "mean", "residual"])))


def joined(kind: str) -> Layer:
    """A node that meets another of the same numbers."""

    def write(f: OnnxFile) -> None:
        x = f.last
        if kind == "gate":
            f.node("Mul", x, f.node("Sigmoid", x))
        elif kind == "square":
            f.node("Mul", x, f.node("Relu", x))
        elif kind == "mean":
            f.node("Sub", x, f.node("ReduceMean", x, axes=[-1]))
        else:
            f.node("Add", x, f.node("Relu", x))

    steps: dict[str, Step] = {
        "gate": lambda x: x * torch.sigmoid(x),
        "square": lambda x: x * torch.relu(x),
        "mean": lambda x: x - x.mean(-1, keepdim=True),
        "residual": lambda x: x + torch.relu(x),
    }
    return Layer(write, steps[kind], kind=kind)


# ---------------------------------------------------------------- maps


def convolution(w: Array, b: Array, transposed: bool = False, **attributes: Any) -> Layer:
    """A (transposed) convolution with equal strides and dilations."""
    w, b = w.astype(np.float32), b.astype(np.float32)
    op, call = ("ConvTranspose", functional.conv_transpose2d) if transposed else ("Conv", functional.conv2d)
    settings = {"stride": attributes["strides"], "dilation": attributes["dilations"]}
    settings["padding"] = attributes.get("pads", [0, 0])[:2]

    def write(f: OnnxFile) -> None:
        f.node(op, f.last, f.constant(w), f.constant(b), **attributes)

    return Layer(write, lambda x: call(x, torch.from_numpy(w), torch.from_numpy(b), **settings), kind=op)


def random_maps(seed: int) -> tuple[Extreme, Array]:
    """A network of one to three layers on maps of two channels, and the middle of images for it."""
    rng = np.random.default_rng(seed)
    layers, power, count, first = [], 0, int(rng.integers(1, 4)), int(rng.integers(4, 7))
    size = first
    for k in range(count):
        step = -power if k == count - 1 and rng.random() < 0.5 else int(rng.choice(EXTREMES))
        step = int(np.clip(step, -145, 120))
        power += step
        kind = int(rng.integers(0, 6))
        if kind < 3:
            s, d, kernel = (int(v) for v in rng.integers(1, 4, 3))
            w = _constants(rng, (2, 2, kernel, kernel), step)
            b = _constants(rng, (2,), step)
            extent = (kernel - 1) * d + 1
            turned = bool(rng.random() < 0.4) and size <= 4
            if extent > size and not turned:
                s, d, w = 1, 1, w[:, :, :1, :1]
                extent = 1
            layers.append(convolution(w, b, turned, strides=[s, s], dilations=[d, d]))
            size = (size - 1) * s + extent if turned else (size - extent) // s + 1
        elif kind == 3:
            gain, shift, mean = (_constants(rng, (2,), step) for _ in range(3))
            layers.append(batch_norm(gain, shift, mean, np.abs(rng.normal(size=2))))
        elif kind == 4:
            a, t = (_constants(rng, (2, 1, 1), step) for _ in range(2))
            layers.append(scale(a, t, bool(rng.random() < 0.5)))
            layers[-1].scale = None
        elif size > 1:
            pool = [("MaxPool", functional.max_pool2d), ("AveragePool", functional.avg_pool2d)][int(rng.integers(2))]
            layers.append(plain(pool[0], partial(pool[1], kernel_size=2, stride=1), kernel_shape=[2, 2]))
            size -= 1
    shape = (2, first, first)
    return Extreme(shape, layers), np.ldexp(rng.normal(size=shape), int(rng.choice(EXTREMES)) // 2).astype(np.float32)


def power_layer(rng: np.random.Generator) -> Layer:
    return power(float(rng.choice([2.0, 3.0, 0.5, -1.0, -0.5])))


def random_network(seed: int) -> tuple[Extreme, Array]:
    """A network of one to four layers on vectors, and the middle of images for it."""
    rng = np.random.default_rng(seed)
    n, count = int(rng.integers(1, 7)) * 2, int(rng.integers(1, 5))
    layers, power = [], 0
    for k in range(count):
        step = int(rng.choice(EXTREMES))
        if k == count - 1 and rng.random() < 0.5:
            step = -power
        layers.append(random_layer(rng, n, int(np.clip(step, -145, 122))))
        power = int(np.clip(power + step, -145, 122))
    middle = rng.normal(size=n) + rng.choice([0.0, 0.0, 4.0, 20.0])
    if rng.random() < 0.4:
        middle = np.full(n, rng.normal() * 8.0) + np.ldexp(rng.normal(size=n), -int(rng.integers(4, 24)))
    if rng.random() < 0.2:
        middle = np.ldexp(middle, int(rng.choice(EXTREMES)))
    return Extreme((n,), layers), middle.astype(np.float32)
