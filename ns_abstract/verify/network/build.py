"""Builds layers from checked weights and attributes, for every file format (docs/dev/design.md, N7)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import LEAST_DIVISOR, OVERFLOW, gamma
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network.graph import Layer, Network, Node, as_double, item
from ns_abstract.verify.network.layers import (
    ChannelEmbedding,
    Convolution,
    Gather,
    LeakyRelu,
    LinearLayer,
    Matrix,
    Pad,
    ScaleLayer,
    Shape,
    Sum,
)
from ns_abstract.verify.network.max_pooling import MaxPool

#: Numbers that one item of a layer may have.
_LARGEST = 1 << 26
#: Numbers that all items and all constants made while reading may have together.
_LARGEST_TOTAL = 1 << 29
_ONE = (1, 1)
#: Numbers of a window whose pairs are compared.
_TAPS = 32


class NetworkBuilder:
    """Collects the nodes of one network; every method adds layers and returns the number of the last node.

    Errors state the problem; the file's reader adds file and node.
    """

    def __init__(self, path: Path, input_shape: Shape) -> None:
        self.path = path
        self._check_size(input_shape)
        self.input_shape = input_shape
        self.nodes: list[Node] = []
        self.spent = 0.0

    def shape(self, index: int) -> Shape:
        """Return the shape of one item of node ``index``."""
        return self.nodes[index - 1].layer.shape if index else self.input_shape

    def name(self, index: int, name: str, op: str) -> None:
        """Give the file's name and operator to the unnamed layers up to node ``index``."""
        for k in range(index, 0, -1):
            if self.nodes[k - 1].name:
                break
            self.nodes[k - 1] = replace(self.nodes[k - 1], name=name, op=op)

    def network(self, output: int, name: str = "", whole_numbers: bool = False, data: Sequence[Path] = ()) -> Network:
        """Return the network whose output is node ``output``, called ``name``, without unneeded nodes.

        ``data`` are the files beside the model that hold constants.
        """
        needed = {output}
        for k in range(output, 0, -1):
            if k in needed:
                needed.update(self.nodes[k - 1].inputs)
        new_number = {0: 0}
        nodes_kept = []
        for k, node in enumerate(self.nodes, 1):
            if k in needed:
                nodes_kept.append(replace(node, inputs=tuple(new_number[i] for i in node.inputs)))
                new_number[k] = len(nodes_kept)
        shape = self.shape(output)
        # the numbers are the same in the shape they had before
        while (
            nodes_kept and type(nodes_kept[-1].layer) is LinearLayer and nodes_kept[-1].inputs[0] == len(nodes_kept) - 1
        ):
            before = nodes_kept[-1].layer.input_shapes[0]
            nodes_kept.pop()
            if len(shape) == 1 and len(before) == 3:
                shape = before
        return Network(self.path, self.input_shape, nodes_kept, shape, name, whole_numbers, data)

    def _check_size(self, shape: Sequence[int]) -> None:
        if any(v < 1 for v in shape) or int(np.prod([float(v) for v in shape])) > _LARGEST:
            raise InputError(f"an item of {item(shape)} numbers", fix=f"between 1 and {_LARGEST:,} are supported")

    def reserve(self, count: float) -> None:
        """Raise InputError for an array of ``count`` numbers that would take too much memory, before it is made."""
        self.spent += count
        if self.spent > _LARGEST_TOTAL:
            raise InputError(
                f"needs more than {_LARGEST_TOTAL:,} numbers up to here", fix="use a smaller input or fewer channels"
            )

    def _add(self, layer: Layer, *inputs: int) -> int:
        self._check_size(layer.shape)
        self.reserve(float(np.prod(layer.shape)))
        for name in ("weight", "offset", "factor"):
            value = getattr(layer, name, None)
            if isinstance(value, Tensor) and not bool(torch.isfinite(value).all()):
                raise InputError("holds numbers that are not finite", fix="train the network again")
            if isinstance(value, Tensor) and value.numel() and float(value.abs().max()) >= OVERFLOW:
                raise InputError("holds numbers that float32 cannot compute with", fix="train the network again")
        if isinstance(layer, LinearLayer):
            # refuses sums of which no digit is left
            gamma(layer.terms + layer.row_terms)
        self.nodes.append(Node("", "", layer, inputs))
        return len(self.nodes)

    # ------------------------------------------------------------ windows

    def check_window(self, x: int, kernel: Any, stride: Any, dilation: Any, pads: Any) -> tuple[int, int]:
        """Return the rows and columns of a window operator's result. InputError."""
        sizes = []
        for axis, name in enumerate(("rows", "columns")):
            n, k, s, d = self.shape(x)[1 + axis], kernel[axis], stride[axis], dilation[axis]
            if k < 1 or s < 1 or d < 1 or min(pads) < 0 or max(pads) > _LARGEST:
                raise InputError(
                    f"kernel_shape {list(kernel)}, strides {list(stride)}, dilations {list(dilation)}, "
                    f"pads {list(pads)}",
                    fix="positive numbers and pads of at least 0 expected",
                )
            free = n + pads[axis] + pads[axis + 2] - (k - 1) * d - 1
            if free < 0:
                raise InputError(f"kernel_shape {list(kernel)} is larger than the {n} {name} with pads {list(pads)}")
            sizes.append(free // s + 1)
        return sizes[0], sizes[1]

    def convolution(
        self,
        x: int,
        weight: np.ndarray,
        bias: Any,
        stride: Any,
        dilation: Any,
        pads: Any,
        groups: int,
        exact: bool = False,
    ) -> int:
        """Add a convolution with weights [Cout, Cin / groups, kh, kw]."""
        channels = self.shape(x)[0]
        if groups < 1 or channels != groups * weight.shape[1] or weight.shape[0] % groups:
            raise InputError(f"weights {item(weight.shape)} with group = {groups} on {channels} channels")
        if bias is not None and bias.shape != weight.shape[:1]:
            raise InputError(f"bias {item(bias.shape)} of {weight.shape[0]} channels")
        size = self.check_window(x, weight.shape[2:], stride, dilation, pads)
        terms = int(np.prod(weight.shape[1:]))
        axes = zip(weight.shape[2:], stride, dilation, strict=True)
        taps = int(np.prod([-(-k // (s // math.gcd(s, d))) for k, s, d in axes]))
        layer = Convolution(
            (self.shape(x),),
            (weight.shape[0], *size),
            0 if exact else terms + 1,
            weight.shape[0] // groups * taps,
            as_double(weight),
            None if bias is None else as_double(bias),
            tuple(stride),
            tuple(dilation),
            tuple(pads),
            groups,
        )
        return self._add(layer, x)

    def average_pool(self, x: int, kernel: Any, stride: Any, pads: Any, count_pads: bool) -> int:
        """Add average pooling; with ``count_pads`` the padding counts as numbers."""
        channels = self.shape(x)[0]
        self.check_window(x, kernel, stride, _ONE, pads)
        count = kernel[0] * kernel[1]
        ones = np.full((channels, 1, *kernel), 1.0 / count)
        index = self.convolution(x, ones, None, stride, _ONE, pads, channels)
        if count_pads or not any(pads):
            return index
        if any(p >= k for p, k in zip(pads, (*kernel, *kernel), strict=True)):
            raise InputError(f"pads {list(pads)} of windows {list(kernel)}", fix="pads must be smaller than the window")
        here = self.nodes[-1].layer
        assert isinstance(here, Convolution)
        inside = here.apply([torch.ones((1, *here.input_shapes[0]), dtype=torch.float64)])[0]
        return self.scale(index, 1.0 / inside.numpy(), None)

    def max_pool(self, x: int, kernel: Any, stride: Any, dilation: Any, pads: Any) -> int:
        """Add max pooling (N12)."""
        channels, *_ = self.shape(x)
        size = self.check_window(x, kernel, stride, dilation, pads)
        if kernel[0] * kernel[1] > _TAPS and min(kernel) > 1:
            # rows of windows, then their columns: fewer pairs of numbers
            x = self.max_pool(x, (kernel[0], 1), (stride[0], 1), (dilation[0], 1), (pads[0], 0, pads[2], 0))
            return self.max_pool(x, (1, kernel[1]), (1, stride[1]), (1, dilation[1]), (0, pads[1], 0, pads[3]))
        layer = MaxPool((self.shape(x),), (channels, *size), tuple(kernel), tuple(stride), tuple(dilation), tuple(pads))
        self._check_size(layer.shape)
        # the largest taps of a window at a time, and their places
        self.reserve(float(np.prod(kernel)) * size[0] * size[1])
        if not bool((layer.places >= 0).any(0).all()):
            raise InputError("a window lies in the padding altogether", fix="use smaller pads")
        return self._add(layer, x)

    def _maximum(self, a: int, b: int) -> int:
        less = self.sum((a, b), (1, -1), exact=True)
        return self.sum((b, self.leaky_relu(less, 0.0)), (1, 1), exact=True)

    # ------------------------------------------------------------ other linear layers

    def matrix(self, x: int, weight: np.ndarray, bias: np.ndarray | None) -> int:
        """Add a fully connected layer with weights [out, in]."""
        shape = self.shape(x)
        if weight.shape[1] != shape[-1]:
            raise InputError(f"weights {item(weight.shape)} (out x in) on an item {item(shape)}", fix="flatten before")
        if bias is not None:
            try:
                bias = np.broadcast_to(bias, (1, weight.shape[0]))[0]  # the same for every row
            except ValueError:
                raise InputError(f"bias {item(bias.shape)} of {weight.shape[0]} outputs") from None
        layer = Matrix(
            (shape,),
            (*shape[:-1], weight.shape[0]),
            weight.shape[1] + 3,
            weight.shape[0],
            as_double(weight),
            None if bias is None else as_double(bias),
        )
        return self._add(layer, x)

    def scale(self, x: int, factor: np.ndarray, offset: np.ndarray | None, parts: float = 0.0) -> int:
        """Add ``factor * x + offset`` with constants that broadcast to a batch; ``parts``: see `ScaleLayer`."""
        shape = self.shape(x)
        self.reserve(2.0 * float(np.prod(shape)))
        spread = []
        for constant in (factor, offset):
            if constant is None:
                spread.append(None)
                continue
            try:
                fitted = np.broadcast_to(constant, (1, *shape))[0]
            except ValueError:
                raise InputError(f"constant {item(constant.shape)} with an item {item(shape)}") from None
            spread.append(as_double(fitted))
        return self._add(ScaleLayer((shape,), shape, 3 + self._fused(x), 1, spread[0], spread[1], parts), x)

    def _fused(self, *inputs: int) -> int:
        """Return the roundings of the inputs' sums, which a program may fuse with this one (N2)."""
        layers = [self.nodes[k - 1].layer for k in inputs if k]
        return max((layer.terms for layer in layers if isinstance(layer, LinearLayer)), default=0)

    def batch_norm(
        self, x: int, scale: np.ndarray, shift: np.ndarray, mean: np.ndarray, variance: np.ndarray, epsilon: float
    ) -> int:
        """Add batch normalisation with stored statistics."""
        shape = self.shape(x)
        parts = [np.asarray(v, np.float64) for v in (scale, shift, mean, variance)]
        if any(v.shape != shape[:1] for v in parts):
            raise InputError(f"statistics {[item(v.shape) for v in parts]} of {shape[0]} channels")
        scale, shift, mean, variance = (v.reshape(-1, *[1] * (len(shape) - 1)) for v in parts)
        if not (variance + epsilon > LEAST_DIVISOR).all():
            raise InputError("variance + epsilon is not positive, or below 1e-30", fix="train the network again")
        if not all(np.abs(v).max(initial=0.0) < OVERFLOW for v in (scale, shift, mean, variance)):
            raise InputError("holds numbers that float32 cannot compute with", fix="train the network again")
        root = 1.0 / np.sqrt(variance + epsilon)
        factor = scale / np.sqrt(variance + epsilon)
        # a program may take the mean away, divide and multiply one after the other, or put the factors together
        grown = float(np.prod([1.0 + np.abs(v).max(initial=0.0) for v in (scale, mean, root)]))
        # shift - mean * factor may cancel: its parts are charged one after the other
        index = self.scale(x, factor, -mean * factor, grown)
        return self.scale(index, np.ones(()), shift)

    def sum(self, inputs: tuple[int, ...], signs: tuple[int, ...], exact: bool = False) -> int:
        """Add a sum or difference of equal shapes."""
        shapes = tuple(self.shape(k) for k in inputs)
        if len(set(shapes)) != 1:
            raise InputError(f"shapes {[item(s) for s in shapes]} differ", fix="spreading is not supported")
        return self._add(Sum(shapes, shapes[0], 0 if exact else len(inputs) + self._fused(*inputs), 1, signs), *inputs)

    def reshape(self, x: int, shape: Sequence[int]) -> int:
        """Add a change of shape."""
        if tuple(shape) == self.shape(x):
            return x
        return self._add(LinearLayer((self.shape(x),), tuple(shape)), x)

    def gather(self, x: int, index: np.ndarray, fill: float = 0.0) -> int:
        """Add a selection of the item's numbers at flat positions ``index``, in its shape; -1 stands for ``fill``."""
        flat = torch.from_numpy(np.ascontiguousarray(index).reshape(-1).astype(np.int64))
        repeated = int(np.bincount(flat[flat >= 0].numpy(), minlength=1).max())
        return self._add(Gather((self.shape(x),), index.shape, 0, repeated, flat, fill), x)

    def transpose(self, x: int, order: Sequence[int]) -> int:
        """Add a permutation of the item's axes."""
        shape = self.shape(x)
        if list(order) == list(range(len(shape))):
            return x
        return self.gather(x, np.arange(int(np.prod(shape))).reshape(shape).transpose(order))

    def slice(self, x: int, chosen: Sequence[slice]) -> int:
        """Add a slice of the item: the places ``chosen`` along its axes."""
        shape = self.shape(x)
        index = np.arange(int(np.prod(shape))).reshape(shape)[tuple(chosen)]
        if index.size == 0:
            raise InputError(f"nothing is left of an item {item(shape)}")
        same = index.shape == shape and bool((index.reshape(-1) == np.arange(index.size)).all())
        return x if same else self.gather(x, index)

    def pad(self, x: int, before: Sequence[int], after: Sequence[int], mode: str, value: float) -> int:
        """Add padding around the item."""
        shape = self.shape(x)
        if mode not in ("constant", "reflect", "edge", "wrap"):
            raise InputError(f"attribute mode = {mode} is not supported", fix="use constant, reflect, edge or wrap")
        if not np.isfinite(value):
            raise InputError(f"pads with {value}", fix="use a finite number")
        if not any(before) and not any(after):
            return x
        grown = [n + a + b for n, a, b in zip(shape, before, after, strict=True)]
        self._check_size(grown)
        if mode == "constant" and len(shape) == 3 and not before[0] and not after[0]:
            pads = (before[1], before[2], after[1], after[2])
            return self._add(Pad((shape,), tuple(grown), 0, 1, pads, value), x)
        if min(*before, *after) < 0:
            raise InputError("negative pads are not supported here", fix="slice instead")
        if mode == "reflect" and any(max(a, b) >= n for n, a, b in zip(shape, before, after, strict=True)):
            raise InputError("reflected pads are larger than the item", fix="use smaller pads")
        if mode == "wrap" and any(max(a, b) > n for n, a, b in zip(shape, before, after, strict=True)):
            raise InputError("wrapped pads are larger than the item", fix="use smaller pads")
        index = np.arange(int(np.prod(shape))).reshape(shape)
        widths = list(zip(before, after, strict=True))
        if mode == "constant":
            return self.gather(x, np.pad(index, widths, constant_values=-1), value)
        return self.gather(x, np.pad(index, widths, mode=mode))  # type: ignore[call-overload]

    def concat(self, sources: Sequence[int], axis: int) -> int:
        """Add a concatenation along ``axis`` of the item, as a sum of items with zeros around them."""
        shapes = [self.shape(k) for k in sources]
        if any(
            len(s) != len(shapes[0]) or s[:axis] + s[axis + 1 :] != shapes[0][:axis] + shapes[0][axis + 1 :]
            for s in shapes
        ):
            raise InputError(f"shapes {[item(s) for s in shapes]} do not fit")
        if len(sources) == 1:
            return sources[0]
        total, parts, done = sum(s[axis] for s in shapes), [], 0
        for source, shape in zip(sources, shapes, strict=True):
            if axis == 0 and len(shape) == 3:
                parts.append(self._add(ChannelEmbedding((shape,), (total, *shape[1:]), 0, 1, done), source))
            else:
                before, after = [0] * len(shape), [0] * len(shape)
                before[axis], after[axis] = done, total - done - shape[axis]
                parts.append(self.pad(source, before, after, "constant", 0.0))
            done += shape[axis]
        return self.sum(tuple(parts), (1,) * len(parts), exact=True)

    # ------------------------------------------------------------ activations

    def leaky_relu(self, x: int, alpha: float) -> int:
        """Add ``max(z, alpha z)``."""
        if not 0.0 <= alpha <= 1.0:
            raise InputError(f"attribute alpha = {alpha} is not supported", fix="between 0 and 1 expected")
        return self._add(LeakyRelu(self.shape(x), alpha), x)
