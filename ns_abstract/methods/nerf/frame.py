"""One frame of a NeRF, ready for refinement: bounds, renders and motion of its pose set (docs/dev/design.md, R5)."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import UNIT32
from ns_abstract.execution.cancellation import WorkCancelledError, check_cancelled, is_cancelled
from ns_abstract.execution.engines import Processes
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import COLOR_SHIFTS, PoseBox
from ns_abstract.geometry.tiles import tile_grid
from ns_abstract.methods.nerf.bounds import NerfBounds
from ns_abstract.methods.nerf.hsv import color_shift, shift_ends, shift_parts
from ns_abstract.methods.nerf.ray_field import BoundedRays, RayBounds, Shifts, typical_displacement
from ns_abstract.methods.nerf.render import NerfRenderer, RayRenderer, Sampling
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.nerf.strips import PoseStrips
from ns_abstract.refine.protocol import Bounds, Frame


@dataclass(frozen=True)
class FieldTuning:
    """Tolerances of fields' frames and steps of their estimates; soundness does not depend on them."""

    #: What an open sample may move a pixel by on boxes a quarter as wide as the set, as a part of the pixels' mean
    #: variation over the set; less on narrower boxes.
    tolerance: float = 0.12
    most_tolerance: float = 0.03
    least_tolerance: float = 5e-4
    #: The least tolerance of sets over which pixels hardly vary, as a part of their mean variation; and of any set:
    #: bounds are kept in float32, where a finer one shows nowhere.
    least_share: float = 0.02
    finest_tolerance: float = UNIT32
    #: Rays and poses rendered to estimate that variation.
    look_rays: int = 256
    look_poses: int = 7
    #: Step of the difference quotient that tells how far the picture moves, as a part of the parameter's range.
    motion_step: float = 2.0**-10
    #: Pixels that a turn of the whole circle of hues counts for.
    motion_of_turn: float = 6.0


_TUNING = FieldTuning()
#: Poses on the diagonal of a box that are rendered to see which colours it reaches, besides random ones.
_LOOK_SHARES = np.linspace(0.0, 1.0, 9)
#: Parts of every range of hues and saturations.
_SHIFT_PARTS = 12
#: Weights of one share of work, in units of rays times weights, and shares of a worker between two looks at the goal
#: where there are several workers: they end at about the same time.
_WORK, _SHARES = 1_600_000, 4
#: Rays that fill the batches of a GPU.
_RAYS_ON_DEVICE = 256
#: Relative change of the width of cells, from some rays to the next, below which it is known.
_STEADY = 0.03
#: Seconds between looks at results of other processes, and those that they get to end when the time is over.
_PATIENCE, _GRACE = 0.2, 3.0


@dataclass(frozen=True)
class RayContext:
    """Opacities of rays over a cell, reused for the same rays in the cells inside it.

    Attributes:
        tiles: [t] numbers of the rays, ascending.
        alpha: [t, samples] upper bounds of opacities over the cell.
    """

    tiles: np.ndarray
    alpha: np.ndarray

    def of(self, tiles: np.ndarray) -> np.ndarray:
        """Return bounds [t, samples] of ``tiles`` [t], which are among its own."""
        return self.alpha[np.searchsorted(self.tiles, tiles)]

    @property
    def nbytes(self) -> int:
        """The bytes that it holds."""
        return self.tiles.nbytes + self.alpha.nbytes

    @property
    def shown(self) -> None:
        """None: a field has no elements."""
        return None


@lru_cache(maxsize=1)
def _processes(count: int) -> Processes:
    """Return worker processes that live until this process ends, as importing and compiling takes seconds."""
    return Processes(count)


#: In a worker: the scene it works on, and its bounds by frame.
_here: dict[bytes, NerfBounds] = {}


def _bound_share(frame: bytes, bounds: tuple[Any, ...], displacement: float, arguments: Sequence[Any]) -> RayBounds:
    """Return `BoundedRays.rays` in a worker process; ``bounds`` are the constructor's arguments."""
    if frame not in _here:
        _here.clear()
        _here[frame] = NerfBounds(*bounds)
    _here[frame].displacement = displacement
    return _here[frame].rays(*arguments)


class FieldFrame(Frame):
    """Bounds and renders one frame's pose set of a field.

    Every ray is a tile of its own. The whole set is bounded by [0, 1] without work, so that refinement can take ray
    after ray.

    Args:
        share: Number of rays that are bounded together.
        at_once: Number of rays between two checks of the goal.
        workers: Number of shares that are bounded side by side.
    """

    tilewise = True
    channels = 3
    side = 1
    tiles_at_once: int
    #: Poses rendered in every part of a cell that is split.
    witnesses = 8

    def __init__(
        self, pose_set: PoseBox, renderer: RayRenderer, bounds: BoundedRays, share: int, at_once: int, workers: int
    ) -> None:
        self.pose_set, self.camera, self.box = pose_set, pose_set.camera, pose_set.box
        self.across, self.down = tile_grid(self.camera, self.side)
        self._geometry = pose_set.geometry
        self.renderer, self.bounds, self.workers = renderer, bounds, workers
        self._share, self.tiles_at_once = share, at_once
        self._inner: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        #: whether boxes need not wait for what others tell of the width of cells
        self._steady = False
        #: Numbers of the rays that `cell_bounds` bounds; of others it says 0.
        self.rays = np.arange(self.tile_count)

    def _pixels(self, tiles: np.ndarray) -> np.ndarray:
        return np.stack([tiles // self.across, tiles % self.across], axis=1)

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Return rays [t, 1, 1, 3] float32 of the image at parameter values [d]."""
        return self.precise(values, tiles).astype(np.float32)

    def precise(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Return the result of `render` before rounding: float64."""
        which = np.arange(self.tile_count) if tiles is None else tiles
        shift = color_shift(self.pose_set, values)
        colors = self.renderer.pixels(self.pose_set.camera, self.pose_set.pose(values), self._pixels(which), shift)
        return colors[:, None, None, :]

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        """Return ``box``: every parameter in it belongs to a pose of the set."""
        return box

    def motion(self, box: ParameterBox) -> np.ndarray:
        """Return the estimated motion [d] in pixels of points at a typical distance over each parameter's range."""
        d = box.dimensions
        low, high = np.array(box.lower), np.array(box.upper)
        distance = float(self.bounds.distances[self.bounds.distances.size // 2])
        largest = np.zeros(d)
        here = self._point(box.middle, distance)
        for k in range(d):
            step = np.zeros(d)
            step[k] = _TUNING.motion_step * (high[k] - low[k])
            moved = np.linalg.norm(self._point(box.middle + step, distance) - here) / _TUNING.motion_step
            largest[k] = moved / distance * self.camera.fx
            if box.names[k] in COLOR_SHIFTS:
                largest[k] = _TUNING.motion_of_turn * (high[k] - low[k])
        return largest

    def _point(self, values: np.ndarray, distance: float) -> np.ndarray:
        pose = self.pose_set.pose(values)
        return pose[:, 3] - distance * pose[:, 2]

    def warm_up(self, stage: str | None = None) -> None:
        """Compile the kernels that this frame needs, which are few."""
        box = self.box
        for axis in range(box.dimensions):
            box = box.split(axis, 1024)[0]
        self.bounds.rays(self._geometry, box.without(COLOR_SHIFTS), self._pixels(np.arange(1)), 1.0)
        self.render(box.middle, np.arange(1))

    def bound_parts(
        self, boxes: Sequence[ParameterBox], tiles: np.ndarray, within: RayContext | None = None,
        keep_linear: bool = False, pixels: np.ndarray | None = None,
    ) -> list[Bounds]:  # fmt: skip
        """Return bounds of the rays ``tiles`` over each of ``boxes``; ``within``: of these rays and an enclosing box.

        Rays for which there is no time (`ns_abstract.execution.cancellation`) are bounded by [0, 1].
        """
        tiles = np.asarray(tiles)
        if self.box.dimensions > 0 and self.box in boxes:
            nothing = self._unknown(tiles.size)
            return [self._box(nothing.lower, nothing.upper, None, keep_linear) for _ in boxes]
        order = np.argsort(tiles)
        part_bounds = []
        for parts in self._parts(boxes, tiles, None if within is None else within.of(tiles)):
            lower, upper, alpha = (
                np.concatenate([getattr(part, name) for part in parts]) for name in ("lower", "upper", "alpha")
            )
            part_bounds.append(self._box(lower, upper, RayContext(tiles[order], alpha[order]), keep_linear))
        return part_bounds

    def _box(self, lower: np.ndarray, upper: np.ndarray, context: RayContext | None, keep_linear: bool) -> Bounds:
        """Return `Bounds` from bounds [t, 3] of rays."""
        d = self.box.dimensions
        low, high = (side.reshape(-1, 1, 1, 3) for side in outward(lower, upper))
        linear = None
        if keep_linear:
            flat = np.zeros((*low.shape, d), np.float32)
            linear = flat, low, flat, high
        return Bounds(low, high, np.zeros(d), context, linear)

    def _unknown(self, count: int) -> RayBounds:
        """Return the trivial bounds of ``count`` rays."""
        alpha = np.ones((count, self.bounds.distances.size), np.float32)
        return RayBounds(np.zeros((count, 3)), np.ones((count, 3)), alpha, 0, self.bounds.displacement)

    def _parts(
        self, boxes: Sequence[ParameterBox], tiles: np.ndarray, known: np.ndarray | None
    ) -> list[list[RayBounds]]:
        """Return bounds of rays over each of ``boxes``, in several groups; [0, 1] where there is no time."""
        bounds_by_box: list[list[RayBounds]] = [[] for _ in boxes]
        with suppress(WorkCancelledError):
            for first in range(0, tiles.size, self.tiles_at_once):
                check_cancelled()
                mine, begun = slice(first, first + self.tiles_at_once), 0
                while begun < len(boxes):
                    past = len(boxes) if self._steady else begun + 1
                    batch = self._batch(boxes[begun:past], tiles[mine], None if known is None else known[mine])
                    for parts, more in zip(bounds_by_box[begun:past], batch, strict=True):
                        parts += more
                    begun = past
        for parts in bounds_by_box:
            missing = tiles.size - sum(len(part.lower) for part in parts)
            if missing:
                parts.append(self._unknown(missing))
        return bounds_by_box

    def _batch(
        self, boxes: Sequence[ParameterBox], tiles: np.ndarray, known: np.ndarray | None
    ) -> list[list[RayBounds]]:
        """Return bounds over each of ``boxes`` of rays that are bounded together, in shares for all workers."""
        size = min(self._share, -(-tiles.size // self.workers))
        shares = []
        for box in boxes:
            tolerance, shifts = self._tolerance(box), self._shifts(box)
            low, high = self._reached(box, tiles, bool(shifts))
            low, high = low - tolerance, high + tolerance
            poses = box.without(COLOR_SHIFTS)
            for start in range(0, tiles.size, size):
                part = slice(start, start + size)
                shares.append(
                    (
                        self._geometry, poses, self._pixels(tiles[part]), tolerance,
                        None if known is None else known[part], (low[part], high[part]), shifts,
                    )
                )  # fmt: skip
        tried = self._tried(shares)
        done = [part for part in tried if part is not None]
        if done:
            before, self.bounds.displacement = self.bounds.displacement, typical_displacement(done)
            self._steady = abs(self.bounds.displacement / before - 1.0) < _STEADY
        parts = [
            self._unknown(len(share[2])) if part is None else part for share, part in zip(shares, tried, strict=True)
        ]
        each = len(parts) // len(boxes)
        return [parts[i : i + each] for i in range(0, len(parts), each)]

    def _run(self, calls: Sequence[Sequence[Any]]) -> list[RayBounds]:
        """Return `BoundedRays.rays` with the arguments of each call, side by side where there are several."""
        parts = [part for part in self._tried(calls) if part is not None]
        if len(parts) < len(calls):
            raise WorkCancelledError
        return parts

    def _tried(self, calls: Sequence[Sequence[Any]]) -> list[RayBounds | None]:
        """Return bounds of rays by call (arguments of `rays`), one by one; None: there was no time for a call."""
        parts: list[RayBounds | None] = []
        with suppress(WorkCancelledError):
            for call in calls:
                parts.append(self.bounds.rays(*call))
        return parts + [None] * (len(calls) - len(parts))

    @cached_property
    def _strips(self) -> PoseStrips:
        return PoseStrips(self.bounds, self.pose_set, self._pixels(self.rays), self._run)

    def cell_bounds(
        self, box: ParameterBox, weigh: Callable[[], np.ndarray | None] | None = None, most_rays: int | None = None
    ) -> Bounds:
        """Return linear bounds of all rays over a cell ``box``, from stored bounds over strips of the set.

        Args:
            most_rays: Approximate number of bounded rays, the first of `rays`; the others stay at [0, 1]. All if None.
            weigh: Returns [H, W, 3] the fraction of the margin that a unit of each pixel's width costs, or None; called
                only where rays could be refined.
        """

        def weights() -> np.ndarray | None:
            pixel_weights = None if weigh is None else weigh()
            if pixel_weights is None:
                return None
            return np.asarray(pixel_weights, np.float64).reshape(self.tile_count, 3)[self.rays]

        linear, lower, upper = self._strips.cell_bounds(box, weights, most_rays)
        if len(lower) < self.rays.size:
            missing = [(0, self.rays.size - len(lower)), *[(0, 0)] * 2]
            linear = [np.pad(part, missing[: part.ndim], constant_values=k == 3) for k, part in enumerate(linear)]
            lower, upper = np.pad(lower, missing[:2]), np.pad(upper, missing[:2], constant_values=1)
        shape = (self.tile_count, 1, 1, 3)
        a_lower, b_lower, a_upper, b_upper, lower, upper = (self._every(part) for part in (*linear, lower, upper))
        d = box.dimensions
        slopes = 0.5 * (np.abs(a_lower) + np.abs(a_upper)).astype(np.float64).sum(axis=(0, 1))
        sets = a_lower.reshape(*shape, d), b_lower.reshape(shape), a_upper.reshape(*shape, d), b_upper.reshape(shape)
        return Bounds(lower.reshape(shape), upper.reshape(shape), slopes, None, sets)

    def _every(self, part: np.ndarray) -> np.ndarray:
        """Return bounds of all rays from those, ``part``, of the rays in `rays`."""
        whole = np.zeros((self.tile_count, *part.shape[1:]), part.dtype)
        whole[self.rays] = part
        return whole

    def effort(self) -> tuple[float | None, int]:
        """Return the estimated seconds of one ray over one strip of the set, and the number of strips.

        None: there was no time to find out (`ns_abstract.execution.cancellation`).
        """
        strips = self._strips
        with suppress(WorkCancelledError):
            strips.layout()
        return strips.effort, strips.count

    def observe(self, tiles: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        """Receive the inner bounds [t, 1, 1, 3] of ``tiles`` [t]."""
        places = np.full(self.tile_count, -1)
        places[tiles] = np.arange(tiles.size)
        self._inner = places, lower, upper

    def plan(self, visible: int | None, lower: np.ndarray, upper: np.ndarray) -> list[str]:
        """Return sentences on what was left out for this frame, given the bounds of refinement."""
        untreated = int(((lower == 0.0) & (upper == 1.0)).all(axis=-1).sum())
        total = lower.shape[0] * lower.shape[1]
        return [f"{untreated:,} of {total:,} rays left at [0, 1]: the work ended before them"] if untreated else []

    def _reached(self, box: ParameterBox, tiles: np.ndarray, shifted: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return ends [n, 3] of rendered colours over the box or, where a refinement reports them, over the set.

        They are those before any shift of colours: if they are ``shifted``, a refinement's are not used.
        """
        if self._inner is not None and not shifted:
            places, *sides = self._inner
            low, high = (side[places[tiles], 0, 0].astype(np.float64) for side in sides)
        else:
            rng, pixels, box = np.random.default_rng(0), self._pixels(tiles), box.without(COLOR_SHIFTS)
            inside = [box.at(np.full(box.dimensions, 2.0 * share - 1.0)) for share in _LOOK_SHARES]
            values = [*inside, *box.sample(_TUNING.look_poses, rng)] if box.dimensions else [box.middle]
            poses = [self._geometry.pose(v) for v in values]
            pictures = np.stack([self.renderer.pixels(self.pose_set.camera, pose, pixels) for pose in poses])
            low, high = pictures.min(axis=0), pictures.max(axis=0)
        return low, high

    def _shifts(self, box: ParameterBox) -> list[Shifts]:
        """Return equal parts of the box's colour shifts, which cost little to bound apart; empty: there are none."""
        return shift_parts(shift_ends(box, self.pose_set.fixed, _SHIFT_PARTS))

    def _tolerance(self, box: ParameterBox) -> float:
        """Return the tolerance for a box: smaller for narrower boxes, as bounds of wider ones did not suffice."""
        box = box.without(COLOR_SHIFTS)
        if not box.dimensions:
            return _TUNING.least_tolerance
        outer = self._geometry.box
        whole = np.array(outer.upper) - np.array(outer.lower)
        width = np.array(box.upper) - np.array(box.lower)
        share = float(np.prod(width / whole)) ** (1.0 / box.dimensions)
        least = min(_TUNING.least_tolerance, max(_TUNING.finest_tolerance, _TUNING.least_share * self._variation))
        return max(least, min(1.0, 4.0 * share) * min(_TUNING.most_tolerance, _TUNING.tolerance * self._variation))

    @cached_property
    def _variation(self) -> float:
        """Estimated mean motion of colours over the set, from a sample of rays."""
        rng = np.random.default_rng(0)
        tiles = np.sort(rng.permutation(self.tile_count)[: _TUNING.look_rays])
        values = [*self.box.sample(_TUNING.look_poses - 2, rng), np.array(self.box.lower), np.array(self.box.upper)]
        pictures = np.stack([self.render(v, tiles) for v in values])
        return float((pictures.max(axis=0) - pictures.min(axis=0)).mean())


class NerfFrame(FieldFrame):
    """Bounds and renders one frame's set of poses of a vanilla NeRF.

    Args:
        workers: Processes that bound rays side by side, one core each: the matrices are too small to be shared
            among cores. Results do not depend on where a ray is bounded, but on what is bounded together.
    """

    #: Measured for one parameter and uniform samples.
    compiled = 84, 40.0

    def __init__(
        self, scene: NerfScene, sampling: Sampling, pose_set: PoseBox, device: str = "cpu", workers: int = 1
    ) -> None:
        self._recipe: tuple[Any, ...] = (scene, sampling, pose_set.geometry.box.dimensions, device)
        self._token = secrets.token_bytes(16)
        bounds = NerfBounds(*self._recipe)
        weights = sum(array.size for array in scene.fine.arrays())
        share = int(np.clip(_WORK // weights, 1, 32)) if bounds.compiled else _RAYS_ON_DEVICE
        at_once = workers * share * (_SHARES if bounds.compiled and workers > 1 else 1)
        super().__init__(pose_set, NerfRenderer(scene, sampling, device=device), bounds, share, at_once, workers)
        self.renderer: NerfRenderer

    def _tried(self, calls: Sequence[Sequence[Any]]) -> list[RayBounds | None]:
        """Return `_run` in processes; None: there was no time for a call."""
        if len(calls) == 1 or self.workers == 1:
            return super()._tried(calls)
        engine = _processes(self.workers)
        for number, call in enumerate(calls):
            engine.submit(number, _bound_share, self._token, self._recipe, self.bounds.displacement, call)
        done: dict[int, RayBounds] = {}
        patience = None
        try:
            while len(done) < len(calls):
                for number, answer in engine.collect(_PATIENCE):
                    if not isinstance(answer, WorkCancelledError):
                        done[number] = answer
                if patience is None and is_cancelled():
                    patience = time.monotonic() + _GRACE
                    engine.abandon()
                if patience is not None and (not engine.unfinished or time.monotonic() > patience):
                    break
        finally:
            # what is still at work would answer those who ask next
            if engine.unfinished:
                _processes.cache_clear()
                engine.close()
        return [done.get(number) for number in range(len(calls))]
