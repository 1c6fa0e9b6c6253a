"""The demo's NeRF: a buoy on a round float, an analytic field that a full-size network is fitted to."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ns_abstract.demo.nerf_fit import NerfNetwork, fit_field
from ns_abstract.geometry.views import View, look_at, path_json
from ns_abstract.methods.nerf.scene import NerfScene

#: Everything lies inside this distance of the origin.
REACH = 1.2
#: Steps of the fit: about a minute of one processor core.
STEPS = 500
BATCH = 1536
_DENSITY, _EDGE = 40.0, 0.05


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


def buoy_scene(steps: int = STEPS) -> NerfScene:
    """A NeRF of Nerfstudio's own size (8 x 256) fitted to the buoy."""
    torch.manual_seed(0)
    network = NerfNetwork()
    fit_field(network, buoy, REACH, steps, batch=BATCH)
    weights = network.weights()
    return NerfScene(weights, weights, background=np.array([1.0, 1.0, 1.0], np.float32), name="buoy")


def buoy_views(count: int = 8, size: int = 64) -> list[View]:
    """Views all around the buoy for the data set beside the run."""
    angles = 2.0 * np.pi * np.arange(count) / count
    eyes = [(3.2 * np.cos(a), 3.2 * np.sin(a), 1.2) for a in angles]
    return [View(look_at(eye, (0.0, 0.0, 0.1)), 40.0, size, size) for eye in eyes]


def buoy_path(size: int = 16) -> dict[str, Any]:
    """One small view of the buoy, and a yaw of 0.002 rad either way."""
    view = View(look_at((2.6, -1.8, 1.2), (0.0, 0.0, 0.1)), 40.0, size, size)
    return path_json([view], seconds=1.0, perturbation={"version": 1, "rotation": {"yaw": 0.002}})
