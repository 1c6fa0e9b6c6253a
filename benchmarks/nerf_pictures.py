"""Pictures of a splat run for `train_lego.py`, by the CPU renderer: a NeRF of the same scene can be trained on them.

    python benchmarks/nerf_pictures.py RUN/config.yml CAMERA_PATH.json PICTURES.npz [--views 96 --side 64]
    python benchmarks/train_lego.py PICTURES.npz RUNS --name NAME --layers 4 --width 64 --skip 2 --head-width 32 \
        --reach 0.6 --frequencies 5 --background white --minutes 3

Views lie all around the target of the path's orbit, as far from it as the path's camera and at about its height.
Colour and opacity of a pixel come from renders on black and on white.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from ns_abstract.geometry.camera_path import PinholeCamera, load_camera_path
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.perturbation.specification import Perturbation, parse_perturbation

#: Radians above and below the path's camera; parts of the distance that it varies by.
_TILT, _NEAR = 0.35, 0.15


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("path", type=Path)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("--views", type=int, default=96)
    parser.add_argument("--side", type=int, default=64)
    options = parser.parse_args()
    scene, path = load_scene(options.run), load_camera_path(options.path)
    orbit = parse_perturbation(path.perturbations[0] or {}).orbit
    if orbit is None:
        raise SystemExit(f"{options.path}: perturbation.orbit: missing")
    renderers = []
    for color in (0.0, 1.0):
        shown = replace(scene, background=np.full(3, color, np.float32))
        renderers.append(Renderer(activate(shown, GSPLAT_1_4_0), GSPLAT_1_4_0))
    first, rng, side = path.cameras[0], np.random.default_rng(0), options.side
    focal = first.fy * side / first.height
    target, axis = np.array(orbit.target), np.array(orbit.axis) / np.linalg.norm(orbit.axis)
    up = axis if axis @ first.camera_to_world[:, 1] > 0.0 else -axis
    start = first.camera_to_world[:, 3] - target
    distance, height = np.linalg.norm(start), np.arcsin(start @ up / np.linalg.norm(start))
    flat = start - (start @ up) * up
    flat /= np.linalg.norm(flat)
    other = np.cross(up, flat)
    images, poses = [], []
    for k in range(options.views):
        angle = 2.0 * np.pi * k / options.views
        tilt, far = height + rng.uniform(-_TILT, _TILT), distance * (1.0 + rng.uniform(-_NEAR, _NEAR))
        out = np.cos(tilt) * (np.cos(angle) * flat + np.sin(angle) * other) + np.sin(tilt) * up
        pose = look_at(target + far * out, target, up)
        camera = PinholeCamera(pose[:3], focal, focal, 0.5 * side, 0.5 * side, side, side)
        matrices = PoseBox.around(camera, Perturbation()).world_to_camera(np.zeros(0))
        black, white = (renderer.image(camera, *matrices) for renderer in renderers)
        alpha = np.clip(1.0 - (white - black).mean(axis=-1, keepdims=True), 0.0, 1.0)
        images.append(np.round(255.0 * np.concatenate([np.minimum(black, alpha), alpha], axis=-1)).astype(np.uint8))
        poses.append(pose)
    np.savez_compressed(
        options.pictures, images=np.stack(images), c2w=np.stack(poses), focal=focal, near=0.3 * distance,
        far=2.0 * distance,
    )  # fmt: skip


if __name__ == "__main__":
    main()
