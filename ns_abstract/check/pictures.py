"""Claims about bounds of pictures: one channel of one pixel over one cell."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ns_abstract.check.claims import BoxClaim, ClaimMargins, Claims
from ns_abstract.check.forms import Affine, Array, U
from ns_abstract.check.poses import Poses
from ns_abstract.check.results import StoredCells
from ns_abstract.check.splats import ActivatedScene, gaussians_at, pictures, pixel_extents, pixels


class ClaimedBounds(NamedTuple):
    """The claimed bounds of a pixel over the cell [low, high]: two constants, and two planes (slope [d], height)."""

    flat: tuple[float, float]
    planes: tuple[tuple[Array, float], tuple[Array, float]]
    low: Array
    high: Array

    def excess(self, low: Array, high: Array, form: Affine) -> tuple[Array, Array]:
        """Return bounds [4, B] of how far the ``form``, clamped to [0, 1], exceeds each claimed bound over boxes."""
        middle, span = 0.5 * (low + high), np.where(self.high > self.low, 0.5 * (self.high - self.low), 1.0)
        half, excesses = np.maximum(high - middle, middle - low), []
        for sign, flat, (slope, height) in zip((1.0, -1.0), self.flat, self.planes, strict=True):
            value = height + ((middle - 0.5 * (self.low + self.high)) / span) @ slope
            # middles are off by U times the parameters, the rest by less than 32 roundings; nothing where nothing moves
            off = 4.0 * U * (np.abs(self.low) + np.abs(self.high)) / span + 32.0 * U
            room = np.abs(slope) @ off + np.any(slope) * 2.0 * U * np.abs(value)
            plane = Affine(value, slope[:, None] * (half / span).T, room)
            for bound in (plane, Affine.constant(flat, plane)):
                # of upper bounds everything is negated: values lie in [-1, 0]
                bound, seen, least = (bound, form, 0.0) if sign > 0.0 else (-bound, -form, -1.0)
                ends = ((bound - e).range() for e in (seen, least, least + 1.0))
                excesses.append([np.maximum(np.minimum(a, b), c) for a, b, c in zip(*ends, strict=True)])
        surely, perhaps = np.moveaxis(np.array(excesses), 1, 0)
        # what is not a number is not known
        return np.where(np.isnan(surely), -np.inf, surely), np.where(np.isnan(perhaps), np.inf, perhaps)


class Picture(Claims):
    """The claims about the bounds of a frame's pictures over each cell; ``poses`` are the frame's."""

    def __init__(self, cells: StoredCells, scene: Any, poses: Poses, report: dict[str, Any]) -> None:
        super().__init__(cells, scene, report)
        self.poses, self.count = poses, len(cells.arrays["tile"])
        self.splats = isinstance(scene, ActivatedScene)
        self.together = 64 if self.splats else 4

    def draw_uniform(self, rng: Any) -> BoxClaim:
        a = self.cells.arrays
        while True:
            cell = int(rng.integers(self.count))
            row, column = (int(t) + int(rng.integers(a["b_lower"].shape[1])) for t in a["tile"][cell])
            # tiles may reach past the picture; those places are drawn again
            if row < a["lower"].shape[0] and column < a["lower"].shape[1]:
                return BoxClaim(cell, row, column, int(rng.integers(3)))

    def suspicion(self, claim: BoxClaim) -> float:
        """Return the slope of the claimed lower plane over the claim's width: steep and narrow claims come first."""
        (_, b), (slope, c) = self.bounds(claim).planes
        return float((np.abs(slope).sum() + 1e-4) / max(c - b, 1e-7)) if np.any(slope) else 0.0

    def draw(self, rng: Any, hunted: bool) -> BoxClaim:
        """Return a uniform claim; with ``hunted`` one that a rendered pose of its cell breaks, if there is one."""
        claim = super().draw(rng, hunted)
        if not hunted or not self.splats:
            return claim
        (low, high), a, k, camera = self.box(claim), self.cells.arrays, claim.cell, self.poses.camera
        # ends of ranges are likely
        s = np.clip(rng.uniform(-1.5, 1.5, len(low)), -1.0, 1.0)
        point = np.clip(0.5 * (low + high) + 0.5 * (high - low) * s, low, high)[None]
        limits, side = (camera.height, camera.width), a["b_lower"].shape[1]
        rows, columns = (np.arange(t, min(t + side, n)) for t, n in zip(a["tile"][k], limits, strict=True))
        numbers = (rows[:, None] * camera.width + columns).ravel()
        drawn = pictures(self.scene, camera, self.poses.view(point, point), 0.0, numbers).c
        drawn, here = drawn.reshape(len(rows), len(columns), 3), np.s_[: len(rows), : len(columns)]
        least, most = (a[f"A_{e}"][k][here] @ s + a[f"b_{e}"][k][here] for e in ("lower", "upper"))
        least, most = np.maximum(least, a["lower"][rows][:, columns]), np.minimum(most, a["upper"][rows][:, columns])
        room = np.minimum(drawn - least, most - drawn)
        row, column, channel = np.unravel_index(int(np.argmin(room)), room.shape)
        broken = BoxClaim(k, int(rows[row]), int(columns[column]), int(channel), point)
        return broken if room.min() < -1e-9 else claim

    def label(self, claim: BoxClaim) -> dict[str, Any]:
        return super().label(claim) | {"pixel": [claim.row, claim.column], "channel": claim.channel}

    def bounds(self, claim: BoxClaim) -> ClaimedBounds:
        """Return the bounds that the frame file claims."""
        a, k, sides = self.cells.arrays, claim.cell, ("lower", "upper")
        at = (k, claim.row - int(a["tile"][k, 0]), claim.column - int(a["tile"][k, 1]), claim.channel)
        least, most = (float(a[s][claim[1:4]]) for s in sides)
        lower, upper = ((a[f"A_{s}"][at].astype(np.float64), float(a[f"b_{s}"][at])) for s in sides)
        return ClaimedBounds((least, most), (lower, upper), *self.box(claim))

    def candidates(self, claim: BoxClaim, low: Array, high: Array, unit: float) -> Array:
        if not self.splats:
            return super().candidates(claim, low, high, unit)
        extents = pixel_extents(self.scene, self.poses.camera, self.poses.view(low, high), unit)
        return gaussians_at(extents[0], *claim[1:3])

    def margins(self, claim: BoxClaim, low: Array, high: Array, near: Array, unit: float) -> ClaimMargins:
        none = np.zeros(len(low))
        form, counted, motion = Affine(none, np.zeros((low.shape[1], len(low))), none + np.inf), None, None
        # some bounds hold whatever is drawn
        if self.bounds(claim).excess(low, high, form)[1].max() > 0.0:
            form, counted, motion = self._forms(claim, low, high, near, unit)
        surely, perhaps = self.bounds(claim).excess(low, high, form)
        return ClaimMargins(-perhaps.max(axis=0), -surely.max(axis=0), counted, motion)

    def _forms(self, claim: BoxClaim, low: Array, high: Array, near: Array, unit: float) -> Any:
        camera, view = self.poses.camera, self.poses.view(low, high)
        pixel = np.full(len(low), claim.row), np.full(len(low), claim.column)
        counted = motion = None
        if self.splats:
            at = np.broadcast_to(near, (len(low), len(near)))
            form, counted, motion = pixels(self.scene, camera, view, at, pixel, unit)
        else:
            form = self.scene.pixels(camera, view, pixel)
        return form.apply(lambda a: a[..., claim.channel]), counted, motion

    def refutation(self, claim: BoxClaim, point: Array) -> dict[str, Any]:
        """Return the pose, the pixel's value there with its error, and which bound it exceeds by how much."""
        form = self._forms(claim, point, point, self.candidates(claim, point, point, 0.0), 0.0)[0]
        excess = self.bounds(claim).excess(point, point, form)[0][:, 0]
        value, side = float(np.clip(form.c[0], 0.0, 1.0)), ("lower", "upper")[int(np.argmax(excess)) // 2]
        about = {"value": value, "error": float(form.width[0]), "bound": side, "excess": float(excess.max())}
        return {"pose": point[0].tolist(), **about}
