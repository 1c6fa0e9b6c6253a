"""Writes a splat scene as a run folder in Nerfstudio's own format, without importing Nerfstudio.

The result is what ``ns-train splatfacto`` of Nerfstudio 1.1.5 leaves behind, so that ``ns-viewer`` and
``ns-render`` open it as well. Nerfstudio takes relative paths from the working directory: start its
commands in the folder given to ``write_splatfacto_run``. The whole folder can be moved.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ns_abstract.atomic import write_atomic
from ns_abstract.demo.paths import View, dataset_views
from ns_abstract.errors import InputError
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.splat.scene import SplatScene

STEP = 29999  # the last of Splatfacto's 30,000 steps
_REST_BANDS = 15  # features_rest of SH degree 3

# Shapes of the LPIPS metric that a Splatfacto checkpoint carries; rendering does not use them.
_LPIPS = {
    "net.slice1.0": (64, 3, 11, 11),
    "net.slice2.3": (192, 64, 5, 5),
    "net.slice3.6": (384, 192, 3, 3),
    "net.slice4.8": (256, 384, 3, 3),
    "net.slice5.10": (256, 256, 3, 3),
}
_LPIPS_HEADS = (64, 192, 384, 256, 256)

_LEARNING_RATES = {
    "means": 0.00016,
    "scales": 0.005,
    "quats": 0.001,
    "features_dc": 0.0025,
    "features_rest": 0.000125,
    "opacities": 0.05,
}


def write_splatfacto_run(
    scene: SplatScene,
    folder: str | Path,
    *,
    timestamp: str,
    experiment_name: str,
    views: Sequence[View] | None = None,
    render: Callable[[View], ArrayLike] | None = None,
) -> Path:
    """Write ``scene`` as a Splatfacto run, and a small data set beside it.

    Files: ``FOLDER/EXPERIMENT/splatfacto/TIMESTAMP/{config.yml, dataparser_transforms.json,
    nerfstudio_models/step-000029999.ckpt}`` and ``FOLDER/data/{transforms.json, images/*.png}``.
    Every file is replaced as a whole and config.yml comes last, so a run with a config is complete.
    Nerfstudio builds its pipeline from the data set; the Gaussians come from the checkpoint alone.

    Args:
        scene: SH is stored padded with zeros to degree 3.
        folder: Nerfstudio's working directory for this run; made if missing.
        timestamp: Name of the run, as in "2026-11-21_120000".
        experiment_name: Name of the experiment.
        views: Cameras of the data set, normalised frame, at least two of one size and field of view.
        render: Gives the image [H, W, 3] in [0, 1] of a view; without it the images hold only the
            background colour.

    Returns:
        The path of config.yml.

    Raises:
        InputError: ``timestamp`` or ``experiment_name`` is not a plain folder name.
    """
    folder = Path(folder)
    run = run_folder(folder, "splatfacto", timestamp, experiment_name)
    write_dataset(scene, folder / "data", dataset_views() if views is None else views, render)
    transform = {"transform": scene.dataparser.matrix.tolist(), "scale": float(scene.dataparser.scale)}
    write_file(run / "dataparser_transforms.json", json.dumps(transform, indent=4).encode())
    # Nerfstudio reads the step out of every name in nerfstudio_models: nothing else may stand there.
    checkpoint = run / "nerfstudio_models" / f"step-{STEP:09d}.ckpt"
    write_file(checkpoint, _checkpoint_bytes(scene), scratch=run)
    config = run / "config.yml"
    write_file(config, _config_text(scene, timestamp, experiment_name).encode())
    return config


def run_folder(folder: Path, method: str, timestamp: str, experiment_name: str) -> Path:
    """Make the folder of a run.

    Raises:
        InputError: ``timestamp`` or ``experiment_name`` is not a plain folder name.
    """
    for field, value in (("timestamp", timestamp), ("experiment_name", experiment_name)):
        if not value or value in {".", ".."} or any(c in value for c in "/\\\0\n"):
            raise InputError(
                f"{value!r} is not a folder name", fix="use letters, digits, _ and -", field=field
            )
    run = folder / experiment_name / method / timestamp
    run.mkdir(parents=True, exist_ok=True)
    return run


def write_file(file: Path, data: bytes, *, scratch: Path | None = None) -> None:
    """Write a file as a whole, in a folder that is made if missing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(file, lambda stream: stream.write(data), scratch=scratch)


def _config_text(scene: SplatScene, timestamp: str, experiment_name: str) -> str:
    # JSON strings and lists are YAML as well, and keep a name made of digits a string.
    return _CONFIG.substitute(
        experiment=json.dumps(experiment_name),
        timestamp=json.dumps(timestamp),
        count=scene.count,
        background=background_name(scene.background),
        mode=scene.rasterize_mode,
        degree=3 if scene.color_model == "sh" else 0,
    )


def background_name(colour: NDArray[np.float32]) -> str:
    """Nerfstudio's name of a colour, or a list where it has none ("random" renders as a fixed grey)."""
    names = {"white": (1, 1, 1), "black": (0, 0, 0), "random": (0.1490, 0.1647, 0.2157)}
    for name, value in names.items():
        if np.array_equal(colour, np.asarray(value, np.float32)):
            return name
    return json.dumps([float(c) for c in colour])


def lpips_state(prefix: str) -> dict[str, Any]:
    """Zeros in place of the LPIPS metric's tensors, whose names begin with ``prefix``."""
    import torch

    def zeros(*shape: int) -> torch.Tensor:
        # One stored number stands for all.
        return torch.zeros(1).expand(shape)

    state = {}
    for name, shape in _LPIPS.items():
        state[f"{prefix}{name}.weight"] = zeros(*shape)
        state[f"{prefix}{name}.bias"] = zeros(shape[0])
    for kind in ("lin", "lins."):
        for i, channels in enumerate(_LPIPS_HEADS):
            state[f"{prefix}{kind}{i}.model.1.weight"] = zeros(1, channels, 1, 1)
    return state


def _checkpoint_bytes(scene: SplatScene) -> bytes:
    """A checkpoint of plain tensors, numbers, lists and dictionaries: loads with weights_only."""
    import torch

    n = scene.count
    rest = np.zeros((n, _REST_BANDS if scene.color_model == "sh" else 0, 3), np.float32)
    rest[:, : scene.sh.shape[1] - 1] = scene.sh[:, 1:]
    gaussians = {
        "features_dc": scene.sh[:, 0],
        "features_rest": rest,
        "means": scene.means,
        "opacities": scene.opacity_logits[:, None],
        "quats": scene.quats,
        "scales": scene.log_scales,
    }

    pipeline: dict[str, torch.Tensor] = {"_model.device_indicator_param": torch.empty(0)}
    for name, value in gaussians.items():
        pipeline[f"_model.gauss_params.{name}"] = torch.from_numpy(np.array(value, np.float32))
    pipeline |= lpips_state("_model.lpips.net.")

    state = {
        "step": STEP,
        "pipeline": pipeline,
        "optimizers": {name: _adam_state(name, rate) for name, rate in _LEARNING_RATES.items()},
        "schedulers": {"means": _scheduler_state(_LEARNING_RATES["means"])},
        "scalers": {},
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def _adam_state(name: str, rate: float) -> dict[str, Any]:
    group: dict[str, Any] = {
        "lr": rate,
        "betas": (0.9, 0.999),
        "eps": 1e-15,
        "weight_decay": 0,
        "amsgrad": False,
        "maximize": False,
        "foreach": None,
        "capturable": False,
        "differentiable": False,
        "fused": None,
        "decoupled_weight_decay": False,
        "params": [0],
    }
    if name == "means":
        group["initial_lr"] = rate
    return {"state": {}, "param_groups": [group]}


def _scheduler_state(rate: float) -> dict[str, Any]:
    return {
        "base_lrs": [rate],
        "last_epoch": 0,
        "_step_count": 1,
        "_is_initial": False,
        "_get_lr_called_within_step": False,
        "_last_lr": [rate],
        "lr_lambdas": [None],
    }


def write_dataset(
    scene: SplatScene | NerfScene, folder: Path, views: Sequence[View], render: Callable[[View], ArrayLike] | None
) -> None:
    """Write transforms.json and one PNG per view; poses are stored in the normalised frame."""
    if len(views) < 2 or any(
        (v.height, v.width, v.fov) != (views[0].height, views[0].width, views[0].fov) for v in views
    ):
        raise ValueError("views: at least two of one size and field of view are needed")
    height, width = views[0].height, views[0].width
    focal = 0.5 * height / np.tan(0.5 * np.deg2rad(views[0].fov))
    frames = []
    for k, view in enumerate(views):
        name = f"images/{k:03d}.png"
        if render is None:
            image = np.broadcast_to(scene.background, (height, width, 3))
        else:
            image = np.asarray(render(view), np.float64)
        write_file(folder / name, _png(image))
        frames.append({"file_path": name, "transform_matrix": view.camera_to_world.tolist()})
    meta: dict[str, Any] = {
        "camera_model": "OPENCV",
        "fl_x": float(focal),
        "fl_y": float(focal),
        "cx": 0.5 * width,
        "cy": 0.5 * height,
        "w": width,
        "h": height,
        "k1": 0,
        "k2": 0,
        "p1": 0,
        "p2": 0,
    }
    identity = np.array_equal(scene.dataparser.matrix, np.eye(3, 4)) and scene.dataparser.scale == 1.0
    if not identity:
        # Nerfstudio composes these into the transform that it would write itself.
        meta["applied_transform"] = scene.dataparser.matrix.tolist()
        meta["applied_scale"] = float(scene.dataparser.scale)
    meta["frames"] = frames
    write_file(folder / "transforms.json", json.dumps(meta, indent=1).encode())


def _png(image: NDArray[Any]) -> bytes:
    """An 8-bit RGB PNG of [H, W, 3] values in [0, 1]."""
    pixels = np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    height, width, _ = pixels.shape
    rows = np.zeros((height, 1 + 3 * width), np.uint8)  # a leading 0 per row: no filter
    rows[:, 1:] = pixels.reshape(height, -1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6))
        + chunk(b"IEND", b"")
    )


# config.yml of a run: the Python tags are those by which Nerfstudio rebuilds its configuration.
_CONFIG = Template(
    """\
!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: !!python/name:nerfstudio.engine.trainer.Trainer ''
data: &id003 !!python/object/apply:pathlib.PosixPath
- data
experiment_name: $experiment
gradient_accumulation_steps: {}
load_checkpoint: null
load_config: null
load_dir: null
load_scheduler: true
load_step: null
log_gradients: false
logging: !!python/object:nerfstudio.configs.base_config.LoggingConfig
  local_writer: !!python/object:nerfstudio.configs.base_config.LocalWriterConfig
    _target: !!python/name:nerfstudio.utils.writer.LocalWriter ''
    enable: true
    max_log_size: 10
    stats_to_track: !!python/tuple
    - !!python/object/apply:nerfstudio.utils.writer.EventName
      - Train Iter (time)
    - !!python/object/apply:nerfstudio.utils.writer.EventName
      - Train Rays / Sec
    - !!python/object/apply:nerfstudio.utils.writer.EventName
      - Test PSNR
    - !!python/object/apply:nerfstudio.utils.writer.EventName
      - Vis Rays / Sec
    - !!python/object/apply:nerfstudio.utils.writer.EventName
      - Test Rays / Sec
    - !!python/object/apply:nerfstudio.utils.writer.EventName
      - ETA (time)
  max_buffer_size: 20
  profiler: basic
  relative_log_dir: !!python/object/apply:pathlib.PosixPath []
  steps_per_log: 10
machine: !!python/object:nerfstudio.configs.base_config.MachineConfig
  device_type: cpu
  dist_url: auto
  machine_rank: 0
  num_devices: 1
  num_machines: 1
  seed: 42
max_num_iterations: 30000
method_name: splatfacto
mixed_precision: false
optimizers:
  bilateral_grid:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: &id001 !!python/name:torch.optim.adam.Adam ''
      eps: 1.0e-15
      lr: 0.002
      max_norm: null
      weight_decay: 0
    scheduler: !!python/object:nerfstudio.engine.schedulers.ExponentialDecaySchedulerConfig
      _target: &id002 !!python/name:nerfstudio.engine.schedulers.ExponentialDecayScheduler ''
      lr_final: 0.0001
      lr_pre_warmup: 0
      max_steps: 30000
      ramp: cosine
      warmup_steps: 1000
  camera_opt:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: *id001
      eps: 1.0e-15
      lr: 0.0001
      max_norm: null
      weight_decay: 0
    scheduler: !!python/object:nerfstudio.engine.schedulers.ExponentialDecaySchedulerConfig
      _target: *id002
      lr_final: 5.0e-07
      lr_pre_warmup: 0
      max_steps: 30000
      ramp: cosine
      warmup_steps: 1000
  features_dc:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: *id001
      eps: 1.0e-15
      lr: 0.0025
      max_norm: null
      weight_decay: 0
    scheduler: null
  features_rest:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: *id001
      eps: 1.0e-15
      lr: 0.000125
      max_norm: null
      weight_decay: 0
    scheduler: null
  means:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: *id001
      eps: 1.0e-15
      lr: 0.00016
      max_norm: null
      weight_decay: 0
    scheduler: !!python/object:nerfstudio.engine.schedulers.ExponentialDecaySchedulerConfig
      _target: *id002
      lr_final: 1.6e-06
      lr_pre_warmup: 1.0e-08
      max_steps: 30000
      ramp: cosine
      warmup_steps: 0
  opacities:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: *id001
      eps: 1.0e-15
      lr: 0.05
      max_norm: null
      weight_decay: 0
    scheduler: null
  quats:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: *id001
      eps: 1.0e-15
      lr: 0.001
      max_norm: null
      weight_decay: 0
    scheduler: null
  scales:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: *id001
      eps: 1.0e-15
      lr: 0.005
      max_norm: null
      weight_decay: 0
    scheduler: null
output_dir: !!python/object/apply:pathlib.PosixPath []
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  _target: !!python/name:nerfstudio.pipelines.base_pipeline.VanillaPipeline ''
  datamanager: !!python/object:nerfstudio.data.datamanagers.full_images_datamanager.FullImageDatamanagerConfig
    _target: !!python/name:nerfstudio.data.datamanagers.full_images_datamanager.FullImageDatamanager ''
    cache_images: cpu
    cache_images_type: uint8
    camera_res_scale_factor: 1.0
    data: *id003
    dataparser: !!python/object:nerfstudio.data.dataparsers.nerfstudio_dataparser.NerfstudioDataParserConfig
      _target: !!python/name:nerfstudio.data.dataparsers.nerfstudio_dataparser.Nerfstudio ''
      auto_scale_poses: false
      center_method: none
      data: *id003
      depth_unit_scale_factor: 0.001
      downscale_factor: null
      eval_interval: 8
      eval_mode: interval
      load_3D_points: false
      mask_color: null
      orientation_method: none
      scale_factor: 1.0
      scene_scale: 1.0
      train_split_fraction: 0.9
    eval_image_indices: !!python/tuple
    - 0
    eval_num_images_to_sample_from: -1
    eval_num_times_to_repeat_images: -1
    fps_reset_every: 100
    images_on_gpu: false
    masks_on_gpu: false
    max_thread_workers: null
    train_cameras_sampling_seed: 42
    train_cameras_sampling_strategy: random
  model: !!python/object:nerfstudio.models.splatfacto.SplatfactoModelConfig
    _target: !!python/name:nerfstudio.models.splatfacto.SplatfactoModel ''
    background_color: $background
    camera_optimizer: !!python/object:nerfstudio.cameras.camera_optimizers.CameraOptimizerConfig
      _target: !!python/name:nerfstudio.cameras.camera_optimizers.CameraOptimizer ''
      mode: 'off'
      optimizer: null
      rot_l2_penalty: 0.001
      scheduler: null
      trans_l2_penalty: 0.01
    collider_params:
      far_plane: 6.0
      near_plane: 2.0
    color_corrected_metrics: false
    cull_alpha_thresh: 0.1
    cull_scale_thresh: 0.5
    cull_screen_size: 0.15
    densify_grad_thresh: 0.0008
    densify_size_thresh: 0.01
    enable_collider: true
    eval_num_rays_per_chunk: 4096
    grid_shape: !!python/tuple
    - 16
    - 16
    - 8
    loss_coefficients:
      rgb_loss_coarse: 1.0
      rgb_loss_fine: 1.0
    max_gauss_ratio: 10.0
    n_split_samples: 2
    num_downscales: 2
    num_random: $count
    output_depth_during_training: false
    prompt: null
    random_init: true
    random_scale: 10.0
    rasterize_mode: $mode
    refine_every: 100
    reset_alpha_every: 30
    resolution_schedule: 3000
    sh_degree: $degree
    sh_degree_interval: 1000
    split_screen_size: 0.05
    ssim_lambda: 0.2
    stop_screen_size_at: 4000
    stop_split_at: 15000
    use_absgrad: true
    use_bilateral_grid: false
    use_scale_regularization: false
    warmup_length: 500
project_name: nerfstudio-project
prompt: null
relative_model_dir: !!python/object/apply:pathlib.PosixPath
- nerfstudio_models
save_only_latest_checkpoint: true
start_paused: false
steps_per_eval_all_images: 1000
steps_per_eval_batch: 0
steps_per_eval_image: 100
steps_per_save: 2000
timestamp: $timestamp
use_grad_scaler: false
viewer: !!python/object:nerfstudio.configs.base_config.ViewerConfig
  camera_frustum_scale: 0.1
  default_composite_depth: true
  image_format: jpeg
  jpeg_quality: 75
  make_share_url: false
  max_num_display_images: 512
  num_rays_per_chunk: 32768
  quit_on_train_completion: false
  relative_log_filename: viewer_log_filename.txt
  websocket_host: 0.0.0.0
  websocket_port: null
  websocket_port_default: 7007
vis: tensorboard
"""
)
