"""Encloses pixels of Splatfacto's picture over boxes of camera poses, by gsplat's rules.

The picture is composited back to front by forms in the pose. Decisions that are open within a box (alpha threshold,
tile, depth order, early stop) are enclosed with both outcomes. With ``unit`` 0 the picture in real numbers is enclosed;
with ``unit`` `FLOAT` every float32 evaluation of gsplat's formulas, too (docs/dev/checker.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ns_abstract.check.blending import ROOM, blended, gathered
from ns_abstract.check.forms import Affine, Array, U, product, total
from ns_abstract.check.poses import CameraForms, CheckedCamera

NEAR, FAR, BLUR, MARGIN, TILE = 0.01, 1e10, 0.3, 0.3, 16
LEAST_ALPHA = 1.0 / 255.0
#: Unit roundoff of float32.
FLOAT = 2.0**-24
#: Pixels times Gaussians that are looked at together. Room for what roots and sums of float64 are off by; what a
#: product of tiny floats may lose when it is flushed.
TOGETHER, _LIBRARY, _FLUSHED = 20_000, 1e-9, 1e-30


class VersionRules(NamedTuple):
    """The rules in which gsplat's versions differ."""

    #: Alpha's cap, and the least compensation.
    cap: float
    least_factor: float
    #: Whether tiles cut. Else they hold every pixel with an alpha above the threshold, in real numbers; in float32
    #: `_surely_in_tile`.
    tiles: bool
    #: Whether tiles are of ellipses.
    ellipses: bool


RULES = {
    "1.4.0": VersionRules(0.999, 0.0, True, False),
    "1.5.3": VersionRules(0.999, 0.0, False, False),
    "1.6.0": VersionRules(float(np.float32(0.99)), float(np.float32(0.005)), False, True),
}


@dataclass(frozen=True)
class ActivatedScene:
    """A scene's activated Gaussians in float64, with bounds of their errors."""

    #: [N, 3], exact.
    means: Array
    #: [N, 3, 3], column k is the k-th axis times its scale; entries are within 96 U ``scales`` [N, 3].
    axes: Array
    scales: Array
    #: [N], within a relative 32 U.
    opacity: Array
    #: [N, K, 3] coefficients, or [N, 1, 3] logits where ``sigmoid``.
    sh: Array
    sigmoid: bool
    degree: int
    antialiased: bool
    background: Array
    rules: VersionRules
    paint: Any = None

    def painted(self, paint: Any) -> ActivatedScene:
        """Return the scene with selected Gaussians white, and all others and the background black.

        ``paint``: a box [2, 3] that selects by mean, a distance that selects by depth, or None: the scene itself.
        """
        if isinstance(paint, np.ndarray):
            paint = ((self.means >= paint[0]) & (self.means <= paint[1])).all(axis=1) * 1.0
        return self if paint is None else replace(self, paint=paint, background=np.zeros(3))


def activated(
    stored: list[Array], sigmoid: bool, degree: int, antialiased: bool, background: Array, version: str
) -> ActivatedScene:
    """Return the scene of stored float32 parameters: means, log scales, quaternions, opacity logits and colours."""
    means, logs, q, logits, sh = (v.astype(np.float64) for v in stored)
    scales = np.exp(logs)
    w, *v = (q / np.sqrt((q * q).sum(axis=1, keepdims=True))).T
    # v x u as a matrix times u
    cross = np.cross(np.stack(v, axis=-1)[:, None], np.eye(3)).swapaxes(1, 2)
    turn = np.eye(3) + 2.0 * w[:, None, None] * cross + 2.0 * cross @ cross
    opacity = 1.0 / (1.0 + np.exp(np.minimum(-logits, 700.0)))
    return ActivatedScene(
        means, turn * scales[:, None, :], scales, opacity, sh,
        sigmoid, degree, antialiased, np.asarray(background, np.float64), RULES[version],
    )  # fmt: skip


def pixel_extents(splats: ActivatedScene, cam: CheckedCamera, view: CameraForms, unit: float) -> Array:
    """Return boxes [B, N, 4] in pixels (left, right, top, bottom) about each Gaussian's visible pixels, some empty."""
    parts, count = np.array_split(np.arange(len(splats.means)), 1 + len(splats.means) // TOGETHER), len(view.origin)
    with np.errstate(all="ignore"):
        some = (projected(splats, cam, view, np.broadcast_to(at, (count, len(at))), unit, False) for at in parts)
        return np.concatenate([_extents(p, unit) for p in some], axis=1)


def _extents(p: ProjectedForms, unit: float) -> Array:
    zl, zh = p.depth.range()
    wild = ~(p.kappa < 0.125)
    # alpha is the threshold where the exponent is the logarithm, and dx^2 is at most twice that times the variance
    visible = 255.0 * p.opacity.range()[1] * (1.0 + ROOM + 80.0 * unit)
    spread = [e.range()[1] + BLUR + error for e, error in zip(p.squares[:2], p.errors, strict=False)]
    reach = np.sqrt(2.0 * np.log(np.maximum(visible, 1.0)) / (1.0 - 1.2 * np.where(wild, 0.0, p.kappa)))
    # tiles' squares are of the longer axis, 3.33 deviations at most
    longest = 3.4 * np.sqrt(spread[0] + spread[1]) + 2.0 * TILE
    ends = []
    for form, variance in zip(p.centre, spread, strict=True):
        (low, high), room = form.range(), np.where(wild, longest, reach * np.sqrt(variance) * (1.0 + 1e-9)) + _LIBRARY
        open_ = ~(np.isfinite(low) & np.isfinite(high) & np.isfinite(room))
        ends += [np.where(open_, -np.inf, low - room), np.where(open_, np.inf, high + room)]
    hidden = (zh < NEAR * (1.0 - ROOM)) | (zl > FAR * (1.0 + ROOM)) | ((visible < 1.0) & ~wild)
    return np.stack([np.where(hidden, np.inf, ends[0]), *ends[1:]], axis=-1)


def gaussians_at(ends: Array, row: int, column: int) -> Array:
    """Return the numbers of the Gaussians whose `pixel_extents` [N, 4] hold the pixel's centre."""
    x, y = column + 0.5, row + 0.5
    return np.flatnonzero((ends[:, 0] <= x) & (ends[:, 1] >= x) & (ends[:, 2] <= y) & (ends[:, 3] >= y))


def wide(form: Affine) -> Affine:
    """Return forms [B] as forms [B, 1]."""
    return form.apply(lambda a: a[..., None])


def _points(splats: ActivatedScene, view: CameraForms, index: Array, unit: float) -> list[Affine]:
    """Return the means in camera coordinates [B, n]; float32 errors are below 8 units of |R| (|mu| + |C|)."""
    means, origin = splats.means[index], view.origin[:, None, :]
    far = np.abs(means) + np.abs(origin) + np.sum([e.size() for e in view.position], axis=0)[:, None, None]
    rotation = [[wide(e) for e in row] for row in view.rotation]
    points = product(rotation, np.moveaxis(means - origin, -1, 0)[:, None])
    errors = (np.sum([e.size() * far[..., s] for s, e in enumerate(row)], axis=0) for row in rotation)
    parts = zip(points, view.shift, errors, strict=True)
    return [(point + wide(move)).wider((4.0 * U + 8.0 * unit) * error) for (point,), move, error in parts]


class ProjectedForms(NamedTuple):
    """Gaussians projected to the image plane, forms [B, n]: everything that does not depend on the pixel."""

    centre: list[Affine]
    #: The three columns of the covariance's root.
    axes: list[list[Affine]]
    squares: list[Affine]
    inverse: Affine
    opacity: Affine
    depth: Affine
    #: Those of the covariance's entries in float32, and the exponent's relative one there.
    errors: list[Array]
    kappa: Array
    #: [3, B, n].
    color: Any = None


def projected(
    splats: ActivatedScene, cam: CheckedCamera, view: CameraForms, at: Array, unit: float, colored: bool = True
) -> ProjectedForms:
    """Return the Gaussians numbered ``at`` [B, n], projected by cameras over B boxes."""
    x, y, z = _points(splats, view, at, unit)
    iz = z.power(-1.0)
    iz = iz.wider(6.0 * unit * iz.size())
    u, v = ((e * iz).wider(4.0 * unit * e.size() * iz.size()) for e in (x, y))
    ends = ((u, cam.fx, cam.cx, cam.width), (v, cam.fy, cam.cy, cam.height))
    centre = [(e * f + c).wider(4.0 * unit * (f * e.size() + abs(c))) for e, f, c, _ in ends]
    slopes, roots, axes, sizes = [], [], splats.axes[at], splats.scales[at]
    turned = product([[wide(e) for e in row] for row in view.rotation], np.moveaxis(axes, (-2, -1), (0, 1)))
    turned = [[e.wider(4.0 * 96.0 * U * sizes[..., k]) for k, e in enumerate(row)] for row in turned]
    for row, (e, f, c, side) in enumerate(ends):
        spare = MARGIN * 0.5 * side / f
        slopes.append(e.clamped(-(c / f + spare), (side - c) / f + spare))
        roots.append([(iz * f) * (a - slopes[-1] * b) for a, b in zip(turned[row], turned[2], strict=True)])
    m, n = roots
    pairs = zip(m, n, strict=True)
    mm, nn, mn = total(a.square() for a in m), total(b.square() for b in n), total(a * b for a, b in pairs)
    flat = total((m[a] * n[b] - m[b] * n[a]).square() for a, b in ((0, 1), (0, 2), (1, 2)))
    det = flat + (mm + nn) * BLUR + BLUR * BLUR
    inverse, errors, kappa = det.power(-1.0), [np.zeros(at.shape)] * 3, np.zeros(at.shape)
    if unit:
        h = [(iz * f).size() * (1.0 + e.size()) for e, f in zip(slopes, (cam.fx, cam.fy), strict=True)]
        errors, kappa, error = _float32_charges(det, (mm, nn), h, sizes)
        flat, det = flat.wider(error), det.wider(error)
    opacity = Affine.constant(splats.opacity[at], z, 32.0 * U * splats.opacity[at])
    if splats.antialiased:
        opacity = opacity * _compensation(flat, det, splats.rules.least_factor, unit)
    color = _colors(splats, view, at, z, unit) if colored else None
    return ProjectedForms(centre, roots, [mm, nn, mn], inverse, opacity, z, errors, kappa, color)


def _fragments(
    splats: ActivatedScene, cam: CheckedCamera, p: ProjectedForms, index: Array, pixel: tuple[Array, Array], unit: float
) -> tuple[Affine, Array, Array]:
    """Return alphas [B, n] at a pixel, which may pass the threshold, and the centres' motion [d, B] in pixels."""
    rules, (mx, my), (m, n), opacity, z = splats.rules, p.centre, p.axes, p.opacity, p.depth
    dx, dy = (e + -(place[:, None] + 0.5) for e, place in ((mx, pixel[1]), (my, pixel[0])))
    near = total((n[k] * dx - m[k] * dy).square() for k in range(3))
    exponent = (near + (dx.square() + dy.square()) * BLUR) * 0.5 * p.inverse
    wild = ~((p.kappa < 0.125) & np.isfinite(exponent.r)) & (unit > 0.0)
    exponent = exponent.wider(np.where(wild, 0.0, 1.2 * p.kappa) * exponent.size() + _FLUSHED * (unit > 0.0))
    elow, ehigh = exponent.range()
    olow, ohigh = opacity.range()
    room = ROOM + 80.0 * unit
    plain = np.exp(-np.clip(np.stack([elow, ehigh]), 0.0, 700.0)) * np.array([1 + room, 1 - room])[:, None, None]
    # where the exponent is not known the opacity is; an exponent that is no number is drawn with the largest alpha
    anything = np.ones_like(ohigh) if unit else np.minimum(ohigh, 1.0)
    most = np.where(np.isfinite(elow) & ~wild, np.maximum(ohigh, 0.0) * plain[0], anything)
    most = np.where(np.isfinite(most), most, 1.0)
    least = np.where(np.isfinite(ehigh) & np.isfinite(olow) & ~wild, np.maximum(olow, 0.0) * plain[1], 0.0)
    alpha = (-exponent).exp() * opacity
    alpha = alpha.wider(80.0 * unit * most)
    zl, zh = z.range()
    shows = (most >= LEAST_ALPHA * (1.0 - room)) & ~(zh < NEAR * (1.0 - ROOM)) & ~(zl > FAR) & (index >= 0)
    surely = (least >= LEAST_ALPHA * (1.0 + room)) & (zl >= NEAR * (1.0 + ROOM)) & (zh <= FAR)
    if rules.tiles:
        squares = [e.wider(error) for e, error in zip(p.squares, p.errors, strict=True)]
        maybe, certain = _tile_overlap(cam, pixel, (mx, my), squares, unit)
        shows, surely = shows & maybe, surely & certain & ~wild
    elif unit:
        ellipse_kept, level = _surely_in_tile(p, rules.ellipses)
        surely = surely & ellipse_kept & (least >= LEAST_ALPHA * level)
    alow, ahigh = alpha.range()
    # the form must say no less than the interval, and stay below the cap, which is rounded, too
    rough = ~((ahigh - alow) <= 1.5 * (most - least)) | ~(ahigh <= rules.cap) | ~(alow >= 0.0) | ~surely
    bottom, top = (np.minimum(e, rules.cap * (1.0 + s * unit)) for e, s in ((least * surely, -1.0), (most, 1.0)))
    alpha = alpha.replaced(rough, bottom, np.maximum(top, bottom)).apply(lambda a: a * shows)
    motion = np.where(shows[None], np.abs(mx.g) + np.abs(my.g), 0.0).max(axis=2, initial=0.0)
    return alpha, shows, motion


def _float32_charges(det: Affine, squares: Any, h: list[Array], sizes: Array) -> tuple[list[Array], Array, Array]:
    """Return float32 errors of the covariance (xx, yy, xy), of the exponent (relative), and of determinants.

    Nothing is known of the exponent where its error (kappa) is 1/8 or more; docs/dev/checker.md derives the charges.
    """
    square, (hx, hy) = (sizes * sizes).sum(axis=-1) * (1.0 + _LIBRARY), h
    a, c = (e.size() + BLUR for e in squares)
    ends = ((hx, hx, a), (hy, hy, c), (hx, hy, 0.0))
    # beyond that products may overflow
    held = (a * c < 1e30) & (square * (1.0 + hx + hy) ** 2 < 1e30)
    ea, ec, eb = (np.where(held, FLOAT * (330.0 * p * q * square + 3.0 * d), np.inf) for p, q, d in ends)
    low = np.maximum(det.range()[0], BLUR * BLUR)
    eta = (c * ea + 2.0 * np.sqrt(a * c) * eb + a * ec) / low
    kappa = 1.05 * (eta + 48.0 * FLOAT * a * c / low)
    error = a * ec + c * ea + 2.0 * np.sqrt(a * c) * eb + ea * ec + eb * eb + 8.0 * FLOAT * a * c + _FLUSHED
    return [ea, ec, eb], kappa, error


def _compensation(flat: Affine, det: Affine, least: float, unit: float) -> Affine:
    """Return gsplat's antialiasing factor of the opacity, sqrt(max(0, det / blurred det)), at least ``least``."""
    (low, high), (dlow, dhigh) = flat.range(), det.range()
    room, limit = ROOM + 16.0 * unit, 1.0 if not unit else 1e3
    bottom = np.sqrt(np.maximum(low, 0.0) / dhigh) * (1.0 - room)
    top = np.sqrt(np.maximum(high, 0.0) / np.maximum(dlow, BLUR * BLUR * (1.0 - 1e-3))) * (1.0 + room)
    bottom = np.where(np.isfinite(bottom), bottom, 0.0)
    top = np.minimum(np.where(np.isfinite(top), top, limit), limit)
    root = (flat * det.power(-1.0)).power(0.5)
    root = root.wider(16.0 * unit * np.minimum(root.size(), limit))
    return root.narrowed(bottom, np.maximum(top, bottom)).clamped(least, limit + ROOM)


def _tile_overlap(cam: CheckedCamera, pixel: Any, centre: Any, squares: Any, unit: float) -> tuple[Array, Array]:
    """Return whether gsplat 1.4.0 may, and whether it surely does, list a Gaussian for the pixel's tile."""
    a, c, b = squares
    (al, ah), (low, high) = ((a + c) * 0.5 + BLUR).range(), (((a - c) * 0.5).square() + b.square()).range()
    # in float32 the smaller root is of a difference of squares
    lost, room = 32.0 * unit * ah * ah, ROOM + 16.0 * unit
    small, large = np.maximum(low - lost, 0.01), np.maximum(high + lost, 0.01)
    rl = np.ceil(3.0 * np.sqrt((al + np.sqrt(small * (1.0 - room))) * (1.0 - room)) * (1.0 - room))
    rh = np.ceil(3.0 * np.sqrt((ah + np.sqrt(large * (1.0 + room))) * (1.0 + room)) * (1.0 + room))
    maybe = certain = True
    for form, place, side in ((centre[0], pixel[1], cam.width), (centre[1], pixel[0], cam.height)):
        low, high = form.range()
        first = TILE * (place[:, None] // TILE)
        last = np.minimum(first + TILE, side)
        slack = _LIBRARY + 16.0 * unit * (np.abs(low) + np.abs(high) + rh)
        certain = certain & (high - rl < last - slack) & (low + rl > first + slack)
        # the negations keep what is not a number
        maybe = maybe & ~(low - rh > last + slack) & ~(high + rh < first - slack)
    return maybe, certain


def _surely_in_tile(p: ProjectedForms, ellipses: bool) -> tuple[Array, Array]:
    """Return where float32 tiles from gsplat 1.5 on list all pixels of alphas above the threshold times a factor.

    Box (1.5.3) and ellipse (1.6.0) come from the floats that alpha comes from, and pixel centres lie half a pixel from
    every tile edge: rounding moves the level, by the factor that is returned (docs/dev/checker.md).
    """
    a, c = (e.range()[1] + BLUR for e in p.squares[:2])
    # along the image's axes, in pixels: where a Gaussian may reach
    span = p.centre[0].size() + p.centre[1].size() + 8.0 * np.sqrt(a + c)
    kept, room = (p.kappa < 0.03) & (span < 4000.0), 2.0**10
    if ellipses:
        thin, room = 1.0 / (p.inverse.range()[1] * a * c), 2.0**19
        sharp = (p.kappa < 2.0**-10) & (thin * thin > 2.0**10 * FLOAT)
        short = thin * np.sqrt(BLUR) > 2.0**10 * FLOAT * span
        kept = kept & sharp & short & (span * np.sqrt(np.maximum(a, c) / BLUR) < 2.0**-6 / FLOAT)
    return kept, 1.0 + 16.0 * p.kappa + room * FLOAT


def _colors(splats: ActivatedScene, view: CameraForms, at: Array, depth: Affine, unit: float) -> Affine:
    """Return the colours [3, B, n] of the Gaussians numbered ``at``, seen from the cameras."""
    sh = np.moveaxis(splats.sh[at], (-2, -1), (0, 1))
    flat = depth.apply(lambda a: np.repeat(a[..., None, :, :], 3, axis=-3))
    if isinstance(splats.paint, float):
        # a depth that is not a number may be any
        low, high = flat.range()
        return flat.replaced(np.array(True), (high < splats.paint) * 1.0, ~(low >= splats.paint) * 1.0)
    if splats.paint is not None:
        return Affine.constant(splats.paint[at], flat)
    if splats.sigmoid:
        value = 1.0 / (1.0 + np.exp(-sh[0]))
        return Affine.constant(value, flat, (32.0 * U + 16.0 * unit) * value)
    size = np.abs(sh[0]) + 1.0
    color = Affine.constant(0.28209479177387814 * sh[0] + 0.5, flat, (8.0 * U + 4.0 * unit) * size)
    if splats.degree and np.any(sh[1:]):
        (x, y, z), error = _directions(splats, view, at, unit)
        bands = [y * -0.4886025119029199, z * 0.4886025119029199, x * -0.4886025119029199]
        xx, yy, zz = x.square(), y.square(), z.square()
        if splats.degree >= 2:
            bands += [
                x * y * 1.0925484305920792, y * z * -1.0925484305920792,
                (zz * 2.0 - xx - yy) * 0.31539156525252005,
                x * z * -1.0925484305920792, (xx - yy) * 0.5462742152960396,
            ]  # fmt: skip
        if splats.degree >= 3:
            bands += [
                y * (xx * 3.0 - yy) * -0.5900435899266435, x * y * z * 2.890611442640554,
                y * (zz * 4.0 - xx - yy) * -0.4570457994644658,
                z * (zz * 2.0 - xx * 3.0 - yy * 3.0) * 0.3731763325901154,
                x * (zz * 4.0 - xx - yy) * -0.4570457994644658,
                z * (xx - yy) * 1.445305721320277, x * (xx - yy * 3.0) * -0.5900435899266435,
            ]  # fmt: skip
        # slopes of bands are below 8, and 16 roundings of sums of terms below 8 together
        bands = [e.wider(8.0 * error + 128.0 * unit).apply(lambda a: a[..., None, :, :]) for e in bands]
        color = total([color, *(band * row for band, row in zip(bands, sh[1:], strict=False))])
    return color.clamped(0.0, np.inf)


def _directions(splats: ActivatedScene, view: CameraForms, at: Array, unit: float) -> tuple[list[Affine], Array]:
    """Return unit vectors from the camera to the means (world axes), and bounds of their float32 errors.

    Version 1.6.0 takes -R^T t of the view matrix as the camera; that differs where a keyframe is not orthonormal.
    """
    far = np.abs(view.origin).sum(axis=1) + sum(e.width for e in view.position)
    means, origin, parts = splats.means[at], view.origin[:, None, :], []
    for k, entry in enumerate(view.position):
        part = -wide(entry) + (means - origin)[..., k]
        parts.append(part.wider(2.0 * U * (np.abs(means) + np.abs(origin))[..., k] + (view.stretch * far)[:, None]))
    inverse = total(e.square() for e in parts).power(-0.5)
    error = 128.0 * unit * (1.0 + np.abs(means).sum(axis=-1) + far[:, None]) * inverse.size()
    return [e * inverse for e in parts], np.where(np.isfinite(error), error, np.inf if unit else 0.0)


def pixels(
    splats: ActivatedScene, cam: CheckedCamera, view: CameraForms | ProjectedForms, index: Array,
    pixel: tuple[Array, Array], unit: float = 0.0,
) -> tuple[Affine, Array, Array]:  # fmt: skip
    """Return one pixel's colours [B, 3] before the clamp over B boxes, which Gaussians contribute, and their motion.

    The motion [d, B], in pixels, is each parameter's largest, approximately. ``view``: cameras, or what `projected`
    returns of them. ``index`` [B, n] numbers the Gaussians that may be visible (`pixel_extents`), negative ones none.
    """
    with np.errstate(all="ignore"):
        if not isinstance(view, ProjectedForms):
            view = projected(splats, cam, view, np.maximum(index, 0), unit)
        alpha, shows, motion = _fragments(splats, cam, view, index, pixel, unit)
        return *blended(alpha, view.color, view.depth, shows, splats.background, unit), motion


def pictures(
    splats: ActivatedScene, cam: CheckedCamera, view: CameraForms, unit: float, numbers: Array | None = None
) -> Affine:
    """Return colours [B, P, 3] of pixels over B boxes of poses: the pixels ``numbers`` [P] of the picture, or all."""
    at: Array = np.arange(cam.height * cam.width) if numbers is None else numbers
    count, lists = len(view.origin), []
    for ends in pixel_extents(splats, cam, view, unit):
        inside = (ends[:, 0] <= cam.width) & (ends[:, 1] >= 0.0) & (ends[:, 2] <= cam.height) & (ends[:, 3] >= 0.0)
        some = np.flatnonzero(inside)
        lists += [some[gaussians_at(ends[some], *divmod(p, cam.width))] for p in at]
    every = np.unique(np.concatenate(lists))
    with np.errstate(all="ignore"):
        whole = projected(splats, cam, view, np.broadcast_to(every, (count, len(every))), unit)
    longest, parts = max(map(len, lists)), []
    step = max(1, TOGETHER // max(1, longest))
    for start in range(0, len(lists), step):
        chosen = lists[start : start + step]
        index = np.full((len(chosen), longest), -1)
        for place, gaussians in zip(index, chosen, strict=True):
            place[: len(gaussians)] = np.searchsorted(every, gaussians)
        box, place = np.divmod(np.arange(start, start + len(chosen)), len(at))
        part = gathered(whole, box[:, None], index)
        parts.append(pixels(splats, cam, part, index, np.divmod(at[place], cam.width), unit)[0].clamped(0.0, 1.0))
    return Affine.joined(parts, -2).reshaped(count, len(at), 3)
