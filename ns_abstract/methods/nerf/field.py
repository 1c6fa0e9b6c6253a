"""A field in torch: density and colour of points, as Nerfstudio evaluates them."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from ns_abstract.methods.nerf.scene import Encoding, FieldWeights, Layer


def encode(x: Tensor, encoding: Encoding) -> Tensor:
    """Return the encoding [..., size] of points ``x`` [..., 3] (``NeRFEncoding.pytorch_fwd``, then the input)."""
    frequencies = torch.from_numpy(encoding.frequencies).to(x)
    angles = ((2.0 * math.pi * x)[..., None] * frequencies).flatten(-2)
    return torch.cat([torch.sin(torch.cat([angles, angles + 0.5 * math.pi], dim=-1)), x], dim=-1)


class Field:
    """A field on one device. ``dtype``: of all arithmetic. The bounds are those of float64 and of real numbers."""

    def __init__(
        self, weights: FieldWeights, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
    ) -> None:
        self.weights = weights

        def put(layer: Layer) -> tuple[Tensor, Tensor]:
            return (torch.from_numpy(layer.weight).to(device, dtype), torch.from_numpy(layer.bias).to(device, dtype))

        self._base = [put(layer) for layer in weights.base]
        self._density, self._color = put(weights.density), put(weights.color)
        self._head = [put(layer) for layer in weights.head]

    def density(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return density [...] per unit of length of points ``x`` [..., 3], and the base's output [..., width]."""
        encoded = encode(x, self.weights.position)
        h = encoded
        for layer, (weight, bias) in zip(self.weights.base, self._base, strict=True):
            if layer.skip:
                h = torch.cat([encoded, h], dim=-1)
            h = functional.relu(functional.linear(h, weight, bias))
        return functional.softplus(functional.linear(h, *self._density))[..., 0], h

    def color(self, base: Tensor, direction: Tensor) -> Tensor:
        """Return RGB [..., 3] for the base's output [..., width] along ``direction`` [..., 3] (unit vectors)."""
        h = torch.cat([encode(direction, self.weights.direction), base], dim=-1)
        for weight, bias in self._head:
            h = functional.relu(functional.linear(h, weight, bias))
        return torch.sigmoid(functional.linear(h, *self._color))
