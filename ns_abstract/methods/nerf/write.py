"""Writes a NeRF as a run folder of ``ns-train vanilla-nerf`` (Nerfstudio 1.1.5), without importing Nerfstudio."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
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
    config = {
        "optimizers": _OPTIMIZERS,
        "background": background_name(scene.background),
        "far": repr(float(scene.far)),
        "coarse": scene.coarse_samples,
        "importance": scene.importance_samples,
    }
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


_OPTIMIZERS = optimizer_lines("RAdam", "1.0e-08", {"fields": ("0.0005", None), "temporal_distortion": ("0.0005", None)})
STEPS = """\
steps_per_eval_all_images: 25000
steps_per_eval_batch: 500
steps_per_eval_image: 500
steps_per_save: 1000"""
