"""Writes NeRFs as run folders of ``ns-train`` (Nerfstudio 1.1.5), without importing Nerfstudio."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ns_abstract.geometry.keyframe_cameras import KeyframeCamera
from ns_abstract.methods.nerf.hash_field import DenseNet, HashEncoding, NerfactoScene
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
    checkpoint where the fields have its own sizes (8 x 256, head 2 x 128). Returns the path of config.yml. Raises
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
    """Return the fields' arrays under Nerfstudio's names."""
    return {
        f"field_{name}.{key}": array
        for name, weights in (("coarse", scene.coarse), ("fine", scene.fine))
        for key, array in _named(weights).items()
    }


def field_states(names: Sequence[str]) -> dict[str, Any]:
    """Return the initial optimizer states of the parameter groups ``names``."""
    group = {"lr": 0.0005, "betas": (0.9, 0.999), "eps": 1e-8, "weight_decay": 0, "params": []}
    return {name: {"state": {}, "param_groups": [group]} for name in names}


def _named(weights: FieldWeights) -> dict[str, ArrayLike]:
    """Return the arrays of a field under the names of Nerfstudio's ``NeRFField``."""
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


def write_nerfacto_run(
    scene: NerfactoScene,
    folder: str | Path,
    *,
    timestamp: str,
    experiment_name: str,
    views: Sequence[KeyframeCamera] | None = None,
    render: Callable[[KeyframeCamera], ArrayLike] | None = None,
) -> Path:
    """Write ``scene`` as a nerfacto run of the torch implementation; the grids begin at resolution 16 or the scene's.

    Files and arguments are those of `ns_abstract.methods.splat.write.write_splatfacto_run`. Proposal fields are written
    one by round, each with two layers; the appearance embedding is a part of the colours' bias. Returns the path of
    config.yml. Raises InputError: ``timestamp`` or ``experiment_name`` is not a plain folder name.
    """
    field = scene.field
    grid = _grid(field.encoding)
    proposals = [
        {"hidden_dim": one.net.weights[0].shape[0], **_grid(one.encoding), "use_linear": False}
        for one in field.proposals
    ]
    behind = field.background
    config = dict(
        optimizers=_NERFACTO_OPTIMIZERS,
        background=behind if isinstance(behind, str) else background_name(behind.astype(np.float32)),
        far=repr(float(field.far)),
        density=repr(float(field.average_init_density)),
        hidden=field.density_net.weights[0].shape[0],
        color=field.color_net.weights[0].shape[0],
        spacing=field.spacing,
        rounds=len(field.proposals),
        nerf_samples=field.samples[-1],
        samples=list(field.samples[:-1]),
        proposals="".join(f"\n    - {one!r}".replace("'", "").replace("False", "false") for one in proposals),
        **grid,
    )
    return write_run(
        _Shown(scene), Path(folder), "nerfacto", timestamp, experiment_name, data=f"data-{experiment_name}",
        checkpoint=checkpoint_bytes(_arrays(scene), field_states(("fields", "proposal_networks")), {}), config=config,
        steps=STEPS, views=views, render=render,
    )  # fmt: skip


class _Shown:
    """Background and units of a nerfacto, as `write_run` needs them for the data set's pictures."""

    def __init__(self, scene: NerfactoScene) -> None:
        behind = scene.field.background
        self.background = np.zeros(3, np.float32) if isinstance(behind, str) else behind.astype(np.float32)
        self.dataparser = scene.dataparser


def _grid(encoding: HashEncoding) -> dict[str, int]:
    """Return settings of a hash grid by their names in Nerfstudio, with the least max_res that gives its resolutions.

    Raises ValueError: none does.
    """
    from ns_abstract.methods.nerf.nerfacto_load import resolutions

    levels, rows, features = encoding.table.shape
    least, most = int(encoding.resolutions[0]), int(encoding.resolutions[-1])
    for greatest in (most, most + 1):
        if np.array_equal(resolutions(levels, least, greatest), encoding.resolutions):
            break
    else:
        raise ValueError("resolutions are not those of Nerfstudio's growth")
    return {
        "num_levels": levels, "base_res": least, "max_res": greatest, "log2_hashmap_size": rows.bit_length() - 1,
        "features_per_level": features,
    }  # fmt: skip


def _arrays(scene: NerfactoScene) -> dict[str, ArrayLike]:
    """Return the arrays of the fields under Nerfstudio's names, float32."""
    field = scene.field
    arrays: dict[str, ArrayLike] = {"field.aabb": np.array([[-1.0] * 3, [1.0] * 3], np.float32)}

    def net(name: str, layers: DenseNet) -> None:
        for k, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
            arrays[f"{name}.layers.{k}.weight"] = weight.astype(np.float32)
            arrays[f"{name}.layers.{k}.bias"] = bias.astype(np.float32)

    def grid(name: str, encoding: HashEncoding) -> np.ndarray:
        sizes = _grid(encoding)
        for key in ("max_res", "num_levels", "log2_hashmap_size"):
            arrays[f"{name}.{key}"] = np.array(sizes[key])
        return encoding.table.reshape(-1, encoding.table.shape[2]).astype(np.float32)

    arrays["field.mlp_base.model.0.hash_table"] = grid("field", field.encoding)
    net("field.mlp_base.model.1", field.density_net)
    net("field.mlp_head", field.color_net)
    for k, one in enumerate(field.proposals):
        name = f"proposal_networks.{k}"
        arrays[f"{name}.aabb"] = arrays["field.aabb"]
        arrays[f"{name}.encoding.hash_table"] = arrays[f"{name}.mlp_base.0.hash_table"] = grid(name, one.encoding)
        net(f"{name}.mlp_base.1", one.net)
    return arrays


_NERFACTO_OPTIMIZERS = optimizer_lines(
    "Adam", "1.0e-15", {"fields": ("0.01", None), "proposal_networks": ("0.01", None)}
)
