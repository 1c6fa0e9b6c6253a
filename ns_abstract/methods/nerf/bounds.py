"""Bounds of rays over a box of poses: cells by sample, densities and colours, compositing (design.md, F6-F8, F10, F14).

Every sample of a ray gets cells of its own width: where the field is rough over the sample's path, the box is cut
finer. The polynomials that come out of the network are then cut into parts at no cost, and compositing is done
part by part, where it is exact for independent samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.chebyshev import ChebyshevBasis
from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import CHEBYSHEV_ROUNDING, COMPOSITE_ROUNDING, UNIT64
from ns_abstract.arithmetic.taylor import TaylorArray
from ns_abstract.execution.ending import checkpoint
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseSet
from ns_abstract.methods.nerf.hsv import Range, shifted_bounds
from ns_abstract.methods.nerf.render import Sampling, camera_rays
from ns_abstract.methods.nerf.samples import composite, edge_bounds
from ns_abstract.methods.nerf.scene import FieldWeights, NerfScene
from ns_abstract.methods.nerf.zonotope import ERROR_TERMS, Affine, FieldBounds, Pieces

#: (degree, grid) of the polynomials by number of parameters.
_DEGREES = {0: (1, 2), 1: (28, 112), 2: (6, 20), 3: (4, 10)}
#: The same of one parameter for a field whose base has at most so many layers: it bears cells as wide as its waves are
#: followed, while deeper ones bend more.
_SHALLOW, _SHALLOW_DEGREE = 4, (35, 126)
#: Degree of the Taylor models of poses.
_TAYLOR = 6
#: Cells bounded at once by compiled kernels, whose numbers stay in a core's cache.
_BATCH = 128
#: Elsewhere: values of a layer's neurons on the grid, and how many arrays as large there may be at a time, about.
_VALUES, _ARRAYS = 1 << 25, 12
#: Samples of a ray that are bounded before the light that is left is looked at.
_BLOCK = 8
#: Halvings below cells of the starting width, by number of parameters (one level may concern any axis).
_DEEPER = {0: 0, 1: 2}
_DEEPER_MORE = 6
#: Halvings of the deepest cells into parts, by axis; the cells of a line have two or three parts as it is.
_FINER = {2: 1}
#: Most parts of one box.
_PARTS = 4096
#: Light (in [0, 1]) that a skipped sample may add, as a share of the tolerance.
_QUIET = 0.02
#: A cell on which an opacity is open by this much everywhere was far too wide.
_LOST = 0.5
#: Shares of the first cells that were far too wide and factors by which later ones begin narrower: the first share that
#: is exceeded counts. Work on wide cells is lost and there is more of it, as their error terms are more.
_LOST_SHARES = ((0.25, 0.6), (0.04, 0.87))
#: The share below which they begin wider, and the factor: this costs little, as the shares rise steeply with the width.
_FEW_LOST, _WIDER = 0.01, 1.08
#: Opacities of at most this share of the tolerance are not told apart by parts of a cell.
_ALIKE = 2.0**-9
#: Light that a sample may leave open before compositing has shown where it matters.
_COARSE = 0.1
#: A sample is worth halving if it can take away this share of what a part has too much.
_SHARE = 0.125
#: Rounds of halving where the colours' bounds are too wide.
_ROUNDS = 32
#: Numbers (rays, samples, parts) that are worked on together.
_NUMBERS = 1 << 21
#: Light from a sample whose colour's shift is not looked at.
_UNSEEN = 1e-5


#: Intervals of hue and saturation.
Shifts = tuple[Range, Range]


def basis_of(dimensions: int, field: FieldWeights) -> ChebyshevBasis:
    """The polynomials that are used for ``dimensions`` parameters of a ``field``."""
    degree, grid = _DEGREES.get(dimensions, (1, 2))
    if dimensions == 1 and len(field.base) <= _SHALLOW:
        degree, grid = _SHALLOW_DEGREE
    return ChebyshevBasis(dimensions, degree, grid)


def cells_at_once(field: FieldWeights, basis: ChebyshevBasis) -> int:
    """Cells of a batch where kernels are not compiled."""
    return max(1, _VALUES // (len(basis.evaluation) * field.width))


def device_bytes(field: FieldWeights, basis: ChebyshevBasis) -> int:
    """Memory that such a batch may take, about."""
    # error terms before and after a layer, and their product with slopes
    columns = 3 * ERROR_TERMS * cells_at_once(field, basis) * field.width
    return 8 * (_ARRAYS * _VALUES + columns) + (1 << 29)


@dataclass(frozen=True)
class Division:
    """Nested equal cells of a box, and the parts that results are kept for.

    A line has levels of 3, 6, 12, ... cells between those of 2, 4, 8, ...: cells are then nearer to the width that
    the network's bounds bear.

    Attributes:
        axes: Axis that is halved from each level to the next; of a line, to that with twice as many cells.
        dimensions: Of the box.
        finer: Halvings of the deepest level's cells into parts, by axis.
    """

    axes: tuple[int, ...]
    dimensions: int
    finer: int = 0

    @cached_property
    def _levels(self) -> list[tuple[int, ...]]:
        """Cells by axis of every level."""
        halved = len(self.axes)
        found = [tuple(1 << self.axes[:level].count(j) for j in range(self.dimensions)) for level in range(halved + 1)]
        if self.dimensions == 1:
            found += [(3 << k,) for k in range(halved - 1)]
        return sorted(found, key=math.prod)

    @property
    def levels(self) -> int:
        """The deepest level."""
        return len(self._levels) - 1

    def counts(self, level: int) -> tuple[int, ...]:
        """Cells by axis of a level."""
        return self._levels[level]

    @cached_property
    def below(self) -> tuple[int, ...]:
        """The level that halves the cells of each level, or -1."""
        level_of = {math.prod(counts): level for level, counts in enumerate(self._levels)}
        return tuple(level_of.get(2 * cells, -1) for cells in level_of)

    @cached_property
    def parts(self) -> tuple[int, ...]:
        """Parts by axis of the whole box."""
        # cells of halves and of thirds are made of the same parts
        finer = (3 if self.dimensions == 1 else 1) << self.finer
        return tuple(finer * n for n in self.counts(self.levels))

    def inner(self, level: int) -> tuple[int, ...]:
        """Parts by axis of one cell of a level."""
        return tuple(p // c for p, c in zip(self.parts, self.counts(level), strict=True))

    def boxes(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        """[cells, d] lower and upper ends in [-1, 1]."""
        counts = np.array(self.counts(level), np.int64)
        found = list(np.ndindex(*counts.tolist()))
        places = np.array(found, np.float64).reshape(len(found), self.dimensions)
        return 2.0 * places / counts - 1.0, 2.0 * (places + 1.0) / counts - 1.0

    def members(self, level: int) -> np.ndarray:
        """[cells, parts of a cell] flat numbers of the parts of every cell."""
        counts, inner = self.counts(level), self.inner(level)
        whole = np.arange(math.prod(self.parts)).reshape([n for pair in zip(counts, inner, strict=True) for n in pair])
        order = [*range(0, 2 * self.dimensions, 2), *range(1, 2 * self.dimensions, 2)]
        return whole.transpose(order).reshape(math.prod(counts), math.prod(inner))

    def children(self, level: int, cells: np.ndarray) -> np.ndarray:
        """[2 n] cells of the level `below` inside ``cells`` [n]."""
        counts, halves = self.counts(level), self.counts(self.below[level])
        axis = int(np.argmax(np.array(halves) > counts))
        places = np.array(np.unravel_index(cells, counts)).reshape(self.dimensions, -1)
        found = []
        for half in (0, 1):
            inside = places.copy()
            inside[axis] = 2 * inside[axis] + half
            found.append(np.ravel_multi_index(tuple(inside), halves))
        return np.concatenate(found)


@dataclass
class RayBounds:
    """What is known of n rays over a box.

    Attributes:
        lower, upper: [n, 3] float64 bounds of the colours.
        alpha: [n, samples] float32 upper bounds of the opacity of every sample over the box.
        cells: Cells of the network that were bounded.
        displacement: Half the way of a sample over a cell that the network's bounds bear, as far as these rays tell.
        parts: [2, n, shifts, *parts, 3] float32 lower and upper bounds, rounded outward, by part of the box, if a
            division was given; one row of ``shifts`` where none were.
    """

    lower: np.ndarray
    upper: np.ndarray
    alpha: np.ndarray
    cells: int
    displacement: float
    parts: np.ndarray | None = None


@dataclass
class _Items:
    """Cells of samples: ray, sample, cell, [k] each, all of one level."""

    ray: np.ndarray
    sample: np.ndarray
    cell: np.ndarray

    def __len__(self) -> int:
        return self.ray.size

    def take(self, which: np.ndarray | slice) -> _Items:
        return _Items(self.ray[which], self.sample[which], self.cell[which])


def join_items(parts: list[_Items]) -> _Items:
    """All items of ``parts``."""
    return _Items(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("ray", "sample", "cell")))


class Pencil:
    """The rays of some pixels over one box of poses, as polynomials of the pose (design.md, F10).

    Args:
        pose_set, box: The poses.
        pixels: [n, 2] rows and columns.
        degree: Of the Taylor models.
        swept: Whether samples lie anywhere in their bins; the last parameter is the place there.
    """

    def __init__(
        self, pose_set: PoseSet, box: ParameterBox, pixels: np.ndarray, degree: int, swept: bool = False
    ) -> None:
        rotation, position = pose_set.taylor(box, degree)
        in_camera = camera_rays(pose_set.camera, pixels)
        world = (rotation[None, :, :] * TaylorArray.constant(rotation.basis, in_camera)[:, None, :]).sum(2)
        # pixel rays and their rotation are rounded, and so is the concrete renderer's normalisation
        world = world.widened(16.0 * UNIT64 * np.abs(in_camera).sum(axis=1)[:, None])
        length = (world * world).sum(1)
        direction = world * length.rsqrt()[:, None]
        exponents = rotation.basis.exponents
        self.exponents = np.array(exponents, np.int64).reshape(len(exponents), box.dimensions)
        self.origin, self.origin_radius = position.coefficients, position.radius
        self.direction = np.ascontiguousarray(direction.coefficients.transpose(1, 0, 2))  # [n, M, 3]
        self.direction_radius = direction.radius + 16.0 * UNIT64
        self.swept = swept
        if swept:
            # the place within a bin is one more parameter: (o + t d) + (h d) tau
            place = np.repeat([0, 1], len(exponents))[:, None]
            self.exponents = np.concatenate([np.tile(self.exponents, (2, 1)), place], axis=1)
            self.origin = np.concatenate([self.origin, np.zeros_like(self.origin)])
            self.along = np.concatenate([np.zeros_like(self.direction), self.direction], axis=1)
            self.direction = np.concatenate([self.direction, np.zeros_like(self.direction)], axis=1)

    def points(self, ray: np.ndarray, distance: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Polynomials [k, M, 3] and radii [k, 3] of points at ``distance`` [k] on ``ray`` [k], ``half`` [k] swept."""
        lines = self.origin + distance[:, None, None] * self.direction[ray]
        far = distance
        if self.swept:
            lines = lines + half[:, None, None] * self.along[ray]
            far = distance + half
        radius = self.origin_radius + far[:, None] * self.direction_radius[ray]
        # rounding of the polynomial's evaluation, and of the concrete renderer's point and distance
        size = np.abs(self.origin).sum(axis=0) + far[:, None] * np.abs(self.direction[ray]).sum(axis=1)
        return lines, radius + 64.0 * UNIT64 * size

    def ranges(
        self, lines: np.ndarray, radius: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Bounds [k, 3] of the ``points`` (lines, radius) on boxes from ``low`` to ``high`` [k, d] in [-1, 1]."""
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        there = np.prod(middle[:, None, :] ** self.exponents, axis=-1)
        center = (there[..., None] * lines).sum(axis=1)
        size = np.abs(lines)
        # on [-1, 1]^d no derivative of a monomial exceeds its exponent
        slope = (half @ self.exponents.T)[..., None]
        spread = (slope * size).sum(axis=1) + radius + 64.0 * UNIT64 * size.sum(axis=1)
        return center - spread, center + spread

    def displacement(self, distances: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """[n, samples, d] half of what a sample moves by over each parameter's range, about."""
        found = np.zeros((self.direction.shape[0], distances.size, self.exponents.shape[1]))
        for j in range(self.exponents.shape[1]):
            moving = self.exponents[:, j] > 0
            steps = self.origin[moving] + distances[:, None, None] * self.direction[:, None, moving]
            found[..., j] = np.linalg.norm(np.abs(steps).sum(axis=2), axis=-1)
        if self.swept:
            found[..., -1] = 0.5 * lengths
        return found


class NerfBounds:
    """Bounds of a scene's rays.

    Args:
        scene: The scene.
        sampling: Uniform, or hierarchical: bounded wherever the fine field may be sampled (design.md, F10, F14).
        dimensions: Number of parameters.
        device: Where the network is bounded.
        compiled: Whether by kernels compiled for a processor; None: where ``device`` is one.
    """

    def __init__(
        self,
        scene: NerfScene,
        sampling: Sampling,
        dimensions: int,
        device: torch.device | str = "cpu",
        compiled: bool | None = None,
    ) -> None:
        self.sampling, self.device = sampling, torch.device(device)
        self.swept = sampling.kind == "hierarchical"
        self.basis = basis_of(dimensions + self.swept, scene.fine)
        self.field = FieldBounds(scene.fine, self.basis, device=device, compiled=compiled)
        #: Cells bounded at once.
        self.batch = _BATCH if self.field.compiled else cells_at_once(scene.fine, self.basis)
        edges = sampling.edges
        self.occupancy = scene.occupancy
        #: Of the coarse pass, by pose alone.
        self.coarse = None
        if self.swept:
            self.coarse = FieldBounds(
                scene.coarse, basis_of(dimensions, scene.coarse), device=device, compiled=compiled
            )
        self.distances = 0.5 * (edges[1:] + edges[:-1])
        self.lengths = edges[1:] - edges[:-1]
        self.taylor = min(_TAYLOR, max(1, self.basis.degree))
        self._bernstein: dict[tuple[int, ...], Tensor] = {}
        #: Where to begin to look for `RayBounds.displacement`.
        self.displacement = 0.02

    def rays(
        self,
        pose_set: PoseSet,
        box: ParameterBox,
        pixels: np.ndarray,
        tolerance: float,
        known: np.ndarray | None = None,
        aim: tuple[np.ndarray, np.ndarray] | None = None,
        shifts: list[Shifts] | None = None,
        division: Division | None = None,
    ) -> RayBounds:
        """Bounds of the colours of ``pixels`` [n, 2] over every pose of ``box``.

        Args:
            pose_set, box: The poses.
            pixels: Rows and columns.
            tolerance: What a sample's open opacity or colour may move a pixel by before its cells are halved.
            known: [n, samples] upper bounds of opacities over a larger box.
            aim: [n, 3] lower and upper colours; bounds between them are good enough (before the shifts).
            shifts: Intervals of hue and saturation that are added to all colours; bounds hold over all of them.
            division: The cells, in place of those that suit the rays; bounds are then kept by part.
        """
        n, samples, given_division = len(pixels), self.distances.size, division
        pencil = Pencil(pose_set, box, pixels, self.taylor, self.swept)
        moves = pencil.displacement(self.distances, self.lengths)
        if division is None:
            division = self.division(moves)
        if division is None or not (np.isfinite(pencil.direction).all() and np.isfinite(pencil.direction_radius).all()):
            nothing = np.zeros((n, 3)), np.ones((n, 3)), np.ones((n, samples), np.float32)
            if given_division is None:
                return RayBounds(*nothing, 0, self.displacement)
            parts = given_division.parts[: box.dimensions]
            low = np.zeros((n, max(1, len(shifts or [])), *parts, 3), np.float32)
            return RayBounds(*nothing, 0, self.displacement, np.stack([low, np.ones_like(low)]))
        if n > 1 and n * samples * math.prod(division.parts) > _NUMBERS:
            halves = []
            for which in (slice(0, n // 2), slice(n // 2, n)):
                part = None if aim is None else (aim[0][which], aim[1][which])
                given = None if known is None else known[which]
                halves.append(self.rays(pose_set, box, pixels[which], tolerance, given, part, shifts, given_division))
            lower, upper, alpha = (
                np.concatenate([getattr(half, name) for half in halves]) for name in ("lower", "upper", "alpha")
            )
            parts = [half.parts for half in halves if half.parts is not None]
            return RayBounds(
                lower, upper, alpha, halves[0].cells + halves[1].cells, typical_displacement(halves),
                np.concatenate(parts, axis=1) if parts else None,
            )  # fmt: skip
        edges = None
        if self.coarse is not None:
            edges = self._edges(self.coarse, Pencil(pose_set, box, pixels, self.taylor), division)
        work = _Work(self, pencil, division, moves, tolerance, known, aim, edges)
        return work.run(shifts or [], given_division is not None)

    def _edges(self, coarse: FieldBounds, pencil: Pencil, division: Division) -> tuple[np.ndarray, np.ndarray]:
        """Bounds [n parts, .] of the fine samples' edges by parts of the poses (design.md, F14)."""
        n, samples, parts = len(pencil.direction), self.distances.size, division.parts[:-1]
        low, high = np.zeros((n, samples, math.prod(parts))), np.ones((n, samples, math.prod(parts)))
        basis = coarse.basis
        monomials = torch.from_numpy(np.prod(basis.nodes[:, None, :] ** pencil.exponents, axis=-1)).to(self.device)
        bernstein = torch.from_numpy(basis.bernstein(parts)).to(self.device)
        rays, places = (a.ravel() for a in np.mgrid[:n, :samples])
        for first in range(0, rays.size, self.batch):
            checkpoint()
            ray, place = rays[first : first + self.batch], places[first : first + self.batch]
            lines, radius = pencil.points(ray, self.distances[place], 0.0 * self.distances[place])
            nodes = monomials @ torch.from_numpy(lines).to(self.device)
            encoded = coarse.encode(nodes, torch.from_numpy(radius).to(self.device), coarse.position)
            _, z = coarse.base(*encoded)
            ends = _parts(z, bernstein)
            length = torch.from_numpy(self.lengths[place]).to(self.device)[:, None]
            alpha = [opacity(ends[up][..., 0], length, up=bool(up)).cpu().numpy() for up in (0, 1)]
            good = ~z.failed.cpu().numpy()[:, None] & (alpha[0] <= alpha[1])
            # density is 0 where it is declared
            low[ray, place] = np.where(good & (self.occupancy is None), alpha[0], 0.0)
            high[ray, place] = np.where(good, alpha[1], 1.0)
        low, high = (np.moveaxis(a, 1, 2).reshape(-1, samples) for a in (low, high))
        return edge_bounds(low, high, self.sampling)

    def bernstein(self, parts: tuple[int, ...]) -> Tensor:
        """`ChebyshevBasis.bernstein` of the field's basis, kept."""
        if parts not in self._bernstein:
            self._bernstein[parts] = torch.from_numpy(self.basis.bernstein(parts)).to(self.device)
        return self._bernstein[parts]

    def division(self, moves: np.ndarray, most: int = _PARTS, deeper: int | None = None) -> Division | None:
        """Levels for samples that move by ``moves`` [n, samples, d]; the last ``deeper`` are for refinement.

        None where that would be more than ``most`` parts and narrower boxes would need fewer.
        """
        d = moves.shape[2]
        if d == 0:
            return Division((), 0)
        widest = moves.reshape(-1, d).max(axis=0)
        if not np.isfinite(widest).all():
            return None
        deeper = _DEEPER.get(d, _DEEPER_MORE) if deeper is None else deeper
        finer = _FINER.get(d, 0)
        levels = (most // 3 if d == 1 else most).bit_length() - 1 - deeper - d * finer
        axes: list[int] = []
        while widest.sum() > self.displacement:
            if len(axes) >= levels:
                # a sample's own interval is as wide in any box
                if widest[: d - self.swept].sum() > self.displacement:
                    return None
                break
            axis = int(np.argmax(widest))
            axes.append(axis)
            widest[axis] *= 0.5
        for _ in range(deeper):
            axis = int(np.argmax(widest))
            axes.append(axis)
            widest[axis] *= 0.5
        return Division(tuple(axes), d, finer)


def typical_displacement(parts: Sequence[RayBounds]) -> float:
    """The geometric mean of what ``parts`` tell; the order in which they were worked on plays no part."""
    return math.exp(sum(math.log(part.displacement) for part in parts) / len(parts))


class _Work:
    """The bounds of one pencil of rays; see `NerfBounds.rays`."""

    def __init__(
        self,
        owner: NerfBounds,
        pencil: Pencil,
        division: Division,
        moves: np.ndarray,
        tolerance: float,
        known: np.ndarray | None,
        aim: tuple[np.ndarray, np.ndarray] | None,
        edges: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self.edges = edges
        self.owner, self.pencil, self.division, self.tolerance, self.aim = owner, pencil, division, tolerance, aim
        self.basis, self.field = owner.basis, owner.field
        n, samples = moves.shape[:2]
        parts = math.prod(division.parts)
        self.alpha_low, self.alpha_high = np.zeros((samples, n, parts)), np.ones((samples, n, parts))
        self.color_low, self.color_high = np.zeros((samples, n, parts, 3)), np.ones((samples, n, parts, 3))
        # what the network itself leaves open of opacities and colours, and the level of the cells that showed it
        self.open, self.vague = (np.ones((samples, n, parts), np.float32) for _ in range(2))
        self.level = np.full((samples, n, parts), -1, np.int8)
        # light that reaches a sample, and what all samples so far let through
        self.before, self.light = np.ones((samples, n, parts), np.float32), np.ones((n, parts))
        self.cells, self.displacement = 0, owner.displacement
        # cells of samples that were the first, those of them that were too wide, and whether the box is not narrow
        self.tried, self.lost, self.wide = 0, 0, False
        inverse = [1.0 / np.array(division.counts(level), np.float64) for level in range(division.levels + 1)]
        # the first level whose cells are narrow enough for the sample
        displacement = [moves @ row for row in inverse]
        self.start = np.zeros((n, samples), np.int64)
        for level in range(division.levels):
            self.start[(self.start == level) & (displacement[level] > owner.displacement)] = level + 1
        self.quiet = np.zeros((n, samples), bool)
        if known is not None:
            self.quiet = known <= _QUIET * tolerance
            for i, k in np.argwhere(self.quiet):
                self.alpha_high[k, i] = known[i, k]
        self._levels: dict[int, tuple[Tensor, Tensor, np.ndarray]] = {}

    def run(self, shifts: list[Shifts], by_part: bool = False) -> RayBounds:
        """Bound block after block of samples, nearest first, then halve cells where colours are too wide.

        ``by_part``: keep the bounds of every part.
        """
        samples = self.owner.distances.size
        for first in range(0, samples, _BLOCK):
            block = np.arange(first, min(samples, first + _BLOCK))
            if not (self.light > self._dark).any():
                break
            self.before[block] = self.light
            self._bound_block(block)
            self.light *= np.prod(1.0 - self._anywhere(self.alpha_low[block], np.minimum), axis=0)
        self._learn()
        self._improve()
        color, found = (self.color_low, self.color_high), []
        for shift in shifts:
            checkpoint()
            self.color_low, self.color_high = self._shifted(color, shift)
            found.append(self._composite())
        low, high = (np.stack(ends, axis=1) for ends in zip(*(found or [self._composite()]), strict=True))
        alpha = self.alpha_high.max(axis=2).T.astype(np.float32)
        return RayBounds(
            low.min(axis=(1, 2)), high.max(axis=(1, 2)), np.nextafter(alpha, np.float32(2.0)), self.cells,
            self.displacement,
            np.stack(outward(self._poses(low, np.min), self._poses(high, np.max))) if by_part else None,
        )  # fmt: skip

    def _poses(self, values: np.ndarray, end: Callable[..., np.ndarray]) -> np.ndarray:
        """[n, shifts, *parts, 3] of [n, shifts, parts, 3]: by part of the poses alone."""
        apart = values.reshape(*values.shape[:2], *self.division.parts, 3)
        return end(apart, axis=-2) if self.owner.swept else apart

    @property
    def _dark(self) -> float:
        """Light that does not matter any more."""
        return 0.1 * self.tolerance

    @property
    def _negligible(self) -> float:
        """Light from a sample, at most, whose colour does not matter."""
        return (0.1 if self.owner.swept else 0.5) * self.tolerance

    def _level(self, level: int) -> tuple[Tensor, Tensor, np.ndarray]:
        """Monomials at the nodes of every cell [cells, nodes, M], Bernstein matrix [parts, b, m], members."""
        if level not in self._levels:
            low, high = self.division.boxes(level)
            nodes = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * self.basis.nodes
            monomials = np.prod(nodes[:, :, None, :] ** self.pencil.exponents, axis=-1)
            self._levels[level] = (
                torch.from_numpy(monomials).to(self.owner.device),
                self.owner.bernstein(self.division.inner(level)),
                self.division.members(level),
            )
        return self._levels[level]

    def _rows(self, level: int, items: _Items) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where the parts [k, parts of a cell] of ``items`` stand in the arrays by sample, ray and part."""
        return items.sample[:, None], items.ray[:, None], self._level(level)[2][items.cell]

    def _bound_block(self, block: np.ndarray) -> None:
        """Bound the samples ``block`` of all rays."""
        waiting: dict[int, list[_Items]] = {}
        for level in range(self.division.levels + 1):
            ray, place = np.nonzero((self.start[:, block] == level) & ~self.quiet[:, block])
            if not ray.size:
                continue
            members = self._level(level)[2]
            bright = self.light[:, members].max(axis=2) > self._dark  # [n, cells]
            item, cell = np.nonzero(bright[ray])
            if not item.size:
                continue
            waiting[level] = [_Items(ray[item], block[place[item]], cell)]
        self.wide |= any(level > 0 for level in waiting)
        for level in range(self.division.levels + 1):
            if level not in waiting:
                continue
            items = join_items(waiting.pop(level))
            again = []
            for start in range(0, len(items), self.owner.batch):
                batch = items.take(slice(start, start + self.owner.batch))
                halve, lost, seen = self._bound_batch(level, batch, _COARSE)
                again.append(batch.take(halve))
                first = self.start[batch.ray, batch.sample] == level
                self.lost += int((lost & first).sum())
                self.tried += int((seen & first).sum())
            coarse = join_items(again)
            below = self.division.below[level]
            if below < 0 or not len(coarse):
                continue
            children = self.division.children(level, coarse.cell)
            finer = _Items(np.tile(coarse.ray, 2), np.tile(coarse.sample, 2), children)
            waiting.setdefault(below, []).append(finer)

    def _learn(self) -> None:
        """Cells should have started narrower if many of them were too wide, wider if few were."""
        if self.tried < 32:
            return
        for share, narrower in _LOST_SHARES:
            if self.lost > share * self.tried:
                self.displacement *= narrower
                return
        # cells that the box itself makes narrow do not show what wider ones would bear
        if self.wide and self.lost < _FEW_LOST * self.tried:
            self.displacement *= _WIDER

    def _improve(self) -> None:
        """Halve cells that leave colours open beyond the aim, round after round, on the parts where they do."""
        rays = np.arange(self.light.shape[0])
        below = np.array([*self.division.below, -1])
        for _ in range(_ROUNDS):
            low, high, impact = self._impact(rays)
            # cells of level -1 were never bounded
            able = below[self.level[:, rays]] >= 0
            threshold = np.full(impact.shape[1:], self.tolerance)
            if self.aim is not None:
                excess = np.maximum(high - self.aim[1][rays, None], self.aim[0][rays, None] - low).max(axis=2)
                able &= excess > 0.0
                threshold = np.minimum(_SHARE * excess, np.where(able, impact, 0.0).max(axis=0))
                threshold = np.maximum(threshold, _SHARE * 0.5 * self.tolerance)
            sample, ray, part = np.nonzero(able & (impact >= threshold))
            if not sample.size:
                return
            ray = rays[ray]
            level = below[self.level[sample, ray, part]]
            for deeper in np.unique(level):
                which = level == deeper
                cell = self._cell_of(deeper)[part[which]]
                found = np.unique(np.stack([ray[which], sample[which], cell]), axis=1)
                for start in range(0, found.shape[1], self.owner.batch):
                    items = _Items(*found[:, start : start + self.owner.batch])
                    self._bound_batch(int(deeper), items, math.inf)
            rays = np.unique(ray)

    def _cell_of(self, level: int) -> np.ndarray:
        """[parts] the cell of ``level`` that every part lies in."""
        members = self._level(level)[2]
        return np.argsort(members, axis=None) // members.shape[1]

    def _impact(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bounds [r, parts, 3] of ``rays``, and [samples, r, parts] what each sample leaves open of them (about)."""
        alpha_low, alpha_high = self._anywhere(self.alpha_low[:, rays], np.minimum), self.alpha_high[:, rays]
        top = self._anywhere(alpha_high, np.maximum)
        light = np.ones_like(alpha_low)
        np.cumprod(1.0 - alpha_low[:-1], axis=0, out=light[1:])
        self.before[:, rays] = light
        color_low, color_high, rest = self._mixtures(rays, True)
        span = np.empty_like(alpha_low)
        low, high = self._background(len(rays)), self._background(len(rays))
        for k in range(len(span) - 1, -1, -1):
            rise, fall = color_high[k] - high, color_low[k] - low
            span[k] = np.maximum(color_high[k] - low, high - color_low[k]).max(axis=-1)
            high += np.where(rise > 0.0, top[k][..., None], alpha_low[k][..., None]) * rise
            low += np.where(fall < 0.0, top[k][..., None], alpha_low[k][..., None]) * fall
        return low - rest, high + rest, light * (self.open[:, rays] * span + alpha_high * self.vague[:, rays])

    def _anywhere(self, values: np.ndarray, end: np.ufunc, axis: int = -1) -> np.ndarray:
        """Where samples lie anywhere in their bins: the ``end`` of ``values`` by parts over the parts of the bin."""
        if not self.owner.swept:
            return values
        inner = self.division.parts[-1]
        axis %= values.ndim
        shape = (*values.shape[:axis], values.shape[axis] // inner, inner, *values.shape[axis + 1 :])
        return np.repeat(end.reduce(values.reshape(shape), axis=axis + 1), inner, axis=axis)

    def _mixtures(self, rays: np.ndarray | slice, apart: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
        """Bounds of the colours that samples or bins contribute, and what must be added to the result's (F10).

        ``apart``: what is negligible in a bin is added instead of mixed in.
        """
        low, high = self.color_low[:, rays], self.color_high[:, rays]
        if not self.owner.swept:
            return low, high, 0.0
        weight = self.before[:, rays] * self.alpha_high[:, rays]
        dim = (weight <= self._negligible) & apart
        alone = self._anywhere(dim, np.logical_and)[..., None]
        low = self._anywhere(np.where(dim[..., None], np.inf, low), np.minimum, -2)
        high = self._anywhere(np.where(dim[..., None], -np.inf, high), np.maximum, -2)
        rest = self._anywhere(np.where(dim & ~alone[..., 0], weight, 0.0), np.maximum).sum(axis=0)
        # the light before a sample is kept in float32
        return np.where(alone, 0.0, low), np.where(alone, 1.0, high), (rest * (1.0 + 2.0**-20))[..., None]

    def _background(self, count: int) -> np.ndarray:
        """[count, parts, 3] the colour behind the last sample."""
        return np.tile(np.array(self.owner.sampling.background, np.float64), (count, self.light.shape[1], 1))

    def _bound_batch(self, level: int, items: _Items, coarse: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bound some cells of one level.

        Returns [k] which leave more light open than ``coarse``, which leave all of it, and which needed the network.
        """
        checkpoint()
        halve, lost, tried = (np.zeros(len(items), bool) for _ in range(3))
        lines, radius = self.pencil.points(
            items.ray, self.owner.distances[items.sample], 0.5 * self.owner.lengths[items.sample]
        )
        which, sure = self._occupied(level, items, lines, radius)
        if which.size:
            items, lines, radius, sure = items.take(which), lines[which], radius[which], sure[which]
            halve[which], lost[which] = self._bound_field(level, items, lines, radius, sure, coarse)
            tried[which] = True
        return halve, lost, tried

    def _occupied(
        self, level: int, items: _Items, lines: np.ndarray, radius: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Which items may see occupied voxels, and [k] whether an item surely does; the others are made empty (F11)."""
        everything = np.arange(len(items))
        if self.owner.occupancy is None:
            return everything, np.ones(len(items), bool)
        low, high = self.division.boxes(level)
        ends = self.pencil.ranges(lines, radius, low[items.cell], high[items.cell])
        empty, sure = self.owner.occupancy.look(*ends)
        gone = items.take(empty)
        if len(gone):
            rows = self._rows(level, gone)
            self.alpha_low[rows] = self.alpha_high[rows] = 0.0
            self.open[rows] = self.vague[rows] = 0.0
            self.level[rows] = self.division.levels
        return everything[~empty], sure

    def _bound_field(
        self,
        level: int,
        items: _Items,
        lines: np.ndarray,
        radius: np.ndarray,
        sure: np.ndarray,
        coarse: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """`_bound_batch` by the network; where it is not ``sure`` [k], density may also be 0."""
        device, field = self.owner.device, self.field
        monomials, bernstein, _ = self._level(level)
        self.cells += len(items)
        there = monomials[torch.from_numpy(items.cell).to(device)]
        nodes = there @ torch.from_numpy(lines).to(device)
        encoded = field.encode(nodes, torch.from_numpy(radius).to(device), field.position)
        pieces, density = field.base(*encoded)
        halve, lost = np.zeros((2, len(items)), bool)
        seen = np.flatnonzero(~self._leave_alike(level, items, density))
        if not seen.size:
            return halve, lost
        items, sure, density = items.take(seen), sure[seen], density.without_columns(torch.from_numpy(seen).to(device))
        low, high, error = _parts(density, bernstein)
        length = torch.from_numpy(self.owner.lengths[items.sample]).to(device)[:, None]
        alpha_low, alpha_high = opacity(low[..., 0], length, up=False), opacity(high[..., 0], length, up=True)
        bad = density.failed[:, None]
        alpha_low, alpha_high = torch.where(bad, 0.0, alpha_low), torch.where(bad, 1.0, alpha_high)
        # what the network's own error leaves open, apart from the cell's width
        middle = 0.5 * (low[..., 0] + high[..., 0])
        open_ = opacity(middle + error[:, :1], length, up=True) - opacity(middle - error[:, :1], length, up=False)
        open_ = torch.where(bad, 1.0, open_).cpu().numpy()
        low_a, high_a = alpha_low.cpu().numpy(), alpha_high.cpu().numpy()
        if not sure.all():
            low_a = np.where(sure[:, None], low_a, 0.0)
            open_ = np.where(sure[:, None], open_, high_a)
        rows = self._rows(level, items)
        light = self.before[rows]
        self._keep(self.alpha_low, self.alpha_high, rows, low_a, high_a)
        self.open[rows] = np.minimum(self.open[rows], open_)
        self.level[rows] = level
        halved = (open_ * light).max(axis=1) > coarse
        halve[seen], lost[seen] = halved, halved & (open_.min(axis=1) > _LOST)
        shines = (high_a * light).max(axis=1) > self._negligible
        # what is halved gets its colours from the halves, if there are any
        final = ~halved | (self.division.below[level] < 0)
        coloured = np.flatnonzero(shines & final & ~density.failed.cpu().numpy())
        if coloured.size:
            which = torch.from_numpy(seen[coloured]).to(device)
            self._color(level, items.take(coloured), pieces.select(which), there[which])
        return halve, lost

    def _leave_alike(self, level: int, items: _Items, density: Affine) -> np.ndarray:
        """[k] whether next to nothing is seen of an item: that is all that is found out about it then."""
        length = torch.from_numpy(self.owner.lengths[items.sample]).to(density.poly.device)
        most = opacity(greatest(density)[:, 0], length, up=True)
        alike = ((most <= _ALIKE * self.tolerance) & ~density.failed).cpu().numpy()
        gone, high = items.take(alike), most.cpu().numpy()[alike, None]
        rows = self._rows(level, gone)
        self.alpha_high[rows] = np.minimum(self.alpha_high[rows], high)
        self.open[rows] = np.minimum(self.open[rows], high)
        self.level[rows] = level
        return alike

    def _color(self, level: int, items: _Items, pieces: Pieces, there: Tensor) -> None:
        """Bound the colours of ``pieces``, those of ``items``; ``there``: monomials at their nodes."""
        device, field = self.owner.device, self.field
        bernstein = self._level(level)[1]
        direction = there @ torch.from_numpy(self.pencil.direction[items.ray]).to(device)
        radius = self.pencil.direction_radius[items.ray] + 96.0 * UNIT64
        encoded = field.encode(direction, torch.from_numpy(radius).to(device), field.direction)
        color = field.color(pieces, *encoded)
        low, high, error = _parts(color, bernstein)
        bad = color.failed[:, None, None]
        low = torch.where(bad, 0.0, torch.sigmoid(low) * (1.0 - COMPOSITE_ROUNDING)).cpu().numpy()
        high = torch.where(bad, 1.0, (torch.sigmoid(high) * (1.0 + COMPOSITE_ROUNDING)).clamp(max=1.0)).cpu().numpy()
        where = self._rows(level, items)
        self._keep(self.color_low, self.color_high, where, low, high)
        slack = 2.0 * torch.tanh(0.25 * error.amax(dim=1))
        slack = torch.where(color.failed, 1.0, slack).cpu().numpy()
        self.vague[where] = np.minimum(self.vague[where], slack[:, None])

    @staticmethod
    def _keep(lower: np.ndarray, upper: np.ndarray, rows: tuple, low: np.ndarray, high: np.ndarray) -> None:
        """Intersect what is known with new bounds; what is not a number or crosses says nothing."""
        old_low, old_high = lower[rows], upper[rows]
        good = (low <= high) & np.isfinite(low) & np.isfinite(high)
        low = np.where(good, np.maximum(low, old_low), old_low)
        high = np.where(good, np.minimum(high, old_high), old_high)
        crossed = ~(low <= high)
        lower[rows] = np.where(crossed, old_low, low)
        upper[rows] = np.where(crossed, old_high, high)

    def _shifted(self, color: tuple[np.ndarray, np.ndarray], shift: Shifts) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of ``color`` (lower, upper) after ``shift``; [0, 1] where next to nothing is seen of it."""
        seen = self.before * self.alpha_high > _UNSEEN
        low, high = np.zeros_like(color[0]), np.ones_like(color[1])
        low[seen], high[seen] = shifted_bounds(color[0][seen], color[1][seen], *shift)
        return low, high

    def _composite(self) -> tuple[np.ndarray, np.ndarray]:
        """[n, parts, 3] bounds by part (design.md, F8)."""
        low, high = self._composited(False)
        if self.owner.swept:
            other_low, other_high = self._composited(True)
            low, high = np.maximum(low, other_low), np.minimum(high, other_high)
        if self.edges is not None:
            other_low, other_high = self._sampled(*self.edges)
            low, high = np.maximum(low, other_low), np.minimum(high, other_high)
        return low, high

    def _sampled(self, edges_low: np.ndarray, edges_high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[n, parts, 3] bounds by parts, from where the fine field is sampled (design.md, F14)."""
        owner, inner = self.owner, self.division.parts[-1]
        rows, samples, n = len(edges_low), self.alpha_low.shape[0], self.alpha_low.shape[1]

        def along(values: np.ndarray) -> np.ndarray:
            """[samples, n, parts, ...] as [n parts of the poses, parts of the ray, ...]."""
            apart = values.reshape(samples, n, rows // n, inner, *values.shape[3:])
            return np.ascontiguousarray(np.moveaxis(apart, 0, 2)).reshape(rows, samples * inner, *values.shape[3:])

        with np.errstate(divide="ignore"):
            density_low = -np.log1p(-self.alpha_low) / owner.lengths[:, None, None] * (1.0 - 2.0**-40)
            density_high = -np.log1p(-self.alpha_high) / owner.lengths[:, None, None] * (1.0 + 2.0**-40)
        weight = self.before * self.alpha_high
        dim = weight <= self._negligible
        # what is negligible takes the colour of what is not, at the price of its weight
        price = along(np.where(dim, weight, 0.0)).reshape(rows, samples, inner).max(axis=2).sum(axis=1)
        color_low = along(np.where(dim[..., None], np.inf, self.color_low))
        color_high = along(np.where(dim[..., None], -np.inf, self.color_high))
        low = np.tile(np.array(owner.sampling.background, np.float64), (rows, 1))
        high = low.copy()
        near, far = owner.sampling.near, owner.sampling.far
        composite(
            edges_low, edges_high, near, (far - near) / (samples * inner), along(density_low), along(density_high),
            color_low, color_high, low, high,
        )  # fmt: skip
        slack = 4.0 * COMPOSITE_ROUNDING * (2 * edges_low.shape[1] + 5) + (price * (1.0 + 2.0**-20))[:, None]
        ends = np.clip(low - slack, 0.0, 1.0), np.clip(high + slack, 0.0, 1.0)
        low, high = (np.repeat(end.reshape(n, rows // n, 3), inner, axis=1) for end in ends)
        return low, high

    def _composited(self, apart: bool) -> tuple[np.ndarray, np.ndarray]:
        """[n, parts, 3] bounds by parts; ``apart``: see `_mixtures`."""
        low, high = self._background(len(self.light)), self._background(len(self.light))
        color_low, color_high, rest = self._mixtures(slice(None), apart)
        for k in range(self.alpha_low.shape[0] - 1, -1, -1):
            least = self._anywhere(self.alpha_low[k], np.minimum)[..., None]
            most = self._anywhere(self.alpha_high[k], np.maximum)[..., None]
            rise, fall = color_high[k] - high, color_low[k] - low
            high += np.where(rise > 0.0, most, least) * rise
            low += np.where(fall < 0.0, most, least) * fall
        slack = 4.0 * COMPOSITE_ROUNDING * (self.alpha_low.shape[0] + self.owner.sampling.importance + 5)
        low, high = low - rest - slack, high + rest + slack
        return np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0)


def greatest(value: Affine) -> Tensor:
    """Upper bounds [B, n] of an affine batch on whole cells."""
    middle, spread = value.poly[:, 0], value.poly[:, 1:].abs().sum(dim=1)
    return middle + spread + (value.radius + CHEBYSHEV_ROUNDING * (middle.abs() + spread))


def _parts(value: Affine, bernstein: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Bounds [B, parts, n] of an affine batch on every part of its cell, and its radius [B, n]."""
    error = value.radius
    (batch, m, n), (parts, k, _) = value.poly.shape, bernstein.shape
    # pieces and outputs side by side
    controls = (bernstein.reshape(parts * k, m) @ value.poly.transpose(0, 1).reshape(m, batch * n)).view(parts, k, -1)
    least, most = (ends.view(parts, batch, n).transpose(0, 1) for ends in (controls.amin(dim=1), controls.amax(dim=1)))
    # on parts that are nearly the whole cell, Bernstein coefficients of high degrees are far from the values
    spread = value.poly[:, 1:].abs().sum(dim=1)[:, None]
    middle = value.poly[:, :1]
    low = torch.maximum(least, middle - spread)
    high = torch.minimum(most, middle + spread)
    slack = (error + CHEBYSHEV_ROUNDING * (value.poly.abs().sum(dim=1) * bernstein.abs().amax()))[:, None]
    return low - slack, high + slack, error


def opacity(z: Tensor, length: Tensor, *, up: bool) -> Tensor:
    """A bound of ``1 - exp(-length softplus(z))``, from above or below (design.md, F7).

    torch returns z itself for the softplus of z > 20, which is less than the function by 2.1e-9.
    """
    if up:
        density = (torch.clamp(z, min=0.0) + torch.log1p(torch.exp(-z.abs()))) * (1.0 + 2.0**-46)
        return (-torch.expm1(-length * density) * (1.0 + 2.0**-46) + 2.0**-1000).clamp(max=1.0)
    density = torch.where(z > 19.0, z, torch.clamp(z, min=0.0) + torch.log1p(torch.exp(-z.abs()))) * (1.0 - 2.0**-46)
    return (-torch.expm1(-length * density) * (1.0 - 2.0**-46)).clamp(min=0.0)
