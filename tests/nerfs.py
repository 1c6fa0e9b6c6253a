"""Small NeRFs, sets of poses and dense samples that the tests of NeRF bounds share."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from benchmark_scripts import script
from torch.nn import functional

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.nerf.field import Field, encode
from ns_abstract.methods.nerf.ray_field import RayBounds
from ns_abstract.methods.nerf.render import NerfRenderer, Sampling
from ns_abstract.methods.nerf.scene import FieldWeights, Layer, NerfScene
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import nerf_renderer

NerfNetwork = script("nerf_network").NerfNetwork
UNIFORM = Sampling("uniform", 0.0, 4.0, 24, 0, (0.2, 0.6, 1.0))
BINS = dataclasses.replace(UNIFORM, kind="hierarchical", samples=32, importance=40)


def tiny_weights(
    seed: int = 0, *, density: float = 8.0, rough: float = 1.0, color: float = 4.0, layers: int = 3
) -> FieldWeights:
    """A random field of ``layers`` x 16 with a skip, empty in three quarters of the space about the origin.

    ``density`` is the standard deviation of the density before its softplus, ``rough`` scales the waves of the
    encoding and ``color`` the last layer of the colours.
    """
    torch.manual_seed(seed)
    found = NerfNetwork(layers, 16, 1, 2, 8).weights()

    def scaled(layer: Layer, by: float, columns: slice = slice(None)) -> Layer:
        weight = layer.weight.copy()
        weight[:, columns] *= by
        return Layer(weight, layer.bias, layer.skip)

    found = dataclasses.replace(
        found,
        base=tuple(scaled(layer, rough, slice(0, 60)) if i in (0, 1) else layer for i, layer in enumerate(found.base)),
        density=dataclasses.replace(found.density, bias=np.zeros(1, np.float32)),
        color=scaled(found.color, color),
    )
    x = 1.2 * (2.0 * torch.rand(4000, 3, dtype=torch.float64) - 1.0)
    raw = raw_outputs(found, x, x)[0]
    by = density / float(raw.std())
    bias = np.full(1, -by * float(raw.quantile(0.75)), np.float32)
    return dataclasses.replace(found, density=Layer(scaled(found.density, by).weight, bias))


def tiny_scene(seed: int = 0, **changes: float) -> NerfScene:
    weights = tiny_weights(seed, **changes)
    return NerfScene(weights, tiny_weights(seed + 100, **changes), 0.0, 4.0, name="tiny")


def view(width: int = 4, height: int = 3) -> PinholeCamera:
    pose = look_at((1.6, 0.4, 0.5), (0.0, 0.0, 0.0))[:3]
    return PinholeCamera(pose, 5.0, 5.0, 0.5 * width, 0.5 * height, width, height)


def other_view(width: int = 4, height: int = 3) -> PinholeCamera:
    pose = look_at((1.5, 0.6, 0.3), (0.1, 0.0, 0.0))[:3]
    return PinholeCamera(pose, 5.0, 5.0, 0.5 * width, 0.5 * height, width, height)


def poses(spec: dict, camera: PinholeCamera | None = None) -> PoseBox:
    """The set of ``spec`` around `view`, towards `other_view` where the sweep is over segments."""
    return PoseBox.around(camera or view(), parse_perturbation(spec), other_view())


def pixels_of(camera: PinholeCamera) -> np.ndarray:
    return np.stack(np.mgrid[: camera.height, : camera.width], axis=-1).reshape(-1, 2)


def images(scene: NerfScene, pose_set: PoseBox, values: np.ndarray, sampling: Sampling = UNIFORM) -> np.ndarray:
    """[n, pixels, 3] concrete renders at ``values`` [n, d]."""
    renderer = NerfRenderer(scene, sampling)
    grid = pixels_of(pose_set.camera)
    return np.stack([renderer.pixels(pose_set.camera, pose_set.pose(v), grid) for v in values])


def raw_outputs(weights: FieldWeights, x: torch.Tensor, direction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Density before the softplus [...] and colours before the sigmoid [..., 3], in float64."""
    field = Field(weights)
    encoded = encode(x, weights.position)
    h = encoded
    for layer, (weight, bias) in zip(weights.base, field._base, strict=True):
        h = functional.relu(functional.linear(torch.cat([encoded, h], -1) if layer.skip else h, weight, bias))
    density = functional.linear(h, *field._density)[..., 0]
    h = torch.cat([encode(direction, weights.direction), h], -1)
    for weight, bias in field._head:
        h = functional.relu(functional.linear(h, weight, bias))
    return density, functional.linear(h, *field._color)


def attack_first_rays(scene: NerfScene, pose_set: PoseBox, found: RayBounds) -> tuple[int, int]:
    """Comparisons and violations of bounds of the first rays, sampled as `BINS` says.

    By random poses, corners, gradient ascent and jumps, of a picture of these rays alone where they are of one row.
    """
    camera, count = pose_set.camera, len(found.lower)
    width, height = min(count, camera.width), -(-count // camera.width)
    shown = dataclasses.replace(pose_set, camera=dataclasses.replace(camera, width=width, height=height))
    lower, upper = np.zeros((height * width, 3)), np.ones((height * width, 3))
    lower[:count], upper[:count] = found.lower, found.upper
    shape = (height, width, 3)
    render, probe, twin = nerf_renderer(scene, shown, BINS)
    result = falsify(
        lower.reshape(shape), upper.reshape(shape), pose_set.box, render, twin, probe=probe, poses=40, seed=1
    )
    return result.comparisons, result.violations
