"""Bounds of hash features: mean-value forms over the cells that a point may lie in (design.md, H3)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ns_abstract.arithmetic.rounding import CELL_ROUNDING, HASH_UP, TRILINEAR_ROUNDING
from ns_abstract.methods.nerf.hash_bounds.forms import spread_of
from ns_abstract.methods.nerf.nerfacto_kernel import hash_row

#: Most nodes of a level whose slopes are looked at, and of which the hull of values is taken.
FORM_NODES, HULL_NODES = 216, 4096


@njit(cache=True, error_model="numpy")
def _gather(table, first, counts, nodes):
    """Values ``nodes`` [counts, F] of a level's ``table`` [2^T, F] from the corner ``first`` [3] on."""
    for i in range(counts[0]):
        for j in range(counts[1]):
            for k in range(counts[2]):
                row = hash_row(first[0] + i, first[1] + j, first[2] + k, table.shape[0])
                for f in range(table.shape[1]):
                    nodes[i, j, k, f] = table[row, f]


@njit(cache=True, error_model="numpy")
def _hull(table, first, counts, low, high):
    """Least and largest value [F] of the nodes from ``first`` on."""
    low[:], high[:] = np.inf, -np.inf
    for i in range(counts[0]):
        for j in range(counts[1]):
            for k in range(counts[2]):
                row = hash_row(first[0] + i, first[1] + j, first[2] + k, table.shape[0])
                for f in range(table.shape[1]):
                    low[f] = min(low[f], table[row, f])
                    high[f] = max(high[f], table[row, f])


@njit(cache=True, error_model="numpy")
def _slopes(nodes, counts, place, low, high, f, kept, slopes):
    """The value of a feature at ``place`` and its slopes [2, 3] between there and the box (design.md, H3).

    Args:
        nodes: [counts, F] values.
        counts: [3] nodes by axis, at least 2.
        place, low, high: [3] in cells from the first node on.
        f: The feature.
        kept: [2, 6, 6, 6] scratch.
        slopes: [2, 3] least and largest; overwritten.
    """
    nx, ny, nz = counts
    cell = np.empty(3, np.int64)
    for a in range(3):
        cell[a] = min(max(int(math.floor(place[a])), 0), counts[a] - 2)
    cx, cy, cz = cell
    rx, ry, rz = place[0] - cx, place[1] - cy, place[2] - cz
    slopes[0], slopes[1] = np.inf, -np.inf
    # along x, where y and z are those of the place
    value = 0.0
    for i in range(nx - 1):
        ends = np.empty(2)
        for e in range(2):
            a = nodes[i + e, cy, cz, f] + ry * (nodes[i + e, cy + 1, cz, f] - nodes[i + e, cy, cz, f])
            b = nodes[i + e, cy, cz + 1, f] + ry * (nodes[i + e, cy + 1, cz + 1, f] - nodes[i + e, cy, cz + 1, f])
            ends[e] = a + rz * (b - a)
        step = ends[1] - ends[0]
        slopes[0, 0], slopes[1, 0] = min(slopes[0, 0], step), max(slopes[1, 0], step)
        if i == cx:
            value = ends[0] + rx * step
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


@njit(cache=True, error_model="numpy")
def level_features(table, resolution, point, ranges, out):
    """Forms of one level's features at a contracted point (design.md, H3).

    Args:
        table: [2^T, F] values of the level.
        resolution: Cells by axis.
        point: [3, n + 3] forms in [0, 1].
        ranges: [2, F] least and largest value of the level.
        out: [F, n + 3].
    """
    features, width = out.shape
    first, counts = np.empty(3, np.int64), np.empty(3, np.int64)
    place, low, high, reach = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
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
    if nodes > FORM_NODES or max(counts[0], counts[1], counts[2]) > 6:
        least, most = np.empty(features), np.empty(features)
        if nodes <= HULL_NODES:
            _hull(table, first, counts, least, most)
        else:
            least[:], most[:] = ranges[0], ranges[1]
        for f in range(features):
            out[f] = 0.0
            out[f, 0] = 0.5 * (least[f] + most[f])
            size = max(abs(least[f]), abs(most[f]))
            out[f, -1] = (0.5 * (most[f] - least[f]) + TRILINEAR_ROUNDING * size) * HASH_UP
        return
    values = np.empty((counts[0], counts[1], counts[2], features))
    kept, slopes = np.empty((2, 6, 6, 6)), np.empty((2, 3))
    _gather(table, first, counts, values)
    for f in range(features):
        size = 0.0
        for i in range(counts[0]):
            for j in range(counts[1]):
                for k in range(counts[2]):
                    size = max(size, abs(values[i, j, k, f]))
        out[f] = 0.0
        out[f, 0] = _slopes(values, counts, place, low, high, f, kept, slopes)
        rest = TRILINEAR_ROUNDING * size
        for a in range(3):
            slope = 0.5 * (slopes[0, a] + slopes[1, a])
            half = 0.5 * (slopes[1, a] - slopes[0, a]) + TRILINEAR_ROUNDING * size
            for s in range(1, width - 1):
                out[f, s] += slope * resolution * point[a, s]
            rest += abs(slope) * (resolution * point[a, -1] + CELL_ROUNDING * resolution) + half * reach[a]
        out[f, -1] = rest * HASH_UP
