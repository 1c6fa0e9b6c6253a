"""Loads a Gaussian-splat scene from an ``ns-train`` run folder or a standard 3DGS ``.ply``.

It refuses a run whose class, or whose checkpoint's modules, are not known to draw what Splatfacto draws. It imports
nothing from Nerfstudio and runs no code in the files.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError, visible
from ns_abstract.io.jsonio import file_size, show
from ns_abstract.io.kinds import is_ply, refuse_other_kind
from ns_abstract.io.memory import check_memory
from ns_abstract.methods import config_keys, runs
from ns_abstract.methods.checkpoint import to_float32
from ns_abstract.methods.overrides import MODES, Overrides, assumption_of
from ns_abstract.methods.splat.drawable import StoredGaussians, coordinates_note, drawable
from ns_abstract.methods.splat.formats import inria
from ns_abstract.methods.splat.formats.compressed_ply import decode_compressed_ply, is_compressed
from ns_abstract.methods.splat.formats.decoded import DecodedSplats, float32_rows, scene_of
from ns_abstract.methods.splat.formats.readers import decoder_of, scene_file
from ns_abstract.methods.splat.ply_header import (
    FILTER,
    GROUPS,
    PlyHeader,
    read_declaration,
    read_elements,
    standard_header,
)
from ns_abstract.methods.splat.scene import Float32Array, SplatScene

# nerfstudio/models/splatfacto.py: SplatfactoModel.load_state_dict sets this step.
_STEP_AFTER_LOADING = 30000
_MAX_DEGREE_STORED = 4
_MAX_DEGREE = 3
#: nerfstudio/models/splatfacto.py:300-303, 498-509: what it shows outside training; at other names, also of another
#: case, it stops.
_BACKGROUNDS = {"random": (0.1490, 0.1647, 0.2157), "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
_MODEL_DEFAULTS: dict[str, Any] = {
    "sh_degree": 3,
    "sh_degree_interval": 1000,
    "rasterize_mode": "classic",
    "background_color": "random",
}
_PARAMETERS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")

#: See `runs.IDLE_MODULES`; camera optimiser and bilateral grid: nerfstudio/models/splatfacto.py:545, 631.
_IDLE = runs.IDLE_MODULES | {"bil_grids.": "a bilateral grid, used in training alone"}
#: Classes that draw in evaluation what Splatfacto draws.
_CLASSES = ("nerfstudio.models.splatfacto.SplatfactoModel", "ns_abstract.nerfstudio.splat.AbstractSplatfactoModel")
#: Unknown modules that are named.
_SHOWN = 8
_FIX = "give the config.yml of a run, its folder, or a scene file such as a .ply"
_FIELDS = {"scales": "vertex.scale_*", "quats": "vertex.rot_*", "opacities": "vertex.opacity", "colours": "vertex.f_*"}


def load_scene(path: str | os.PathLike[str], overrides: Overrides | None = None) -> SplatScene:
    """Return the scene of a run or file.

    Args:
        path: ``config.yml`` of a run, the run folder that holds it, or a file or folder of another program
            (docs/formats.md).
        overrides: The user's values in place of the files'.

    Returns:
        The stored parameters; world is the run's normalised frame, or that of the ``.ply``. ``sh`` keeps the bands up
            to the degree that Nerfstudio evaluates after loading.

    Raises:
        InputError: For any content of the files, or an override, that cannot be used.
    """
    path, overrides = Path(path), overrides or Overrides()
    if os.path.isdir(path):
        inner = scene_file(path, overrides.load_step)
        if inner is not None:
            # the step has chosen the file
            return load_scene(inner, replace(overrides, load_step=None))
    else:
        file_size(path, "config.yml or .ply", fix=_FIX)
        if is_ply(path) or path.suffix.lower() == ".ply":
            return load_ply(path, overrides)
        decode = decoder_of(path)
        if decode is not None:
            overrides.refuse(("load_step", "assume_splatfacto"), "is for runs, this is a file")
            return scene_of(decode(path, overrides), overrides)
        refuse_other_kind(path)
        if path.suffix.lower() == ".json":
            lod = path.name == "lod-meta.json"
            fix = f"convert with: splat-transform {path.name} out.ply" if lod else _FIX
            what = "the index of a SOG scene in levels of detail" if lod else "a .json file is not a scene"
            raise InputError(what, file=path, fix=fix)
        if path.suffix.lower() in (".ckpt", ".pt", ".pth"):
            raise InputError(f"a {path.suffix} file is not a scene", file=path, fix=_FIX)
    return load_run(runs.read_config(path), overrides)


def scene_from_parameters(
    parameters: Mapping[str, Any],
    *,
    source: str,
    name: str,
    color_model: Literal["sh", "sigmoid"],
    sh_degree: int,
    rasterize_mode: Literal["classic", "antialiased"],
    background: Float32Array,
) -> SplatScene:
    """Return the scene of a loaded Splatfacto model, checked like one that is read from files.

    ``parameters``: arrays means [N, 3], scales [N, 3], quats [N, 4], features_dc [N, 3], features_rest [N, K - 1, 3]
    and opacities [N, 1]. ``name``, ``color_model``, ``sh_degree``, ``rasterize_mode``, ``background``: as in
    `SplatScene`. Raises InputError where a value is not finite or cannot be drawn.
    """
    stored_arrays = {key: np.array(parameters[key], np.float32) for key in _PARAMETERS}
    rest = stored_arrays["features_rest"][:, : (sh_degree + 1) ** 2 - 1]
    arrays = StoredGaussians(
        means=stored_arrays["means"],
        log_scales=stored_arrays["scales"],
        quats=stored_arrays["quats"],
        opacity_logits=stored_arrays["opacities"].reshape(-1),
        sh=np.concatenate([stored_arrays["features_dc"][:, None], rest], axis=1),
    )
    fields = {name: name for name in ("scales", "quats", "opacities", "colours")}
    arrays, dropped = drawable(arrays, Path(source), fields)
    return SplatScene(
        **vars(arrays),
        color_model=color_model,
        sh_degree=sh_degree,
        rasterize_mode=rasterize_mode,
        background=background,
        name=name,
        source=source,
        **dropped,
    )


def load_run(run: runs.RunConfig, overrides: Overrides) -> SplatScene:
    """Return the scene of a run whose configuration has been read, as `load_scene` does."""
    degree_stored = run.integer("sh_degree", _MODEL_DEFAULTS["sh_degree"], 0, _MAX_DEGREE_STORED)
    interval = run.integer("sh_degree_interval", _MODEL_DEFAULTS["sh_degree_interval"], 1)
    choices, background = _picture(run, overrides)
    degree = min(_STEP_AFTER_LOADING // interval, degree_stored)
    if degree > _MAX_DEGREE:
        raise InputError(
            f"spherical harmonics of degree {degree}",
            file=run.file,
            field="pipeline.model.sh_degree",
            fix=f"train with degree {_MAX_DEGREE} or less",
        )
    transform, notes = runs.read_dataparser_transform(run)
    checkpoint = runs.find_checkpoint(run, overrides.load_step)
    whole = runs.read_model_state(checkpoint)
    state = _gaussian_state(whole, checkpoint, run.method_name)
    gaussians_alone, model_assumptions = _check_model(run, whole, checkpoint, overrides.assume_splatfacto)
    unused = config_keys.check_keys(run, config_keys.SPLATFACTO, refuse_unknown=not overrides.assume_splatfacto)
    arrays = _run_arrays(state, checkpoint, degree_stored, degree)
    fields = {"scales": "scales", "quats": "quats", "opacities": "opacities", "colours": "features_dc"}
    fields = {name: _run_field(field) for name, field in fields.items()}
    arrays, dropped = drawable(arrays, checkpoint, fields, overrides.drop_nan_gaussians)
    return SplatScene(
        **vars(arrays),
        color_model="sh" if degree_stored > 0 else "sigmoid",
        sh_degree=degree,
        rasterize_mode=cast(Literal["classic", "antialiased"], choices[0].value),
        background=background,
        dataparser=transform,
        name=run.experiment_name,
        source=str(checkpoint),
        **dropped,
        notes=(*notes, *_notes(run), *unused, *coordinates_note(arrays.means, arrays.log_scales)),
        assumptions=(
            *choices,
            runs.step_assumption(run, checkpoint, overrides.load_step),
            *model_assumptions,
            runs.units_assumption(transform, bool(notes)),
        ),
        gaussians_alone=gaussians_alone,
    )


def _picture(run: runs.RunConfig, overrides: Overrides) -> tuple[tuple[Assumption, ...], Float32Array]:
    """Return records of the choices of rasterisation and background, and the background's colour."""
    origins = {
        name: f"config.yml: pipeline.model.{name}" if name in run.model else "default of nerfstudio 1.1.5"
        for name in ("rasterize_mode", "background_color")
    }
    # what is replaced is read first, so that a file that says nonsense is refused either way
    mode = run.choice("rasterize_mode", _MODEL_DEFAULTS["rasterize_mode"], MODES)
    background = run.color("background_color", _MODEL_DEFAULTS["background_color"], _BACKGROUNDS)
    stored = tuple(float(part) for part in background)
    if not isinstance(run.model.get("background_color", ""), str):
        origins["background_color"] += ", three numbers, at which Nerfstudio's own model stops"
    choices = (
        assumption_of("rasterize_mode", overrides.rasterize_mode, "--rasterize-mode", mode, origins["rasterize_mode"]),
        assumption_of("background", overrides.background, "--background", stored, origins["background_color"]),
    )
    return choices, np.array(overrides.background or stored, np.float32)


def _check_model(
    run: runs.RunConfig, state: dict[str, Any], checkpoint: Path, assumed: bool
) -> tuple[bool, tuple[Assumption, ...]]:
    """Return whether bounds are of the Gaussians alone, and records of the model's class and ignored modules.

    Raises:
        InputError: The class or a module is unknown, and the user does not say that it is Splatfacto's.
    """
    name = runs.target_class(run)
    unknown = sorted({_module(key) for key in state if not _known(key)})
    if not assumed and name and name not in _CLASSES:
        raise InputError(
            f"names the model class {show(name)}, which may draw more than the Gaussians that Splatfacto draws",
            file=run.file,
            field="pipeline.model._target",
            fix="give --assume-splatfacto to bound its Gaussians alone",
        )
    if not assumed and unknown:
        raise InputError(
            f"holds modules that Splatfacto does not have: {visible(', '.join(unknown[:_SHOWN]))}",
            file=checkpoint,
            field="pipeline",
            fix="give --assume-splatfacto to bound its Gaussians alone",
        )
    gaussians_alone = bool(unknown) or bool(name and name not in _CLASSES)
    origin = "config.yml: pipeline.model._target" if name else "default: config.yml names no class"
    records = [Assumption("model", visible(name) or "SplatfactoModel", origin)]
    if gaussians_alone:
        left = f", without {visible(', '.join(unknown[:_SHOWN]))}" if unknown else ""
        records.append(Assumption("bounded", f"the Gaussians alone{left}", "--assume-splatfacto"))
    return gaussians_alone, (*records, *runs.idle_assumptions(state, _IDLE))


def _known(key: str) -> bool:
    return key.removeprefix("gauss_params.") in _PARAMETERS or key.startswith(tuple(_IDLE))


def _module(key: str) -> str:
    """Return the outermost module of a tensor, or the tensor's own name in ``gauss_params``."""
    return key if key.startswith("gauss_params.") else key.partition(".")[0]


def _notes(run: runs.RunConfig) -> list[str]:
    absent = [name for name in _MODEL_DEFAULTS if name not in run.model]
    return [f"config.yml lacks {', '.join(absent)}: the defaults of nerfstudio 1.1.5 are used"] if absent else []


def _run_field(name: str) -> str:
    return f"pipeline._model.gauss_params.{name}"


def _gaussian_state(state: dict[str, Any], file: Path, method: str) -> dict[str, Any]:
    """Return the six parameter tensors by short name."""
    # Old keys win over new ones, as in SplatfactoModel.load_state_dict.
    prefix = "" if "means" in state else "gauss_params."
    if f"{prefix}means" not in state:
        raise InputError(
            f"no Gaussians in this checkpoint (method {show(method)})",
            file=file,
            field=_run_field("means"),
            fix="give a run of splatfacto",
        )
    for name in _PARAMETERS:
        if f"{prefix}{name}" not in state and name != "features_rest":
            raise InputError("missing", file=file, field=_run_field(name), fix="give a run of splatfacto")
    return {name: state.get(f"{prefix}{name}") for name in _PARAMETERS}


def _run_arrays(state: dict[str, Any], file: Path, degree_stored: int, degree: int) -> StoredGaussians:
    count = _row_count(state["means"], file)
    bands = (degree_stored + 1) ** 2
    shapes = {
        "means": (count, 3),
        "scales": (count, 3),
        "quats": (count, 4),
        "features_dc": (count, 3),
        "features_rest": (count, bands - 1, 3),
        "opacities": (count, 1),
    }
    # Twice: the arrays and one copy while rows are selected.
    check_memory(2 * 4 * count * (11 + 3 * bands), file, f"the scene of {count} Gaussians")
    arrays = {}
    for name, shape in shapes.items():
        if name == "features_rest" and state[name] is None and bands == 1:
            arrays[name] = np.zeros(shape, np.float32)
            continue
        stored_shape = tuple(getattr(state[name], "shape", ()))
        if stored_shape != shape and not (name == "opacities" and stored_shape == (count,)):
            fix = "give config.yml and checkpoint of the same run"
            if name == "features_rest":
                fix += f": pipeline.model.sh_degree {degree_stored} there needs {bands - 1} bands"
            problem = f"shape {_shape(stored_shape)}, expected {_shape(shape)}"
            raise InputError(problem, file=file, field=_run_field(name), fix=fix)
        arrays[name] = to_float32(state[name], file, _run_field(name), finite=False).reshape(shape)
    bands_used = (degree + 1) ** 2
    first, rest = arrays["features_dc"][:, None, :], arrays["features_rest"][:, : bands_used - 1, :]
    return StoredGaussians(
        means=arrays["means"],
        log_scales=arrays["scales"],
        quats=arrays["quats"],
        opacity_logits=arrays["opacities"].reshape(count),
        sh=np.concatenate([first, rest], axis=1),
    )


def _shape(shape: tuple[int, ...]) -> str:
    return f"[{', '.join(map(str, shape[:8]))}]"


def _row_count(means: Any, file: Path) -> int:
    shape = tuple(getattr(means, "shape", ()))
    if len(shape) != 2 or shape[0] < 1:
        problem = f"shape {_shape(shape)}, expected [N, 3] with N at least 1"
        raise InputError(problem, file=file, field=_run_field("means"), fix="give a run of splatfacto")
    return shape[0]


def load_ply(path: Path, overrides: Overrides) -> SplatScene:
    """Return the scene of a standard or compressed ``.ply``.

    The background is that of a ``cfg_args`` in the folder that the file was trained in. Raises InputError: for any
    content of the file, or an override, that cannot be used.
    """
    overrides.refuse(("load_step", "assume_splatfacto"), "is for runs, this file is a .ply")
    declared = read_declaration(path, overrides.rasterize_mode is not None)
    if is_compressed(declared.elements):
        decoded = decode_compressed_ply(path, declared.elements, declared.mode, declared.comment)
    else:
        decoded = _decode(path, standard_header(declared, path))
    arguments = inria.arguments_beside(path)
    if arguments is not None:
        background = inria.background(inria.read_arguments(arguments), arguments)
        decoded = replace(
            decoded,
            background=background,
            background_origin=f"{inria.ARGUMENTS}: white_background" if background else "",
        )
    return scene_of(decoded, overrides)


def _decode(path: Path, header: PlyHeader) -> DecodedSplats:
    vertex = read_elements(path, [header.vertex])[header.vertex.name]
    arrays = {name: _columns(vertex, columns) for name, columns in GROUPS.items()}
    count, bands = arrays["means"].shape[0], header.bands
    rest = _columns(vertex, tuple(f"f_rest_{i}" for i in range(3 * (bands - 1))))
    # f_rest is channel-major: f_rest[c * (K - 1) + k].
    rest = rest.reshape(count, 3, bands - 1).transpose(0, 2, 1)
    scales, opacities = arrays["scales"], arrays["opacity"].reshape(count)
    notes = [f"not used: {visible(', '.join(header.unused))}"] if header.unused else []
    if FILTER in header.vertex.types:
        scales, opacities = filtered(scales, opacities, _columns(vertex, (FILTER,))[:, 0])
        notes.append(
            f"{FILTER} is applied to scales and opacities, as mip-splatting does on export; its own rasteriser blurs "
            "by 0.1 square pixels and compensates opacities, gsplat blurs by 0.3"
        )
    return DecodedSplats(
        "a .ply",
        (path,),
        float32_rows(arrays["means"], scales, arrays["quats"], opacities, arrays["f_dc"], rest),
        _FIELDS,
        mode=header.mode,
        mode_origin=f"comment in the file: {visible(header.comment)}" if header.mode else "",
        notes=tuple(notes),
    )


def filtered(
    log_scales: Float32Array, opacity_logits: Float32Array, width: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Return scales and opacities with mip-splatting's 3-D filter, as its ``save_fused_ply`` stores them.

    With s the scales and f the filter's ``width`` [N], the scales become sqrt(s^2 + f^2) and the opacity is multiplied
    by sqrt(prod(s^2) / prod(s^2 + f^2)). Takes logarithms [N, 3] and logits [N]; computed in float64 and rounded once
    to float32; rows of width 0 are unchanged.
    """
    with np.errstate(all="ignore"):
        square = np.square(np.exp(log_scales.astype(np.float64)))
        total = square + np.square(width.astype(np.float64))[:, None]
        weight = np.sqrt(np.prod(square / total, axis=1))
        opacity = weight / (1.0 + np.exp(-opacity_logits.astype(np.float64)))
        scales_and_opacities = (
            (0.5 * np.log(total)).astype(np.float32),
            (np.log(opacity) - np.log1p(-opacity)).astype(np.float32),
        )
    same = width == 0
    return np.where(same[:, None], log_scales, scales_and_opacities[0]), np.where(
        same, opacity_logits, scales_and_opacities[1]
    )


def _columns(vertex: Any, names: tuple[str, ...]) -> Float32Array:
    """Return columns of the vertex table as [N, len(names)] float32."""
    array = np.empty((len(vertex), len(names)), np.float32)
    for i, name in enumerate(names):
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            array[:, i] = vertex[name]
    return array
