"""Lines, bands and ranges of functions of one number, against 200-bit balls at tolerance zero."""

from __future__ import annotations

import math
from collections.abc import Callable

import flint
import numpy as np
import pytest
import torch
from flint import arb, fmpq
from oracle import at_most, rational

from ns_abstract.verify.network import activations, composite_activations
from ns_abstract.verify.network.layers import LinearRelaxation
from ns_abstract.verify.network.scalar_function import ScalarFunction

ZERO = fmpq(0)
Exact = Callable[[arb], arb]


def _clip(z: arb, least: float, most: float) -> arb:
    return z.max(arb(least)).min(arb(most))


def _logistic(z: arb) -> arb:
    return 1 / (1 + (-z).exp())


def _elu(z: arb, alpha: float, scale: float, width: float) -> arb:
    return arb(scale) * (z if z > 0 else arb(alpha) * (z / arb(width)).expm1())


#: A curve, its exact function, and the inputs to try.
CURVES: dict[str, tuple[ScalarFunction, Exact, tuple[float, float]]] = {
    "clip": (activations.Clip((1,), least=-0.5, most=0.75), lambda z: _clip(z, -0.5, 0.75), (-9, 9)),
    "hard sigmoid": (
        activations.Clip((1,), factor=0.2, offset=0.5),
        lambda z: _clip(arb(0.2) * z + arb(0.5), 0, 1),
        (-9, 9),
    ),
    "abs": (activations.Abs((1,)), abs, (-9, 9)),
    "hard swish": (activations.HardSwish((1,)), lambda z: z * _clip(z + 3, 0, 6) / 6, (-9, 9)),
    "square": (activations.Power((1,)), lambda z: z * z, (-30, 30)),
    "cube": (activations.Power((1,), exponent=3), lambda z: z * z * z, (-9, 9)),
    "reciprocal": (activations.Reciprocal((1,)), lambda z: 1 / z, (1e-3, 50)),
    "negative reciprocal": (activations.Reciprocal((1,)), lambda z: 1 / z, (-50, -1e-3)),
    "root": (activations.Root((1,)), lambda z: z.sqrt(), (1e-6, 50)),
    "inverse root": (activations.Root((1,), inverse=True), lambda z: z.rsqrt(), (1e-5, 50)),
    "power -0.75": (activations.PositivePower((1,)), lambda z: z ** arb(-0.75), (1e-5, 50)),
    "power 0.3": (activations.PositivePower((1,), exponent=0.3), lambda z: z ** arb(0.3), (1e-6, 50)),
    "power 2.5": (activations.PositivePower((1,), exponent=2.5), lambda z: z ** arb(2.5), (1e-4, 30)),
    "exp": (activations.Exp((1,)), lambda z: z.exp(), (-30, 30)),
    "capped exp": (
        composite_activations.CappedExp((1,)),
        lambda z: z.min(arb(composite_activations.CAP)).exp(),
        (-30, 40),
    ),
    "log": (activations.Log((1,)), lambda z: z.log(), (1e-4, 50)),
    "softplus": (activations.Softplus((1,)), lambda z: (1 + z.exp()).log(), (-40, 40)),
    "elu": (activations.Elu((1,), alpha=1.5), lambda z: _elu(z, 1.5, 1, 1), (-20, 20)),
    "celu": (activations.Elu((1,), alpha=0.5, scale=1.25, width=0.5), lambda z: _elu(z, 0.5, 1.25, 0.5), (-20, 20)),
    "erf": (activations.Erf((1,)), lambda z: z.erf(), (-8, 8)),
    "sigmoid": (activations.Sigmoid((1,)), _logistic, (-40, 40)),
    "tanh": (activations.Tanh((1,)), lambda z: z.tanh(), (-20, 20)),
    "silu": (activations.Silu((1,)), lambda z: z * _logistic(z), (-40, 40)),
    "gelu": (activations.Gelu((1,)), lambda z: z * (-z / arb(2).sqrt()).erfc() / 2, (-20, 20)),
    "gelu tanh": (
        activations.GeluTanh((1,)),
        lambda z: z / 2 * (1 + ((2 / arb.pi()).sqrt() * (z + arb(0.044715) * z * z * z)).tanh()),
        (-12, 12),
    ),
    "mish": (activations.Mish((1,)), lambda z: z * (1 + z.exp()).log().tanh(), (-40, 40)),
}


def intervals(low: float, high: float, count: int = 24) -> tuple[torch.Tensor, torch.Tensor]:
    """Intervals of all widths, from points to the whole range."""
    rng = np.random.default_rng(0)
    place = rng.uniform(low, high, count) if low < 0.0 < high else np.exp(rng.uniform(0, 1, count)) * 0 + low
    if not low < 0.0 < high:
        sign = 1.0 if low > 0.0 else -1.0
        ends = sorted((abs(low), abs(high)))
        place = sign * np.exp(rng.uniform(math.log(ends[0]), math.log(ends[1]), count))
    else:
        place *= rng.uniform(0, 1, count)
    width = np.where(np.arange(count) % 6 == 0, 0.0, 10.0 ** rng.uniform(-9, 1.3, count))
    one, two = np.clip(place, low, high), np.clip(place + width, low, high)
    one[-1], two[-1] = low, high
    return torch.from_numpy(one), torch.from_numpy(np.maximum(one, two))


def points(low: float, high: float, breaks: tuple[float, ...]) -> list[float]:
    inside = [b for b in breaks if low <= b <= high]
    rng = np.random.default_rng(1)
    return [low, high, *inside, *np.clip(rng.uniform(low, high, 6), low, high)]


def below(slope: float, offset: float, z: float, exact: Exact) -> bool:
    """Whether ``slope z + offset <= f(z)``."""
    return at_most(lambda: rational(slope) * rational(z) + rational(offset) - exact(arb(rational(z))), ZERO)


def above(slope: float, offset: float, z: float, exact: Exact) -> bool:
    return at_most(lambda: exact(arb(rational(z))) - rational(slope) * rational(z) - rational(offset), ZERO)


def broken(curve: ScalarFunction, exact: Exact, range_: tuple[float, float]) -> int:
    """How many of all tried points lie outside lines, bands or ranges."""
    lower, upper = intervals(*range_)
    flat = torch.zeros_like(lower)
    least, most = curve.range(lower, upper)
    found = 0
    lines = [curve.lines(lower, upper), curve.band(lower, upper), LinearRelaxation(flat, least, flat, most)]
    for k in range(len(lower)):
        for z in points(float(lower[k]), float(upper[k]), curve.breaks):
            for line in lines:
                found += not below(float(line.lower_slope[k]), float(line.lower_offset[k]), z, exact)
                found += not above(float(line.upper_slope[k]), float(line.upper_offset[k]), z, exact)
    return found


@pytest.mark.parametrize("name", CURVES)
def test_lines_enclose_the_function(name: str) -> None:
    with flint.ctx.workprec(200):
        assert broken(*CURVES[name]) == 0


@pytest.mark.parametrize("name", CURVES)
def test_lines_are_nearly_the_best(name: str) -> None:
    """A line's height at the middle is at most a little more than the envelope's, found by dense sampling."""
    curve, _, range_ = CURVES[name]
    lower, upper = intervals(*range_)
    wide = upper - lower > 1e-5
    lower, upper = lower[wide], upper[wide]
    middle = 0.5 * (lower + upper)
    lines = curve.lines(lower, upper)
    steps = torch.linspace(0, 1, 401, dtype=torch.float64)[:, None]
    z = lower + (upper - lower) * steps
    value = curve.function(z)
    span = value.amax(0) - value.amin(0)
    for side, slope, offset in (
        (1.0, lines.upper_slope, lines.upper_offset),
        (-1.0, lines.lower_slope, lines.lower_offset),
    ):
        best = torch.full_like(middle, -math.inf)
        for i in range(0, 201, 8):
            for j in range(200, 401, 8):
                if i < 200 < j:
                    part = (200 - i) / (j - i)
                    best = torch.maximum(best, side * ((1 - part) * value[i] + part * value[j]))
        best = torch.maximum(best, side * value[200])
        height = side * (slope * middle + offset)
        assert (height <= best + 0.03 * span + 1e-9 * (1 + value.abs().amax(0))).all()


@pytest.mark.parametrize("name", CURVES)
def test_thin_intervals_have_thin_bands(name: str) -> None:
    curve, _, (low, high) = CURVES[name]
    middle = torch.linspace(low + 0.1 * (high - low), high - 0.1 * (high - low), 41, dtype=torch.float64)
    for width in (1e-3, 1e-6):
        lower, upper = middle - width, middle + width
        if low > 0.0 or high < 0.0:
            lower, upper = lower.clamp(low, high), upper.clamp(low, high)
        band, (least, most) = curve.band(lower, upper), curve.range(lower, upper)
        kinks = 2.0 * width * (0.5 + 2.0 * (0 in curve.bends))
        size = curve.function(middle).abs().amax()
        kinks *= max(1.0, float(size))
        assert (band.upper_offset - band.lower_offset <= kinks + 1e-9 * size).all()
        steep = (curve.function(upper) - curve.function(lower)).abs()
        assert (most - least <= steep + kinks + 1e-9 * size).all()


@pytest.mark.parametrize("name", CURVES)
def test_larger_intervals_have_larger_ranges(name: str) -> None:
    curve, _, range_ = CURVES[name]
    lower, upper = intervals(*range_)
    inner = lower + 0.3 * (upper - lower), upper - 0.2 * (upper - lower)
    inner = torch.minimum(*inner), torch.maximum(*inner)
    (least, most), (low, high) = curve.range(*inner), curve.range(lower, upper)
    # a fault of a part's tangents is a 64th of the part's bend
    room = 2.0**-7 * (high - low) + 1e-9 * (1 + high.abs() + low.abs())
    assert (low <= least + room).all() and (high >= most - room).all()


class _Chord(activations.Silu):
    """Takes the function to be straight."""

    @property
    def bends(self) -> tuple[int, ...]:
        return 0, 0, 0

    def straight(self, z: torch.Tensor) -> torch.Tensor:
        return self.slope(z)


class _Turned(activations.Silu):
    """Takes the wrong parts to be convex."""

    @property
    def bends(self) -> tuple[int, ...]:
        return 1, -1, 1


@pytest.mark.parametrize(("wrong", "name"), [(_Chord, "silu"), (_Turned, "silu")])
def test_planted_faults_are_found(wrong: type[ScalarFunction], name: str) -> None:
    _, exact, range_ = CURVES[name]
    with flint.ctx.workprec(200):
        assert broken(wrong((1,)), exact, range_) > 0


def test_what_lies_outside_a_domain_is_unknown() -> None:
    lower, upper = torch.tensor([-1.0, 0.0, 0.5]).double(), torch.tensor([1.0, 2.0, 2.0]).double()
    for curve in (
        activations.Reciprocal((3,)),
        activations.Root((3,)),
        activations.Log((3,)),
        activations.Root((3,), inverse=True),
    ):
        band = curve.band(lower, upper)
        known = torch.isfinite(band.upper_offset - band.lower_offset)
        assert known.tolist() == [False, False, True]
        floored = type(curve)((3,), floor=0.25).band(lower, upper)
        assert torch.isfinite(floored.upper_offset).all()
    band = activations.PositivePower((3,)).band(lower, upper)
    assert torch.isfinite(band.upper_offset - band.lower_offset).tolist() == [False, False, True]
