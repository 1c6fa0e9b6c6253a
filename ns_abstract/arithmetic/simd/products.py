"""Products of small matrices, four rows at a time, by explicit vectors (design.md, F4).

Each sum is of its products in their order, every product added by `muladd`: what is charged for sums in any order, with
roundings of products and sums apart, covers it.
"""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.simd.lanes import load_line, muladd

#: Rows of a product that are worked on together.
ROWS = 4


@njit(cache=True, error_model="numpy")
def four_rows(factors, first, lines, count, elements, at, stride, begin):
    """``begin + sum_i factors[first + 4 i + r] elements[at + stride lines[i] : ...]``, i < ``count``, r = 0, ..., 3.

    Args:
        factors, lines, elements: `intrinsics.pointer`; factors and elements of one type.
        first: Where the factors begin.
        count: Number of terms.
        at, stride: Where the line of `lanes.LINE` bytes that is numbered 0 lies among the elements, and how far on each
            next one does.
        begin: Lanes.
    """
    t0, t1, t2, t3 = begin, begin, begin, begin
    for i in range(count):
        x = load_line(elements, at + stride * lines[i])
        t0 = muladd(factors[first], x, t0)
        t1 = muladd(factors[first + 1], x, t1)
        t2 = muladd(factors[first + 2], x, t2)
        t3 = muladd(factors[first + 3], x, t3)
        first += ROWS
    return t0, t1, t2, t3
