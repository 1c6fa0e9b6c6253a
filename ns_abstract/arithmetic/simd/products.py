"""Products of small matrices, six rows by two lines at a time, by explicit vectors (design.md, F4).

Each sum is of its products in their order, added by `muladd`: what is charged for sums in any order, with roundings of
products and sums apart, covers it. Twelve sums are under way at a time, and each element loaded serves six of them.
"""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.simd.lanes import load_line, muladd, store

#: Rows of a product that are worked on together.
ROWS = 6


@njit(cache=True, error_model="numpy")
def sums_of_rows(factors, rows, places, count, elements, at, stride, line, begin):
    """``begin + sum_i factors[rows[r] + places[i]] elements[at + stride places[i] : ...]``, r = 0, ..., `ROWS` - 1.

    Args:
        factors, places, elements: `intrinsics.pointer`; factors and elements of one type.
        rows: Where the rows of factors begin.
        count: Number of terms.
        at, stride: Where the two lines of `lanes.LINE` bytes that are numbered 0 lie among the elements, side by side,
            and how far on each next pair does.
        line: Elements of a line.
        begin: Lanes.

    Returns:
        The sums of the first line's rows, then of the second's.
    """
    r0, r1, r2, r3, r4, r5 = rows
    s0, s1, s2, s3, s4, s5 = begin, begin, begin, begin, begin, begin
    t0, t1, t2, t3, t4, t5 = begin, begin, begin, begin, begin, begin
    for i in range(count):
        k = places[i]
        x, y = load_line(elements, at + stride * k), load_line(elements, at + stride * k + line)
        f0, f1, f2 = factors[r0 + k], factors[r1 + k], factors[r2 + k]
        f3, f4, f5 = factors[r3 + k], factors[r4 + k], factors[r5 + k]
        s0, t0 = muladd(f0, x, s0), muladd(f0, y, t0)
        s1, t1 = muladd(f1, x, s1), muladd(f1, y, t1)
        s2, t2 = muladd(f2, x, s2), muladd(f2, y, t2)
        s3, t3 = muladd(f3, x, s3), muladd(f3, y, t3)
        s4, t4 = muladd(f4, x, s4), muladd(f4, y, t4)
        s5, t5 = muladd(f5, x, s5), muladd(f5, y, t5)
    return (s0, s1, s2, s3, s4, s5), (t0, t1, t2, t3, t4, t5)


@njit(cache=True, error_model="numpy")
def _store_line(out, rows, at, sums):
    """Write the line of each row r to ``out[rows[r] + at : ...]``."""
    s0, s1, s2, s3, s4, s5 = sums
    p0, p1, p2, p3, p4, p5 = rows
    store(out, p0 + at, s0)
    store(out, p1 + at, s1)
    store(out, p2 + at, s2)
    store(out, p3 + at, s3)
    store(out, p4 + at, s4)
    store(out, p5 + at, s5)


@njit(cache=True, error_model="numpy")
def store_rows(out, rows, at, line, sums):
    """Write what `sums_of_rows` returns: row r to ``out[rows[r] + at : ...]`` of a `intrinsics.pointer`."""
    first, second = sums
    _store_line(out, rows, at, first)
    _store_line(out, rows, at + line, second)


@njit(cache=True, error_model="numpy")
def rows_from(first, last, width):
    """Return the offsets of `ROWS` rows of ``width`` numbers from ``first`` on; row ``last`` fills up the rest."""
    return (
        first * width, min(first + 1, last) * width, min(first + 2, last) * width, min(first + 3, last) * width,
        min(first + 4, last) * width, min(first + 5, last) * width,
    )  # fmt: skip
