"""Train a small nerfacto on posed pictures by Nerfstudio itself, on a CPU, to a run folder.

    python benchmarks/train_nerfacto.py PICTURES.npz OUTPUT_DIR [--steps 2500 --rays 384] [--name lego] [--stock]

PICTURES.npz is that of `train_lego.py`, or ``buoy`` for pictures of the analytic buoy of `fit_buoy.py`. OUTPUT_DIR gets
a data set of Nerfstudio's (``data-NAME``) and a run of the method abstract-nerfacto; with ``--stock`` its model has
nerfacto's own sizes and losses instead, for comparison. Every eighth view is held back.

The demo's weights: ``train_nerfacto.py buoy OUT --name buoy --steps 1800 --levels 6 --max-res 128 --log2-table 14
--far 4 --weights ns_abstract/demo/buoy_nerfacto.npz``.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.io.atomic import write_atomic
from ns_abstract.methods.load import load_any

#: Half the side of the cube that holds the object: it becomes the part of space that is not contracted.
REACH = 1.25


def buoy_pictures(count: int = 64, side: int = 96) -> tuple[np.ndarray, np.ndarray, float]:
    """Premultiplied RGBA [N, H, W, 4], poses [N, 4, 4] and the focal length of views all around the buoy."""
    import torch
    from fit_buoy import buoy

    from ns_abstract.geometry.camera_path import PinholeCamera
    from ns_abstract.geometry.keyframe_cameras import look_at
    from ns_abstract.methods.nerf.render import camera_rays

    rng = np.random.default_rng(0)
    focal = 0.5 * side / math.tan(math.radians(20.0))
    steps = torch.linspace(1.8, 4.4, 161)
    middles, length = 0.5 * (steps[1:] + steps[:-1]), float(steps[1] - steps[0])
    grid = np.indices((side, side)).reshape(2, -1).T
    images, poses = [], []
    for k in range(count):
        angle, height = 2.399963 * k, rng.uniform(-0.4, 0.9)
        flat = math.sqrt(1.0 - height * height)
        eye = 3.1 * np.array([flat * math.cos(angle), flat * math.sin(angle), height])
        pose = np.eye(4)
        pose[:3] = look_at(tuple(eye), (0.0, 0.0, 0.1))[:3]
        camera = PinholeCamera(pose[:3], focal, focal, 0.5 * side, 0.5 * side, side, side)
        world = torch.nn.functional.normalize(
            torch.from_numpy(camera_rays(camera, grid) @ pose[:3, :3].T).float(), dim=1
        )
        points = torch.from_numpy(pose[:3, 3]).float() + middles[:, None] * world[:, None]
        density, color = buoy(points.reshape(-1, 3), world[:, None].expand(points.shape).reshape(-1, 3))
        depth = length * density.reshape(len(world), -1)
        weights = (1.0 - torch.exp(-depth)) * torch.exp(depth - torch.cumsum(depth, dim=1))
        rgb = (weights[..., None] * color.reshape(*weights.shape, 3)).sum(dim=1)
        rgba = torch.cat([rgb, weights.sum(dim=1, keepdim=True)], dim=1).numpy()
        images.append(np.rint(255.0 * rgba).astype(np.uint8).reshape(side, side, 4))
        poses.append(pose)
    return np.stack(images), np.stack(poses), focal


def read_pictures(file: str) -> tuple[np.ndarray, np.ndarray, float]:
    """What `buoy_pictures` returns, of a file."""
    with np.load(file, allow_pickle=False) as data:
        return data["images"], data["c2w"], float(data["focal"])


def write_data(pictures: tuple[np.ndarray, np.ndarray, float], folder: Path) -> Path:
    """Write transforms.json and pictures with straight alpha; returns the folder."""
    from PIL import Image

    images, poses, focal = pictures
    side = images.shape[1]
    (folder / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for k, (image, pose) in enumerate(zip(images, poses, strict=True)):
        name = f"images/{k:03d}.png"
        alpha = image[..., 3:].astype(np.float64)
        straight = np.divide(255.0 * image[..., :3], alpha, out=np.zeros(image[..., :3].shape), where=alpha > 0)
        colors = np.rint(np.clip(straight, 0.0, 255.0)).astype(np.uint8)
        Image.fromarray(np.concatenate([colors, image[..., 3:]], axis=-1)).save(folder / name)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    meta = {
        "camera_model": "OPENCV", "fl_x": focal, "fl_y": focal, "cx": side / 2, "cy": side / 2, "w": side, "h": side,
        "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def quantised(config: Path) -> dict[str, np.ndarray]:
    """The arrays of a run's fields: tables as int8 with a float32 scale by level, networks as float32."""
    field = load_any(config).field
    found: dict[str, np.ndarray] = {}
    encodings = {"field": field.encoding} | {f"proposal{k}": one.encoding for k, one in enumerate(field.proposals)}
    for name, encoding in encodings.items():
        scale = np.abs(encoding.table).max(axis=(1, 2), keepdims=True) / 127.0
        found[f"{name}.table"] = np.rint(encoding.table / scale).astype(np.int8)
        found[f"{name}.scale"], found[f"{name}.resolutions"] = scale.astype(np.float32), encoding.resolutions
    nets = {"density": field.density_net, "color": field.color_net}
    nets |= {f"proposal{k}": one.net for k, one in enumerate(field.proposals)}
    for name, net in nets.items():
        for k, (weight, bias) in enumerate(zip(net.weights, net.biases, strict=True)):
            found[f"{name}.{k}.weight"], found[f"{name}.{k}.bias"] = weight.astype(np.float32), bias.astype(np.float32)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures")
    parser.add_argument("output_dir", type=Path)
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--rays", type=int, default=512, help="of every step")
    parser.add_argument("--levels", type=int, help="of the field's grid")
    parser.add_argument("--max-res", type=int, help="the field's greatest resolution")
    parser.add_argument("--log2-table", type=int, help="rows of every level of the field's table, as a power of two")
    parser.add_argument("--name", default="lego")
    parser.add_argument("--stock", action="store_true", help="the sizes and losses of nerfacto")
    parser.add_argument("--weights", type=Path, help="where to write the fields' arrays, of 8 bits each")
    parser.add_argument("--far", type=float, default=5.0, help="end of the rays, in units of the object's cube")
    options = parser.parse_args()

    pictures = buoy_pictures() if options.pictures == "buoy" else read_pictures(options.pictures)
    from ns_abstract.nerfstudio.torchvision_operators import declare_missing

    declare_missing()
    from nerfstudio.models.nerfacto import NerfactoModelConfig

    from ns_abstract.nerfstudio.loading import lpips_weights
    from ns_abstract.nerfstudio.methods import abstract_nerfacto

    config: Any = copy.deepcopy(abstract_nerfacto.config)
    if options.stock:
        ours = config.pipeline.model
        config.pipeline.model = NerfactoModelConfig(
            implementation="torch", average_init_density=0.01, background_color=ours.background_color,
            camera_optimizer=ours.camera_optimizer, eval_num_rays_per_chunk=ours.eval_num_rays_per_chunk,
        )  # fmt: skip
    config.pipeline.model.far_plane = options.far
    given = {"num_levels": options.levels, "max_res": options.max_res, "log2_hashmap_size": options.log2_table}
    for name, value in given.items():
        if value is not None:
            setattr(config.pipeline.model, name, value)
    for arguments in config.pipeline.model.proposal_net_args_list:
        arguments["log2_hashmap_size"] = min(arguments["log2_hashmap_size"], config.pipeline.model.log2_hashmap_size)
    config.experiment_name, config.timestamp, config.output_dir = options.name, "trained", options.output_dir
    config.vis, config.machine.device_type = "tensorboard", "cpu"
    config.max_num_iterations, config.steps_per_save = options.steps, 250
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
    for one in config.optimizers.values():
        if one["scheduler"] is not None:
            one["scheduler"].max_steps = options.steps
    manager = config.pipeline.datamanager
    manager.train_num_rays_per_batch = options.rays
    manager.data = config.data = write_data(pictures, options.output_dir / f"data-{options.name}")
    parser_config = manager.dataparser
    parser_config.orientation_method = parser_config.center_method = "none"
    parser_config.auto_scale_poses, parser_config.scale_factor = False, 1.0 / REACH
    parser_config.eval_mode, parser_config.eval_interval = "interval", 8
    config.print_to_terminal()
    config.save_config()
    with lpips_weights(download=False):
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
    started = time.process_time()
    trainer.train()
    print(f"{options.steps} steps in {time.process_time() - started:.0f} s of processor time")
    pipeline = trainer.pipeline
    pipeline.eval()
    found = []
    for camera, batch in pipeline.datamanager.fixed_indices_eval_dataloader:
        shown = pipeline.model.get_outputs_for_camera(camera)["rgb"].numpy()
        truth = batch["image"].numpy()
        found.append(-10.0 * math.log10(np.square(shown - truth[..., :3] * truth[..., 3:]).mean()))
    print(f"held back, {len(found)} views on black: {np.mean(found):.2f} dB")
    file = config.get_base_dir() / "config.yml"
    if options.weights is not None:
        arrays: dict[str, Any] = quantised(file)
        write_atomic(options.weights, lambda stream: np.savez_compressed(stream, **arrays))
    print(f"run {file}")


if __name__ == "__main__":
    main()
