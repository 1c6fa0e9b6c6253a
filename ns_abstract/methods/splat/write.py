"""Writes a splat scene as a run folder in Nerfstudio's own format, without importing Nerfstudio.

The result is what ``ns-train splatfacto`` of Nerfstudio 1.1.5 leaves behind, so that ``ns-viewer`` and
``ns-render`` open it as well. Nerfstudio takes relative paths from the working directory: start its
commands in the folder given to ``write_splatfacto_run``. The whole folder can be moved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ns_abstract.geometry.keyframe_cameras import KeyframeCamera
from ns_abstract.methods.run_writer import (
    background_name,
    checkpoint_bytes,
    optimizer_lines,
    write_run,
)
from ns_abstract.methods.splat.scene import SplatScene

_REST_BANDS = 15  # features_rest of SH degree 3

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
    views: Sequence[KeyframeCamera] | None = None,
    render: Callable[[KeyframeCamera], ArrayLike] | None = None,
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
        views: Cameras of the data set, normalised frame, at least two of one size and field of view.
        render: Gives the image [H, W, 3] in [0, 1] of a view; without it the images hold only the
            background colour.

    Returns:
        The path of config.yml.

    Raises:
        InputError: ``timestamp`` or ``experiment_name`` is not a plain folder name.
    """
    config = {
        "optimizers": _OPTIMIZERS,
        "count": scene.count,
        "background": background_name(scene.background),
        "mode": scene.rasterize_mode,
        "degree": 3 if scene.color_model == "sh" else 0,
    }
    return write_run(
        scene, Path(folder), "splatfacto", timestamp, experiment_name, data="data", checkpoint=_checkpoint_bytes(scene),
        config=config, steps=_STEPS, views=views, render=render,
    )  # fmt: skip


def _checkpoint_bytes(scene: SplatScene) -> bytes:
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
    return checkpoint_bytes(
        {f"gauss_params.{name}": np.array(value, np.float32) for name, value in gaussians.items()},
        {name: _adam_state(name, rate) for name, rate in _LEARNING_RATES.items()},
        {"means": _scheduler_state(_LEARNING_RATES["means"])},
    )


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


_OPTIMIZERS = optimizer_lines(
    "Adam",
    "1.0e-15",
    {
        "bilateral_grid": ("0.002", ("0.0001", "0", 1000)),
        "camera_opt": ("0.0001", ("5.0e-07", "0", 1000)),
        "features_dc": ("0.0025", None),
        "features_rest": ("0.000125", None),
        "means": ("0.00016", ("1.6e-06", "1.0e-08", 0)),
        "opacities": ("0.05", None),
        "quats": ("0.001", None),
        "scales": ("0.005", None),
    },
)
_STEPS = """\
steps_per_eval_all_images: 1000
steps_per_eval_batch: 0
steps_per_eval_image: 100
steps_per_save: 2000"""
