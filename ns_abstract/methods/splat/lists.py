"""Lists of Gaussians by tile and by block, front to back, shared by the renderer and the bounds."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.simd.intrinsics import prefetch

#: Side of a block in pixels; a block is what one pass of the compiled pixel stages works on.
BLOCK = 8
#: Pixels of a block.
PIXELS = BLOCK * BLOCK
#: How many entries ahead memory is asked for: lists name Gaussians in depth order, which is no order in memory.
AHEAD = 8


class TileLists(NamedTuple):
    """Gaussians of the tiles of an image, nearest first.

    Attributes:
        wanted: [t] int64 numbers of the requested tiles, row-major.
        offsets: [T + 1] where the list of each of all T tiles begins in ``entries``; other tiles have empty lists.
        entries: uint32 rows of the Gaussians.
    """

    wanted: np.ndarray
    offsets: np.ndarray
    entries: np.ndarray


def depth_order(visible, depth):
    """Return the indices ``visible`` sorted by ``depth[visible]``, equal depths by index."""
    keys = depth[visible]
    order = np.argsort(keys)
    keys, order = keys[order], visible[order]
    same = keys[1:] == keys[:-1]
    if same.any():
        tied = np.append(same, False) | np.append(False, same)
        order[tied] = order[tied][np.lexsort((order[tied], keys[tied]))]
    return order


def tile_mask(wanted, count):
    """Return [count] 1 for the tiles ``wanted`` (numbers), 0 for the others."""
    mask = np.zeros(count, np.uint8)
    mask[wanted] = 1
    return mask


def pixel_sets(chosen, count, side):
    """Return [t, blocks] int64 bit sets of each block's ``chosen`` pixels [t, side, side], blocks row by row.

    None: all pixels of ``count`` tiles of ``side`` pixels.
    """
    along = side // BLOCK
    if chosen is None:
        return np.full((count, along * along), -1, np.int64)
    by_block = chosen.reshape(count, along, BLOCK, along, BLOCK).swapaxes(2, 3).reshape(count, along * along, PIXELS)
    return np.packbits(by_block, axis=-1, bitorder="little").view("<i8")[..., 0]


def summed_area(chosen):
    """Return [rows + 1, columns + 1] int32 the number of ``chosen`` places [rows, columns] above and left of each."""
    table = np.zeros((chosen.shape[0] + 1, chosen.shape[1] + 1), np.int32)
    table[1:, 1:] = np.cumsum(np.cumsum(chosen, axis=0, dtype=np.int32), axis=1, dtype=np.int32)
    return table


@njit(cache=True, error_model="numpy")
def touching(indices, rectangles, table):
    """Return those of ``indices`` (rows of ``rectangles``) whose rectangle contains a chosen place.

    ``rectangles`` [n, >= 4] are columns first and past, rows first and past, of tiles or pixels; ``table`` is the
    `summed_area` of the chosen places.
    """
    out = np.empty_like(indices)
    count = 0
    for i in indices:
        x0, x1, y0, y1 = rectangles[i, 0], rectangles[i, 1], rectangles[i, 2], rectangles[i, 3]
        if x0 < x1 and y0 < y1 and table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0] > 0:
            out[count] = i
            count += 1
    return out[:count]


def rectangles_by_place(rectangles, rows, columns):
    """Return [rows, columns] int64 the number of ``rectangles`` [n, 4] (see `touching`) that contain each place."""
    # those of Gaussians end with their tiles, which reach beyond a picture whose sides they do not divide
    x0, x1, y0, y1 = np.minimum(np.maximum(rectangles, 0), [columns, columns, rows, rows]).T
    some = (x0 < x1) & (y0 < y1)
    x0, x1, y0, y1 = x0[some], x1[some], y0[some], y1[some]
    wide = columns + 1
    begun, ended = (
        np.bincount(a * wide + x0, minlength=(rows + 1) * wide)
        - np.bincount(a * wide + x1, minlength=(rows + 1) * wide)
        for a in (y0, y1)
    )
    return (begun - ended).reshape(rows + 1, wide).cumsum(axis=0).cumsum(axis=1)[:rows, :columns]


@njit(cache=True, error_model="numpy")
def visible_again(marks, numbers, box, tiles, side):
    """Return the ``numbers`` whose mark is not 0, and the pixel rectangles on which they may be drawn (design.md, R2).

    ``box`` [n, 4] is the least and largest x, least and largest y that they reach, pixels; NaN: unknown. ``tiles`` [n,
    >= 4] are their ranges of tiles of ``side`` pixels, see `tile_lists`; they are not drawn elsewhere. Returns [k], and
    [k, 4] int32 columns first and past, rows first and past.
    """
    count = 0
    for k in range(marks.size):
        count += marks[k] != 0
    numbers_marked, pixels = np.empty(count, numbers.dtype), np.empty((count, 4), np.int32)
    count = 0
    for k in range(marks.size):
        if marks[k] == 0:
            continue
        numbers_marked[count] = numbers[k]
        for axis in range(0, 4, 2):
            first, past = tiles[k, axis] * side, tiles[k, axis + 1] * side
            # a pixel's middle lies half a pixel behind its number; what is not a number leaves nothing out
            low, high = box[k, axis] - 0.5, box[k, axis + 1] - 0.5
            pixels[count, axis], pixels[count, axis + 1] = first, past
            if low > first:
                pixels[count, axis] = int(math.ceil(min(low, float(past))))
            if high < past:
                pixels[count, axis + 1] = int(math.floor(max(high, first - 1.0))) + 1
        count += 1
    return numbers_marked, pixels


def longest_first(wanted, offsets):
    """Return positions in ``wanted`` (tile numbers), longest lists first, so that threads end together."""
    return np.argsort(offsets[wanted] - offsets[wanted + 1], kind="stable")


@njit(cache=True, error_model="numpy")
def tile_lists(order, tiles, wanted, tiles_x):
    """Return offsets [T + 1] and entries of the lists of the T tiles whose ``wanted`` is not 0.

    ``tiles`` [n, >= 4] holds tile ranges x0, x1, y0, y1 (x1, y1 exclusive) by Gaussian.
    """
    count = wanted.size
    offsets = np.zeros(count + 1, np.int64)
    for k in range(order.size):
        prefetch(tiles, order[min(k + AHEAD, order.size - 1)], 0)
        i = order[k]
        for ty in range(tiles[i, 2], tiles[i, 3]):
            for tx in range(tiles[i, 0], tiles[i, 1]):
                t = ty * tiles_x + tx
                if wanted[t]:
                    offsets[t + 1] += 1
    for t in range(count):
        offsets[t + 1] += offsets[t]
    entries = np.empty(offsets[count], np.uint32)
    position = offsets[:-1].copy()
    for k in range(order.size):
        prefetch(tiles, order[min(k + AHEAD, order.size - 1)], 0)
        i = order[k]
        for ty in range(tiles[i, 2], tiles[i, 3]):
            for tx in range(tiles[i, 0], tiles[i, 1]):
                t = ty * tiles_x + tx
                if wanted[t]:
                    entries[position[t]] = i
                    position[t] += 1
    return offsets, entries


@njit(cache=True, error_model="numpy")
def block_lists(entries, box, x0, y0, tile, offsets, out):
    """Distribute a tile's ``entries`` over its blocks by the pixel regions ``box`` [n, 4].

    Args:
        x0, y0: The tile's first pixel.
        tile: The tile's side in pixels, a multiple of `BLOCK`.
        offsets: Output [B^2 + 1] with B = tile / BLOCK.
        out: Memory for the entries; returned, enlarged where it was too small.
    """
    side = tile // BLOCK
    offsets[:] = 0
    ranges = np.empty((entries.size, 4), np.uint16)
    for k in range(entries.size):
        prefetch(box, entries[min(k + AHEAD, entries.size - 1)], 0)
        i = entries[k]
        bx0, bx1 = _block_range(box[i, 0], box[i, 1], x0, side)
        by0, by1 = _block_range(box[i, 2], box[i, 3], y0, side)
        ranges[k, 0], ranges[k, 1], ranges[k, 2], ranges[k, 3] = bx0, bx1, by0, by1
        for by in range(by0, by1):
            for bx in range(bx0, bx1):
                offsets[by * side + bx + 1] += 1
    for b in range(side * side):
        offsets[b + 1] += offsets[b]
    if out.size < offsets[side * side]:
        out = np.empty(2 * offsets[side * side], np.uint32)
    position = offsets[:-1].copy()
    for k in range(entries.size):
        i = entries[k]
        for by in range(ranges[k, 2], ranges[k, 3]):
            for bx in range(ranges[k, 0], ranges[k, 1]):
                b = by * side + bx
                out[position[b]] = i
                position[b] += 1
    return out


@njit(cache=True, inline="always")
def _block_range(low, high, origin, side):
    """Return the blocks [first, past) with a pixel centre in [low, high], clipped to the tile."""
    span = float(side * BLOCK)
    a = min(max(low - 0.5 - origin, -1.0), span)
    b = min(max(high - 0.5 - origin, -1.0), span)
    # first pixel with centre >= low, last with centre <= high
    first = int(np.ceil(a))
    last = int(np.floor(b))
    first = max(first, 0)
    last = min(last, side * BLOCK - 1)
    if last < first:
        return 0, 0
    return first // BLOCK, last // BLOCK + 1
