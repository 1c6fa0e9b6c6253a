"""Rendering of nerfacto by the rules of Nerfstudio's torch implementation, in float64 (models/nerfacto.py:298-345).

Lines are those of nerfstudio 1.1.5.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ns_abstract.methods.nerf.hash_field import PRIME_Y, PRIME_Z, DenseNet, HashEncoding, NerfactoField
from ns_abstract.methods.nerf.hsv import shifted
from ns_abstract.methods.nerf.render import HISTOGRAM_PADDING, RayRenderer, Shift, interval_weights


def contracted(x: Tensor) -> Tensor:
    """Return the grids' coordinates [..., 3] of points (spatial_distortions.py:66-69, nerfacto_field.py:208)."""
    size = x.abs().amax(dim=-1, keepdim=True)
    far = size.clamp(min=1.0)
    return (torch.where(size < 1.0, x, (2.0 - 1.0 / far) * (x / far)) + 2.0) / 4.0


def grid_features(encoding: HashEncoding, x: Tensor) -> Tensor:
    """Return features [..., L F] of positions [..., 3] in [0, 1]^3 (encodings.py:418-459)."""
    levels, rows, _ = encoding.table.shape
    q = x[..., None, :] * torch.from_numpy(encoding.resolutions)[:, None]
    low = torch.floor(q).detach()
    share = q - low
    # [8, ..., L, 3] by corner
    high = torch.from_numpy(np.indices((2, 2, 2)).reshape(3, 8).T == 1).reshape(8, *(1,) * (q.dim() - 1), 3)
    cx, cy, cz = torch.where(high, torch.ceil(q).detach(), low).long().unbind(dim=-1)
    row = (cx ^ (cy * PRIME_Y) ^ (cz * PRIME_Z)) & (rows - 1)
    weight = torch.where(high, share, 1.0 - share).prod(dim=-1)
    table = torch.from_numpy(encoding.table)
    return (weight[..., None] * table[torch.arange(levels), row]).sum(dim=0).flatten(-2)


def evaluate_net(net: DenseNet, x: Tensor) -> Tensor:
    """Return the outputs of a network."""
    for k, (weight, bias) in enumerate(zip(net.weights, net.biases, strict=True)):
        x = functional.linear(functional.relu(x) if k else x, torch.from_numpy(weight), torch.from_numpy(bias))
    return x


def harmonics(direction: Tensor) -> Tensor:
    """Return 16 harmonics [..., 16] of (d + 1) / 2 for unit directions (nerfacto_field.py:242, math.py:42-77)."""
    x, y, z = ((direction + 1.0) / 2.0).unbind(dim=-1)
    xx, yy, zz = x * x, y * y, z * z
    parts = [
        0.28209479177387814 * torch.ones_like(x),
        0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x,
        1.0925484305920792 * x * y, 1.0925484305920792 * y * z, 0.9461746957575601 * zz - 0.31539156525251999,
        1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        0.5900435899266435 * y * (3.0 * xx - yy), 2.890611442640554 * x * y * z,
        0.4570457994644658 * y * (5.0 * zz - 1.0), 0.3731763325901154 * z * (5.0 * zz - 3.0),
        0.4570457994644658 * x * (5.0 * zz - 1.0), 1.445305721320277 * z * (xx - yy),
        0.5900435899266435 * x * (xx - 3.0 * yy),
    ]  # fmt: skip
    return torch.stack(parts, dim=-1)


def even(end: float, count: int) -> Tensor:
    """Return [count] evenly spaced float64 numbers from 0 to ``end``."""
    return torch.linspace(0.0, end, count, dtype=torch.float64)


def quantiles(count: int) -> Tensor:
    """Return the [count + 1] quantiles at which the edges of ``count`` intervals lie (ray_samplers.py:337-339)."""
    edges = count + 1
    return even(1.0 - 1.0 / edges, edges) + 1.0 / (2 * edges)


def next_places(places: Tensor, weights: Tensor, count: int) -> Tensor:
    """Return positions [n, count + 1] of the next round's edges (ray_samplers.py:305-354, outside training).

    ``places`` [n, k + 1] are the edges of this round, from 0 to 1, and ``weights`` [n, k] those of its intervals.
    """
    padded = weights + HISTOGRAM_PADDING
    shares = torch.cumsum(padded / padded.sum(dim=-1, keepdim=True), dim=-1).clamp(max=1.0)
    shares = torch.cat([torch.zeros_like(shares[:, :1]), shares], dim=-1)
    wanted = quantiles(count).expand(len(shares), -1).contiguous()
    above = torch.searchsorted(shares.detach(), wanted, side="right").clamp(1, weights.shape[1])
    low, high = shares.gather(1, above - 1), shares.gather(1, above)
    part = ((wanted - low) / (high - low)).nan_to_num(0.0).clamp(0.0, 1.0)
    start = places.gather(1, above - 1)
    return start + part * (places.gather(1, above) - start)


def spacing(distance: float) -> float:
    """Return the position of a distance in the piecewise spacing: half of it below 1, above it 1 - 1 / (2 distance)."""
    return distance / 2.0 if distance < 1.0 else 1.0 - 1.0 / (2.0 * distance)


class NerfactoRenderer(RayRenderer):
    """Renders rays of a nerfacto; gradients flow through the samples' positions, too."""

    def __init__(self, field: NerfactoField) -> None:
        self.field = field

    @property
    def points(self) -> int:
        return sum(self.field.samples)

    def rays(self, pose: Tensor, directions: Tensor, shift: Shift | None = None) -> Tensor:
        world = functional.normalize(directions @ pose[:, :3].T, dim=-1, eps=0.0)
        return self.colors(pose[:, 3], world, shift)

    def colors(self, origin: Tensor, world: Tensor, shift: Shift | None = None) -> Tensor:
        """Return `rays` from ``origin`` [3], or [n, 3] by ray, along unit vectors ``world`` [n, 3]."""
        f = self.field
        weights, raw = self._samples(
            f.encoding, f.density_net, f.average_init_density, origin, world, self.edges(origin, world)
        )
        seen = weights > 0.0 if not weights.requires_grad else torch.ones_like(weights, dtype=torch.bool)
        seen[:, -1] |= isinstance(f.background, str)
        directions = harmonics(world)[:, None].expand(-1, weights.shape[1], -1)[seen]
        color = torch.sigmoid(evaluate_net(f.color_net, torch.cat([directions, raw[seen][:, 1:]], dim=-1)))
        # renderers.py:225
        color = color.nan_to_num()
        if shift is not None:
            color = shifted(color, *shift)
        colors = color.new_zeros(*weights.shape, 3).index_put(seen.nonzero(as_tuple=True), color)
        behind = colors[:, -1] if isinstance(f.background, str) else torch.from_numpy(f.background)
        total = (weights[..., None] * colors).sum(dim=1) + behind * (1.0 - weights.sum(dim=1))[:, None]
        return total.clamp(0.0, 1.0)

    def edges(self, origin: Tensor, world: Tensor) -> Tensor:
        """Return [n, samples + 1] distances of the edges of the picture's samples; rays as in `colors`."""
        samples = self.field.samples
        places = even(1.0, samples[0] + 1).expand(len(world), -1)
        for field, count in zip(self.field.proposals, samples[1:], strict=True):
            distances = self.distances(places)
            weights, _ = self._samples(field.encoding, field.net, field.average_init_density, origin, world, distances)
            places = next_places(places, weights, count)
        return self.distances(places)

    def distances(self, places: Tensor) -> Tensor:
        """Return distances along a ray of ``places`` in [0, 1] (ray_samplers.py:113-118, 244-245)."""
        f, piecewise = self.field, self.field.spacing == "piecewise"
        near, far = (spacing(end) if piecewise else end for end in (f.near, f.far))
        places = places * far + (1.0 - places) * near
        if not piecewise:
            return places
        return torch.where(places < 0.5, 2.0 * places, 1.0 / (2.0 - 2.0 * places.clamp(min=0.5)))

    @staticmethod
    def _samples(
        encoding: HashEncoding, net: DenseNet, factor: float, origin: Tensor, world: Tensor, distances: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return weights [n, k] of intervals between ``distances`` [n, k + 1], and the network's outputs there."""
        middles = (distances[:, :-1] + distances[:, 1:]) / 2.0
        x = contracted(origin[..., None, :] + world[:, None] * middles[..., None])
        # nerfacto_field.py:211-213: false only where rounding puts a point that is very far away onto the cube's face
        inside = ((x > 0.0) & (x < 1.0)).all(dim=-1)
        raw = evaluate_net(net, grid_features(encoding, torch.where(inside[..., None], x, 0.0)))
        return interval_weights(factor * raw[..., 0].exp() * inside, distances.diff(dim=-1)), raw
