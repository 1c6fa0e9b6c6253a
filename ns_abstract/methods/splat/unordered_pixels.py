"""Pixels over sub-boxes of a cell whatever the depth order (design.md, B14).

SIMD lanes are eight sub-boxes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.elementary import fma
from ns_abstract.arithmetic.rounding import FRAGMENT_ROUNDING, SECOND_ORDER, UP
from ns_abstract.arithmetic.simd.intrinsics import borrowed, lowest_bit, pointer, signed, taken
from ns_abstract.arithmetic.simd.lanes import bits, load8, maximum, store
from ns_abstract.methods.splat.block_buffers import block_of, new_buffers, resized
from ns_abstract.methods.splat.depth_pairs import block_list
from ns_abstract.methods.splat.fragments import find_alphas, place_batch
from ns_abstract.methods.splat.intervals import blend_least, blend_most, part_alphas, thresholds_of
from ns_abstract.methods.splat.lists import BLOCK, PIXELS, TileLists, block_lists, longest_first
from ns_abstract.methods.splat.pixel_block import (
    BATCH,
    EXPONENT,
    block_place,
    exponent_ends,
    exponent_limit,
    part_axes,
    take_motion,
)
from ns_abstract.methods.splat.pixels import borrowed_inputs
from ns_abstract.methods.splat.stage_data import PART_LANES, ColorEnd, PixelInputs, Strips
from ns_abstract.methods.splat.work_sharing import run_by_tiles

#: Bits of a set of eight lanes.
_ALL = 255


@dataclass(frozen=True)
class UnorderedTuning:
    """Where lists end. It does not decide whether a bound holds."""

    #: Light behind which fragments are no more told from the most extreme colour that they may have.
    dim: float = 2.0**-8


_DIM = UnorderedTuning.dim


class _Sums(NamedTuple):
    """Sums of a block's pixels over strips of eight sub-boxes; lanes are the sub-boxes of a strip.

    Attributes:
        colors: [PIXELS, strips, 8] light of the fragments before the background.
        light: [PIXELS, strips, 8] what these leave.
        behind: [PIXELS, strips, 8] blend of the other fragments over the background.
        passed: [PIXELS, strips, 8] least light that these others leave.
        boldest: [PIXELS, strips, 8] most alpha.
        open: [PIXELS] sets of the strips in which fragments still count.
        strips: Number of strips.
    """

    colors: Any
    light: Any
    behind: Any
    passed: Any
    boldest: Any
    open: Any
    strips: int


@njit(cache=True, error_model="numpy")
def _sum_rooms(strips):
    """Memory of `_Sums`, which the caller keeps alive for as long as it is used."""
    return np.empty((5, PIXELS * strips * PART_LANES)), np.empty(PIXELS, np.int64)


@njit(cache=True, error_model="numpy")
def _sums_of(rooms, strips):
    """The `_Sums` in ``rooms``."""
    lanes, sets = rooms
    return _Sums(
        pointer(lanes[0]), pointer(lanes[1]), pointer(lanes[2]), pointer(lanes[3]), pointer(lanes[4]), pointer(sets),
        strips,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _start(wanted, background, sums):
    """Reset the sums of ``wanted`` pixels."""
    while wanted != 0:
        q = lowest_bit(wanted)
        wanted = signed(wanted & (wanted - 1))
        for strip in range(q * sums.strips, (q + 1) * sums.strips):
            for lane in range(PART_LANES * strip, PART_LANES * (strip + 1)):
                sums.colors[lane] = 0.0
                sums.light[lane] = 1.0
                sums.behind[lane] = background
                sums.passed[lane] = 1.0
                sums.boldest[lane] = 0.0
        sums.open[q] = (1 << sums.strips) - 1


@njit(cache=True, error_model="numpy", forceinline=True)
def _strips_met(values, at, strips, inputs):
    """The set of strips in which the fragment at ``at`` may reach the threshold (design.md, B4, B12, B14)."""
    axes = part_axes(inputs.shape)
    ends = at + exponent_ends(inputs.shape.monomials)
    e1, e2, e = values[ends], values[ends + 1], at + EXPONENT
    for k in range(axes):
        e += 2
        e1 += strips.half[k] * abs(values[e])
        e2 += strips.half[k] * abs(values[e + 1])
    e1 *= UP
    e2 *= UP
    met, room = 0, strips.room
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
        met |= (_ALL - bits(beyond)) << strip
    return met


@njit(cache=True, error_model="numpy", forceinline=True)
def _add_in_front(values, at, color, q, met, thresholds, inputs, sums):
    """Add a fragment of a colour beyond the background to pixel q in the strips ``met`` (design.md, B14).

    Behind it come less extreme colours only, so that it covers as much as it may.
    """
    while met != 0:
        strip = lowest_bit(met)
        met &= met - 1
        _, high = part_alphas(values, at, PART_LANES * strip, inputs, thresholds)
        place = PART_LANES * (q * sums.strips + strip)
        light = load8(sums.light, place)
        store(sums.colors, place, fma(light * high, color, load8(sums.colors, place)))
        light = light * (1.0 - high)
        store(sums.light, place, light)
        store(sums.boldest, place, maximum(load8(sums.boldest, place), high))
        if bits(light > _DIM) == 0:
            # what comes next is no more extreme
            store(sums.behind, place, color + 0.0 * high)
            sums.open[q] &= ~(1 << strip)


@njit(cache=True, error_model="numpy", forceinline=True)
def _add_behind(values, at, color, sign, q, met, thresholds, inputs, sums):
    """Draw a fragment of pixel q over what is behind it in the strips ``met`` (design.md, B7, B14)."""
    while met != 0:
        strip = lowest_bit(met)
        met &= met - 1
        low, high = part_alphas(values, at, PART_LANES * strip, inputs, thresholds)
        place = PART_LANES * (q * sums.strips + strip)
        behind = load8(sums.behind, place)
        store(sums.boldest, place, maximum(load8(sums.boldest, place), high))
        store(sums.passed, place, load8(sums.passed, place) * (1.0 - high))
        if sign > 0.0:
            store(sums.behind, place, blend_most(behind, color, low, high))
        else:
            store(sums.behind, place, blend_least(behind, color, low, high))


@njit(cache=True, error_model="numpy", forceinline=True)
def _add_batch(start, some, live, front, listed, place, thresholds, inputs, block, strips, color_end, sums):
    """Add ``some`` list positions from ``start`` on to the pixels ``live``; returns those that stay open.

    ``front``: whether they are beyond the background, and come in order; else they come in the opposite one.
    """
    batch, values, width = block.batch, block.fragments.values, block.fragments.width
    place_batch(start, some, live, listed, inputs, block)
    find_alphas(start, some, signed(0), place, listed, inputs, block)
    for step in range(some):
        b = step if front else some - 1 - step
        lanes, begin = batch.found[b], batch.begins[b]
        color = color_end.values[listed.numbers[start + b]]
        while lanes != 0:
            lane = lowest_bit(lanes)
            lanes &= lanes - 1
            q = int(batch.pixels[begin + lane])
            at = (begin + lane) * width
            met = _strips_met(values, at, strips, inputs) & sums.open[q]
            if front:
                _add_in_front(values, at, color, q, met, thresholds, inputs, sums)
                if sums.open[q] == 0:
                    live = signed(live & ~(1 << q))
            else:
                _add_behind(values, at, color, color_end.sign, q, met, thresholds, inputs, sums)
    return live


@njit(cache=True, error_model="numpy")
def _bound_block(numbers, place, inputs, block, strips, color_end, out, sums):
    """Write one end of the pixels of a block over each sub-box (design.md, B14)."""
    take_motion(place, inputs, block)
    listed = block_list(numbers, place, inputs)
    thresholds = thresholds_of(inputs)
    background, sign, length = inputs.colors.background[color_end.channel], color_end.sign, listed.length
    _start(signed(place.wanted), background, sums)
    for k in range(length):
        block.entries.has_pixels[k] = 0
    # colours beyond the background come first
    front, past = 0, length
    while front < past:
        middle = (front + past) // 2
        if sign * color_end.values[listed.numbers[middle]] > sign * background:
            front = middle + 1
        else:
            past = middle
    live, start = signed(place.wanted), 0
    while start < front and live != 0:
        some = min(BATCH, front - start)
        live = _add_batch(start, some, live, True, listed, place, thresholds, inputs, block, strips, color_end, sums)
        start += some
    past = length
    while past > front and live != 0:
        some = min(BATCH, past - front)
        _add_batch(past - some, some, live, False, listed, place, thresholds, inputs, block, strips, color_end, sums)
        past -= some
    _write(place, length, inputs, color_end, out, sums)


@njit(cache=True, error_model="numpy", forceinline=True)
def _lost_light(stop, alpha):
    """Most light that a stop at a fragment of at most ``alpha`` leaves (B6); where ``stop`` is not positive: none."""
    if stop <= 0.0:
        return 0.0
    return stop / (1.0 - alpha) if 1.0 - alpha > stop else 1.0


@njit(cache=True, error_model="numpy")
def _write(place, length, inputs, color_end, out, sums):
    """Write the wanted pixels' ends with their charges to ``out`` [side, side, 6, parts] (design.md, B6, B8, B14)."""
    charges, side, sign, pixels = inputs.charges, out.shape[0], color_end.sign, signed(place.wanted)
    background = inputs.colors.background[color_end.channel]
    # rounding of the program's own sums and products
    rounding = (charges.blend_fragment * length + charges.blend_pixel) * color_end.bright * SECOND_ORDER
    slack = rounding + inputs.colors.error + inputs.cutoffs.negligible * color_end.bright
    # a stop shows the background in place of what lies behind it
    hidden = (abs(color_end.opposite - background) + rounding) * (1.0 + charges.lost_light)
    stop = inputs.rules.transmittance_min * (1.0 + charges.transmittance)
    # two roundings of the light by fragment
    dark = stop * (1.0 + charges.transmittance * length)
    while pixels != 0:
        q = lowest_bit(pixels)
        pixels = signed(pixels & (pixels - 1))
        ends = out[place.y0 % side + q // BLOCK, place.x0 % side + q % BLOCK, color_end.row]
        for strip in range(sums.strips):
            closed = sums.open[q] & (1 << strip) == 0
            for lane in range(PART_LANES):
                at = PART_LANES * (q * sums.strips + strip) + lane
                end = sign * (sums.colors[at] + sums.light[at] * sums.behind[at])
                # where the list ended early, the end holds every part of it before the background
                if not closed and not sums.light[at] * sums.passed[at] > dark:
                    stopped = sign * (sums.colors[at] + sums.light[at] * background)
                    end = min(end + _lost_light(stop, sums.boldest[at]) * hidden, stopped)
                ends[PART_LANES * strip + lane] = sign * (end + slack)


@njit(cache=True, error_model="numpy", nogil=True)
def _unordered_worker(share, lists, pixels, inputs, strips, color_end, out):
    """One thread's tiles; see `ThreadShare` and `unordered_stage`."""
    sequence, counter = borrowed(share.sequence), pointer(share.counter)
    inputs = borrowed_inputs(inputs)
    strips = Strips(pointer(strips.middles), pointer(strips.half), strips.room)
    camera, side = inputs.intrinsics, out.shape[1]
    tiles_x, blocks = int(math.ceil(camera.width / side)), side // BLOCK
    forms = max(inputs.colors.values.shape[1] // inputs.colors.channels - 1, 1)
    buffers = new_buffers(inputs.shape, forms, 1, inputs.colors.background)
    block, rooms = block_of(buffers, inputs.shape, forms), _sum_rooms(inputs.shape.parts // PART_LANES)
    sums = _sums_of(rooms, inputs.shape.parts // PART_LANES)
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
                buffers = resized(buffers, 2 * numbers.size, buffers.lists.shape[1], inputs.shape, forms)
                block = block_of(buffers, inputs.shape, forms)
            _bound_block(borrowed(numbers), place, inputs, block, strips, color_end, out[number], sums)
    # the owner of the block's memory lives to here
    return len(buffers) + len(rooms)


def unordered_stage(
    lists: TileLists, pixels: np.ndarray, inputs: PixelInputs, strips: Strips, color_end: ColorEnd, threads: int,
    out: np.ndarray,
) -> None:  # fmt: skip
    """One end of one channel of pixels of the tiles ``lists.wanted`` over each sub-box of a cell (design.md, B14).

    Args:
        lists: Of all tiles of the image, the most extreme colours first.
        pixels: [t, blocks] the set of the pixels of each block that are wanted, blocks row by row.
        inputs: Of the cell, which has parts: the sub-boxes.
        strips: Of eight sub-boxes each.
        color_end: The end that is wanted.
        threads: Number of threads.
        out: [t, side, side, 6, parts] receives it at wanted pixels. What is no number bounds nothing.
    """
    run_by_tiles(
        _unordered_worker, longest_first(lists.wanted, lists.offsets), threads, lists, pixels, inputs, strips,
        color_end, out,
    )  # fmt: skip
