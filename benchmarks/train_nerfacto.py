"""Train a small nerfacto on posed pictures by Nerfstudio itself, on a CPU, to a run folder.

    python benchmarks/train_nerfacto.py PICTURES.npz OUTPUT_DIR [--steps 8000] [--name lego] [--stock]

PICTURES.npz is that of `train_lego.py`. OUTPUT_DIR gets a data set of Nerfstudio's (``data-NAME``) and the run of the
method abstract-nerfacto; with ``--stock`` the method's model has nerfacto's own sizes and losses instead, for
comparison. Every eighth view is held back.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import time
from pathlib import Path

import numpy as np

#: Half the side of the cube that holds the object: it becomes the part of space that is not contracted.
REACH = 1.25


def write_data(pictures: Path, folder: Path) -> Path:
    """Write transforms.json and pictures with straight alpha; returns the folder."""
    from PIL import Image

    with np.load(pictures, allow_pickle=False) as data:
        images, poses, focal = data["images"], data["c2w"], float(data["focal"])
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("output_dir", type=Path)
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--rays", type=int, default=512, help="of every step")
    parser.add_argument("--log2-table", type=int, help="rows of every level of the field's table, as a power of two")
    parser.add_argument("--name", default="lego")
    parser.add_argument("--stock", action="store_true", help="the sizes and losses of nerfacto")
    parser.add_argument("--far", type=float, default=5.0, help="end of the rays, in units of the object's cube")
    options = parser.parse_args()

    from ns_abstract.nerfstudio.torchvision_operators import declare_missing

    declare_missing()
    from nerfstudio.models.nerfacto import NerfactoModelConfig

    from ns_abstract.nerfstudio.loading import lpips_weights
    from ns_abstract.nerfstudio.methods import abstract_nerfacto

    config = copy.deepcopy(abstract_nerfacto.config)
    if options.stock:
        ours = config.pipeline.model
        config.pipeline.model = NerfactoModelConfig(
            implementation="torch", average_init_density=0.01, background_color=ours.background_color,
            camera_optimizer=ours.camera_optimizer, eval_num_rays_per_chunk=ours.eval_num_rays_per_chunk,
        )  # fmt: skip
    config.pipeline.model.far_plane = options.far
    if options.log2_table is not None:
        config.pipeline.model.log2_hashmap_size = options.log2_table
    config.experiment_name, config.timestamp, config.output_dir = options.name, "trained", options.output_dir
    config.vis, config.machine.device_type = "tensorboard", "cpu"
    config.max_num_iterations, config.steps_per_save = options.steps, 250
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
    for one in config.optimizers.values():
        if one["scheduler"] is not None:
            one["scheduler"].max_steps = options.steps
    manager = config.pipeline.datamanager
    manager.train_num_rays_per_batch = options.rays
    manager.data = config.data = write_data(options.pictures, options.output_dir / f"data-{options.name}")
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
    print(f"run {config.get_base_dir() / 'config.yml'}")


if __name__ == "__main__":
    main()
