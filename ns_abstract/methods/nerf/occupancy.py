"""A declared occupancy grid, which states where a scene's density is 0 (docs/dev/design.md, F11).

The scene with the grid is another one than the scene without: in empty voxels and outside the grid, density is 0
whatever the networks compute. Renderer, attacks and bounds all use the same definition.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.rounding import VOXEL_ROUNDING
from ns_abstract.io.arrays import open_archive
from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError
from ns_abstract.io.memory import check_memory

#: Most voxels of a grid.
_MOST = 1 << 27
#: Memory for a voxel: as read, packed, and numbers of occupied voxels while they are summed.
VOXEL_BYTES = 12
#: Points that are looked at together.
_POINTS = 1 << 17


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Voxels of a box; point x lies in voxel floor((x - lower) * scale) by axis.

    Attributes:
        lower: [3] float64 corner of the box, normalised units.
        scale: [3] float64 voxels per unit.
        occupied: [X, Y, Z] bool.
    """

    lower: np.ndarray
    scale: np.ndarray
    occupied: np.ndarray

    @staticmethod
    def of_box(lower: np.ndarray, upper: np.ndarray, occupied: np.ndarray) -> OccupancyGrid:
        """Return the grid whose voxels fill the box from ``lower`` to ``upper`` [3] float64."""
        return OccupancyGrid(lower, np.array(occupied.shape) / (upper - lower), occupied)

    def at(self, points: Tensor) -> Tensor:
        """Return [...] whether ``points`` [..., 3] lie in occupied voxels; False outside and where not finite."""
        size = torch.tensor(self.occupied.shape, dtype=torch.float64, device=points.device)
        lower, scale = (torch.from_numpy(v).to(points.device) for v in (self.lower, self.scale))
        place = torch.floor((points.detach().double() - lower) * scale)
        inside = ((place >= 0.0) & (place < size)).all(dim=-1)
        index = torch.where(inside[..., None], place, 0.0).long()
        return inside & self._voxels.to(points.device)[index.unbind(dim=-1)]

    @cached_property
    def _voxels(self) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(self.occupied))

    @cached_property
    def _sums(self) -> np.ndarray:
        """[X + 1, Y + 1, Z + 1] numbers of occupied voxels below each corner."""
        sums = np.zeros(np.array(self.occupied.shape) + 1, np.int32)
        np.cumsum(self.occupied, axis=0, dtype=np.int32, out=sums[1:, 1:, 1:])
        for axis in (1, 2):
            np.cumsum(sums, axis=axis, out=sums)
        return sums

    def look(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return [k] whether boxes [k, 3] of points surely lie in empty voxels, and whether surely in occupied ones.

        It encloses the float64 rounding of `at`. Boxes that are not finite are neither, unless the grid is empty.
        """
        size = np.array(self.occupied.shape)
        with np.errstate(invalid="ignore", over="ignore"):
            low, high = (lower - self.lower) * self.scale, (upper - self.lower) * self.scale
            # the difference and the product, here and in `at`; the operands' own sizes count where they cancel
            room = VOXEL_ROUNDING * (np.maximum(np.abs(lower), np.abs(upper)) + np.abs(self.lower)) * self.scale
            first, last = np.floor(low - room), np.floor(high + room)
        first, last = np.where(np.isnan(first), -np.inf, first), np.where(np.isnan(last), np.inf, last)
        within = ((first >= 0) & (last < size)).all(axis=-1)
        start = np.clip(first, 0, size).astype(np.int64)
        stop = np.clip(last + 1, 0, size).astype(np.int64)
        stop = np.maximum(start, stop)
        x0, y0, z0 = start.T
        x1, y1, z1 = stop.T
        s = self._sums
        count = (
            s[x1, y1, z1] - s[x0, y1, z1] - s[x1, y0, z1] - s[x1, y1, z0]
            + s[x0, y0, z1] + s[x0, y1, z0] + s[x1, y0, z0] - s[x0, y0, z0]
        )  # fmt: skip
        return count == 0, within & (count == (stop - start).prod(axis=-1))

    @property
    def digest(self) -> bytes:
        """Return bytes that differ for different grids."""
        parts = (np.array(self.occupied.shape), self.lower, self.scale, np.packbits(self.occupied))
        return hashlib.sha256(b"".join(part.tobytes() for part in parts)).digest()

    def describe(self) -> str:
        """Return the grid as text."""
        share = 100.0 * float(self.occupied.mean())
        return f"{'x'.join(str(n) for n in self.occupied.shape)} voxels, {share:.2g} % occupied"

    def write(self, path: Path) -> None:
        """Write ``occupied`` [X, Y, Z] bool and ``aabb`` [2, 3] float64 as npz."""
        upper = self.lower + np.array(self.occupied.shape) / self.scale
        aabb = np.stack([self.lower, upper])
        write_atomic(path, lambda stream: np.savez_compressed(stream, occupied=self.occupied, aabb=aabb))


def load_grid(path: Path) -> OccupancyGrid:
    """Return a grid from an npz with ``occupied`` [X, Y, Z] bool and ``aabb`` [2, 3] (normalised units)."""
    with open_archive(path, "occupancy grid", "give an .npz with occupied and aabb") as file:
        for name in ("occupied", "aabb"):
            if name not in file.declared:
                raise InputError("missing", field=name, fix="give occupied and aabb")
        shape, kind = file.declared["occupied"]
        if len(shape) != 3 or kind != np.bool_ or not 0 < math.prod(shape) <= _MOST:
            fix = f"give [X, Y, Z] bool of at most {_MOST} voxels"
            raise InputError(f"found {kind} {shape}", field="occupied", fix=fix)
        check_memory(VOXEL_BYTES * math.prod(shape), path, "the grid")
        shape, kind = file.declared["aabb"]
        if shape != (2, 3) or kind.kind not in "fiu":
            raise InputError(f"found {kind} {shape}", field="aabb", fix="give [2, 3] numbers")
        occupied, aabb = file.read("occupied"), file.read("aabb")
    aabb = aabb.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        grid = OccupancyGrid.of_box(aabb[0], aabb[1], occupied)
    if not (np.isfinite(aabb).all() and (aabb[0] < aabb[1]).all() and np.isfinite(grid.scale).all()):
        raise InputError("found an empty or infinite box", file=path, field="aabb", fix="give lower, then upper ends")
    return grid


def sample_grid(
    density: Callable[[Tensor], Tensor],
    lower: Sequence[float],
    upper: Sequence[float],
    resolution: int,
    least_density: float,
    progress: Callable[[float], None] = lambda share: None,
) -> OccupancyGrid:
    """Return a grid of the voxels near which ``density`` (points [n, 3] float64 to [n]) exceeds ``least_density``.

    Eight points of every voxel are sampled, and occupied voxels grow by one to every side: a proposal, not a proof.
    """
    low, high = np.array(lower, np.float64), np.array(upper, np.float64)
    size = (high - low) / resolution
    occupied = np.zeros((resolution,) * 3, bool)
    corners = np.stack(np.meshgrid(*[[0.25, 0.75]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    flat = occupied.reshape(-1)
    for start in range(0, flat.size, _POINTS // 8):
        numbers = np.arange(start, min(flat.size, start + _POINTS // 8))
        places = np.stack(np.unravel_index(numbers, occupied.shape), axis=-1)
        points = low + (places[:, None] + corners) * size
        with torch.inference_mode():
            values = density(torch.from_numpy(points.reshape(-1, 3)))
        flat[numbers] = (values.reshape(-1, 8) > least_density).any(dim=1).cpu().numpy()
        progress((numbers[-1] + 1) / flat.size)
    for axis in range(3):
        grown = occupied.copy()
        head, tail = [slice(None)] * 3, [slice(None)] * 3
        head[axis], tail[axis] = slice(1, None), slice(None, -1)
        grown[tuple(head)] |= occupied[tuple(tail)]
        grown[tuple(tail)] |= occupied[tuple(head)]
        occupied = grown
    return OccupancyGrid.of_box(low, high, occupied)
