"""Alpha compositing of the fragments of a pixel, in first-order forms over boxes of poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from ns_abstract.check.forms import TINY, Affine, Array, U

#: Light at which the rasteriser stops.
STOP = 1e-4
#: Relative room around decisions, for the rounding of their thresholds.
ROOM = 1e-12
#: Places in the order that a Gaussian may move by before a box is given up.
LONGEST = 96


def gathered(part: Any, row: Array, index: Array) -> Any:
    """Return the elements of ``part`` (an array, a form [..., B, n], or a list) at rows [W, 1] and columns [W, m]."""
    if isinstance(part, Affine):
        return part.apply(lambda a: a[..., row, index])
    if isinstance(part, np.ndarray):
        return part[row, index]
    parts = [gathered(e, row, index) for e in part]
    return type(part)(*parts) if isinstance(part, tuple) else parts


def blended(
    alpha: Affine, color: Affine, depth: Affine, shows: Array, background: Array, unit: float
) -> tuple[Affine, Array]:
    """Return the composited colours [B, 3] before the clamp, and which fragments [B, n] may contribute.

    Depth orders and early stops that are open within a box are enclosed with every outcome. Alphas, depths and
    ``shows`` (may pass the alpha threshold) are [B, n], colours [3, B, n]; ``unit`` is the roundoff of compositing.
    """
    # those that do not show stand behind all others
    order = np.argsort(np.where(shows, depth.c, np.inf), axis=1, kind="stable")
    order, keep = order[:, : shows.sum(axis=1).max()], np.zeros(shows.shape, bool)
    count, n = order.shape
    alpha, color, depth, shows = gathered([alpha, color, depth, shows], np.arange(count)[:, None], order)
    color = color.apply(lambda a: np.moveaxis(a, -3, -1))
    al, ah = (np.clip(a, 0.0, 1.0) for a in alpha.range())
    cl, ch = color.range()
    # a slope that all share changes no order
    common = (depth.g * (shows / np.maximum(shows.sum(axis=1, keepdims=True), 1))).sum(axis=2, keepdims=True)
    room = (np.abs(depth.g - common).sum(axis=0) + depth.r) * (1.0 + 64.0 * U) + 64.0 * U * depth.size()
    room = np.where(np.isnan(room), np.inf, room)
    low, high = (np.where(shows, depth.c + s * room, -s * np.inf) for s in (-1.0, 1.0))
    front, back = np.maximum.accumulate(high, axis=1), np.minimum.accumulate(low[:, ::-1], axis=1)[:, ::-1]
    # whether all in front of a place is surely in front of all behind it
    clean = np.ones((count, n + 1), bool)
    clean[:, 1:n] = front[:, :-1] < back[:, 1:]
    step = 1.0 + 8.0 * n * U + 4.0 * n * unit
    most, least = (
        np.concatenate([np.ones((count, 1)), np.cumprod(1.0 - a, axis=1)], axis=1) * s
        for a, s in ((al, step), (ah, 1.0 / step))
    )
    most[:, 0] = least[:, 0] = 1.0
    place = np.arange(n + 1)[None]
    # the first fragment at which the rasteriser may stop, and the first at which it surely has stopped
    may, sure = least[:, 1:] <= STOP * (1.0 + ROOM + 4.0 * unit), most[:, 1:] <= STOP * (1.0 - ROOM - 4.0 * unit)
    first, last = ((~np.logical_or.accumulate(a, axis=1)).sum(axis=1)[:, None] for a in (may, sure))
    begin = np.where(clean & (place <= first), place, 0).max(axis=1)[:, None]
    plain = np.take_along_axis(clean, last, 1) & np.take_along_axis(clean, np.minimum(last + 1, n), 1)
    end = np.where(plain, last, np.where(clean & (place > last), place, n).min(axis=1)[:, None])
    inside = (place[:, :-1] < end) & (ah > 0.0)
    form = from_the_back(alpha, color, inside, background, unit)
    # other orders than that of the centres, and earlier stops
    lower, upper = _reordering_bounds((low, high, front, back), inside, most, ah, cl, ch)
    at = ((place[:, :-1] >= begin) & (place[:, :-1] < end))[..., None]
    room = 1.0 + ROOM + 8.0 * n * unit
    light = np.where(at[..., 0], STOP * room / np.maximum(1.0 - ah, 1e-3), 0.0).max(axis=1, initial=0.0)
    light = np.minimum(light, np.take_along_axis(most, begin, 1)[:, 0])[:, None] * (begin < end) * room
    darkest = np.minimum(np.where(at, cl, np.inf).min(axis=1, initial=np.inf), background)
    brightest = np.maximum(np.where(at, ch, -np.inf).max(axis=1, initial=-np.inf), background)
    lower = lower - np.where(light > 0.0, light * (brightest - background), 0.0)
    upper = upper + np.where(light > 0.0, light * (background - darkest), 0.0)
    # where nothing shows the background is drawn, exactly
    rest = 0.5 * (upper - lower) * (1.0 + ROOM) + 8.0 * U * (np.abs(form.c) + 1.0) * inside.any(axis=1)[:, None]
    middle = 0.5 * (lower + upper)
    bad = ~np.isfinite(rest)
    form = Affine(form.c + np.where(bad, 0.0, middle), form.g, form.r + np.where(bad, np.inf, rest))
    np.put_along_axis(keep, order, (place[:, :-1] < end + 1) & shows, 1)
    return form, keep


def from_the_back(alpha: Affine, color: Affine, inside: Array, background: Array, unit: float) -> Affine:
    """Return the colours [B, 3] of fragments composited back to front, in the order of their middle depths.

    S' = S + alpha (C - S): an error of S is scaled by 1 - alpha, one of C by alpha. In float32 a fragment's
    transmittance errs by 2 units for each fragment in front of it, and each sum by one unit.
    """
    count = len(inside)
    size = np.maximum(color.size().max(axis=(1, 2), initial=0.0), np.abs(background).max(initial=1.0))[:, None]
    c, r = np.broadcast_to(background, (count, 3)), np.zeros((count, 3))
    g = np.zeros((len(alpha.g), count, 3))
    al, ah = (np.clip(a, 0.0, 1.0) for a in alpha.range())
    slope = alpha.slope
    for k in np.flatnonzero(inside.any(axis=0))[::-1]:
        used = inside[:, k, None] * 1.0
        a, da, ra, s = (v[..., k, None] * used for v in (alpha.c, alpha.g, alpha.r, slope))
        d, dg = color.c[:, k] - c, color.g[:, :, k] - g
        tilt = np.abs(dg).sum(axis=0)
        r = (1.0 - al[:, k, None] * used) * r + ah[:, k, None] * used * color.r[:, k]
        r = (r + ra * (np.abs(d) + tilt) + s * tilt) * (1.0 + 16.0 * U) + (32.0 * U * size + TINY) * used
        c, g = c + a * d, g + a * dg + da * d
    drawn = inside.sum(axis=1, keepdims=True)
    # what is outside of the colours is not known better than that
    return Affine(c, g, np.where(np.isfinite(r), r, np.inf)).wider((4.0 * drawn + 16.0 * (drawn > 0)) * unit * size)


def _reordering_bounds(depths: Any, inside: Array, most: Array, ah: Array, cl: Array, ch: Array) -> tuple[Array, Array]:
    """Return the least and the largest change [B, 3] of the colour by depth orders other than that of the middles.

    Sorting by exchanges of neighbours exchanges each inverted pair once. An exchange changes the colour by the
    transmittance in front, times both alphas, times the difference of colours. A fragment that is surely in front of
    both stays in front of them throughout.
    """
    (count, n), (dlow, dhigh, front, back) = inside.shape, depths
    begin = np.stack([np.searchsorted(f, low) for f, low in zip(front, dlow, strict=True)])
    light, lower, upper = np.take_along_axis(most, begin, 1), np.zeros((count, 3)), np.zeros((count, 3))
    for k in range(1, n):
        if not ((back[:, k:] <= dhigh[:, :-k]) & inside[:, k:]).any():
            break
        if k > LONGEST:
            return lower - np.inf, upper + np.inf
        pair = inside[:, :-k] & inside[:, k:] & ~(dhigh[:, :-k] < dlow[:, k:])
        rows = np.flatnonzero(pair.any(axis=1))
        weight = np.where(pair, np.maximum(light[:, :-k], light[:, k:]) * ah[:, :-k] * ah[:, k:], 0.0)[rows, :, None]
        down = np.where(weight > 0.0, weight * np.minimum(cl[rows, k:] - ch[rows, :-k], 0.0), 0.0)
        up = np.where(weight > 0.0, weight * np.maximum(ch[rows, k:] - cl[rows, :-k], 0.0), 0.0)
        lower[rows], upper[rows] = lower[rows] + down.sum(axis=1), upper[rows] + up.sum(axis=1)
    return lower * (1.0 + ROOM), upper * (1.0 + ROOM)
