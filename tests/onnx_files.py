"""Small ONNX files written by hand, image sets, and an attack on bounds of their outputs."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import TensorProto, helper, numpy_helper

from ns_abstract.verify.network import ImageSets, Network


class OnnxFile:
    """Collects the nodes of a model with one input [N, *shape]."""

    def __init__(self, shape: tuple[int, ...], seed: int = 0, opset: int = 17, batch: Any = "N") -> None:
        self.shape, self.opset, self.batch = shape, opset, batch
        self.rng = np.random.default_rng(seed)
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.last, self.kind = "image", TensorProto.FLOAT

    def constant(self, value: Any, kind: Any = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, kind), name))
        return name

    def weights(self, *shape: int, scale: float = 1.0) -> str:
        fan = max(1, int(np.prod(shape[1:])))
        return self.constant(scale * self.rng.normal(size=shape) / np.sqrt(fan))

    def node(self, op: str, *inputs: str, **attributes: Any) -> str:
        """Add a node; without inputs it reads the last."""
        name = f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, list(inputs or (self.last,)), [name], name=f"{op}_{name}", **attributes))
        self.last = name
        return name

    def conv(self, cin: int, cout: int, k: int = 3, groups: int = 1, bias: bool = True, **attributes: Any) -> str:
        inputs = [self.last, self.weights(cout, cin // groups, k, k)]
        if bias:
            inputs.append(self.weights(cout))
        return self.node("Conv", *inputs, group=groups, **attributes)

    def gemm(self, n: int, out: int, scale: float = 1.0) -> str:
        return self.node("Gemm", self.last, self.weights(out, n, scale=scale), self.weights(out), transB=1)

    def relu_layers(self, *sizes: int) -> None:
        """Add fully connected layers of so many numbers, with ReLUs between."""
        for before, after in itertools.pairwise(sizes[:-1]):
            self.gemm(before, after)
            self.node("Relu")
        self.gemm(sizes[-2], sizes[-1])

    def model(self) -> onnx.ModelProto:
        sizes = [self.batch, *self.shape]
        graph = helper.make_graph(
            self.nodes,
            "network",
            [helper.make_tensor_value_info("image", self.kind, sizes)],
            [helper.make_tensor_value_info(self.last, TensorProto.FLOAT, None)],
            self.constants,
        )
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", self.opset)], ir_version=8)

    def write(self, file: Path) -> Path:
        file.write_bytes(self.model().SerializeToString())
        return file


def image_sets(shape: tuple[int, ...], m: int, d: int, radius: float, slack: float, seed: int = 0) -> ImageSets:
    """Random sets: planes that are not parallel, and boxes that cut some of them."""
    rng = np.random.default_rng(seed)
    n = int(np.prod(shape))
    b = rng.normal(size=(m, n))
    a = radius * rng.normal(size=(m, n, d))
    apart = 0.3 * slack * rng.uniform(-1, 1, (m, n, d))
    low, high = slack * rng.uniform(0.3, 1, (m, n)), slack * rng.uniform(0.3, 1, (m, n))
    # planes that differ by less than their distance do not cross
    low, high = low + np.abs(apart).sum(-1), high + np.abs(apart).sum(-1)
    reach = np.abs(a).sum(-1)
    cut = rng.uniform(0.7, 1.3, (m, n))
    lower = b - low - reach * cut - np.abs(apart).sum(-1)
    upper = b + high + reach * cut + np.abs(apart).sum(-1)
    return ImageSets(a - apart, b - low, a + apart, b + high, lower, upper)


def boxed(images: ImageSets) -> ImageSets:
    """The sets' boxes alone: nothing is said of parameters."""
    still = np.zeros_like(images.a_lower)
    return ImageSets(still, images.lower, still, images.upper, images.lower, images.upper)


def members(images: ImageSets, cell: int, p: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images at ``p`` [B, d], ``t`` [B, n] of the way between their bounds; and which are in the set."""
    low = np.maximum(p @ images.a_lower[cell].T + images.b_lower[cell], images.lower[cell])
    high = np.minimum(p @ images.a_upper[cell].T + images.b_upper[cell], images.upper[cell])
    x = (low + t * (high - low)).astype(np.float32)
    x = np.where(x < low, np.nextafter(x, np.float32(np.inf)), x)
    x = np.where(x > high, np.nextafter(x, np.float32(-np.inf)), x)
    return x, ((x >= low) & (x <= high)).all(axis=1)


def session(file: Path) -> Callable[[np.ndarray], np.ndarray]:
    """onnxruntime on images [B, ...], one at a time if the file wants that."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = 1
    opened = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    entry = opened.get_inputs()[0]
    single = entry.shape[0] == 1

    def run(x: np.ndarray) -> np.ndarray:
        parts = [x[k : k + 1] for k in range(len(x))] if single else [x]
        found = [np.asarray(opened.run(None, {entry.name: part})[0]) for part in parts]
        return np.concatenate([f.reshape(part.shape[0], -1) for f, part in zip(found, parts, strict=True)])

    return run


def attack(
    network: Network,
    run: Callable[[np.ndarray], np.ndarray],
    images: ImageSets,
    cell: int,
    rows: np.ndarray,
    count: int = 64,
    steps: int = 15,
    seed: int = 0,
) -> tuple[np.ndarray, int]:
    """Least ``rows @ y`` [k] of float32 runs over images of one cell, and how many were compared.

    Random and extreme images first, then gradient descent of every row from its best one.
    """
    rng = np.random.default_rng(seed)
    d, n, k = images.dimensions, network.input_size, len(rows)
    p = np.where(
        rng.uniform(size=(count, 1)) < 0.5, rng.uniform(-1, 1, (count, d)), rng.choice([-1.0, 1.0], (count, d))
    )
    t = np.where(rng.uniform(size=(count, 1)) < 0.5, rng.uniform(size=(count, n)), rng.integers(0, 2, (count, n)))
    t[: count // 8] = 0.5
    least, compared = np.full(k, np.inf), 0
    best_p, best_t = np.zeros((k, d)), np.full((k, n), 0.5)

    def compare(p: np.ndarray, t: np.ndarray) -> None:
        nonlocal compared
        x, inside = members(images, cell, p, t)
        if not inside.any():
            return
        y = run(x[inside].reshape(-1, *network.input_shape)).astype(np.float64) @ rows.T
        compared += y.size
        for row in range(k):
            at = int(y[:, row].argmin())
            if y[at, row] < least[row]:
                least[row] = y[at, row]
                best_p[row], best_t[row] = p[inside][at], t[inside][at]

    compare(p, t)
    fields = [torch.from_numpy(getattr(images, name)[cell]) for name in images.__dataclass_fields__]
    a_lower, b_lower, a_upper, b_upper, lower, upper = fields
    step = 0.5
    for _ in range(steps):
        q = torch.from_numpy(best_p).requires_grad_()
        s = torch.from_numpy(best_t).requires_grad_()
        low = torch.maximum(q @ a_lower.T + b_lower, lower)
        high = torch.minimum(q @ a_upper.T + b_upper, upper)
        x = low + s * (high - low)
        y = network(x.reshape(-1, *network.input_shape))
        (y * torch.from_numpy(rows)).sum().backward()
        assert q.grad is not None and s.grad is not None
        move_p = np.clip(best_p - step * np.sign(q.grad.numpy()), -1.0, 1.0)
        move_t = np.where(s.grad.numpy() > 0.0, 0.0, np.where(s.grad.numpy() < 0.0, 1.0, best_t))
        compare(np.concatenate([best_p, move_p, move_p]), np.concatenate([move_t, best_t, move_t]))
        step *= 0.7
    return least, compared
