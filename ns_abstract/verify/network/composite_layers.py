"""Builds operators that consist of several basic layers (docs/dev/design.md, N11, N19)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from ns_abstract.arithmetic.network_charges import ATTENTION, ATTENTION_BLOCKS, FOLDING, LEAST_DIVISOR, gamma
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import activations, composite_activations
from ns_abstract.verify.network.elementwise_layers import ElementwiseBuilder
from ns_abstract.verify.network.graph import as_double, item
from ns_abstract.verify.network.interpolation import ResizeAxis
from ns_abstract.verify.network.layers import Convolution, Gather, LinearLayer, ScaleLayer, Shape, Sum
from ns_abstract.verify.network.sparse_layers import (
    ChannelWindows,
    PairwiseDifferences,
    Resize,
    SparseMatrix,
    TransposedConvolution,
    Variance,
)

_ONES = (1, 1)
#: Entries of a matrix that takes means away; where it would have more, the mean is a layer of its own.
_CENTRED_AT_ONCE = 1 << 16


class CompositeBuilder(ElementwiseBuilder):
    """Builds operators such as softmax, normalisation and resizing from basic layers."""

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
        """Add a sparse matrix with entries ``weight`` from positions ``source`` to ``to``; weights broadcast."""
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
        """Return the item's flat positions, ``copies`` times."""
        size = int(np.prod(self.shape(x)))
        self.reserve(3.0 * size * copies)
        return np.arange(size).reshape(self.shape(x))

    def reduce(self, x: int, axes: Sequence[int], mean: bool, keep: bool) -> int:
        """Add a sum or mean over axes of the item."""
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

    def _variance(self, squares: int, x: int, kept_shape: Shape, group: np.ndarray, count: int) -> int:
        """Add means of ``squares`` of the centred ``x`` over groups [size], charged for variances of one pass (N11)."""
        size = int(np.prod(self.shape(x)))
        layer = Variance(
            (self.shape(squares), self.shape(x)),
            tuple(kept_shape),
            count + 4,
            1,
            torch.from_numpy(group.reshape(-1).copy()),
            torch.from_numpy(np.arange(size)),
            torch.full((size,), 1.0 / count, dtype=torch.float64),
        )
        return self._add(layer, squares, x)

    def _centred(self, squares: int) -> int:
        """Return the node x if node ``squares`` holds squares of x less a mean of x; else -1."""
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
        """Return the node of which node ``index`` is a reshaped, permuted or repeated copy."""
        while index and (type(self._node(index).layer) is LinearLayer or isinstance(self._node(index).layer, Gather)):
            index = self._node(index).inputs[0]
        return index

    def local_response(self, x: int, size: int, alpha: float, beta: float, bias: float) -> int:
        """Add ``x / (bias + alpha / size * sum of squares)^beta``; sums are over ``size`` channels (N11)."""
        shape = self.shape(x)
        channels, before = shape[0], (size - 1) // 2
        place = self.positions(x, min(size, channels))
        to, source = [], []
        for step in range(max(-before, 1 - channels), min(size - before, channels)):
            to.append(place[max(0, -step) : channels - max(0, step)].reshape(-1))
            source.append(place[max(0, step) : channels + min(0, step)].reshape(-1))
        offset = torch.full(shape, bias, dtype=torch.float64)
        kind = partial(ChannelWindows, offset=offset, before=before)
        # additions and subtractions of all channels, products, the weight's own
        terms = 2 * channels + size + 4
        squares = self.curve(x, activations.Power, exponent=2)
        sums = self._sparse(squares, shape, np.concatenate(to), np.concatenate(source), alpha / size, terms, kind)
        return self.product(x, self.power(sums, -beta))

    def greatest(self, x: int, axes: Sequence[int], keep: bool, most: bool = True) -> int:
        """Add a maximum, or with ``most`` False a minimum, over axes of the item."""
        shape = self.shape(x)
        rest = [k for k in range(len(shape)) if k not in axes]
        reduced_shape = tuple(shape[k] for k in rest)
        places = self.positions(x).transpose(*rest, *axes).reshape(*reduced_shape, -1)
        parts = [self.gather(x, np.ascontiguousarray(places[..., k])) for k in range(places.shape[-1])]
        index = self.extreme(parts, most)
        final = tuple(1 if k in axes else n for k, n in enumerate(shape)) if keep else reduced_shape
        return self.reshape(index, final or (1,))

    def part(self, x: int, chosen: Sequence[slice]) -> int:
        """Add a slice of the item; channels are selected by a convolution, which keeps windows of rows small."""
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

    def shift(self, x: int, offset: Any) -> int:
        """Add ``x + offset`` with a constant, unless the offset is zero."""
        return x if offset is None else self.scale(x, np.ones(()), np.asarray(offset, np.float64))

    # ------------------------------------------------------------ sizes of maps

    def rounded_up(self, x: int, kernel: Any, stride: Any, dilation: Any, pads: Any) -> tuple[int, int]:
        """Return the rows and columns behind the pads that windows cover if their number is rounded up (ceil_mode)."""
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
        """Add average pooling whose windows may reach past the pads by ``more``; numbers there never count."""
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
        output_padding: Any,
        groups: int,
        exact: bool = False,
    ) -> int:
        """Add a transposed convolution with weights [Cin, Cout / groups, kh, kw] and pads top, left, bottom, right."""
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
            if min(s, d, kernel) < 1 or min(pads) < 0 or min(output_padding) < 0 or max(output_padding) > 1 << 20:
                raise InputError(f"strides {list(stride)}, dilations {list(dilation)}, pads {list(pads)}")
            sizes.append((shape[1 + k] - 1) * s + (kernel - 1) * d + 1 - pads[k] - pads[2 + k] + output_padding[k])
            # taps of one place are that many steps of the stride apart
            taps *= -(-kernel // (s // math.gcd(s, d)))
        self._check_size(sizes)
        layer = TransposedConvolution(
            (shape,),
            tuple(sizes),
            terms=0 if exact else shape[0] // groups * taps + 2,
            row_terms=int(np.prod(weight.shape[1:])),
            weight=as_double(weight),
            offset=None if bias is None else as_double(bias),
            stride=tuple(stride),
            dilation=tuple(dilation),
            pads=tuple(pads[:2]),
            groups=groups,
        )
        return self._add(layer, x)

    def resize(self, x: int, axes: Sequence[ResizeAxis]) -> int:
        """Add a resizing of rows and columns by matrices [out, in]; whole factors of "nearest" are repetitions."""
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
        """Add ``(x - mean) / sqrt(variance + epsilon)`` over axes of the item (N11)."""
        if not epsilon > LEAST_DIVISOR:
            raise InputError(f"attribute epsilon = {epsilon} is not supported", fix="give at least 1e-30")
        shape = self.shape(x)
        reduced_shape = tuple(1 if k in axes else n for k, n in enumerate(shape))
        group = np.broadcast_to(np.arange(int(np.prod(reduced_shape))).reshape(reduced_shape), shape).reshape(-1)
        count = int(np.prod([shape[k] for k in axes]))
        size = int(np.prod(shape))
        # what a number loses where it is taken from itself is no product of a matrix
        if count > 1 and size * count <= _CENTRED_AT_ONCE:
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
        """Add ``1 / sum_j exp(x_j - x_i)`` along an axis of the item, or its logarithm (N11).

        ``dropped``: the item's numbers that a mask removes; not all of any row.
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
        powers = self.curve(apart, composite_activations.CappedExp, count=count)
        if dropped is not None:
            if bool(dropped.all(axis).any()):
                raise InputError("a mask takes out all numbers of a row", fix="leave one, at least")
            self.reserve(2.0 * count * dropped.size)
            others = np.moveaxis(dropped, axis, -1)[..., None, :].repeat(count, -2)
            # its own term keeps the sum of a number that is taken out away from zero
            powers = self._selected(powers, np.moveaxis(~others | np.eye(count, dtype=bool), -2, axis))
        total = self.reduce(powers, [len(shape)], False, False)
        total = self.curve(total, activations.Clip, least=0.0, most=math.exp(composite_activations.CAP))
        shares = self.curve(total, composite_activations.SoftmaxReciprocal, floor=least)
        return shares if dropped is None else self._selected(shares, ~dropped)

    def _selected(self, x: int, mask: np.ndarray) -> int:
        """Add the item with zeros where ``mask`` [shape] is 0; nothing is rounded."""
        self.reserve(float(mask.size))
        return self._add(ScaleLayer((mask.shape,), mask.shape, 0, 1, as_double(mask), None), x)

    def matmul(self, a: int, b: int) -> int:
        """Add a product of matrices that both depend on the image, with equal leading axes."""
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
        index = self.product(self.gather(a, first), self.gather(b, second))
        return self.reduce(index, [len(shape) - 1], False, False)

    def matrix_from_left(self, weight: np.ndarray, x: int) -> int:
        """Add ``weight x`` along the last axis but one."""
        order = [*range(len(self.shape(x)) - 2), len(self.shape(x)) - 1, len(self.shape(x)) - 2]
        return self.transpose(self.matrix(self.transpose(x, order), weight, None), order)
