"""Bounds of pixels over sub-boxes of a cell from the ranges of the Gaussians' depths (docs/dev/design.md, B14).

A fragment is surely in front of another if the far end of its depth range is nearer than the other's near end. SIMD
lanes are eight sub-boxes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.elementary import exp_kernel, fma
from ns_abstract.arithmetic.rounding import FRAGMENT_ROUNDING, UP
from ns_abstract.arithmetic.simd.intrinsics import borrowed, lowest_bit, offset_by, pointer, signed, taken
from ns_abstract.arithmetic.simd.lanes import bits, load8, maximum
from ns_abstract.methods.splat.block_buffers import block_of, new_buffers, resized
from ns_abstract.methods.splat.color_bands import (
    BANDS,
    BandSums,
    ColorEnd,
    choose_levels,
    composite,
    end_charges,
    keep_possible_stops,
    occlude,
    retire_decided_strips,
    share_of,
    write_end,
)
from ns_abstract.methods.splat.depth_pairs import block_list, depth_radii
from ns_abstract.methods.splat.fragments import find_alphas, place_batch
from ns_abstract.methods.splat.intervals import sort_keys, thresholds_of
from ns_abstract.methods.splat.lists import BLOCK, TileLists, block_lists, longest_first
from ns_abstract.methods.splat.pixel_block import (
    ALPHA_HIGH,
    BATCH,
    EXPONENT,
    EXPONENT_CUT,
    block_place,
    exponent_ends,
    exponent_limit,
    part_axes,
    take_motion,
)
from ns_abstract.methods.splat.pixels import borrowed_inputs, ray_at
from ns_abstract.methods.splat.reached_pixels import pixels_once
from ns_abstract.methods.splat.stage_data import PART_LANES, ColorEnds, PixelInputs, Strips
from ns_abstract.methods.splat.work_sharing import run_by_tiles

#: Bits of a set of eight lanes.
_ALL = 255


@dataclass(frozen=True)
class DepthRangeTuning:
    """How many fragments are considered before bands are chosen; soundness does not depend on it."""

    #: Transmittance at the middle pose behind which they are not.
    least_transmittance: float = 2.0**-4


_LEAST_TRANSMITTANCE = DepthRangeTuning.least_transmittance


class _Work(NamedTuple):
    """Memory for the fragments of one pixel, sorted by the near ends of their depths; [room] unless stated otherwise.

    Attributes:
        sets: The set of the block's pixels that each of its Gaussians reaches.
        numbers: The rows of the Gaussians that reach the pixel.
        is_drawn: Whether alpha may reach the threshold.
        near, far: Ends of the depth (`_depth_ranges`); ``far`` is sorted by itself, in the order ``by_far``.
        by_far: The fragments sorted by far ends.
        strips: The sets of strips in which alpha may reach the threshold.
        below: Number of bands that the colour exceeds.
        share: Fraction of the next band that it reaches, or 0.
        low: [room, 2, parts] least alpha over the sub-boxes, and largest transmittance at an early termination there.
        colors, weights, keys: Scratch.
        order: Scratch.
    """

    sets: np.ndarray
    numbers: np.ndarray
    is_drawn: np.ndarray
    near: np.ndarray
    far: np.ndarray
    by_far: np.ndarray
    strips: np.ndarray
    below: np.ndarray
    share: np.ndarray
    low: np.ndarray
    colors: np.ndarray
    weights: np.ndarray
    keys: np.ndarray
    order: np.ndarray


@njit(cache=True, error_model="numpy")
def _new_work(room):
    """Return `_Work` for lists of ``room`` Gaussians, without ``low``."""
    return (
        np.empty(room, np.int64), np.empty(room, np.uint32), np.empty(room, np.int64), np.empty(room), np.empty(room),
        np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room),
    ), (
        np.empty(room + 1), np.empty(room + 1), np.empty(room + 1), np.empty(room + 1, np.int64),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _work_of(rooms, low):
    """Return the `_Work` in ``rooms`` and ``low``, which the caller keeps alive while it is used."""
    first, last = rooms
    return _Work(
        first[0], first[1], first[2], first[3], first[4], first[5], first[6], first[7], first[8],
        pointer(low), last[0], last[1], last[2], last[3],
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def _strips_reached(values, at, strips, inputs):
    """Return the set of strips in which the fragment at ``at`` may reach the alpha threshold (B4, B12, B14)."""
    axes = part_axes(inputs.shape)
    ends = at + exponent_ends(inputs.shape.monomials)
    e1, e2, e = values[ends], values[ends + 1], at + EXPONENT
    for k in range(axes):
        e += 2
        e1 += strips.half[k] * abs(values[e])
        e2 += strips.half[k] * abs(values[e + 1])
    e1 *= UP
    e2 *= UP
    reached, room = 0, strips.room
    for strip in range(0, room, PART_LANES):
        e = at + EXPONENT
        zero = 0.0 * load8(strips.middles, strip)
        y1, y2 = zero + values[e], zero + values[e + 1]
        for k in range(axes):
            e += 2
            middle = load8(strips.middles, room * k + strip)
            y1 = fma(middle, values[e], y1)
            y2 = fma(middle, values[e + 1], y2)
        near1, near2 = maximum(0.0, abs(y1) - e1), maximum(0.0, abs(y2) - e2)
        nearest = (0.5 * (1.0 - FRAGMENT_ROUNDING)) * fma(near1, near1, near2 * near2)
        beyond = nearest > values[at + exponent_limit(inputs.shape)]
        reached |= (_ALL - bits(beyond)) << strip
    return reached


@njit(cache=True, error_model="numpy")
def _depth_ranges(count, x, y, inputs, block, work):
    """Sort the ``count`` Gaussians of the pixel at (x, y) by the near ends of their depths (design.md, O1, B14).

    A Gaussian whose far end is nearer than another's near end is in front of it at every pose.
    """
    numbers, near, far = work.numbers, work.near, work.far
    ray_at(x + 0.5, y + 0.5, inputs, block.ray)
    room, _ = depth_radii(
        borrowed(numbers[:count]), inputs.gaussians, inputs.axes.depth, block.ray, inputs.shape.monomials, block.entries
    )
    for k in range(count):
        # where nothing is known, all have one place
        near[k], work.keys[k] = 0.0, 0.0
        if room > 0.0:
            deep = block.entries.depth[k]
            reach = (block.entries.depth_radius[k] + FRAGMENT_ROUNDING * abs(deep)) * UP
            near[k], work.keys[k] = room * deep - reach, room * deep + reach
    sort_keys(near, work.order, count)
    for k in range(count):
        far[k] = work.keys[work.order[k]]
        # as scratch
        work.is_drawn[k] = numbers[work.order[k]]
    for k in range(count):
        numbers[k] = work.is_drawn[k]
    sort_keys(far, work.by_far, count)


@njit(cache=True, error_model="numpy", forceinline=True)
def _compute_alphas(start, q, place, listed, inputs, block, work):
    """Compute the alphas of the next fragments of pixel q; return the number of fragments with alphas."""
    some = min(BATCH, listed.length - start)
    place_batch(start, some, signed(1 << q), listed, inputs, block)
    find_alphas(start, some, signed(start), place, listed, inputs, block)
    for b in range(some):
        work.is_drawn[start + b] = block.batch.found[b]
    return start + some


@njit(cache=True, error_model="numpy")
def _compute_visible(q, place, listed, inputs, block, work):
    """Compute blending weights at the middle pose while the transmittance is high; return the number of fragments.

    Soundness does not depend on them. The background counts as one more fragment.
    """
    values, width = block.fragments.values, block.fragments.width
    ends = exponent_ends(inputs.shape.monomials)
    transmittance, computed = 1.0, 0
    while computed < listed.length and transmittance > _LEAST_TRANSMITTANCE:
        first = computed
        computed = _compute_alphas(first, q, place, listed, inputs, block, work)
        for k in range(first, computed):
            at = k * width
            y1, y2 = values[at + EXPONENT], values[at + EXPONENT + 1]
            alpha = 0.0
            if work.is_drawn[k] != 0:
                exponent = min(0.5 * (y1 * y1 + y2 * y2), EXPONENT_CUT)
                alpha = min(values[at + ends + 3] * exp_kernel(-exponent), values[at + ALPHA_HIGH])
            work.weights[k] = transmittance * alpha
            transmittance *= 1.0 - alpha
    work.weights[computed] = transmittance
    return computed


@njit(cache=True, error_model="numpy")
def _bound_end(q, computed, goal, place, listed, inputs, block, strips, end, work, sums, out):
    """Write one end (lower or upper) of pixel q over each sub-box; return the number of fragments with alphas (B14).

    Fragments are composited nearest depth first; each occludes the following ones once its farthest depth is passed.
    """
    values, width, parts, levels = block.fragments.values, block.fragments.width, inputs.shape.parts, sums.levels
    count = listed.length
    charges, thresholds = end_charges(count, inputs, end), thresholds_of(inputs)
    for lane in range(BANDS * parts):
        sums.drawn[lane], sums.transmittance[lane], sums.occluded[lane] = 0.0, 1.0, 0.0
    for lane in range(parts):
        sums.least_transmittance[lane], sums.most_transmittance[lane], sums.stopped[lane] = 1.0, 1.0, 0.0
    open_, past = (1 << (parts // PART_LANES)) - 1, 0
    for k in range(count):
        if open_ == 0:
            break
        if k == computed:
            computed = _compute_alphas(k, q, place, listed, inputs, block, work)
        while past < count and work.far[past] < work.near[k]:
            occlude(work.by_far[past], open_, charges.dark, parts, work, sums)
            past += 1
        work.strips[k] = 0
        if work.is_drawn[k] != 0:
            color, below = end.colors[listed.numbers[k]], 0
            while below < BANDS and levels[below + 1] <= color:
                below += 1
            work.below[k], work.share[k] = below, share_of(color, below, levels)
            work.strips[k] = _strips_reached(values, k * width, strips, inputs) & open_
            composite(k, work.strips[k], values, k * width, thresholds, charges, inputs, work, sums)
        if k % BATCH == BATCH - 1:
            still = retire_decided_strips(open_, goal, charges, sums)
            # what may come before these is not known
            keep_possible_stops(open_ & ~still, k, past, count, parts, work, sums)
            open_ = still
    if open_ != 0:
        while past < count:
            occlude(work.by_far[past], open_, charges.dark, parts, work, sums)
            past += 1
    write_end(q, open_, charges, place, end, sums, out)
    return computed


@njit(cache=True, error_model="numpy")
def _bound_pixel(q, count, goals, place, inputs, block, strips, color_ends, work, sums, out):
    """Write the ends with ``goals`` of pixel q of a block, which ``count`` Gaussians reach (design.md, B14)."""
    _depth_ranges(count, place.x0 + q % BLOCK, place.y0 + q // BLOCK, inputs, block, work)
    listed = block_list(borrowed(work.numbers[:count]), place, inputs)
    for k in range(count):
        block.entries.has_pixels[k] = 1
        block.entries.pixels[k] = signed(1 << q)
    visible = computed = _compute_visible(q, place, listed, inputs, block, work)
    for row in range(6):
        goal = goals[row] if row >= 3 else -goals[row]
        if math.isnan(goal):
            continue
        if math.isinf(goal):
            # everything matters
            goal = np.nan
        end = ColorEnd(
            row, pointer(color_ends.values[row]), color_ends.background[row], color_ends.opposite[row],
            color_ends.bright,
        )  # fmt: skip
        choose_levels(visible, count, end, work, sums)
        computed = _bound_end(q, computed, goal, place, listed, inputs, block, strips, end, work, sums, out)


@njit(cache=True, error_model="numpy")
def _bound_block(numbers, goals, place, inputs, block, strips, color_ends, work, sums, out):
    """Write the ends with ``goals`` of a block's requested pixels over each sub-box (design.md, B14)."""
    take_motion(place, inputs, block)
    listed, sets, pixels = block_list(numbers, place, inputs), work.sets, signed(place.wanted)
    for k in range(listed.length):
        block.entries.has_pixels[k] = 0
        sets[k] = pixels_once(k, listed, block.entries, block.fragments.per_pixel)
    side = out.shape[0]
    while pixels != 0:
        q = lowest_bit(pixels)
        pixels = signed(pixels & (pixels - 1))
        count = 0
        for k in range(listed.length):
            if sets[k] >> q & 1 != 0:
                work.numbers[count] = numbers[k]
                count += 1
        _bound_pixel(
            q, count, goals[place.y0 % side + q // BLOCK, place.x0 % side + q % BLOCK], place, inputs, block, strips,
            color_ends, work, sums, out,
        )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _depth_range_worker(share, lists, pixels, goals, inputs, strips, color_ends, out):
    """Bound the pixels of one thread's ``share`` of tiles; see `ThreadShare` and `depth_range_stage`."""
    sequence, counter = borrowed(share.sequence), pointer(share.counter)
    inputs = borrowed_inputs(inputs)
    strips = Strips(pointer(strips.middles), pointer(strips.half), strips.room)
    camera, side = inputs.intrinsics, out.shape[1]
    tiles_x, blocks = int(math.ceil(camera.width / side)), side // BLOCK
    forms = max(inputs.colors.values.shape[1] // inputs.colors.channels - 1, 1)
    buffers = new_buffers(inputs.shape, forms, 1, inputs.colors.background)
    block, room, parts = block_of(buffers, inputs.shape, forms), buffers.depths.shape[1], inputs.shape.parts
    rooms, low = _new_work(room), np.empty(2 * room * parts)
    work, lanes = _work_of(rooms, low), np.empty((3 * BANDS + 3) * parts)
    size, rest = BANDS * parts, 3 * BANDS * parts
    sums = BandSums(
        np.empty(BANDS + 1), pointer(lanes), offset_by(pointer(lanes), size), offset_by(pointer(lanes), 2 * size),
        offset_by(pointer(lanes), rest), offset_by(pointer(lanes), rest + parts),
        offset_by(pointer(lanes), rest + 2 * parts),
    )  # fmt: skip
    block_offsets, block_entries = np.empty(blocks * blocks + 1, np.int64), np.empty(4096, np.uint32)
    while True:
        turn = taken(counter)
        if turn >= sequence.size:
            break
        number = sequence[turn]
        tile = lists.wanted[number]
        tile_x, tile_y = tile % tiles_x, tile // tiles_x
        block_entries = block_lists(
            lists.entries[lists.offsets[tile] : lists.offsets[tile + 1]], inputs.gaussians.box, tile_x * side,
            tile_y * side, side, block_offsets, block_entries,
        )  # fmt: skip
        for b in range(blocks * blocks):
            place = block_place(tile_x, tile_y, b, side, pixels[number, b])
            if place.wanted == 0 or place.x0 >= camera.width or place.y0 >= camera.height:
                continue
            numbers = block_entries[block_offsets[b] : block_offsets[b + 1]]
            if numbers.size >= buffers.depths.shape[1]:
                # a pixel's fragments stand one after the other
                room = 2 * numbers.size
                buffers = resized(buffers, room, max(buffers.lists.shape[1], room // 64 + 1), inputs.shape, forms)
                block, rooms, low = block_of(buffers, inputs.shape, forms), _new_work(room), np.empty(2 * room * parts)
                work = _work_of(rooms, low)
            _bound_block(
                borrowed(numbers), goals[number], place, inputs, block, strips, color_ends, work, sums, out[number]
            )
    # the owners of the memory live to here
    return len(buffers) + len(rooms) + low.size + lanes.size


def depth_range_stage(
    lists: TileLists, pixels: np.ndarray, goals: np.ndarray, inputs: PixelInputs, strips: Strips,
    color_ends: ColorEnds, threads: int, out: np.ndarray,
) -> None:  # fmt: skip
    """Write ends of pixels of the tiles ``lists.wanted`` over each sub-box of a cell (design.md, B14).

    Args:
        lists: Of all tiles of the image.
        pixels: [t, blocks] the set of each block's requested pixels, blocks row by row.
        goals: [t, side, side, 6] goals for the least of three channels, then the greatest. Only the side of its goal on
            which an end lies matters; infinite: the end itself is needed; NaN: it is not needed.
        inputs: Of the cell, whose parts are the sub-boxes.
        strips: Of eight sub-boxes each.
        color_ends: Of the Gaussians.
        threads: Number of threads.
        out: [t, side, side, 6, parts] receives the ends. NaN bounds nothing.
    """
    run_by_tiles(
        _depth_range_worker, longest_first(lists.wanted, lists.offsets), threads, lists, pixels, goals, inputs,
        strips, color_ends, out,
    )  # fmt: skip
