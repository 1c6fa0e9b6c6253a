"""Sparse matrices, pairwise differences and transposed convolutions as layers (docs/dev/design.md, N11, N19)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ns_abstract.arithmetic.network_charges import (
    FLUSH,
    FLUSHES,
    FOLDING,
    MAGNITUDES_UP,
    OWN_LINE,
    OWN_POSITIONS,
    UP,
    VARIANCE_PASSES,
    gamma,
)
from ns_abstract.verify.network.coefficients import Coefficients, full, grid
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.layers import LinearLayer, WindowLayer


def _none() -> Tensor:
    return torch.zeros(0)


@dataclass(frozen=True, eq=False)
class SparseMatrix(LinearLayer):
    """A sparse matrix applied to the flattened item: weights [E] float64 from ``source`` [E] to ``to`` [E]."""

    to: Tensor = field(default_factory=_none)
    source: Tensor = field(default_factory=_none)
    weight: Tensor = field(default_factory=_none)
    offset: Tensor | None = None
    mixes: ClassVar[bool] = True

    @property
    def bias(self) -> Tensor | None:
        return self.offset

    @cached_property
    def gain(self) -> float:
        return max(1, self.terms) * (1.0 + float(self.weight.abs().max()))

    @cached_property
    def _sizes(self) -> tuple[int, int]:
        return int(np.prod(self.shape)), int(np.prod(self.input_shapes[0]))

    def _stored(self, places: Tensor, values: Tensor) -> Tensor:
        return torch.sparse_coo_tensor(places, values, self._sizes, check_invariants=True).coalesce()

    @cached_property
    def _matrix(self) -> Tensor:
        return self._stored(torch.stack([self.to, self.source]), self.weight)

    @cached_property
    def _single(self) -> Tensor:
        """The weights [in, out] in float32, for rows."""
        return self._matrix.t().float().coalesce()

    def weight_for(self, coefficients: Tensor) -> Tensor:
        """Return the weights [in, out] in the coefficients' type."""
        return self._single if coefficients.dtype == torch.float32 else self._matrix.t()

    def _rows(self, value: Tensor) -> Tensor:
        """Return rows [R, in] for ``value`` [R, out]."""
        return torch.sparse.mm(self.weight_for(value), value.T).T

    @cached_property
    def _absolute(self) -> Tensor:
        matrix = self._matrix
        return self._stored(matrix.indices(), matrix.values().abs())

    def apply(self, inputs: Sequence[Tensor]) -> Tensor:
        return torch.sparse.mm(self._matrix.to(inputs[0].dtype), inputs[0].flatten(1).T).T.reshape(-1, *self.shape)

    def magnitude(self, inputs: Sequence[Tensor]) -> Tensor:
        return torch.sparse.mm(self._absolute.to(inputs[0].dtype), inputs[0].flatten(1).T).T.reshape(-1, *self.shape)

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        whole = full(coefficients, self.shape, force=True)
        count = whole.value.shape[0]
        value = self._rows(torch.from_numpy(whole.value).reshape(count, -1))
        return [Coefficients.whole(value.contiguous().numpy().reshape(count, *grid(self.input_shapes[0])))]


@dataclass(frozen=True, eq=False)
class Variance(SparseMatrix):
    """The variance: means of the squared centred numbers (first input) of the numbers in the second input.

    A program may compute the variance as mean of squares minus square of the mean: the error is then relative to the
    numbers, not to their spread (N11).
    """

    def spare(self, sizes: Sequence[Tensor]) -> Tensor | float:
        return gamma(VARIANCE_PASSES * self.terms) * self._means(sizes[1].square()) * UP + FLUSHES * FLUSH

    def least(self, squares: NodeForm, x: NodeForm, in_float32: bool) -> Tensor:
        """Return a lower bound [m, *shape] of the variance, with its rounding if ``in_float32``, without flushes (N11).

        Squares are not negative, and one pass loses a fraction of the variance itself and of the square of the mean.
        """
        low = self._means(squares.interval.lower.clamp(min=0.0)) * (2.0 - MAGNITUDES_UP)
        if not in_float32:
            return low
        reach = self._means(x.reference + x.c).abs() + self._means(x.r)
        reach = reach + self._means(x.a.flatten(0, 1)).unflatten(0, x.a.shape[:2]).abs().sum(1)
        ends = torch.maximum(*(self._means(end).abs() for end in x.interval))
        reach = torch.minimum(reach, ends) * MAGNITUDES_UP + OWN_LINE * self._means(x.interval.size)
        relative = gamma((1 + VARIANCE_PASSES) * self.terms + FOLDING)
        return low * (1.0 - relative) - gamma(VARIANCE_PASSES * self.terms) * reach.square() * UP

    def _means(self, value: Tensor) -> Tensor:
        return torch.sparse.mm(self._absolute, value.flatten(1).T).T.reshape(-1, *self.shape)

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        both = super().backward(coefficients)
        shape = (both[0].value.shape[0], *grid(self.input_shapes[1]))
        return [*both, Coefficients.whole(np.zeros(shape, coefficients.value.dtype))]


@dataclass(frozen=True, eq=False)
class ChannelWindows(SparseMatrix):
    """Weighted sums over windows of neighbouring channels, ``before`` of them before the middle, and an offset.

    A program may go from channel to channel, adding the one that enters the window and subtracting the one that leaves
    it: the error is then relative to all channels that have left, too (N11).
    """

    before: int = 0

    def spare(self, sizes: Sequence[Tensor]) -> Tensor | float:
        left = torch.zeros_like(sizes[0])
        passed = sizes[0].cumsum(1)[:, : max(0, sizes[0].shape[1] - self.before - 1)]
        left[:, self.before + 1 :] = passed
        weight = float(self.weight.abs().max())
        return gamma(self.terms) * 2.0 * weight * left * UP + self.terms * FLUSHES * FLUSH * (1.0 + weight)


@dataclass(frozen=True, eq=False)
class Resize(SparseMatrix):
    """A resized map: rows and columns are interpolated; programs compute their positions in float32.

    ``rows``, ``columns`` [2, out, in]: magnitudes of the weights along an axis, and bounds of their errors.
    """

    rows: Tensor = field(default_factory=_none)
    columns: Tensor = field(default_factory=_none)

    def spare(self, sizes: Sequence[Tensor]) -> Tensor | float:
        (own, off), (across, apart) = self.rows, self.columns
        return off @ sizes[0] @ (across + apart).T + own @ sizes[0] @ apart.T

    def inexact(self, sizes: Sequence[Tensor]) -> Tensor | float:
        # places and polynomials are rounded by float64 in the same way
        return OWN_POSITIONS * self.spare(sizes)


@dataclass(frozen=True, eq=False)
class PairwiseDifferences(LinearLayer):
    """``x_j - x_i`` for all i and j along an axis of the item; j is a new last axis. For i = j it is zero."""

    axis: int = 0
    mixes: ClassVar[bool] = True

    @cached_property
    def gain(self) -> float:
        return 2.0 * max(1, self.terms)

    @cached_property
    def _apart(self) -> Tensor:
        """[*shape] 0 where i = j, else 1; a view of few numbers."""
        ones = [1] * len(self.input_shapes[0])
        count = ones[self.axis] = self.shape[-1]
        return (1.0 - torch.eye(count, dtype=torch.float64)).reshape(*ones, count)

    def _others(self, x: Tensor) -> Tensor:
        """Return x_j at all (i, j)."""
        last = x.movedim(self.axis + 1, -1)
        return last[..., None, :].expand(*last.shape, last.shape[-1]).movedim(-2, self.axis + 1)

    def apply(self, inputs: Sequence[Tensor]) -> Tensor:
        return self._others(inputs[0]) - inputs[0][..., None]

    def magnitude(self, inputs: Sequence[Tensor]) -> Tensor:
        return (self._others(inputs[0]) + inputs[0][..., None]) * self._apart.to(inputs[0].dtype)

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        whole = full(coefficients, self.shape, force=True)
        count = whole.value.shape[0]
        value = torch.from_numpy(whole.value).reshape(count, *self.shape)
        value = value * self._apart.to(value.dtype)
        result = value.sum(self.axis + 1).movedim(-1, self.axis + 1) - value.sum(-1)
        return [Coefficients.whole(result.contiguous().numpy().reshape(count, *grid(self.input_shapes[0])))]


@dataclass(frozen=True, eq=False)
class TransposedConvolution(WindowLayer):
    """Two-dimensional transposed convolution with weights [Cin, Cout / groups, kh, kw]; pads top, left are cropped."""

    pads: tuple[int, int] = (0, 0)
    groups: int = 1

    def product(self, x: Tensor, weight: Tensor) -> Tensor:
        whole = functional.conv_transpose2d(
            x, weight.to(x.dtype), None, self.stride, groups=self.groups, dilation=self.dilation
        )
        top, left = self.pads
        height, width = self.shape[1:]
        missing = max(0, top + height - whole.shape[2]), max(0, left + width - whole.shape[3])
        if any(missing):
            whole = functional.pad(whole, (0, missing[1], 0, missing[0]))
        return whole[:, :, top : top + height, left : left + width]

    def backward(self, coefficients: Coefficients) -> list[Coefficients]:
        value = torch.from_numpy(full(coefficients, self.shape, force=True).value)
        _, height, width = self.input_shapes[0]
        need = [
            (n - 1) * s + (k - 1) * d + 1
            for n, s, k, d in zip((height, width), self.stride, self.weight.shape[2:], self.dilation, strict=True)
        ]
        top, left = self.pads
        bottom, right = need[0] - top - value.shape[2], need[1] - left - value.shape[3]
        # negative pads cut what no input reaches
        value = functional.pad(value, (left, right, top, bottom))
        result = functional.conv2d(value, self.weight_for(value), None, self.stride, 0, self.dilation, self.groups)
        return [Coefficients.whole(result.numpy())]
