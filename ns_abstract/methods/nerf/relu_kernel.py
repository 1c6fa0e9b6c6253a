"""The ReLU of `ns_abstract.methods.nerf.zonotope` for one parameter, compiled: one pass over every piece.

The grid is symmetric and ``T_k(-p) = (-1)^k T_k(p)``, so even and odd degrees are summed on one half of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import CHEBYSHEV_ROUNDING, FIELD_UP, UNIT64


class Grid(NamedTuple):
    """The first half of a symmetric grid of g points, its middle included, and how a polynomial is fitted there.

    Attributes:
        half: [m, (g + 1) / 2] values of the basis.
        fit_even, fit_odd: [(g + 1) / 2, .] the fit of even and odd degrees.
        chord: [m].
        norming: See `ChebyshevBasis.norming`.
    """

    half: np.ndarray
    fit_even: np.ndarray
    fit_odd: np.ndarray
    chord: np.ndarray
    norming: float


@njit(cache=True, error_model="numpy")
def _on_grid(p, half, even, odd, values):
    """``values[i] = sum_k p[k] T_k(x_i)`` from ``half`` [m, (g + 1) / 2], the grid's first half and its middle."""
    count = half.shape[1]
    last = values.shape[0] - 1
    for i in range(count):
        even[i] = 0.0
        odd[i] = 0.0
    for k in range(0, p.shape[0], 2):
        for i in range(count):
            even[i] += p[k] * half[k, i]
    for k in range(1, p.shape[0], 2):
        for i in range(count):
            odd[i] += p[k] * half[k, i]
    for i in range(count):
        values[last - i] = even[i] - odd[i]
        values[i] = even[i] + odd[i]


@njit(cache=True, error_model="numpy")
def _series(values, fit_even, fit_odd, sum_even, sum_odd, q):
    """``q[k] = sum_i fit[k, i] values[i]`` from the grid's first half and its middle, by even and odd degrees."""
    count = fit_even.shape[0]
    last = values.shape[0] - 1
    sum_even[:] = 0.0
    sum_odd[:] = 0.0
    for i in range(count):
        # the middle of the grid stands for itself; odd polynomials vanish there
        even = values[i] + values[last - i] if i < count - 1 else values[i]
        odd = values[i] - values[last - i]
        for k in range(sum_even.shape[0]):
            sum_even[k] += fit_even[i, k] * even
        for k in range(sum_odd.shape[0]):
            sum_odd[k] += fit_odd[i, k] * odd
    q[0::2] = sum_even
    q[1::2] = sum_odd


@njit(cache=True, error_model="numpy")
def _smallest(values, scratch):
    """The least of ``values`` by folding, which the processor does many at a time; NaN may be passed over."""
    n = values.shape[0]
    rest = (n + 1) // 2
    for i in range(n - rest):
        scratch[i] = values[i] if values[i] < values[i + rest] else values[i + rest]
    if n - rest < rest:
        scratch[rest - 1] = values[rest - 1]
    n = rest
    while n > 1:
        rest = (n + 1) // 2
        for i in range(n - rest):
            scratch[i] = scratch[i] if scratch[i] < scratch[i + rest] else scratch[i + rest]
        n = rest
    return scratch[0]


@njit(cache=True, error_model="numpy")
def relu(poly, rho, box, failed, grid, slope, size, which, neuron, error):
    """max(0, z) in place (design.md, F5); returns the number of new error terms.

    One long function: with the range and the fit in functions of their own it takes 1.15 times as long (measured).

    Args:
        poly: [B, m, n] coefficients; replaced.
        rho: [B, n] sums of absolute columns.
        box: [B, n]; replaced.
        failed: [B].
        grid: `Grid`.
        slope, size: [B, n], filled: what columns are multiplied by; sum of absolute coefficients and columns.
        which, neuron, error: [B n], filled with piece, neuron and size of the new error terms.
    """
    half, fit_even, fit_odd, chord, norming = grid
    pieces, m, n = poly.shape
    points = 2 * half.shape[1] - 1
    p, q = np.empty(m), np.empty(m)
    values, fitted, positive = np.empty(points), np.empty(points), np.empty(points)
    even, odd = np.empty(half.shape[1]), np.empty(half.shape[1])
    spread = np.empty(n)
    scratch, trial = np.empty(points), np.empty(points)
    sum_even, sum_odd = np.empty(fit_even.shape[1]), np.empty(fit_odd.shape[1])
    found = 0
    for b in range(pieces):
        if failed[b]:
            for j in range(n):
                slope[b, j] = 0.0
                size[b, j] = 0.0
                box[b, j] = 0.0
            poly[b] = 0.0
            continue
        for j in range(n):
            spread[j] = 0.0
        for k in range(1, m):
            for j in range(n):
                spread[j] += abs(poly[b, k, j])
        begin = found
        for j in range(n):
            radius = (spread[j] * FIELD_UP + rho[b, j] + box[b, j]) * FIELD_UP
            middle = poly[b, 0, j]
            whole = abs(middle) + spread[j] + rho[b, j]
            if middle >= radius:
                slope[b, j] = 1.0
                size[b, j] = whole * FIELD_UP
                continue
            if middle <= -radius:
                slope[b, j] = 0.0
                size[b, j] = 0.0
                box[b, j] = 0.0
                continue
            absolute = 0.0
            for k in range(m):
                p[k] = poly[b, k, j]
                absolute += abs(p[k])
            _on_grid(p, half, even, odd, values)
            low = _smallest(values, scratch)
            for i in range(points):
                trial[i] = -values[i]
            high = -_smallest(trial, scratch)
            slack = CHEBYSHEV_ROUNDING * absolute
            centre = 0.5 * (low + high)
            width = 0.5 * (high - low) * norming + slack
            low = centre - width
            high = centre + width
            e = rho[b, j]
            r = box[b, j]
            if low >= e + r:
                slope[b, j] = 1.0
                size[b, j] = whole * FIELD_UP
                continue
            if high <= -(e + r):
                slope[b, j] = 0.0
                size[b, j] = 0.0
                box[b, j] = 0.0
                continue
            # written so that what is not a number stays open, and fails below
            for i in range(points):
                positive[i] = values[i] if values[i] > 0.0 else 0.0
            _series(positive, fit_even, fit_odd, sum_even, sum_odd, q)
            _on_grid(q, half, even, odd, fitted)
            below = 0.0
            above = 0.0
            sum_q = 0.0
            for k in range(m):
                below += abs(q[k]) * chord[k]
                above += abs(p[k] - q[k]) * chord[k]
                sum_q += abs(q[k])
            for i in range(points):
                trial[i] = fitted[i] - positive[i]
            most = max(above, below) - _smallest(trial, scratch)
            for i in range(points - 1):
                left = values[i] - fitted[i]
                right = values[i + 1] - fitted[i + 1]
                first = (left if left < right else right) - above
                second = (-fitted[i] if fitted[i] > fitted[i + 1] else -fitted[i + 1]) - below
                trial[i] = first if first > second else second
            least = _smallest(trial[: points - 1], scratch)
            new = (0.5 * (most - least) + CHEBYSHEV_ROUNDING * (sum_q + absolute) + 0.5 * e + 2.0 * slack) * FIELD_UP
            bottom = low - e - r
            top = high + e + r
            line = top / (top - bottom)
            line_error = (0.5 * line * -bottom + 4.0 * slack) * FIELD_UP
            if line_error + line * r < new + r:
                kept = line
                new = line_error
                box[b, j] = r * line
                for k in range(m):
                    q[k] = p[k] * line
                q[0] += 0.5 * line * -bottom
            else:
                kept = 0.5
                q[0] += 0.5 * (most + least)
            sum_q = 0.0
            for k in range(m):
                poly[b, k, j] = q[k]
                sum_q += abs(q[k])
            new += 8.0 * UNIT64 * (sum_q + e)
            slope[b, j] = kept
            size[b, j] = (sum_q + kept * e + new) * FIELD_UP
            box[b, j] *= FIELD_UP
            which[found] = b
            neuron[found] = j
            error[found] = new
            found += 1
        # only certain zeros are left to clear: what is open has its new polynomial
        place = begin
        for j in range(n):
            if place < found and neuron[place] == j:
                place += 1
            elif slope[b, j] == 0.0:
                for k in range(m):
                    poly[b, k, j] = 0.0
    return found
