"""Alphas from ranges of the exponent (design.md, B3, B4)."""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import njit

from ns_abstract.arithmetic.elementary import exp_kernel, fma
from ns_abstract.arithmetic.rounding import (
    CUBIC_SERIES_REST,
    EXP_OF_ENDS,
    FIT_ROUNDING,
    FRAGMENT_ROUNDING,
    SECOND_ORDER,
    SERIES_REST,
    UP,
)
from ns_abstract.arithmetic.simd.lanes import maximum, minimum, where
from ns_abstract.methods.splat.pixel_block import EXPONENT_CUT

#: Half-width of the exponent's range up to which exp(-t) is fitted by a polynomial.
_FIT_LIMIT = 2.0


class Limits(NamedTuple):
    """The quantities that turn a Gaussian's exponent into alpha.

    Attributes:
        opacity_low, opacity_high: Bounds of the opacity.
        kappa: Relative error of the computed exponent.
        sigma_max: Exponent above which alpha is below the threshold.
        alpha_min, alpha_min_high: Bounds of the alpha threshold.
        alpha_max: Larger alphas are lowered to it.
        sure: 1 where the Gaussian surely belongs to the tile, else 0.
    """

    opacity_low: float
    opacity_high: float
    kappa: float
    sigma_max: float
    alpha_min: float
    alpha_min_high: float
    alpha_max: float
    sure: float


class Exponent(NamedTuple):
    """Exponents of eight pixels, as bounds and forms.

    Attributes:
        low, high: Bounds.
        center, radius: Of the form.
        slope, bend: Magnitudes of its linear part and of its quadratic part, which is never negative.
        turn: Twice the number that stands for the quadratic part in products with it.
    """

    low: Any
    high: Any
    center: Any
    radius: Any
    slope: Any
    bend: Any
    turn: Any


class Alpha(NamedTuple):
    """Alphas of eight pixels: bounds, the form's centre and radius, and `ThresholdedAlpha.crossing`.

    The form's linear coefficients are ``weight`` times the exponent's, the quadratic ones ``curve`` times the products
    of the exponent's linear coefficients.
    """

    low: Any
    high: Any
    center: Any
    radius: Any
    crossing: Any
    weight: Any
    curve: Any


class _Range(NamedTuple):
    """Ranges of the computed exponents of eight pixels, and their exponentials (docs/dev/design.md, B3).

    Attributes:
        low: The least exponent.
        middle, half: Middle and half width of the range over which the exponential is fitted.
        fits: 1 where that is the whole range, else 0.
        radius: Of the form.
        at_low, fall: exp(-low), exp(-half).
        scale: Alpha at ``middle``.
        slack: Relative error of the exponential.
    """

    low: Any
    middle: Any
    half: Any
    fits: Any
    radius: Any
    at_low: Any
    fall: Any
    scale: Any
    slack: Any


class ThresholdedAlpha(NamedTuple):
    """Alphas of eight pixels after alpha threshold and cap.

    Attributes:
        low, high: Bounds.
        center, radius: Of the form.
        keep: 1 unless the form is constant.
        crossing: Alpha up to which the fragment may be skipped; 0 where it never is, or the form is constant.
    """

    low: Any
    high: Any
    center: Any
    radius: Any
    keep: Any
    crossing: Any


@njit(cache=True, error_model="numpy", forceinline=True)
def exponential_range(low, high, radius, limits, charges):
    """Return the `_Range` of exponents from ``low`` to ``high`` whose form has the ``radius`` (design.md, B3)."""
    kappa = limits.kappa
    low = minimum(maximum(0.0, low * (1.0 - kappa)), EXPONENT_CUT)
    high = maximum(low, high * (1.0 + kappa))
    width = 0.5 * (high - low) * UP
    half = minimum(width, _FIT_LIMIT)
    at_low, fall = exp_kernel(-low), exp_kernel(-half)
    slack = charges.exponential + charges.exponential_by_argument * low + charges.exponential_by_range * half
    return _Range(
        low=low,
        middle=low + half,
        half=half,
        fits=where(width < _FIT_LIMIT, 1.0, 0.0),
        # float evaluation moves the exponent by kappa
        radius=radius + kappa * minimum(high, 4.0 * EXPONENT_CUT),
        at_low=at_low,
        fall=fall,
        scale=0.5 * (limits.opacity_low + limits.opacity_high) * (at_low * fall),
        slack=slack + EXP_OF_ENDS,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _bessel_terms(x):
    """Return I0 - 2 I2, 2 I1 / r, 4 I2 / r^2 of modified Bessel functions at r = 2 sqrt(x), by cut series (B3)."""
    i0 = fma(x, fma(x, fma(x, fma(x, 1.0 / 576.0, 1.0 / 36.0), 0.25), 1.0), 1.0)
    k1 = fma(x, fma(x, fma(x, fma(x, 1.0 / 2880.0, 1.0 / 144.0), 1.0 / 12.0), 0.5), 1.0)
    k2 = fma(x, fma(x, fma(x, fma(x, 1.0 / 17280.0, 1.0 / 720.0), 1.0 / 48.0), 1.0 / 6.0), 0.5)
    return i0 - 2.0 * x * k2, k1, k2


@njit(cache=True, error_model="numpy", forceinline=True)
def cubic_exponential(low, high, center, radius, linear, quadratic, limits, charges):
    """Return opacity exp(-sigma) for one parameter, fitted by a polynomial of degree 3 (design.md, B3).

    The exponent sigma lies between ``low`` and ``high`` and within ``radius`` of ``center`` + ``linear`` p +
    ``quadratic`` p^2. The result is the `ThresholdedAlpha`, and the coefficients of p and p^2.
    """
    sigma = exponential_range(low, high, radius, limits, charges)
    # exp(-t) = k0 - k1 t + k2 t^2 - k3 t^3 +- fit over |t| <= half
    h = 0.5 * sigma.half
    x = h * h
    k0, k1, k2 = _bessel_terms(x)
    k3 = fma(x, fma(x, fma(x, 1.0 / 4320.0, 1.0 / 240.0), 1.0 / 24.0), 1.0 / 6.0)
    k1 = fma(-3.0 * x, k3, k1)
    fit = (x * x) * (1.0 / 12.0) * fma(x, fma(x, 1.0 / 48.0, 0.2), 1.0) * fma(x, 1.0 / 24.0, fma(h, 0.2, 1.0))
    fit = fma(CUBIC_SERIES_REST * x, (x * x) * (x * x), fit)
    t0 = center - sigma.middle
    # e0 + e1 u + e2 u^2 - k3 u^3 in u = linear p + quadratic p^2
    e0 = fma(t0, fma(t0, fma(-t0, k3, k2), -k1), k0)
    e1 = fma(t0, fma(-3.0 * t0, k3, 2.0 * k2), -k1)
    e2 = fma(-3.0 * t0, k3, k2)
    square, product = linear * linear, linear * quadratic
    p3 = fma(2.0 * e2, product, -k3 * (square * linear))
    p4 = quadratic * fma(e2, quadratic, -3.0 * k3 * square)
    p5 = -3.0 * k3 * (product * quadratic)
    p6 = -k3 * (quadratic * quadratic * quadratic)
    # in Chebyshev's basis, where what is above degree 2 is left out
    middle = fma(-5.0 / 32.0, p6, fma(-0.125, p4, e0))
    tilt = fma(0.625, p5, fma(0.75, p3, e1 * linear))
    bend = fma(15.0 / 16.0, p6, fma(e1, quadratic, fma(e2, square, p4)))
    dropped = abs(fma(0.25, p3, 0.3125 * p5)) + abs(fma(0.125, p4, 0.1875 * p6))
    dropped = dropped + 0.0625 * abs(p5) + 0.03125 * abs(p6)
    moved = abs(linear) + abs(quadratic) + sigma.radius
    steepest = fma(moved, fma(3.0 * k3, moved, 2.0 * abs(e2)), abs(e1))
    size = abs(t0) + moved + 1.0
    size = size * size * fma(2.0, size, 4.0)
    error = fma(steepest, sigma.radius, fma(FIT_ROUNDING, size, dropped + fit))
    alpha = thresholded(middle, error, sigma, limits, charges)
    always_drawn = alpha.keep == 1.0
    return alpha, where(always_drawn, sigma.scale * tilt, 0.0), where(always_drawn, sigma.scale * bend, 0.0)


@njit(cache=True, error_model="numpy", forceinline=True)
def fitted_exponential(exponent, limits, charges):
    """Return the `Alpha` opacity exp(-sigma) of an `Exponent`, after alpha threshold and cap (design.md, B3-B4)."""
    l, b = exponent.slope, exponent.bend
    sigma = exponential_range(exponent.low, exponent.high, exponent.radius, limits, charges)
    # exp(-t) = k0 - k1 t + k2 t^2 +- fit over |t| <= half
    h = 0.5 * sigma.half
    x = h * h
    k0, k1, k2 = _bessel_terms(x)
    fit = (h * x) * (1.0 / 3.0) * fma(x, fma(x, 1.0 / 24.0, 0.25), 1.0) * fma(x, 1.0 / 15.0, fma(h, 0.25, 1.0))
    fit = fma(SERIES_REST * x, (x * x) * (x * x), fit)
    t0 = exponent.center - sigma.middle
    weight = fma(2.0 * k2, t0, -k1)
    sr = sigma.radius
    spread = sr + l + b
    size = fma(abs(t0), 4.0 + abs(t0), fma(spread, 1.0 + spread, 4.0))
    # the linear part times twice what the curvature is off half its turn, and the square of that
    turn = exponent.turn
    bent = fma(l, 2.0 * b - turn, fma(0.125 * turn, turn, sr * fma(2.0, l + b, sr)))
    error = fma(abs(weight), sr, fma(k2, bent, fma(FIT_ROUNDING, size, fit)))
    middle = fma(t0, fma(k2, t0, -k1), fma(-0.125 * k2, turn * turn, k0))
    weight = fma(k2, turn, weight)
    alpha = thresholded(middle, error, sigma, limits, charges)
    return Alpha(
        alpha.low, alpha.high, alpha.center, alpha.radius, alpha.crossing,
        alpha.keep * (sigma.scale * weight), alpha.keep * (sigma.scale * k2),
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def thresholded(middle, error, sigma, limits, charges):
    """Return the `ThresholdedAlpha` of the `_Range` ``sigma``, with a form around ``middle`` within ``error`` (B4)."""
    opacity_low, opacity_high, alpha_max = limits.opacity_low, limits.opacity_high, limits.alpha_max
    slack, at_low = sigma.slack, sigma.at_low
    opacity = 0.5 * (opacity_low + opacity_high)
    opacity_spread = 0.5 * (opacity_high - opacity_low) * UP + FRAGMENT_ROUNDING * opacity
    a_high = opacity_high * at_low * (1.0 + slack)
    a_low = sigma.fits * (opacity_low * at_low * (sigma.fall * sigma.fall) * (1.0 - slack))
    center = sigma.scale * middle
    radius = fma(sigma.scale, error, SECOND_ORDER * at_low * fma(opacity_high, slack, opacity_spread))
    # alpha_max
    excess = maximum(0.0, a_high - alpha_max)
    a_high = minimum(a_high, alpha_max * (1.0 + charges.threshold))
    a_low = minimum(a_low, alpha_max * (1.0 - charges.threshold))
    # alpha_min: below it the fragment is skipped
    skips = a_low < limits.alpha_min_high
    crossing = where(skips, minimum(limits.alpha_min_high, a_high), 0.0)
    center = center - 0.5 * (excess + crossing)
    radius = fma(0.5, excess + crossing, radius) * UP
    a_low = where(skips, 0.0, limits.sure * a_low)
    # gone where it cannot reach the threshold
    gone = (a_high < limits.alpha_min) | (sigma.low > limits.sigma_max)
    a_high = where(gone, 0.0, a_high)
    a_low = where(gone, 0.0, a_low)
    flat = 0.5 * (a_high - a_low)
    keep = where(radius < flat, sigma.fits * limits.sure, 0.0)
    center = where(keep == 1.0, center, 0.5 * (a_high + a_low))
    radius = where(keep == 1.0, radius, flat * UP)
    return ThresholdedAlpha(a_low, a_high, center, radius, keep, where(skips, keep * limits.alpha_min_high, 0.0))
