"""Per-pixel stage of the bounds: the tiles of a picture, block by block, on all threads (design.md, B1-B9).

A block of `PIXELS` pixels passes two steps: `layers` collects what may be drawn, with alphas from `alphas`, and
`blend` blends it, each pixel by itself; `block` tells how layers are kept.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ns_abstract.arithmetic.compiled import borrowed, pointer, taken
from ns_abstract.methods.splat.blend import shade, swap_bounds
from ns_abstract.methods.splat.block import FORM, LISTED, MOVES, NUMBERS, ROWS, color_size, longest_list
from ns_abstract.methods.splat.layers import BATCH, GIVE_UP, GROW, collect_layers, number_chains, settle_stops
from ns_abstract.methods.splat.lists import BLOCK, PIXELS, block_lists, longest_first


@njit(cache=True, error_model="numpy")
def _block(
    listed, x0, y0, tile_x, tile_y, record, box, tiles, depth, delta, depth_error, colors, color_radius,
    slope, direction, camera, rules, errors, background, unseen, floor, fade, negligible, d, order, m, antialiased,
    s, t, y1, y2, poly, rows, value, palette, layers, offset_x, offset_y, pixels, batch, masks, asked, lists, lengths,
    reach, deep, far, first, last, slots, owners, drawn, places, pairs, moves, ray, lower, upper, linear, slopes,
    statistics, marks,
):  # fmt: skip
    """Bounds of one block of pixels whose first pixel is (x0, y0). Returns whether the buffers sufficed.

    ``lower``, ``upper`` [side, side, 3] are the tile's, ``linear`` starts with the tile's or is empty;
    ``slopes`` [d] are the tile's sums of absolute linear coefficients, ``statistics`` is the thread's row.
    """
    unit = errors[0]
    side = lower.shape[0]
    width = rows.size // PIXELS
    forms = max(colors.shape[1] // 3 - 1, 1)
    u = (x0 + 0.5 * BLOCK - camera[2]) / camera[0]
    v = (y0 + 0.5 * BLOCK - camera[3]) / camera[1]
    for k in range(3):
        ray[k] = direction[k] * u + direction[3 + k] * v + direction[6 + k]
    pair_count, slot_count = collect_layers(
        listed, record, box, tiles, tile_x, tile_y, colors, palette, depth, delta, depth_error, slope, ray,
        s, y1, y2, poly, rows, layers, width, offset_x, offset_y, pixels, batch, masks, asked, lists, lengths, reach,
        deep, far, first, last, slots, owners, drawn, places, moves, pairs, x0, y0, d, order, m, antialiased, rules,
        errors, floor, background, unseen, marks,
    )  # fmt: skip
    if pair_count == GROW:
        return False
    statistics[0] += 1
    if pair_count == GIVE_UP:
        # too much may be reordered: nothing is known
        statistics[3] += 1
        for k in range(listed.size):
            marks[listed[k]] = 1
        for q in range(PIXELS):
            row = y0 % side + q // BLOCK
            column = x0 % side + q % BLOCK
            for channel in range(3):
                lower[row, column, channel] = 0.0
                upper[row, column, channel] = 1.0
                if linear.shape[0] > 0:
                    linear[0, row, column, channel, 0] = 0.5
                    linear[0, row, column, channel, m] = 0.5
        return True
    if slot_count > 0:
        swap_bounds(
            pairs, pair_count, slots, slot_count, drawn, places, layers, width, lists, palette, forms, moves
        )
        settle_stops(
            layers, width, lists, lengths, first, last, owners, drawn, places, slot_count, s, m, rules[9], unit
        )
        number_chains(last[: listed.size], far)
    statistics[1] += longest_list(lengths)
    statistics[2] += pair_count
    shade(
        layers, width, lists, palette, forms, lengths, moves, far, slot_count > 0, background, unseen, fade,
        color_radius, negligible, unit, x0 % side, y0 % side, d, order, m, s, t, value, reach, first, lower, upper,
        linear, slopes, statistics,
    )  # fmt: skip
    return True


@njit(cache=True, error_model="numpy")
def _aligned(size):
    """Uninitialised doubles that begin with a cache line."""
    memory = np.empty(size + 7)
    start = -(memory.ctypes.data // 8) % 8
    return memory[start : start + size]


@njit(cache=True, error_model="numpy")
def _pixel_worker(
    thread, sequence_, counter_, wanted, offsets, entries, record_, box_, tiles_, depth_, delta_, depth_error_, colors_,
    color_radius, slope_, direction_, camera_, rules_, errors_, background_colors, floor, fade, negligible, pair_limit,
    d, order, m, antialiased, lower_, upper_, linear_, slopes_, statistics_, marks_,
):  # fmt: skip
    """One thread's tiles: the next of ``sequence`` that none has taken yet; see `pixel_stage`."""
    sequence, counter = borrowed(sequence_), pointer(counter_)
    record, box, tiles, depth = borrowed(record_), borrowed(box_), borrowed(tiles_), borrowed(depth_)
    delta, depth_error, colors, slope = borrowed(delta_), borrowed(depth_error_), borrowed(colors_), borrowed(slope_)
    direction, camera, rules, errors = borrowed(direction_), borrowed(camera_), borrowed(rules_), borrowed(errors_)
    lower, upper, slopes = borrowed(lower_), borrowed(upper_), borrowed(slopes_)
    linear, statistics, marks = borrowed(linear_), borrowed(statistics_), borrowed(marks_)
    image_width, image_height = camera[4], camera[5]
    side = lower.shape[1]
    tiles_x = int(math.ceil(image_width / side))
    blocks = side // BLOCK
    # columns of a layer, and numbers of a colour of the palette
    width = -(-(FORM + m + 1) // 8) * 8
    numbers = color_size(max(colors.shape[1] // 3 - 1, 1))
    scratch = np.zeros(ROWS * PIXELS)
    scratch[NUMBERS : NUMBERS + BLOCK] = np.arange(BLOCK)
    background_ = np.zeros(4)
    background_[:3] = background_colors
    unseen_ = np.zeros(8)
    channels_ = np.zeros(4 * (2 * m + 4))
    value_ = np.zeros(4 * m)
    planes = np.empty((2 * m, PIXELS))
    rows_ = np.zeros((width, PIXELS))
    offsets_ = np.zeros((2, BATCH * PIXELS + 8))
    pixels_ = np.empty(BATCH * PIXELS, np.uint8)
    batch_ = np.empty((2, BATCH + 1), np.int64)
    lengths_ = np.empty(PIXELS, np.uint32)
    ray_ = np.empty(3)
    s, t, value, background = borrowed(scratch), borrowed(channels_), borrowed(value_), borrowed(background_)
    unseen = borrowed(unseen_)
    y1, y2, poly = borrowed(planes[:m]), borrowed(planes[m:]), borrowed(rows_[FORM : FORM + m])
    rows, batch = borrowed(rows_.reshape(width * PIXELS)), borrowed(batch_)
    offset_x, offset_y = borrowed(offsets_[0]), borrowed(offsets_[1])
    pixels, lengths, ray = borrowed(pixels_), borrowed(lengths_), borrowed(ray_)
    layers_ = _aligned(256 * PIXELS * width)
    lists_ = np.empty((PIXELS, 256, LISTED), np.uint32)
    drawn_ = np.empty(512, np.int64)
    places_ = np.empty((512, PIXELS), np.uint32)
    moves_ = np.empty((8192, MOVES))
    reach_ = np.empty((2, 1024))
    order_ = np.empty((7, 1024), np.int64)
    palette_ = np.zeros(1024 * numbers)
    pairs_ = np.empty((pair_limit, 2), np.int64)
    block_offsets = np.empty(blocks * blocks + 1, np.int64)
    block_entries = np.empty(4096, np.uint32)
    while True:
        turn = taken(counter)
        if turn >= sequence.size:
            break
        number = sequence[turn]
        tile = wanted[number]
        tile_x = tile % tiles_x
        tile_y = tile // tiles_x
        block_entries = block_lists(
            entries[offsets[tile] : offsets[tile + 1]], box, tile_x * side, tile_y * side, side,
            block_offsets, block_entries,
        )  # fmt: skip
        for b in range(blocks * blocks):
            x0 = tile_x * side + (b % blocks) * BLOCK
            y0 = tile_y * side + (b // blocks) * BLOCK
            if x0 >= image_width or y0 >= image_height:
                continue
            listed = block_entries[block_offsets[b] : block_offsets[b + 1]]
            if listed.size >= reach_.shape[1]:
                reach_ = np.empty((2, 2 * listed.size))
                order_ = np.empty((7, 2 * listed.size), np.int64)
                palette_ = np.zeros(2 * listed.size * numbers)
            while not _block(
                borrowed(listed), x0, y0, tile_x, tile_y, record, box, tiles, depth, delta, depth_error, colors,
                color_radius, slope, direction, camera, rules, errors, background, unseen, floor, fade, negligible, d,
                order, m, antialiased, s, t, y1, y2, poly, rows, value, borrowed(palette_), borrowed(layers_), offset_x,
                offset_y, pixels, batch, borrowed(order_[0]), borrowed(order_[1]), borrowed(lists_), lengths,
                borrowed(reach_[0]), borrowed(reach_[1]), borrowed(order_[2]), borrowed(order_[3]),
                borrowed(order_[4]), borrowed(order_[5]), borrowed(order_[6]), borrowed(drawn_), borrowed(places_),
                borrowed(pairs_), borrowed(moves_), ray,
                lower[number], upper[number], linear[min(number, linear.shape[0]) :],
                slopes[number], statistics[thread], marks,
            ):  # fmt: skip
                capacity = 2 * lists_.shape[1]
                layers_ = _aligned(capacity * PIXELS * width)
                lists_ = np.empty((PIXELS, capacity, LISTED), np.uint32)
                drawn_ = np.empty(2 * capacity, np.int64)
                places_ = np.empty((2 * capacity, PIXELS), np.uint32)
                moves_ = np.empty((32 * capacity, MOVES))
    # the owners of the borrowed arrays live to here
    return (
        scratch.size + background_.size + unseen_.size + channels_.size + value_.size + planes.size + rows_.size
        + offsets_.size + pixels_.size + batch_.size + lengths_.size + ray_.size + layers_.size + lists_.size
        + drawn_.size + places_.size + moves_.size + reach_.size + order_.size + palette_.size + pairs_.size
    )  # fmt: skip


@njit(cache=True, parallel=True, error_model="numpy")
def pixel_stage(
    wanted, offsets, entries, record, box, tiles, depth, delta, depth_error, colors, color_radius,
    slope, direction, camera, rules, errors, background, floor, fade, negligible, pair_limit, d, order, m, antialiased,
    threads, lower, upper, linear, slopes, statistics, marks,
):  # fmt: skip
    """Bounds of the pixels of the tiles ``wanted`` [t] (tile numbers, row-major).

    Args:
        wanted: [t] int64.
        offsets, entries: Lists of the tiles, nearest first (`lists.tile_lists`, all tiles of the image).
        record .. depth_error: See `gaussians.gaussian_stage`.
        colors: [n, 3] or [n, 3 (m + 1)] forms.
        color_radius: Bound of the error of the colours, added to every result.
        slope: [rows, 3] third row of the rotation forms.
        direction: [9] the middle pose's world-to-camera rotation, row-major.
        floor: Layers are left out where no pose lets more light come to them (B6); none if negative.
        fade: Bound of the program's rounding when it adds up what was left out, in units of the brightest colour.
        negligible: Bound of what all layers that were left out for a negligible alpha may add up to.
        pair_limit: Most depth-order pairs looked at in one block.
        lower, upper: [t, side, side, 3] outputs.
        linear: [t, side, side, 3, m + 1] forms before the clamp, or empty.
        slopes: [t, d] sums of absolute linear coefficients, added to.
        marks: [n] uint8; set to 1 for every Gaussian that some pixel of these tiles may draw or stop at.
            Those that stay 0 are hidden or too faint for every pose: leaving them out changes nothing.
        statistics: [threads, 5] blocks, layers, uncertain pairs, blocks where too many pairs were
            uncertain, pixels with results that were not numbers.
    """
    sequence = longest_first(wanted, offsets)
    counter = np.zeros(1, np.int64)
    for thread in prange(threads):
        _pixel_worker(
            thread, sequence, counter, wanted, offsets, entries, record, box, tiles, depth, delta, depth_error, colors,
            color_radius, slope, direction, camera, rules, errors, background, floor, fade, negligible, pair_limit,
            d, order, m, antialiased, lower, upper, linear, slopes, statistics, marks,
        )  # fmt: skip
