"""Pairs of Gaussians on a common pixel whose depth order is open within the cell (docs/dev/design.md, O1)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import ORDER_ROUNDING, TURN_ROOM, UP, WINDOW_ROUNDING
from ns_abstract.arithmetic.simd.intrinsics import offset_by, pointer, prefetch
from ns_abstract.methods.splat.lists import AHEAD
from ns_abstract.methods.splat.reached_pixels import pixels_at, pixels_once


class BlockList(NamedTuple):
    """A block's Gaussians, nearest first, with pointers to their `ProjectedGaussians`.

    Attributes:
        numbers: [length] the Gaussians' rows.
        columns: Columns of ``record``.
        slope: [rows, 3] see `ViewingAxes.depth`.
        tied: See `ViewingAxes.tied`.
        colors: Of Gaussians, see `Colors.values`.
        color_columns, color_rows: Columns of ``colors``, and of each channel in it.
        x0, y0: The block's first pixel.
        m: Coefficients of a form.
    """

    numbers: np.ndarray
    length: int
    record: np.ndarray
    columns: int
    box: np.ndarray
    tiles: np.ndarray
    delta: np.ndarray
    depth_error: np.ndarray
    slope: np.ndarray
    tied: bool
    colors: np.ndarray
    color_columns: int
    color_rows: int
    x0: int
    y0: int
    m: int


@njit(cache=True, error_model="numpy", forceinline=True)
def block_list(numbers, place, inputs):
    """Return the `BlockList` of the Gaussians ``numbers`` (rows of ``inputs.gaussians``) at a block's ``place``."""
    gaussians, axes, colors = inputs.gaussians, inputs.axes, inputs.colors.values
    return BlockList(
        pointer(numbers), numbers.size, pointer(gaussians.record), gaussians.record.shape[1], pointer(gaussians.box),
        pointer(gaussians.tiles), pointer(gaussians.delta), pointer(gaussians.depth_error), pointer(axes.depth),
        axes.tied, pointer(colors), colors.shape[1], colors.shape[1] // inputs.colors.channels, place.x0, place.y0,
        inputs.shape.monomials,
    )  # fmt: skip


class DepthWindow(NamedTuple):
    """The distance in depth up to which list positions may change their order (O1).

    Attributes:
        room: Positions i, j keep their order where ``room |depth_i - depth_j| > radius_i + radius_j``; if not positive,
            no order is known.
        largest: Largest `ListEntries.depth_radius` of all but the few positions in ``far``.
        far: Number of these.
        farthest: Their largest radius.
    """

    room: float
    largest: float
    far: int
    farthest: float


@njit(cache=True, error_model="numpy", forceinline=True)
def _uncertain(i, j, listed):
    """Return whether Gaussians i and j, listed in this order, may have the other order in the cell (design.md, O1).

    Depths differ by the third row of the rotation times ``delta_i - delta_j``.
    """
    delta, slope, depth_error, m = listed.delta, listed.slope, listed.depth_error, listed.m
    x = delta[3 * i] - delta[3 * j]
    y = delta[3 * i + 1] - delta[3 * j + 1]
    z = delta[3 * i + 2] - delta[3 * j + 2]
    if listed.tied and x == 0.0 and y == 0.0 and z == 0.0:
        return i > j
    center = slope[0] * x + slope[1] * y + slope[2] * z
    spread = 0.0
    for k in range(1, m):
        spread += abs(slope[3 * k] * x + slope[3 * k + 1] * y + slope[3 * k + 2] * z)
    size = abs(delta[3 * i]) + abs(delta[3 * j]) + abs(delta[3 * i + 1]) + abs(delta[3 * j + 1])
    size += abs(delta[3 * i + 2]) + abs(delta[3 * j + 2])
    rounding = ORDER_ROUNDING * size
    radius = slope[3 * m] * abs(x) + slope[3 * m + 1] * abs(y) + slope[3 * m + 2] * abs(z)
    return not (abs(center) > (spread + radius) * UP + rounding + depth_error[i] + depth_error[j])


@njit(cache=True, error_model="numpy", forceinline=True)
def _same_color(i, j, listed):
    """Return whether Gaussians i and j surely have the same colour, so that their order changes nothing (O5)."""
    first, second = (
        offset_by(listed.colors, i * listed.color_columns),
        offset_by(listed.colors, j * listed.color_columns),
    )
    for column in range(listed.color_columns):
        # a colour that moves or has a radius is not one number
        varies = column % listed.color_rows != 0 and first[column] != 0.0
        if varies or first[column] != second[column]:
            return False
    return True


@njit(cache=True, error_model="numpy", forceinline=True)
def _turn(slope, ray, m):
    """Return the largest change over the cell of the depth of a point of unit depth on ``ray`` [3] (design.md, O1)."""
    along = 0.0
    for k in range(1, m):
        along += abs(slope[k, 0] * ray[0] + slope[k, 1] * ray[1] + slope[k, 2] * ray[2])
    return along + (slope[m, 0] * abs(ray[0]) + slope[m, 1] * abs(ray[1]) + slope[m, 2] * abs(ray[2]))


@njit(cache=True, error_model="numpy", forceinline=True)
def _steadiness(along):
    """Return a lower bound of one less the exact `_turn`; a small result may be rounding alone (design.md, O1)."""
    return 1.0 - along - TURN_ROOM


@njit(cache=True, error_model="numpy")
def depth_radii(numbers, gaussians, slope, ray, m, entries):
    """Compute how far in depth each entry may move relative to the block's central ray (design.md, O1).

    Fills ``entries.depth_radius`` and ``entries.depth``; returns `DepthWindow.room` and `DepthWindow.largest`.
    """
    depth, delta, depth_error = gaussians.depth, gaussians.delta, gaussians.depth_error
    radii, deep = entries.depth_radius, entries.depth
    count = numbers.size
    along = _turn(slope, ray, m)
    total = 0.0
    for k in range(count):
        ahead = numbers[min(k + AHEAD, count - 1)]
        prefetch(delta, ahead, 0)
        prefetch(depth, ahead, 0)
        prefetch(depth_error, ahead, 0)
        i = numbers[k]
        deep[k] = depth[i]
        # offset from the central ray: what a rotation moves in depth relative to the ray
        x = delta[i, 0] - depth[i] * ray[0]
        y = delta[i, 1] - depth[i] * ray[1]
        z = delta[i, 2] - depth[i] * ray[2]
        e = slope[m, 0] * abs(x) + slope[m, 1] * abs(y) + slope[m, 2] * abs(z)
        for row in range(1, m):
            e += abs(slope[row, 0] * x + slope[row, 1] * y + slope[row, 2] * z)
        size = abs(delta[i, 0]) + abs(delta[i, 1]) + abs(delta[i, 2]) + abs(depth[i]) * (1.0 + along)
        radii[k] = e * UP + WINDOW_ROUNDING * size + depth_error[i]
        total += radii[k]
    room = _steadiness(along)
    if not total < np.inf:
        room = -1.0
    # few entries reach far: they are compared with all, the others within a window
    typical = 4.0 * total / max(count, 1)
    largest = 0.0
    for k in range(count):
        if radii[k] <= typical:
            largest = max(largest, radii[k])
    return room, largest


@njit(cache=True, error_model="numpy", forceinline=True)
def find_pairs(k, found, pixels, listed, entries, per_pixel, window, reordering, count):
    """Append the pairs (k, later entry) on a common pixel with open order; widen ``first``, ``last``.

    Pairs of one colour are not appended (O5). ``pixels`` in the lanes ``found`` are those of k. Returns the number of
    pairs, or -1 if they do not fit.
    """
    radii, deep, far, pairs = entries.depth_radius, entries.depth, entries.far, reordering.pairs
    i = listed.numbers[k]
    pixel_set = 0
    beyond = listed.length
    near = radii[k] + window.largest
    # those within the window, then those that reach far
    other = k
    f = 0
    within = True
    while True:
        if within:
            other += 1
            if other >= listed.length or (deep[other] - deep[k]) * window.room > near:
                within = False
                beyond = other
                continue
        else:
            while f < window.far and far[f] < beyond:
                f += 1
            if f >= window.far:
                break
            other = far[f]
            f += 1
            if (deep[other] - deep[k]) * window.room > radii[k] + window.farthest:
                break
        if (deep[other] - deep[k]) * window.room > radii[k] + radii[other]:
            continue
        if pixel_set == 0:
            pixel_set = pixels_at(found, pixels)
        theirs = pixels_once(other, listed, entries, per_pixel)
        if pixel_set & int(theirs) == 0 or not _uncertain(i, listed.numbers[other], listed):
            continue
        entries.last[k] = max(entries.last[k], other)
        entries.first[other] = min(entries.first[other], k)
        if _same_color(i, listed.numbers[other], listed):
            continue
        if count >= reordering.pair_limit:
            return -1
        pairs[2 * count] = k
        pairs[2 * count + 1] = other
        count += 1
    return count
