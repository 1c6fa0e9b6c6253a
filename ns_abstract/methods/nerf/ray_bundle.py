"""Rays of pixels over a box of poses (design.md, F1, F10)."""

from __future__ import annotations

import numpy as np

from ns_abstract.arithmetic.rounding import FOLLOWED_ROUNDING, POINT_ROUNDING, RAY_ROUNDING
from ns_abstract.arithmetic.taylor import TaylorArray
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.nerf.render import camera_rays

#: Most that the degree of the Taylor models of poses may be.
TAYLOR = 6


class RayBundle:
    """The rays of some pixels over one box of poses, as polynomials of the pose (docs/dev/design.md, F10).

    Args:
        swept: Whether samples lie anywhere in their bins; the last parameter is then the position in the bin.
    """

    def __init__(
        self, pose_set: PoseBox, box: ParameterBox, pixels: np.ndarray, degree: int, swept: bool = False
    ) -> None:
        rotation, position = pose_set.taylor(box, degree)
        in_camera = camera_rays(pose_set.camera, pixels)
        world = (rotation[None, :, :] * TaylorArray.constant(rotation.basis, in_camera)[:, None, :]).sum(2)
        # pixel rays and their rotation are rounded, and so is the concrete renderer's normalisation
        world = world.widened(RAY_ROUNDING * np.abs(in_camera).sum(axis=1)[:, None])
        length = (world * world).sum(1)
        direction = world * length.rsqrt()[:, None]
        exponents = rotation.basis.exponents
        self.exponents = np.array(exponents, np.int64).reshape(len(exponents), box.dimensions)
        self.origin, self.origin_radius = position.coefficients, position.radius
        self.direction = np.ascontiguousarray(direction.coefficients.transpose(1, 0, 2))  # [n, M, 3]
        self.direction_radius = direction.radius + RAY_ROUNDING
        self.swept = swept
        if swept:
            # the place within a bin is one more parameter: (o + t d) + (h d) tau
            place = np.repeat([0, 1], len(exponents))[:, None]
            self.exponents = np.concatenate([np.tile(self.exponents, (2, 1)), place], axis=1)
            self.origin = np.concatenate([self.origin, np.zeros_like(self.origin)])
            self.along = np.concatenate([np.zeros_like(self.direction), self.direction], axis=1)
            self.direction = np.concatenate([self.direction, np.zeros_like(self.direction)], axis=1)

    @property
    def finite(self) -> bool:
        """Whether the directions have finite bounds."""
        return bool(np.isfinite(self.direction).all() and np.isfinite(self.direction_radius).all())

    @property
    def rounded(self) -> tuple[np.ndarray, np.ndarray]:
        """Return radii [3] of the origin and [n, 3] of directions, with points' rounding, here and in a render."""
        return (
            self.origin_radius + FOLLOWED_ROUNDING * np.abs(self.origin).sum(axis=0),
            self.direction_radius + FOLLOWED_ROUNDING * np.abs(self.direction).sum(axis=1),
        )

    def points(self, ray: np.ndarray, distance: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return polynomials [k, M, 3] and radii [k, 3] of points at ``distance`` [k] on ``ray`` [k].

        ``half`` [k]: half of the swept length.
        """
        lines = self.origin + distance[:, None, None] * self.direction[ray]
        far = distance
        if self.swept:
            lines = lines + half[:, None, None] * self.along[ray]
            far = distance + half
        radius = self.origin_radius + far[:, None] * self.direction_radius[ray]
        # rounding of the polynomial's evaluation, and of the concrete renderer's point and distance
        size = np.abs(self.origin).sum(axis=0) + far[:, None] * np.abs(self.direction[ray]).sum(axis=1)
        return lines, radius + POINT_ROUNDING * size

    def ranges(
        self, lines: np.ndarray, radius: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds [k, 3] of ``points`` (lines, radius) on boxes from ``low`` to ``high`` [k, d] in [-1, 1]."""
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        there = np.prod(middle[:, None, :] ** self.exponents, axis=-1)
        center = (there[..., None] * lines).sum(axis=1)
        size = np.abs(lines)
        # on [-1, 1]^d no derivative of a monomial exceeds its exponent
        slope = (half @ self.exponents.T)[..., None]
        spread = (slope * size).sum(axis=1) + radius + POINT_ROUNDING * size.sum(axis=1)
        return center - spread, center + spread

    def displacement(self, distances: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Return the approximate half [n, samples, d] of a sample's motion over each parameter's range."""
        displacement = np.zeros((self.direction.shape[0], distances.size, self.exponents.shape[1]))
        for j in range(self.exponents.shape[1]):
            moving = self.exponents[:, j] > 0
            steps = self.origin[moving] + distances[:, None, None] * self.direction[:, None, moving]
            displacement[..., j] = np.linalg.norm(np.abs(steps).sum(axis=2), axis=-1)
        if self.swept:
            displacement[..., -1] = 0.5 * lengths
        return displacement
