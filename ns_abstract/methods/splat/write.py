"""Writes a splat scene as a run folder in Nerfstudio's own format, without importing Nerfstudio.

The result is what ``ns-train splatfacto`` of Nerfstudio 1.1.5 leaves behind, so that ``ns-viewer`` and
``ns-render`` open it as well. Nerfstudio takes relative paths from the working directory: start its
commands in the folder given to ``write_splatfacto_run``. The whole folder can be moved.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ns_abstract.geometry.keyframe_cameras import KeyframeCamera
from ns_abstract.io.atomic import write_atomic
from ns_abstract.methods.run_writer import background_name, checkpoint_bytes, optimizer_lines, write_run
from ns_abstract.methods.splat.activate import SH_C0
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


def write_splatfacto_run(
    scene: SplatScene,
    folder: str | Path,
    *,
    timestamp: str,
    experiment_name: str,
    views: Sequence[KeyframeCamera] | None = None,
    render: Callable[[KeyframeCamera], ArrayLike] | None = None,
) -> Path:
    """Write ``scene`` as a Splatfacto run, and a small data set beside it; return the path of config.yml.

    Files: ``FOLDER/EXPERIMENT/splatfacto/TIMESTAMP/{config.yml, dataparser_transforms.json,
    nerfstudio_models/step-000029999.ckpt}`` and ``FOLDER/data/{transforms.json, images/*.png}``. Every file is replaced
    as a whole and config.yml comes last, so a run with a config is complete. Nerfstudio builds its pipeline from the
    data set; the Gaussians come from the checkpoint alone.

    Args:
        scene: SH is stored padded with zeros to degree 3.
        folder: Nerfstudio's working directory for this run; made if missing.
        timestamp: Name of the run, as in "2026-11-21_120000".
        experiment_name: Name of the folder of its experiment.
        views: Cameras of the data set, normalised frame, at least two of one size and field of view.
        render: Returns the image [H, W, 3] in [0, 1] of a view; without it images hold only the background colour.

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


def write_ply(scene: SplatScene, file: Path) -> tuple[str, ...]:
    """Write ``scene`` as a .ply; `ns_abstract.methods.splat.load.load_scene` reads the same numbers back.

    A comment says how the scene is rasterised. The file holds means in the run's normalised frame, logarithms of
    scales, logits of opacities, quaternions as stored, and spherical harmonics channel by channel. Returns a sentence
    on each thing that the format cannot hold. Raises OSError where the file cannot be written.
    """
    import plyfile

    sh, lost = scene.sh, []
    if scene.color_model == "sigmoid":
        colors = 1.0 / (1.0 + np.exp(-sh.astype(np.float64)))
        sh = ((colors - 0.5) / SH_C0).astype(np.float32)
        lost.append("colours were turned from logits into spherical harmonics of degree 0, rounded to float32")
    if scene.rasterize_mode != "classic":
        lost.append(
            f"rasterize_mode {scene.rasterize_mode} but as a comment: programs that do not read it draw the scene as "
            "classic"
        )
    if np.any(scene.background):
        red, green, blue = (float(value) for value in scene.background)
        lost.append(
            f"the background ({red:.3g}, {green:.3g}, {blue:.3g}): this package takes black for a .ply unless "
            "--background says it"
        )
    columns: dict[str, np.ndarray] = dict(zip("xyz", scene.means.T, strict=True))
    columns |= {name: np.zeros(scene.count, np.float32) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{c}": sh[:, 0, c] for c in range(3)}
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(scene.count, -1)
    columns |= {f"f_rest_{k}": rest[:, k] for k in range(rest.shape[1])}
    columns["opacity"] = scene.opacity_logits
    columns |= {f"scale_{k}": scene.log_scales[:, k] for k in range(3)}
    columns |= {f"rot_{k}": scene.quats[:, k] for k in range(4)}
    table = np.empty(scene.count, [(name, "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mode = "mip" if scene.rasterize_mode == "antialiased" else "default"
        content = plyfile.PlyData(
            [plyfile.PlyElement.describe(table, "vertex")], byte_order="<", comments=[f"SplatRenderMode: {mode}"]
        )
    write_atomic(file, content.write)
    return tuple(lost)
