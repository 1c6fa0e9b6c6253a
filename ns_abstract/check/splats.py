"""Enclosures of one pixel of a Splatfacto picture over boxes of camera poses, by gsplat's rules in real numbers.

The picture is a function ``F`` of the alphas and colours of the Gaussians in depth order, linear in each of them. Its
form is that of the mean value theorem: ``F`` at the centres, plus interval derivatives times the deviations of alphas
and colours, which are forms in the pose. What depends on decisions that are open within a box (threshold, tile, depth
order, stop) is enclosed with both outcomes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ns_abstract.check.forms import TINY, Form, U, total
from ns_abstract.check.poses import Poses

Array = Any

NEAR, FAR, BLUR, MARGIN, TILE = 0.01, 1e10, 0.3, 0.3, 16
LEAST_ALPHA, STOP = 1.0 / 255.0, 1e-4
#: Relative room around decisions, for the rounding of their thresholds.
ROOM = 1e-12
#: Most Gaussians that may change their order with one another before a box is given up.
LONGEST_GROUP = 96


class Rules(NamedTuple):
    """What differs between gsplat's versions in real numbers: alpha's cap, least compensation, tiles that cut."""

    cap: float
    least_factor: float
    tiles: bool


RULES = {
    "1.4.0": Rules(0.999, 0.0, True),
    # from 1.5 on a box holds every pixel with an alpha above the threshold, so that tiles change nothing
    "1.5.3": Rules(0.999, 0.0, False),
    "1.6.0": Rules(float(np.float32(0.99)), float(np.float32(0.005)), False),
}


@dataclass(frozen=True)
class Splats:
    """A scene's activated Gaussians: float64 arrays and how far they may be from the real numbers.

    Attributes:
        means: [N, 3], exact.
        axes: [N, 3, 3], column k is the k-th axis times its scale; entries are within ``axes_error`` [N, 3] of columns.
        opacity: [N], within a relative 32 U.
        sh: [N, K, 3] coefficients, or [N, 1, 3] logits where ``sigmoid``.
    """

    means: Array
    axes: Array
    axes_error: Array
    opacity: Array
    sh: Array
    sigmoid: bool
    degree: int
    antialiased: bool
    background: Array
    rules: Rules


def activated(
    means: Array, logs: Array, quats: Array, logits: Array, sh: Array, *, sigmoid: bool, degree: int,
    antialiased: bool, background: Array, version: str,
) -> Splats:  # fmt: skip
    """The scene of stored float32 parameters."""
    logs, q, logits = (v.astype(np.float64) for v in (logs, quats, logits))
    scales = np.exp(logs)
    w, x, y, z = (q / np.sqrt((q * q).sum(axis=1, keepdims=True))).T
    turn = np.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        axis=1,
    ).reshape(-1, 3, 3)  # fmt: skip
    with np.errstate(over="ignore"):
        opacity = 1.0 / (1.0 + np.exp(-logits))
    return Splats(
        means.astype(np.float64), turn * scales[:, None, :], 96.0 * U * scales, opacity, sh.astype(np.float64),
        sigmoid, degree, antialiased, np.asarray(background, np.float64), RULES[version],
    )  # fmt: skip


def candidates(splats: Splats, poses: Poses, low: Array, high: Array, pixel: tuple[int, int]) -> Array:
    """Numbers of all Gaussians that may show at the pixel for some pose of a box; [d] ends of the box."""
    view = poses.view(low[None], high[None])
    x, y, z = _points(splats, view, np.arange(len(splats.means)))
    zl, zh = (v[0] for v in z.range())
    open_ = ~(zl > 0.5 * NEAR)
    zl = np.where(open_, 1.0, zl)
    cam, found = poses.camera, (zh >= NEAR * (1.0 - ROOM)) & ~(zl > FAR * (1.0 + ROOM))
    with np.errstate(all="ignore"):
        reach = np.sqrt(2.0 * np.log(np.maximum(splats.opacity * (1.0 + ROOM) * 255.0, 1.0))) * (1.0 + ROOM)
        # keyframes' rotations stretch by a hundredth at most
        size = np.sqrt((splats.axes**2).sum(axis=1).max(axis=1))
        for t, f, centre, place, side in (
            (x, cam.fx, cam.cx, pixel[1], cam.width), (y, cam.fy, cam.cy, pixel[0], cam.height)
        ):  # fmt: skip
            a, b = (v[0] for v in t.range())
            least = f * np.minimum(a / zl, a / zh) + centre - (place + 0.5)
            most = f * np.maximum(b / zl, b / zh) + centre - (place + 0.5)
            away = np.maximum(np.maximum(least, -most), 0.0) * (1.0 - ROOM) - 1e-9
            limit = (max(centre, side - centre) + 0.15 * side) / f * (1.0 + ROOM)
            spread = 1.05 * f / zl * size * np.sqrt(1.0 + limit * limit)
            found &= open_ | ~(away > reach * np.sqrt(spread * spread + BLUR) * (1.0 + ROOM))
    found &= splats.opacity * (1.0 + ROOM) >= LEAST_ALPHA
    return np.flatnonzero(found)


def _points(splats: Splats, view: Any, index: Array) -> list[Form]:
    """Camera coordinates [B, n] of the means."""
    rotation, shift, origin = view
    near = splats.means[index][None] - origin[:, None, :]
    error = 2.0 * U * (np.abs(splats.means[index])[None] + np.abs(origin)[:, None, :])
    found = []
    for row, move in zip(rotation, shift, strict=True):
        parts = []
        for s, entry in enumerate(row):
            part = wide(entry) * near[..., s]
            part.r = part.r + 1.5 * error[..., s]
            parts.append(part)
        found.append(total(parts) + wide(move))
    return found


def wide(form: Form) -> Form:
    """Forms [B] as forms [B, 1]."""
    return Form(form.c[:, None], form.g[:, :, None], form.r[:, None])


class _Fragments(NamedTuple):
    """Alphas, colours and depths of Gaussians, forms [B, n], and which may show at all."""

    alpha: Form
    color: Form
    depth: Form
    shows: Array
    motion: Array


def _fragments(
    splats: Splats, poses: Poses, low: Array, high: Array, index: Array, pixel: tuple[int, int], channel: int
) -> _Fragments:
    view = poses.view(low, high)
    cam, rules = poses.camera, splats.rules
    x, y, z = _points(splats, view, index)
    iz = z.reciprocal()
    u, v = x * iz, y * iz
    mx, my = u * cam.fx + cam.cx, v * cam.fy + cam.cy
    dx, dy = mx - (pixel[1] + 0.5), my - (pixel[0] + 0.5)
    tx, ty = MARGIN * 0.5 * cam.width / cam.fx, MARGIN * 0.5 * cam.height / cam.fy
    uc = u.clamped(-(cam.cx / cam.fx + tx), (cam.width - cam.cx) / cam.fx + tx)
    vc = v.clamped(-(cam.cy / cam.fy + ty), (cam.height - cam.cy) / cam.fy + ty)
    axes, rotation = splats.axes[index], view[0]
    sizes = splats.axes_error[index]
    rows = []
    for k in range(3):
        turned = []
        for r in range(3):
            one = total(wide(rotation[r][s]) * axes[None, :, s, k] for s in range(3))
            one.r = one.r + 4.0 * sizes[None, :, k]
            turned.append(one)
        rows.append(turned)
    across, down = iz * cam.fx, iz * cam.fy
    m = [across * (rows[k][0] - uc * rows[k][2]) for k in range(3)]
    n = [down * (rows[k][1] - vc * rows[k][2]) for k in range(3)]
    mm, nn = total(e.square() for e in m), total(e.square() for e in n)
    minors = [m[a] * n[b] - m[b] * n[a] for a, b in ((0, 1), (0, 2), (1, 2))]
    flat = total(e.square() for e in minors)
    det = flat + (mm + nn) * BLUR + BLUR * BLUR
    near = total((n[k] * dx - m[k] * dy).square() for k in range(3))
    exponent = (near + (dx.square() + dy.square()) * BLUR) * 0.5 * det.reciprocal()
    opacity = Form.constant(splats.opacity[index][None], dx, 32.0 * U * splats.opacity[index][None])
    if splats.antialiased:
        opacity = opacity * _factor(flat, det, rules.least_factor)
    elow = np.maximum(exponent.range()[0], 0.0)
    ehigh = exponent.range()[1]
    olow, ohigh = opacity.range()
    plain = np.exp(-np.minimum(np.stack([elow, ehigh]), 700.0)) * np.array([1 + ROOM, 1 - ROOM])[:, None, None]
    most = np.where(np.isfinite(elow), np.maximum(ohigh, 0.0) * plain[0], np.minimum(1.0, splats.opacity[index])[None])
    most = np.where(np.isfinite(most), most, 1.0)
    least = np.where(np.isfinite(ehigh) & np.isfinite(olow), np.maximum(olow, 0.0) * plain[1], 0.0)
    alpha = (-exponent).exp() * opacity
    zl, zh = z.range()
    shows = (most >= LEAST_ALPHA * (1.0 - ROOM)) & ~(zh < NEAR * (1.0 - ROOM)) & ~(zl > FAR)
    surely = (least >= LEAST_ALPHA * (1.0 + ROOM)) & (zl >= NEAR * (1.0 + ROOM)) & (zh <= FAR)
    if rules.tiles:
        maybe, certain = _tiles(cam, pixel, (mx, my), (mm, nn), total(m[k] * n[k] for k in range(3)))
        shows, surely = shows & maybe, surely & certain
    alow, ahigh = alpha.range()
    # the form must say no less than the interval, and stay below the cap
    rough = ~((ahigh - alow) <= 1.5 * (most - least)) | ~(ahigh <= rules.cap) | ~(alow >= 0.0) | ~surely
    top = np.minimum(most, rules.cap)
    bottom = np.where(surely, np.minimum(least, rules.cap), 0.0)
    alpha = alpha.boxed(rough, bottom, np.maximum(top, bottom))
    gone = np.where(shows, 1.0, 0.0)
    alpha = Form(alpha.c * gone, alpha.g * gone, alpha.r * gone)
    motion = np.where(shows[None], np.abs(mx.g) + np.abs(my.g), 0.0).max(axis=2, initial=0.0)
    color = _colors(splats, poses, view, low, high, index, channel, dx)
    return _Fragments(alpha, color, z, shows, motion)


def _factor(flat: Form, det: Form, least: float) -> Form:
    """The opacity's factor sqrt(max(0, det before / det after the blur)), not below ``least``."""
    ratio = flat * det.reciprocal()
    low, high = flat.range()
    dlow, dhigh = det.range()
    with np.errstate(all="ignore"):
        bottom = np.sqrt(np.maximum(low, 0.0) / dhigh) * (1.0 - ROOM)
        top = np.sqrt(np.maximum(high, 0.0) / np.maximum(dlow, BLUR * BLUR)) * (1.0 + ROOM)
    bottom = np.where(np.isfinite(bottom), bottom, 0.0)
    top = np.minimum(np.where(np.isfinite(top), top, 1.0), 1.0)
    root = ratio.root()
    rlow, rhigh = root.range()
    rough = ~((rhigh - rlow) <= 1.5 * (top - bottom))
    return root.boxed(rough, bottom, np.maximum(top, bottom)).clamped(least, 1.0 + ROOM)


def _tiles(cam: Any, pixel: tuple[int, int], centre: tuple[Form, Form], squares: tuple[Form, Form], mixed: Form) -> Any:
    """Whether gsplat 1.4.0 may, and surely does, list a Gaussian for the pixel's tile."""
    (al, ah), (bl, bh), (ml, mh) = squares[0].range(), squares[1].range(), mixed.range()
    al, bl = np.maximum(al, 0.0), np.maximum(bl, 0.0)
    dh = np.maximum(np.abs(ah - bl), np.abs(bh - al))
    dl = np.maximum(np.maximum(al - bh, bl - ah), 0.0)
    xl = np.where((ml <= 0.0) & (mh >= 0.0), 0.0, np.minimum(np.abs(ml), np.abs(mh)))
    xh = np.maximum(np.abs(ml), np.abs(mh))
    small = np.maximum(0.25 * dl * dl + xl * xl, 0.01) * (1.0 - ROOM)
    large = np.maximum(0.25 * dh * dh + xh * xh, 0.01) * (1.0 + ROOM)
    rl = np.ceil(3.0 * np.sqrt(0.5 * (al + bl) + BLUR + np.sqrt(small)) * (1.0 - ROOM))
    rh = np.ceil(3.0 * np.sqrt(0.5 * (ah + bh) + BLUR + np.sqrt(large)) * (1.0 + ROOM))
    maybe = certain = True
    for form, place, side in ((centre[0], pixel[1], cam.width), (centre[1], pixel[0], cam.height)):
        low, high = form.range()
        first = TILE * (place // TILE)
        last = min(first + TILE, side)
        certain = certain & (high - rl < last - 1e-9) & (low + rl > first + 1e-9)
        # the negations keep what is not a number
        maybe = maybe & ~(low - rh > last + 1e-9) & ~(high + rh < first - 1e-9)
    return maybe, certain


def _colors(
    splats: Splats, poses: Poses, view: Any, low: Array, high: Array, index: Array, channel: int, like: Form
) -> Form:
    sh = splats.sh[index][None, :, :, channel]
    if splats.sigmoid:
        value = 1.0 / (1.0 + np.exp(-sh[..., 0]))
        return Form.constant(value, like, 32.0 * U * value)
    found = Form.constant(0.28209479177387814 * sh[..., 0] + 0.5, like, 8.0 * U * (np.abs(sh[..., 0]) + 1.0))
    if splats.degree and np.any(sh[..., 1:]):
        x, y, z = _directions(splats, poses, low, high, index, view)
        bands = [y * -0.4886025119029199, z * 0.4886025119029199, x * -0.4886025119029199]
        if splats.degree >= 2 and np.any(sh[..., 4:]):
            xx, yy, zz = x.square(), y.square(), z.square()
            bands += [
                x * y * 1.0925484305920792, y * z * -1.0925484305920792,
                (zz * 2.0 - xx - yy) * 0.31539156525252005,
                x * z * -1.0925484305920792, (xx - yy) * 0.5462742152960396,
            ]  # fmt: skip
            if splats.degree >= 3 and np.any(sh[..., 9:]):
                bands += [
                    y * (xx * 3.0 - yy) * -0.5900435899266435, x * y * z * 2.890611442640554,
                    y * (zz * 4.0 - xx - yy) * -0.4570457994644658,
                    z * (zz * 2.0 - xx * 3.0 - yy * 3.0) * 0.3731763325901154,
                    x * (zz * 4.0 - xx - yy) * -0.4570457994644658,
                    z * (xx - yy) * 1.445305721320277, x * (xx - yy * 3.0) * -0.5900435899266435,
                ]  # fmt: skip
        for k, band in enumerate(bands):
            found = found + band * sh[..., k + 1]
    return found.clamped(0.0, np.inf)


def _directions(splats: Splats, poses: Poses, low: Array, high: Array, index: Array, view: Any) -> list[Form]:
    """Unit vectors from the camera to the means, world axes."""
    position, origin = poses.position(low, high), view[2]
    near = splats.means[index][None] - origin[:, None, :]
    error = 2.0 * U * (np.abs(splats.means[index])[None] + np.abs(origin)[:, None, :])
    parts = []
    for k in range(3):
        part = -wide(position[k]) + near[..., k]
        part.r = part.r + error[..., k]
        parts.append(part)
    length = total(e.square() for e in parts).root().reciprocal()
    return [e * length for e in parts]


def pixel_form(
    splats: Splats, poses: Poses, low: Array, high: Array, index: Array, pixel: tuple[int, int], channel: int
) -> tuple[Form, Array, Array]:
    """The pixel's channel before the clamp over every box, a form [B]; which Gaussians may matter [B, n]; their motion.

    The motion [d, B], in pixels, is what each parameter moves a Gaussian by at most, about.

    Args:
        low, high: [B, d] ends of the boxes.
        index: [n] numbers of the Gaussians that may show (`candidates`).
        pixel: Row and column.
    """
    background = float(splats.background[channel])
    with np.errstate(all="ignore"):
        f = _fragments(splats, poses, low, high, index, pixel, channel)
        used = np.flatnonzero(f.shows.any(axis=0))
        if not len(used):
            zero = np.zeros(len(low))
            return Form(zero + background, np.zeros((low.shape[1], len(low))), zero), f.shows, f.motion
        alpha, color, depth, shows = f.alpha.among(used), f.color.among(used), f.depth.among(used), f.shows[:, used]
        # those that do not show stand behind all others
        key = np.where(shows, depth.c, np.inf)
        order = np.argsort(key, axis=1, kind="stable")
        alpha, color, depth = alpha.take(order), color.take(order), depth.take(order)
        shows = np.take_along_axis(shows, order, 1)
        form, matters = _blended(alpha, color, depth, shows, background)
        keep = np.zeros(f.shows.shape, bool)
        np.put_along_axis(keep, used[order], matters & shows, 1)
        return form, keep, f.motion


def _groups(depth: Form, shows: Array) -> tuple[Array, Array, Array]:
    """[B, n + 1] whether all in front of a place in the order is surely in front of all behind it; ranges of depth."""
    n = shows.shape[1]
    weight = shows / np.maximum(shows.sum(axis=1, keepdims=True), 1)
    # a slope that all share changes no order
    common = (depth.g * weight).sum(axis=2, keepdims=True)
    room = (np.abs(depth.g - common).sum(axis=0) + depth.r) * (1.0 + 64.0 * U) + 64.0 * U * (
        np.abs(depth.c) + depth.slope
    )
    low = np.where(shows, depth.c - room, np.inf)
    high = np.where(shows, depth.c + room, -np.inf)
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    clean = np.ones((len(shows), n + 1), bool)
    front = np.maximum.accumulate(high, axis=1)
    back = np.minimum.accumulate(low[:, ::-1], axis=1)[:, ::-1]
    clean[:, 1:n] = front[:, :-1] < back[:, 1:]
    return clean, low, high


def _blended(alpha: Form, color: Form, depth: Form, shows: Array, background: float) -> tuple[Form, Array]:
    """The form of the blended colour [B] of fragments in the order of their centres, and which of them matter."""
    count, n = shows.shape
    al, ah = alpha.range()
    al, ah = np.clip(al, 0.0, 1.0), np.clip(ah, 0.0, 1.0)
    cl, ch = color.range()
    clean, dlow, dhigh = _groups(depth, shows)
    step = 1.0 + 8.0 * n * U
    most, least = (
        np.concatenate([np.ones((count, 1)), np.cumprod(1.0 - a, axis=1)], axis=1) * s
        for a, s in ((al, step), (ah, 1 / step))
    )
    most[:, 0] = least[:, 0] = 1.0
    place = np.arange(n + 1)[None]
    # the first fragment at which the rasteriser may stop, and the first at which it surely has stopped
    may = least[:, 1:] <= STOP * (1.0 + ROOM)
    sure = most[:, 1:] <= STOP * (1.0 - ROOM)
    first = np.where(may.any(axis=1), may.argmax(axis=1), n)[:, None]
    last = np.where(sure.any(axis=1), sure.argmax(axis=1), n)[:, None]
    begin = np.where(clean & (place <= first), place, 0).max(axis=1)[:, None]
    plain = np.take_along_axis(clean, last, 1) & np.take_along_axis(clean, np.minimum(last + 1, n), 1)
    beyond = np.where(clean & (place > last), place, n).min(axis=1)[:, None]
    end = np.where(plain, last, beyond)
    inside = np.arange(n)[None] < end
    blank = np.where(inside, 1.0, 0.0)
    ac, al, ah = alpha.c * blank, al * blank, ah * blank
    most, least = (np.take_along_axis(t, np.minimum(place, end), 1) for t in (most, least))
    # colours behind each place, as intervals, and at the centres
    low, high, centre = (np.full((count, n + 1), background) for _ in range(3))
    for k in range(n - 1, -1, -1):
        for s, c, pick in ((low, cl, np.minimum), (high, ch, np.maximum)):
            a, b = s[:, k + 1], c[:, k]
            s[:, k] = pick(a + al[:, k] * (b - a), a + ah[:, k] * (b - a))
        centre[:, k] = centre[:, k + 1] + ac[:, k] * (color.c[:, k] - centre[:, k + 1])
    span = np.maximum(np.abs(low), np.abs(high)).max(axis=1) + np.where(
        inside, np.maximum(np.abs(cl), np.abs(ch)), 0.0
    ).max(axis=1)
    slack = 8.0 * (n + 2) * U * span
    low, high = low - slack[:, None], high + slack[:, None]
    total_form = _mean_value(alpha, color, blank, (most, least), (al, ah), (cl, ch), (low, high))
    form = Form(centre[:, 0], total_form.g, total_form.r + slack)
    # another order
    swap = _swaps(clean, dlow, dhigh, inside, most[:, :-1], ah, cl, ch)
    # an earlier stop
    open_ = begin < end
    at = (place[:, :-1] >= begin) & (place[:, :-1] < end)
    light = np.where(at, STOP * (1.0 + 4.0 * ROOM) / np.maximum(1.0 - np.where(at, ah, 0.0), 1e-3), 0.0).max(axis=1)
    light = np.minimum(light, np.take_along_axis(most, begin, 1)[:, 0])
    darkest = np.minimum(np.where(at, cl, np.inf).min(axis=1), background)
    brightest = np.maximum(np.where(at, ch, -np.inf).max(axis=1), background)
    stops = open_[:, 0]
    fall = np.where(stops, light * (brightest - background), 0.0) * (1.0 + ROOM)
    rise = np.where(stops, light * (background - darkest), 0.0) * (1.0 + ROOM)
    lower, upper = swap[0] - fall, swap[1] + rise
    form = Form(
        form.c + 0.5 * (lower + upper),
        form.g,
        form.r + 0.5 * (upper - lower) * (1.0 + ROOM) + 8.0 * U * (np.abs(form.c) + 1.0),
    )
    return form, inside | (np.arange(n)[None] < end + 1)


def _mean_value(alpha: Form, color: Form, blank: Array, light: Any, alphas: Any, colors: Any, behind: Any) -> Form:
    """Deviation of the picture from that of the centres: derivatives times deviations of alphas and colours."""
    (most, least), (al, ah), (cl, ch), (low, high) = light, alphas, colors, behind
    dlow, dhigh = cl - high[:, 1:], ch - low[:, 1:]
    t, b = most[:, :-1], least[:, :-1]
    by_alpha = np.minimum(dlow * t, dlow * b), np.maximum(dhigh * t, dhigh * b)
    by_color = b * al, t * ah
    g, r = 0.0, 0.0
    for (lowest, highest), form in ((by_alpha, alpha), (by_color, color)):
        middle, radius = 0.5 * (lowest + highest) * blank, 0.5 * (highest - lowest) * blank
        wide_ = form.width
        radius = radius * (1.0 + 8.0 * U) + 8.0 * U * np.abs(middle) + TINY
        g = g + (middle[None] * form.g).sum(axis=2)
        part = np.abs(middle) * form.r * blank + radius * wide_
        part = part + 16.0 * U * np.abs(middle) * wide_
        r = r + np.where(blank > 0.0, part, 0.0).sum(axis=1) * (1.0 + 4.0 * (blank.shape[1] + 8) * U)
        r = r + 4.0 * (blank.shape[1] + 8) * U * (np.abs(middle) * form.slope).sum(axis=1)
    return Form(np.zeros(len(blank)), g, r)


def _swaps(clean: Array, dlow: Array, dhigh: Array, inside: Array, most: Array, ah: Array, cl: Array, ch: Array) -> Any:
    """What other orders than that of the centres may change: [B] least and largest.

    Sorting by exchanges of neighbours exchanges each inverted pair once; an exchange changes the colour by the
    transmittance in front times both alphas times the difference of colours. What is surely in front of a group of
    fragments is in front of it in every order.
    """
    count, n = inside.shape
    place = np.arange(n)[None]
    begin = np.maximum.accumulate(np.where(clean[:, :n], place, 0), axis=1)
    light = np.take_along_axis(most, begin, 1)
    lower, upper = np.zeros(count), np.zeros(count)
    longest = int((np.where(inside, place - begin, 0)).max(initial=0))
    if longest > LONGEST_GROUP:
        return lower - np.inf, upper + np.inf
    for k in range(1, longest + 1):
        pair = inside[:, :-k] & inside[:, k:] & (begin[:, k:] <= place[:, :-k]) & ~(dhigh[:, :-k] < dlow[:, k:])
        if not pair.any():
            continue
        weight = np.where(pair, light[:, :-k] * ah[:, :-k] * ah[:, k:], 0.0)
        weight = np.where(weight > 0.0, weight, 0.0)
        with np.errstate(all="ignore"):
            down = np.where(weight > 0.0, weight * np.minimum(cl[:, k:] - ch[:, :-k], 0.0), 0.0)
            up = np.where(weight > 0.0, weight * np.maximum(ch[:, k:] - cl[:, :-k], 0.0), 0.0)
        lower, upper = lower + down.sum(axis=1), upper + up.sum(axis=1)
    return lower * (1.0 + ROOM), upper * (1.0 + ROOM)
