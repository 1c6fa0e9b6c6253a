"""Bounds of one ray over a sub-box of a pose set, round by round, and halving of sub-boxes (design.md, H6 to H8)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import (
    HASH_BAND_ROUNDING,
    HASH_PLACES_ROUNDING,
    HASH_SUM_ROUNDING,
    HASH_UP,
    PIECE_END_ROUNDING,
    PIECE_PART_ROUNDING,
)
from ns_abstract.methods.nerf.hash_bounds.composition import (
    form_bounds,
    form_color,
    interval_colors,
    shifted_interval_colors,
    weight_bounds,
)
from ns_abstract.methods.nerf.hash_bounds.distribution import follow
from ns_abstract.methods.nerf.hash_bounds.edges import Edges, middle_of, space
from ns_abstract.methods.nerf.hash_bounds.features import FeatureRoom, level_features
from ns_abstract.methods.nerf.hash_bounds.forms import (
    COUNTED,
    UNCOUNTED,
    apply_band,
    exp_above,
    exp_band,
    exp_below,
    form_range,
    sigmoid_band,
)
from ns_abstract.methods.nerf.hash_bounds.light import Light, add_depth, begin, give_up
from ns_abstract.methods.nerf.hash_bounds.network import (
    HeadWeights,
    LayerZonotope,
    NetWeights,
    colors,
    from_features,
    output_form,
    remaining_layers,
    weigh_direction,
)
from ns_abstract.methods.nerf.hash_bounds.points import harmonics, line_form, point, quotients


class DensityArrays(NamedTuple):
    """A density of points as kernels take it.

    Attributes:
        table: [L, 2^T, F].
        resolutions: [L].
        ranges: [L, 2, F] least and largest value of every level.
        net: Its network; the first output is the logarithm of density over ``scale``.
        scale: Factor of densities.
    """

    table: np.ndarray
    resolutions: np.ndarray
    ranges: np.ndarray
    net: NetWeights
    scale: float


class FieldArrays(NamedTuple):
    """A hash-grid field as kernels take it.

    Attributes:
        proposals: `DensityArrays` of every round that places samples.
        head: Their colours.
        background: [3] behind the last sample.
        last: Whether the last sample's colour stands there instead.
        spacing: Whether distances are piecewise; the ends of rays in the spacing's units.
    """

    proposals: tuple[DensityArrays, ...]
    density: DensityArrays
    head: HeadWeights
    background: np.ndarray
    last: bool
    spacing: tuple[bool, float, float]


class PieceRoom(NamedTuple):
    """Scratch of one thread.

    Attributes:
        work: [24, n + 3] and [2, n + 4] forms.
        ray: Forms [3, n + 3] of the origin and direction, and the results of `quotients`.
        directions: [16, n + 3] harmonics, and their contribution to the first layer.
        features: [features, n + 3] of the widest encoding.
        levels: Scratch of one level of it.
        edges, light: Of every round.
        rooms: Neurons of density networks by round, of as many layers for each; ``head``: of the network of colours.
        colors: [N, 3, n + 4] forms, [2, N, 3] bounds, and as many numbers of scratch.
        live, rest: Scratch of layers.
    """

    work: tuple[np.ndarray, np.ndarray]
    ray: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    directions: tuple[np.ndarray, np.ndarray, np.ndarray]
    features: np.ndarray
    levels: FeatureRoom
    edges: tuple[Edges, ...]
    light: tuple[Light, ...]
    rooms: tuple[tuple[LayerZonotope, ...], ...]
    head: tuple[LayerZonotope, ...]
    colors: tuple[np.ndarray, np.ndarray, np.ndarray]
    live: np.ndarray
    rest: np.ndarray


class RayPolynomials(NamedTuple):
    """Rays over a box of poses (`ray_bundle.RayBundle`).

    Attributes:
        origin, origin_radius: [M, 3] and [3].
        direction, direction_radius: [rays, M, 3] and [rays, 3].
        exponents: [M, d].
    """

    origin: np.ndarray
    origin_radius: np.ndarray
    direction: np.ndarray
    direction_radius: np.ndarray
    exponents: np.ndarray


class WorkLimits(NamedTuple):
    """Limits of the work; soundness does not depend on them.

    Attributes:
        dark: Transmittance below which samples are left open, in rounds that place samples and in the last one.
        dim: Weight below which colours are left open.
    """

    dark: tuple[float, float]
    dim: float


@njit(cache=True, error_model="numpy", nogil=True, **UNCOUNTED)
def density_of(field, place, line, rooms, room, out):
    """Compute the form of a density's logarithm at contracted ``place`` [3, n + 3]; return the rows of its network.

    Args:
        place: Forms.
        rooms: `LayerZonotope` of every layer.
        out: [n + 3].
    """
    levels, features = field.table.shape[0], field.table.shape[2]
    for level in range(levels):
        level_features(
            field.table[level], float(field.resolutions[level]), place, field.ranges[level],
            room.features[level * features : (level + 1) * features], room.levels,
        )  # fmt: skip
    count = from_features(room.features[: levels * features], field.net, rooms[0])
    count = remaining_layers(rooms, count, field.net, room.live, room.rest)
    output_form(rooms[field.net.sizes.shape[0] - 2], count, 0, out.shape[0] - 1, out)
    return count


@njit(cache=True, error_model="numpy", nogil=True, **UNCOUNTED)
def _sample(field, edges, light, i, line, rooms, room):
    """Compute the depth of interval ``i`` of a round; return whether it is finite, and the network's rows."""
    work, wide = room.work
    distance, value, out, place = work[0], work[1], work[2], work[3:6]
    shares = middle_of(edges, i, distance)
    bounds = (0.0, np.inf)
    count = 0
    out[:] = 0.0
    out[-1] = np.inf
    if point(room.ray, distance, line, place, work[6:19]):
        count = density_of(field, place, line, rooms, room, value)
        low, high = form_range(value, line)
        if low <= high:
            bounds = exp_below(low) * field.scale, exp_above(high) * field.scale
            apply_band(value, exp_band(value[0], low, high), line, out)
            for s in range(out.shape[0]):
                out[s] *= field.scale
            out[-1] = (out[-1] + HASH_BAND_ROUNDING * abs(out[0])) * HASH_UP
            bounds = bounds[0] * (1.0 - HASH_BAND_ROUNDING), bounds[1] * (1.0 + HASH_BAND_ROUNDING)
    return add_depth(edges, i, out, bounds, shares, line, light, wide), count


@njit(cache=True, error_model="numpy", nogil=True, **UNCOUNTED)
def _color(field, edges, i, count, line, rooms, room):
    """Compute the colours of sample ``i`` from ``count`` rows of the density's network."""
    forms, bounds, _ = room.colors
    work = room.work[0]
    distance, value, out = work[0], work[1], work[2]
    n = out.shape[0] - 3
    start, stop = middle_of(edges, i, distance)
    rows = colors(
        rooms[field.density.net.sizes.shape[0] - 2], count, (room.directions[1], room.directions[2]), field.head,
        room.head, room.live, room.rest,
    )  # fmt: skip
    for c in range(3):
        output_form(room.head[len(room.head) - 1], rows, c, n + 2, value)
        low, high = form_range(value, line)
        if not low <= high:
            continue
        band = sigmoid_band(value[0], low, high)
        apply_band(value, band, line, out)
        if not out[n + 2] < 0.5:
            out[:] = 0.0
            out[0], out[n + 2] = 0.5, 0.5
        form = forms[i, c]
        for s in range(n + 1):
            form[s] = out[s]
        form[n + 1], form[n + 2] = out[n + 1] * start, out[n + 1] * stop
        left = max(1.0 - start - stop, 0.0) + HASH_SUM_ROUNDING
        form[n + 3] = (out[n + 2] + abs(out[n + 1]) * left) * HASH_UP
        ends = sigmoid_band(low, low, low)[0], sigmoid_band(high, high, high)[0]
        bounds[0, i, c] = max(ends[0] - HASH_BAND_ROUNDING, 0.0)
        bounds[1, i, c] = min(ends[1] + HASH_BAND_ROUNDING, 1.0)


@njit(cache=True, error_model="numpy", nogil=True, **UNCOUNTED)
def _round(field, edges, light, count, dark, line, rooms, room):
    """Compute the depths of a round that places samples; return whether they are finite."""
    begin(light)
    for i in range(count):
        bounded, _ = _sample(field, edges, light, i, line, rooms, room)
        if not bounded:
            return False
        if light.left[i + 1, 1] < dark:
            give_up(light, i + 1, count)
            break
    return True


@njit(cache=True, error_model="numpy", nogil=True, **UNCOUNTED)
def _start(rays, ray, middle, half, field, line, room):
    """Compute forms of a ray over a sub-box, the first edges, and the direction's contribution to the head."""
    origin, direction, ratios, shifts, along = room.ray
    for a in range(3):
        line_form(rays.origin[:, a], rays.exponents, rays.origin_radius[a], middle, half, line, origin[a])
        line_form(
            rays.direction[ray, :, a], rays.exponents, rays.direction_radius[ray, a], middle, half, line, direction[a]
        )
    work = room.work[0]
    quotients(origin, direction, line, ratios, shifts, along, work)
    harmonics(direction, line, room.directions[0], work)
    weigh_direction(room.directions[0], field.head, room.directions[1], room.directions[2])
    edges = room.edges[0]
    count = edges.low.shape[0] - 1
    for j in range(count + 1):
        edges.place[j] = 0.0
        edges.place[j, 0] = j / count
        edges.place[j, -2] = HASH_SUM_ROUNDING
        edges.low[j], edges.high[j] = j / count - HASH_SUM_ROUNDING, j / count + HASH_SUM_ROUNDING
        space(edges, j, field.spacing, line, work)


@njit(cache=True, error_model="numpy", nogil=True, **UNCOUNTED)
def bound_piece(field, rays, ray, middle, half, limits, room, out, shown):
    """Compute bounds ``out`` [2, 3] of a ray's colour over the box ``middle`` +- ``half`` [d] (design.md, H6, H7).

    Args:
        ray: Number of the ray.
        middle, half: [d] in [-1, 1].
        out: [2, 3]; overwritten: [0, 1] where no bound is known.
        shown: [3, n + 3] forms of the colours (`composition.form_color`), of infinite radius where none is known.

    Returns:
        Whether bounds are known; ``room`` then has the light and colours of the samples.
    """
    out[0], out[1] = 0.0, 1.0
    shown[:] = 0.0
    shown[:, -1] = np.inf
    line, rounds = middle.shape[0] == 1, len(room.light) - 1
    _start(rays, ray, middle, half, field, line, room)
    work = room.work[0]
    for r in range(rounds):
        edges, light, following = room.edges[r], room.light[r], room.edges[r + 1]
        count = light.least.shape[0]
        if not _round(field.proposals[r], edges, light, count, limits.dark[0], line, room.rooms[r], room):
            return False
        wanted = following.low.shape[0]
        if not follow(light, count, edges, wanted, line, following, work[:3]):
            return False
        for j in range(wanted):
            space(following, j, field.spacing, line, work)
    edges, light, rooms = room.edges[rounds], room.light[rounds], room.rooms[rounds]
    forms, bounds, _ = room.colors
    count, n = light.least.shape[0], work.shape[1] - 3
    forms[:] = 0.0
    forms[:, :, 0] = 0.5
    forms[:, :, n + 3] = 0.5
    bounds[0], bounds[1] = 0.0, 1.0
    begin(light)
    for i in range(count):
        bounded, rows = _sample(field.density, edges, light, i, line, rooms, room)
        if not bounded:
            return False
        whole = field.last and i == count - 1
        if rows > 0 and weight_bounds(light, i, whole)[1] > limits.dim:
            _color(field, edges, i, rows, line, rooms, room)
        if light.left[i + 1, 1] < limits.dark[1]:
            give_up(light, i + 1, count)
            break
    interval_colors(light, count, bounds[0], bounds[1], field.background, field.last, out)
    for c in range(3):
        form_color(light, count, forms[:, c], field.background[c], field.last, line, shown[c])
        low, high = form_bounds(shown[c], line)
        out[0, c] = min(max(out[0, c], low, 0.0), 1.0)
        out[1, c] = min(max(min(out[1, c], high), 0.0), 1.0)
        if not out[0, c] <= out[1, c]:
            out[0, c], out[1, c] = 0.0, 1.0
    return True


@njit(cache=True, error_model="numpy", nogil=True, **UNCOUNTED)
def _longest_axis(rays, ray, half):
    """Return the axis along which points move most."""
    terms, d = rays.exponents.shape
    best, axis = -1.0, 0
    for k in range(d):
        moved = 0.0
        for m in range(terms):
            if rays.exponents[m, k] > 0:
                for a in range(3):
                    moved += abs(rays.origin[m, a]) + abs(rays.direction[ray, m, a])
        if moved * half[k] > best:
            best, axis = moved * half[k], k
    return axis


@njit(cache=True, error_model="numpy", nogil=True, **UNCOUNTED)
def _on_part(form, line, low, high):
    """Return bounds of a ``form`` over parameters between ``low`` and ``high`` [d] in [-1, 1]."""
    n = form.shape[0] - 3
    rest = form[n + 2]
    if not rest < np.inf:
        return -np.inf, np.inf
    least = most = form[0]
    size = abs(form[0])
    if line:
        g, q, a, b = form[1], form[2], low[0], high[0]
        ends = g * a + q * (2.0 * a * a - 1.0), g * b + q * (2.0 * b * b - 1.0)
        down, up = min(ends[0], ends[1]), max(ends[0], ends[1])
        if q != 0.0 and a < -g / (4.0 * q) < b:
            vertex = -q - g * g / (8.0 * q)
            down, up = min(down, vertex), max(up, vertex)
        least, most, size = least + down, most + up, size + abs(g) + abs(q)
    else:
        for k in range(n):
            ends = form[1 + k] * low[k], form[1 + k] * high[k]
            least, most = least + min(ends[0], ends[1]), most + max(ends[0], ends[1])
            size += abs(form[1 + k])
    rest += HASH_PLACES_ROUNDING * size
    return least - rest, most + rest


@njit(cache=True, error_model="numpy", nogil=True, **COUNTED)
def _keep(out, counts, place, cells, found, shown, line, low, high):
    """Unite the bounds of a sub-box with those ``out`` [parts, 2, 3] of all parts that it meets.

    ``counts`` [d] are parts by axis; the sub-box is number ``place`` of ``cells`` [d] by axis; ``found`` and ``shown``
    are results of `bound_piece`; ``low`` and ``high`` [d] are scratch.
    """
    d = counts.shape[0]
    first, past, at = np.empty(d, np.int64), np.empty(d, np.int64), np.empty(d, np.int64)
    for k in range(d):
        first[k] = place[k] * counts[k] // cells[k]
        past[k] = -((-(place[k] + 1) * counts[k]) // cells[k])
        at[k] = first[k]
    while True:
        part = 0
        for k in range(d):
            part = part * counts[k] + at[k]
            # where the part begins and ends in the piece, with room for rounding
            scale = 2.0 * cells[k] / counts[k]
            low[k] = max(at[k] * scale - 2.0 * place[k] - 1.0 - PIECE_PART_ROUNDING * cells[k], -1.0)
            high[k] = min((at[k] + 1) * scale - 2.0 * place[k] - 1.0 + PIECE_PART_ROUNDING * cells[k], 1.0)
        for c in range(3):
            least, most = _on_part(shown[c], line, low, high)
            least, most = max(least, found[0, c]), min(most, found[1, c])
            if not least <= most:
                least, most = found[0, c], found[1, c]
            out[part, 0, c], out[part, 1, c] = min(out[part, 0, c], least), max(out[part, 1, c], most)
        k = d - 1
        while k >= 0:
            at[k] += 1
            if at[k] < past[k]:
                break
            at[k] = first[k]
            k -= 1
        if k < 0:
            return


@njit(cache=True, error_model="numpy", nogil=True, **COUNTED)
def bound_ray(field, rays, ray, cells, deepest, most, goal, limits, shifts, room, counts, out):
    """Compute bounds of a ray over each part of the box, from sub-boxes halved until they are tight (design.md, H8).

    Args:
        field, rays, ray, limits, room: See `bound_piece`.
        cells: [d] first sub-boxes by axis.
        deepest, most: Largest number of halvings of one of these, and of sub-boxes in all.
        goal: [3, 3] by channel: a sub-box is tight with bounds between the first two, or a radius below the third.
        shifts: [s, 2, 2] intervals of hue and saturation that are added to the samples' colours; empty: none.
        counts: [d] parts by axis.
        out: [s or 1, parts, 2, 3] bounds by shift; overwritten.

    Returns:
        The number of first sub-boxes, of bounded ones, and of those that were not halved.
    """
    d = cells.shape[0]
    first = 1
    for k in range(d):
        first *= cells[k]
    # place and cells by axis, and halvings
    stack = np.empty((first + deepest + 1, 2, d), np.int64)
    depth = np.zeros(first + deepest + 1, np.int64)
    outer = np.empty((first + deepest + 1, 2, 3))
    piece, middle, half = np.empty((2, 3)), np.empty(d), np.empty(d)
    low, high, lines = np.empty(d), np.empty(d), np.empty((3, room.features.shape[1]))
    for i in range(first):
        rest = i
        for k in range(d - 1, -1, -1):
            stack[i, 0, k], stack[i, 1, k] = rest % cells[k], cells[k]
            rest //= cells[k]
        outer[i, 0], outer[i, 1] = 0.0, 1.0
    out[:, :, 0], out[:, :, 1] = 1.0, 0.0
    height, tried, leaves = first, 0, 0
    while height:
        height -= 1
        for k in range(d):
            place, count = stack[height, 0, k], stack[height, 1, k]
            middle[k] = (2.0 * place + 1.0) / count - 1.0
            half[k] = 1.0 / count + PIECE_END_ROUNDING
        sampled = bound_piece(field, rays, ray, middle, half, limits, room, piece, lines)
        tried += 1
        good = True
        for c in range(3):
            piece[0, c], piece[1, c] = max(piece[0, c], outer[height, 0, c]), min(piece[1, c], outer[height, 1, c])
            if not piece[0, c] <= piece[1, c]:
                piece[0, c], piece[1, c] = outer[height, 0, c], outer[height, 1, c]
            inside = piece[0, c] >= goal[0, c] and piece[1, c] <= goal[1, c]
            good &= inside or lines[c, -1] <= goal[2, c]
        if good or depth[height] >= deepest or tried + height >= most:
            leaves += 1
            if not shifts.shape[0]:
                _keep(out[0], counts, stack[height, 0], stack[height, 1], piece, lines, d == 1, low, high)
            for s in range(shifts.shape[0]):
                piece[0], piece[1] = 0.0, 1.0
                lines[:, -1] = np.inf
                if sampled:
                    shifted_interval_colors(
                        room.light[len(room.light) - 1], room.light[len(room.light) - 1].least.shape[0],
                        room.colors[1], shifts[s], field.background, field.last, room.colors[2], piece,
                    )  # fmt: skip
                _keep(out[s], counts, stack[height, 0], stack[height, 1], piece, lines, d == 1, low, high)
            continue
        axis = _longest_axis(rays, ray, half)
        stack[height, 0, axis] *= 2
        stack[height, 1, axis] *= 2
        depth[height] += 1
        outer[height] = piece
        stack[height + 1] = stack[height]
        stack[height + 1, 0, axis] += 1
        depth[height + 1] = depth[height]
        outer[height + 1] = piece
        height += 2
    return first, tried, leaves


@njit(cache=True, error_model="numpy", nogil=True, **COUNTED)
def bound_rays(field, rays, cells, deepest, most, goal, limits, shifts, room, counts, out, pieces):
    """Call `bound_ray` for rays: ``cells`` [r, d], ``goal`` [r, 3, 3], ``out`` [r, ., parts, 2, 3], `pieces` [r, 3]."""
    for k in range(cells.shape[0]):
        pieces[k] = bound_ray(field, rays, k, cells[k], deepest, most, goal[k], limits, shifts, room, counts, out[k])
