"""Load a vanilla NeRF from an ``ns-train vanilla-nerf`` run folder.

Nothing from Nerfstudio is imported and no code in the files is run. Numbers and widths of layers are
those of the checkpoint; the encodings' exponents are Nerfstudio's own unless config.yml names others.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ns_abstract.errors import InputError
from ns_abstract.jsonio import is_number, show
from ns_abstract.methods import runs
from ns_abstract.methods.nerf.scene import Encoding, FieldWeights, Layer, NerfScene

_FIX = "give a run of vanilla-nerf"
_LAYERS_LIMIT = 64
_SAMPLES_LIMIT = 4096
#: nerfstudio/models/vanilla_nerf.py: exponents of the encodings, which its config cannot change.
_POSITION_EXPONENTS, _DIRECTION_EXPONENTS = (0.0, 8.0), (0.0, 4.0)
#: nerfstudio/models/base_model.py: default of ``collider_params``.
_PLANES = {"near_plane": 2.0, "far_plane": 6.0}


def holds_nerf(run: runs.RunConfig) -> bool:
    """Whether config.yml names vanilla NeRF: by its method or by its model class."""
    target = run.model.get("_target")
    name = target.tag if isinstance(target, runs.Tagged) else ""
    return run.method_name == "vanilla-nerf" or name.endswith(":nerfstudio.models.vanilla_nerf.NeRFModel")


def load_nerf(run: runs.RunConfig) -> NerfScene:
    """Read the fields and what evaluation needs besides.

    Args:
        run: The run's configuration.

    Raises:
        InputError: For any content of the files that cannot be used.
    """
    for name, why in (("enable_temporal_distortion", "scenes that move"), ("use_integrated_encoding", "mip-NeRF")):
        if run.model.get(name, False) is not False:
            raise InputError(
                f"{why} cannot be bounded", file=run.file, field=f"pipeline.model.{name}", fix="train without it"
            )
    if run.model.get("enable_collider", True) is not True:
        raise InputError(
            "rays without ends", file=run.file, field="pipeline.model.enable_collider", fix="train with a collider"
        )
    background = run.color("background_color", "white", {"random": (0.0, 0.0, 0.0)})
    coarse_samples = run.integer("num_coarse_samples", 64, 1, _SAMPLES_LIMIT)
    importance_samples = run.integer("num_importance_samples", 128, 1, _SAMPLES_LIMIT)
    transform, notes = runs.read_dataparser_transform(run)
    checkpoint = runs.find_checkpoint(run)
    state = runs.read_model_state(checkpoint)
    if not any(key.startswith("field_fine.") for key in state):
        raise InputError(
            f"no NeRF fields in this checkpoint (method {show(run.method_name)})",
            file=checkpoint,
            field="pipeline._model.field_fine",
            fix=_FIX,
        )
    return NerfScene(
        coarse=_field(state, "field_coarse", checkpoint),
        fine=_field(state, "field_fine", checkpoint),
        # nerfstudio/model_components/scene_colliders.py: reset_near_plane, outside training
        near=0.0,
        far=_far_plane(run),
        coarse_samples=coarse_samples,
        importance_samples=importance_samples,
        background=background,
        dataparser=transform,
        name=run.experiment_name,
        source=str(checkpoint),
        notes=notes,
    )


def _far_plane(run: runs.RunConfig) -> float:
    params = runs.as_mapping(run.model.get("collider_params", _PLANES))
    value = None if params is None else params.get("far_plane", _PLANES["far_plane"])
    if not is_number(value) or not 0.0 < value < 1e6:  # pyright: ignore[reportOperatorIssue]
        raise InputError(
            f"found {show(value)}",
            file=run.file,
            field="pipeline.model.collider_params.far_plane",
            fix="write a distance above 0",
        )
    return float(value)  # pyright: ignore[reportArgumentType]


def _field(state: dict[str, Any], name: str, file: Path) -> FieldWeights:
    def layer(key: str, skip: bool = False) -> Layer:
        where = f"pipeline._model.{name}.{key}"
        for part in ("weight", "bias"):
            if f"{name}.{key}.{part}" not in state:
                raise InputError("missing", file=file, field=f"{where}.{part}", fix=_FIX)
        weight = runs.tensor_to_float32(state[f"{name}.{key}.weight"], file, f"{where}.weight")
        bias = runs.tensor_to_float32(state[f"{name}.{key}.bias"], file, f"{where}.bias")
        if weight.ndim != 2 or 0 in weight.shape or bias.shape != weight.shape[:1]:
            problem = f"shapes {list(weight.shape)} and {list(bias.shape)} are not those of a linear layer"
            raise InputError(problem, file=file, field=where, fix=_FIX)
        return Layer(weight, bias, skip)

    def layers(key: str) -> list[Layer]:
        found = []
        while f"{name}.{key}.layers.{len(found)}.weight" in state and len(found) < _LAYERS_LIMIT:
            found.append(layer(f"{key}.layers.{len(found)}"))
        return found or [layer(f"{key}.layers.0")]

    def fits(key: str, found: int, expected: tuple[int, ...]) -> None:
        if found not in expected:
            wanted = " or ".join(map(str, dict.fromkeys(expected)))
            raise InputError(
                f"takes {found} inputs, expected {wanted}",
                file=file,
                field=f"pipeline._model.{name}.{key}.weight",
                fix=_FIX,
            )

    base = layers("mlp_base")
    position = _encoding(base[0].weight.shape[1], _POSITION_EXPONENTS, file, f"pipeline._model.{name}.mlp_base")
    for i in range(1, len(base)):
        width, inputs = base[i - 1].weight.shape[0], base[i].weight.shape[1]
        fits(f"mlp_base.layers.{i}", inputs, (width, width + position.size))
        base[i] = Layer(base[i].weight, base[i].bias, inputs != width)
    width = base[-1].weight.shape[0]
    density, head, color = layer("field_output_density.net"), layers("mlp_head"), layer("field_heads.0.net")
    fits("field_output_density.net", density.weight.shape[1], (width,))
    direction = _encoding(
        head[0].weight.shape[1] - width, _DIRECTION_EXPONENTS, file, f"pipeline._model.{name}.mlp_head"
    )
    for i in range(1, len(head)):
        fits(f"mlp_head.layers.{i}", head[i].weight.shape[1], (head[i - 1].weight.shape[0],))
    fits("field_heads.0.net", color.weight.shape[1], (head[-1].weight.shape[0],))
    for key, found, expected in (("field_output_density", density, 1), ("field_heads.0", color, 3)):
        if found.weight.shape[0] != expected:
            problem = f"{found.weight.shape[0]} outputs, expected {expected}"
            raise InputError(problem, file=file, field=f"pipeline._model.{name}.{key}.net", fix=_FIX)
    return FieldWeights(tuple(base), density, tuple(head), color, position, direction)


def _encoding(size: int, exponents: tuple[float, float], file: Path, field: str) -> Encoding:
    if size < 9 or (size - 3) % 6:
        raise InputError(
            f"{size} encoded values are not 3 coordinates with sines and cosines",
            file=file,
            field=f"{field}.layers.0.weight",
            fix=_FIX,
        )
    return Encoding((size - 3) // 6, *exponents)
