"""Claims of a picture's bounds: one channel of one pixel over one cell."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np

from ns_abstract.check.forms import Affine, Array
from ns_abstract.check.poses import Poses
from ns_abstract.check.results import StoredCells
from ns_abstract.check.splats import FLOAT, ActivatedScene, meeting, pixels, reaches

Verdict = tuple[bool | None, str, dict[str, Any]]

#: Boxes times Gaussians that are looked at together, and boxes of one claim before it is given up.
BATCH, MOST_BOXES = 40_000, 400_000
#: Part of a claim's time in which every float32 evaluation must be proved; then the picture in real numbers is.
FIRST = 0.5


class PixelClaim(NamedTuple):
    """A pixel's channel over a cell."""

    cell: int
    row: int
    column: int
    channel: int


class ClaimedBounds(NamedTuple):
    """What is claimed: constants of the frame, and planes over the cell's box."""

    least: float
    most: float
    low: Array
    high: Array
    planes: tuple[tuple[Array, float], ...]

    def excess(self, centre: Array, half: Array, form: Affine) -> tuple[Array, Array]:
        """By how much pictures may lie [B] below the lower and above the upper bounds, over boxes [B, d]."""
        c, g, r, ends = form.c, form.g, form.r, []
        for side, (plane, constant) in zip((1.0, -1.0), self.planes, strict=True):
            fixed, end = (self.least, 0.0) if side > 0 else (self.most, 1.0)
            span = np.where(self.high > self.low, 0.5 * (self.high - self.low), 1.0)
            place, slope = (centre - 0.5 * (self.low + self.high)) / span, plane[:, None] * (half / span).T
            middle = constant + place @ plane
            tilt = np.abs(slope - g).sum(axis=0) + r
            linear = side * (middle - c) + tilt + 1e-13 * (np.abs(plane).sum() + tilt + np.abs(middle - c))
            # pictures are clamped: a bound beyond the end of [0, 1] holds
            beyond = side * (middle - end) + np.abs(slope).sum(axis=0) + 1e-13 * np.abs(plane).sum()
            linear = np.where(beyond <= 0.0, -1.0, linear)
            flat = side * (fixed - c) + (np.abs(g).sum(axis=0) + r) * (1.0 + 1e-13)
            both = np.maximum(linear, -1.0 if side * (fixed - end) <= 0.0 else flat)
            # not a number: nothing is known
            ends.append(np.where(np.isnan(both), np.inf, both))
        return ends[0], ends[1]

    def trivial(self) -> bool:
        """Whether the bounds are [0, 1] or wider."""
        (a, b), (c, d) = self.planes
        ends = b + np.abs(a).sum() <= 0.0 and d - np.abs(c).sum() >= 1.0
        return bool(self.least <= 0.0 and self.most >= 1.0 and ends)


class Picture:
    """The claims of a frame's cells.

    Args:
        cells: Of the frame.
        scene: What is drawn.
        poses: The frame's poses.
        report: Of the result.
    """

    def __init__(self, cells: StoredCells, scene: Any, poses: Poses, report: dict[str, Any]) -> None:
        self.cells, self.scene, self.poses = cells, scene, poses
        self.units, self.together = units(scene, report), 64 if isinstance(scene, ActivatedScene) else 4

    @property
    def count(self) -> int:
        """Number of cells."""
        return len(self.cells.arrays["tile"])

    def draw(self, rng: Any, hunted: bool) -> PixelClaim:
        """A claim that is uniform over cells, pixels and channels, or the most telling of eight: narrow and moving."""
        a = self.cells.arrays
        height, width, _ = a["lower"].shape
        side = a["b_lower"].shape[1]
        best, chosen = -1.0, PixelClaim(0, 0, 0, 0)
        for _ in range(8 if hunted else 1):
            while True:
                cell = int(rng.integers(self.count))
                row, column = (int(t) + int(rng.integers(side)) for t in a["tile"][cell])
                # tiles may reach past the picture; those places are drawn again, so that pixels are uniform
                if row < height and column < width:
                    break
            claim = PixelClaim(cell, row, column, int(rng.integers(3)))
            (_, b), (slope, c) = self.bounds(claim).planes
            interest = float((np.abs(slope).sum() + 1e-4) / max(c - b, 1e-7)) if np.any(slope) else 0.0
            best, chosen = (interest, claim) if interest > best else (best, chosen)
        return chosen

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
        return ClaimedBounds(least, most, a["box_lower"][k], a["box_upper"][k], planes)

    def settle(self, claim: PixelClaim, deadline: float) -> Verdict:
        """True: proved; False: refuted, with the pose; None: open when the time was over; and of which picture."""
        bounds, begin = self.bounds(claim), time.monotonic()
        if bounds.trivial():
            return True, "float32" if self.units[0] else "real", {}
        for unit in self.units:
            end = begin + (deadline - begin) * (FIRST if unit else 1.0)
            verdict, detail = self._settle(bounds, claim, unit, end)
            if verdict is not None:
                return verdict, "float32" if unit else "real", detail
        return None, "", {}

    def _settle(
        self, bounds: ClaimedBounds, claim: PixelClaim, unit: float, deadline: float
    ) -> tuple[bool | None, dict[str, Any]]:
        low, high, looked = bounds.low, bounds.high, 0
        stack = [(low, high, self._near(low, high, claim, unit))]
        while stack:
            if time.monotonic() > deadline or looked > MOST_BOXES:
                return None, {}
            batch = [stack.pop()]
            index = batch[0][2]
            while stack and len(batch) < self.together and (len(batch) + 1) * max(len(index), 1) <= BATCH:
                index = np.union1d(index, stack[-1][2])
                batch.append(stack.pop())
            first, last = (np.stack([b[k] for b in batch]) for k in (0, 1))
            looked += len(batch)
            form, kept, motion = self._forms(first, last, index, claim, unit)
            middle = 0.5 * (first + last)
            below, above = bounds.excess(middle, np.maximum(last - middle, middle - first), form)
            open_ = np.flatnonzero((below > 0.0) | (above > 0.0))
            if not len(open_):
                continue
            detail, hopeless = self._points(bounds, middle[open_[:8]], index, claim, unit)
            if detail or hopeless:
                return (False if detail else None), detail
            for k in open_:
                inner = index[kept[k]] if len(kept[k]) else index
                stack.extend((a, b, inner) for a, b in divided(first[k], last[k], motion[:, k], high - low))
        return True, {}

    def _near(self, low: Array, high: Array, claim: PixelClaim, unit: float) -> Array:
        if not isinstance(self.scene, ActivatedScene):
            return np.zeros(0, np.int64)
        view = self.poses.view(low[None], high[None])
        return meeting(reaches(self.scene, self.poses.camera, view, unit)[0], claim.row, claim.column)

    def _forms(
        self, low: Array, high: Array, index: Array, claim: PixelClaim, unit: float
    ) -> tuple[Affine, Array, Array]:
        view = self.poses.view(low, high)
        pixel = np.full(len(low), claim.row), np.full(len(low), claim.column)
        if isinstance(self.scene, ActivatedScene):
            at = np.broadcast_to(index, (len(low), len(index)))
            form, kept, motion = pixels(self.scene, self.poses.camera, view, at, pixel, unit)
        else:
            form = self.scene.pixels(self.poses.camera, view, pixel)
            kept, motion = np.zeros((len(low), 0), bool), np.ones((low.shape[1], len(low)))
        return form.of(lambda a: a[..., claim.channel]), kept, motion

    def _points(
        self, bounds: ClaimedBounds, points: Array, index: Array, claim: PixelClaim, unit: float
    ) -> tuple[Any, bool]:
        """A pose at which the picture surely lies outside the bounds, and whether one of the points can't be proved."""
        form, _, _ = self._forms(points, points, index, claim, unit)
        error, zero = np.abs(form.g).sum(axis=0) + form.r, np.zeros_like(points)
        hopeless = (np.maximum(*bounds.excess(points, zero, form)) > 0.0).any()
        for side, sign in (("lower", 1.0), ("upper", -1.0)):
            # the least picture above the upper bound, the largest below the lower one
            shifted = Affine(form.c + sign * 2.0 * error, 0.0 * form.g, error)
            out = bounds.excess(points, zero, shifted)[side == "upper"] - 4e-13 * (1.0 + np.abs(form.c))
            k = int(np.argmax(np.where(np.isfinite(out) & np.isfinite(error), out, -1.0)))
            if np.isfinite(out[k]) and out[k] > 0.0 and np.isfinite(error[k]):
                value = {"value": float(np.clip(form.c[k], 0.0, 1.0)), "error": float(error[k])}
                return {"pose": points[k].tolist(), **value, "bound": side, "excess": float(out[k])}, True
        return {}, bool(hopeless)


def units(scene: Any, report: dict[str, Any]) -> tuple[float, ...]:
    """Roundoffs of the pictures that are tried: float32's first, where that is claimed and this program has charges."""
    splats = isinstance(scene, ActivatedScene)
    return (FLOAT, 0.0) if splats and report.get("guarantee") == "float32-sound" else (0.0,)


def divided(low: Array, high: Array, motion: Array, full: Array) -> list[tuple[Array, Array]]:
    """Parts of a box: along the side that moves the picture most."""
    width = high - low
    if not (width > 0.0).any():
        return [(low, high)]
    weight = np.where(np.isfinite(motion), motion, 0.0)
    weight = np.where(
        width > 0.0, weight + 1e-3 * (weight.max() + 1e-30) * width / np.where(full > 0.0, full, 1.0), -1.0
    )
    axis, count = int(np.argmax(weight)), 4 if len(width) == 1 else 2
    parts, rest = [], (low, high)
    for k in range(1, count):
        top, bottom = rest[1].copy(), rest[0].copy()
        top[axis] = bottom[axis] = low[axis] + width[axis] * k / count
        parts.append((rest[0], top))
        rest = (bottom, rest[1])
    return [*parts, rest]
