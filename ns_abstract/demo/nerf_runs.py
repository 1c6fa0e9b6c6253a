"""Writes a NeRF as a run folder of ``ns-train vanilla-nerf`` (Nerfstudio 1.1.5), without importing Nerfstudio."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from string import Template

from numpy.typing import ArrayLike

from ns_abstract.demo.paths import View, dataset_views
from ns_abstract.demo.runs import STEP, background_name, lpips_state, run_folder, write_dataset, write_file
from ns_abstract.methods.nerf.scene import FieldWeights, NerfScene


def write_nerf_run(
    scene: NerfScene,
    folder: str | Path,
    *,
    timestamp: str,
    experiment_name: str,
    views: Sequence[View] | None = None,
    render: Callable[[View], ArrayLike] | None = None,
) -> Path:
    """Write ``scene`` as a vanilla-nerf run; files and arguments as for `ns_abstract.demo.runs.write_splatfacto_run`.

    Nerfstudio itself loads the checkpoint where the fields have its own sizes (8 x 256, head 2 x 128).

    Returns:
        The path of config.yml.

    Raises:
        InputError: ``timestamp`` or ``experiment_name`` is not a plain folder name.
    """
    folder = Path(folder)
    run = run_folder(folder, "vanilla-nerf", timestamp, experiment_name)
    # a data set of its own: a Splatfacto run may stand in the same folder
    data = f"data-{experiment_name}"
    write_dataset(scene, folder / data, dataset_views() if views is None else views, render)
    transform = {"transform": scene.dataparser.matrix.tolist(), "scale": float(scene.dataparser.scale)}
    write_file(run / "dataparser_transforms.json", json.dumps(transform, indent=4).encode())
    write_file(run / "nerfstudio_models" / f"step-{STEP:09d}.ckpt", _checkpoint_bytes(scene), scratch=run)
    text = _CONFIG.substitute(
        experiment=json.dumps(experiment_name),
        timestamp=json.dumps(timestamp),
        data=json.dumps(data),
        background=background_name(scene.background),
        far=repr(float(scene.far)),
        coarse=scene.coarse_samples,
        importance=scene.importance_samples,
    )
    config = run / "config.yml"
    write_file(config, text.encode())
    return config


def _checkpoint_bytes(scene: NerfScene) -> bytes:
    """A checkpoint of plain tensors, numbers, lists and dictionaries: loads with weights_only."""
    import torch

    pipeline = {"_model.device_indicator_param": torch.empty(0)}
    for name, weights in (("coarse", scene.coarse), ("fine", scene.fine)):
        for key, array in _named(weights).items():
            pipeline[f"_model.field_{name}.{key}"] = torch.tensor(array)
    pipeline |= lpips_state("_model.lpips.net.")
    group = {"lr": 0.0005, "betas": (0.9, 0.999), "eps": 1e-8, "weight_decay": 0, "params": []}
    state = {
        "step": STEP,
        "pipeline": pipeline,
        "optimizers": {"fields": {"state": {}, "param_groups": [group]}},
        "schedulers": {},
        "scalers": {},
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def _named(weights: FieldWeights) -> dict[str, ArrayLike]:
    """The arrays of a field under the names of Nerfstudio's ``NeRFField``."""
    layers = {f"mlp_base.layers.{i}": layer for i, layer in enumerate(weights.base)}
    layers["field_output_density.net"] = weights.density
    layers |= {f"mlp_head.layers.{i}": layer for i, layer in enumerate(weights.head)}
    layers["field_heads.0.net"] = weights.color
    return {f"{key}.{part}": getattr(layer, part) for key, layer in layers.items() for part in ("weight", "bias")}


# config.yml of a run: the Python tags are those by which Nerfstudio rebuilds its configuration.
_CONFIG = Template(
    """\
!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: !!python/name:nerfstudio.engine.trainer.Trainer ''
data: &id002 !!python/object/apply:pathlib.PosixPath
- $data
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
max_num_iterations: 1000000
method_name: vanilla-nerf
mixed_precision: false
optimizers:
  fields:
    optimizer: !!python/object:nerfstudio.engine.optimizers.RAdamOptimizerConfig
      _target: &id001 !!python/name:torch.optim.radam.RAdam ''
      eps: 1.0e-08
      lr: 0.0005
      max_norm: null
      weight_decay: 0
    scheduler: null
  temporal_distortion:
    optimizer: !!python/object:nerfstudio.engine.optimizers.RAdamOptimizerConfig
      _target: *id001
      eps: 1.0e-08
      lr: 0.0005
      max_norm: null
      weight_decay: 0
    scheduler: null
output_dir: !!python/object/apply:pathlib.PosixPath []
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  _target: !!python/name:nerfstudio.pipelines.base_pipeline.VanillaPipeline ''
  datamanager: !!python/object:nerfstudio.data.datamanagers.base_datamanager.VanillaDataManagerConfig
    _target: !!python/name:nerfstudio.data.datamanagers.base_datamanager.VanillaDataManager ''
    camera_optimizer: null
    camera_res_scale_factor: 1.0
    collate_fn: !!python/name:nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate ''
    data: *id002
    dataparser: !!python/object:nerfstudio.data.dataparsers.nerfstudio_dataparser.NerfstudioDataParserConfig
      _target: !!python/name:nerfstudio.data.dataparsers.nerfstudio_dataparser.Nerfstudio ''
      auto_scale_poses: false
      center_method: none
      data: *id002
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
    eval_num_rays_per_batch: 1024
    eval_num_times_to_repeat_images: -1
    images_on_gpu: false
    masks_on_gpu: false
    patch_size: 1
    pixel_sampler: !!python/object:nerfstudio.data.pixel_samplers.PixelSamplerConfig
      _target: !!python/name:nerfstudio.data.pixel_samplers.PixelSampler ''
      fisheye_crop_radius: null
      ignore_mask: false
      is_equirectangular: false
      keep_full_image: false
      max_num_iterations: 100
      num_rays_per_batch: 4096
      rejection_sample_mask: true
    train_num_images_to_sample_from: -1
    train_num_rays_per_batch: 1024
    train_num_times_to_repeat_images: -1
  model: !!python/object:nerfstudio.models.vanilla_nerf.VanillaModelConfig
    _target: !!python/name:nerfstudio.models.vanilla_nerf.NeRFModel ''
    background_color: $background
    collider_params:
      far_plane: $far
      near_plane: 2.0
    enable_collider: true
    enable_temporal_distortion: false
    eval_num_rays_per_chunk: 4096
    loss_coefficients:
      rgb_loss_coarse: 1.0
      rgb_loss_fine: 1.0
    num_coarse_samples: $coarse
    num_importance_samples: $importance
    prompt: null
    temporal_distortion_params:
      kind: !!python/object/apply:nerfstudio.field_components.temporal_distortions.TemporalDistortionKind
      - dnerf
    use_gradient_scaling: false
project_name: nerfstudio-project
prompt: null
relative_model_dir: !!python/object/apply:pathlib.PosixPath
- nerfstudio_models
save_only_latest_checkpoint: true
start_paused: false
steps_per_eval_all_images: 25000
steps_per_eval_batch: 500
steps_per_eval_image: 500
steps_per_save: 1000
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
