"""Nerfacto in torch: the picture of `NerfactoRenderer`, differentiable by the pose, for attacks and slopes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ns_abstract.methods.nerf.hash_field import DenseNet, HashEncoding, NerfactoField
from ns_abstract.methods.nerf.hsv import shifted
from ns_abstract.methods.nerf.nerfacto_kernel import PRIME_Y, PRIME_Z, spacing
from ns_abstract.methods.nerf.nerfacto_render import even, quantiles
from ns_abstract.methods.nerf.render import HISTOGRAM_PADDING, Shift, interval_weights


def contracted(x: Tensor) -> Tensor:
    """The grids' coordinates [..., 3] of points [..., 3]."""
    size = x.abs().amax(dim=-1, keepdim=True)
    far = size.clamp(min=1.0)
    return (torch.where(size < 1.0, x, (2.0 - 1.0 / far) * (x / far)) + 2.0) / 4.0


def grid_features(encoding: HashEncoding, x: Tensor) -> Tensor:
    """Features [..., L F] of positions [..., 3] in [0, 1]^3."""
    levels, rows, _ = encoding.table.shape
    q = x[..., None, :] * torch.from_numpy(encoding.resolutions)[:, None]
    low = torch.floor(q).detach()
    share = q - low
    table, level = torch.from_numpy(encoding.table), torch.arange(levels)
    ends = low.long(), torch.ceil(q).detach().long()
    features: Tensor | float = 0.0
    for corner in np.ndindex(2, 2, 2):
        cx, cy, cz = (ends[high][..., axis] for axis, high in enumerate(corner))
        row = (cx ^ (cy * PRIME_Y) ^ (cz * PRIME_Z)) % rows
        weight = torch.stack([share[..., a] if h else 1.0 - share[..., a] for a, h in enumerate(corner)]).prod(dim=0)
        features = features + weight[..., None] * table[level, row]
    assert isinstance(features, Tensor)
    return features.flatten(-2)


def evaluate_net(net: DenseNet, x: Tensor) -> Tensor:
    """Outputs of a network."""
    for k, (weight, bias) in enumerate(zip(net.weights, net.biases, strict=True)):
        x = functional.linear(functional.relu(x) if k else x, torch.from_numpy(weight), torch.from_numpy(bias))
    return x


def harmonics(direction: Tensor) -> Tensor:
    """The 16 harmonics [..., 16] of (d + 1) / 2 for unit directions [..., 3]."""
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


class DifferentiableNerfacto:
    """Renders rays of a nerfacto in float64; slopes go through the samples' places as well."""

    def __init__(self, field: NerfactoField) -> None:
        self.field = field

    @property
    def points(self) -> int:
        """Points that are evaluated for a ray."""
        return sum(self.field.samples)

    def rays(self, pose: Tensor, directions: Tensor, shift: Shift | None = None) -> Tensor:
        """Colours [n, 3] in [0, 1] along camera-axes ``directions`` [n, 3] from ``pose`` [3, 4]."""
        f = self.field
        world = functional.normalize(directions @ pose[:, :3].T, dim=-1, eps=0.0)
        origin = pose[:, 3]
        places = torch.from_numpy(even(1.0, f.samples[0] + 1)).expand(len(world), -1)
        for field, count in zip(f.proposals, f.samples[1:], strict=True):
            distances = self._distances(places)
            raw = evaluate_net(field.net, grid_features(field.encoding, self._positions(origin, world, distances)))
            weights = interval_weights(field.average_init_density * raw[..., 0].exp(), distances.diff(dim=-1))
            places = self._next(places, weights, count)
        distances = self._distances(places)
        raw = evaluate_net(f.density_net, grid_features(f.encoding, self._positions(origin, world, distances)))
        weights = interval_weights(f.average_init_density * raw[..., 0].exp(), distances.diff(dim=-1))
        seen = harmonics(world)[:, None].expand(-1, weights.shape[1], -1)
        colors = torch.sigmoid(evaluate_net(f.color_net, torch.cat([seen, raw[..., 1:]], dim=-1)))
        if shift is not None:
            colors = shifted(colors, *shift)
        behind = colors[:, -1] if isinstance(f.background, str) else torch.from_numpy(f.background)
        total = (weights[..., None] * colors).sum(dim=1) + behind * (1.0 - weights.sum(dim=1))[:, None]
        return total.clamp(0.0, 1.0)

    def _distances(self, places: Tensor) -> Tensor:
        f, piecewise = self.field, self.field.spacing == "piecewise"
        near, far = (spacing(end) if piecewise else end for end in (f.near, f.far))
        places = places * far + (1.0 - places) * near
        if not piecewise:
            return places
        return torch.where(places < 0.5, 2.0 * places, 1.0 / (2.0 - 2.0 * places.clamp(min=0.5)))

    @staticmethod
    def _positions(origin: Tensor, world: Tensor, distances: Tensor) -> Tensor:
        both = distances[:, :-1] + distances[:, 1:]
        return contracted(origin + world[:, None] * (both / 2.0)[..., None])

    @staticmethod
    def _next(places: Tensor, weights: Tensor, count: int) -> Tensor:
        """The places of the next round's edges."""
        padded = weights + HISTOGRAM_PADDING
        shares = torch.cumsum(padded / padded.sum(dim=-1, keepdim=True), dim=-1).clamp(max=1.0)
        shares = torch.cat([torch.zeros_like(shares[:, :1]), shares], dim=-1)
        wanted = torch.from_numpy(quantiles(count)).expand(len(shares), -1).contiguous()
        above = torch.searchsorted(shares.detach(), wanted, side="right").clamp(1, weights.shape[1])
        low, high = shares.gather(1, above - 1), shares.gather(1, above)
        part = ((wanted - low) / (high - low)).clamp(0.0, 1.0)
        start = places.gather(1, above - 1)
        return start + part * (places.gather(1, above) - start)
