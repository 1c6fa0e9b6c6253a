"""The ReLU of `ns_abstract.methods.nerf.zonotope` for one parameter, compiled: 32 neurons side by side.

The grid is symmetric and ``T_k(-p) = (-1)^k T_k(p)``, so even and odd degrees are summed on one half of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.chebyshev import ChebyshevBasis
from ns_abstract.arithmetic.rounding import CHEBYSHEV_ROUNDING, FIELD_UP, LEAST_SLOPE, RELU_ROUNDING
from ns_abstract.arithmetic.simd.intrinsics import pointer
from ns_abstract.arithmetic.simd.lanes import LINE, load_line, maximum, minimum, store
from ns_abstract.arithmetic.simd.products import ROWS, rows_from, store_rows, sums_of_rows

#: Neurons side by side.
LANES = 32


class FitGrid(NamedTuple):
    """The first half of a symmetric grid of g points, its middle included, and how a polynomial is fitted there.

    Attributes:
        points: (g + 1) / 2.
        even, odd: Values [points, .] of the basis' even and odd degrees.
        fit_even, fit_odd: The fit [., points] of even and odd degrees.
        order: 0, 1, 2, ..., for as many as these matrices have columns.
        chord: [m].
        norming: See `ChebyshevBasis.norming`.
    """

    points: int
    even: np.ndarray
    odd: np.ndarray
    fit_even: np.ndarray
    fit_odd: np.ndarray
    order: np.ndarray
    chord: np.ndarray
    norming: float


class ReluInput(NamedTuple):
    """B pieces before an activation; see `PreActivation`.

    Attributes:
        poly: [B, m, n] coefficients; replaced for unstable neurons, and for failed pieces. Inactive neurons keep their
            own: their size is 0.
        sums: [B, n] sums of absolute columns.
        box: [B, n]; replaced.
        failed, count: [B].
    """

    poly: np.ndarray
    sums: np.ndarray
    box: np.ndarray
    failed: np.ndarray
    count: np.ndarray


class ReluOutput(NamedTuple):
    """B pieces behind an activation; see `PostActivation`.

    Attributes:
        slope: [B, n] factor of the columns.
        size, spread: [B, n] sums of absolute coefficients and columns, and of columns alone.
        failed, count: [B].
        piece, neuron, error: [B n] piece, neuron and size of the new error terms, piece by piece; only the first are
            used.
    """

    slope: np.ndarray
    size: np.ndarray
    spread: np.ndarray
    failed: np.ndarray
    count: np.ndarray
    piece: np.ndarray
    neuron: np.ndarray
    error: np.ndarray


def grid_of(basis: ChebyshevBasis) -> FitGrid:
    """Return the grid of a ``basis`` of one variable, whose ``grid`` is even."""
    points = basis.grid // 2 + 1
    values, fit = basis.evaluation[:points], basis.fit[:, :points]
    parts = values[:, 0::2], values[:, 1::2], fit[0::2], fit[1::2]
    even, odd, fit_even, fit_odd = map(np.ascontiguousarray, parts)
    return FitGrid(points, even, odd, fit_even, fit_odd, np.arange(max(points, basis.size)), basis.chord, basis.norming)


@njit(cache=True, error_model="numpy")
def _multiply(matrix, order, lanes, out):
    """Write ``out = matrix @ lanes``, [R, LANES] of [R, K] and [K, LANES]; ``order``: see `FitGrid`."""
    count, terms = matrix.shape
    factors, elements, results = pointer(matrix), pointer(lanes), pointer(out)
    places, line = pointer(order), LINE // lanes.itemsize
    out[0] = 0.0
    nothing = load_line(results, 0)
    for first in range(0, count, ROWS):
        rows = rows_from(first, count - 1, terms)
        for c in range(0, LANES, 2 * line):
            sums = sums_of_rows(factors, rows, places, terms, elements, c, LANES, line, nothing)
            store_rows(results, rows_from(first, count - 1, LANES), c, line, sums)


@njit(cache=True, error_model="numpy")
def _degrees(grid):
    """Return memory for coefficients of even and odd degrees, [., LANES]."""
    return np.empty((grid.fit_even.shape[0], LANES)), np.empty((grid.fit_odd.shape[0], LANES))


@njit(cache=True, error_model="numpy")
def _both(even, odd):
    """Return sums and differences of one line of rows."""
    a0, a1, a2, a3, a4, a5 = even
    b0, b1, b2, b3, b4, b5 = odd
    sums = a0 + b0, a1 + b1, a2 + b2, a3 + b3, a4 + b4, a5 + b5
    differences = a0 - b0, a1 - b1, a2 - b2, a3 - b3, a4 - b4, a5 - b5
    return sums, differences


@njit(cache=True, error_model="numpy")
def _on_grid(even, odd, grid, values):
    """Compute ``values`` [g, LANES] of polynomials with coefficients ``even`` and ``odd``."""
    factors, other = pointer(grid.even), pointer(grid.odd)
    terms, others, middle = grid.even.shape[1], grid.odd.shape[1], grid.points - 1
    elements, more, out, places = pointer(even), pointer(odd), pointer(values), pointer(grid.order)
    line, last = LINE // values.itemsize, LANES * (values.shape[0] - 1)
    values[0] = 0.0
    nothing = load_line(out, 0)
    for first in range(0, grid.points, ROWS):
        rows, others_rows = rows_from(first, middle, terms), rows_from(first, middle, others)
        front = p0, p1, p2, p3, p4, p5 = rows_from(first, middle, LANES)
        back = last - p0, last - p1, last - p2, last - p3, last - p4, last - p5
        for c in range(0, LANES, 2 * line):
            evens = sums_of_rows(factors, rows, places, terms, elements, c, LANES, line, nothing)
            odds = sums_of_rows(other, others_rows, places, others, more, c, LANES, line, nothing)
            (sums, less), (sums_next, less_next) = _both(evens[0], odds[0]), _both(evens[1], odds[1])
            # the middle of the grid is its own mirror; odd polynomials vanish there
            store_rows(out, back, c, line, (less, less_next))
            store_rows(out, front, c, line, (sums, sums_next))


@njit(cache=True, error_model="numpy")
def _gather(poly, which, neuron, even, odd):
    """Copy the coefficients of neurons ``neuron`` of pieces ``which`` to ``even`` and ``odd``; spare lanes are 0."""
    (_, m, n), flat, places = poly.shape, poly.reshape(-1), np.empty(LANES, np.int64)
    for c in range(which.shape[0]):
        places[c] = which[c] * m * n + neuron[c]
    for k in range(m):
        rows = odd if k % 2 else even
        for c in range(which.shape[0]):
            rows[k // 2, c] = flat[places[c] + k * n]
        for c in range(which.shape[0], LANES):
            rows[k // 2, c] = 0.0


@njit(cache=True, error_model="numpy")
def _absolute(even, odd, out):
    """Compute sums ``out`` [LANES] of absolute coefficients."""
    evens, odds, sums = pointer(even), pointer(odd), pointer(out)
    for c in range(0, LANES, LINE // out.itemsize):
        total = abs(load_line(evens, c))
        for k in range(1, even.shape[0]):
            total = total + abs(load_line(evens, LANES * k + c))
        for k in range(odd.shape[0]):
            total = total + abs(load_line(odds, LANES * k + c))
        store(sums, c, total)


@njit(cache=True, error_model="numpy")
def _certain(poly, rho, box, failed, slope, size, which, neuron):
    """Find the signs that the sums of coefficients decide; return the number of the others (``which``, ``neuron``).

    See `_relax_unstable` for the arguments; ``size`` is that of an active neuron where the sign is open.
    """
    pieces, m, n = poly.shape
    spread = np.empty(n)
    undecided = 0
    for b in range(pieces):
        if failed[b]:
            slope[b], size[b], box[b] = 0.0, 0.0, 0.0
            continue
        spread[:] = 0.0
        for k in range(1, m):
            for j in range(n):
                spread[j] += abs(poly[b, k, j])
        for j in range(n):
            radius = (spread[j] * FIELD_UP + rho[b, j] + box[b, j]) * FIELD_UP
            middle = poly[b, 0, j]
            slope[b, j] = 1.0
            size[b, j] = (abs(middle) + spread[j] + rho[b, j]) * FIELD_UP
            if middle >= radius:
                continue
            if middle <= -radius:
                slope[b, j] = size[b, j] = box[b, j] = 0.0
                continue
            which[undecided] = b
            neuron[undecided] = j
            undecided += 1
    return undecided


@njit(cache=True, error_model="numpy")
def _ranges(values, absolute, norming, low, high):
    """Compute ranges ``low`` and ``high`` [LANES] of polynomials from their values on the grid (design.md, F2)."""
    elements, sums, lows, highs = pointer(values), pointer(absolute), pointer(low), pointer(high)
    for c in range(0, LANES, LINE // values.itemsize):
        least = most = load_line(elements, c)
        for i in range(1, values.shape[0]):
            v = load_line(elements, LANES * i + c)
            least, most = minimum(least, v), maximum(most, v)
        # what is not a number may be passed over above, but not in the sum of absolute coefficients
        centre = 0.5 * (least + most)
        width = 0.5 * (most - least) * norming + CHEBYSHEV_ROUNDING * load_line(sums, c)
        store(lows, c, centre - width)
        store(highs, c, centre + width)


@njit(cache=True, error_model="numpy")
def _decide(poly, rho, box, grid, slope, size, which, neuron, found, low, high):
    """Settle neurons whose polynomials have a certain sign; return the number of the others, which are kept.

    ``low`` and ``high`` [.] receive the ranges of the others. NaN stays undecided, and fails in `relu`. See `_certain`.
    """
    even, odd = _degrees(grid)
    values = np.empty((2 * grid.points - 1, LANES))
    absolute, least, most = np.empty(LANES), np.empty(LANES), np.empty(LANES)
    left = 0
    for first in range(0, found, LANES):
        past = min(first + LANES, found)
        _gather(poly, which[first:past], neuron[first:past], even, odd)
        _absolute(even, odd, absolute)
        _on_grid(even, odd, grid, values)
        _ranges(values, absolute, grid.norming, least, most)
        for c in range(past - first):
            b, j = which[first + c], neuron[first + c]
            rest = rho[b, j] + box[b, j]
            if least[c] >= rest:
                continue
            if most[c] <= -rest:
                slope[b, j] = size[b, j] = box[b, j] = 0.0
                continue
            which[left], neuron[left] = b, j
            low[left], high[left] = least[c], most[c]
            left += 1
    return left


@njit(cache=True, error_model="numpy")
def _series(values, grid, sum_even, sum_odd, even, odd):
    """Compute coefficients ``even`` and ``odd`` of the fit to the positive parts of ``values`` [g, LANES]."""
    elements, evens, odds, last = pointer(values), pointer(sum_even), pointer(sum_odd), values.shape[0] - 1
    middle = grid.points - 1
    for c in range(0, LANES, LINE // values.itemsize):
        for i in range(middle):
            left = maximum(0.0, load_line(elements, LANES * i + c))
            right = maximum(0.0, load_line(elements, LANES * (last - i) + c))
            store(evens, LANES * i + c, left + right)
            store(odds, LANES * i + c, left - right)
        # the middle of the grid stands for itself
        store(evens, LANES * middle + c, maximum(0.0, load_line(elements, LANES * middle + c)))
    sum_odd[middle] = 0.0
    _multiply(grid.fit_even, grid.order, sum_even, even)
    _multiply(grid.fit_odd, grid.order, sum_odd, odd)


@njit(cache=True, error_model="numpy")
def _chords(even, odd, even_q, odd_q, chord, above, below):
    """Compute distances [LANES] of ``p - q`` and ``q`` from their chords on the grid."""
    evens, odds, evens_q, odds_q = pointer(even), pointer(odd), pointer(even_q), pointer(odd_q)
    over, under = pointer(above), pointer(below)
    for c in range(0, LANES, LINE // even.itemsize):
        # a constant is its own chord
        q = load_line(odds_q, c)
        u, v = abs(q) * chord[1], abs(load_line(odds, c) - q) * chord[1]
        for k in range(2, chord.shape[0]):
            at = LANES * (k // 2) + c
            q = load_line(odds_q, at) if k % 2 else load_line(evens_q, at)
            p = load_line(odds, at) if k % 2 else load_line(evens, at)
            u, v = u + abs(q) * chord[k], v + abs(p - q) * chord[k]
        store(under, c, u)
        store(over, c, v)


@njit(cache=True, error_model="numpy")
def _errors(values, fitted, above, below, least, most):
    """Compute ends ``least``, ``most`` [LANES] of ``max(0, p) - q`` from p and q on the grid (design.md, F5)."""
    elements, fits, over, under = pointer(values), pointer(fitted), pointer(above), pointer(below)
    lows, highs = pointer(least), pointer(most)
    for c in range(0, LANES, LINE // values.itemsize):
        a, b = load_line(over, c), load_line(under, c)
        p, q = load_line(elements, c), load_line(fits, c)
        high, left = maximum(0.0, p) - q, p - q
        low = high
        for i in range(1, values.shape[0]):
            p, r = load_line(elements, LANES * i + c), load_line(fits, LANES * i + c)
            right = p - r
            high = maximum(high, maximum(0.0, p) - r)
            between = maximum(minimum(left, right) - a, -maximum(q, r) - b)
            low = between if i == 1 else minimum(low, between)
            left, q = right, r
        store(lows, c, low)
        store(highs, c, high + maximum(a, b))


@njit(cache=True, error_model="numpy")
def _relax_unstable(poly, rho, box, failed, grid, slope, size, which, neuron, error):
    """Relax the unstable neurons of a layer in place, and return the number of new error terms.

    Args as for `relu`, besides: rho: [B, n] each neuron's sum of absolute error coefficients. which, neuron, error:
    piece, neuron and radius of each new error term; overwritten.
    """
    undecided = _certain(poly, rho, box, failed, slope, size, which, neuron)
    lows, highs = np.empty(undecided), np.empty(undecided)
    undecided = _decide(poly, rho, box, grid, slope, size, which, neuron, undecided, lows, highs)
    m, points = poly.shape[1], grid.points
    (even, odd), (even_q, odd_q) = _degrees(grid), _degrees(grid)
    sum_even, sum_odd = np.empty((points, LANES)), np.empty((points, LANES))
    values, fitted = np.empty((2 * points - 1, LANES)), np.empty((2 * points - 1, LANES))
    absolute, absolute_q, above = np.empty(LANES), np.empty(LANES), np.empty(LANES)
    below, least, most = np.empty(LANES), np.empty(LANES), np.empty(LANES)
    for first in range(0, undecided, LANES):
        past = min(first + LANES, undecided)
        _gather(poly, which[first:past], neuron[first:past], even, odd)
        _absolute(even, odd, absolute)
        _on_grid(even, odd, grid, values)
        _series(values, grid, sum_even, sum_odd, even_q, odd_q)
        _absolute(even_q, odd_q, absolute_q)
        _on_grid(even_q, odd_q, grid, fitted)
        _chords(even, odd, even_q, odd_q, grid.chord, above, below)
        _errors(values, fitted, above, below, least, most)
        for c in range(past - first):
            b, j = which[first + c], neuron[first + c]
            e, r, slack = rho[b, j], box[b, j], CHEBYSHEV_ROUNDING * absolute[c]
            new = 0.5 * (most[c] - least[c]) + CHEBYSHEV_ROUNDING * (absolute_q[c] + absolute[c])
            new = (new + 0.5 * e + 2.0 * slack) * FIELD_UP
            bottom, top = lows[first + c] - e - r, highs[first + c] + e + r
            line = max(top / (top - bottom), LEAST_SLOPE)
            line_error = (0.5 * line * -bottom + 4.0 * slack) * FIELD_UP
            slope_part, shift, total = 0.5, 0.5 * (most[c] + least[c]), 0.0
            by_line = line_error + line * r < new + r
            if by_line:
                slope_part, shift, new = line, 0.5 * line * -bottom, line_error
                box[b, j] = r * line
            evens, odds, factor = (even, odd, line) if by_line else (even_q, odd_q, 1.0)
            for k in range(0, m, 2):
                q = factor * evens[k // 2, c]
                if k == 0:
                    q += shift
                poly[b, k, j] = q
                total += abs(q)
                if k + 1 < m:
                    q = factor * odds[k // 2, c]
                    poly[b, k + 1, j] = q
                    total += abs(q)
            new += RELU_ROUNDING * (total + e)
            slope[b, j] = slope_part
            size[b, j] = (total + slope_part * e + new) * FIELD_UP
            box[b, j] *= FIELD_UP
            error[first + c] = new
    return undecided


@njit(cache=True, error_model="numpy")
def relu(z, grid, limit, out):
    """Compute max(0, z) in place (design.md, F5); return the number of new error terms.

    ``limit``: largest number of error terms of a piece, beyond which it fails. ``out``: `ReluOutput`, filled.
    """
    # arrays of a record are counted each time they are taken out of it
    poly, sums, box, old_failed, old_count = z
    slope, size, spread, failed, count, piece, neuron, error = out
    pieces, n = sums.shape
    rho = sums * FIELD_UP
    new_terms = _relax_unstable(poly, rho, box, old_failed, grid, slope, size, piece, neuron, error)
    for b in range(pieces):
        count[b] = old_count[b]
        for j in range(n):
            spread[b, j] = rho[b, j] * slope[b, j]
    for i in range(new_terms):
        spread[piece[i], neuron[i]] += error[i]
        count[piece[i]] += 1
    for b in range(pieces):
        fails = old_failed[b] or count[b] > limit
        for j in range(n):
            spread[b, j] *= FIELD_UP
            fails |= not math.isfinite(size[b, j])
        failed[b] = fails
        if fails:
            poly[b], box[b], size[b], spread[b] = 0.0, 0.0, 0.0, 0.0
    return new_terms
