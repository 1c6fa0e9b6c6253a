"""Memory of a block of pixels, which grows with the lengths of its lists."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.simd.intrinsics import pointer
from ns_abstract.methods.splat.lists import BLOCK, PIXELS
from ns_abstract.methods.splat.pixel_block import (
    BATCH,
    CROSSING_LANES,
    LISTED,
    MOVES,
    NUMBERS,
    PART_ENDS,
    ROWS,
    FragmentBatch,
    Fragments,
    ListEntries,
    Palette,
    PixelBlock,
    Reordering,
    ThresholdCrossings,
    bends_of,
    color_size,
    crossing_column,
    crossing_rows,
    fragment_width,
)
from ns_abstract.methods.splat.stage_data import PART_LANES

#: Fragments that each pixel's list has room for at first.
_CAPACITY = 256
#: Room for list positions at first.
_POSITIONS = 1024


class Buffers(NamedTuple):
    """Memory of a thread's blocks; its fields are those of `PixelBlock` and its parts."""

    per_pixel: np.ndarray
    offsets: np.ndarray
    pixels: np.ndarray
    batch: np.ndarray
    rows: np.ndarray
    lengths: np.ndarray
    background: np.ndarray
    nothing: np.ndarray
    unseen: np.ndarray
    part_ends: np.ndarray
    sums: np.ndarray
    ray: np.ndarray
    motion: np.ndarray
    positions: np.ndarray
    depths: np.ndarray
    palette: np.ndarray
    shifted: np.ndarray
    values: np.ndarray
    lists: np.ndarray
    light: np.ndarray
    drawn: np.ndarray
    places: np.ndarray
    moves: np.ndarray
    pairs: np.ndarray
    skipped: np.ndarray
    distances: np.ndarray
    crossings: np.ndarray


@njit(cache=True, error_model="numpy")
def _crossing_columns(shape, capacity):
    """Return memory for the columns of `ThresholdCrossings`: channels, ``capacity``; the last row is for one part."""
    return max(CROSSING_LANES + -(-capacity // CROSSING_LANES) * CROSSING_LANES, 20 * shape.dimensions + 80)


@njit(cache=True, error_model="numpy")
def _aligned(size):
    """Return uninitialised doubles that begin at a cache line."""
    memory = np.empty(size + 7)
    start = -(memory.ctypes.data // 8) % 8
    return memory[start : start + size]


@njit(cache=True, error_model="numpy")
def _part_ends(shape, capacity):
    """Return memory for `PixelBlock.part_ends` with lists of ``capacity`` fragments."""
    by_interval = 6 * shape.parts + 2 * PART_LANES * capacity if shape.parts > 0 else 0
    return np.empty(PART_ENDS + max(by_interval, 6 * shape.sub_boxes))


@njit(cache=True, error_model="numpy")
def new_buffers(shape, forms, pair_limit, background):
    """Return memory for fragments of ``shape``, colours of ``forms`` coefficients and ``pair_limit`` pairs."""
    per_pixel = np.zeros(ROWS * PIXELS)
    per_pixel[NUMBERS : NUMBERS + BLOCK] = np.arange(BLOCK)
    behind = np.zeros(4)
    behind[:3] = background
    m, width = shape.monomials, fragment_width(shape)
    return Buffers(
        per_pixel=per_pixel,
        offsets=np.zeros((2, BATCH * PIXELS + 8)),
        pixels=np.empty(BATCH * PIXELS, np.uint8),
        batch=np.empty((2, BATCH + 1), np.int64),
        rows=np.zeros((width + max(2 * m, 4 * shape.dimensions), 8)),
        lengths=np.empty(PIXELS, np.uint32),
        background=behind,
        nothing=np.zeros(4),
        unseen=np.zeros(8),
        part_ends=_part_ends(shape, _CAPACITY),
        sums=np.zeros(4 * (3 * m + 5 + bends_of(shape))),
        ray=np.empty(3),
        motion=np.zeros(4 * shape.dimensions * PIXELS),
        positions=np.empty((7, _POSITIONS), np.int64),
        depths=np.empty((2, _POSITIONS)),
        palette=np.zeros(_POSITIONS * color_size(forms)),
        shifted=np.zeros(_POSITIONS * color_size(forms)),
        values=_aligned(_CAPACITY * PIXELS * width),
        lists=np.empty((PIXELS, _CAPACITY, LISTED), np.uint32),
        light=np.empty((PIXELS, _CAPACITY, 2)),
        drawn=np.empty(2 * _CAPACITY, np.int64),
        places=np.empty((2 * _CAPACITY, PIXELS), np.uint32),
        moves=np.empty((32 * _CAPACITY, MOVES)),
        pairs=np.empty((pair_limit, 2), np.int64),
        skipped=np.empty(_CAPACITY, np.int64),
        distances=np.empty(8 * _CAPACITY),
        crossings=np.zeros((crossing_rows(shape), _crossing_columns(shape, _CAPACITY))),
    )


@njit(cache=True, error_model="numpy")
def resized(old, positions, capacity, shape, forms):
    """Return ``old`` buffers with room for at least ``positions`` list entries, and ``capacity`` fragments by pixel."""
    places, depths, palette, shifted = old.positions, old.depths, old.palette, old.shifted
    if positions > places.shape[1]:
        places, depths = np.empty((7, positions), np.int64), np.empty((2, positions))
        palette = np.zeros(positions * color_size(forms))
        shifted = np.zeros(positions * color_size(forms))
    values, lists, light, drawn, of_slots, moves = (
        old.values, old.lists, old.light, old.drawn, old.places, old.moves,
    )  # fmt: skip
    skipped, distances, crossings, part_ends = old.skipped, old.distances, old.crossings, old.part_ends
    if capacity > lists.shape[1]:
        values = _aligned(capacity * PIXELS * fragment_width(shape))
        lists = np.empty((PIXELS, capacity, LISTED), np.uint32)
        light = np.empty((PIXELS, capacity, 2))
        drawn = np.empty(2 * capacity, np.int64)
        of_slots = np.empty((2 * capacity, PIXELS), np.uint32)
        moves = np.empty((32 * capacity, MOVES))
        skipped, distances = np.empty(capacity, np.int64), np.empty(8 * capacity)
        crossings = np.zeros((crossing_rows(shape), _crossing_columns(shape, capacity)))
        part_ends = _part_ends(shape, capacity)
    return Buffers(
        per_pixel=old.per_pixel,
        offsets=old.offsets,
        pixels=old.pixels,
        batch=old.batch,
        rows=old.rows,
        lengths=old.lengths,
        background=old.background,
        nothing=old.nothing,
        unseen=old.unseen,
        part_ends=part_ends,
        sums=old.sums,
        ray=old.ray,
        motion=old.motion,
        positions=places,
        depths=depths,
        palette=palette,
        shifted=shifted,
        values=values,
        lists=lists,
        light=light,
        drawn=drawn,
        places=of_slots,
        moves=moves,
        pairs=old.pairs,
        skipped=skipped,
        distances=distances,
        crossings=crossings,
    )


@njit(cache=True, error_model="numpy")
def block_of(buffers, shape, forms):
    """Return the block in ``buffers``, which the caller keeps alive while it uses the block."""
    positions, depths = buffers.positions, buffers.depths
    fragments = Fragments(
        pointer(buffers.values),
        fragment_width(shape),
        bends_of(shape),
        crossing_column(shape),
        shape.parts,
        pointer(buffers.lists),
        pointer(buffers.light),
        pointer(buffers.lengths),
        buffers.lists.shape[1],
        pointer(buffers.per_pixel),
    )
    palette = Palette(pointer(buffers.palette), forms, pointer(buffers.background), pointer(buffers.unseen))
    # sums that begin at 0 and do not know what else is behind
    shifted = Palette(pointer(buffers.shifted), forms, pointer(buffers.nothing), pointer(buffers.unseen))
    entries = ListEntries(
        pointer(positions[0]),
        pointer(positions[1]),
        pointer(depths[0]),
        pointer(depths[1]),
        pointer(positions[2]),
        pointer(positions[3]),
        pointer(positions[4]),
    )
    reordering = Reordering(
        pointer(buffers.pairs),
        buffers.pairs.shape[0],
        pointer(positions[5]),
        pointer(positions[6]),
        pointer(buffers.drawn),
        pointer(buffers.places),
        pointer(buffers.moves),
    )
    batch = FragmentBatch(
        pointer(buffers.offsets[0]),
        pointer(buffers.offsets[1]),
        pointer(buffers.pixels),
        pointer(buffers.batch[0]),
        pointer(buffers.batch[1]),
        pointer(buffers.rows),
    )
    crossings = ThresholdCrossings(
        pointer(buffers.skipped), pointer(buffers.distances), pointer(buffers.crossings), buffers.crossings.shape[1]
    )
    return PixelBlock(
        fragments,
        palette,
        shifted,
        entries,
        reordering,
        batch,
        crossings,
        pointer(buffers.part_ends),
        pointer(buffers.sums),
        pointer(buffers.ray),
        pointer(buffers.motion),
    )
