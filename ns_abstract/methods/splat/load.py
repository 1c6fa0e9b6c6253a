"""Load a Gaussian-splat scene from an ``ns-train`` run folder or a standard 3DGS ``.ply``.

Decides by what the checkpoint holds (``gauss_params``), not by the class named in config.yml.
Nothing from Nerfstudio is imported and no code in the files is run.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from ns_abstract.io.errors import InputError, visible
from ns_abstract.io.jsonio import file_size, show
from ns_abstract.io.memory import check_memory
from ns_abstract.methods import config_keys, runs
from ns_abstract.methods.checkpoint import require_finite, to_float32
from ns_abstract.methods.splat.scene import DataparserTransform, Float32Array, SplatScene

# nerfstudio/models/splatfacto.py: SplatfactoModel.load_state_dict sets this step.
_STEP_AFTER_LOADING = 30000
_MAX_DEGREE_STORED = 4
_MAX_DEGREE = 3
# nerfstudio/models/splatfacto.py: colour shown outside training for background "random".
_RANDOM_BACKGROUND = (0.1490, 0.1647, 0.2157)
_MODEL_DEFAULTS: dict[str, Any] = {
    "sh_degree": 3,
    "sh_degree_interval": 1000,
    "rasterize_mode": "classic",
    "background_color": "random",
}
_PARAMETERS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")

#: Least squared length of a quaternion. Each of its four squares may be flushed, which changes their sum by 2^-24 of it
#: at most.
_LEAST_QUATERNION = 2.0**-100

_PLY_HEADER_LIMIT = 64 * 2**10
_PLY_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_PLY_FLOATS = ("float", "float32", "double", "float64")
_PLY_BANDS = {0: 0, 9: 1, 24: 2, 45: 3}
_PLY_GROUPS = {
    "means": ("x", "y", "z"),
    "f_dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_PLY_FIX = "export the scene again as a standard, uncompressed 3DGS .ply"


def load_scene(path: str | os.PathLike[str]) -> SplatScene:
    """Read a scene.

    Args:
        path: ``config.yml`` of a run, the run folder that holds it, or a 3DGS ``.ply``.

    Returns:
        The stored parameters; world is the run's normalised frame, or that of the ``.ply``.
        ``sh`` keeps the bands up to the degree that Nerfstudio evaluates after loading.

    Raises:
        InputError: For any content of the files that cannot be used.
    """
    path = Path(path)
    if not os.path.isdir(path):
        file_size(path, "config.yml or .ply", fix="give the config.yml of a run, its folder, or a .ply")
        if path.suffix.lower() == ".ply":
            return _load_ply(path)
        if path.suffix.lower() in (".ckpt", ".pt", ".pth", ".splat", ".spz", ".json"):
            raise InputError(
                f"a {path.suffix} file is not a scene",
                file=path,
                fix="give the config.yml of a run, its folder, or a .ply",
            )
    return _load_run(runs.read_config(path))


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
    """The scene that a loaded Splatfacto model holds, checked as one that is read from files.

    Args:
        parameters: means [N, 3], scales [N, 3], quats [N, 4], features_dc [N, 3], features_rest
            [N, K - 1, 3] and opacities [N, 1], arrays.
        source: Where they are from, for messages.
        name, color_model, sh_degree, rasterize_mode, background: As in `SplatScene`.

    Raises:
        InputError: A value is not finite or cannot be drawn.
    """
    found = {key: np.array(parameters[key], np.float32) for key in _PARAMETERS}
    for key, array in found.items():
        require_finite(array, Path(source), key)
    rest = found["features_rest"][:, : (sh_degree + 1) ** 2 - 1]
    arrays = _Arrays(
        means=found["means"],
        log_scales=found["scales"],
        quats=found["quats"],
        opacity_logits=found["opacities"].reshape(-1),
        sh=np.concatenate([found["features_dc"][:, None], rest], axis=1),
    )
    arrays, dropped = _drawable(arrays, Path(source), {"scales": "scales", "quats": "quats"})
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


@dataclass(frozen=True)
class _Arrays:
    """Stored parameters: [N, 3], [N, 3], [N, 4], [N], [N, K, 3], all finite float32."""

    means: Float32Array
    log_scales: Float32Array
    quats: Float32Array
    opacity_logits: Float32Array
    sh: Float32Array


def _load_run(run: runs.RunConfig) -> SplatScene:
    unused = config_keys.check_keys(run, config_keys.SPLATFACTO)
    degree_stored = run.integer("sh_degree", _MODEL_DEFAULTS["sh_degree"], 0, _MAX_DEGREE_STORED)
    interval = run.integer("sh_degree_interval", _MODEL_DEFAULTS["sh_degree_interval"], 1)
    mode = run.choice("rasterize_mode", _MODEL_DEFAULTS["rasterize_mode"], ("classic", "antialiased"))
    background = run.color("background_color", _MODEL_DEFAULTS["background_color"], {"random": _RANDOM_BACKGROUND})
    degree = min(_STEP_AFTER_LOADING // interval, degree_stored)
    if degree > _MAX_DEGREE:
        raise InputError(
            f"spherical harmonics of degree {degree}",
            file=run.file,
            field="pipeline.model.sh_degree",
            fix=f"train with degree {_MAX_DEGREE} or less",
        )
    transform, notes = runs.read_dataparser_transform(run)
    checkpoint = runs.find_checkpoint(run)
    state = _gaussian_state(runs.read_model_state(checkpoint), checkpoint, run.method_name)
    arrays = _run_arrays(state, checkpoint, degree_stored, degree)
    arrays, dropped = _drawable(arrays, checkpoint, {name: _run_field(name) for name in ("scales", "quats")})
    return SplatScene(
        means=arrays.means,
        log_scales=arrays.log_scales,
        quats=arrays.quats,
        opacity_logits=arrays.opacity_logits,
        sh=arrays.sh,
        color_model="sh" if degree_stored > 0 else "sigmoid",
        sh_degree=degree,
        rasterize_mode=cast(Literal["classic", "antialiased"], mode),
        background=background,
        dataparser=transform,
        name=run.experiment_name,
        source=str(checkpoint),
        **dropped,
        notes=(*notes, *_assumptions(run), *unused),
    )


def _assumptions(run: runs.RunConfig) -> list[str]:
    notes = []
    absent = [name for name in _MODEL_DEFAULTS if name not in run.model]
    if absent:
        notes.append(f"config.yml lacks {', '.join(absent)}: the defaults of nerfstudio 1.1.5 are used")
    target = run.model.get("_target")
    name = target.tag.rpartition(":")[2] if isinstance(target, runs.Tagged) else ""
    if name and name.rpartition(".")[2] != "SplatfactoModel":
        notes.append(f"the model class {show(name)} is rendered as SplatfactoModel")
    return notes


def _run_field(name: str) -> str:
    return f"pipeline._model.gauss_params.{name}"


def _gaussian_state(state: dict[str, Any], file: Path, method: str) -> dict[str, Any]:
    """The six parameter tensors by short name."""
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


def _run_arrays(state: dict[str, Any], file: Path, degree_stored: int, degree: int) -> _Arrays:
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
        found = tuple(getattr(state[name], "shape", ()))
        if found != shape and not (name == "opacities" and found == (count,)):
            fix = "give config.yml and checkpoint of the same run"
            if name == "features_rest":
                fix += f": pipeline.model.sh_degree {degree_stored} there needs {bands - 1} bands"
            problem = f"shape {_shape(found)}, expected {_shape(shape)}"
            raise InputError(problem, file=file, field=_run_field(name), fix=fix)
        arrays[name] = to_float32(state[name], file, _run_field(name)).reshape(shape)
    kept = (degree + 1) ** 2
    first, rest = arrays["features_dc"][:, None, :], arrays["features_rest"][:, : kept - 1, :]
    return _Arrays(
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


def _drawable(arrays: _Arrays, file: Path, fields: dict[str, str]) -> tuple[_Arrays, dict[str, Any]]:
    """Check scales and quaternions; leave out the rows that gsplat can never draw.

    Returns:
        The arrays, and what a `SplatScene` says about the rows left out.
    """
    limits = np.finfo(np.float32)
    # Strictly inside the normal range, so that any float32 exp stays inside it.
    with np.errstate(over="ignore", under="ignore"):
        scales = np.exp(arrays.log_scales.astype(np.float64))
    low, high = float(limits.tiny) * (1 + 1e-6), float(limits.max) * (1 - 1e-6)
    normal = (scales >= low) & (scales <= high)
    _require_rows(normal, file, fields["scales"], "exp of the logarithm is not a normal float32")
    squared = np.square(arrays.quats.astype(np.float64)).sum(axis=1)
    zero = squared == 0
    # Squares that a device flushes to 0 are then part of the kernel's own rounding (design.md, G6); beyond the largest
    # float32, rsqrt(|q|^2) is 0.
    _require_rows(
        zero | ((squared >= _LEAST_QUATERNION) & (squared <= high)),
        file,
        fields["quats"],
        "squared length of the quaternion is below 2^-100 or above the largest float32",
    )
    if zero.all():
        problem = "every quaternion is zero, so nothing is drawn"
        raise InputError(problem, file=file, field=fields["quats"], fix="train again")
    if not zero.any():
        return arrays, {}
    kept = {name: np.ascontiguousarray(value[~zero]) for name, value in vars(arrays).items()}
    return _Arrays(**kept), {"dropped": {"zero quaternion": int(zero.sum())}, "stored": np.flatnonzero(~zero)}


def _require_rows(good: Any, file: Path, field: str, problem: str) -> None:
    bad = ~good.reshape(good.shape[0], -1).all(axis=1)
    if bad.any():
        rows = np.flatnonzero(bad)
        raise InputError(
            f"{problem} in {len(rows)} rows, the first is row {int(rows[0])}",
            file=file,
            field=field,
            fix="remove these rows or train again",
        )


@dataclass(frozen=True)
class _PlyElement:
    name: str
    count: int
    types: dict[str, str]  # property name -> scalar type, or "list"

    def least_size(self, ascii_text: bool) -> int:
        """Bytes that the rows take at the least."""
        if ascii_text:
            return self.count * max(1, 2 * len(self.types))
        return self.count * sum(_PLY_SIZES.get(kind, 1) for kind in self.types.values())


def _load_ply(path: Path) -> SplatScene:
    element, bands = _check_ply(path)
    vertex = _read_vertex(path, element)
    arrays = {name: _columns(vertex, columns, path) for name, columns in _PLY_GROUPS.items()}
    count = arrays["means"].shape[0]
    rest = _columns(vertex, tuple(f"f_rest_{i}" for i in range(3 * (bands - 1))), path)
    # f_rest is channel-major: f_rest[c * (K - 1) + k].
    rest = rest.reshape(count, 3, bands - 1).transpose(0, 2, 1)
    found = _Arrays(
        means=arrays["means"],
        log_scales=arrays["scales"],
        quats=arrays["quats"],
        opacity_logits=arrays["opacity"].reshape(count),
        sh=np.ascontiguousarray(np.concatenate([arrays["f_dc"][:, None, :], rest], axis=1)),
    )
    found, dropped = _drawable(found, path, {"scales": "vertex.scale_*", "quats": "vertex.rot_*"})
    return SplatScene(
        **vars(found),
        color_model="sh",
        sh_degree=_PLY_BANDS[3 * (bands - 1)],
        dataparser=DataparserTransform(),
        name=visible(path.stem),
        source=str(path),
        **dropped,
    )


def _read_vertex(path: Path, element: _PlyElement) -> Any:
    import plyfile

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            vertex = plyfile.PlyData.read(str(path))["vertex"].data
            if len(vertex) != element.count or vertex.dtype.names != tuple(element.types):
                raise ValueError("ambiguous header")
            return vertex
    except MemoryError:
        raise
    except Exception as error:  # numpy and plyfile raise many types on damaged files
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(f"damaged .ply: {text}", file=path, fix=_PLY_FIX) from None


def _columns(vertex: Any, names: tuple[str, ...], path: Path) -> Float32Array:
    """Columns of the vertex table as [N, len(names)] float32."""
    array = np.empty((len(vertex), len(names)), np.float32)
    for i, name in enumerate(names):
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            array[:, i] = vertex[name]
        require_finite(array[:, i], path, f"vertex.{name}")
    return array


def _check_ply(path: Path) -> tuple[_PlyElement, int]:
    """Check the header against the size of the file; return the vertex element and K."""
    size = file_size(path, ".ply")
    try:
        with path.open("rb") as stream:
            head = stream.read(_PLY_HEADER_LIMIT)
    except OSError as error:
        message = error.strerror or type(error).__name__
        raise InputError(f".ply cannot be read: {message}", file=path, fix="check the permissions") from None
    end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
    if not head.startswith((b"ply\n", b"ply\r\n")) or end is None:
        raise InputError("not a .ply file with a header", file=path, fix=_PLY_FIX)
    ascii_text, elements = _parse_header(head[: end.start()], path)
    for element in elements:
        if element.count and (not element.types or "list" in element.types.values()):
            problem = "has list properties" if element.types else "has no properties"
            raise InputError(problem, file=path, field=f"element {element.name}", fix=_PLY_FIX)
    needed = sum(element.least_size(ascii_text) for element in elements)
    # The last line of a text file may lack its line break.
    if needed - ascii_text > size - end.end():
        raise InputError(
            f"the header claims at least {needed} bytes of data, {size - end.end()} follow",
            file=path,
            field="header",
            fix="the file is cut off: copy or export it again",
        )
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None or vertex.count < 1:
        raise InputError("no Gaussians", file=path, field="element vertex", fix=_PLY_FIX)
    bands = _vertex_bands(vertex, path)
    check_memory(2 * 4 * vertex.count * (11 + 3 * bands), path, f"the scene of {vertex.count} Gaussians")
    return vertex, bands


def _vertex_bands(vertex: _PlyElement, path: Path) -> int:
    rest = [name for name in vertex.types if name.startswith("f_rest_")]
    if len(rest) not in _PLY_BANDS or set(rest) != {f"f_rest_{i}" for i in range(len(rest))}:
        raise InputError(
            f"{len(rest)} properties, expected f_rest_0 to f_rest_8, f_rest_23 or f_rest_44, or none",
            file=path,
            field="vertex.f_rest_*",
            fix=_PLY_FIX,
        )
    for name in [*(column for group in _PLY_GROUPS.values() for column in group), *rest]:
        kind = vertex.types.get(name)
        if kind is None:
            fix = _PLY_FIX
            if name.startswith("f_dc") and "red" in vertex.types:
                fix = "export with --ply-color-mode sh_coeffs"
            raise InputError("property missing", file=path, field=f"vertex.{name}", fix=fix)
        if kind not in _PLY_FLOATS:
            raise InputError(f"type {kind}, expected float", file=path, field=f"vertex.{name}", fix=_PLY_FIX)
    return len(rest) // 3 + 1


def _parse_header(header: bytes, path: Path) -> tuple[bool, list[_PlyElement]]:
    """Whether the data is text, and the declared elements."""
    formats: list[str] = []
    elements: list[_PlyElement] = []
    for number, line in enumerate(header.decode("latin-1").split("\n")[1:], start=2):
        words = line.split()
        good = True
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3:
            formats.append(words[1])
        elif words[0] == "element" and len(words) == 3 and re.fullmatch(r"[0-9]{1,12}", words[2]):
            elements.append(_PlyElement(words[1], int(words[2]), {}))
        elif words[0] == "property" and elements and len(words) in (3, 5):
            kind = "list" if words[1] == "list" else words[1]
            good = words[-1] not in elements[-1].types
            good = good and (kind == "list" if len(words) == 5 else kind in _PLY_SIZES)
            elements[-1].types[words[-1]] = kind
        else:
            good = False
        if not good:
            raise InputError(f"line {number}: {show(line.strip())}", file=path, field="header", fix=_PLY_FIX)
    if formats not in (["ascii"], ["binary_little_endian"], ["binary_big_endian"]):
        raise InputError(f"format {show(' '.join(formats))}", file=path, field="header", fix=_PLY_FIX)
    return formats == ["ascii"], elements
