"""Train a vanilla NeRF on posed pictures, on a CPU, to a run folder that Nerfstudio and ns-abstract-render open.

    python benchmarks/train_lego.py PICTURES.npz OUTPUT_DIR [--layers 4 --width 128 --skip 2] [--minutes 30]
                                    [--reach 1.4] [--frequencies 5] [--background white]

PICTURES.npz holds ``images`` [N, H, W, 4] (premultiplied RGBA, uint8), ``c2w`` [N, 4, 4] (OpenGL), ``focal``
(pixels), ``near`` and ``far``. Every eighth view is held back. Where some view sees nothing, the space is empty
(visual hull): most of the work is spent inside. The coarse and the fine field are the same network, trained at
uniform, jittered samples on black, opacities besides.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from nerf_network import NerfNetwork
from torch.nn import functional

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.methods.nerf.render import NerfRenderer, Sampling, camera_rays
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.nerfstudio.nerf import log_lipschitz

HULL = 96
BINS = 96
FREE_POINTS = 1024


def hull(images: np.ndarray, poses: np.ndarray, focal: float, reach: float) -> torch.Tensor:
    """[HULL, HULL, HULL] whether a voxel (two of margin) shows in every view."""
    axis = (np.arange(HULL) + 0.5) / HULL * 2.0 * reach - reach
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.ones(len(points), bool)
    height, width = images.shape[1:3]
    for image, pose in zip(images, poses, strict=True):
        alpha = torch.from_numpy(image[..., 3].astype(np.float32) / 255.0)[None, None]
        alpha = functional.max_pool2d(alpha, 3, 1, 1)[0, 0].numpy()
        x, y, z = pose[:3, :3].T @ (points - pose[:3, 3]).T
        column = np.clip((0.5 * width - focal * x / z).astype(int), 0, width - 1)
        row = np.clip((0.5 * height + focal * y / z).astype(int), 0, height - 1)
        inside &= alpha[row, column] > 0.02
    grid = torch.from_numpy(inside.reshape(1, 1, HULL, HULL, HULL).astype(np.float32))
    return functional.max_pool3d(grid, 3, 1, 1)[0, 0] > 0


def camera(pose: np.ndarray, focal: float, side: int) -> PinholeCamera:
    return PinholeCamera(pose[:3].astype(np.float64), focal, focal, 0.5 * side, 0.5 * side, side, side)


def psnr(scene: NerfScene, far: float, images: np.ndarray, poses: np.ndarray, focal: float) -> float:
    """Mean PSNR (dB) of held-back views on black at uniform samples from 0 to ``far``."""
    renderer = NerfRenderer(scene, Sampling("uniform", 0.0, far, BINS, 0, (0.0, 0.0, 0.0)), torch.float32)
    found = []
    for image, pose in zip(images, poses, strict=True):
        shown = renderer.image(camera(pose, focal, image.shape[0]), pose[:3])
        found.append(-10.0 * math.log10(np.square(shown - image[..., :3] / 255.0).mean()))
    return float(np.mean(found))


def drop_waves(network: NerfNetwork, columns: torch.Tensor) -> None:
    """Make a network blind to waves of the encoded position."""
    with torch.no_grad():
        for k, layer in enumerate(network.base):
            if k in (0, network.skip):
                layer.weight[:, columns] = 0.0  # pyright: ignore


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("pictures", type=Path)
    parser.add_argument("output_dir", type=Path)
    parser.add_argument("--layers", type=int, default=8)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--skip", type=int, help="layer that the position is given to again; default: half of them")
    parser.add_argument("--head-width", type=int, default=128)
    parser.add_argument("--minutes", type=float, default=30.0, help="of processor time")
    parser.add_argument("--smoothness-penalty", type=float, default=0.0, help="of abstract-nerf (design.md, W5)")
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--reach", type=float, default=1.4, help="half the side of the cube that is looked at")
    parser.add_argument("--frequencies", type=int, default=10, help="of positions that are used, of 10")
    parser.add_argument("--background", choices=("black", "white"), default="black", help="of the run")
    parser.add_argument("--name", default="lego")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args()
    torch.manual_seed(0)
    with np.load(options.pictures, allow_pickle=False) as data:
        images, poses = data["images"], data["c2w"]
        focal, near, far = (float(data[name]) for name in ("focal", "near", "far"))
    skip = options.layers // 2 if options.skip is None else options.skip
    held = np.arange(len(images)) % 8 == 0
    side, device = images.shape[1], options.device
    reach = options.reach
    occupied = hull(images[~held], poses[~held], focal, reach).to(device)
    print(f"visual hull: {float(occupied.float().mean()):.1%} of the cube", flush=True)
    grid = np.stack(np.mgrid[:side, :side], axis=-1).reshape(-1, 2)
    rays = camera_rays(camera(poses[0], focal, side), grid)
    directions = np.stack([rays @ pose[:3, :3].T for pose in poses[~held]])
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    origins = np.repeat(poses[~held, None, :3, 3], len(grid), axis=1)
    colors = images[~held].reshape(len(directions), -1, 4) / 255.0
    d, o, c = (torch.from_numpy(a.reshape(-1, a.shape[-1])).float().to(device) for a in (directions, origins, colors))
    bright = torch.nonzero(torch.from_numpy(images[~held].reshape(-1, 4)[:, 3] > 0)).ravel()
    network = NerfNetwork(options.layers, options.width, skip, 2, options.head_width).to(device)
    unused = (torch.arange(60) % 10 >= options.frequencies).nonzero().ravel().to(device)
    drop_waves(network, unused)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3, eps=1e-8)
    length = (far - near) / BINS
    started, limit, step, share, shown = time.process_time(), 60.0 * options.minutes, 0, 0.0, 0.0

    def scene() -> NerfScene:
        weights = network.weights()
        return NerfScene(weights, weights, 0.0, far, background=np.zeros(3, np.float32), name=options.name)

    while share < 1.0:
        share = (time.process_time() - started) / limit
        for group in optimizer.param_groups:
            group["lr"] = 1.5e-3 * 0.02 ** min(1.0, share) * min(1.0, (step + 1) / 200)
        some = bright[torch.randint(bright.numel(), (options.rays * 3 // 4,))]
        which = torch.cat([some, torch.randint(d.shape[0], (options.rays - some.numel(),))]).to(device)
        t = near + (torch.arange(BINS, device=device) + torch.rand(which.numel(), BINS, device=device)) * length
        x = o[which, None] + t[..., None] * d[which, None]
        voxel = ((x + reach) / (2.0 * reach) * HULL).long()
        valid = ((voxel >= 0) & (voxel < HULL)).all(dim=-1)
        a, b, e = voxel.clamp(0, HULL - 1).unbind(-1)
        valid = valid & occupied[a, b, e]
        raw, h = network.raw_density(x[valid])
        density = torch.zeros_like(t)
        density[valid] = functional.softplus(raw)
        depth = density * length
        weight = (1.0 - torch.exp(-depth)) * torch.exp(depth - torch.cumsum(depth, dim=1))
        seen = weight[valid] > 1e-4
        color = torch.zeros(*t.shape, 3, device=device)
        place = torch.nonzero(valid)[seen]
        along = d[which[place[:, 0]]]
        color[place[:, 0], place[:, 1]] = network.colors(h[seen], along)
        shown_colors = torch.cat([(weight[..., None] * color).sum(dim=1), weight.sum(dim=1, keepdim=True)], dim=1)
        loss = functional.mse_loss(shown_colors, c[which])
        # space outside the hull, which rays of any view may cross, is empty
        which = which[torch.randint(which.numel(), (FREE_POINTS,), device=device)]
        free = o[which] + far * torch.rand(FREE_POINTS, 1, device=device) * d[which]
        voxel = ((free + reach) / (2.0 * reach) * HULL).long()
        a, b, e = voxel.clamp(0, HULL - 1).unbind(-1)
        free = free[~(occupied[a, b, e] & ((voxel >= 0) & (voxel < HULL)).all(dim=-1))]
        loss = loss + 1e-2 * functional.relu(network.raw_density(free)[0] + 8.0).mean()
        if options.smoothness_penalty > 0.0:
            loss = loss + options.smoothness_penalty * log_lipschitz(network)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        drop_waves(network, unused)
        step += 1
        if share > shown + 0.1 or share >= 1.0:
            shown = share
            quality = psnr(scene(), far, images[held][:3], poses[held][:3], focal)
            print(f"{share:4.0%} step {step}: loss {float(loss.detach()):.5f}, held back {quality:.2f} dB", flush=True)
    final = replace(scene(), background=np.full(3, float(options.background == "white"), np.float32))
    print(f"held back, all {int(held.sum())} views: {psnr(scene(), far, images[held], poses[held], focal):.2f} dB")
    config = write_nerf_run(final, options.output_dir, timestamp="trained", experiment_name=options.name)
    print(f"run {config}")


if __name__ == "__main__":
    main()
