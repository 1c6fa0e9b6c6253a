"""Rows of coefficients on windows of a map: what passes backwards through a network (design.md, N5).

A row is one linear function of the numbers at a node. In a convolutional network it depends on a window of
the map only, its receptive field, so that is what is stored: ``value`` [R, C, h, w] float32 and the window's
first row and column ``y``, ``x`` [R], which may lie outside the map. Coefficients outside mean nothing and
are set to zero by whatever passes next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ns_abstract.arithmetic.simd.intrinsics import pointer

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


def grid(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """(channels, rows, columns) of an item: a vector is one row of one channel."""
    if len(shape) == 3:
        return shape[0], shape[1], shape[2]
    return 1, 1, int(np.prod(shape, dtype=np.int64))


@dataclass
class Rows:
    """Windows of rows; see the module."""

    value: Float32
    y: Int64
    x: Int64

    def __post_init__(self) -> None:
        # kernels go through memory as it lies
        self.value = np.ascontiguousarray(self.value)

    def __getitem__(self, chosen: Any) -> Rows:
        return Rows(self.value[chosen], self.y[chosen], self.x[chosen])

    @staticmethod
    def whole(value: Float32) -> Rows:
        """Rows that cover their map [R, C, H, W]."""
        zero = np.zeros(value.shape[0], np.int64)
        return Rows(np.ascontiguousarray(value), zero, zero)

    def covers(self, shape: tuple[int, ...]) -> bool:
        """Whether the rows are those of the whole map of ``shape``."""
        return self.value.shape[1:] == grid(shape) and not (self.y.any() or self.x.any())

    def scale(self, factor: Float32) -> None:
        """Multiply by ``factor`` [C, H, W] in place."""
        _scale(self.value, self.y, self.x, factor)


def join(one: Rows, two: Rows, shape: tuple[int, ...]) -> Rows:
    """Sum of two sets of rows on a node of ``shape``."""
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
        target = np.zeros((*one.value.shape[:2], height, width), np.float32)
        target[:, :, -top : h - top, -left : w - left] = one.value
    row, column = int(dy[0]) - top, int(dx[0]) - left
    target[:, :, row : row + h2, column : column + w2] += two.value
    return full(Rows(target, one.y + top, one.x + left), shape)


def shifted(rows: Rows, height: int, width: int) -> Rows:
    """The same rows on the whole map."""
    value = np.zeros((*rows.value.shape[:2], height, width), np.float32)
    _place(rows.value, rows.y, rows.x, value)
    return Rows.whole(value)


def full(rows: Rows, shape: tuple[int, ...], force: bool = False) -> Rows:
    """Rows on the whole map of ``shape``, if their windows are no smaller than it (or always)."""
    _, height, width = grid(shape)
    if rows.covers(shape):
        return rows
    if force or rows.value.shape[2] * rows.value.shape[3] >= height * width:
        return shifted(rows, height, width)
    return rows


def unflatten(rows: Rows, shape: tuple[int, ...], before: tuple[int, ...]) -> Rows:
    """Rows on an item of ``before`` for rows on the same numbers seen as ``shape``."""
    if grid(shape) == grid(before):
        return rows
    whole = full(rows, shape, force=True)
    return Rows.whole(whole.value.reshape(whole.value.shape[0], *grid(before)))


@njit(cache=True, error_model="numpy", nogil=True)
def _place(value, y, x, target):
    """Copy windows to where they lie in ``target`` [R, C, H, W]."""
    count, channels, h, w = value.shape
    H, W = target.shape[2:]
    for r in range(count):
        first, past = max(0, -x[r]), min(w, W - x[r])
        for c in range(channels):
            for i in range(max(0, -y[r]), min(h, H - y[r])):
                for j in range(first, past):
                    target[r, c, y[r] + i, x[r] + j] = value[r, c, i, j]


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
def _passed(rows, at, line, here, plane):
    """What a number becomes, and what it adds below and above."""
    a = rows[at]
    # all lines are read and one kept: signs are as good as random, and so several numbers go side by side
    s0, l0, m0 = line[here], line[here + plane], line[here + 2 * plane]
    s1, l1, m1 = line[here + 3 * plane], line[here + 4 * plane], line[here + 5 * plane]
    negative = a < np.float32(0.0)
    b = np.float64(a)
    below, above = b * np.float64(l1 if negative else l0), b * np.float64(m1 if negative else m0)
    return a * (s1 if negative else s0), below, above


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _pass_run(rows, at, line, here, plane, count):
    """Pass ``count`` numbers that lie together; returns what they add below and above."""
    l0, l1, l2, l3 = 0.0, 0.0, 0.0, 0.0
    m0, m1, m2, m3 = 0.0, 0.0, 0.0, 0.0
    for j in range(0, count - 3, 4):
        i, k = at + j, here + j
        a0, p0, q0 = _passed(rows, i, line, k, plane)
        a1, p1, q1 = _passed(rows, i + 1, line, k + 1, plane)
        a2, p2, q2 = _passed(rows, i + 2, line, k + 2, plane)
        a3, p3, q3 = _passed(rows, i + 3, line, k + 3, plane)
        # nothing is stored before all is read
        rows[i], rows[i + 1], rows[i + 2], rows[i + 3] = a0, a1, a2, a3
        l0, l1, l2, l3 = l0 + p0, l1 + p1, l2 + p2, l3 + p3
        m0, m1, m2, m3 = m0 + q0, m1 + q1, m2 + q2, m3 + q3
    for j in range(count - count % 4, count):
        a0, p0, q0 = _passed(rows, at + j, line, here + j, plane)
        rows[at + j] = a0
        l0, m0 = l0 + p0, m0 + q0
    return (l0 + l1) + (l2 + l3), (m0 + m1) + (m2 + m3)


@njit(cache=True, error_model="numpy", nogil=True)
def pass_activation(value, y, x, cell, lines, total):
    """Rows [R, C, h, w] on an activation's output become rows on its input, in place (N4).

    Args:
        value, y, x, cell: Rows and which cell each belongs to [R].
        lines: [6, m, C, H, W] float32: slope, lower and upper offset for coefficients that are not negative;
            slope, upper and lower offset for negative ones.
        total: [R, 2] gathers what the rows are at least and at most.
    """
    count, channels, h, w = value.shape
    m, (H, W) = lines.shape[1], lines.shape[3:]
    plane = m * channels * H * W
    rows, line = pointer(value), pointer(lines)
    for r in range(count):
        top, left = y[r], x[r]
        if top == 0 and left == 0 and h == H and w == W:
            size = channels * H * W
            below, above = _pass_run(rows, r * size, line, cell[r] * size, plane, size)
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
                        rows[at + j] = np.float32(0.0)
                    continue
                for j in range(first):
                    rows[at + j] = np.float32(0.0)
                for j in range(past, w):
                    rows[at + j] = np.float32(0.0)
                here = ((cell[r] * channels + c) * H + Y) * W + left
                below, above = _pass_run(rows, at + first, line, here + first, plane, past - first)
                least += below
                most += above
        total[r, 0] += least
        total[r, 1] += most


@njit(cache=True, error_model="numpy", nogil=True)
def pass_maximum(value, y, x, cell, winner, which, slopes, offsets, steps, stride, total, target):
    """Rows [R, C, h, w] on maxima of windows become rows ``target`` on the numbers of the windows (N12).

    Args:
        value, y, x, cell: Rows and which cell each belongs to [R].
        winner, which, slopes, offsets: See `ns_abstract.verify.network.bounds._Maxima`.
        steps: [K, 2] rows and columns of a window's numbers, from its first.
        stride: Rows and columns from one window to the next.
        total: [R, 2] gathers what the rows are at least and at most.
        target: [R, C, h', w'], zero.
    """
    count, channels, h, w = value.shape
    m, (H, W) = winner.shape[0], winner.shape[2:]
    high, wide = target.shape[2:]
    plane, taps = m * channels * H * W, steps.shape[0]
    rows, found, line = pointer(value), pointer(target), pointer(offsets)
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
                    a = rows[at + j]
                    if a == 0.0:
                        continue
                    b, k = np.float64(a), here + j + 2 * plane * np.int64(a < 0.0)
                    least += b * np.float64(line[k])
                    most += b * np.float64(line[k + plane])
                    number = np.int64(chosen[here + j])
                    to = there + j * stride[1]
                    if a > 0.0 or number < 0:
                        found[to + ahead[first[here + j]]] += a
                        continue
                    for t in range(taps):
                        s = slope[number * taps + t]
                        if s != 0.0:
                            found[to + ahead[t]] += a * s
        total[r, 0] += least
        total[r, 1] += most


@njit(cache=True, error_model="numpy", nogil=True)
def charge(value, y, x, cell, noise, total):
    """Charge rows on a linear layer's output with its rounding and their own, ``noise`` [m, C, H, W] (N2)."""
    count, channels, h, w = value.shape
    H, W = noise.shape[2:]
    rows, shake = pointer(value), pointer(noise)
    for r in range(count):
        top, left = y[r], x[r]
        first, past = min(w, max(0, -left)), max(0, min(w, W - left))
        shaken = 0.0
        for c in range(channels):
            for i in range(h):
                at, Y = ((r * channels + c) * h + i) * w, top + i
                if Y < 0 or Y >= H or past <= first:
                    for j in range(w):
                        rows[at + j] = np.float32(0.0)
                    continue
                for j in range(first):
                    rows[at + j] = np.float32(0.0)
                for j in range(past, w):
                    rows[at + j] = np.float32(0.0)
                here = ((cell[r] * channels + c) * H + Y) * W + left
                for j in range(first, past):
                    shaken += abs(np.float64(rows[at + j])) * shake[here + j]
        total[r, 0] -= shaken
        total[r, 1] += shaken


@njit(cache=True, error_model="numpy", nogil=True)
def concretize(value, y, x, cell, slopes, offsets, lower, upper, total, plane, box):
    """Bounds of rows on a node of which planes and intervals are known (N5).

    Args:
        value, y, x, cell: Rows.
        slopes: [m, 2, C, H, W, d] of the lower and upper planes.
        offsets: [m, 2, C, H, W].
        lower, upper: [m, C, H, W].
        total: [R, 2] what the rows gathered on their way.
        plane: [R, 2, d + 1] becomes slopes and offset of planes below and above.
        box: [R, 2] becomes a lower and an upper bound from ``lower`` and ``upper`` alone.
    """
    count, channels, h, w = value.shape
    H, W, d = slopes.shape[3:]
    size = channels * H * W
    rows, slope, offset = pointer(value), pointer(slopes), pointer(offsets)
    least, most = pointer(lower), pointer(upper)
    sums_ = np.empty((2, d))
    sums = pointer(sums_)
    for r in range(count):
        top, left, whole = y[r], x[r], 2 * size * cell[r]
        first, past = max(0, -left), min(w, W - left)
        below, above, low, high, total_size = 0.0, 0.0, 0.0, 0.0, 0.0
        sums_[:] = 0.0
        for c in range(channels):
            for i in range(max(0, -top), min(h, H - top)):
                at = ((r * channels + c) * h + i) * w
                here = (c * H + top + i) * W + left
                for j in range(first, past):
                    a = np.float64(rows[at + j])
                    # the plane below for positive coefficients, the one above for others, without a branch
                    other = size * np.int64(a <= 0.0)
                    one = whole + other + here + j
                    two = whole + (size - other) + here + j
                    b0, b1 = a * offset[one], a * offset[two]
                    below += b0
                    above += b1
                    reached = abs(b0) + abs(b1)
                    for l in range(d):
                        s0, s1 = a * slope[one * d + l], a * slope[two * d + l]
                        sums[l] += s0
                        sums[d + l] += s1
                        reached += abs(s0) + abs(s1)
                    k = size * cell[r] + here + j
                    e0, e1 = a * least[k], a * most[k]
                    low += min(e0, e1)
                    high += max(e0, e1)
                    total_size += reached + abs(e0) + abs(e1)
        for l in range(d):
            plane[r, 0, l] += sums[l]
            plane[r, 1, l] += sums[d + l]
        # sums of at most 2^24 products
        room = 2.0**-28 * total_size + 2.0**-48 * (abs(total[r, 0]) + abs(total[r, 1]))
        plane[r, 0, d], box[r, 0] = total[r, 0] + below - room, total[r, 0] + low - room
        plane[r, 1, d], box[r, 1] = total[r, 1] + above + room, total[r, 1] + high + room
