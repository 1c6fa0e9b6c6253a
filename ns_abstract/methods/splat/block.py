"""What the pixel stage keeps of a block of pixels, and where (design.md, B1-B9).

A layer is one Gaussian on one pixel: what is known of its alpha, and of the light before and behind it. Layers lie one
after the other; each pixel lists those that may contribute to it, nearest first, with the places of their colours in a
palette and of the rows that tell how far reordering may move them.
"""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.lanes import bits, maximum, minimum, where
from ns_abstract.arithmetic.units import UNIT64
from ns_abstract.methods.splat.lists import BLOCK, PIXELS

assert PIXELS == 64 and BLOCK == 8

ROUND = 16.0 * UNIT64
UP = 1.0 + 128.0 * UNIT64

# Scratch is flat: row r holds its lanes at r * PIXELS .. r * PIXELS + PIXELS - 1, one by pixel.
(
    C1, C2, L1, L2, B1, B2, S0, SR, SL, SB, SLO, SHI, WEIGHT, CURVE,
    TLO, THI, REACH, RHO, LOST, OPEN, MIN, MAX, NUMBERS,
) = range(0, 23 * PIXELS, PIXELS)  # fmt: skip
ROWS = 23
#: Columns of a layer: bounds of alpha, transmittance behind it at its least and before it at its most, alpha's
#: coefficients and then its radius.
ALPHA_LOW, ALPHA_HIGH, LEFT, LIGHT, FORM = range(5)
#: Columns of an entry of a pixel's list: the layer's number, its list position, its row of moves; one is spare.
LISTED = 4
#: Columns of a row of moves: by how much reordering may lower and raise the pixel, found from sums and from maxima.
MOVES = 16


@njit(cache=True, error_model="numpy", forceinline=True)
def parabola(slope, bend):
    """Range of +-slope p + bend p^2 over p in [-1, 1], up to rounding, of lanes (design.md, A4)."""
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
    """The largest of the pixels' ``lengths``."""
    longest = 0
    for q in range(PIXELS):
        longest = max(longest, int(lengths[q]))
    return longest


@njit(cache=True, error_model="numpy", forceinline=True)
def set_unknown(layers, at, high, m):
    """Let the layer at ``at`` have any alpha from 0 to ``high``."""
    layers[at + ALPHA_LOW] = 0.0
    layers[at + ALPHA_HIGH] = high
    layers[at + FORM] = 0.5 * high
    for k in range(1, m):
        layers[at + FORM + k] = 0.0
    layers[at + FORM + m] = 0.5 * high * UP


@njit(cache=True, error_model="numpy", inline="always")
def color_size(forms):
    """Numbers of one colour of the palette."""
    return 4 * (forms + 3)


@njit(cache=True, error_model="numpy", inline="always")
def color_ends(forms):
    """Where in a colour of the palette its lower bound stands, before its upper one."""
    return 4 * (forms + 1)


@njit(cache=True, error_model="numpy", forceinline=True)
def listed_layer(lists, entry, width, forms):
    """Where a pixel's layer stands, its colour in the palette and its row of moves (0: none)."""
    at = LISTED * entry
    return int(lists[at]) * width, int(lists[at + 1]) * color_size(forms), MOVES * int(lists[at + 2])
