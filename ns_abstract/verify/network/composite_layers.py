"""Build operators that consist of several basic layers (docs/dev/design.md, N11, N19)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch

from ns_abstract.arithmetic.network_charges import (
    ATTENTION,
    ATTENTION_BLOCKS,
    FOLDING,
    LEAST_DIVISOR,
    NEAR,
    OVERFLOW,
    POLYNOMIAL,
    POSITION,
    gamma,
)
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import activations
from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.build import NetworkBuilder
from ns_abstract.verify.network.composite_activations import GatedClip, ScaledGelu, SwitchedSoftplus
from ns_abstract.verify.network.graph import as_double, item
from ns_abstract.verify.network.inexact_constants import ConstantIntervals, InexactLayer, with_inexact_constants
from ns_abstract.verify.network.layers import (
    Activation,
    Convolution,
    Gather,
    LeakyRelu,
    LinearLayer,
    ScaleLayer,
    Shape,
    Sum,
)
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.sparse_layers import (
    PairwiseDifferences,
    Resize,
    SparseMatrix,
    TransposedConvolution,
    Variance,
)

#: The same for curves that take the file's own numbers.
_ALIKE = 2.0**-10
_ONES = (1, 1)
#: A preference: limits of one side up to this are those of a ReLU, whose slopes are chosen (N14).
_NEAR_ZERO = 2.0**16
#: Entries of a matrix that takes means away; where it would have more, the mean is a layer of its own.
_CENTRED_AT_ONCE = 1 << 16


class CompositeBuilder(NetworkBuilder):
    """Builds operators such as softmax, normalisation and resizing from basic layers."""

    # ------------------------------------------------------------ what is known of nodes

    def _node(self, index: int) -> Any:
        return self.nodes[index - 1] if index else None

    def _affine(self, index: int) -> tuple[int, float, float]:
        """(root, factor, offset): node ``index`` is ``factor * root + offset`` with plain numbers."""
        factor, offset = 1.0, 0.0
        # constants that are known within bounds alone are no plain numbers
        while index and type(self._node(index).layer) is ScaleLayer:
            layer = self._node(index).layer
            f = layer.factor.reshape(-1)
            o = torch.zeros(1, dtype=torch.float64) if layer.offset is None else layer.offset.reshape(-1)
            if not (bool((f == f[0]).all()) and bool((o == o[0]).all())):
                break
            factor, offset = factor * float(f[0]), offset + factor * float(o[0])
            index = self._node(index).inputs[0]
        return index, factor, offset

    def floor(self, index: int, depth: int = 12) -> float:
        """A number that node ``index`` never is below, by what computes it, rounding included."""
        if not index or not depth:
            return -math.inf
        node = self._node(index)
        layer = node.layer
        if isinstance(layer, (activations.Exp, activations.Softplus, activations.Abs, activations.Sigmoid)):
            return 0.0
        if isinstance(layer, LeakyRelu) and layer.alpha == 0.0:
            return 0.0
        if isinstance(layer, activations.Power) and layer.exponent % 2 == 0:
            return 0.0
        if isinstance(layer, activations.Clip):
            return layer.least
        least = [self.floor(k, depth - 1) for k in node.inputs]
        if isinstance(layer, Product):
            return 0.0 if min(least) >= 0.0 else -math.inf
        if isinstance(layer, Variance):
            # one pass may end below zero (N11)
            return -math.inf
        if min(least) == -math.inf or isinstance(layer, Activation):
            return -math.inf
        if type(layer) is ScaleLayer and bool((layer.factor >= 0.0).all()):
            low = layer.factor * least[0] + (0.0 if layer.offset is None else layer.offset)
            positive = layer.offset is None or bool((layer.offset >= 0.0).all())
            return self._rounded(float(low.min()), positive, layer.terms)
        if type(layer) is LinearLayer or isinstance(layer, MaxPool):
            return least[0]
        positive = (
            (isinstance(layer, Sum) and min(layer.signs) > 0)
            or (
                isinstance(layer, (SparseMatrix, Convolution))
                and not isinstance(layer, InexactLayer)
                and bool((layer.weight >= 0.0).all())
            )
            or isinstance(layer, Gather)
        )
        return 0.0 if positive and min(least) >= 0.0 and layer.bias is None else -math.inf

    @staticmethod
    def _rounded(value: float, positive: bool, terms: int) -> float:
        """A sum of numbers that are not negative keeps its size, but for ``terms`` roundings and folding."""
        return value * (1.0 - gamma(terms + FOLDING)) if positive and value >= 0.0 else -math.inf

    # ------------------------------------------------------------ functions of one number

    def curve(self, x: int, make: Callable[..., activations.ScalarFunction], **settings: Any) -> int:
        """A layer of `ns_abstract.verify.network.activations`."""
        return self._add(make(self.shape(x), **settings), x)

    def doubt(self, index: int, weight: ConstantIntervals | None, offset: ConstantIntervals | None) -> int:
        """The last layer again, whose constants are known within bounds alone (N23)."""
        if weight is None and offset is None:
            return index
        node = self.nodes[index - 1]
        assert isinstance(node.layer, LinearLayer)
        self.nodes[index - 1] = replace(node, layer=with_inexact_constants(node.layer, weight, offset))
        return index

    def clip(self, x: int, least: float, most: float) -> int:
        """``min(max(x, least), most)``, with infinite limits, too."""
        if not least <= most:
            raise InputError(f"clips to [{least}, {most}]", fix="the limits must not cross")
        if least >= OVERFLOW or most <= -OVERFLOW:
            raise InputError(f"clips to [{least}, {most}]", fix="float32 cannot compute with such numbers")
        # numbers that are bounded at all never reach limits past that (N22)
        open_below, open_above = least <= -OVERFLOW, most >= OVERFLOW
        if open_below and open_above:
            return x
        if least == most:
            return self.scale(x, np.zeros(()), np.asarray(least))
        limit = least if open_above else most
        if (open_below or open_above) and abs(limit) <= _NEAR_ZERO:
            sign = 1.0 if open_above else -1.0
            moved = x if limit == 0.0 and sign > 0.0 else self.scale(x, np.asarray(sign), np.asarray(-sign * limit))
            if limit == 0.0 and sign > 0.0:
                return self.leaky_relu(moved, 0.0)
            return self.scale(self.leaky_relu(moved, 0.0), np.asarray(sign), np.asarray(limit))
        bounds = -math.inf if open_below else least, math.inf if open_above else most
        return self.curve(x, activations.Clip, least=bounds[0], most=bounds[1])

    def prelu(self, x: int, slope: np.ndarray) -> int:
        """``max(x, 0) + slope min(x, 0)`` as ``slope x + (1 - slope) relu(x)``."""
        slope = np.asarray(slope, np.float64)
        if slope.size == 1 and 0.0 <= float(slope.reshape(-1)[0]) <= 1.0:
            return self.leaky_relu(x, float(slope.reshape(-1)[0]))
        straight = self.scale(x, slope, None)
        return self.sum((straight, self.scale(self.leaky_relu(x, 0.0), 1.0 - slope, None)), (1, 1))

    def power(self, x: int, exponent: float) -> int:
        """``x^exponent`` for whole exponents and half ones."""
        if exponent == 1.0:
            return x
        if exponent == int(exponent) and 2.0 <= exponent <= 8.0:
            return self.curve(x, activations.Power, exponent=int(exponent))
        if exponent in (0.5, -0.5):
            return self.curve(x, activations.Root, floor=self._above(x), inverse=exponent < 0.0)
        if exponent == -1.0:
            return self.reciprocal(x)
        raise InputError(f"exponent {exponent} is not supported", fix="use 2 to 8, 0.5, -0.5 or -1")

    def _above(self, x: int) -> float:
        floor = self.floor(x)
        # a smaller one may be flushed to zero
        return floor if floor > LEAST_DIVISOR else -math.inf

    def reciprocal(self, x: int) -> int:
        """``1 / x``; 1 / sqrt is one function."""
        node = self._node(x)
        if node is not None and isinstance(node.layer, activations.Root) and not node.layer.inverse:
            return self.curve(node.inputs[0], activations.Root, floor=node.layer.floor, inverse=True)
        return self.curve(x, activations.Reciprocal, floor=self._above(x))

    def softsign(self, x: int) -> int:
        """``x / (1 + |x|)``."""
        size = self.scale(self.curve(x, activations.Abs), np.ones(()), np.ones(()))
        return self.product(x, self.reciprocal(size))

    def logarithm(self, x: int) -> int:
        """The natural logarithm."""
        return self.curve(x, activations.Log, floor=self._above(x))

    def switched_softplus(self, compared: int, limit: float, straight: int, curved: int) -> int:
        """``straight`` where ``compared`` is above the limit, else the softplus ``curved``; 0 if it is none."""
        (root, s, o), (behind, t, p) = self._affine(straight), self._affine(curved)
        node = self._node(behind)
        if node is None or type(node.layer) is not activations.Softplus or limit < 16.0 or o != 0.0 or p != 0.0:
            return 0
        argument, other = self._affine(node.inputs[0]), self._affine(compared)
        same = argument[0] == other[0] == root and argument[2] == other[2] == 0.0 and argument[1] == other[1]
        if not same or not abs(t * argument[1] - s) <= NEAR * abs(s):
            return 0
        # of the argument a x: the line is s x = s / (t a) of it, times t
        excess = abs(1.0 - s / (t * argument[1]))
        return self._times(self.curve(node.inputs[0], SwitchedSoftplus, limit=limit, excess=excess), t)

    # ------------------------------------------------------------ two values that depend on the image

    def spread(self, x: int, shape: Shape) -> int:
        """The item repeated along axes of length 1, as arrays are."""
        before = self.shape(x)
        if before == tuple(shape):
            return x
        self._check_size(shape)
        self.reserve(float(np.prod(shape)))
        try:
            index = np.broadcast_to(np.arange(int(np.prod(before))).reshape(1, *before), (1, *shape))[0]
        except ValueError:
            raise InputError(f"shapes {item(before)} and {item(shape)} do not fit") from None
        if int(np.prod(before)) == int(np.prod(shape)):
            return self.reshape(x, tuple(shape))
        return self._gather(x, index, 0.0)

    def common(self, *inputs: int) -> tuple[int, ...]:
        """The inputs, spread to one shape."""
        try:
            shape = np.broadcast_shapes(*[(1, *self.shape(k)) for k in inputs])
        except ValueError:
            raise InputError(f"shapes {[item(self.shape(k)) for k in inputs]} do not fit") from None
        if shape[0] != 1:
            raise InputError(f"shapes {[item(self.shape(k)) for k in inputs]} mix the batch", fix="unsqueeze before")
        return tuple(self.spread(k, shape[1:]) for k in inputs)

    def plus(self, inputs: Sequence[int], signs: Sequence[int]) -> int:
        """A sum of values whose shapes may differ."""
        return self.sum(self.common(*inputs), tuple(signs))

    def product(self, a: int, b: int) -> int:
        """``a b``; a value times a known function of it is one function (N10)."""
        gated = self._gated(a, b) or self._gated(b, a)
        if gated:
            return gated
        (root, s, o), (other, t, p) = self._affine(a), self._affine(b)
        if root == other and o == p == 0.0:
            return self._times(self.curve(root, activations.Power, exponent=2), s * t)
        a, b = self.common(a, b)
        return self._add(Product(self.shape(a)), a, b)

    def _times(self, x: int, factor: float) -> int:
        return x if factor == 1.0 else self.scale(x, np.asarray(factor), None)

    def _gated(self, value: int, gate: int) -> int:
        """``value gate`` as one curve; 0 if it is none that is known."""
        root, s, o = self._affine(value)
        inner, factor, shift = self._affine(gate)
        node = self._node(inner)
        if o != 0.0 or node is None or not isinstance(node.layer, Activation) or s == 0.0 or factor == 0.0:
            return 0
        argument, t, c = self._affine(node.inputs[0])
        layer = node.layer
        if isinstance(layer, activations.Tanh) and c == 0.0 and t == 1.0 and shift == 0.0:
            behind = self._node(argument)
            if behind is not None and isinstance(behind.layer, activations.Softplus) and behind.inputs[0] == root:
                return self._times(self.curve(root, activations.Mish), s * factor)
        if argument != root:
            return 0
        if isinstance(layer, activations.Sigmoid) and c == 0.0 and shift == 0.0 and t != 0.0:
            return self._times(self.curve(self._times(root, t), activations.Silu), s * factor / t)
        if (
            isinstance(layer, activations.Erf)
            and c == 0.0
            and abs(t * math.sqrt(2.0) - 1.0) < _ALIKE
            and shift == factor
        ):
            return self._times(self.curve(root, ScaledGelu, rate=t * math.sqrt(2.0)), 2.0 * s * factor)
        if isinstance(layer, activations.Clip) and shift == 0.0 and layer.least == 0.0 and 0.0 in (c, layer.offset):
            # clip(a x + b, 0, m) of the root
            a, b = layer.factor * t / layer.most, (layer.factor * c + layer.offset) / layer.most
            if abs(6.0 * a - 1.0) < _ALIKE and abs(2.0 * b - 1.0) < _ALIKE:
                gate = self.curve(root, GatedClip, factor=a, offset=b)
                return self._times(gate, s * factor * layer.most)
        return 0

    def extreme(self, inputs: Sequence[int], most: bool) -> int:
        """Greatest or least of several values."""
        parts = list(self.common(*inputs))
        while len(parts) > 1:
            pairs = [self._either(a, b, most) for a, b in zip(parts[::2], parts[1::2], strict=False)]
            parts = pairs + parts[len(pairs) * 2 :]
        return parts[0]

    def _either(self, a: int, b: int, most: bool) -> int:
        if most:
            return self._maximum(a, b)
        # min(a, b) = a - relu(a - b)
        less = self.sum((a, b), (1, -1), exact=True)
        return self.sum((a, self.leaky_relu(less, 0.0)), (1, -1), exact=True)

    # ------------------------------------------------------------ sparse maps

    def _sparse(
        self,
        x: int,
        shape: Shape,
        to: np.ndarray,
        source: np.ndarray,
        weight: Any,
        terms: int | None = None,
        kind: Callable[..., SparseMatrix] = SparseMatrix,
    ) -> int:
        """A sparse matrix; positions of equal shape, weights broadcast."""
        to, source = to.reshape(-1).astype(np.int64), source.reshape(-1).astype(np.int64)
        weight = np.broadcast_to(np.asarray(weight, np.float64), to.shape)
        forwards = int(np.bincount(to, minlength=1).max())
        backwards = int(np.bincount(source, minlength=1).max())
        layer = kind(
            (self.shape(x),),
            tuple(shape),
            forwards + 2 if terms is None else terms,
            backwards,
            torch.from_numpy(to.copy()),
            torch.from_numpy(source.copy()),
            as_double(weight),
        )
        return self._add(layer, x)

    def positions(self, x: int, copies: int = 1) -> np.ndarray:
        """Flat positions in the item."""
        size = int(np.prod(self.shape(x)))
        self.reserve(3.0 * size * copies)
        return np.arange(size).reshape(self.shape(x))

    def reduce(self, x: int, axes: Sequence[int], mean: bool, keep: bool) -> int:
        """Sum or mean over axes of the item."""
        shape = self.shape(x)
        if not axes:
            return x
        count = int(np.prod([shape[k] for k in axes]))
        reduced_shape = tuple(1 if k in axes else n for k, n in enumerate(shape))
        final = tuple(n for k, n in enumerate(shape) if k not in axes)
        centred = self._centred(x) if mean else -1
        if centred >= 0:
            # programs compute such a norm in one pass, too
            group = np.broadcast_to(np.arange(int(np.prod(reduced_shape))).reshape(reduced_shape), shape)
            index = self._variance(x, centred, reduced_shape, group, count)
        elif mean and len(shape) == 3 and tuple(sorted(axes)) == (1, 2):
            index = self.average_pool(x, shape[1:], _ONES, (0, 0, 0, 0), True)
        else:
            source = self.positions(x)
            to = np.broadcast_to(np.arange(int(np.prod(reduced_shape))).reshape(reduced_shape), shape)
            index = self._sparse(x, reduced_shape, to, source, 1.0 / count if mean else 1.0)
        return index if keep else self.reshape(index, final or (1,))

    def _variance(self, squares: int, x: int, kept: Shape, group: np.ndarray, count: int) -> int:
        """Means of ``squares`` of the centred numbers of ``x`` over groups [size]: one pass is charged (N11)."""
        size = int(np.prod(self.shape(x)))
        layer = Variance(
            (self.shape(squares), self.shape(x)),
            tuple(kept),
            count + 4,
            1,
            torch.from_numpy(group.reshape(-1).copy()),
            torch.from_numpy(np.arange(size)),
            torch.full((size,), 1.0 / count, dtype=torch.float64),
        )
        return self._add(layer, squares, x)

    def _centred(self, squares: int) -> int:
        """The node whose numbers less a mean of them are squared in node ``squares``; -1: none."""
        node = self._node(squares)
        while node is not None and type(node.layer) is LinearLayer:
            node = self._node(node.inputs[0])
        if node is None or not isinstance(node.layer, activations.Power) or node.layer.exponent != 2:
            return -1
        apart = self._node(node.inputs[0])
        if apart is None or not isinstance(apart.layer, Sum) or sorted(apart.layer.signs) != [-1, 1]:
            return -1
        for x, mean in (apart.inputs, apart.inputs[::-1]):
            behind = self._node(self._moved(mean))
            if behind is None or not isinstance(behind.layer, (SparseMatrix, Convolution)):
                continue
            if self._moved(behind.inputs[0]) == self._moved(x):
                return x
        return -1

    def _moved(self, index: int) -> int:
        """The node whose numbers node ``index`` holds in another shape or order, or repeated."""
        while index and (type(self._node(index).layer) is LinearLayer or isinstance(self._node(index).layer, Gather)):
            index = self._node(index).inputs[0]
        return index

    def greatest(self, x: int, axes: Sequence[int], keep: bool, most: bool = True) -> int:
        """Maximum or minimum over axes of the item."""
        shape = self.shape(x)
        rest = [k for k in range(len(shape)) if k not in axes]
        reduced_shape = tuple(shape[k] for k in rest)
        places = self.positions(x).transpose(*rest, *axes).reshape(*reduced_shape, -1)
        parts = [self._gather(x, np.ascontiguousarray(places[..., k]), 0.0) for k in range(places.shape[-1])]
        index = self.extreme(parts, most)
        final = tuple(1 if k in axes else n for k, n in enumerate(shape)) if keep else reduced_shape
        return self.reshape(index, final or (1,))

    def take(self, x: int, indices: np.ndarray, axis: int) -> int:
        """Entries along an axis of the item, in the shape of ``indices``."""
        shape = self.shape(x)
        if indices.size and not (-shape[axis] <= indices.min() and indices.max() < shape[axis]):
            raise InputError(f"indices up to {int(indices.max())} of {shape[axis]} numbers", fix="check the indices")
        self._check_size((*shape[:axis], max(1, indices.size), *shape[axis + 1 :]))
        positions = np.take(self.positions(x), indices, axis)
        if positions.size == 0:
            raise InputError("nothing is taken")
        return (
            self._gather(x, positions, 0.0)
            if positions.ndim
            else self.reshape(self._gather(x, positions[None], 0.0), (1,))
        )

    def part(self, x: int, chosen: Sequence[slice]) -> int:
        """Part of the item; channels of a map are chosen by a convolution, which keeps windows small."""
        shape = self.shape(x)
        channels: Any = np.arange(shape[0])[chosen[0]]
        whole = len(shape) == 3 and all(
            np.array_equal(np.arange(n)[s], np.arange(n)) for n, s in zip(shape[1:], chosen[1:], strict=True)
        )
        if not whole or not len(channels) or len(channels) == shape[0] or shape[1] * shape[2] == 1:
            return self.slice(x, chosen)
        self.reserve(float(len(channels) * shape[0]))
        place = np.zeros((len(channels), shape[0], 1, 1))
        place[np.arange(len(channels)), channels] = 1.0
        return self.convolution(x, place, None, _ONES, _ONES, (0, 0, 0, 0), 1, exact=True)

    def rearranged(self, x: int, index: np.ndarray) -> int:
        """The item's numbers at flat positions ``index``, in its shape."""
        return self._gather(x, index, 0.0)

    def shift(self, x: int, offset: Any) -> int:
        """``x + offset`` with a constant, or nothing at all."""
        return x if offset is None else self.scale(x, np.ones(()), np.asarray(offset, np.float64))

    # ------------------------------------------------------------ sizes of maps

    def rounded_up(self, x: int, kernel: Any, stride: Any, dilation: Any, pads: Any) -> tuple[int, int]:
        """Rows and columns behind the pads that windows take in if their number is rounded up."""
        self.check_window(x, kernel, stride, dilation, pads)
        more = []
        for k, size in enumerate(self.shape(x)[1:]):
            extent = (kernel[k] - 1) * dilation[k] + 1
            free = size + pads[k] + pads[k + 2] - extent
            count = -(-free // stride[k])
            # the last window begins inside
            count -= count * stride[k] >= size + pads[k]
            more.append(max(0, count * stride[k] - free))
        return more[0], more[1]

    def average_windows(self, x: int, kernel: Any, stride: Any, pads: Any, more: Any, count_pads: bool) -> int:
        """Means of windows that may reach past the pads; numbers there never count."""
        if not any(more):
            return self.average_pool(x, kernel, stride, pads, count_pads)
        longer = (*pads[:2], pads[2] + more[0], pads[3] + more[1])
        if not count_pads:
            return self.average_pool(x, kernel, stride, longer, False)
        index = self.average_pool(x, kernel, stride, longer, True)
        parts = []
        for k, size in enumerate(self.shape(x)[1:]):
            start = np.arange(self.shape(index)[1 + k]) * stride[k]
            parts.append(kernel[k] / (np.minimum(start + kernel[k], size + pads[k] + pads[k + 2]) - start))
        return self.scale(index, parts[0][:, None] * parts[1][None, :], None)

    def transposed_convolution(
        self,
        x: int,
        weight: np.ndarray,
        bias: np.ndarray | None,
        stride: Any,
        dilation: Any,
        pads: Any,
        more: Any,
        groups: int,
        exact: bool = False,
    ) -> int:
        """A transposed convolution with weights [Cin, Cout / groups, kh, kw] and pads top, left, bottom, right."""
        shape = self.shape(x)
        if len(shape) != 3 or weight.ndim != 4:
            raise InputError(f"weights {item(weight.shape)} on {item(shape)}", fix="only two dimensions are read")
        if groups < 1 or weight.shape[0] != shape[0] or shape[0] % groups:
            raise InputError(f"weights {item(weight.shape)} with group = {groups} on {shape[0]} channels")
        out = weight.shape[1] * groups
        if bias is not None and bias.shape != (out,):
            raise InputError(f"bias {item(bias.shape)} of {out} channels")
        sizes, taps = [out], 1
        for k in range(2):
            kernel, s, d = weight.shape[2 + k], stride[k], dilation[k]
            if min(s, d, kernel) < 1 or min(pads) < 0 or min(more) < 0 or max(more) > 1 << 20:
                raise InputError(f"strides {list(stride)}, dilations {list(dilation)}, pads {list(pads)}")
            sizes.append((shape[1 + k] - 1) * s + (kernel - 1) * d + 1 - pads[k] - pads[2 + k] + more[k])
            # taps of one place are that many steps of the stride apart
            taps *= -(-kernel // (s // math.gcd(s, d)))
        self._check_size(sizes)
        layer = TransposedConvolution(
            (shape,),
            tuple(sizes),
            0 if exact else shape[0] // groups * taps + 2,
            int(np.prod(weight.shape[1:])),
            as_double(weight),
            None if bias is None else as_double(bias),
            tuple(stride),
            tuple(dilation),
            tuple(pads[:2]),
            groups,
        )
        return self._add(layer, x)

    def resize(self, x: int, axes: Sequence[ResizeAxis]) -> int:
        """Rows and columns mapped by matrices [out, in] each; whole factors of nearest ones by repetition."""
        shape = self.shape(x)
        if len(shape) != 3:
            raise InputError(f"input {item(shape)}", fix="only maps of rows and columns are resized")
        maps = [axis.weight for axis in axes]
        factors = [m.shape[0] // m.shape[1] for m in maps]
        if all(
            f >= 1 and m.shape[0] == f * m.shape[1] and np.array_equal(m, np.repeat(np.eye(m.shape[1]), f, 0))
            for f, m in zip(factors, maps, strict=True)
        ):
            ones = np.ones((shape[0], 1, *factors))
            return self.transposed_convolution(x, ones, None, factors, _ONES, (0,) * 4, (0, 0), shape[0], exact=True)
        (h, i), (w, j) = (np.nonzero(m) for m in maps)
        channels, height, width = shape[0], maps[0].shape[0], maps[1].shape[0]
        self._check_size((channels, height, width))
        self.reserve(3.0 * channels * len(h) * len(w))
        c = np.arange(channels)[:, None, None]
        to = (c * height + h[None, :, None]) * width + w[None, None, :]
        source = (c * shape[1] + i[None, :, None]) * shape[2] + j[None, None, :]
        weight = np.broadcast_to(maps[0][h, i][:, None] * maps[1][w, j][None, :], to.shape).reshape(-1)
        exact = bool((weight == 1.0).all()) and len(h) == height and len(w) == width
        doubts = [axis.doubt for axis in axes]
        if exact or not any(doubt.any() for doubt in doubts):
            # weights of places that are known are exact, but for their products
            return self._sparse(x, (channels, height, width), to, source, weight, 0 if exact else None)
        sides = [as_double(np.stack([np.abs(m), doubt])) for m, doubt in zip(maps, doubts, strict=True)]
        kind = partial(Resize, rows=sides[0], columns=sides[1])
        return self._sparse(x, (channels, height, width), to, source, weight, 32, kind)

    # ------------------------------------------------------------ normalisation and attention

    def normalise(self, x: int, axes: Sequence[int], epsilon: float) -> int:
        """``(x - mean) / sqrt(variance + epsilon)`` over axes of the item (N11)."""
        if not epsilon > LEAST_DIVISOR:
            raise InputError(f"attribute epsilon = {epsilon} is not supported", fix="give at least 1e-30")
        shape = self.shape(x)
        reduced_shape = tuple(1 if k in axes else n for k, n in enumerate(shape))
        group = np.broadcast_to(np.arange(int(np.prod(reduced_shape))).reshape(reduced_shape), shape).reshape(-1)
        count = int(np.prod([shape[k] for k in axes]))
        size = int(np.prod(shape))
        if size * count <= _CENTRED_AT_ONCE:
            self.reserve(3.0 * size * count)
            members = np.argsort(group, kind="stable").reshape(-1, count)
            to = np.broadcast_to(np.arange(size)[:, None], (size, count))
            source = members[group]
            weight = np.where(to == source, 1.0 - 1.0 / count, -1.0 / count)
            centred = self._sparse(x, shape, to, source, weight.reshape(-1), count + 4)
        else:
            mean = self.spread(self._sparse(x, reduced_shape, group, np.arange(size), 1.0 / count), shape)
            centred = self.sum((x, mean), (1, -1))
        squares = self.curve(centred, activations.Power, exponent=2)
        variance = self._variance(squares, x, reduced_shape, group, count)
        root = self.scale(variance, np.ones(()), np.asarray(epsilon))
        inverse = self.curve(root, activations.Root, inverse=True)
        return self.product(centred, self.spread(inverse, shape))

    def softmax(self, x: int, axis: int, logarithm: bool = False, dropped: np.ndarray | None = None) -> int:
        """``1 / sum_j exp(x_j - x_i)`` along an axis of the item, or its logarithm (N11).

        ``dropped``: which numbers of the item a mask takes out; not all of any row.
        """
        shape = self.shape(x)
        count = shape[axis]
        # a program subtracts the greatest first
        layer = PairwiseDifferences((shape,), (*shape, count), count + 4, 2 * count, axis % len(shape))
        apart = self._add(layer, x)
        # sums of exponentials one of which is exp(0)
        least = 1.0 - gamma(2 * count + FOLDING) - ATTENTION - ATTENTION_BLOCKS * count
        if logarithm:
            total = self.reduce(self.curve(apart, activations.Exp), [len(shape)], False, False)
            return self.scale(self.curve(total, activations.Log, floor=least), -np.ones(()), None)
        powers = self.curve(apart, activations.CappedExp, count=count)
        if dropped is not None:
            if bool(dropped.all(axis).any()):
                raise InputError("a mask takes out all numbers of a row", fix="leave one, at least")
            self.reserve(2.0 * count * dropped.size)
            others = np.moveaxis(dropped, axis, -1)[..., None, :].repeat(count, -2)
            # its own term keeps the sum of a number that is taken out away from zero
            powers = self._selected(powers, np.moveaxis(~others | np.eye(count, dtype=bool), -2, axis))
        total = self.reduce(powers, [len(shape)], False, False)
        total = self.curve(total, activations.Clip, least=0.0, most=math.exp(activations.CAP))
        shares = self.curve(total, activations.SoftmaxReciprocal, floor=least)
        return shares if dropped is None else self._selected(shares, ~dropped)

    def _selected(self, x: int, kept: np.ndarray) -> int:
        """The item with zeros where numbers are not kept; nothing is rounded."""
        self.reserve(float(kept.size))
        return self._add(ScaleLayer((kept.shape,), kept.shape, 0, 1, as_double(kept), None), x)

    def matmul(self, a: int, b: int) -> int:
        """A product of matrices that both depend on the image, with leading axes alike."""
        one, two = self.shape(a), self.shape(b)
        if len(one) < 2 or len(two) < 2 or one[-1] != two[-2] or one[:-2] != two[:-2]:
            raise InputError(f"matrices {item(one)} and {item(two)}", fix="leading sizes must agree")
        lead, (n, k), m = one[:-2], one[-2:], two[-1]
        shape = (*lead, n, m, k)
        self._check_size(shape)
        self.reserve(4.0 * float(np.prod(shape)))
        first = np.broadcast_to(np.arange(int(np.prod(one))).reshape(*lead, n, 1, k), shape)
        second = np.broadcast_to(
            np.swapaxes(np.arange(int(np.prod(two))).reshape(two), -1, -2).reshape(*lead, 1, m, k), shape
        )
        index = self.product(self._gather(a, first, 0.0), self._gather(b, second, 0.0))
        return self.reduce(index, [len(shape) - 1], False, False)

    def matrix_from_left(self, weight: np.ndarray, x: int) -> int:
        """``weight x`` along the last axis but one."""
        order = [*range(len(self.shape(x)) - 2), len(self.shape(x)) - 1, len(self.shape(x)) - 2]
        return self.transpose(self.matrix(self.transpose(x, order), weight, None), order)


class ResizeAxis(NamedTuple):
    """The interpolation matrix along one axis, and its error.

    Attributes:
        weight: [out, size].
        doubt: [out, size] what a weight may be off in float32, for positions are computed in it, too.
    """

    weight: np.ndarray
    doubt: np.ndarray


def nearest_pixels(size: int, out: int, coordinates: str, nearest: str, ratio: float) -> np.ndarray:
    """Return [out] the input pixels that onnxruntime picks along one axis; it computes positions in float32.

    Exact places differ from these by up to a pixel where they lie half way or on a number.
    """
    half = np.float32(0.5)
    k, scale = np.arange(out, dtype=np.float32), np.float32(ratio)
    if coordinates == "align_corners":
        place = k * np.float32(size - 1) / np.float32(out - 1) if out > 1 else 0.0 * k
    elif coordinates == "asymmetric":
        place = k / scale
    elif coordinates == "pytorch_half_pixel" and out == 1:
        place = 0.0 * k
    else:
        place = (k + half) / scale - half
    # half way from zero, as C rounds
    rounded = np.trunc(place) + np.sign(place) * (np.abs(place - np.trunc(place)) >= half)
    places = {
        "floor": np.floor(place),
        "ceil": np.ceil(place),
        "round_prefer_floor": np.where(place == np.trunc(place) + half, np.floor(place), rounded),
        "round_prefer_ceil": rounded,
    }
    if nearest not in places:
        raise InputError(f"attribute nearest_mode = {nearest} is not supported", fix="use floor")
    return np.clip(places[nearest], 0, size - 1).astype(np.int64)


def interpolation(
    size: int, out: int, mode: str, coordinates: str, nearest: str, scale: float | None, bend: float = -0.75
) -> ResizeAxis:
    """ONNX's Resize along one axis; ``bend`` is `cubic_coeff_a`."""
    k = np.arange(out, dtype=np.float64)
    ratio = out / size if scale is None else scale
    if coordinates == "align_corners":
        step = (size - 1) / (out - 1) if out > 1 else 0.0
        place = k * step
    elif coordinates == "asymmetric":
        step, place = ratio, k / ratio
    elif coordinates == "pytorch_half_pixel" and out == 1:
        step, place = 0.0, 0.0 * k
    elif coordinates in ("half_pixel", "pytorch_half_pixel"):
        step, place = ratio, (k + 0.5) / ratio - 0.5
    else:
        raise InputError(
            f"attribute coordinate_transformation_mode = {coordinates} is not supported",
            fix="use half_pixel, asymmetric or align_corners",
        )
    matrix, doubt = np.zeros((out, size)), np.zeros((out, size))
    rows = np.arange(out)
    if mode == "nearest":
        matrix[rows, nearest_pixels(size, out, coordinates, nearest, ratio)] = 1.0
        return ResizeAxis(matrix, doubt)
    cubic = mode == "cubic"
    if cubic and not abs(bend) <= 1.0:
        raise InputError(f"attribute cubic_coeff_a = {bend} is not supported", fix="between -1 and 1")
    if not cubic:
        place = np.clip(place, 0.0, size - 1.0)
    low = np.floor(place).astype(np.int64)
    part = place - low
    taps, weights = (0, 1), (1.0 - part, part)
    if cubic:
        far, near, across, beyond = (np.abs(part - tap) for tap in (-1, 0, 1, 2))
        inner = [(bend + 2.0) * t**3 - (bend + 3.0) * t**2 + 1.0 for t in (near, across)]
        outer = [bend * (t**3 - 5.0 * t**2 + 8.0 * t - 4.0) for t in (far, beyond)]
        taps, weights = (-1, 0, 1, 2), (outer[0], *inner, outer[1])
    for tap, weight in zip(taps, weights, strict=True):
        np.add.at(matrix, (rows, np.clip(low + tap, 0, size - 1)), weight)
    # scale, quotient or product of a reciprocal, difference; exact where the scale is a power of two
    moved = np.zeros(out) if np.frexp(step)[0] in (0.0, 0.5) else POSITION * (np.abs(place) + 1.0)
    steepest = 2.0 if cubic else 1.0
    # weights of a known place are exact but for the polynomials'
    own = POLYNOMIAL if cubic else 0.0
    for tap in range(min(taps) - 1, max(taps) + 2):
        # one beside those of a place counts where the place may be past a number
        inside = min(taps) <= tap <= max(taps)
        weighted = inside | (part <= moved if tap < 0 else 1.0 - part <= moved)
        np.add.at(doubt, (rows, np.clip(low + tap, 0, size - 1)), np.where(weighted, steepest * moved + own, 0.0))
    return ResizeAxis(matrix, doubt)
