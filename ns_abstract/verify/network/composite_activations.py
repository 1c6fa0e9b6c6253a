"""Activations inside composites: parts of a softmax, and functions with constants of the file.

A file's 0.70710677 is not ``1 / sqrt(2)``. In exact arithmetic the difference may decide a verdict, so these functions
take the file's numbers (docs/dev/design.md, N24).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import ATTENTION, ATTENTION_BLOCKS, LOST_SHARE, OWN_QUOTIENTS, STEPS, SWITCH
from ns_abstract.verify.network.activations import FLUSHED, Clip, Exp, Gelu, HardSwish, Reciprocal, Softplus
from ns_abstract.verify.network.scalar_function import _size


@dataclass(frozen=True, eq=False)
class ScaledGelu(Gelu):
    """``z (1 + erf(rate z / sqrt(2))) / 2``: GELU of ``rate z``, divided by ``rate``."""

    rate: float = 1.0

    @property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        return tuple(point / self.rate for point in Gelu.breaks)

    def function(self, z: Tensor) -> Tensor:
        return super().function(self.rate * z) / self.rate

    def slope(self, z: Tensor) -> Tensor:
        return super().slope(self.rate * z)

    def missing(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return OWN_QUOTIENTS * _size(lower, upper)


@dataclass(frozen=True, eq=False)
class GatedClip(HardSwish):
    """``z min(max(factor z + offset, 0), 1)``."""

    factor: float = 1.0 / 6.0
    offset: float = 0.5

    @property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        return -self.offset / self.factor, (1.0 - self.offset) / self.factor

    def function(self, z: Tensor) -> Tensor:
        return z * (self.factor * z + self.offset).clamp(0.0, 1.0)

    def slope(self, z: Tensor) -> Tensor:
        return 2.0 * self.factor * z + self.offset

    def missing(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return OWN_QUOTIENTS * _size(lower, upper)


@dataclass(frozen=True, eq=False)
class SwitchedSoftplus(Softplus):
    """``log(1 + exp(z))`` up to ``limit``, and above it a straight line within a relative ``excess`` of z."""

    limit: float = math.inf
    excess: float = 0.0

    def missing(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # softplus is less than exp(-z) above its argument
        gap = math.exp(-self.limit) * SWITCH + (self.excess + OWN_QUOTIENTS) * _size(lower, upper)
        return torch.where(upper >= self.limit * (2.0 - SWITCH), gap, torch.zeros_like(gap))


@dataclass(frozen=True, eq=False)
class Quantised(Clip):
    """``step * min(max(round(z / step), low), high)``, enclosed by the clipped z plus or minus half a step (N25).

    `function` is z clipped to ``least = step * low`` and ``most = step * high``; a call has its gradient.
    """

    step: float = 1.0

    def missing(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # places, quotients and products of float32 move a number by less than the second part
        largest = max(abs(self.least), abs(self.most))
        return 0.5 * self.step * SWITCH + STEPS * largest

    def __call__(self, inputs: Sequence[Tensor]) -> Tensor:
        z = inputs[0]
        plain = self.function(z)
        stepped = (torch.round(z / self.step) * self.step).clamp(self.least, self.most)
        return plain + (stepped - plain).detach()


#: A softmax's terms, relative to one of them, and their sum are cut off at exp(this).
CAP = 30.0


class SoftmaxReciprocal(Reciprocal):
    """The reciprocal of a softmax's sum of capped exponentials (N11)."""

    def missing(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # the share and this are both less than exp(-CAP) and its roundings there; sums keep half their size
        return torch.where(upper > 0.5 * math.exp(CAP), LOST_SHARE, 0.0)


@dataclass(frozen=True, eq=False)
class CappedExp(Exp):
    """``min(exp(z), exp(cap))``, a term of a softmax; beyond the cap its sum is practically infinite (N11).

    Attributes:
        count: Terms of a sum.
    """

    count: int = 1
    cap: ClassVar[float] = CAP
    breaks = (CAP,)
    bends = (1, 0)

    def function(self, z: Tensor) -> Tensor:
        return z.clamp(max=self.cap).exp()

    def slope(self, z: Tensor) -> Tensor:
        return z.clamp(max=self.cap).exp()

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # the smaller of a number and the cap is the cap where any evaluation is past it
        capped = lower > self.cap + 1.0
        relative = ATTENTION + ATTENTION_BLOCKS * self.count
        return torch.where(capped, 0.0, relative * upper.clamp(max=self.cap).exp() + FLUSHED)
