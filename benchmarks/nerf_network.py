"""NeRF networks in PyTorch, which `fit_buoy.py`, `objects.py` and `train_lego.py` train."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ns_abstract.methods.nerf.field import encode
from ns_abstract.methods.nerf.scene import Encoding, FieldWeights, Layer

POSITION = Encoding(10, 0.0, 8.0)
DIRECTION = Encoding(4, 0.0, 4.0)
#: Density before the softplus where training begins: nearly transparent.
_EMPTY = -3.0


class NerfNetwork(nn.Module):
    """The architecture of ``NeRFField`` with free sizes.

    The columns of high frequencies start small, in proportion to 1 / frequency: the network then learns coarse
    shapes first and stays as smooth as the data allow.

    Args:
        layers, width: Of the base.
        skip: Layer of the base that sees the encoding again; None: none does.
        head_layers, head_width: Of the colour head.
    """

    def __init__(
        self, layers: int = 8, width: int = 256, skip: int | None = 4, head_layers: int = 2, head_width: int = 128
    ) -> None:
        super().__init__()
        self.skip = skip
        inputs = [POSITION.size] + [width + (POSITION.size if i == skip else 0) for i in range(1, layers)]
        self.base = nn.ModuleList(nn.Linear(n, width) for n in inputs)
        self.density = nn.Linear(width, 1)
        heads = [width + DIRECTION.size, *[head_width] * (head_layers - 1)]
        self.head = nn.ModuleList(nn.Linear(n, head_width) for n in heads)
        self.color = nn.Linear(head_width, 3)
        with torch.no_grad():
            for layer in (*self.base, *self.head):
                nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")  # pyright: ignore
                nn.init.zeros_(layer.bias)  # pyright: ignore
            self.density.bias.fill_(_EMPTY)
            for k, encoding in ((0, POSITION), *(() if skip is None else ((skip, POSITION),))):
                damp = torch.from_numpy(1.0 / encoding.frequencies).float().repeat(6)
                self.base[k].weight[:, : damp.numel()] *= damp  # pyright: ignore
            damp = torch.from_numpy(1.0 / DIRECTION.frequencies).float().repeat(6)
            self.head[0].weight[:, : damp.numel()] *= damp  # pyright: ignore

    def raw_density(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Densities [...] before the softplus, and the base's output, of points [..., 3]."""
        encoded = encode(x, POSITION)
        h = encoded
        for i, layer in enumerate(self.base):
            h = functional.relu(layer(torch.cat([encoded, h], dim=-1) if i == self.skip else h))
        return self.density(h)[..., 0], h

    def colors(self, h: Tensor, direction: Tensor) -> Tensor:
        """Colours [..., 3] of the base's output seen along ``direction`` [..., 3]."""
        h = torch.cat([encode(direction, DIRECTION), h], dim=-1)
        for layer in self.head:
            h = functional.relu(layer(h))
        return torch.sigmoid(self.color(h))

    def weights(self) -> FieldWeights:
        """The parameters as plain arrays."""

        def plain(layer: nn.Module, skip: bool = False) -> Layer:
            arrays = (getattr(layer, name).detach().cpu().numpy() for name in ("weight", "bias"))
            weight, bias = (array.astype(np.float32) for array in arrays)
            return Layer(weight, bias, skip)

        return FieldWeights(
            tuple(plain(layer, i == self.skip) for i, layer in enumerate(self.base)),
            plain(self.density),
            tuple(plain(layer) for layer in self.head),
            plain(self.color),
            POSITION,
            DIRECTION,
        )
