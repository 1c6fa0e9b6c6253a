"""Activations that are convex, concave or linear between known points (docs/dev/design.md, N10, N21)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import (
    AFFINE,
    FLUSH,
    FUNCTION_FLUSHES,
    HARD,
    LARGEST_EXPONENT,
    LIBRARY,
    OWN_FUNCTION,
    QUOTIENT,
    ROOT,
    SQUARE,
)
from ns_abstract.verify.network.scalar_function import LibraryFunction, ScalarFunction, _SampledFunction, _size

#: What a number that is flushed to zero may change in a function whose slopes are 1 at most.
FLUSHED = FUNCTION_FLUSHES * FLUSH

# ---------------------------------------------------------------- straight parts


@dataclass(frozen=True, eq=False)
class Clip(ScalarFunction):
    """``min(max(slope z + offset, least), most)``; ReLU6, clamp, HardSigmoid."""

    least: float = 0.0
    most: float = 1.0
    factor: float = 1.0
    offset: float = 0.0

    @property
    def steepest(self) -> float:  # type: ignore[override]
        return self.factor

    @property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        return (self.least - self.offset) / self.factor, (self.most - self.offset) / self.factor

    bends = (0, 0, 0)

    def function(self, z: Tensor) -> Tensor:
        return (self.factor * z + self.offset).clamp(self.least, self.most)

    def straight(self, z: Tensor) -> Tensor:
        low, high = self.breaks
        return torch.where((z >= low) & (z <= high), torch.full_like(z, self.factor), torch.zeros_like(z))

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        flushed = FLUSHED * (1.0 + self.factor + _size(lower, upper))
        if (self.factor, self.offset) == (1.0, 0.0):
            return flushed
        return AFFINE * (self.factor * _size(lower, upper) + abs(self.offset)) + flushed


class Abs(ScalarFunction):
    """``|z|``."""

    breaks = (0.0,)
    bends = (0, 0)

    def function(self, z: Tensor) -> Tensor:
        return z.abs()

    def straight(self, z: Tensor) -> Tensor:
        return torch.where(z >= 0.0, torch.ones_like(z), -torch.ones_like(z))

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return FLUSHED


# ---------------------------------------------------------------- algebraic


class HardSwish(ScalarFunction):
    """``z min(max(z / 6 + 1 / 2, 0), 1)``."""

    breaks = (-3.0, 3.0)
    bends = (0, 1, 0)

    def function(self, z: Tensor) -> Tensor:
        return z * (z + 3.0).clamp(0.0, 6.0) / 6.0

    def slope(self, z: Tensor) -> Tensor:
        return (2.0 * z + 3.0) / 6.0

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return HARD * _size(lower, upper) + FLUSHED


@dataclass(frozen=True, eq=False)
class Power(ScalarFunction):
    """``z^exponent`` for a whole exponent of at least 2."""

    exponent: int = 2

    @property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        return (0.0,) if self.exponent % 2 else ()

    @property
    def bends(self) -> tuple[int, ...]:  # type: ignore[override]
        return (-1, 1) if self.exponent % 2 else (1,)

    def function(self, z: Tensor) -> Tensor:
        return z**self.exponent

    def slope(self, z: Tensor) -> Tensor:
        return self.exponent * z ** (self.exponent - 1)

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # a square is one product; others may be a library's power
        relative = SQUARE if self.exponent == 2 else LIBRARY
        size = _size(lower, upper)
        return relative * size**self.exponent + FLUSHED * (1.0 + size)


def _unknown(lower: Tensor, upper: Tensor, where: Tensor) -> tuple[Tensor, Tensor]:
    """Return bounds with NaN ``where`` the function has no bound; the cell is then given up."""
    nan = torch.full_like(lower, math.nan)
    return torch.where(where, nan, lower), torch.where(where, nan, upper)


@dataclass(frozen=True, eq=False)
class _Floored(ScalarFunction):
    """A function whose inputs are at least ``floor``."""

    floor: float = -math.inf

    def _inside(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        return lower.clamp(min=self.floor), upper.clamp(min=self.floor)


class _Positive(_Floored):
    """A function whose inputs are above 0."""

    def _cuts(self, lower: Tensor, upper: Tensor) -> _SampledFunction:
        # a number below may be flushed to zero, whose root, power or logarithm is far from its own
        return super()._cuts(*_unknown(lower, upper, ~(lower >= FLUSH)))


@dataclass(frozen=True, eq=False)
class Reciprocal(_Floored):
    """``1 / z``; bounded only over intervals without 0."""

    # two operations that keep all digits, however small the slope is
    slope_scale = 0.0
    breaks = (0.0,)
    bends = (-1, 1)

    def function(self, z: Tensor) -> Tensor:
        return 1.0 / z

    def slope(self, z: Tensor) -> Tensor:
        return -1.0 / z.square()

    def _cuts(self, lower: Tensor, upper: Tensor) -> _SampledFunction:
        return super()._cuts(*_unknown(lower, upper, (lower <= 0.0) & (upper >= 0.0)))

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        lower, upper = self._inside(lower, upper)
        return QUOTIENT / torch.minimum(lower.abs(), upper.abs()) + FLUSHED


@dataclass(frozen=True, eq=False)
class Root(_Positive):
    """``sqrt(z)``, or ``1 / sqrt(z)`` if ``inverse``."""

    inverse: bool = False

    @property
    def bends(self) -> tuple[int, ...]:  # type: ignore[override]
        return (1,) if self.inverse else (-1,)

    def function(self, z: Tensor) -> Tensor:
        return z.rsqrt() if self.inverse else z.sqrt()

    def slope(self, z: Tensor) -> Tensor:
        return -0.5 * z.rsqrt() / z if self.inverse else 0.5 * z.rsqrt()

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        lower, upper = self._inside(lower, upper)
        return ROOT * (lower.rsqrt() if self.inverse else upper.sqrt()) + FLUSHED


@dataclass(frozen=True, eq=False)
class PositivePower(_Positive):
    """``z^exponent`` for any exponent but 0 and 1."""

    exponent: float = -0.75

    @property
    def bends(self) -> tuple[int, ...]:  # type: ignore[override]
        return (-1,) if 0.0 < self.exponent < 1.0 else (1,)

    def function(self, z: Tensor) -> Tensor:
        return z**self.exponent

    def slope(self, z: Tensor) -> Tensor:
        return self.exponent * z ** (self.exponent - 1.0)

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return LIBRARY * torch.maximum(lower**self.exponent, upper**self.exponent) + FLUSHED


# ---------------------------------------------------------------- with exponentials


class Exp(LibraryFunction):
    """The exponential."""

    bends = (1,)

    def function(self, z: Tensor) -> Tensor:
        return z.exp()

    def slope(self, z: Tensor) -> Tensor:
        return z.exp()

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        representable = upper < LARGEST_EXPONENT
        return torch.where(representable, 2.0 * LIBRARY * upper.exp() + FLUSHED, torch.full_like(upper, math.nan))


class Log(_Positive, LibraryFunction):
    """The natural logarithm."""

    bends = (-1,)

    def function(self, z: Tensor) -> Tensor:
        return z.log()

    def slope(self, z: Tensor) -> Tensor:
        return 1.0 / z

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        lower, upper = self._inside(lower, upper)
        return LIBRARY * (1.0 + torch.maximum(lower.log().abs(), upper.log().abs()))


class Softplus(LibraryFunction):
    """``log(1 + exp(z))``."""

    bends = (1,)

    def function(self, z: Tensor) -> Tensor:
        return torch.logaddexp(z, torch.zeros_like(z))

    def slope(self, z: Tensor) -> Tensor:
        return torch.sigmoid(z)

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return 2.0 * LIBRARY * (1.0 + _size(lower, upper))


@dataclass(frozen=True, eq=False)
class Elu(LibraryFunction):
    """``scale z`` above 0 and ``scale alpha (exp(z / width) - 1)`` below; ELU, SELU and CELU."""

    alpha: float = 1.0
    scale: float = 1.0
    width: float = 1.0

    breaks = (0.0,)
    bends = (1, 0)

    def function(self, z: Tensor) -> Tensor:
        below = self.alpha * torch.expm1(z.clamp(max=0.0) / self.width)
        return self.scale * torch.where(z > 0.0, z, below)

    def slope(self, z: Tensor) -> Tensor:
        return self.scale * self.alpha / self.width * torch.exp(z.clamp(max=0.0) / self.width)

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        size = _size(lower, upper)
        flushed = FLUSHED * (1.0 + self.scale) * (1.0 + self.alpha) * (1.0 + size)
        return 2.0 * LIBRARY * self.scale * (self.alpha + size) + flushed


class Erf(LibraryFunction):
    """The error function."""

    breaks = (0.0,)
    bends = (1, -1)

    def function(self, z: Tensor) -> Tensor:
        return torch.erf(z)

    def slope(self, z: Tensor) -> Tensor:
        return 2.0 / math.sqrt(math.pi) * torch.exp(-z.square())

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return 2.0 * LIBRARY


class _Sigmoidal(ScalarFunction):
    """An increasing function between -1 and 1 that is convex below 0 and concave above."""

    breaks = (0.0,)
    bends = (1, -1)

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        return LIBRARY

    def range(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        return self.function(lower) - OWN_FUNCTION, self.function(upper) + OWN_FUNCTION

    def relaxation_gap(self, lower: Tensor, upper: Tensor) -> Tensor | None:
        return None

    def unstable(self, lower: Tensor, upper: Tensor) -> Tensor:
        return lower < upper


class Sigmoid(_Sigmoidal):
    """``1 / (1 + exp(-z))``."""

    def function(self, z: Tensor) -> Tensor:
        return torch.sigmoid(z)

    def slope(self, z: Tensor) -> Tensor:
        return torch.sigmoid(z) * torch.sigmoid(-z)


class Tanh(_Sigmoidal):
    """Hyperbolic tangent."""

    def function(self, z: Tensor) -> Tensor:
        return torch.tanh(z)

    def slope(self, z: Tensor) -> Tensor:
        return 1.0 / torch.cosh(z).square()


class _Gated(LibraryFunction):
    """``z g(z)`` with a gate g from 0 to 1: concave, convex, concave."""

    bends = (-1, 1, -1)

    def error(self, lower: Tensor, upper: Tensor) -> Tensor | float:
        # the gate may be made of two such functions, and of constants that are float32 numbers
        return 4.0 * LIBRARY * _size(lower, upper) + FLUSHED


class Silu(_Gated):
    """``z / (1 + exp(-z))``."""

    @property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        # z tanh(z / 2) = 2
        return -2.3993572805154676, 2.3993572805154676

    def function(self, z: Tensor) -> Tensor:
        return z * torch.sigmoid(z)

    def slope(self, z: Tensor) -> Tensor:
        gate = torch.sigmoid(z)
        return gate + z * gate * torch.sigmoid(-z)


class Gelu(_Gated):
    """``z (1 + erf(z / sqrt(2))) / 2``."""

    breaks = (-math.sqrt(2.0), math.sqrt(2.0))

    def function(self, z: Tensor) -> Tensor:
        return 0.5 * z * torch.special.erfc(-z * math.sqrt(0.5))

    def slope(self, z: Tensor) -> Tensor:
        density = torch.exp(-0.5 * z.square()) / math.sqrt(2.0 * math.pi)
        return 0.5 * torch.special.erfc(-z * math.sqrt(0.5)) + z * density


_CUBIC = 0.044715
_RATE = math.sqrt(2.0 / math.pi)


class GeluTanh(_Gated):
    """``z (1 + tanh(sqrt(2 / pi) (z + 0.044715 z^3))) / 2``."""

    # second derivative 0 (mpmath, 40 digits)
    breaks = (-1.4185040087908283, 1.4185040087908283)

    def function(self, z: Tensor) -> Tensor:
        return z * torch.sigmoid(2.0 * _RATE * (z + _CUBIC * z**3))

    def slope(self, z: Tensor) -> Tensor:
        inner = 2.0 * _RATE * (z + _CUBIC * z**3)
        gate = torch.sigmoid(inner)
        return gate + z * gate * torch.sigmoid(-inner) * 2.0 * _RATE * (1.0 + 3.0 * _CUBIC * z.square())


class Mish(_Gated):
    """``z tanh(log(1 + exp(z)))``."""

    # second derivative 0 (mpmath, 40 digits)
    breaks = (-2.256376396360793, 1.4905711794854284)

    def function(self, z: Tensor) -> Tensor:
        return z * torch.tanh(torch.logaddexp(z, torch.zeros_like(z)))

    def slope(self, z: Tensor) -> Tensor:
        gate = torch.tanh(torch.logaddexp(z, torch.zeros_like(z)))
        return gate + z * (1.0 - gate.square()) * torch.sigmoid(z)
