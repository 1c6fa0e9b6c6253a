"""Backward coefficients on windows of a map, and their kernels (design.md, N5).

A row is one linear function of the numbers at a node. It is stored on its receptive field: ``value`` [R, C, h, w],
float32 or float64, and the window's first row and column ``y``, ``x`` [R], which may lie outside the map. Coefficients
outside mean nothing and are set to zero by whatever passes next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ns_abstract.arithmetic.elementary import fma
from ns_abstract.arithmetic.network_charges import OWN_GATHERED, OWN_ROWS
from ns_abstract.arithmetic.simd.intrinsics import offset_by, pointer
from ns_abstract.arithmetic.simd.lanes import load8, store, where

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
#: Rows are of either; kernels are compiled for both.
Floats = NDArray[np.floating[Any]]


def grid(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Return (channels, rows, columns) of an item; a vector is one row of one channel."""
    if len(shape) == 3:
        return shape[0], shape[1], shape[2]
    return 1, 1, int(np.prod(shape, dtype=np.int64))


@dataclass
class Coefficients:
    """Backward coefficients that vanish outside a window of a node's map."""

    value: Floats
    y: Int64
    x: Int64

    def __post_init__(self) -> None:
        # kernels go through memory as it lies
        self.value = np.ascontiguousarray(self.value)

    def __getitem__(self, chosen: Any) -> Coefficients:
        return Coefficients(self.value[chosen], self.y[chosen], self.x[chosen])

    @staticmethod
    def whole(value: Floats) -> Coefficients:
        """Return rows whose window is the whole map [R, C, H, W]."""
        zero = np.zeros(value.shape[0], np.int64)
        return Coefficients(np.ascontiguousarray(value), zero, zero)

    def replaced(self, value: Floats) -> Coefficients:
        """Return other coefficients [R, C, h, w] on the same windows."""
        return Coefficients(value, self.y, self.x)

    def covers(self, shape: tuple[int, ...]) -> bool:
        """Return whether every window is the whole map of ``shape``."""
        return self.value.shape[1:] == grid(shape) and not (self.y.any() or self.x.any())

    def scale(self, factor: Floats) -> None:
        """Multiply in place by ``factor`` [C, H, W], which has the rows' type."""
        _scale(self.value, self.y, self.x, factor)


def join(one: Coefficients, two: Coefficients, shape: tuple[int, ...]) -> Coefficients:
    """Return the sum of two sets of coefficients on a node of ``shape``."""
    one, two = full(one, shape), full(two, shape)
    if one.covers(shape) or two.covers(shape):
        one, two = full(one, shape, force=True), full(two, shape, force=True)
        one.value += two.value
        return one
    dy, dx = two.y - one.y, two.x - one.x
    assert dy.min() == dy.max() and dx.min() == dx.max(), "windows of one node move together"
    top, left = min(0, int(dy[0])), min(0, int(dx[0]))
    (h, w), (h2, w2) = one.value.shape[2:], two.value.shape[2:]
    height, width = max(h, int(dy[0]) + h2) - top, max(w, int(dx[0]) + w2) - left
    target = one.value
    if (height, width) != (h, w):
        target = np.zeros((*one.value.shape[:2], height, width), one.value.dtype)
        target[:, :, -top : h - top, -left : w - left] = one.value
    row, column = int(dy[0]) - top, int(dx[0]) - left
    target[:, :, row : row + h2, column : column + w2] += two.value
    return full(Coefficients(target, one.y + top, one.x + left), shape)


def shifted(coefficients: Coefficients, height: int, width: int) -> Coefficients:
    """Return the same coefficients on the whole map."""
    value = np.zeros((*coefficients.value.shape[:2], height, width), coefficients.value.dtype)
    _place(coefficients.value, coefficients.y, coefficients.x, value)
    return Coefficients.whole(value)


def full(coefficients: Coefficients, shape: tuple[int, ...], force: bool = False) -> Coefficients:
    """Return the coefficients on the whole map of ``shape`` if their windows are no smaller (or always)."""
    _, height, width = grid(shape)
    if coefficients.covers(shape):
        return coefficients
    if force or coefficients.value.shape[2] * coefficients.value.shape[3] >= height * width:
        return shifted(coefficients, height, width)
    return coefficients


def unflatten(coefficients: Coefficients, shape: tuple[int, ...], before: tuple[int, ...]) -> Coefficients:
    """Return the rows on an item of shape ``before`` for rows on the same numbers reshaped to ``shape``."""
    if grid(shape) == grid(before):
        return coefficients
    whole = full(coefficients, shape, force=True)
    return Coefficients.whole(whole.value.reshape(whole.value.shape[0], *grid(before)))


@njit(cache=True, error_model="numpy", nogil=True)
def _place(value, y, x, target):
    """Copy windows to their places in ``target`` [R, C, H, W]."""
    count, channels, h, w = value.shape
    H, W = target.shape[2:]
    for r in range(count):
        first, past = max(0, -x[r]), min(w, W - x[r])
        for c in range(channels):
            for i in range(max(0, -y[r]), min(h, H - y[r])):
                for j in range(first, past):
                    target[r, c, y[r] + i, x[r] + j] = value[r, c, i, j]


@njit(cache=True, error_model="numpy", nogil=True)
def add_gathered(value, y, x, height, width, index, target):
    """Add windows of a map [C, height, width] to ``target`` [R, M] at places ``index`` [C height width] (-1: none)."""
    count, channels, h, w = value.shape
    for r in range(count):
        first, past = max(0, -x[r]), min(w, width - x[r])
        for c in range(channels):
            for i in range(max(0, -y[r]), min(h, height - y[r])):
                row = (c * height + y[r] + i) * width + x[r]
                for j in range(first, past):
                    at = index[row + j]
                    if at >= 0:
                        target[r, at] += value[r, c, i, j]


@njit(cache=True, error_model="numpy", nogil=True)
def interleave(parts, s, t, top, left, whole):
    """Interleave the ``s t`` phases of a transposed convolution with stride (s, t), and crop the map to ``whole``.

    Args:
        parts: [R, s t C, h', w'], phase by phase; row ``s i + a`` and column ``t j + b`` of the map is element i, j of
            phase ``t a + b``.
        s, t: The stride.
        top, left: The row and the column of the map at which ``whole`` begins.
        whole: [R, C, h, w] output; zero beyond the map.
    """
    count, channels, h, w = whole.shape
    high, wide = parts.shape[2:]
    source, target = pointer(parts), pointer(whole)
    for r in range(count):
        for c in range(channels):
            for y in range(h):
                i, a = (y + top) // s, (y + top) % s
                here = ((r * channels + c) * h + y) * w
                if i >= high:
                    for j in range(w):
                        target[here + j] = 0.0
                    continue
                for b in range(t):
                    at = ((r * s * t * channels + (a * t + b) * channels + c) * high + i) * wide
                    first = -(-(left - b) // t)
                    # column t j + b of the map is column t j + b - left of the whole
                    past = -(-(w + left - b) // t)
                    for j in range(first, min(past, wide)):
                        target[here + b - left + t * j] = source[at + j]
                    for j in range(max(first, wide), past):
                        target[here + b - left + t * j] = 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _scale(value, y, x, factor):
    count, channels, h, w = value.shape
    H, W = factor.shape[1:]
    for r in range(count):
        for c in range(channels):
            for i in range(h):
                for j in range(w):
                    Y, X = y[r] + i, x[r] + j
                    value[r, c, i, j] *= factor[c, Y, X] if 0 <= Y < H and 0 <= X < W else np.float32(0.0)


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _through_activation(coefficient, at, line, here, plane):
    """Return the coefficient on the input of activation ``at``, and the constants that it adds below and above."""
    a = coefficient[at]
    # all lines are read and one kept: signs are as good as random, and so several numbers go side by side
    s0, l0, m0 = line[here], line[here + plane], line[here + 2 * plane]
    s1, l1, m1 = line[here + 3 * plane], line[here + 4 * plane], line[here + 5 * plane]
    negative = a < np.float32(0.0)
    b = np.float64(a)
    below, above = b * np.float64(l1 if negative else l0), b * np.float64(m1 if negative else m0)
    return a * (s1 if negative else s0), below, above


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _through_run(coefficient, at, line, here, plane, count):
    """Propagate ``count`` adjacent coefficients through an activation; return the constants added below and above."""
    l0, l1, l2, l3 = 0.0, 0.0, 0.0, 0.0
    m0, m1, m2, m3 = 0.0, 0.0, 0.0, 0.0
    for j in range(0, count - 3, 4):
        i, k = at + j, here + j
        a0, p0, q0 = _through_activation(coefficient, i, line, k, plane)
        a1, p1, q1 = _through_activation(coefficient, i + 1, line, k + 1, plane)
        a2, p2, q2 = _through_activation(coefficient, i + 2, line, k + 2, plane)
        a3, p3, q3 = _through_activation(coefficient, i + 3, line, k + 3, plane)
        # nothing is stored before all is read
        coefficient[i], coefficient[i + 1], coefficient[i + 2], coefficient[i + 3] = a0, a1, a2, a3
        l0, l1, l2, l3 = l0 + p0, l1 + p1, l2 + p2, l3 + p3
        m0, m1, m2, m3 = m0 + q0, m1 + q1, m2 + q2, m3 + q3
    for j in range(count - count % 4, count):
        a0, p0, q0 = _through_activation(coefficient, at + j, line, here + j, plane)
        coefficient[at + j] = a0
        l0, m0 = l0 + p0, m0 + q0
    return (l0 + l1) + (l2 + l3), (m0 + m1) + (m2 + m3)


@njit(cache=True, error_model="numpy", nogil=True)
def pass_activation(value, y, x, cell, lines, total):
    """Propagate rows [R, C, h, w] on an activation's output to its input, in place (N4).

    Args:
        value, y, x, cell: Rows, and each row's cell [R].
        lines: [6, m, C, H, W] of the rows' type: slope, lower and upper offset for coefficients >= 0; slope, upper and
            lower offset for negative ones.
        total: [R, 2] constants below and above, to which offsets are added.
    """
    count, channels, h, w = value.shape
    m, (H, W) = lines.shape[1], lines.shape[3:]
    plane = m * channels * H * W
    coefficient, line = pointer(value), pointer(lines)
    for r in range(count):
        top, left = y[r], x[r]
        if top == 0 and left == 0 and h == H and w == W:
            size = channels * H * W
            below, above = _through_run(coefficient, r * size, line, cell[r] * size, plane, size)
            total[r, 0] += below
            total[r, 1] += above
            continue
        first, past = min(w, max(0, -left)), max(0, min(w, W - left))
        least, most = 0.0, 0.0
        for c in range(channels):
            for i in range(h):
                at, Y = ((r * channels + c) * h + i) * w, top + i
                if Y < 0 or Y >= H or past <= first:
                    for j in range(w):
                        coefficient[at + j] = np.float32(0.0)
                    continue
                for j in range(first):
                    coefficient[at + j] = np.float32(0.0)
                for j in range(past, w):
                    coefficient[at + j] = np.float32(0.0)
                here = ((cell[r] * channels + c) * H + Y) * W + left
                below, above = _through_run(coefficient, at + first, line, here + first, plane, past - first)
                least += below
                most += above
        total[r, 0] += least
        total[r, 1] += most


@njit(cache=True, error_model="numpy", nogil=True)
def pass_maximum(value, y, x, cell, winner, which, slopes, offsets, steps, stride, total, target):
    """Propagate rows [R, C, h, w] on maxima of windows to ``target``, rows on the windows' inputs (N12).

    Args:
        value, y, x, cell: Rows, and each row's cell [R].
        winner, which, slopes, offsets: See `ns_abstract.verify.network.relaxations.MaxPoolPlanes`.
        steps: [K, 2] rows and columns of a window's inputs, from its first.
        stride: Rows and columns from one window to the next.
        total: [R, 2] constants below and above, to which offsets are added.
        target: [R, C, h', w'], zero.
    """
    count, channels, h, w = value.shape
    m, (H, W) = winner.shape[0], winner.shape[2:]
    high, wide = target.shape[2:]
    plane, taps = m * channels * H * W, steps.shape[0]
    coefficient, targets, line = pointer(value), pointer(target), pointer(offsets)
    first, chosen, slope = pointer(winner), pointer(which), pointer(slopes)
    ahead = steps[:, 0] * wide + steps[:, 1]
    for r in range(count):
        least, most = 0.0, 0.0
        for c in range(channels):
            for i in range(max(0, -y[r]), min(h, H - y[r])):
                at = ((r * channels + c) * h + i) * w
                here = ((cell[r] * channels + c) * H + y[r] + i) * W + x[r]
                there = ((r * channels + c) * high + i * stride[0]) * wide
                for j in range(max(0, -x[r]), min(w, W - x[r])):
                    a = coefficient[at + j]
                    if a == 0.0:
                        continue
                    b, k = np.float64(a), here + j + 2 * plane * np.int64(a < 0.0)
                    least += b * np.float64(line[k])
                    most += b * np.float64(line[k + plane])
                    number = np.int64(chosen[here + j])
                    to = there + j * stride[1]
                    if a > 0.0 or number < 0:
                        targets[to + ahead[first[here + j]]] += a
                        continue
                    for t in range(taps):
                        s = slope[number * taps + t]
                        if s != 0.0:
                            targets[to + ahead[t]] += a * s
        total[r, 0] += least
        total[r, 1] += most


@njit(cache=True, error_model="numpy", nogil=True)
def charge(value, y, x, cell, noise, total):
    """Charge rows on a linear layer's output with its rounding error ``noise`` [m, C, H, W] and their own (N2)."""
    count, channels, h, w = value.shape
    H, W = noise.shape[2:]
    coefficient, shake = pointer(value), pointer(noise)
    for r in range(count):
        top, left = y[r], x[r]
        first, past = min(w, max(0, -left)), max(0, min(w, W - left))
        shaken = 0.0
        for c in range(channels):
            for i in range(h):
                at, Y = ((r * channels + c) * h + i) * w, top + i
                if Y < 0 or Y >= H or past <= first:
                    for j in range(w):
                        coefficient[at + j] = np.float32(0.0)
                    continue
                for j in range(first):
                    coefficient[at + j] = np.float32(0.0)
                for j in range(past, w):
                    coefficient[at + j] = np.float32(0.0)
                here = ((cell[r] * channels + c) * H + Y) * W + left
                for j in range(first, past):
                    shaken += abs(np.float64(coefficient[at + j])) * shake[here + j]
        total[r, 0] -= shaken
        total[r, 1] += shaken


class NodeColumns(NamedTuple):
    """Planes and intervals of a node's values, laid out for `concretize` (docs/dev/design.md, N5).

    Attributes:
        values: [m K C H W + 8]. By cell: middles of the planes' slopes and offsets [d + 1] and of the intervals, half
            the distance of offsets and of intervals, magnitudes of all terms, and half the distance of slopes [d] if
            the planes differ in them. The last 8 numbers are padding for vector loads.
        count: K.
        height, width: H, W.
    """

    values: Float64
    count: int
    height: int
    width: int


def columns_of(slopes: Float64, offsets: Float64, lower: Float64, upper: Float64) -> NodeColumns:
    """Return the columns of planes (slopes [m, 2, C, H, W, d], offsets [m, 2, C, H, W]) and intervals [m, C, H, W]."""
    m, d, shape = slopes.shape[0], slopes.shape[-1], offsets.shape[2:]
    apart = slopes[:, 1] - slopes[:, 0]
    tilted = bool(apart.any())
    count = d + 5 + (d if tilted else 0)
    values = np.zeros(m * count * math.prod(shape) + 8)
    columns = values[:-8].reshape(m, count, *shape)
    columns[:, :d] = np.moveaxis(0.5 * slopes[:, 0] + 0.5 * slopes[:, 1], -1, 1)
    columns[:, d], columns[:, d + 1] = 0.5 * offsets.sum(1), 0.5 * (lower + upper)
    columns[:, d + 2], columns[:, d + 3] = 0.5 * (offsets[:, 1] - offsets[:, 0]), 0.5 * (upper - lower)
    columns[:, d + 4] = np.abs(offsets).sum(1) + np.abs(slopes).sum((1, -1)) + np.abs(lower) + np.abs(upper)
    if tilted:
        columns[:, d + 5 :] = np.moveaxis(0.5 * apart, -1, 1)
    return NodeColumns(values, count, shape[1], shape[2])


@njit(cache=True, error_model="numpy", nogil=True)
def _add_run(tape, n, column, here, step, columns, signed, sums):
    """Add ``n`` coefficients [tape] times columns to ``sums`` [columns, 8]; the first ``signed`` with their signs."""
    last = n - n % 8
    for k in range(columns):
        at = here + k * step
        total = load8(sums, 8 * k)
        if k < signed:
            for j in range(0, last, 8):
                total = fma(load8(tape, j), load8(column, at + j), total)
        else:
            for j in range(0, last, 8):
                total = fma(abs(load8(tape, j)), load8(column, at + j), total)
        if last < n:
            a = load8(tape, last)
            product = (a if k < signed else abs(a)) * load8(column, at + last)
            total = total + where(a != 0.0, product, 0.0)
        store(sums, 8 * k, total)


@njit(cache=True, error_model="numpy", nogil=True)
def concretize(value, y, x, cell, intermediate, total, plane, box):
    """Concretise rows on a node with known planes and intervals (N5).

    Args:
        value, y, x, cell: Rows, and each row's cell [R].
        intermediate: `NodeColumns` of the node.
        total: [R, 2] constants that the rows gathered.
        plane: [R, 2, d + 1] output: slopes and offset of planes below and above.
        box: [R, 2] output: a lower and an upper bound from the intervals alone.
    """
    count, channels, h, w = value.shape
    H, W, columns, d = intermediate.height, intermediate.width, intermediate.count, plane.shape[2] - 1
    size = channels * H * W
    coefficient, column = pointer(value), pointer(intermediate.values)
    whole = h == H and w == W
    # lanes by column, then coefficients of a run
    memory = np.empty(8 * columns + (size if whole else w) + 8)
    sums = pointer(memory)
    tape = offset_by(sums, 8 * columns)
    for r in range(count):
        top, left, cells = y[r], x[r], cell[r] * columns * size
        memory[: 8 * columns] = 0.0
        if whole and top == 0 and left == 0:
            for j in range(size):
                tape[j] = np.float64(coefficient[r * size + j])
            for j in range(size, size + 8):
                tape[j] = 0.0
            _add_run(tape, size, column, cells, size, columns, d + 2, sums)
        else:
            first, past = max(0, -left), min(w, W - left)
            n = max(0, past - first)
            for c in range(channels):
                for i in range(max(0, -top), min(h, H - top)):
                    at = ((r * channels + c) * h + i) * w + first
                    for j in range(n):
                        tape[j] = np.float64(coefficient[at + j])
                    for j in range(n, n + 8):
                        tape[j] = 0.0
                    here = cells + (c * H + top + i) * W + left + first
                    _add_run(tape, n, column, here, size, columns, d + 2, sums)
        for k in range(columns):
            low = (sums[8 * k] + sums[8 * k + 1]) + (sums[8 * k + 2] + sums[8 * k + 3])
            sums[k] = low + ((sums[8 * k + 4] + sums[8 * k + 5]) + (sums[8 * k + 6] + sums[8 * k + 7]))
        for k in range(d):
            apart = sums[d + 5 + k] if columns > d + 5 else 0.0
            plane[r, 0, k] += sums[k] - apart
            plane[r, 1, k] += sums[k] + apart
        # sums of at most 2^24 products
        room = OWN_ROWS * sums[d + 4] + OWN_GATHERED * (abs(total[r, 0]) + abs(total[r, 1]))
        least, most = total[r, 0] - room, total[r, 1] + room
        plane[r, 0, d], plane[r, 1, d] = least + (sums[d] - sums[d + 2]), most + (sums[d] + sums[d + 2])
        box[r, 0], box[r, 1] = least + (sums[d + 1] - sums[d + 3]), most + (sums[d + 1] + sums[d + 3])
