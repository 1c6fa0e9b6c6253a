"""The concrete renderer beside Open3D's Gaussian splats on software Vulkan, in one run.

Needs ``pip install open3d==0.20.0`` and a Vulkan driver; Mesa's llvmpipe (Debian: mesa-vulkan-drivers) is the one for
a machine without a GPU. Both programs draw the same poses in turn, so that they see the same machine; the first
pictures are not timed. Reading, sorting and uploading the scene is not timed either. Ours is float64 with gsplat's
rules; Open3D's is float32 with rules of its own, so the pictures agree only roughly: the mean difference is told.

    python benchmarks/open3d_render.py RUN/config.yml [--sizes 200 800] [--repeats 9] [--output-dir bench]
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
from ns_abstract.bench.tables import markdown, write
from ns_abstract.execution.threads import threads
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.write import write_ply


class Open3DRenderer:
    """A scene in Open3D's offscreen renderer."""

    def __init__(self, scene: SplatScene, camera: PinholeCamera) -> None:
        import open3d as o3d

        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "scene.ply"
            write_ply(scene, file)
            cloud = o3d.t.io.read_point_cloud(file)
        rendering = o3d.visualization.rendering
        self.renderer = rendering.OffscreenRenderer(camera.width, camera.height)
        self.renderer.scene.set_background(np.append(scene.background, 1.0).astype(np.float32))
        material = rendering.MaterialRecord()
        material.shader = "gaussianSplat"
        material.gaussian_splat_sh_degree = scene.sh_degree
        material.gaussian_splat_antialias = scene.rasterize_mode == "antialiased"
        self.renderer.scene.add_geometry("scene", cloud, material)
        self.camera = camera

    def image(self, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """[H, W, 3] uint8; ``rotation`` [3, 3] world to camera (OpenCV axes), ``position`` [3]."""
        camera, pose = self.camera, np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ position
        intrinsics = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        self.renderer.setup_camera(intrinsics, pose, camera.width, camera.height)
        return np.asarray(self.renderer.render_to_image())


def compare(config: Path, size: int, repeats: int, folder: Path) -> dict[str, Any]:
    """One row: seconds of both programs over the same poses, and how far their pictures are apart."""
    width = open_jobs((config,), None, 1.0)[0].path.cameras[0].width
    (job,) = open_jobs((config,), None, width / size)
    poses = pose_set(job, "x", 0)
    splat = splat_of(job)
    view = SplatFrame(splat.splats, splat.rasteriser, splat.arithmetic, poses)
    camera = view.camera
    theirs = Open3DRenderer(splat.scene, camera)
    low, high = np.array(poses.box.lower), np.array(poses.box.upper)
    seconds = np.empty((repeats, 2))
    difference = 0.0
    # the first pictures compile and upload
    for repeat in range(-2, repeats):
        values = low + (high - low) * ((repeat + 2.5) / (repeats + 2))
        rotation, position = poses.world_to_camera(values)
        start = time.perf_counter()
        ours = view.renderer.image(camera, rotation, position)
        middle = time.perf_counter()
        other = theirs.image(rotation, position)
        end = time.perf_counter()
        if repeat >= 0:
            seconds[repeat] = middle - start, end - middle
            difference += float(np.abs(ours - other / 255.0).mean()) / repeats
    from matplotlib.image import imsave

    imsave(folder / f"open3d-{camera.width}.png", np.clip(np.hstack([ours, other / 255.0]), 0.0, 1.0))
    median = np.median(seconds, axis=0)
    return {
        "scene": job.method.name,
        "size": f"{camera.width}x{camera.height}",
        "ours s": float(median[0]),
        "Open3D s": float(median[1]),
        "Open3D / ours": float(median[1] / median[0]),
        "least of the ratios": float((seconds[:, 1] / seconds[:, 0]).min()),
        "mean difference": difference,
    }


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("config", type=Path)
    parser.add_argument("--sizes", type=int, nargs="+", default=[200, 800])
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--output-dir", type=Path, default=Path("bench"))
    options = parser.parse_args()
    options.output_dir.mkdir(parents=True, exist_ok=True)
    rows = []
    for size in options.sizes:
        # Open3D's renderer can be opened once in a process
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            rows.append(pool.submit(compare, options.config, size, options.repeats, options.output_dir).result())
        print(markdown(rows), flush=True)
    write(rows, options.output_dir, "open3d", f"Beside Open3D, {threads()} threads")


if __name__ == "__main__":
    main()
