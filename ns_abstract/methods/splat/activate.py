"""Activated Gaussians of a scene in float64, independent of the pose."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ns_abstract.methods.splat.constants import Rasteriser
from ns_abstract.methods.splat.scene import Float64Array, SplatScene

#: Band-0 constant of the real spherical harmonics (spherical_harmonics.cuh).
SH_C0 = 0.2820947917738781


@dataclass(frozen=True)
class Splats:
    """Activated Gaussians.

    Attributes:
        means: [N, 3], world.
        axes: [N, 3, 3] ``B = R(q) diag(s)``: columns are the principal axes scaled by their standard deviations, so the
            covariance is ``B B^T``.
        opacity: [N] in [0, 1].
        sh: [N, K, 3] coefficients, or [N, 1, 3] final colours when ``degree`` is 0.
        degree: Highest SH band that is not zero for some Gaussian and that the rasteriser uses.
        background: [3].
        antialiased: Whether opacity is compensated for the blur.
        color_shift: [N, 3], or [0, 3], added to the activated colours, which are then clamped to [0, ``color_max``].
        color_max: Largest colour the activation can give: 1 for a sigmoid, else infinite.
    """

    means: Float64Array
    axes: Float64Array
    opacity: Float64Array
    sh: Float64Array
    degree: int
    background: Float64Array
    antialiased: bool
    color_shift: Float64Array = field(default_factory=lambda: np.empty((0, 3)))
    color_max: float = np.inf

    @property
    def count(self) -> int:
        """Number of Gaussians N."""
        return self.means.shape[0]


def rotation_matrices(quats: Float64Array) -> Float64Array:
    """Return the [N, 3, 3] rotations of quaternions [N, 4] (w, x, y, z), normalised here (utils.cuh:14-35)."""
    w, x, y, z = (quats / np.sqrt(np.sum(quats * quats, axis=1, keepdims=True))).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def used_degree(scene: SplatScene, rasteriser: Rasteriser) -> int:
    """Return the highest SH band with a nonzero coefficient, at most the evaluated one."""
    if scene.color_model == "sigmoid" or not rasteriser.view_dependent:
        return 0
    for degree in range(scene.sh_degree, 0, -1):
        if np.any(scene.sh[:, degree**2 : (degree + 1) ** 2]):
            return degree
    return 0


def activate(scene: SplatScene, rasteriser: Rasteriser, every_band: bool = False) -> Splats:
    """Return the activated Gaussians by Splatfacto's formulas (splatfacto.py:590-606), in float64.

    Args:
        every_band: Whether to keep harmonics that are zero for every Gaussian.
    """
    axes = rotation_matrices(scene.quats.astype(np.float64)) * np.exp(scene.log_scales.astype(np.float64))[:, None]
    logits = scene.opacity_logits.astype(np.float64)
    opacity = np.where(logits >= 0, 1.0, np.exp(np.minimum(logits, 0))) / (1.0 + np.exp(-np.abs(logits)))
    degree = used_degree(scene, rasteriser)
    if every_band and scene.color_model != "sigmoid" and rasteriser.view_dependent:
        degree = scene.sh_degree
    sh = scene.sh.astype(np.float64)
    if scene.color_model == "sigmoid":
        colors = 1.0 / (1.0 + np.exp(-sh[:, :1]))
    elif degree == 0:
        colors = np.maximum(SH_C0 * sh[:, :1] + 0.5, 0.0)
    else:
        colors = sh[:, : (degree + 1) ** 2]
    background = scene.background.astype(np.float64) if rasteriser.background else np.zeros(3)
    return Splats(
        means=np.ascontiguousarray(scene.means, dtype=np.float64),
        axes=np.ascontiguousarray(axes),
        opacity=np.ascontiguousarray(opacity),
        sh=np.ascontiguousarray(colors),
        degree=degree,
        background=background,
        antialiased=scene.rasterize_mode == "antialiased",
        color_max=1.0 if scene.color_model == "sigmoid" else np.inf,
    )
