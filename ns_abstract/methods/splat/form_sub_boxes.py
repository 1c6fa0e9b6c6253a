"""Bounds of a pixel's polynomial over equal sub-boxes of the cell (design.md, B13)."""

from __future__ import annotations

from numba import njit

from ns_abstract.arithmetic.simd.intrinsics import offset_by
from ns_abstract.methods.splat.pixel_block import CROSSING_LANES, PART_ENDS
from ns_abstract.methods.splat.threshold_crossings import (
    bound_part,
    crossing_columns,
    crossing_scratch,
    foretell,
    restrict,
    set_planes,
)


@njit(cache=True, error_model="numpy", forceinline=True)
def _undecided(foretold, levels):
    """Return whether one of ``levels`` lies between a channel's ends in ``foretold`` [8], or there are no levels."""
    if levels.size == 0:
        return True
    for channel in range(3):
        for k in range(levels.size):
            if -foretold[channel] <= levels[k] <= foretold[4 + channel]:
                return True
    return False


@njit(cache=True, error_model="numpy")
def bound_sub_boxes(count, limit, moved, crossings, inputs, out):
    """Write bounds of three channels over each sub-box of the cell, from the blends of `set_blend` (design.md, B13).

    ``count`` fragments may be skipped, which lowers and raises the channels by at most ``moved`` [8]; a fragment is
    surely skipped below alpha ``limit``. ``out`` is `PixelBlock.part_ends`, which receives the bounds from `PART_ENDS`
    on.
    """
    parts, d, boxes = inputs.parts, inputs.shape.dimensions, inputs.shape.sub_boxes
    columns = crossing_columns(count)
    middle = crossing_scratch(crossings, d)
    half = offset_by(middle, d)
    place = offset_by(half, d)
    bounds = offset_by(place, d)
    foretold = offset_by(bounds, 4 + 4 * d)
    for number in range(boxes):
        for k in range(d):
            middle[k], half[k] = parts.middles[boxes * k + number], parts.half[k]
        restrict(CROSSING_LANES, middle, half, crossings, d)
        foretell(foretold, moved, crossings, d)
        if count > 0 and _undecided(foretold, parts.levels):
            restrict(columns, middle, half, crossings, d)
            set_planes(columns, limit, crossings, d)
            for side in range(2):
                bound_part(columns, 1.0 if side == 1 else -1.0, place, bounds, crossings, d)
                for channel in range(3):
                    k = 4 * side + channel
                    foretold[k] = min(foretold[k], bounds[channel])
        for channel in range(3):
            out[PART_ENDS + boxes * channel + number] = -foretold[channel]
            out[PART_ENDS + boxes * (3 + channel) + number] = foretold[4 + channel]
