"""Builds layers that act on each number alone, and recognises those that a file spells out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ns_abstract.arithmetic.network_charges import FOLDING, LEAST_DIVISOR, NEAR, OVERFLOW, gamma
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import activations
from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.build import NetworkBuilder
from ns_abstract.verify.network.composite_activations import GatedClip, ScaledGelu, SwitchedSoftplus
from ns_abstract.verify.network.graph import item
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
from ns_abstract.verify.network.scalar_function import ScalarFunction
from ns_abstract.verify.network.sparse_layers import SparseMatrix, Variance

#: A preference: constants of a gate this close to a known function's, relative to them, are bounded as a curve.
_ALIKE = 2.0**-10

#: A preference: limits of one side up to this are those of a ReLU, whose slopes are chosen (N14).
_NEAR_ZERO = 2.0**16


class ElementwiseBuilder(NetworkBuilder):
    """Builds functions of one number, and sums and products of two values that depend on the image."""

    # ------------------------------------------------------------ what is known of nodes

    def _node(self, index: int) -> Any:
        return self.nodes[index - 1] if index else None

    def _affine(self, index: int) -> tuple[int, float, float]:
        """Return (root, factor, offset) if node ``index`` is ``factor * root + offset`` with single numbers."""
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
        """Return a lower bound of node ``index`` that follows from its operators, rounding included."""
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
        """Return a lower bound of a computed sum of non-negative numbers, after ``terms`` roundings and folding."""
        return value * (1.0 - gamma(terms + FOLDING)) if positive and value >= 0.0 else -math.inf

    # ------------------------------------------------------------ functions of one number

    def curve(self, x: int, make: Callable[..., ScalarFunction], **settings: Any) -> int:
        """Add a layer of `ns_abstract.verify.network.activations`."""
        return self._add(make(self.shape(x), **settings), x)

    def doubt(self, index: int, weight: ConstantIntervals | None, offset: ConstantIntervals | None) -> int:
        """Replace the last layer by one whose constants are intervals (N23)."""
        if weight is None and offset is None:
            return index
        node = self.nodes[index - 1]
        assert isinstance(node.layer, LinearLayer)
        self.nodes[index - 1] = replace(node, layer=with_inexact_constants(node.layer, weight, offset))
        return index

    def clip(self, x: int, least: float, most: float) -> int:
        """Add ``min(max(x, least), most)``; limits may be infinite."""
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
        """Add ``max(x, 0) + slope min(x, 0)`` as ``slope x + (1 - slope) relu(x)``."""
        slope = np.asarray(slope, np.float64)
        if slope.size == 1 and 0.0 <= float(slope.reshape(-1)[0]) <= 1.0:
            return self.leaky_relu(x, float(slope.reshape(-1)[0]))
        straight = self.scale(x, slope, None)
        return self.sum((straight, self.scale(self.leaky_relu(x, 0.0), 1.0 - slope, None)), (1, 1))

    def power(self, x: int, exponent: float) -> int:
        """Add ``x^exponent``; unless it is a whole number from 2 on, ``x`` must be positive (not 0 for -1)."""
        if exponent == 1.0:
            return x
        if exponent == int(exponent) and 2.0 <= exponent <= 8.0:
            return self.curve(x, activations.Power, exponent=int(exponent))
        if exponent in (0.5, -0.5):
            return self.curve(x, activations.Root, floor=self._above(x), inverse=exponent < 0.0)
        if exponent == -1.0:
            return self.reciprocal(x)
        if not 0.0 < abs(exponent) <= 8.0:
            raise InputError(f"exponent {exponent} is not supported", fix="use one from -8 to 8 other than 0")
        return self.curve(x, activations.PositivePower, exponent=exponent)

    def _above(self, x: int) -> float:
        floor = self.floor(x)
        # a smaller one may be flushed to zero
        return floor if floor > LEAST_DIVISOR else -math.inf

    def reciprocal(self, x: int) -> int:
        """Add ``1 / x``; 1 / sqrt becomes one function."""
        node = self._node(x)
        if node is not None and isinstance(node.layer, activations.Root) and not node.layer.inverse:
            return self.curve(node.inputs[0], activations.Root, floor=node.layer.floor, inverse=True)
        return self.curve(x, activations.Reciprocal, floor=self._above(x))

    def softsign(self, x: int) -> int:
        """Add ``x / (1 + |x|)``."""
        size = self.scale(self.curve(x, activations.Abs), np.ones(()), np.ones(()))
        return self.product(x, self.reciprocal(size))

    def logarithm(self, x: int) -> int:
        """Add the natural logarithm."""
        return self.curve(x, activations.Log, floor=self._above(x))

    def switched_softplus(self, compared: int, limit: float, straight: int, curved: int) -> int:
        """Add ``straight`` where ``compared`` is above the limit, else the softplus ``curved``; 0 if it is none."""
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
        """Add the item ``x``, broadcast to ``shape`` along axes of length 1, and return its node."""
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
        return self.gather(x, index)

    def common(self, *inputs: int) -> tuple[int, ...]:
        """Return the inputs broadcast to one shape."""
        try:
            shape = np.broadcast_shapes(*[(1, *self.shape(k)) for k in inputs])
        except ValueError:
            raise InputError(f"shapes {[item(self.shape(k)) for k in inputs]} do not fit") from None
        if shape[0] != 1:
            raise InputError(f"shapes {[item(self.shape(k)) for k in inputs]} mix the batch", fix="unsqueeze before")
        return tuple(self.spread(k, shape[1:]) for k in inputs)

    def product(self, a: int, b: int) -> int:
        """Add ``a b``; a value times a known function of itself becomes one function (N10)."""
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
        """Add ``value * gate`` as one activation (such as SiLU) and return its node; 0 if it is no known one."""
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
        """Add the maximum or minimum of several values."""
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
