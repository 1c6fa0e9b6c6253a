"""Blends of one pixel's fragments that tests make up, by the compiled kernels."""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.simd.intrinsics import pointer
from ns_abstract.methods.splat.blend import blend_quadratic, blend_several
from ns_abstract.methods.splat.pixel_block import Fragments, Palette, bends_of, crossing_column, fragment_width

#: Fragments that there is room for.
CAPACITY = 64


@njit(error_model="numpy")
def blended(values_, lists_, colors_, background_, shape, forms, count, t, crossings, split):
    """The fragments of arrays, and their blend; ``t`` is a pointer and receives the polynomials."""
    values, lists, colors, background = pointer(values_), pointer(lists_), pointer(colors_), pointer(background_)
    fragments = Fragments(
        values,
        fragment_width(shape),
        bends_of(shape),
        crossing_column(shape),
        shape.parts,
        lists,
        values,
        lists,
        CAPACITY,
        values,
    )
    palette = Palette(colors, forms, background, background)
    if shape.order == 2:
        return fragments, blend_quadratic(0, count, fragments, palette, values, t, crossings, split)
    return fragments, blend_several(0, count, fragments, palette, values, t, shape.monomials, crossings, split)
