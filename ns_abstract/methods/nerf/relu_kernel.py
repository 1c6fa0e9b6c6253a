"""The ReLU of `ns_abstract.methods.nerf.zonotope` for one parameter, compiled: one pass over every piece.

The grid is symmetric and ``T_k(-p) = (-1)^k T_k(p)``, so even and odd degrees are summed on one half of it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ns_abstract.arithmetic.chebyshev import ROUNDING
from ns_abstract.arithmetic.units import UNIT64

_UP = 1.0 + 2.0**-40


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
def _series(values, fit, even, odd, q):
    """``q[k] = sum_i fit[k, i] values[i]`` from the first half of ``fit`` and its middle (weighted once)."""
    count = fit.shape[1]
    last = values.shape[0] - 1
    for i in range(count):
        even[i] = values[i] + values[last - i]
        odd[i] = values[i] - values[last - i]
    even[count - 1] = values[count - 1]
    odd[count - 1] = 0.0
    for k in range(q.shape[0]):
        total = 0.0
        if k % 2 == 0:
            for i in range(count):
                total += fit[k, i] * even[i]
        else:
            for i in range(count):
                total += fit[k, i] * odd[i]
        q[k] = total


@njit(cache=True, error_model="numpy")
def relu(poly, rho, box, failed, half, fit, chord, norming, slope, size, which, neuron, error):
    """max(0, z) in place (design.md, N5); returns the number of new error terms.

    Args:
        poly: [B, m, n] coefficients; replaced.
        rho: [B, n] sums of absolute columns.
        box: [B, n]; replaced.
        failed: [B].
        half, fit: [m, (g + 1) / 2] values and fit on the first half of the grid of g points, middle included.
        chord: [m].
        norming: See `ChebyshevBasis.norming`.
        slope, size: [B, n], filled: what columns are multiplied by; sum of absolute coefficients and columns.
        which, neuron, error: [B n], filled with piece, neuron and size of the new error terms.
    """
    pieces, m, n = poly.shape
    points = 2 * half.shape[1] - 1
    p, q = np.empty(m), np.empty(m)
    values, fitted, positive = np.empty(points), np.empty(points), np.empty(points)
    even, odd = np.empty(half.shape[1]), np.empty(half.shape[1])
    spread = np.empty(n)
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
            reach = (spread[j] * _UP + rho[b, j] + box[b, j]) * _UP
            middle = poly[b, 0, j]
            whole = abs(middle) + spread[j] + rho[b, j]
            if middle >= reach:
                slope[b, j] = 1.0
                size[b, j] = whole * _UP
                continue
            if middle <= -reach:
                slope[b, j] = 0.0
                size[b, j] = 0.0
                box[b, j] = 0.0
                continue
            absolute = 0.0
            for k in range(m):
                p[k] = poly[b, k, j]
                absolute += abs(p[k])
            _on_grid(p, half, even, odd, values)
            low = values[0]
            high = values[0]
            for i in range(1, points):
                low = min(low, values[i])
                high = max(high, values[i])
            slack = ROUNDING * absolute
            centre = 0.5 * (low + high)
            width = 0.5 * (high - low) * norming + slack
            low = centre - width
            high = centre + width
            e = rho[b, j]
            r = box[b, j]
            if low >= e + r:
                slope[b, j] = 1.0
                size[b, j] = whole * _UP
                continue
            if high <= -(e + r):
                slope[b, j] = 0.0
                size[b, j] = 0.0
                box[b, j] = 0.0
                continue
            # written so that what is not a number stays open, and fails below
            for i in range(points):
                positive[i] = values[i] if values[i] > 0.0 else 0.0
            _series(positive, fit, even, odd, q)
            _on_grid(q, half, even, odd, fitted)
            below = 0.0
            above = 0.0
            sum_q = 0.0
            for k in range(m):
                below += abs(q[k]) * chord[k]
                above += abs(p[k] - q[k]) * chord[k]
                sum_q += abs(q[k])
            most = -np.inf
            for i in range(points):
                most = max(most, positive[i] - fitted[i])
            most += max(above, below)
            least = np.inf
            for i in range(points - 1):
                first = min(values[i] - fitted[i], values[i + 1] - fitted[i + 1]) - above
                second = min(-fitted[i], -fitted[i + 1]) - below
                least = min(least, max(first, second))
            new = (0.5 * (most - least) + ROUNDING * (sum_q + absolute) + 0.5 * e + 2.0 * slack) * _UP
            bottom = low - e - r
            top = high + e + r
            line = top / (top - bottom)
            line_error = (0.5 * line * -bottom + 4.0 * slack) * _UP
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
            size[b, j] = (sum_q + kept * e + new) * _UP
            box[b, j] *= _UP
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
