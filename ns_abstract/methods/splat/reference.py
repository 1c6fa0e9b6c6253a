"""A slow reference renderer, written from gsplat's formulas alone, to check the fast one and the bounds.

It shares nothing with the compiled kernels but the constants: own activations, spherical harmonics,
projection (``J W Sigma W^T J^T``), tiles and compositing, in torch. Pictures are differentiable with
respect to the camera pose, except through the rasteriser's decisions (culling, tiles, thresholds, order).

Sources: splatfacto.py:547-640 (activations, view matrix, background) and gsplat 1.4.0's ``cuda/csrc``
(fully_fused_projection_fwd.cu, utils.cuh, spherical_harmonics.cuh, isect_tiles.cu,
rasterize_to_pixels_fwd.cu).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ns_abstract.arithmetic.rounding import PIXEL_ROOM
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.methods.splat.constants import ACCUMULATION_MIN, GSPLAT_1_4_0, Rasteriser
from ns_abstract.methods.splat.scene import SplatScene

#: Gaussians blended at a time: bounds the memory, and is how often a finished region is noticed.
_LAYERS = 128
#: Side of the regions that are blended at a time; divides every tile size.
_REGION = 8


@dataclass(frozen=True)
class Projection:
    """The Gaussians that gsplat draws for one camera, in scene order.

    Attributes:
        indices: [n] their numbers in the scene.
        means2d: [n, 2] centres, pixels.
        conics: [n, 3] entries xx, xy, yy of the inverse of the blurred covariance, 1 / pixels^2.
        radii: [n] pixels; infinite where the rasteriser has no tiles.
        depths: [n] z in the camera frame.
        tiles: [n, 4] tile ranges x0, x1, y0, y1; x1 and y1 are exclusive.
        colors: [n, 3] before the final clamp.
        opacities: [n], compensated for the blur if the scene is antialiased.
        extents: [n, 2] half-width and half-height of the pixels in which alpha reaches the
            threshold (no gradient); infinite where that is not used.
    """

    indices: Tensor
    means2d: Tensor
    conics: Tensor
    radii: Tensor
    depths: Tensor
    tiles: Tensor
    colors: Tensor
    opacities: Tensor
    extents: Tensor


def rotations(quats: Tensor) -> Tensor:
    """Return the [N, 3, 3] rotation matrices of quaternions [N, 4] (w, x, y, z), normalised here.

    ``R v = v + 2 w (u x v) + 2 u x (u x v)`` with ``u = (x, y, z)``; equal to utils.cuh:14-35.
    """
    q = quats / quats.norm(dim=1, keepdim=True)
    w, x, y, z = q.unbind(1)
    zero = torch.zeros_like(w)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    return torch.eye(3, dtype=q.dtype) + 2.0 * w[:, None, None] * cross + 2.0 * cross @ cross


def sh_colors(degree: int, directions: Tensor, sh: Tensor) -> Tensor:
    """Return ``max(0, 0.5 + sum_k Y_k(direction) sh_k)`` [n, 3] (rendering.py:382-392 of gsplat).

    ``directions`` [n, 3] lead from the camera, of any length, world axes; ``sh`` is [n, K, 3] with K >= (degree + 1)^2,
    for a ``degree`` from 0 to 3.
    """
    x, y, z = (directions / directions.norm(dim=1, keepdim=True)).unbind(1)
    basis = [torch.full_like(x, 0.28209479177387814)]
    if degree >= 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree >= 3:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    total = torch.einsum("nk,nkc->nc", torch.stack(basis, dim=1), sh[:, : len(basis)])
    return (total + 0.5).clamp(min=0.0)


class Reference:
    """Renders one scene.

    ``dtype``: of the computation. ``torch.float32`` gives one of the pictures that a float32 rasteriser may output.
    """

    def __init__(
        self, scene: SplatScene, rasteriser: Rasteriser = GSPLAT_1_4_0, dtype: torch.dtype = torch.float64
    ) -> None:
        self.scene = scene
        self.rules = rasteriser
        self.dtype = dtype
        self._means = torch.from_numpy(scene.means.copy()).to(dtype)
        spread = rotations(torch.from_numpy(scene.quats.copy()).to(dtype)) * torch.exp(
            torch.from_numpy(scene.log_scales.copy()).to(dtype)
        ).unsqueeze(1)
        self._covariances = spread @ spread.transpose(1, 2)
        self._opacities = torch.sigmoid(torch.from_numpy(scene.opacity_logits.copy()).to(dtype))
        self._sh = torch.from_numpy(scene.sh.copy()).to(dtype)
        self._shift: Tensor | None = None
        self._plain: Tensor | None = None
        self._background = torch.from_numpy(scene.background.copy()).to(dtype)
        if not rasteriser.background:
            self._background = torch.zeros(3, dtype=dtype)

    def scene_sample(self, means: Tensor, opacities: Tensor, color_shift: Tensor | None) -> Reference:
        """Return the scene with other means [N, 3], activated opacities [N] and shifts of activated colours [N, 3].

        Gradients of `pixels` flow back to them.
        """
        other = copy.copy(self)
        other._means, other._opacities = means.to(self.dtype), opacities.to(self.dtype)
        other._shift = None if color_shift is None else color_shift.to(self.dtype)
        return other

    def recolored(self, colors: Tensor) -> Reference:
        """Return the same Gaussians with view-independent ``colors`` [N, 3] and a black background."""
        other = copy.copy(self)
        other._plain, other._background = colors.to(self.dtype), torch.zeros(3, dtype=self.dtype)
        return other

    def project(self, camera: PinholeCamera, camera_to_world: Tensor, subset: Tensor | None = None) -> Projection:
        """Return the projected scene (fully_fused_projection_fwd.cu, isect_tiles.cu); arguments as for `image`.

        ``subset``: numbers of Gaussians that are known to be drawn: these, without culling; all if None.
        """
        r = self.rules
        pose = camera_to_world.to(self.dtype)
        rotation = (pose[:, :3] * torch.tensor([1.0, -1.0, -1.0], dtype=self.dtype)).T
        translation = -(rotation @ pose[:, 3])
        indices = torch.arange(self.scene.count) if subset is None else subset
        means = self._means if subset is None else self._means[subset]
        # entry by entry, so that equal means have equal depths
        x, y, z = means.unbind(1)
        points = torch.stack([a * x + b * y + c * z for a, b, c in rotation], dim=1) + translation
        if subset is None:
            in_range = torch.nonzero((points[:, 2] >= r.near) & (points[:, 2] <= r.far)).squeeze(1)
            indices, points = indices[in_range], points[in_range]
        means2d, covariance, flat = self._splat(camera, rotation, points, indices)
        xx, yy, xy = covariance[:, 0, 0] + r.eps2d, covariance[:, 1, 1] + r.eps2d, covariance[:, 0, 1]
        det = xx * yy - xy * xy
        opacities = self._opacities[indices]
        if self.scene.rasterize_mode == "antialiased":
            # max(0, .) may hold exactly; the root has no slope there
            ratio, least = flat / det, r.compensation_min
            positive = ratio > least * least
            opacities = opacities * torch.where(positive, torch.where(positive, ratio, 1.0).sqrt(), least)
        with torch.no_grad():
            radii, tiles, visible = self._tile_ranges(camera, means2d, xx, yy, det, opacities)
            extents = self._extents(xx, yy, opacities)
        in_range = torch.nonzero(visible).squeeze(1) if subset is None else torch.arange(len(indices))
        return Projection(
            indices=indices[in_range],
            means2d=means2d[in_range],
            conics=torch.stack([yy / det, -xy / det, xx / det], dim=1)[in_range],
            radii=radii[in_range].amax(dim=1),
            depths=points[in_range, 2],
            tiles=tiles[in_range],
            # the inverse of the view matrix holds the position, also where it is no rotation
            colors=self._colors(indices[in_range], -(rotation.T @ translation) if r.eye_from_view else pose[:, 3]),
            opacities=opacities[in_range],
            extents=extents[in_range],
        )

    def _splat(
        self, camera: PinholeCamera, rotation: Tensor, points: Tensor, indices: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return centres [n, 2], covariances [n, 2, 2] before the blur, and determinants (utils.cuh:255-291)."""
        margin = self.rules.view_margin
        x, y, z = points.unbind(1)
        u, v = x / z, y / z
        means2d = torch.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], dim=1)
        if margin >= 0.0:
            u = _limit(u, camera.cx, camera.width, camera.fx, margin)
            v = _limit(v, camera.cy, camera.height, camera.fy, margin)
        zero = torch.zeros_like(z)
        jacobian = torch.stack(
            [camera.fx / z, zero, -camera.fx * u / z, zero, camera.fy / z, -camera.fy * v / z], dim=1
        ).reshape(-1, 2, 3)
        turned = rotation @ self._covariances[indices] @ rotation.T
        covariance = jacobian @ turned @ jacobian.transpose(1, 2)
        flat = covariance[:, 0, 0] * covariance[:, 1, 1] - covariance[:, 0, 1] * covariance[:, 1, 0]
        return means2d, covariance, flat

    def _tile_ranges(
        self, camera: PinholeCamera, means2d: Tensor, xx: Tensor, yy: Tensor, det: Tensor, opacities: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return radii [n, 2], tile ranges [n, 4] and whether the Gaussian is drawn [n].

        Ellipses are enclosed in boxes: the Gaussian is invisible in the tiles of a box that the ellipse does not meet.
        """
        r = self.rules
        visible = det > 0.0
        side = r.work_tile
        limits = torch.tensor([-(-camera.width // side), -(-camera.height // side)])
        if not r.tile_size:
            radii = torch.full((len(det), 2), torch.inf, dtype=self.dtype)
            first = torch.zeros(len(det), 2, dtype=torch.int64)
            past = limits.expand(len(det), 2)
        else:
            if r.axis_sigmas:
                visible &= opacities >= r.alpha_min
                extent = torch.sqrt(2.0 * torch.log(opacities / r.alpha_min).clamp(min=0.0)).clamp(max=r.axis_sigmas)
                radii = torch.ceil(extent[:, None] * torch.sqrt(torch.stack([xx, yy], dim=1)))
            else:
                half = 0.5 * (xx + yy)
                larger = half + torch.sqrt((half * half - det).clamp(min=r.discriminant_min))
                radii = torch.ceil(r.radius_sigmas * torch.sqrt(larger))[:, None].expand(len(det), 2)
            size = torch.tensor([camera.width, camera.height], dtype=self.dtype)
            inside = (radii > 0.0) & (means2d + radii > 0.0) & (means2d - radii < size)
            visible &= inside.all(dim=1)
            # a radius that is not finite covers everything
            first = torch.floor(means2d / side - radii / side)
            past = torch.ceil(means2d / side + radii / side)
            first = torch.minimum(first.clamp(min=0.0), limits).long()
            past = torch.minimum(past.clamp(min=0.0), limits).long()
        return radii, torch.stack([first[:, 0], past[:, 0], first[:, 1], past[:, 1]], dim=1), visible

    def _extents(self, xx: Tensor, yy: Tensor, opacities: Tensor) -> Tensor:
        """Return half-sizes [n, 2] of the box outside of which alpha is below the threshold."""
        if self.rules.alpha_min <= 0.0 or self.dtype != torch.float64:
            return torch.full((len(xx), 2), torch.inf, dtype=self.dtype)
        # alpha >= alpha_min means d^T Sigma^-1 d <= 2 log(opacity / alpha_min); |d_x| <= sqrt(that Sigma_xx)
        level = (2.0 * torch.log(opacities / self.rules.alpha_min)).clamp(min=0.0) + PIXEL_ROOM
        return torch.sqrt(level[:, None] * torch.stack([xx, yy], dim=1)) * (1.0 + PIXEL_ROOM) + PIXEL_ROOM

    def _colors(self, indices: Tensor, position: Tensor) -> Tensor:
        """Return colours [n, 3] seen from ``position`` [3], world."""
        if self._plain is not None:
            return self._plain[indices]
        sh = self._sh[indices]
        if self.scene.color_model == "sigmoid":
            colors = torch.sigmoid(sh[:, 0])
            return colors if self._shift is None else (colors + self._shift[indices]).clamp(0.0, 1.0)
        degree = self.scene.sh_degree if self.rules.view_dependent else 0
        colors = sh_colors(degree, self._means[indices] - position, sh)
        return colors if self._shift is None else (colors + self._shift[indices]).clamp(min=0.0)

    def _layers(self, p: Projection, order: Tensor, axis: int, low: float, high: float) -> Tensor:
        """Return the rows ``order`` of ``p`` that reach pixel centres in [low, high] along one axis (0: x)."""
        tile = int(low) // self.rules.work_tile
        first, past = p.tiles[order, 2 * axis], p.tiles[order, 2 * axis + 1]
        mean, extent = p.means2d[order, axis].detach(), p.extents[order, axis]
        return order[(first <= tile) & (tile < past) & (mean + extent >= low) & (mean - extent <= high)]

    def _blend(self, p: Projection, layers: Tensor, centers: Tensor) -> Tensor:
        """Composite rows ``layers`` of ``p`` at pixel ``centers`` [k, 2] over the background; return [k, 3]."""
        color, light = self._sums(p, layers, centers, p.colors)
        return (color + light[:, None] * self._background).clamp(0.0, 1.0)

    def _blend_layers(self, p: Projection, layers: Tensor, centers: Tensor) -> Tensor:
        """Return accumulation and expected depth [k, 2], NaN where nothing is drawn (gsplat's RGB+ED)."""
        depth, light = self._sums(p, layers, centers, p.depths[:, None])
        accumulation = 1.0 - light[:, None]
        mean = depth / accumulation.clamp(min=ACCUMULATION_MIN)
        return torch.cat([accumulation, torch.where(accumulation > 0.0, mean, torch.nan)], dim=1)

    def _sums(self, p: Projection, layers: Tensor, centers: Tensor, colors: Tensor) -> tuple[Tensor, Tensor]:
        """Return weighted sums [k, c] of ``colors`` [n, c] at ``centers`` [k, 2], and the final transmittance [k].

        See rasterize_to_pixels_fwd.cu:60-184.
        """
        r = self.rules
        light = torch.ones(len(centers), dtype=self.dtype)
        live = torch.ones(len(centers), dtype=torch.bool)
        color = torch.zeros(len(centers), colors.shape[1], dtype=self.dtype)
        for start in range(0, len(layers), _LAYERS):
            chunk = layers[start : start + _LAYERS]
            dx = p.means2d[chunk, 0:1] - centers[:, 0]
            dy = p.means2d[chunk, 1:2] - centers[:, 1]
            a, b, c = p.conics[chunk].unsqueeze(2).unbind(1)
            sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
            alpha = (p.opacities[chunk, None] * torch.exp(-sigma)).clamp(max=r.alpha_max)
            alpha = torch.where((sigma >= 0.0) & (alpha >= r.alpha_min), alpha, 0.0)
            # transmittance in front of the first layer, then behind each
            rest = torch.cat([light[None], light * torch.cumprod(1.0 - alpha, dim=0)])
            drawn = live.expand_as(alpha)
            if r.transmittance_min > 0.0:
                # falls monotonically, so this is a run of layers from the first
                drawn = drawn & (rest[1:] > r.transmittance_min)
            weight = torch.where(drawn, alpha * rest[:-1], 0.0)
            color = color + weight.T @ colors[chunk]
            light = rest.gather(0, drawn.sum(dim=0, keepdim=True)).squeeze(0)
            live = live & drawn[-1]
            if not live.any():
                break
        return color, light

    def image(self, camera: PinholeCamera, camera_to_world: Tensor) -> Tensor:
        """Return the picture [H, W, 3] in [0, 1] from ``camera_to_world`` [3, 4], OpenGL axes."""
        return self._picture(camera, camera_to_world, self._blend)

    def layers(self, camera: PinholeCamera, camera_to_world: Tensor) -> Tensor:
        """Return accumulation and expected depth [H, W, 2], NaN where nothing is drawn; arguments as for `image`."""
        return self._picture(camera, camera_to_world, self._blend_layers)

    def _picture(
        self, camera: PinholeCamera, camera_to_world: Tensor, blend: Callable[[Projection, Tensor, Tensor], Tensor]
    ) -> Tensor:
        p = self.project(camera, camera_to_world)
        order = torch.argsort(p.depths.detach(), stable=True)
        rows = []
        for top in range(0, camera.height, _REGION):
            y = torch.arange(top, min(top + _REGION, camera.height), dtype=self.dtype) + 0.5
            strip = self._layers(p, order, 1, float(y[0]), float(y[-1]))
            row = []
            for left in range(0, camera.width, _REGION):
                x = torch.arange(left, min(left + _REGION, camera.width), dtype=self.dtype) + 0.5
                layers = self._layers(p, strip, 0, float(x[0]), float(x[-1]))
                centers = torch.stack([x.repeat(len(y)), y.repeat_interleave(len(x))], dim=1)
                row.append(blend(p, layers, centers).reshape(len(y), len(x), -1))
            rows.append(torch.cat(row, dim=1))
        return torch.cat(rows)

    def pixels(self, camera: PinholeCamera, camera_to_world: Tensor, pixels: Tensor) -> Tensor:
        """Return `image` at ``pixels`` [k, 2] (row, column) alone: [k, 3]; gradients cost only the Gaussians there."""
        with torch.no_grad():
            p = self.project(camera, camera_to_world)
            order = torch.argsort(p.depths, stable=True)
        colors = []
        for row, column in pixels.tolist():
            center = torch.tensor([column + 0.5, row + 0.5], dtype=self.dtype)
            layers = self._layers(p, self._layers(p, order, 1, row + 0.5, row + 0.5), 0, column + 0.5, column + 0.5)
            transmittance, layers_left = p, layers
            leaves = (camera_to_world, self._means, self._opacities, self._shift)
            if torch.is_grad_enabled() and any(leaf is not None and leaf.requires_grad for leaf in leaves):
                # the decisions of the first pass stand, the second one only adds derivatives
                transmittance = self.project(camera, camera_to_world, p.indices[layers])
                layers_left = torch.arange(len(layers))
            colors.append(self._blend(transmittance, layers_left, center[None]).squeeze(0))
        return torch.stack(colors)


def _limit(ratio: Tensor, center: float, size: int, focal: float, margin: float) -> Tensor:
    """Clamp x/z (or y/z) to ``margin`` of the half field of view outside the image (utils.cuh:267-277)."""
    spare = margin * 0.5 * size / focal
    return ratio.clamp(-(center / focal + spare), (size - center) / focal + spare)


def project(
    scene: SplatScene, camera: PinholeCamera, camera_to_world: Tensor, *, rasteriser: Rasteriser = GSPLAT_1_4_0
) -> Projection:
    """Return the result of gsplat's projection and tile stages for a scene; see `Reference.project`."""
    return Reference(scene, rasteriser).project(camera, camera_to_world)
