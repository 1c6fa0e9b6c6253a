"""Layers: their values, their forms forwards, and their coefficients backwards (docs/dev/design.md, N3, N4).

A layer is linear (`LinearLayer` and the classes built on it) or acts on every number by itself (`Activation`). A linear
layer with matrix W computes ``W x + bias``, its magnitude ``|W| x`` (for radii and rounding), and its transpose
``coefficients W`` on windows of rows (`coefficients`). An activation computes its value, and lines that enclose it over
an interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ns_abstract.arithmetic.network_charges import AFFINE, FLUSH, FUNCTION_FLUSHES, OWN_LINE
from ns_abstract.verify.network.coefficients import Coefficients, add_gathered, full, grid, interleave, unflatten

Shape = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class LinearLayer:
    """A linear layer; the base class only changes the shape.

    Attributes:
        input_shapes: One item of every input.
        shape: One item of the output.
        terms: Largest number of roundings of one output in float32 (terms of its sum of products, and of layers that
            may be folded into it); 0 if it is exact.
        row_terms: Terms of the longest sum when a row passes backwards.
    """

    input_shapes: tuple[Shape, ...]
    shape: Shape
    terms: int = 0
    row_terms: int = 0
    #: Whether one output depends on several inputs, so that their radii add up.
    mixes: ClassVar[bool] = False

    @property
    def bias(self) -> Tensor | None:
        """The bias, [*shape] or broadcastable to it; None: zero."""
        return None

    @cached_property
    def gain(self) -> float:
        """Upper bound of a result's magnitude over the largest input's, in any grouping of the factors (N21)."""
        return 1.0

    def roundings(self, active: Sequence[Tensor]) -> Tensor | int:
        """Return `terms` where inputs that are not ``active`` [B, *input_shapes[i]] are exactly zero (N2)."""
        return self.terms

    def apply(self, inputs: Sequence[Tensor]) -> Tensor:
        """Return ``W x`` for inputs [B, *input_shapes[i]]."""
        return inputs[0].reshape(-1, *self.shape)

    def magnitude(self, inputs: Sequence[Tensor]) -> Tensor:
        """Return ``|W| x``."""
        return self.apply(inputs)

    def spare(self, sizes: Sequence[Tensor]) -> Tensor | float:
        """Return float32 errors besides those of sums, for inputs up to ``sizes`` [m, *input_shapes[i]]."""
        return 0.0

    def inexact(self, sizes: Sequence[Tensor]) -> Tensor | float:
        """Return errors of the layer's numbers, which count in real arithmetic, too, for inputs up to ``sizes``."""
        return 0.0

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        """Return coefficients on every input for coefficients on the output; may reuse their memory."""
        return [unflatten(coefficients, self.shape, self.input_shapes[0])]

    def __call__(self, inputs: Sequence[Tensor]) -> Tensor:
        value = self.apply(inputs)
        return value if self.bias is None else value + self.bias.to(value.dtype)


@dataclass(frozen=True, eq=False)
class Weighted(LinearLayer):
    """A layer of sums of products with float64 ``weight`` and ``offset`` (None: no offset)."""

    weight: Tensor = field(default_factory=lambda: torch.zeros(0))
    offset: Tensor | None = None
    mixes: ClassVar[bool] = True

    @cached_property
    def _single(self) -> Tensor:
        return self.weight.float()

    def weight_for(self, coefficients: Tensor) -> Tensor:
        """Return the weights in the coefficients' type."""
        return self._single if coefficients.dtype == torch.float32 else self.weight

    @cached_property
    def gain(self) -> float:
        return max(1, self.terms) * (1.0 + float(self.weight.abs().max()))

    def product(self, x: Tensor, weight: Tensor) -> Tensor:
        """Return sums of products of ``x`` [B, *input_shape] with weights of the layer's shape."""
        raise AssertionError

    def apply(self, inputs: Sequence[Tensor]) -> Tensor:
        return self.product(inputs[0], self.weight)

    def magnitude(self, inputs: Sequence[Tensor]) -> Tensor:
        return self.product(inputs[0], self.weight.abs())

    @property
    def squared(self) -> Weighted:
        """Return the layer with its weights and offset squared, signs kept (N20)."""
        offset = None if self.offset is None else self.offset * self.offset.abs()
        return replace(self, weight=self.weight * self.weight.abs(), offset=offset)


@dataclass(frozen=True, eq=False)
class WindowLayer(Weighted):
    """A layer of windows of rows and columns, with an ``offset`` [Cout] float64 or None."""

    stride: tuple[int, int] = (1, 1)
    dilation: tuple[int, int] = (1, 1)

    @property
    def bias(self) -> Tensor | None:
        return None if self.offset is None else self.offset[:, None, None]


@dataclass(frozen=True, eq=False)
class Convolution(WindowLayer):
    """Two-dimensional convolution with zero padding; average pooling and selections are convolutions, too.

    Attributes:
        weight: [Cout, Cin / groups, kh, kw] float64.
        pads: top, left, bottom, right.
        groups: As in ONNX.
    """

    pads: tuple[int, int, int, int] = (0, 0, 0, 0)
    groups: int = 1

    @cached_property
    def _phases(self) -> dict[torch.dtype, Tensor | None]:
        """`_parts` by the rows' type, made at first use."""
        return {}

    def _parts(self, weight: Tensor) -> Tensor | None:
        """Return weights [s t Cin, Cout, kh', kw'] of the phases of a transposed stride (s, t), or None without stride.

        Row ``s i + a`` of the result is row i of phase a, a convolution with every s-th row of the weights. This runs
        several times as fast as the library's transposed convolution with a stride.
        """
        (s, t), (kh, kw) = self.stride, self.weight.shape[2:]
        if (s, t) == (1, 1) or self.groups > 1 or self.dilation != (1, 1):
            return None
        whole = functional.pad(weight, (0, -kw % t, 0, -kh % s))
        out, into, high, wide = whole.shape
        parts = whole.reshape(out, into, high // s, s, wide // t, t).permute(3, 5, 1, 0, 2, 4)
        return parts.reshape(s * t * into, out, high // s, wide // t).flip(2, 3).contiguous()

    def _phases_for(self, value: Tensor) -> Tensor | None:
        """Return `_parts` of the weights in the type of ``value``, cached."""
        if value.dtype not in self._phases:
            self._phases[value.dtype] = self._parts(self.weight_for(value))
        return self._phases[value.dtype]

    def _joined(self, value: Tensor, phases: Tensor, size: tuple[int, int], corner: tuple[int, int]) -> Tensor:
        """Return the window of ``size`` at ``corner`` of the transposed convolution of rows [R, Cout, h, w]."""
        high, wide = phases.shape[2:]
        result = functional.conv2d(value, phases, padding=(high - 1, wide - 1)).numpy()
        window = np.empty((len(value), self.weight.shape[1], *size), result.dtype)
        interleave(result, *self.stride, *corner, window)
        return torch.from_numpy(window)

    def _transposed(self, value: Tensor) -> Tensor:
        """Return the transposed convolution [R, Cin, (h - 1) s + kh, (w - 1) t + kw] of rows [R, Cout, h, w]."""
        phases = self._phases_for(value)
        if phases is None:
            return functional.conv_transpose2d(
                value, self.weight_for(value), stride=self.stride, groups=self.groups, dilation=self.dilation
            )
        (s, t), (kh, kw) = self.stride, self.weight.shape[2:]
        size = (value.shape[2] - 1) * s + kh, (value.shape[3] - 1) * t + kw
        if kh == kw == 1:
            near = functional.conv2d(value, self.weight_for(value).transpose(0, 1))
            result = torch.zeros((*near.shape[:2], *size), dtype=value.dtype)
            result[:, :, ::s, ::t] = near
            return result
        return self._joined(value, phases, size, (0, 0))

    def roundings(self, active: Sequence[Tensor]) -> Tensor | int:
        out, taps = self.weight.shape[0] // self.groups, self.weight[0].numel()
        number = active[0].float().unflatten(1, (self.groups, -1)).sum(2)
        ones = torch.ones((1, 1, *self.weight.shape[2:])).expand(self.groups, -1, -1, -1)
        count = self.product(number, ones).repeat_interleave(out, 1).double()
        return count + (self.terms - taps)

    def product(self, x: Tensor, weight: Tensor) -> Tensor:
        top, left, bottom, right = self.pads
        padding: tuple[int, int] = (top, left)
        if (top, left) != (bottom, right):
            x, padding = functional.pad(x, (left, right, top, bottom)), (0, 0)
        return functional.conv2d(x, weight.to(x.dtype), None, self.stride, padding, self.dilation, self.groups)

    @cached_property
    def _trims(self) -> bool:
        """Whether a transposed convolution of whole maps only has to be cropped by the first pads on both sides."""
        (top, left, _, _), (kh, kw) = self.pads, self.weight.shape[2:]
        (_, height, width), (_, high, wide) = self.input_shapes[0], self.shape
        spread = high + (kh - 1) * self.dilation[0], wide + (kw - 1) * self.dilation[1]
        return self.stride == (1, 1) and spread == (height + 2 * top, width + 2 * left)

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        value = torch.from_numpy(coefficients.value)
        if coefficients.covers(self.shape):
            # nothing outside of the map is kept
            top, left = self.pads[:2]
            if self._trims:
                weight, groups, dilation = self.weight_for(value), self.groups, self.dilation
                whole = functional.conv_transpose2d(
                    value, weight, padding=(top, left), groups=groups, dilation=dilation
                )
                return [Coefficients.whole(whole.numpy())]
            phases, (_, height, width) = self._phases_for(value), self.input_shapes[0]
            if phases is not None and self.weight[0, 0].numel() > 1 and min(top, left) >= 0:
                return [Coefficients.whole(self._joined(value, phases, (height, width), (top, left)).numpy())]
        value = self._transposed(value).numpy()
        y, x = coefficients.y * self.stride[0] - self.pads[0], coefficients.x * self.stride[1] - self.pads[1]
        return [full(Coefficients(value, y, x), self.input_shapes[0])]


@dataclass(frozen=True, eq=False)
class Matrix(Weighted):
    """A fully connected layer along the last axis; ``weight`` [out, in], ``offset`` [out] or None, float64."""

    @property
    def bias(self) -> Tensor | None:
        return self.offset

    def roundings(self, active: Sequence[Tensor]) -> Tensor | int:
        return active[0].sum(-1, keepdim=True).double() + (self.terms - self.weight.shape[1])

    def product(self, x: Tensor, weight: Tensor) -> Tensor:
        return x @ weight.to(x.dtype).T

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        whole = full(coefficients, self.shape, force=True)
        count = whole.value.shape[0]
        value = torch.from_numpy(whole.value).reshape(count, *self.shape)
        value = value @ self.weight_for(value)
        return [Coefficients.whole(value.numpy().reshape(count, *grid(self.input_shapes[0])))]


@dataclass(frozen=True, eq=False)
class ScaleLayer(LinearLayer):
    """``factor * x + offset`` with constants; both [*shape] float64 (batch normalisation, Mul, Add, ...).

    ``parts``: if factor and offset are made of other constants, the product of 1 + |f| over the largest of these.
    """

    factor: Tensor = field(default_factory=lambda: torch.zeros(0))
    offset: Tensor | None = None
    parts: float = 0.0

    @cached_property
    def gain(self) -> float:
        return max(self.parts, 1.0 + float(self.factor.abs().max()))

    @property
    def bias(self) -> Tensor | None:
        return self.offset

    def apply(self, inputs: Sequence[Tensor]) -> Tensor:
        return inputs[0] * self.factor.to(inputs[0].dtype)

    def magnitude(self, inputs: Sequence[Tensor]) -> Tensor:
        return inputs[0] * self.factor.abs().to(inputs[0].dtype)

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        factor = self.factor.expand(self.shape).reshape(grid(self.shape)).numpy()
        coefficients.scale(factor.astype(coefficients.value.dtype))
        return [coefficients]


@dataclass(frozen=True, eq=False)
class Sum(LinearLayer):
    """``sum_i signs[i] x_i``, signs 1 or -1."""

    signs: tuple[int, ...] = (1, 1)
    mixes: ClassVar[bool] = True

    def apply(self, inputs: Sequence[Tensor]) -> Tensor:
        total = inputs[0] if self.signs[0] > 0 else -inputs[0]
        for value, sign in zip(inputs[1:], self.signs[1:], strict=True):
            total = total + value if sign > 0 else total - value
        return total

    def magnitude(self, inputs: Sequence[Tensor]) -> Tensor:
        total = inputs[0]
        for value in inputs[1:]:
            total = total + value
        return total

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        # rows are changed in place further on, so every input gets its own
        value = coefficients.value
        copies = [coefficients.replaced(value * value.dtype.type(sign)) for sign in self.signs[1:]]
        if self.signs[0] < 0:
            np.negative(value, out=value)
        return [coefficients, *copies]


@dataclass(frozen=True, eq=False)
class Pad(LinearLayer):
    """Constant padding: ``pads`` top, left, bottom, right (negative ones crop), and its ``value``."""

    pads: tuple[int, int, int, int] = (0, 0, 0, 0)
    value: float = 0.0

    @property
    def bias(self) -> Tensor | None:
        if self.value == 0.0:
            return None
        inside = self.apply([torch.ones((1, *self.input_shapes[0]), dtype=torch.float64)])[0]
        return self.value * (1.0 - inside)

    def apply(self, inputs: Sequence[Tensor]) -> Tensor:
        top, left, bottom, right = self.pads
        return functional.pad(inputs[0], (left, right, top, bottom))

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        top, left = self.pads[:2]
        padded = Coefficients(coefficients.value, coefficients.y - top, coefficients.x - left)
        return [full(padded, self.input_shapes[0])]


@dataclass(frozen=True, eq=False)
class ChannelEmbedding(LinearLayer):
    """Places the input's channels, from number ``first`` on, among channels of zeros."""

    first: int = 0

    def apply(self, inputs: Sequence[Tensor]) -> Tensor:
        after = self.shape[0] - self.input_shapes[0][0] - self.first
        return functional.pad(inputs[0], (0, 0, 0, 0, self.first, after))

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        part = coefficients.value[:, self.first : self.first + self.input_shapes[0][0]]
        return [coefficients.replaced(np.ascontiguousarray(part))]


@dataclass(frozen=True, eq=False)
class Gather(LinearLayer):
    """Gathers numbers of the input by flat positions ``index`` [prod(shape)]; -1 stands for the constant ``fill``."""

    index: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))
    fill: float = 0.0

    @property
    def bias(self) -> Tensor | None:
        if self.fill == 0.0 or not bool((self.index < 0).any()):
            return None
        return (self.fill * (self.index < 0).double()).reshape(self.shape)

    def apply(self, inputs: Sequence[Tensor]) -> Tensor:
        chosen = inputs[0].flatten(1)[:, self.index.clamp(min=0)]
        return (chosen * (self.index >= 0).to(chosen.dtype)).reshape(-1, *self.shape)

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        count, (_, height, width), before = len(coefficients.value), grid(self.shape), grid(self.input_shapes[0])
        value = np.zeros((count, int(np.prod(before))), coefficients.value.dtype)
        add_gathered(coefficients.value, coefficients.y, coefficients.x, height, width, self.index.numpy(), value)
        return [Coefficients.whole(value.reshape(count, *before))]


class LinearRelaxation(NamedTuple):
    """Lower and upper lines ``slope * z + offset`` of an activation over an interval, float64, shaped as z."""

    lower_slope: Tensor
    lower_offset: Tensor
    upper_slope: Tensor
    upper_offset: Tensor


@dataclass(frozen=True, eq=False)
class Activation:
    """An elementwise activation; ``shape`` is that of one item."""

    shape: Shape

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        """Return the largest float32 error of the function over [lower, upper]."""
        return 0.0

    def missing(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        """Return the largest distance of the network's value, also in real numbers, from `function`."""
        return 0.0

    def range(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """Return the least and greatest value; a monotone function's are at the ends."""
        return self.function(lower), self.function(upper)

    def function(self, z: Tensor) -> Tensor:
        """Return the value."""
        raise AssertionError

    def unstable(self, lower: Tensor, upper: Tensor) -> Tensor:
        """Return where tighter bounds of the input would give tighter lines."""
        raise AssertionError

    def relaxation_gap(self, lower: Tensor, upper: Tensor) -> Tensor | None:
        """Return the distance of the lines of N3 as a fraction of the interval; None: `unstable` says all."""
        return None

    def lines(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        """Return a lower and an upper line over [lower, upper], each optimal by itself (N4)."""
        raise AssertionError

    def band(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        """Return two parallel lines (N3); both slopes are the same tensor."""
        raise AssertionError

    def offsets(self, slope: Tensor, lower: Tensor, upper: Tensor, band: LinearRelaxation) -> tuple[Tensor, Tensor]:
        """Return bounds of the function less ``slope * z`` over [lower, upper], without rounding.

        They are derived from ``band``, two parallel lines.
        """
        apart = band.lower_slope - slope
        ends = apart * lower, apart * upper
        return torch.minimum(*ends) + band.lower_offset, torch.maximum(*ends) + band.upper_offset

    def __call__(self, inputs: Sequence[Tensor]) -> Tensor:
        return self.function(inputs[0])


@dataclass(frozen=True, eq=False)
class LeakyRelu(Activation):
    """``max(z, alpha z)`` with 0 <= alpha <= 1; ReLU for alpha = 0."""

    alpha: float = 0.0

    def function(self, z: Tensor) -> Tensor:
        return torch.relu(z) if self.alpha == 0.0 else torch.where(z >= 0.0, z, z * self.alpha)

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # numbers that are flushed to zero are small and, but for a slope, positive
        if not self.alpha:
            return FUNCTION_FLUSHES * FLUSH * ((upper > 0.0) & (lower < FLUSH)).double()
        size = torch.maximum(lower.abs(), upper.abs())
        return AFFINE * self.alpha * size + FUNCTION_FLUSHES * FLUSH * (1.0 + size)

    def unstable(self, lower: Tensor, upper: Tensor) -> Tensor:
        return (lower < 0.0) & (upper > 0.0)

    def offsets(self, slope: Tensor, lower: Tensor, upper: Tensor, band: LinearRelaxation) -> tuple[Tensor, Tensor]:
        # convex: most at an end, least there or at the kink
        ends = [torch.where(z >= 0.0, (1.0 - slope) * z, (self.alpha - slope) * z) for z in (lower, upper)]
        least = torch.minimum(*ends)
        return torch.where(self.unstable(lower, upper), least.clamp(max=0.0), least), torch.maximum(*ends)

    def _chord(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """Return slope and offset of an upper line: the chord where unstable, the function itself elsewhere."""
        ends = self.function(lower), self.function(upper)
        slope = (ends[1] - ends[0]) / (upper - lower)
        low, high = torch.full_like(lower, self.alpha), torch.ones_like(lower)
        slope = torch.where(upper <= 0.0, low, torch.where(lower >= 0.0, high, slope.clamp(self.alpha, 1.0)))
        # convex: above both ends is above everywhere between
        offset = torch.maximum(ends[0] - slope * lower, ends[1] - slope * upper)
        size = slope * torch.maximum(lower.abs(), upper.abs())
        return slope, torch.where(self.unstable(lower, upper), offset + OWN_LINE * size, torch.zeros_like(offset))

    def lines(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        slope, offset = self._chord(lower, upper)
        # any line alpha..1 through the origin is below; the larger area is cut off by the steeper half
        below = torch.where(upper > -lower, torch.ones_like(lower), torch.full_like(lower, self.alpha))
        below = torch.where(self.unstable(lower, upper), below, slope)
        return LinearRelaxation(below, torch.zeros_like(offset), slope, offset)

    def band(self, lower: Tensor, upper: Tensor) -> LinearRelaxation:
        slope, offset = self._chord(lower, upper)
        return LinearRelaxation(slope, torch.zeros_like(offset), slope, offset)
