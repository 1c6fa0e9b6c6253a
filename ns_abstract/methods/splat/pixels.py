"""The per-pixel stage of the bounds: the tiles of a picture, block by block, on all threads (design.md, B1-B12, R4).

A block of `PIXELS` pixels passes two steps: `fragments` collects what may be drawn, with alphas from `alphas`, and
`blend` composites it pixel by pixel; `pixel_block` describes the memory.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ns_abstract.arithmetic.simd.intrinsics import borrowed, lowest_bit, pointer, signed, taken
from ns_abstract.methods.splat.blend import shade
from ns_abstract.methods.splat.block_buffers import block_of, new_buffers, resized
from ns_abstract.methods.splat.depths import ACCUMULATION_HIGH, ACCUMULATION_LOW, DEPTH_HIGH, DEPTH_LOW, shade_layers
from ns_abstract.methods.splat.fragments import GIVE_UP, GROW, apply_stops, collect_fragments, number_groups
from ns_abstract.methods.splat.lists import BLOCK, TileLists, block_lists, longest_first
from ns_abstract.methods.splat.pixel_block import block_place, longest_list, take_motion
from ns_abstract.methods.splat.reordering import swap_bounds
from ns_abstract.methods.splat.stage_data import (
    Colors,
    Parts,
    PixelBounds,
    PixelInputs,
    ProjectedGaussians,
    ViewingAxes,
)
from ns_abstract.methods.splat.work_sharing import run_by_tiles


@njit(cache=True, error_model="numpy")
def _set_trivial(pixels, left, above, bounds, m):
    """Set the bounds of ``pixels`` of a block to [0, 1], as nothing is known of them."""
    lower, upper, linear = bounds.lower, bounds.upper, bounds.linear
    while pixels != 0:
        q = lowest_bit(pixels)
        pixels = signed(pixels & (pixels - 1))
        row, column = above + q // BLOCK, left + q % BLOCK
        for channel in range(3):
            lower[row, column, channel] = 0.0
            upper[row, column, channel] = 1.0
            if linear.shape[0] > 0:
                linear[0, row, column, channel, 0] = 0.5
                linear[0, row, column, channel, m] = 0.5
        if bounds.layers.shape[0] > 0:
            of_pixel = bounds.layers[0, row, column]
            of_pixel[ACCUMULATION_LOW], of_pixel[ACCUMULATION_HIGH] = 0.0, 1.0
            of_pixel[DEPTH_LOW], of_pixel[DEPTH_HIGH] = 0.0, np.inf


@njit(cache=True, error_model="numpy")
def _set_trivial_parts(pixels, left, above, bounds):
    """Set the bounds of ``pixels`` to [0, 1] over the parts or sub-boxes of the cell, where these are requested."""
    while pixels != 0 and bounds.parts.shape[0] > 0:
        q = lowest_bit(pixels)
        pixels = signed(pixels & (pixels - 1))
        ends = bounds.parts[0, above + q // BLOCK, left + q % BLOCK]
        for part in range(ends.shape[1]):
            for channel in range(3):
                ends[channel, part], ends[3 + channel, part] = 0.0, 1.0


@njit(cache=True, error_model="numpy", forceinline=True)
def ray_at(x, y, inputs, ray):
    """Write the ray [3] of unit depth through image point (x, y) at the cell's middle, world axes."""
    camera, direction = inputs.intrinsics, inputs.axes.middle
    u, v = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    for k in range(3):
        ray[k] = direction[k] * u + direction[3 + k] * v + direction[6 + k]


@njit(cache=True, error_model="numpy")
def _bound_block(numbers, place, inputs, block, bounds):
    """Bound one block of pixels; return whether the buffers sufficed.

    ``numbers`` are the rows of the Gaussians that may reach it, nearest first. ``bounds`` is the tile's slice of
    `PixelBounds`, where ``linear`` starts with the tile's or is empty, and ``statistics`` is the thread's row.
    """
    left, above, m = place.x0 % bounds.lower.shape[0], place.y0 % bounds.lower.shape[0], inputs.shape.monomials
    _set_trivial(signed(~place.wanted), left, above, bounds, m)
    if place.wanted == 0:
        return True
    take_motion(place, inputs, block)
    ray_at(place.x0 + 0.5 * BLOCK, place.y0 + 0.5 * BLOCK, inputs, block.ray)
    pairs, slots = collect_fragments(numbers, place, inputs, block, bounds.marks)
    if pairs == GROW:
        return False
    bounds.statistics[0] += 1
    if pairs == GIVE_UP:
        # too much may be reordered
        bounds.statistics[3] += 1
        for k in range(numbers.size):
            bounds.marks[numbers[k]] = 1
        _set_trivial(signed(place.wanted), left, above, bounds, m)
        _set_trivial_parts(signed(place.wanted), left, above, bounds)
        return True
    if slots > 0:
        swap_bounds(pairs, slots, block)
        apply_stops(slots, block, inputs)
        number_groups(numbers.size, block.entries)
    bounds.statistics[1] += longest_list(block.fragments.lengths)
    bounds.statistics[2] += pairs
    shade(place.wanted, left, above, slots > 0, block, inputs, bounds)
    if bounds.layers.shape[0] > 0:
        shade_layers(place.wanted, left, above, block, inputs, bounds)
    return True


@njit(cache=True, error_model="numpy")
def borrowed_inputs(inputs):
    """Return the `PixelInputs` without references to the arrays' owners."""
    gaussians, axes, colors, parts = inputs.gaussians, inputs.axes, inputs.colors, inputs.parts
    gaussians = ProjectedGaussians(
        borrowed(gaussians.record), borrowed(gaussians.box), borrowed(gaussians.tiles), borrowed(gaussians.depth),
        borrowed(gaussians.delta), borrowed(gaussians.depth_error),
    )  # fmt: skip
    axes = ViewingAxes(borrowed(axes.depth), borrowed(axes.middle), axes.tied)
    colors = Colors(
        borrowed(colors.values), borrowed(colors.background), colors.error, colors.channels, borrowed(colors.common)
    )
    parts = Parts(
        pointer(parts.middles),
        pointer(parts.half),
        pointer(parts.slope),
        borrowed(parts.levels),
        pointer(parts.motion),
        parts.side,
    )
    return PixelInputs(
        gaussians, axes, inputs.intrinsics, colors, inputs.rules, inputs.charges, inputs.cutoffs, inputs.shape, parts
    )


@njit(cache=True, error_model="numpy")
def _tile_bounds(bounds, number, thread):
    """Return the slice of ``bounds`` that ``thread`` writes for tile ``number`` of the requested ones."""
    linear, layers, parts = borrowed(bounds.linear), borrowed(bounds.layers), borrowed(bounds.parts)
    return PixelBounds(
        borrowed(bounds.lower)[number], borrowed(bounds.upper)[number], linear[min(number, linear.shape[0]) :],
        layers[min(number, layers.shape[0]) :], borrowed(bounds.slopes)[number],
        borrowed(bounds.statistics)[thread], parts[min(number, parts.shape[0]) :], borrowed(bounds.marks),
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _pixel_worker(share, lists, pixels, inputs, bounds):
    """Bound the pixels of one thread's ``share`` of tiles; see `ThreadShare` and `pixel_stage`."""
    sequence, counter = borrowed(share.sequence), pointer(share.counter)
    inputs = borrowed_inputs(inputs)
    camera = inputs.intrinsics
    side = bounds.lower.shape[1]
    tiles_x = int(math.ceil(camera.width / side))
    blocks = side // BLOCK
    forms = max(inputs.colors.values.shape[1] // inputs.colors.channels - 1, 1)
    buffers = new_buffers(inputs.shape, forms, inputs.cutoffs.pairs, inputs.colors.background)
    block = block_of(buffers, inputs.shape, forms)
    block_offsets = np.empty(blocks * blocks + 1, np.int64)
    block_entries = np.empty(4096, np.uint32)
    while True:
        turn = taken(counter)
        if turn >= sequence.size:
            break
        number = sequence[turn]
        tile = lists.wanted[number]
        tile_x = tile % tiles_x
        tile_y = tile // tiles_x
        of_tile = _tile_bounds(bounds, number, share.thread)
        block_entries = block_lists(
            lists.entries[lists.offsets[tile] : lists.offsets[tile + 1]], inputs.gaussians.box, tile_x * side,
            tile_y * side, side, block_offsets, block_entries,
        )  # fmt: skip
        for b in range(blocks * blocks):
            place = block_place(tile_x, tile_y, b, side, pixels[number, b])
            if place.x0 >= camera.width or place.y0 >= camera.height:
                continue
            numbers = block_entries[block_offsets[b] : block_offsets[b + 1]]
            if numbers.size >= buffers.depths.shape[1]:
                buffers = resized(buffers, 2 * numbers.size, buffers.lists.shape[1], inputs.shape, forms)
                block = block_of(buffers, inputs.shape, forms)
            while not _bound_block(borrowed(numbers), place, inputs, block, of_tile):
                buffers = resized(buffers, buffers.depths.shape[1], 2 * buffers.lists.shape[1], inputs.shape, forms)
                block = block_of(buffers, inputs.shape, forms)
    # the owner of the block's memory lives to here
    return len(buffers)


def pixel_stage(lists: TileLists, pixels: np.ndarray, inputs: PixelInputs, bounds: PixelBounds) -> None:
    """Bound the pixels of the tiles ``lists.wanted`` (design.md, B).

    Args:
        lists: Of all tiles of the image.
        pixels: [t, blocks] the set of each block's requested pixels, blocks row by row; others have no meaningful
            bounds.
        inputs: Of the cell; if it has parts, there are no linear sets and no layers.
        bounds: The output, with one row of statistics for each thread.
    """
    run_by_tiles(
        _pixel_worker, longest_first(lists.wanted, lists.offsets), bounds.statistics.shape[0], lists, pixels, inputs,
        bounds,
    )  # fmt: skip
