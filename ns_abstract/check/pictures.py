"""Claims of a picture's bounds: one channel of one pixel over one cell."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ns_abstract.check.claims import ClaimMargins, Claims
from ns_abstract.check.forms import Affine, Array
from ns_abstract.check.poses import Poses
from ns_abstract.check.results import StoredCells
from ns_abstract.check.splats import ActivatedScene, meeting, pixels, reaches, several

#: Room for the float64 rounding of a claim's planes, relative to their terms.
_ROUNDED = 1e-13


class PixelClaim(NamedTuple):
    """A pixel's channel over a cell, and a pose [1, d] that may refute it."""

    cell: int
    row: int
    column: int
    channel: int
    pose: Array | None = None


class ClaimedBounds(NamedTuple):
    """What is claimed: constants of the frame, and planes over the cell's box."""

    least: float
    most: float
    low: Array
    high: Array
    planes: tuple[tuple[Array, float], ...]

    def excess(self, centre: Array, half: Array, form: Affine) -> tuple[Array, Array]:
        """By how much pictures may lie below the lower and above the upper bound, over boxes [B, d], as [2, B].

        Also by how much they surely do at the middle. Pictures are clamped to [0, 1] after the ``form``.
        """
        c, worst, sure = form.c, [], []
        moved, span = form.slope + form.r, np.where(self.high > self.low, 0.5 * (self.high - self.low), 1.0)
        for side, (plane, constant) in zip((1.0, -1.0), self.planes, strict=True):
            fixed, end = (self.least, 0.0) if side > 0 else (self.most, 1.0)
            slope = plane[:, None] * (half / span).T
            middle = constant + ((centre - 0.5 * (self.low + self.high)) / span) @ plane
            tilt, reach = np.abs(slope - form.g).sum(axis=0) + form.r, np.abs(slope).sum(axis=0)
            room = _ROUNDED * (np.abs(plane).sum() + tilt + np.abs(middle - c))
            # a bound beyond the end of [0, 1] holds, and one beyond the other end does not
            holds = side * (middle - end) + reach + _ROUNDED * (np.abs(plane).sum() + 1.0) <= 0.0
            past = side * (middle - 1.0 + end) + reach - 1e-9
            flat, holds_flat = side * (fixed - c), side * (fixed - end) <= 0.0
            for ends, a, b in (
                (worst, np.maximum(side * (middle - c) + tilt + room, past), flat + moved * (1.0 + _ROUNDED)),
                (sure, side * (middle - c) - form.width - 8.0 * room, flat - form.width - 8.0 * room),
            ):
                ends.append(np.maximum(np.where(holds, -1.0, a), -1.0 if holds_flat else b))
        # not a number: nothing is known
        return np.nan_to_num(worst, nan=np.inf, posinf=np.inf), np.nan_to_num(sure, nan=-np.inf, neginf=-np.inf)


class Picture(Claims):
    """The claims of a frame's cells; ``poses`` are the frame's."""

    def __init__(self, cells: StoredCells, scene: Any, poses: Poses, report: dict[str, Any]) -> None:
        super().__init__(cells, scene, report)
        self.poses, self.count = poses, len(cells.arrays["tile"])
        self.together = 64 if isinstance(scene, ActivatedScene) else 4

    def one(self, rng: Any) -> PixelClaim:
        """A claim that is uniform over cells, pixels and channels."""
        a = self.cells.arrays
        while True:
            cell = int(rng.integers(self.count))
            row, column = (int(t) + int(rng.integers(a["b_lower"].shape[1])) for t in a["tile"][cell])
            # tiles may reach past the picture; those places are drawn again
            if row < a["lower"].shape[0] and column < a["lower"].shape[1]:
                return PixelClaim(cell, row, column, int(rng.integers(3)))

    def interest(self, claim: PixelClaim) -> float:
        """Narrow and moving."""
        (_, b), (slope, c) = self.bounds(claim).planes
        return float((np.abs(slope).sum() + 1e-4) / max(c - b, 1e-7)) if np.any(slope) else 0.0

    def draw(self, rng: Any, hunted: bool) -> PixelClaim:
        """A claim that is uniform, or the most telling of eight, or one that a pose of its cell seems to break."""
        claim = super().draw(rng, hunted)
        if not hunted or not isinstance(self.scene, ActivatedScene):
            return claim
        (low, high), a, k, camera = self.box(claim), self.cells.arrays, claim.cell, self.poses.camera
        # ends of ranges are likely
        s = np.clip(rng.uniform(-1.5, 1.5, len(low)), -1.0, 1.0)
        point = np.clip(0.5 * (low + high) + 0.5 * (high - low) * s, low, high)[None]
        limits, side = (camera.height, camera.width), a["b_lower"].shape[1]
        rows, columns = (np.arange(t, min(t + side, n)) for t, n in zip(a["tile"][k], limits, strict=True))
        numbers = (rows[:, None] * camera.width + columns).ravel()
        drawn = several(self.scene, camera, self.poses.view(point, point), numbers, 0.0).c
        here = np.s_[: len(rows), : len(columns)]
        planes = (a[f"A_{e}"][k][here] @ s + a[f"b_{e}"][k][here] for e in ("lower", "upper"))
        low, high = (pick(p, a[e][rows][:, columns]) for p, pick, e in
                     zip(planes, (np.maximum, np.minimum), ("lower", "upper"), strict=True))  # fmt: skip
        room = np.minimum(drawn.reshape(low.shape) - low, high - drawn.reshape(low.shape))
        row, column, channel = np.unravel_index(int(np.argmin(room)), room.shape)
        broken = room[row, column, channel] < -1e-9
        return PixelClaim(k, int(rows[row]), int(columns[column]), int(channel), point) if broken else claim

    def hint(self, claim: PixelClaim) -> Array | None:
        """A pose that may refute the claim."""
        return claim.pose

    def place(self, claim: PixelClaim) -> dict[str, Any]:
        """The claim for check.json."""
        at = {"pixel": [claim.row, claim.column], "channel": claim.channel}
        return {"cell": claim.cell, "parameters": list(self.cells.names), **at}

    def bounds(self, claim: PixelClaim) -> ClaimedBounds:
        """What is claimed."""
        a, k = self.cells.arrays, claim.cell
        at = (k, claim.row - int(a["tile"][k, 0]), claim.column - int(a["tile"][k, 1]), claim.channel)
        least, most = (float(a[s][claim.row, claim.column, claim.channel]) for s in ("lower", "upper"))
        planes = tuple((a[f"A_{s}"][at].astype(np.float64), float(a[f"b_{s}"][at])) for s in ("lower", "upper"))
        return ClaimedBounds(least, most, *self.box(claim), planes)

    def near(self, claim: PixelClaim, low: Array, high: Array, unit: float) -> Array:
        """Numbers of the Gaussians that may show."""
        if not isinstance(self.scene, ActivatedScene):
            return super().near(claim, low, high, unit)
        return meeting(reaches(self.scene, self.poses.camera, self.poses.view(low, high), unit)[0], *claim[1:3])

    def margins(self, claim: PixelClaim, low: Array, high: Array, near: Array, unit: float) -> ClaimMargins:
        """Over boxes [B, d], of the Gaussians ``near``."""
        bounds, middle = self.bounds(claim), 0.5 * (low + high)
        half, none = np.maximum(high - middle, middle - low), np.zeros(len(low))
        nothing = Affine(none, np.zeros((low.shape[1], len(low))), none + np.inf)
        counted = motion = None
        if (worst := bounds.excess(middle, half, nothing)[0]).max() > 0.0:
            form, counted, motion = self._forms(claim, low, high, near, unit)
            worst, sure = bounds.excess(middle, half, form)
            return ClaimMargins(-worst.max(axis=0), -sure.max(axis=0), counted, motion)
        # the bounds [0, 1] or wider hold whatever is drawn
        return ClaimMargins(-worst.max(axis=0), none + 1.0)

    def _forms(self, claim: PixelClaim, low: Array, high: Array, near: Array, unit: float) -> Any:
        view = self.poses.view(low, high)
        pixel = np.full(len(low), claim.row), np.full(len(low), claim.column)
        counted = motion = None
        if isinstance(self.scene, ActivatedScene):
            at = np.broadcast_to(near, (len(low), len(near)))
            form, counted, motion = pixels(self.scene, self.poses.camera, view, at, pixel, unit)
        else:
            form = self.scene.pixels(self.poses.camera, view, pixel)
        return form.of(lambda a: a[..., claim.channel]), counted, motion

    def detail(self, claim: PixelClaim, point: Array) -> dict[str, Any]:
        """The pose, the picture's value, its error, and by how much which bound is left."""
        form = self._forms(claim, point, point, self.near(claim, point, point, 0.0), 0.0)[0]
        excess = self.bounds(claim).excess(point, 0.0 * point, form)[1][:, 0]
        value = {"value": float(np.clip(form.c[0], 0.0, 1.0)), "error": float(form.width[0])}
        side = int(np.argmax(excess))
        return {"pose": point[0].tolist(), **value, "bound": ("lower", "upper")[side], "excess": float(excess[side])}
