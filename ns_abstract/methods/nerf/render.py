"""Concrete rendering of a vanilla NeRF with Nerfstudio's evaluation semantics, in torch.

``hierarchical`` is what Nerfstudio shows (nerfstudio/models/vanilla_nerf.py, ``get_outputs``);
``uniform`` evaluates the fine field at the middles of N equal bins, which is Algorithm 2 of
"Abstract Rendering". Rays: cameras.py:880-900 (pixel centres, OpenGL axes, normalised directions).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as recompute

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.methods.nerf.field import Field
from ns_abstract.methods.nerf.hsv import shifted
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.nerf.white import WhiteSamples

#: nerfstudio/model_components/ray_samplers.py, ``PDFSampler``.
HISTOGRAM_PADDING = 0.01
_SUM_EPS = 1e-5
#: Points whose fields are evaluated at once.
_CHUNK = 1 << 15
#: Hue and saturation, numbers or tensors.
Shift = tuple[Any, Any]


@dataclass(frozen=True)
class Sampling:
    """Where a ray is sampled.

    Attributes:
        samples: Bins of equal length; of the coarse pass where the sampling is hierarchical.
        importance: Samples that the coarse weights place (hierarchical only).
    """

    kind: Literal["uniform", "hierarchical"]
    near: float
    far: float
    samples: int
    importance: int
    background: tuple[float, float, float]

    @property
    def bins(self) -> tuple[np.ndarray, np.ndarray]:
        """Return [samples] distances of the bins' middles, and their lengths."""
        edges = self.edges
        return 0.5 * (edges[1:] + edges[:-1]), edges[1:] - edges[:-1]

    @property
    def edges(self) -> np.ndarray:
        """Return [samples + 1] float64 distances of the bins' ends (``UniformSampler`` outside training)."""
        bins = np.linspace(0.0, 1.0, self.samples + 1)
        return bins * self.far + (1.0 - bins) * self.near


def camera_rays(camera: PinholeCamera, pixels: np.ndarray) -> np.ndarray:
    """Return [n, 3] float64 ray directions in camera axes, not normalised, of ``pixels`` [n, 2] (row, column)."""
    rows, columns = np.asarray(pixels).T
    x = (columns + 0.5 - camera.cx) / camera.fx
    y = -(rows + 0.5 - camera.cy) / camera.fy
    return np.stack([x, y, -np.ones_like(x)], axis=1)


class RayRenderer(ABC):
    """Renders pictures of a field ray by ray; subclasses provide ``rays`` and ``points``."""

    dtype: torch.dtype = torch.float64
    device: torch.device = torch.device("cpu")

    @property
    @abstractmethod
    def points(self) -> int:
        """Number of evaluated points of a ray."""

    @abstractmethod
    def rays(self, pose: Tensor, directions: Tensor, shift: Shift | None = None) -> Tensor:
        """Return colours [n, 3] in [0, 1] along camera-axes ``directions`` [n, 3] from ``pose`` [3, 4]; differentiable.

        ``shift``: hue and saturation added to every point's colour (`hsv.shifted`).
        """

    def _directions(self, camera: PinholeCamera, pixels: np.ndarray) -> tuple[Tensor, ...]:
        """Return directions of ``pixels`` [n, 2] in batches that fit into memory."""
        directions = torch.from_numpy(camera_rays(camera, pixels)).to(self.device, self.dtype)
        return directions.split(max(1, _CHUNK // self.points))

    def pixels(
        self, camera: PinholeCamera, pose: np.ndarray, pixels: np.ndarray, shift: Shift | None = None
    ) -> np.ndarray:
        """Return colours [n, 3] float64 of ``pixels`` [n, 2] (row, column) from camera-to-world ``pose`` [3, 4]."""
        matrix = torch.tensor(np.asarray(pose)).to(self.device, self.dtype)
        with torch.inference_mode():
            parts = []
            for part in self._directions(camera, pixels):
                check_cancelled()
                parts.append(self.rays(matrix, part, shift))
        return torch.cat(parts).double().cpu().numpy()

    def image(self, camera: PinholeCamera, pose: np.ndarray, shift: Shift | None = None) -> np.ndarray:
        """Return the image [H, W, 3] float64."""
        return self.pixels(camera, pose, _every_pixel(camera), shift).reshape(camera.height, camera.width, 3)

    def picture(self, camera: PinholeCamera, pose: Tensor, shift: Shift | None = None) -> Tensor:
        """Return the image [H, W, 3] from camera-to-world ``pose`` [3, 4]; differentiable.

        Gradients render the rays once more, so that memory stays small.
        """

        def part(pose: Tensor, directions: Tensor) -> Tensor:
            check_cancelled()
            return self.rays(pose, directions, shift)

        directions = self._directions(camera, _every_pixel(camera))
        parts = [recompute(part, pose, some, use_reentrant=False) for some in directions]
        return torch.cat(parts).reshape(camera.height, camera.width, 3)


def _every_pixel(camera: PinholeCamera) -> np.ndarray:
    """Return [H W, 2] rows and columns of all pixels."""
    return np.indices((camera.height, camera.width)).reshape(2, -1).T


class NerfRenderer(RayRenderer):
    """Renders rays of a scene.

    Args:
        white: The uniform samples that are white, the others black, in place of the field's colours; None: the latter.
    """

    def __init__(
        self,
        scene: NerfScene,
        sampling: Sampling,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
        white: WhiteSamples | None = None,
    ) -> None:
        self.white = white
        self.sampling, self.dtype, self.device = sampling, dtype, torch.device(device)
        self.fine = Field(scene.fine, dtype, device)
        self.coarse = Field(scene.coarse, dtype, device) if sampling.kind == "hierarchical" else self.fine
        self.occupancy = scene.occupancy
        self._background = torch.tensor(sampling.background, dtype=dtype, device=device)

    def rays(self, pose: Tensor, directions: Tensor, shift: Shift | None = None) -> Tensor:
        world = directions @ pose[:, :3].T
        world = world / torch.linalg.vector_norm(world, dim=-1, keepdim=True)
        origin = pose[:, 3]
        s = self.sampling
        bins = torch.linspace(0.0, 1.0, s.samples + 1, dtype=self.dtype, device=self.device)
        bins = bins.expand(directions.shape[0], -1)
        if s.kind == "hierarchical":
            density, _, _ = self._densities(self.coarse, origin, world, bins)
            bins = self._refined(bins, interval_weights(density, self._lengths(bins)))
        density, base, inside = self._densities(self.fine, origin, world, bins)
        weights = interval_weights(density, self._lengths(bins))
        if self.white is not None:
            distances = self._middles(bins)
            color = self.white.at(origin + world[:, None] * distances[..., None], distances)
            return (weights[..., None] * color).sum(dim=1).clamp(0.0, 1.0)
        if not weights.requires_grad:
            # most samples of empty space add exactly nothing, whatever their colour
            visible = weights > 0.0
            base, inside = base[visible[inside]], visible
        color = self.fine.color(base, world[:, None].expand(-1, weights.shape[1], -1)[inside])
        if shift is not None:
            color = shifted(color, *shift)
        color = _filled(color, inside)
        total = (weights[..., None] * color).sum(dim=1)
        total = total + self._background * (1.0 - weights.sum(dim=1))[:, None]
        return total.clamp(0.0, 1.0)

    @property
    def points(self) -> int:
        """Number of evaluated points of a ray."""
        s = self.sampling
        return s.samples + (s.importance if s.kind == "hierarchical" else 0)

    def _distances(self, bins: Tensor) -> Tensor:
        s = self.sampling
        return bins * s.far + (1.0 - bins) * s.near

    def _middles(self, bins: Tensor) -> Tensor:
        distances = self._distances(bins)
        return (distances[:, :-1] + distances[:, 1:]) / 2.0

    def _lengths(self, bins: Tensor) -> Tensor:
        distances = self._distances(bins)
        return distances[:, 1:] - distances[:, :-1]

    def _densities(self, field: Field, origin: Tensor, world: Tensor, bins: Tensor) -> tuple[Tensor, Tensor, Any]:
        """Return densities [n, k] in the middles of the bins [n, k + 1], and base outputs of the evaluated points.

        The last result selects these points of [n, k]: all of them where nothing is declared empty.
        """
        points = origin + world[:, None] * self._middles(bins)[..., None]
        if self.occupancy is None:
            return *field.density(points), ...
        inside = self.occupancy.at(points)
        density, base = field.density(points[inside])
        return _filled(density, inside), base, inside

    def _refined(self, bins: Tensor, weights: Tensor) -> Tensor:
        """Return ``PDFSampler.generate_ray_samples`` outside training: the union of old and new edges, sorted."""
        weights = weights + HISTOGRAM_PADDING
        total = weights.sum(dim=-1, keepdim=True)
        padding = torch.relu(_SUM_EPS - total)
        pdf = (weights + padding / weights.shape[-1]) / (total + padding)
        cdf = torch.clamp(torch.cumsum(pdf, dim=-1), max=1.0)
        cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf], dim=-1)
        count = self.sampling.importance + 1
        u = torch.linspace(0.0, 1.0 - 1.0 / count, count, dtype=self.dtype, device=self.device) + 0.5 / count
        u = u.expand(cdf.shape[0], -1).contiguous()
        places = torch.searchsorted(cdf, u, side="right")
        below, above = (places - 1).clamp(0, bins.shape[1] - 1), places.clamp(0, bins.shape[1] - 1)
        low, high = cdf.gather(1, below), cdf.gather(1, above)
        part = torch.clip(torch.nan_to_num((u - low) / (high - low), 0.0), 0.0, 1.0)
        start = bins.gather(1, below)
        new = start + part * (bins.gather(1, above) - start)
        return torch.sort(torch.cat([bins, new], dim=-1), dim=-1).values.detach()


def _filled(values: Tensor, inside: Any) -> Tensor:
    """Return ``values`` [p, ...] at the places ``inside`` [n, k], zeros elsewhere; unchanged where it selects all."""
    if inside is ...:
        return values
    return values.new_zeros((*inside.shape, *values.shape[1:])).index_put(inside.nonzero(as_tuple=True), values)


def interval_weights(density: Tensor, lengths: Tensor) -> Tensor:
    """Return weights [n, k] of densities [n, k] on bins of ``lengths`` [n, k] (``RaySamples.get_weights``)."""
    depth = lengths * density
    before = torch.cat([torch.zeros_like(depth[:, :1]), torch.cumsum(depth[:, :-1], dim=1)], dim=1)
    return torch.nan_to_num((1.0 - torch.exp(-depth)) * torch.exp(-before))
