"""Does real CUDA gsplat 1.4.0 stay inside the float32 abstract images?

Needs a CUDA GPU and gsplat 1.4.0. For each run: bounds of several sets of poses, then renders of random poses and
corners with ``gsplat.rasterization``, called as splatfacto.py:599-628 calls it, compared with tolerance zero.

    python benchmarks/cuda_gsplat.py RUN/config.yml ... [--poses 1000] [--downscale-factor 2] [--output-dir bench]

Result so far: not run, no machine with a GPU was at hand.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
from ns_abstract.bench.tables import markdown, write
from ns_abstract.bench.tightness import refine
from ns_abstract.geometry.camera_path import Camera
from ns_abstract.methods.splat.scene import SplatScene


class CudaRenderer:
    """A scene on the GPU.

    Args:
        scene: The parameters as stored.
        device: Where to render.
    """

    def __init__(self, scene: SplatScene, device: str = "cuda") -> None:
        def tensor(array: np.ndarray) -> torch.Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        self.device = device
        self.means, self.quats = tensor(scene.means), tensor(scene.quats)
        self.scales = torch.exp(tensor(scene.log_scales))
        self.opacities = torch.sigmoid(tensor(scene.opacity_logits))
        plain = scene.color_model == "sigmoid"
        self.colors = torch.sigmoid(tensor(scene.sh[:, 0])) if plain else tensor(scene.sh)
        # plain .ply and sh_degree > 0 runs both go through gsplat's spherical harmonics
        self.degree = None if plain else scene.sh_degree
        self.mode = scene.rasterize_mode
        self.background = tensor(scene.background)

    @torch.no_grad()
    def image(self, camera: Camera, camera_to_world: np.ndarray) -> np.ndarray:
        """[H, W, 3] float32 (splatfacto.py:128-143 and 599-628)."""
        from gsplat import rasterization

        pose = torch.tensor(camera_to_world, dtype=torch.float32, device=self.device)[None]
        rotation = pose[:, :3, :3] * torch.tensor([[[1.0, -1.0, -1.0]]], device=self.device)
        inverse = rotation.transpose(1, 2)
        view = torch.zeros(1, 4, 4, device=self.device)
        view[:, 3, 3] = 1.0
        view[:, :3, :3] = inverse
        view[:, :3, 3:4] = -torch.bmm(inverse, pose[:, :3, 3:4])
        intrinsics = torch.tensor(
            [[[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]],
            dtype=torch.float32,
            device=self.device,
        )
        render, alpha, _ = rasterization(
            means=self.means,
            quats=self.quats,
            scales=self.scales,
            opacities=self.opacities,
            colors=self.colors,
            viewmats=view,
            Ks=intrinsics,
            width=camera.width,
            height=camera.height,
            packed=False,
            near_plane=0.01,
            far_plane=1e10,
            render_mode="RGB+ED",
            sh_degree=self.degree,
            sparse_grad=False,
            absgrad=False,
            rasterize_mode=self.mode,
        )
        return torch.clamp(render[..., :3] + (1 - alpha) * self.background, 0.0, 1.0)[0].cpu().numpy()


def check(job: Any, name: str, frame: int, seconds: float, poses: int) -> dict[str, object]:
    """Bound one set and compare ``poses`` CUDA renders with it."""
    a_set = pose_set(job, name, frame)
    result = refine(job, a_set, frame, seconds, 1.0)
    renderer = CudaRenderer(splat_of(job).scene)
    corners = a_set.box.corners()[:64]
    values = np.concatenate([corners, a_set.box.sample(max(0, poses - len(corners)), np.random.default_rng(0))])
    violations, worst, compared = 0, 0.0, 0
    for value in values:
        image = renderer.image(a_set.camera, a_set.pose(value))
        # a value that is not a number is outside as well
        outside = ~((result.lower <= image) & (image <= result.upper))
        violations += int(outside.sum())
        compared += image.size
        beyond = np.nan_to_num(np.maximum(result.lower - image, image - result.upper), nan=np.inf)
        worst = max(worst, float(beyond.max()))
    return {
        "scene": job.method.name,
        "set": name,
        "size": f"{a_set.camera.width}x{a_set.camera.height}",
        "poses": len(values),
        "comparisons": compared,
        "violations": violations,
        "worst": worst,
    }


def main() -> int:
    """Run the comparison; 1 if something lies outside."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("load_config", type=Path, nargs="+")
    parser.add_argument("--sets", nargs="+", default=["x", "yaw", "roll", "six", "orbit"])
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--downscale-factor", type=float, default=1.0)
    parser.add_argument("--output-dir", type=Path, default=Path("bench"))
    options = parser.parse_args()
    if not torch.cuda.is_available():
        print("error: no CUDA GPU is available; nothing was compared", file=sys.stderr)
        return 2
    rows = []
    for job in open_jobs(tuple(options.load_config), None, options.downscale_factor):
        for name in options.sets:
            rows.append(check(job, name, options.frame, options.seconds, options.poses))
            print(markdown(rows[-1:]), flush=True)
    write(rows, options.output_dir, "cuda", "CUDA gsplat against the float32 bounds")
    return 1 if any(row["violations"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
