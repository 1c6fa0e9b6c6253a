"""Algorithm 1 of "Abstract Rendering" as printed, and its bound by the paper's own rules, for comparison.

Every Gaussian reaches every pixel, nothing is culled, and the cost of the depth order grows with the square of the
number of Gaussians. `SplatBounds` with the rasteriser `PAPER` bounds the same picture for whole scenes.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ns_abstract.arithmetic.forms import Float64Array
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseForms
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.constants import PAPER
from ns_abstract.paper import (
    Enclosure,
    Interval,
    adjugate_inverse,
    matrix_inverse,
    sorted_blend,
    sumcumprod,
    surely_in_front,
    vr_ind,
)

Inverse = Literal["matrixinv", "adjugate"]
Blend = Literal["vr-ind", "sort", "sumcumprod"]


def _require_plain(splats: Splats) -> None:
    if splats.degree != 0 or splats.antialiased or np.any(splats.background):
        raise ValueError("Algorithm 1 knows RGB colours on black only: activate the scene with the rasteriser PAPER")


def pixel_centers(camera: PinholeCamera) -> Float64Array:
    """Return [H * W, 2] pixel centres (x, y), row-major."""
    x, y = (np.arange(size, dtype=np.float64) + 0.5 for size in (camera.width, camera.height))
    x, y = np.meshgrid(x, y)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def render(
    splats: Splats,
    camera: PinholeCamera,
    rotation: Float64Array,
    position: Float64Array,
    pixels: Float64Array | None = None,
) -> Float64Array:
    """Return the picture by GAUSSIANSPLAT (Algorithm 1) in float64, line by line.

    Args:
        splats: The scene, activated with the rasteriser `PAPER`.
        camera: Intrinsics; its own pose is not used.
        rotation: [3, 3] world to camera, OpenCV axes.
        position: [3] camera position, world.
        pixels: [P, 2] points (x, y) of the image plane; all pixel centres if None.

    Returns:
        [P, 3] colours. Gaussians nearer than the near plane are left out.

    Raises:
        ValueError: The scene was activated for another rasteriser.
    """
    _require_plain(splats)
    u = pixel_centers(camera) if pixels is None else np.asarray(pixels, np.float64)
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    mean_c = (splats.means - position) @ rotation.T
    in_range = (mean_c[:, 2] >= PAPER.near) & (mean_c[:, 2] <= PAPER.far)
    alphas, depths = [], []
    for axes, mean, opacity in zip(splats.axes[in_range], mean_c[in_range], splats.opacity[in_range], strict=True):
        covariance_c = rotation @ axes @ axes.T @ rotation.T
        x, y, z = mean
        jacobian = np.array([[focal[0] / z, 0.0, -focal[0] * x / z**2], [0.0, focal[1] / z, -focal[1] * y / z**2]])
        conic = np.linalg.inv(jacobian @ covariance_c @ jacobian.T)
        offset = u - (focal * mean[:2] / z + center)
        q = np.einsum("pi,ij,pj->p", offset, conic, offset)
        alphas.append(opacity * np.exp(-0.5 * q))
        depths.append(z)
    color = np.zeros((u.shape[0], 3))
    light = np.ones(u.shape[0])
    for i in np.argsort(np.array(depths), kind="stable"):
        color += (light * alphas[i])[:, None] * splats.sh[in_range][i, 0]
        light *= 1.0 - alphas[i]
    return color


def _alpha(
    axes: Float64Array,
    mean: Enclosure,
    opacity: float,
    rotation: Enclosure,
    camera: PinholeCamera,
    u: Float64Array,
    inverse: Inverse,
    order: int,
) -> Enclosure:
    """Return opacity at the points u [P, 2] of one Gaussian (lines 3-10), given its centre [3] in the camera frame."""
    unit = Interval(np.zeros(u.shape[0]), np.full(u.shape[0], opacity))
    if not (mean.range.lower[2] >= PAPER.near and mean.range.upper[2] <= PAPER.far):
        # some poses drop it
        return Enclosure.of(mean.basis, unit)
    inverse_z = mean[2].reciprocal()
    view = [mean[0] * inverse_z, mean[1] * inverse_z]
    principal = rotation @ axes
    rows = [
        (principal[k] - view[k].reshape(1).broadcast_to((3,)) * principal[2])
        * (inverse_z * focal).reshape(1).broadcast_to((3,))
        for k, focal in enumerate((camera.fx, camera.fy))
    ]
    mixed = (rows[0] * rows[1]).sum()
    covariance = Enclosure.stack([rows[0].square().sum(), mixed, mixed, rows[1].square().sum()]).reshape(2, 2)
    conic = adjugate_inverse(covariance) if inverse == "adjugate" else matrix_inverse(covariance, order=order)
    points = u.shape[:1]
    dx = u[:, 0] - (view[0] * camera.fx + camera.cx).reshape(1).broadcast_to(points)
    dy = u[:, 1] - (view[1] * camera.fy + camera.cy).reshape(1).broadcast_to(points)
    wide = [conic[i, j].reshape(1).broadcast_to(points) for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))]
    q = dx.square() * wide[0] + dx * dy * (wide[1] + wide[2]) + dy.square() * wide[3]
    # the covariance is a Gram matrix: q is never negative
    q = q.meet(Interval(np.zeros(points), np.full(points, np.inf)))
    return ((q * -0.5).exp() * opacity).meet(unit)


def bound(
    splats: Splats,
    camera: PinholeCamera,
    forms: PoseForms,
    pixels: Float64Array | None = None,
    *,
    inverse: Inverse = "matrixinv",
    blend: Blend = "vr-ind",
    order: int = 2,
    linear: bool = True,
) -> Enclosure:
    """Return bounds of Algorithm 1 over all poses of ``forms``, by the paper's rules.

    Args:
        splats: The scene, activated with the rasteriser `PAPER`; a handful of Gaussians.
        camera: Intrinsics.
        forms: The poses.
        pixels: [P, 2] points (x, y) of the image plane; all pixel centres if None.
        inverse: "matrixinv" (Algorithm 3), or "adjugate", what it replaces.
        blend: "vr-ind" (Algorithm 4), "sort" (Algorithm 1, lines 13-18, one by one), or "sumcumprod"
            (Algorithm 5), which needs one depth order for all poses.
        order: Taylor order of MATRIXINV.
        linear: Whether opacities keep their linear part; without it they are intervals.

    Returns:
        Enclosures [P, 3] of the real-number picture.

    Raises:
        ValueError: The scene was activated for another rasteriser, or "sumcumprod" was asked for and
            the depth order may change.
    """
    _require_plain(splats)
    u = pixel_centers(camera) if pixels is None else np.asarray(pixels, np.float64)
    rotation, offset = Enclosure(forms.rotation), Enclosure(forms.offset)
    means, alphas, colors = [], [], []
    for i in range(splats.count):
        relative = Interval(splats.means[i]) - forms.origin
        mean = (rotation @ relative.reshape(3, 1)).reshape(3) + offset
        if mean.range.upper[2] < PAPER.near or mean.range.lower[2] > PAPER.far:
            continue
        opacity = float(splats.opacity[i])
        alpha = _alpha(splats.axes[i], mean, opacity, rotation, camera, u, inverse, order)
        alphas.append(alpha if linear else Enclosure.of(alpha.basis, alpha.range))
        means.append(mean)
        colors.append(splats.sh[i, 0])
    if not alphas:
        return Enclosure.of(rotation.basis, np.zeros((u.shape[0], 3)))
    depths = Enclosure.stack([mean[2] for mean in means])
    shape = (len(alphas), u.shape[0], 3)
    layers = Enclosure.stack(alphas).reshape(*shape[:2], 1).broadcast_to(shape)
    palette = np.broadcast_to(np.array(colors)[:, None], shape)
    if blend == "sort":
        return sorted_blend(layers, depths, palette)
    if blend == "vr-ind":
        return vr_ind(layers, depths, palette)
    front = surely_in_front(depths)
    places = front.sum(axis=1)
    if len(set(places.tolist())) < len(places):
        raise ValueError("the depth order may change inside this set of poses: use vr-ind, or smaller cells")
    nearest_first = np.argsort(places)
    return sumcumprod(layers[nearest_first], palette[nearest_first])
