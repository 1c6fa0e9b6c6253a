"""Bounds of hash features: mean-value forms over the cells that a point may lie in (design.md, H3)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import CELL_ROUNDING, HASH_UP, TRILINEAR_ROUNDING
from ns_abstract.methods.nerf.hash_bounds.forms import UNCOUNTED, spread_of
from ns_abstract.methods.nerf.hash_field import PRIME_Y, PRIME_Z

#: Most nodes by axis of a level whose slopes are looked at, and in all of those of which the hull of values is taken.
FORM_NODES, HULL_NODES = 6, 4096


class FeatureRoom(NamedTuple):
    """Scratch of `level_features`, which is called so often that allocating it would take as long as using it.

    Attributes:
        cells: [2, 3] first node and number of nodes.
        ends: [4, 3] position, least and largest position in cells, and half of the range.
        nodes: [6, 6, 6, F] values at the nodes of a small box.
        kept: [2, 6, 6, 6] values on its faces.
        slopes: [2, 3] least and largest slopes.
        hull: [2, F] least and largest values.
    """

    cells: np.ndarray
    ends: np.ndarray
    nodes: np.ndarray
    kept: np.ndarray
    slopes: np.ndarray
    hull: np.ndarray


def feature_room(features: int) -> FeatureRoom:
    """Return scratch for levels of ``features`` features."""
    box = (FORM_NODES,) * 3
    return FeatureRoom(
        np.zeros((2, 3), np.int64), np.zeros((4, 3)), np.zeros((*box, features)), np.zeros((2, *box)), np.zeros((2, 3)),
        np.zeros((2, features)),
    )  # fmt: skip


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def hash_row(x, y, z, rows):
    """Return the row of a level's table, of ``rows`` (a power of two), of the corner (x, y, z)."""
    return (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & (rows - 1)


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _gather(table, first, counts, nodes):
    """Copy values ``nodes`` [6, 6, 6, F] of a level's ``table`` [2^T, F] from the corner ``first`` [3] on."""
    for i in range(counts[0]):
        for j in range(counts[1]):
            for k in range(counts[2]):
                row = hash_row(first[0] + i, first[1] + j, first[2] + k, table.shape[0])
                for f in range(table.shape[1]):
                    nodes[i, j, k, f] = table[row, f]


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _hull(table, first, counts, low, high):
    """Compute the least and largest value [F] of the nodes from ``first`` on."""
    low[:], high[:] = np.inf, -np.inf
    for i in range(counts[0]):
        for j in range(counts[1]):
            for k in range(counts[2]):
                row = hash_row(first[0] + i, first[1] + j, first[2] + k, table.shape[0])
                for f in range(table.shape[1]):
                    low[f] = min(low[f], table[row, f])
                    high[f] = max(high[f], table[row, f])


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _across(nodes, i, j, k, y, z, f):
    """Return a feature's value on face ``i`` of a grid of nodes, interpolated at ``y``, ``z`` from the node (j, k)."""
    a = nodes[i, j, k, f] + y * (nodes[i, j + 1, k, f] - nodes[i, j, k, f])
    b = nodes[i, j, k + 1, f] + y * (nodes[i, j + 1, k + 1, f] - nodes[i, j, k + 1, f])
    return a + z * (b - a)


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def _slopes(nodes, counts, place, low, high, f, kept, slopes):
    """Return the value of a feature at ``place``, and compute its slopes [2, 3] from there to all of the box (H3).

    ``nodes`` [6, 6, 6, F] are values, ``counts`` [3] of them by axis, at least 2. ``place``, ``low`` and ``high`` [3]
    are in cells from the first node on. ``slopes`` receives the least and largest; ``kept`` [2, 6, 6, 6] is scratch.
    """
    nx, ny, nz = counts
    cx = min(max(int(math.floor(place[0])), 0), nx - 2)
    cy = min(max(int(math.floor(place[1])), 0), ny - 2)
    cz = min(max(int(math.floor(place[2])), 0), nz - 2)
    rx, ry, rz = place[0] - cx, place[1] - cy, place[2] - cz
    slopes[0], slopes[1] = np.inf, -np.inf
    # along x, where y and z are those of the place
    value = 0.0
    for i in range(nx - 1):
        here, there = _across(nodes, i, cy, cz, ry, rz, f), _across(nodes, i + 1, cy, cz, ry, rz, f)
        step = there - here
        slopes[0, 0], slopes[1, 0] = min(slopes[0, 0], step), max(slopes[1, 0], step)
        if i == cx:
            value = here + rx * step
    # at the ends of the box along x, and at nodes between; the same along y
    at_x, at_y = kept[0], kept[1]
    for i in range(nx):
        c, r = i, 0.0
        if i == 0:
            r = low[0]
        elif i == nx - 1:
            c, r = nx - 2, high[0] - (nx - 2)
        for j in range(ny):
            for k in range(nz):
                here = nodes[c, j, k, f]
                at_x[i, j, k] = here + r * (nodes[c + 1, j, k, f] - here) if r != 0.0 else here
    for i in range(nx):
        for j in range(ny - 1):
            a, b = at_x[i, j + 1, cz] - at_x[i, j, cz], at_x[i, j + 1, cz + 1] - at_x[i, j, cz + 1]
            step = a + rz * (b - a)
            slopes[0, 1], slopes[1, 1] = min(slopes[0, 1], step), max(slopes[1, 1], step)
    for i in range(nx):
        for j in range(ny):
            c, r = j, 0.0
            if j == 0:
                r = low[1]
            elif j == ny - 1:
                c, r = ny - 2, high[1] - (ny - 2)
            for k in range(nz):
                here = at_x[i, c, k]
                at_y[i, j, k] = here + r * (at_x[i, c + 1, k] - here) if r != 0.0 else here
    for i in range(nx):
        for j in range(ny):
            for k in range(nz - 1):
                step = at_y[i, j, k + 1] - at_y[i, j, k]
                slopes[0, 2], slopes[1, 2] = min(slopes[0, 2], step), max(slopes[1, 2], step)
    return value


@njit(cache=True, error_model="numpy", **UNCOUNTED)
def level_features(table, resolution, point, ranges, out, room):
    """Compute forms ``out`` [F, n + 3] of one level's features at a contracted ``point`` [3, n + 3] in [0, 1] (H3).

    ``table`` [2^T, F] holds the level's values, ``ranges`` [2, F] their least and largest; ``resolution``: cells by
    axis.
    """
    features, width = out.shape
    first, counts = room.cells[0], room.cells[1]
    place, low, high, reach = room.ends[0], room.ends[1], room.ends[2], room.ends[3]
    nodes = 1
    for a in range(3):
        q = resolution * point[a, 0]
        reach[a] = (resolution * spread_of(point[a]) + CELL_ROUNDING * (resolution + abs(q))) * HASH_UP
        below, above = q - reach[a], q + reach[a]
        begin = math.floor(below)
        first[a] = int(begin)
        counts[a] = max(int(math.ceil(above - begin)), 1) + 1
        place[a], low[a], high[a] = q - begin, below - begin, above - begin
        # beyond any number of nodes that is looked at
        nodes = min(nodes * min(counts[a], 1 << 16), 1 << 30)
    if max(counts[0], counts[1], counts[2]) > FORM_NODES:
        least, most = room.hull[0], room.hull[1]
        if nodes <= HULL_NODES:
            _hull(table, first, counts, least, most)
        else:
            for f in range(features):
                least[f], most[f] = ranges[0, f], ranges[1, f]
        for f in range(features):
            out[f] = 0.0
            out[f, 0] = 0.5 * (least[f] + most[f])
            size = max(abs(least[f]), abs(most[f]))
            out[f, -1] = (0.5 * (most[f] - least[f]) + TRILINEAR_ROUNDING * size) * HASH_UP
        return
    values, slopes = room.nodes, room.slopes
    _gather(table, first, counts, values)
    for f in range(features):
        size = 0.0
        for i in range(counts[0]):
            for j in range(counts[1]):
                for k in range(counts[2]):
                    size = max(size, abs(values[i, j, k, f]))
        out[f] = 0.0
        out[f, 0] = _slopes(values, counts, place, low, high, f, room.kept, slopes)
        rest = TRILINEAR_ROUNDING * size
        for a in range(3):
            slope = 0.5 * (slopes[0, a] + slopes[1, a])
            half = 0.5 * (slopes[1, a] - slopes[0, a]) + TRILINEAR_ROUNDING * size
            for s in range(1, width - 1):
                out[f, s] += slope * resolution * point[a, s]
            rest += abs(slope) * (resolution * point[a, -1] + CELL_ROUNDING * resolution) + half * reach[a]
        out[f, -1] = rest * HASH_UP
