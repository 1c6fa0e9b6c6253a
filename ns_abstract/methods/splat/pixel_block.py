"""The memory layout of a block of pixels in the pixel stage (docs/dev/design.md, B1-B12).

A fragment is one Gaussian on one pixel, with its alpha and the light before and behind it. Fragments are stored one
after the other. Each pixel lists those that may contribute to it, nearest first, with the places of their colours in a
palette, and of the rows that bound the effect of reordering. `Buffers` own the memory; kernels are given a
`PixelBlock`, with pointers in place of arrays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import UP
from ns_abstract.arithmetic.simd.lanes import bits, maximum, minimum, where
from ns_abstract.methods.splat.lists import BLOCK, PIXELS

assert PIXELS == 64 and BLOCK == 8


#: Lanes that are looked at together where they are fragments of one pixel.
CROSSING_LANES = 8
#: List entries that are looked at together: no step waits for the one before.
BATCH = 8

# What is known of each pixel lies in flat rows: row r holds its lanes at r * PIXELS .. r * PIXELS + PIXELS - 1. Light
# that passes the fragments listed so far at its least and most; last list position that may still change places; what
# a stop that is ignored may hide, and what any stop so far may leave; light that comes to what is missing; what stops
# at fragments of uncertain order may leave; 0, 1, 2, ...
TLO, THI, LAST, RHO, LOST, OPEN, HIDDEN, NUMBERS = range(0, 8 * PIXELS, PIXELS)
ROWS = 8
#: Columns of a fragment: bounds of alpha, middle and half-width of the range of its curvature, alpha's coefficients and
#: then its radius; where curvature is kept (B10), coefficients of products of two parameters follow, and the alpha up
#: to which the fragment may be skipped, or 0 (`crossing_column`).
ALPHA_LOW, ALPHA_HIGH, BEND, BEND_SPREAD, FORM = range(5)
#: Where the ends of single parts begin in `PixelBlock.part_ends`.
PART_ENDS = 16
#: Where pixels are bounded over parts of the cell (B12), a fragment is bounds of alpha and then: centres of y1 and y2,
#: their slopes, parameter by parameter, their radii over a part; alpha at exponent 0, at its least and its most; and
#: the alpha below which the fragment may be skipped, and the exponent beyond which it is.
EXPONENT = 2
#: Exponents are cut here; exp(-60) is far below any threshold.
EXPONENT_CUT = 60.0
#: What a list tells of the light at a fragment: behind it at its least, before it at its most.
LEFT, LIGHT = range(2)
#: Columns of an entry of a pixel's list: the fragment's number, its list position, its row of moves; one is spare.
LISTED = 4
#: Columns of a row of moves: by how much reordering may lower and raise the pixel, found from sums and from maxima.
MOVES = 16
#: Rows of `ThresholdCrossings` before the forms, and beside the slopes of their restrictions to a part of the box.
CROSSING_FORM, CROSSING_RESTRICTED = 11, 13


class BlockPlace(NamedTuple):
    """A block's first pixel in the picture, its tile's column and row, and the set of its requested pixels."""

    x0: int
    y0: int
    tile_x: int
    tile_y: int
    wanted: int


@njit(cache=True, error_model="numpy", forceinline=True)
def block_place(tile_x, tile_y, b, side, wanted):
    """Return the `BlockPlace` of block ``b``, row by row, of a tile of ``side`` pixels."""
    blocks = side // BLOCK
    x0, y0 = tile_x * side + (b % blocks) * BLOCK, tile_y * side + (b // blocks) * BLOCK
    return BlockPlace(x0, y0, tile_x, tile_y, wanted)


class Fragments(NamedTuple):
    """The fragments of a block's pixels.

    Attributes:
        values: [PIXELS capacity, width] fragments; the columns are ALPHA_LOW .. FORM + m, and ``bends`` more.
        width: Numbers of a fragment.
        bends: Number of coefficients of products of two parameters beside forms of order 1.
        crossing: See `crossing_column`.
        parts: Parts of the cell over which pixels are bounded; 0: fragments have forms.
        lists: [PIXELS, capacity, LISTED] each pixel's fragments, nearest first.
        light: [PIXELS, capacity, 2] the transmittance at each: see `LEFT`.
        lengths: [PIXELS] of the lists.
        capacity: Largest length of a list.
        per_pixel: [ROWS, PIXELS] further numbers of each pixel.
    """

    values: np.ndarray
    width: int
    bends: int
    crossing: int
    parts: int
    lists: np.ndarray
    light: np.ndarray
    lengths: np.ndarray
    capacity: int
    per_pixel: np.ndarray


class Palette(NamedTuple):
    """Colours of a block's list; each has rows of three channels and one of the depth, if that is requested.

    Attributes:
        values: [entries, forms + 3, 4] coefficients, radius, lower and upper bound over the cell.
        forms: Coefficients of a colour.
        background: [4].
        unseen: [2, 4] darkest and brightest colour of omitted fragments.
    """

    values: np.ndarray
    forms: int
    background: np.ndarray
    unseen: np.ndarray


class ListEntries(NamedTuple):
    """Properties of each position of a block's list; [entries] all.

    Attributes:
        pixels: The set of the block's pixels that may be reached; valid where ``has_pixels`` is 1.
        has_pixels: Whether ``pixels`` was found.
        depth_radius: Largest motion in depth of the Gaussian relative to the block's central ray (O1).
        depth: At the cell's middle.
        far: Positions that move further than most, in order; later the group of a position (O4).
        first, last: Nearest and farthest position whose depth order against this one is open, or itself.
    """

    pixels: np.ndarray
    has_pixels: np.ndarray
    depth_radius: np.ndarray
    depth: np.ndarray
    far: np.ndarray
    first: np.ndarray
    last: np.ndarray


class Reordering(NamedTuple):
    """The fragments of a block that may change their order. A list position with such fragments has a slot.

    Attributes:
        pairs: [pair_limit, 2] list positions of open order, the nearer at the middle first.
        pair_limit: Largest number of pairs.
        slots: [entries] number of a position's slot; -1: its order is certain.
        owners: [slots] list positions.
        drawn: [2 capacity] the set of pixels on which a slot is drawn.
        places: [2 capacity, PIXELS] a slot's place in their lists.
        moves: [32 capacity, MOVES] see `MOVES`; row 0 is for fragments of certain order.
    """

    pairs: np.ndarray
    pair_limit: int
    slots: np.ndarray
    owners: np.ndarray
    drawn: np.ndarray
    places: np.ndarray
    moves: np.ndarray


class ThresholdCrossings(NamedTuple):
    """Fragments of one pixel whose alpha crosses the threshold within the cell (B11), farthest first.

    Attributes:
        entries: [capacity] their places in the pixel's list.
        distances: [capacity, 8] by channel, the least, then the greatest of its colour minus the colour behind it.
        rows: [R, room] numbers of each, in the R rows that `threshold_crossings` lists.
        room: Length of rows, whole lanes.
    """

    entries: np.ndarray
    distances: np.ndarray
    rows: np.ndarray
    room: int


class FragmentBatch(NamedTuple):
    """Scratch for `BATCH` list positions on the pixels that they may reach, one position after the other.

    Attributes:
        offset_x, offset_y: [BATCH PIXELS] pixel centre minus mean, pixels.
        pixels: [BATCH PIXELS] numbers of the pixels.
        begins: [BATCH + 1] where the pixels of each position begin.
        found: [BATCH] the set of those of its pixels on which alpha may reach the threshold.
        rows: [width + 2 m, 8] columns of eight fragments, then scratch.
    """

    offset_x: np.ndarray
    offset_y: np.ndarray
    pixels: np.ndarray
    begins: np.ndarray
    found: np.ndarray
    rows: np.ndarray


class PixelBlock(NamedTuple):
    """A block as kernels take it: pointers to `Buffers`.

    Attributes:
        shifted: Depths of one pixel's list relative to its own reference (see `depths`).
        part_ends: Over parts of the cell: least and largest of the channels [2, 4], scratch, and from `PART_ENDS` on
            the least of three channels and the largest in each part or sub-box [6, parts]; then scratch for a list's
            alphas.
        sums: [3 m + bends + 5, 4] scratch by channel: polynomials, then scratch of `blend` and `depths`.
        ray: [3] the block's central ray at the cell's middle, world axes, of unit depth.
        motion: [4, d, PIXELS] the pixels' `MotionCells.motion`, where parts are those of the image motion.
    """

    fragments: Fragments
    palette: Palette
    shifted: Palette
    entries: ListEntries
    reordering: Reordering
    batch: FragmentBatch
    crossings: ThresholdCrossings
    part_ends: np.ndarray
    sums: np.ndarray
    ray: np.ndarray
    motion: np.ndarray


@njit(cache=True, error_model="numpy", inline="always")
def part_axes(shape):
    """Return the number of axes that the parts of a cell divide."""
    return 2 if shape.by_motion else shape.dimensions


@njit(cache=True, error_model="numpy", forceinline=True)
def take_motion(place, inputs, block):
    """Set the motion of the pixels at ``place``, where parts are those of the image motion (design.md, B16)."""
    if not inputs.shape.by_motion:
        return
    width, height, numbers = int(inputs.intrinsics.width), int(inputs.intrinsics.height), 4 * inputs.shape.dimensions
    side = inputs.parts.side
    across = (width + side - 1) // side
    for q in range(PIXELS):
        # no pixel beyond the picture is wanted
        column, row = min(place.x0 + q % BLOCK, width - 1), min(place.y0 + q // BLOCK, height - 1)
        for k in range(numbers):
            block.motion[k * PIXELS + q] = inputs.parts.motion[numbers * (row // side * across + column // side) + k]


@njit(cache=True, error_model="numpy")
def bends_of(shape):
    """Return the number of coefficients of products of two parameters beside the Gaussians' forms (design.md, B10)."""
    return 0 if shape.order == 2 else shape.dimensions * (shape.dimensions + 1) // 2


@njit(cache=True, error_model="numpy")
def fragment_width(shape):
    """Return the numbers of a fragment with forms of ``shape``: whole cache lines."""
    if shape.parts > 0:
        return -(-(exponent_limit(shape) + 1) // 8) * 8
    return -(-max(FORM + shape.monomials + 1 + bends_of(shape), crossing_column(shape) + 1) // 8) * 8


@njit(cache=True, error_model="numpy", inline="always")
def exponent_ends(m):
    """Return the column in a fragment of the radii behind the exponent's slopes, see `EXPONENT`."""
    return EXPONENT + 2 * m


@njit(cache=True, error_model="numpy", inline="always")
def exponent_limit(shape):
    """Return a fragment's column of the exponent beyond which its alpha is below the threshold (B4); see `EXPONENT`."""
    return exponent_ends(shape.monomials) + 5


@njit(cache=True, error_model="numpy")
def crossing_column(shape):
    """Return the column in a fragment of the alpha up to which it may be skipped; it differs for one parameter."""
    return BEND if shape.order == 2 else FORM + shape.monomials + 1 + bends_of(shape)


@njit(cache=True, error_model="numpy")
def crossing_rows(shape):
    """Return the number of rows of `ThresholdCrossings` (see `threshold_crossings`)."""
    d = shape.dimensions
    return CROSSING_FORM + 1 + 2 * d + d * (d + 1) // 2 + CROSSING_RESTRICTED


@njit(cache=True, error_model="numpy", forceinline=True)
def parabola(slope, bend):
    """Return the range of +-slope p + bend p^2 over p in [-1, 1], up to rounding, by lane (design.md, A4)."""
    bottom, top = bend - slope, bend + slope
    # the vertex counts where it lies inside [-1, 1]
    inside = slope < 2.0 * abs(bend)
    if bits(inside) != 0:
        vertex = -0.25 * (slope * slope) / where(bend != 0.0, bend, 1.0)
        bottom = where(inside, minimum(bottom, vertex), bottom)
        top = where(inside, maximum(top, vertex), top)
    return bottom, top


@njit(cache=True, error_model="numpy", forceinline=True)
def longest_list(lengths):
    """Return the largest of the pixels' ``lengths``."""
    longest = 0
    for q in range(PIXELS):
        longest = max(longest, int(lengths[q]))
    return longest


@njit(cache=True, error_model="numpy", forceinline=True)
def set_unknown(fragments, at, high, m):
    """Let the fragment at ``at`` have any alpha from 0 to ``high``."""
    values = fragments.values
    values[at + ALPHA_LOW] = 0.0
    values[at + ALPHA_HIGH] = high
    if fragments.parts > 0:
        for k in range(EXPONENT, exponent_ends(m)):
            values[at + k] = 0.0
        ends = at + exponent_ends(m)
        values[ends], values[ends + 1] = 0.0, 0.0
        values[ends + 2], values[ends + 3], values[ends + 4], values[ends + 5] = (0.0, 1.0, 0.0, EXPONENT_CUT)
        return
    for k in range(FORM + m + 1, FORM + m + 1 + fragments.bends):
        values[at + k] = 0.0
    values[at + BEND] = 0.0
    values[at + BEND_SPREAD] = 0.0
    values[at + fragments.crossing] = 0.0
    values[at + FORM] = 0.5 * high
    for k in range(1, m):
        values[at + FORM + k] = 0.0
    values[at + FORM + m] = 0.5 * high * UP


@njit(cache=True, error_model="numpy", forceinline=True)
def crossing_of(fragments, at):
    """Return the largest fall of alpha by skipping the fragment at ``at``; half of it is in its form (B4, B11)."""
    return min(fragments.values[at + fragments.crossing], fragments.values[at + ALPHA_HIGH])


@njit(cache=True, error_model="numpy", inline="always")
def color_size(forms):
    """Return the count of numbers of one colour of the palette."""
    return 4 * (forms + 3)


@njit(cache=True, error_model="numpy", inline="always")
def color_ends(forms):
    """Return the place in a colour of the palette of its lower bound, which the upper one follows."""
    return 4 * (forms + 1)


@njit(cache=True, error_model="numpy", forceinline=True)
def listed_fragment(fragments, entry, forms):
    """Return the places of a pixel's fragment, of its colour in the palette and of its row of moves (0: none)."""
    lists, at = fragments.lists, LISTED * entry
    return (int(lists[at]) * fragments.width, int(lists[at + 1]) * color_size(forms), MOVES * int(lists[at + 2]))
