"""Concrete rendering of nerfacto with Nerfstudio's evaluation semantics in float64 (models/nerfacto.py:298-345)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.methods.nerf import nerfacto_kernel as kernel
from ns_abstract.methods.nerf.hash_field import NerfactoField
from ns_abstract.methods.nerf.hsv import shifted
from ns_abstract.methods.nerf.render import Shift, camera_rays

#: Rays whose samples are held at once.
_CHUNK = 512


def even(most: float, count: int) -> NDArray[np.float64]:
    """``torch.linspace(0, most, count)`` in float64, to the last bit."""
    steps = np.arange(count)
    step = most / (count - 1) if count > 1 else 0.0
    return np.where(steps < count // 2, step * steps, most - step * (count - 1 - steps)) if count > 1 else np.zeros(1)


def quantiles(count: int) -> NDArray[np.float64]:
    """[count + 1] parts of a distribution at which the edges of ``count`` intervals lie (ray_samplers.py:337-339)."""
    edges = count + 1
    return even(1.0 - 1.0 / edges, edges) + 1.0 / (2 * edges)


class NerfactoRenderer:
    """Renders rays of a nerfacto."""

    def __init__(self, field: NerfactoField) -> None:
        self.field = field
        self._grid = kernel.pack_grid(field.encoding)
        self._density, self._color = kernel.pack(field.density_net), kernel.pack(field.color_net)
        self._proposals = [(kernel.pack_grid(p.encoding), kernel.pack(p.net)) for p in field.proposals]
        nets = (self._density, self._color, *(net for _, net in self._proposals))
        self._width = max(int(net.widths.max()) for net in nets)
        self._piecewise = field.spacing == "piecewise"
        place = kernel.spacing if self._piecewise else float
        self._ends = place(field.near), place(field.far)
        self._first = even(1.0, field.samples[0] + 1)
        self._quantiles = [quantiles(count) for count in field.samples[1:]]

    def edges(self, ray: NDArray[np.float64]) -> NDArray[np.float64]:
        """[samples + 1] distances between which the picture's samples lie, on ``ray`` [2, 3] (origin, direction)."""
        places, buffers = self._first, np.empty((2, self._width))
        for field, (grid, net), wanted in zip(self.field.proposals, self._proposals, self._quantiles, strict=True):
            places = kernel.place_samples(
                grid, net, field.average_init_density, ray, self._ends, self._piecewise, places, wanted, buffers
            )
        return np.array([kernel.distance_at(place, *self._ends, self._piecewise) for place in places])

    def rays(self, rays: NDArray[np.float64], shift: Shift | None = None) -> NDArray[np.float64]:
        """Colours [n, 3] in [0, 1] of ``rays`` [n, 2, 3], origins and unit directions.

        ``shift``: hue and saturation added to every sample's colour (`hsv.shifted`).
        """
        count = self.field.samples[-1]
        weights, colors = np.empty((len(rays), count)), np.empty((len(rays), count, 3))
        last, buffers = isinstance(self.field.background, str), np.empty((2, self._width))
        for k, ray in enumerate(rays):
            kernel.color_samples(
                self._grid, self._density, self._color, self.field.average_init_density, ray, self.edges(ray), last,
                buffers, weights[k], colors[k],
            )  # fmt: skip
        if shift is not None:
            colors = shifted(torch.from_numpy(colors), *shift).numpy()
        behind = colors[:, -1] if isinstance(self.field.background, str) else self.field.background
        total = (weights[..., None] * colors).sum(axis=1) + behind * (1.0 - weights.sum(axis=1))[:, None]
        return np.clip(total, 0.0, 1.0)

    def pixels(
        self, camera: PinholeCamera, pose: NDArray[np.float64], pixels: NDArray[np.int64], shift: Shift | None = None
    ) -> NDArray[np.float64]:
        """Colours [n, 3] of ``pixels`` [n, 2] (row, column) from camera-to-world ``pose`` [3, 4]."""
        pose = np.asarray(pose, np.float64)
        world = camera_rays(camera, pixels) @ pose[:, :3].T
        world /= np.linalg.norm(world, axis=1, keepdims=True)
        rays = np.stack([np.broadcast_to(pose[:, 3], world.shape), world], axis=1)
        colors = [np.zeros((0, 3))]
        for start in range(0, len(rays), _CHUNK):
            check_cancelled()
            colors.append(self.rays(rays[start : start + _CHUNK], shift))
        return np.concatenate(colors)
