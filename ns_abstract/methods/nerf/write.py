"""Writes a NeRF as a run folder of ``ns-train vanilla-nerf`` (Nerfstudio 1.1.5), without importing Nerfstudio."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from string import Template
from typing import Any

from numpy.typing import ArrayLike

from ns_abstract.geometry.keyframe_cameras import KeyframeCamera
from ns_abstract.methods.nerf.scene import FieldWeights, NerfScene
from ns_abstract.methods.run_writer import background_name, checkpoint_bytes, optimizer_lines, write_run


def write_nerf_run(
    scene: NerfScene,
    folder: str | Path,
    *,
    timestamp: str,
    experiment_name: str,
    views: Sequence[KeyframeCamera] | None = None,
    render: Callable[[KeyframeCamera], ArrayLike] | None = None,
) -> Path:
    """Write ``scene`` as a vanilla-nerf run.

    Files and arguments are those of `ns_abstract.methods.splat.write.write_splatfacto_run`. Nerfstudio itself loads the
    checkpoint where the fields have its own sizes (8 x 256, head 2 x 128).

    Returns:
        The path of config.yml.

    Raises:
        InputError: ``timestamp`` or ``experiment_name`` is not a plain folder name.
    """
    config = _CONFIG.safe_substitute(
        optimizers=_OPTIMIZERS,
        datamanager=DATAMANAGER,
        background=background_name(scene.background),
        far=repr(float(scene.far)),
        coarse=scene.coarse_samples,
        importance=scene.importance_samples,
    )
    # a data set of its own: a Splatfacto run may stand in the same folder
    return write_run(
        scene, Path(folder), "vanilla-nerf", timestamp, experiment_name, data=f"data-{experiment_name}",
        checkpoint=checkpoint_bytes(_pipeline(scene), field_states(("fields",)), {}), config=config, steps=STEPS,
        views=views, render=render,
    )  # fmt: skip


def _pipeline(scene: NerfScene) -> dict[str, ArrayLike]:
    """The fields' arrays under Nerfstudio's names."""
    return {
        f"field_{name}.{key}": array
        for name, weights in (("coarse", scene.coarse), ("fine", scene.fine))
        for key, array in _named(weights).items()
    }


def field_states(names: Sequence[str]) -> dict[str, Any]:
    """States of optimizers that have done nothing, of groups of parameters with these names."""
    group = {"lr": 0.0005, "betas": (0.9, 0.999), "eps": 1e-8, "weight_decay": 0, "params": []}
    return {name: {"state": {}, "param_groups": [group]} for name in names}


def _named(weights: FieldWeights) -> dict[str, ArrayLike]:
    """The arrays of a field under the names of Nerfstudio's ``NeRFField``."""
    layers = {f"mlp_base.layers.{i}": layer for i, layer in enumerate(weights.base)}
    layers["field_output_density.net"] = weights.density
    layers |= {f"mlp_head.layers.{i}": layer for i, layer in enumerate(weights.head)}
    layers["field_heads.0.net"] = weights.color
    return {f"{key}.{part}": getattr(layer, part) for key, layer in layers.items() for part in ("weight", "bias")}


# what config.yml of both methods says of data; $dataparser is for the writer
DATAMANAGER = """\
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  _target: !!python/name:nerfstudio.pipelines.base_pipeline.VanillaPipeline ''
  datamanager: !!python/object:nerfstudio.data.datamanagers.base_datamanager.VanillaDataManagerConfig
    _target: !!python/name:nerfstudio.data.datamanagers.base_datamanager.VanillaDataManager ''
    camera_optimizer: null
    camera_res_scale_factor: 1.0
    collate_fn: !!python/name:nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate ''
    data: *data
$dataparser
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
    train_num_times_to_repeat_images: -1"""
_OPTIMIZERS = optimizer_lines("RAdam", "1.0e-08", {"fields": ("0.0005", None), "temporal_distortion": ("0.0005", None)})
# what config.yml of vanilla-nerf says
_CONFIG = Template(
    """\
max_num_iterations: 1000000
method_name: vanilla-nerf
mixed_precision: false
$optimizers
output_dir: !!python/object/apply:pathlib.PosixPath []
$datamanager
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
    use_gradient_scaling: false"""
)
STEPS = """\
steps_per_eval_all_images: 25000
steps_per_eval_batch: 500
steps_per_eval_image: 500
steps_per_save: 1000"""
