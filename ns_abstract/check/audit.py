"""Claims of a result, drawn at random and proved, refuted or left open; see docs/check.md."""

from __future__ import annotations

import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ns_abstract.check.inputs import RULES, BadInput, dataset_scale, given_set, read_poses, read_scene
from ns_abstract.check.poses import Poses
from ns_abstract.check.results import Cells, read_cells, read_report, structure
from ns_abstract.check.splats import Splats, candidates, pixel_form

Array = Any

#: Boxes times Gaussians that are looked at together, and boxes of one claim before it is given up.
BATCH, MOST_BOXES = 40_000, 400_000
#: Part of the settled claims below which the audit says too little.
ENOUGH = 0.8
CONFIDENCE = 0.95


class Claim(NamedTuple):
    """A pixel's channel over a cell of a frame; ``hunted``: not drawn uniformly."""

    frame: int
    cell: int
    row: int
    column: int
    channel: int
    hunted: bool


@dataclass
class Audit:
    """What came of the claims.

    Attributes:
        claims: Number of claims that were looked at.
        proved, refuted, unsettled: Their numbers by outcome.
        refutations: By refuted claim: frame, cell, pixel, channel, pose, value, its error, the bound.
        uniform: Claims and proofs of the uniform sample, and the least part of all claims that holds, at 95 %.
        structure: What is wrong with the cells; empty: they tile every set, and every pixel is bounded.
        seconds, median_seconds: Of all claims, and of one.
        picture: What was proved of: "real numbers".
    """

    claims: int = 0
    proved: int = 0
    refuted: int = 0
    unsettled: int = 0
    refutations: list[dict[str, Any]] = field(default_factory=list)
    uniform: dict[str, Any] = field(default_factory=dict)
    structure: list[str] = field(default_factory=list)
    seconds: float = 0.0
    median_seconds: float = 0.0
    picture: str = "real numbers"

    @property
    def exit_code(self) -> int:
        """0 nothing refuted, 1 refuted, 3 too few claims settled."""
        if self.refuted or self.structure:
            return 1
        return 3 if self.proved < ENOUGH * self.claims or not self.claims else 0


def run(
    folder: Path, *, claims: int, seconds: float, seed: int, load_config: Path | None = None,
    camera_path: Path | None = None, perturbation: Path | None = None,
    on_claim: Callable[[Audit], object] | None = None,
) -> Audit:  # fmt: skip
    """Audit the result in ``folder`` and write ``check.json`` there.

    Args:
        folder: Output folder of ns-abstract-render --save-cells.
        claims: Number of claims to draw.
        seconds: Time for all of them.
        seed: Of the draws.
        load_config, camera_path, perturbation: Where files lie that have been moved since.
        on_claim: Called after every claim; False ends the audit.

    Raises:
        BadInput: A file cannot be used.
    """
    begin = time.monotonic()
    report = read_report(folder)
    settings, renderer = report["settings"], report.get("renderer") or {}
    if renderer.get("name") != "gsplat" or renderer.get("version") not in RULES:
        found = f"{renderer.get('name')} {renderer.get('version')}"
        raise BadInput(f"found {found}, and this program checks gsplat alone", folder / "report.json", "renderer")
    if report.get("guarantee") not in ("float32-sound", "real-sound"):
        raise BadInput(f"found {report.get('guarantee')!r}: nothing is claimed", folder / "report.json", "guarantee")
    config = load_config or _stored(settings, "load_config", folder)
    splats, digest = read_scene(config, settings, report["scene"], renderer["version"])
    if digest != report["fingerprint"].get("scene"):
        raise BadInput("is not the scene of the result (its digest differs)", config, fix="give the run of the result")
    path = camera_path or _stored(settings, "camera_path_filename", folder)
    given = given_set(settings, perturbation)
    frames: list[tuple[Cells, Poses]] = []
    for entry in report["frames"]:
        index, name = entry.get("index"), (entry.get("files") or {}).get("npz")
        # where the cells do not cover the set yet nothing is claimed
        if (
            name is None
            or entry.get("status") == "missing"
            or (entry.get("trace") or [{}])[-1].get("covered", 1.0) < 1.0
        ):
            continue
        if not isinstance(index, int) or name != f"frame_{index:05d}.npz":
            raise BadInput(f"found {name!r}", folder / "report.json", "frames.files.npz")
        cells = read_cells(folder, name, index, report["sha256"].get(name))
        poses, free = read_poses(path, given, index, settings, dataset_scale(config))
        ranges = list(zip(cells.names, cells.lower.tolist(), cells.upper.tolist(), strict=True))
        size = cells.arrays["lower"].shape[:2]
        if ranges != free or size != (poses.camera.height, poses.camera.width):
            fix = "give the camera path and the set of the result"
            raise BadInput(f"frame {index} of the result is another set of poses or size", path, fix=fix)
        frames.append((cells, poses))
    if not frames:
        raise BadInput("no frame has a result", folder / "report.json", "frames")
    audit = Audit(structure=[f"frame {c.index}: {text}" for c, _ in frames for text in structure(c)])
    spent: list[float] = []
    uniform = [0, 0]
    if not audit.structure:
        for claim in draw([c for c, _ in frames], claims, seed):
            left = begin + seconds - time.monotonic()
            cells, poses = frames[claim.frame]
            start = time.monotonic()
            share = max(4.0 * left / max(claims - audit.claims, 1), 0.0)
            verdict, detail = (
                settle(splats, poses, cells, claim, start + min(share, left)) if left > 0.0 else (None, {})
            )
            spent.append(time.monotonic() - start)
            _count(audit, claim, cells, verdict, detail)
            if not claim.hunted:
                uniform[0] += 1
                uniform[1] += verdict is True
            if on_claim is not None and on_claim(audit) is False:
                break
    audit.uniform = {"claims": uniform[0], "proved": uniform[1], "holds_at_least": least_part(uniform[1], uniform[0])}
    audit.seconds, audit.median_seconds = time.monotonic() - begin, statistics.median(spent) if spent else 0.0
    (folder / "check.json").write_text(
        json.dumps({"version": 1, "seed": seed, **vars(audit)}, indent=1, allow_nan=False)
    )
    return audit


def _stored(settings: dict[str, Any], name: str, folder: Path) -> Path:
    value = settings.get(name)
    if not isinstance(value, str):
        raise BadInput("missing", folder / "report.json", f"settings.{name}", f"give --{name.replace('_', '-')}")
    return Path(value)


def _count(audit: Audit, claim: Claim, cells: Cells, verdict: bool | None, detail: dict[str, Any]) -> None:
    audit.claims += 1
    if verdict is None:
        audit.unsettled += 1
    elif verdict:
        audit.proved += 1
    else:
        audit.refuted += 1
        place = {"pixel": [claim.row, claim.column], "channel": claim.channel, "parameters": list(cells.names)}
        audit.refutations.append({"frame": cells.index, "cell": claim.cell, **place, **detail})


def draw(frames: list[Cells], count: int, seed: int) -> list[Claim]:
    """``count`` claims: in turns one that is uniform over frames' cells, pixels and channels, and one hunted.

    A hunted claim is the narrowest of eight whose bounds are not trivial, or one at a tile's edge.
    """
    rng = np.random.default_rng(seed)
    sizes = np.array([len(c.arrays["tile"]) for c in frames], np.float64)

    def one(hunted: bool) -> Claim:
        frame = int(rng.choice(len(frames), p=sizes / sizes.sum()))
        a = frames[frame].arrays
        height, width, _ = a["lower"].shape
        side = a["b_lower"].shape[1]
        while True:
            cell = int(rng.integers(len(a["tile"])))
            row, column = (int(t) + int(rng.integers(side)) for t in a["tile"][cell])
            # tiles may reach past the picture; those places are drawn again, so that pixels are uniform
            if row < height and column < width:
                return Claim(frame, cell, row, column, int(rng.integers(3)), hunted)

    def interest(claim: Claim) -> float:
        a = frames[claim.frame].arrays
        row, column = claim.row - a["tile"][claim.cell][0], claim.column - a["tile"][claim.cell][1]
        slope = np.abs(a["A_upper"][claim.cell, row, column, claim.channel]).sum()
        gap = (
            a["b_upper"][claim.cell, row, column, claim.channel] - a["b_lower"][claim.cell, row, column, claim.channel]
        )
        return float((slope + 1e-4) / max(gap, 1e-7)) if slope > 0.0 else 0.0

    return [max((one(True) for _ in range(8)), key=interest) if k % 2 else one(False) for k in range(count)]


class _Bounds(NamedTuple):
    """What is claimed: constants of the frame, and planes over the cell's box."""

    least: float
    most: float
    low: Array
    high: Array
    planes: tuple[tuple[Array, float], tuple[Array, float]]

    def excess(self, centre: Array, half: Array, c: Array, g: Array, r: Array) -> tuple[Array, Array]:
        """By how much pictures c + g . s within r may lie [B] below the lower and above the upper bounds."""
        reach = (np.abs(g).sum(axis=0) + r) * (1.0 + 1e-13)
        found = []
        for side, (plane, constant) in zip((1.0, -1.0), self.planes, strict=True):
            fixed = self.least if side > 0 else self.most
            end = 0.0 if side > 0 else 1.0
            span = np.where(self.high > self.low, 0.5 * (self.high - self.low), 1.0)
            place = (centre - 0.5 * (self.low + self.high)) / span
            slope = plane[:, None] * (half / span).T
            middle = constant + place @ plane
            # nothing where the plane has no slope and the picture does not move: bounds of 0 and 1 are exact
            tilt = np.abs(slope - g).sum(axis=0) + r
            room = 1e-13 * (np.abs(plane).sum() + tilt + np.abs(middle - c))
            linear = side * (middle - c) + tilt + room
            # pictures are clamped: a bound beyond the end of [0, 1] holds
            beyond = side * (middle - end) + np.abs(slope).sum(axis=0) + 1e-13 * np.abs(plane).sum()
            linear = np.where(beyond <= 0.0, -1.0, linear)
            constant_ = np.full(len(c), -1.0) if side * (fixed - end) <= 0.0 else (side * (fixed - c) + reach)
            # not a number: nothing is known
            both = np.maximum(linear, constant_)
            found.append(np.where(np.isnan(both), np.inf, both))
        return found[0], found[1]


def _bounds(cells: Cells, claim: Claim) -> _Bounds:
    a, k = cells.arrays, claim.cell
    at = (k, claim.row - int(a["tile"][k, 0]), claim.column - int(a["tile"][k, 1]), claim.channel)
    pixel = (claim.row, claim.column, claim.channel)
    planes = tuple((a[f"A_{s}"][at].astype(np.float64), float(a[f"b_{s}"][at])) for s in ("lower", "upper"))
    ends = float(a["lower"][pixel]), float(a["upper"][pixel])
    return _Bounds(*ends, a["box_lower"][k], a["box_upper"][k], planes)  # pyright: ignore[reportArgumentType]


def settle(
    splats: Splats, poses: Poses, cells: Cells, claim: Claim, deadline: float
) -> tuple[bool | None, dict[str, Any]]:
    """True: proved; False: refuted, with the pose; None: open when the time was over."""
    bounds = _bounds(cells, claim)
    pixel = (claim.row, claim.column)
    if bounds.least <= 0.0 and bounds.most >= 1.0 and _trivial(bounds):
        return True, {}
    low, high = bounds.low, bounds.high
    stack = [(low, high, candidates(splats, poses, low, high, pixel))]
    looked = 0
    while stack:
        if time.monotonic() > deadline or looked > MOST_BOXES:
            return None, {}
        batch = [stack.pop()]
        index = batch[0][2]
        while stack and len(batch) < 64 and (len(batch) + 1) * max(len(index), 1) <= BATCH:
            index = np.union1d(index, stack[-1][2])
            batch.append(stack.pop())
        first, last = (np.stack([b[k] for b in batch]) for k in (0, 1))
        looked += len(batch)
        form, kept, motion = pixel_form(splats, poses, first, last, index, pixel, claim.channel)
        middle = 0.5 * (first + last)
        half = np.maximum(last - middle, middle - first)
        below, above = bounds.excess(middle, half, form.c, form.g, form.r)
        open_ = np.flatnonzero((below > 0.0) | (above > 0.0))
        if not len(open_):
            continue
        found = _refuted(splats, poses, bounds, middle[open_], index, pixel, claim.channel)
        if found:
            return False, found
        for k in open_:
            inner = index[kept[k]]
            stack.extend((a, b, inner) for a, b in _divided(first[k], last[k], motion[:, k], high - low))
    return True, {}


def _trivial(bounds: _Bounds) -> bool:
    (a, b), (c, d) = bounds.planes
    return b + np.abs(a).sum() <= 0.0 and d - np.abs(c).sum() >= 1.0


def _divided(low: Array, high: Array, motion: Array, full: Array) -> list[tuple[Array, Array]]:
    """Parts of a box: along the side that moves the picture most."""
    width = high - low
    if not len(width) or not (width > 0.0).any():
        return [(low, high)]
    share = width / np.where(full > 0.0, full, 1.0)
    weight = np.where(np.isfinite(motion), motion, 0.0)
    axis = int(np.argmax(weight + 1e-3 * (weight.max() + 1e-30) * share))
    count = 4 if len(width) == 1 else 2
    ends = [low[axis] + width[axis] * k / count for k in range(1, count)]
    parts, rest = [], (low, high)
    for end in ends:
        top, bottom = rest[1].copy(), rest[0].copy()
        top[axis] = bottom[axis] = end
        parts.append((rest[0], top))
        rest = (bottom, rest[1])
    return [*parts, rest]


def _refuted(
    splats: Splats, poses: Poses, bounds: _Bounds, points: Array, index: Array, pixel: tuple[int, int], channel: int
) -> dict[str, Any]:
    """A pose whose picture surely lies outside the bounds, if one of the points [B, d] is one."""
    points = points[:8]
    form, _, _ = pixel_form(splats, poses, points, points, index, pixel, channel)
    error = np.abs(form.g).sum(axis=0) + form.r
    zero = np.zeros_like(points)
    # the least picture above the upper bound, the largest below the lower one
    for side, sign in (("lower", 1.0), ("upper", -1.0)):
        shifted = form.c + sign * 2.0 * error
        below, above = bounds.excess(points, zero, shifted, 0.0 * form.g, error)
        out = (below if side == "lower" else above) - 4e-13 * (1.0 + np.abs(form.c))
        k = int(np.argmax(np.where(np.isfinite(out) & np.isfinite(error), out, -1.0)))
        if np.isfinite(out[k]) and out[k] > 0.0 and np.isfinite(error[k]):
            value = float(np.clip(form.c[k], 0.0, 1.0))
            return {
                "pose": points[k].tolist(),
                "value": value,
                "error": float(error[k]),
                "bound": side,
                "excess": float(out[k]),
            }
    return {}


def least_part(proved: int, count: int) -> float:
    """Clopper and Pearson's lower limit, at 95 %, of the part of all claims that holds: ``proved`` of ``count`` do."""
    if proved == 0:
        return 0.0
    low, high = 0.0, 1.0
    logs = [math.lgamma(count + 1) - math.lgamma(k + 1) - math.lgamma(count - k + 1) for k in range(proved, count + 1)]
    for _ in range(60):
        p = 0.5 * (low + high)
        tail = sum(
            math.exp(c + k * math.log(p) + ((count - k) * math.log1p(-p) if count > k else 0.0))
            for k, c in enumerate(logs, proved)
        )
        low, high = (p, high) if tail <= 1.0 - CONFIDENCE else (low, p)
    return low
