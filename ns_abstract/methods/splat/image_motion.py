"""Estimates of the image motion of a splat scene over a pose set, which decide how cells are cut."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.motion_cells import square_numbers
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.perturbation.specification import ROTATIONS


@dataclass(frozen=True)
class MotionTuning:
    """Preferences of the estimates; soundness does not depend on them."""

    #: Gaussians and poses looked at.
    gaussians: int = 2000
    poses: int = 9
    #: Step of the difference quotient, as a part of the parameter's range.
    step: float = 2.0**-10
    #: What is typical: as many move by less.
    most: float = 0.75
    #: A compensation by less than this part of a rotation's range is left out.
    shear_matters: float = 2.0**-7
    #: Pixels across a neighbourhood whose depth a pixel takes where nothing else is known of it.
    neighbourhood: int = 8
    #: Most squares: a picture of more pixels is looked at by neighbourhoods.
    most_squares: int = 2**16


_TUNING = MotionTuning()


class ImageMotion:
    """The image motion of a pose set, by typical Gaussians and by the surface that its pixels show.

    Args:
        pose_set: The poses; boxes are of its parameters.
        means: [N, 3] of the Gaussians, world.
        renderer: Of the scene.
    """

    def __init__(self, pose_set: PoseBox, means: np.ndarray, renderer: Renderer) -> None:
        self.pose_set, self._camera, self._renderer = pose_set, pose_set.camera, renderer
        self._all_means = means

    @cached_property
    def _means(self) -> np.ndarray:
        """Means [n, 3] of typical Gaussians."""
        means = self._all_means
        if means.shape[0] > _TUNING.gaussians:
            means = means[np.random.default_rng(0).choice(means.shape[0], _TUNING.gaussians, replace=False)]
        return means

    def shear(self) -> dict[str, dict[str, float]]:
        """Return for each rotation the amount that compensates the motion by one unit of another parameter."""
        box, middle = self.pose_set.box, self.pose_set.box.middle
        names = [name for name in ROTATIONS if name in box.names]
        others = [name for name in box.names if name not in ROTATIONS]
        means, width = self._means, np.array(box.upper) - np.array(box.lower)
        here, visible = self._seen(middle, means)
        if not names or not others or not visible.any():
            return {}

        def moved(name: str) -> np.ndarray:
            step = np.zeros(box.dimensions)
            step[box.names.index(name)] = _TUNING.step * width[box.names.index(name)]
            return ((self._project(middle + step, means)[0] - here)[visible] / step.sum()).ravel()

        turns, shifts = (np.stack([moved(name) for name in group], axis=1) for group in (names, others))
        factors = -np.linalg.lstsq(turns, shifts, rcond=None)[0]
        shears: dict[str, dict[str, float]] = {}
        # few bits: the last ones depend on the library's threads, results must not
        mantissa, exponent = np.frexp(factors)
        factors = np.ldexp(np.round(mantissa * 256.0), exponent - 8)
        for name, row in zip(names, factors.tolist(), strict=True):
            least = _TUNING.shear_matters * width[box.names.index(name)]
            useful = {
                other: factor
                for other, factor in zip(others, row, strict=True)
                if math.isfinite(factor) and abs(factor) * width[box.names.index(other)] > least
            }
            if useful:
                shears[name] = useful
        return shears

    def typical(self, box: ParameterBox) -> np.ndarray:
        """Return the estimated motion [d] in pixels of typical Gaussians over each parameter's range."""
        d, means = box.dimensions, self._means
        low, high = np.array(box.lower), np.array(box.upper)
        total = np.zeros(d)
        for values in (box.middle, *box.sample(_TUNING.poses - 1, np.random.default_rng(0))):
            here, visible = self._seen(values, means)
            if not visible.any():
                continue
            for k in range(d):
                step = np.zeros(d)
                step[k] = (high[k] - low[k]) * _TUNING.step
                there, _ = self._project(values + step, means)
                moved = np.linalg.norm(there[visible] - here[visible], axis=1) / _TUNING.step
                total[k] = max(total[k], float(np.quantile(moved, _TUNING.most)))
        return total

    def depths(self) -> np.ndarray:
        """Return depths [n] of typical Gaussians in the picture of the middle pose."""
        means = self._means
        _, visible = self._seen(self.pose_set.box.middle, means)
        return self._project(self.pose_set.box.middle, means)[1][visible]

    def parallax(self, box: ParameterBox) -> np.ndarray:
        """Return the estimated motion [d] of typical Gaussians relative to the pixels around them, over each range."""
        means, moved = self._means, self.of_squares(box)
        here, visible = self._seen(box.middle, means)
        columns, rows = here[visible].astype(np.int64).T
        squares = square_numbers(columns, rows, self._camera.width, self.side)
        rest, half = np.zeros(box.dimensions), 0.5 * (np.array(box.upper) - np.array(box.lower))
        if not visible.any():
            return rest
        for k, width in enumerate(half):
            step = width * np.eye(box.dimensions)[k]
            first, last = (self._project(box.middle + sign * step, means)[0][visible] for sign in (-1.0, 1.0))
            rest[k] = np.quantile(np.linalg.norm(last - first - 2.0 * moved[squares, :, k], axis=1), _TUNING.most)
        return rest

    @property
    def side(self) -> int:
        """Side in pixels of the squares of `of_squares`."""
        return 1 if self._camera.width * self._camera.height <= _TUNING.most_squares else _TUNING.neighbourhood

    def of_squares(self, box: ParameterBox) -> np.ndarray:
        """Return the estimated motion [squares, 2, d] in pixels of each square's content over half of a cell (B16).

        Squares of `side` pixels are in row order; the estimate is made at the cell's middle.
        """
        camera, side = self._camera, self.side
        here, z = self._project(box.middle, self._surface)
        inside = (z > 0.0) & (here >= 0.0).all(axis=1) & (here < [camera.width, camera.height]).all(axis=1)
        columns, rows = here[inside].astype(np.int64).T
        z = z[inside]
        y, x = np.mgrid[: camera.height : side, : camera.width : side].reshape(2, -1)
        depths = np.full(x.size, np.median(z) if z.size else 1.0)
        # of a neighbourhood where a square has no point
        for wide in (_TUNING.neighbourhood, side):
            there = square_numbers(columns, rows, camera.width, wide)
            own = square_numbers(x, y, camera.width, wide)
            counts = np.bincount(there, minlength=own.max() + 1)
            means = np.bincount(there, z, minlength=counts.size) / np.maximum(counts, 1)
            depths = np.where(counts[own] > 0, means[own], depths)
        pose = self.pose_set.world_to_camera(box.middle, beyond=True)
        points = self._points(*pose, x + 0.5 * side, y + 0.5 * side, depths)
        moved, half = np.zeros((x.size, 2, box.dimensions)), 0.5 * (np.array(box.upper) - np.array(box.lower))
        for k, reach in enumerate(half):
            step = reach * np.eye(box.dimensions)[k]
            first, last = (self._project(box.middle + sign * step, points)[0] for sign in (-1.0, 1.0))
            moved[:, :, k] = 0.5 * (last - first)
        return moved

    @cached_property
    def _surface(self) -> np.ndarray:
        """Points [n, 3] that the pixels show from the set's middle, at their expected depths."""
        rotation, position = self.pose_set.world_to_camera(self.pose_set.box.middle)
        tiles = self._renderer.layer_tiles(self._camera, rotation, position)
        layers = assemble(tiles, self._camera)
        rows, columns = np.nonzero((layers[..., 3] > 0.0) & np.isfinite(layers[..., 4]))
        return self._points(rotation, position, columns + 0.5, rows + 0.5, layers[rows, columns, 4])

    def _points(
        self, rotation: np.ndarray, position: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray
    ) -> np.ndarray:
        """Return the world points [n, 3] at pixel coordinates [n], [n] and depths [n] of a pose."""
        rays = np.stack(
            [(x - self._camera.cx) / self._camera.fx, (y - self._camera.cy) / self._camera.fy, 0.0 * x + 1.0]
        )
        return position + (rotation.T @ (rays * z)).T

    def _seen(self, values: np.ndarray, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixel coordinates [n, 2] of ``means``, and which of them [n] lie in the picture."""
        here, z = self._project(values, means)
        size = self._camera.width, self._camera.height
        return here, (z > 0.01) & (here > 0).all(axis=1) & (here < size).all(axis=1)

    def _project(self, values: np.ndarray, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixel coordinates [n, 2] of world points ``means`` [n, 3], and their depths."""
        # as the parameters go on: taken back into the set, a shift would come without the turn that undoes it
        rotation, position = self.pose_set.world_to_camera(values, beyond=True)
        x, y, z = rotation @ (means - position).T
        with np.errstate(all="ignore"):
            pixels = np.stack(
                [self._camera.fx * x / z + self._camera.cx, self._camera.fy * y / z + self._camera.cy], axis=1
            )
        return np.where(np.isfinite(pixels), pixels, 0.0), z
