"""Loads a vanilla NeRF from an ``ns-train vanilla-nerf`` run folder.

It imports nothing from Nerfstudio and runs no code in the files. Numbers and widths of layers are those of the
checkpoint; the encodings' exponents are Nerfstudio's own, and for runs of abstract-nerf those of config.yml.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import is_number, show
from ns_abstract.methods import config_keys, runs
from ns_abstract.methods.nerf import model_state
from ns_abstract.methods.nerf.model_state import ModelState
from ns_abstract.methods.nerf.scene import Encoding, FieldWeights, Layer, NerfScene
from ns_abstract.methods.overrides import Overrides

FIX = "give a run of vanilla-nerf or abstract-nerf"
_LAYERS_LIMIT = 64
_SAMPLES_LIMIT = 4096
#: nerfstudio/models/vanilla_nerf.py: exponents of the encodings of positions and directions, which its config
#: cannot change.
_EXPONENTS = (8.0, 4.0)
#: nerfstudio/nerf.py: defaults of abstract-nerf.
_FREQUENCIES = {"num_frequencies": 6, "num_direction_frequencies": 2}
_MAX_EXPONENT, _MAX_EXPONENT_LIMIT = 5.0, 60.0
_FREQUENCIES_LIMIT = 64
_STOCK, _OURS = "nerfstudio.models.vanilla_nerf.NeRFModel", "ns_abstract.nerfstudio.nerf.AbstractNerfModel"
#: nerfstudio/models/base_model.py: default of ``collider_params``.
_PLANES = {"near_plane": 2.0, "far_plane": 6.0}


def holds_nerf(run: runs.RunConfig) -> bool:
    """Return whether config.yml names vanilla NeRF: by its method or by its model class."""
    return run.method_name in ("vanilla-nerf", "abstract-nerf") or runs.target_class(run) in (_STOCK, _OURS)


def load_nerf(run: runs.RunConfig, overrides: Overrides | None = None) -> NerfScene:
    """Return the fields and the other inputs of Nerfstudio's evaluation."""
    overrides = overrides or Overrides()
    model_state.check_model(run, overrides, (_STOCK, _OURS), "vanilla-nerf", FIX)
    unused = config_keys.check_keys(run, config_keys.VANILLA_NERF)
    color = _color(run, overrides)
    coarse_samples = run.integer("num_coarse_samples", 64, 1, _SAMPLES_LIMIT)
    importance_samples = run.integer("num_importance_samples", 128, 1, _SAMPLES_LIMIT)
    transform, notes = runs.read_dataparser_transform(run)
    checkpoint = runs.find_checkpoint(run, overrides.load_step)
    state = ModelState(runs.read_model_state(checkpoint), checkpoint, FIX)
    if not any(key.startswith("field_fine.") for key in state):
        raise state.refused(f"no NeRF fields in this checkpoint (method {show(run.method_name)})", "field_fine")
    exponents, counts = _encodings(run)
    coarse, fine = (field_weights(state, name, exponents, counts) for name in ("field_coarse", "field_fine"))
    state.refuse_unread("vanilla-nerf")
    return NerfScene(
        coarse=coarse,
        fine=fine,
        # nerfstudio/model_components/scene_colliders.py: reset_near_plane, outside training
        near=0.0,
        far=_far_plane(run),
        coarse_samples=coarse_samples,
        importance_samples=importance_samples,
        background=color[1],
        dataparser=transform,
        name=run.experiment_name,
        source=str(checkpoint),
        notes=(*notes, *unused),
        assumptions=(color[0], *model_state.records(run, state, overrides, _STOCK, transform, bool(notes))),
    )


def _color(run: runs.RunConfig, overrides: Overrides) -> tuple[Assumption, NDArray[np.float32]]:
    """Return the record of the background's choice, and its colour."""
    record, color = model_state.background(run, overrides, "white")
    if isinstance(color, str):
        raise InputError(
            "last_sample, which continues the colour of a ray's last sample, is not supported",
            file=run.file,
            field="pipeline.model.background_color",
            fix="give --background R G B to bound the field before a constant colour, which is another picture",
        )
    return record, color


def _encodings(run: runs.RunConfig) -> tuple[tuple[float, float], tuple[int | None, int | None]]:
    """Return highest exponents, and numbers of frequencies if config.yml states them, of positions and directions."""
    ours = run.method_name == "abstract-nerf" or runs.target_class(run) == _OURS
    if not ours:
        return _EXPONENTS, (None, None)
    position, direction = (run.integer(name, n, 0, _FREQUENCIES_LIMIT) for name, n in _FREQUENCIES.items())
    if direction == 0:
        return _EXPONENTS, (None, None)
    highest = run.model.get("max_frequency_exponent", _MAX_EXPONENT)
    if not is_number(highest) or not 0.0 <= highest <= _MAX_EXPONENT_LIMIT:
        raise run.refused("max_frequency_exponent", highest, f"a number from 0 to {_MAX_EXPONENT_LIMIT:g}")
    return (float(highest), direction - 1.0), (position, direction)


def _far_plane(run: runs.RunConfig) -> float:
    params = runs.as_mapping(run.model.get("collider_params", _PLANES))
    value = None if params is None else params.get("far_plane")
    if not is_number(value) or not 0.0 < value < 1e6:  # pyright: ignore[reportOperatorIssue]
        raise run.refused("collider_params.far_plane", value, "a distance above 0")
    return float(value)  # pyright: ignore[reportArgumentType]


def field_weights(
    state: ModelState,
    name: str,
    exponents: tuple[float, float] = _EXPONENTS,
    counts: tuple[int | None, int | None] = (None, None),
) -> FieldWeights:
    """Return one field of a model's state.

    Args:
        exponents: Highest exponents of the frequencies of positions and directions; the lowest are 0.
        counts: Numbers of these frequencies; None: as the layers' widths imply.
    """

    def layer(key: str, skip: bool = False) -> Layer:
        return Layer(*state.linear(f"{name}.{key}"), skip)

    def layers(key: str) -> list[Layer]:
        layer_list = []
        while f"{name}.{key}.layers.{len(layer_list)}.weight" in state and len(layer_list) < _LAYERS_LIMIT:
            layer_list.append(layer(f"{key}.layers.{len(layer_list)}"))
        return layer_list or [layer(f"{key}.layers.0")]

    def fits(key: str, outputs: int, expected: tuple[int, ...]) -> None:
        if outputs not in expected:
            wanted = " or ".join(map(str, dict.fromkeys(expected)))
            raise state.refused(f"takes {outputs} inputs, expected {wanted}", f"{name}.{key}.weight")

    base = layers("mlp_base")
    position = _encoding(state, f"{name}.mlp_base", base[0].weight.shape[1], exponents[0], counts[0])
    for i in range(1, len(base)):
        width, inputs = base[i - 1].weight.shape[0], base[i].weight.shape[1]
        fits(f"mlp_base.layers.{i}", inputs, (width, width + position.size))
        base[i] = Layer(base[i].weight, base[i].bias, inputs != width)
    width = base[-1].weight.shape[0]
    density, head, color = layer("field_output_density.net"), layers("mlp_head"), layer("field_heads.0.net")
    fits("field_output_density.net", density.weight.shape[1], (width,))
    direction = _encoding(state, f"{name}.mlp_head", head[0].weight.shape[1] - width, exponents[1], counts[1])
    for i in range(1, len(head)):
        fits(f"mlp_head.layers.{i}", head[i].weight.shape[1], (head[i - 1].weight.shape[0],))
    fits("field_heads.0.net", color.weight.shape[1], (head[-1].weight.shape[0],))
    for key, outputs, expected in (("field_output_density", density, 1), ("field_heads.0", color, 3)):
        if outputs.weight.shape[0] != expected:
            raise state.refused(f"{outputs.weight.shape[0]} outputs, expected {expected}", f"{name}.{key}.net")
    return FieldWeights(tuple(base), density, tuple(head), color, position, direction)


def _encoding(state: ModelState, key: str, size: int, highest: float, count: int | None) -> Encoding:
    key = f"{key}.layers.0.weight"
    if size < 9 or (size - 3) % 6:
        raise state.refused(f"{size} encoded values are not 3 coordinates with sines and cosines", key)
    frequencies = (size - 3) // 6
    if count not in (None, frequencies):
        fix = "give the checkpoint that belongs to config.yml"
        raise state.refused(f"takes {frequencies} frequencies, config.yml says {count}", key, fix)
    return Encoding(frequencies, 0.0, highest)
