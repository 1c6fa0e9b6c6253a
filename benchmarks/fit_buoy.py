"""Fits the demo's NeRF to an analytic buoy and writes its weights, of 6 bits each: about a minute.

    python benchmarks/fit_buoy.py ns_abstract/demo/buoy.npz

`ns_abstract.demo.scenes.buoy_weights` reads the file.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from nerf_network import NerfNetwork
from torch import Tensor
from torch.nn import functional

from ns_abstract.io.atomic import write_atomic

#: Everything lies inside this distance of the origin.
REACH = 1.2
STEPS, BATCH = 500, 1536
_DENSITY, _EDGE = 40.0, 0.05
#: Density before the softplus that counts as empty in `fit_field`.
_CLEAR = -9.0
#: Radius of the space that is fitted as empty, relative to that of the object.
_FAR = 4.0
#: Largest quantised weight.
_LEVELS = 31

#: Points [n, 3] and unit directions [n, 3] to densities [n] and colours [n, 3].
AnalyticField = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def buoy(x: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Densities [n] and colours [n, 3] at points [n, 3] seen along unit ``direction`` [n, 3]."""
    flat = x[:, :2].norm(dim=1)
    height = x[:, 2]
    float_ = torch.hypot((flat - 0.55).clamp(min=0.0), (height + 0.35).abs()) - 0.16
    body = torch.hypot(
        (flat - 0.12 - 0.22 * (0.6 - height).clamp(0.0, 0.9)).clamp(min=0.0), (height - 0.15).abs() - 0.45
    )
    body = torch.where((height - 0.15).abs() < 0.45, flat - 0.12 - 0.22 * (0.6 - height), body) - 0.02
    lamp = (x - torch.tensor([0.0, 0.0, 0.78])).norm(dim=1) - 0.14
    nearest = torch.stack([float_, body, lamp])
    distance, part = nearest.min(dim=0)
    density = _DENSITY * torch.sigmoid(-distance / _EDGE * 4.0)
    stripes = torch.sigmoid(20.0 * torch.sin(9.0 * height))[:, None]
    red, white = torch.tensor([0.85, 0.12, 0.1]), torch.tensor([0.95, 0.95, 0.92])
    colors = torch.where((part == 0)[:, None], torch.tensor([0.15, 0.2, 0.35]), stripes * red + (1.0 - stripes) * white)
    colors = torch.where((part == 2)[:, None], torch.tensor([1.0, 0.85, 0.3]), colors)
    shade = 0.8 + 0.2 * (0.5 + 0.5 * (-direction @ torch.tensor([0.3, 0.2, 0.93])))
    return density, (colors * shade[:, None]).clamp(0.0, 1.0)


def fit_field(
    network: NerfNetwork,
    field: AnalyticField,
    radius: float,
    steps: int,
    *,
    batch: int = 2048,
    rate: float = 8e-4,
    seed: int = 0,
) -> None:
    """Fit a network to an analytic field over the ball of radius ``radius``, and more coarsely around it.

    Densities are compared before the softplus and squeezed, so that neither empty nor dense space dominates;
    colours where there is something.
    """
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=rate, eps=1e-8)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / 40) * 0.5 * (1.0 + math.cos(math.pi * step / steps)) + 1e-5
        x = torch.randn(batch, 3, generator=generator)
        # rays begin far outside of what there is to see
        around = torch.where(torch.arange(batch)[:, None] % 4 == 0, _FAR * radius, radius)
        x *= around * torch.rand(batch, 1, generator=generator).sqrt() / x.norm(dim=1, keepdim=True)
        direction = functional.normalize(torch.randn(batch, 3, generator=generator), dim=1)
        density, color = field(x, direction)
        raw, h = network.raw_density(x)
        target = torch.where(density > 20.0, density, torch.log(torch.expm1(density.clamp(1e-12, 30.0))))
        loss = functional.mse_loss(functional.softsign(raw / 4.0), functional.softsign(target.clamp(min=_CLEAR) / 4.0))
        opaque = (density > 0.5).float()[:, None]
        loss = loss + (opaque * (network.colors(h, direction) - color) ** 2).mean() / opaque.mean().clamp(min=0.01)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()


def quantised(network: NerfNetwork) -> dict[str, np.ndarray]:
    """The parameters by their names: weight matrices as int8 and a float32 scale for every row, others as float32."""
    found: dict[str, np.ndarray] = {}
    for name, value in network.state_dict().items():
        values = value.numpy()
        if values.ndim == 2:
            scale = np.abs(values).max(axis=1, keepdims=True) / _LEVELS
            found[f"{name}.scale"] = scale
            values = np.rint(values / scale).astype(np.int8)
        found[name] = values
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output_filename", type=Path)
    parser.add_argument("--steps", type=int, default=STEPS)
    options = parser.parse_args()
    torch.manual_seed(0)
    network = NerfNetwork()
    fit_field(network, buoy, REACH, options.steps, batch=BATCH)
    arrays = quantised(network)
    write_atomic(options.output_filename, lambda stream: np.savez_compressed(stream, **arrays))


if __name__ == "__main__":
    main()
