"""The checker's own reading of run folders, .ply files, camera paths and perturbation files; nothing in them is run."""

from __future__ import annotations

import hashlib
import json
import math
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from ns_abstract.check.poses import SHIFTS, TURNS, Camera, Poses
from ns_abstract.check.splats import RULES, Splats, activated

Array = Any

_COLORS = {
    "random": (0.1490, 0.1647, 0.2157), "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0),
    "red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0), "blue": (0.0, 0.0, 1.0),
}  # fmt: skip
#: Bytes of the largest text that is read.
_TEXT = 256 << 20
_MODES = {"classic": "classic", "default": "classic", "antialiased": "antialiased", "mip": "antialiased"}


class BadInput(ValueError):
    """A file or a field of it cannot be used: ``file``, ``field``, what is wrong, and ``fix``."""

    def __init__(self, problem: str, file: Any = None, field: str | None = None, fix: str | None = None) -> None:
        super().__init__(problem)
        self.problem, self.file, self.field, self.fix = problem, file, field, fix


def read_json(file: Path, what: str, fix: str | None = None) -> dict[str, Any]:
    """A JSON object."""
    try:
        if not file.is_file():
            raise BadInput(f"no such {what}", file, fix=fix)
        if file.stat().st_size > _TEXT:
            raise BadInput(f"this {what} is too large", file, fix=fix)
        found = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(f"this {what} cannot be read", file, fix=fix) from None
    if not isinstance(found, dict):
        raise BadInput("the top level is not an object", file, fix=fix)
    return found


class _Inert(yaml.SafeLoader):
    """Keeps what Python objects are made of, and makes none."""


def _plain(loader: Any, suffix: str, node: Any) -> Any:
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_scalar(node)


_Inert.add_multi_constructor("tag:yaml.org,2002:python/", _plain)
_Inert.add_multi_constructor("!", _plain)


def read_scene(file: Path, settings: dict[str, Any], about: dict[str, Any], version: str) -> tuple[Splats, str]:
    """The scene that a result is about, and the digest that its report must give.

    Args:
        file: config.yml or .ply.
        settings: The options that the result was made with.
        about: The report's ``scene``.
        version: gsplat's.
    """
    if file.is_dir():
        file = file / "config.yml"
    if not file.is_file():
        raise BadInput("no such run", file, fix="say with --load-config where the scene lies now")
    stored, mode, background, sigmoid, degree = (_read_ply if file.suffix == ".ply" else _read_run)(file, settings)
    mode = settings.get("rasterize_mode") or mode
    if settings.get("background") is not None:
        background = settings["background"]
    background = np.array(background, np.float32)
    squares = np.square(stored[2].astype(np.float64)).sum(axis=1)
    stored = [np.ascontiguousarray(a[squares > 0.0], np.float32) for a in stored]
    if settings.get("drop_nan_gaussians"):
        good = np.all([np.isfinite(a).reshape(len(a), -1).all(axis=1) for a in stored], axis=0)
        stored = [np.ascontiguousarray(a[good]) for a in stored]
    if not all(np.isfinite(a).all() for a in stored):
        raise BadInput("holds numbers that are not finite", file)
    if mode != about.get("rasterize_mode") or [float(v) for v in background] != about.get("background"):
        raise BadInput("the result was made with another mode or background", file, fix="give the run of the result")
    digest = hashlib.sha256()
    for array in (*stored, background):
        digest.update(np.ascontiguousarray(array, np.float32).tobytes())
    digest.update(repr(("sigmoid" if sigmoid else "sh", degree, mode)).encode())
    found = activated(
        *stored,
        sigmoid=sigmoid,
        degree=degree,
        antialiased=mode == "antialiased",
        background=background,
        version=version,
    )
    return found, digest.hexdigest()


def _read_run(file: Path, settings: dict[str, Any]) -> tuple[list[Array], str, Any, bool, int]:
    try:
        loader = _Inert(file.read_text(encoding="utf-8"))
        root = loader.get_single_data()
        model = root["pipeline"]["model"]
        target = str(root["relative_model_dir"] if isinstance(root.get("relative_model_dir"), str) else "")
        parts = root.get("relative_model_dir")
        folder = file.parent / (target or "/".join(parts) if parts else "nerfstudio_models")
        step = settings.get("load_step")
        step = root.get("load_step") if step is None else step
        degree, interval = int(model.get("sh_degree", 3)), int(model.get("sh_degree_interval", 1000))
        mode, color = model.get("rasterize_mode", "classic"), model.get("background_color", "random")
        background = _COLORS[color.lower()] if isinstance(color, str) else [float(v) for v in color]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, yaml.YAMLError):
        raise BadInput("cannot be read as a Splatfacto run's configuration", file) from None
    names = {
        int(m[1]): p for p in sorted(folder.glob("step-*.ckpt")) if (m := re.fullmatch(r"step-(\d+)\.ckpt", p.name))
    }
    if not names or (step is not None and int(step) not in names):
        raise BadInput("no such checkpoint" if names else "no checkpoints", folder, fix="give the whole run folder")
    checkpoint = names[max(names) if step is None else int(step)]
    state = _state(checkpoint)
    prefix = "" if "means" in state else "gauss_params."
    try:
        a = {n: state[prefix + n].float().numpy() for n in ("means", "scales", "quats", "opacities", "features_dc")}
        rest = state[f"{prefix}features_rest"].float().numpy()[:, : (min(30000 // interval, degree) + 1) ** 2 - 1]
        count = len(a["means"])
        sh = np.concatenate([a["features_dc"].reshape(count, 1, 3), rest.reshape(count, -1, 3)], axis=1)
        stored = [a["means"], a["scales"], a["quats"], a["opacities"].reshape(-1), sh]
    except (KeyError, ValueError, AttributeError):
        raise BadInput("holds no Gaussians of Splatfacto", checkpoint) from None
    return stored, mode, background, degree == 0, min(30000 // interval, degree)


def _state(checkpoint: Path) -> dict[str, Any]:
    """The model's tensors by their names in the model."""
    scalar = np.float64(0.0).__reduce__()[0]
    kinds = [type(np.dtype(code)) for code in ("f8", "f4", "i8", "i4", "?")]
    safe = [(scalar, "numpy.core.multiarray.scalar"), (scalar, "numpy._core.multiarray.scalar"), np.dtype, *kinds]
    try:
        with torch.serialization.safe_globals(safe), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            root = torch.load(checkpoint, map_location="cpu", weights_only=True)
        pipeline = root["pipeline"]
        names = {key.removeprefix("module."): value for key, value in pipeline.items()}
    except Exception:  # torch raises whatever a damaged file makes it run into
        raise BadInput("cannot be read as a checkpoint", checkpoint) from None
    return {
        key.removeprefix("_model.").removeprefix("module."): v for key, v in names.items() if key.startswith("_model.")
    }


def _read_ply(file: Path, settings: dict[str, Any]) -> tuple[list[Array], str, Any, bool, int]:
    import plyfile

    try:
        data = plyfile.PlyData.read(str(file))
        vertex = data["vertex"].data
        columns = {name: np.asarray(vertex[name], np.float32) for name in vertex.dtype.names}
        rest = [columns[f"f_rest_{k}"] for k in range(sum(name.startswith("f_rest_") for name in columns))]
        dc = np.stack([columns[f"f_dc_{k}"] for k in range(3)], axis=1)[:, None]
        more = np.stack(rest, axis=1).reshape(len(dc), 3, -1).transpose(0, 2, 1) if rest else dc[:, :0]
        sh = np.concatenate([dc, more], axis=1)
        groups = (("x", "y", "z"), [f"scale_{k}" for k in range(3)], [f"rot_{k}" for k in range(4)])
        stored = [np.stack([columns[name] for name in group], axis=1) for group in groups]
        stored += [columns["opacity"], sh]
    except Exception:  # plyfile raises whatever a damaged file makes it run into
        raise BadInput("cannot be read as a 3DGS .ply", file) from None
    mode = "classic"
    for comment in (*data.comments, *data.obj_info):
        match = re.fullmatch(r"splatrendermode\b[\s:=]*(.*)", comment.strip(), re.IGNORECASE)
        if match:
            said = match[1].strip().strip("'\"").lower()
            if said not in _MODES and not settings.get("rasterize_mode"):
                raise BadInput(f"found {said!r}", file, "comment SplatRenderMode", "give a scene of 3D Gaussians")
            mode = _MODES.get(said, mode)
    degree = math.isqrt(sh.shape[1]) - 1
    # a file of degree 0 holds spherical harmonics, too
    return stored, mode, (0.0, 0.0, 0.0), False, degree


def dataset_scale(config: Path) -> float:
    """Normalised units per unit of transforms.json."""
    file = (config if config.is_dir() else config.parent) / "dataparser_transforms.json"
    return float(read_json(file, "dataparser transform")["scale"]) if file.is_file() else 1.0


def read_poses(
    path: Path, given: dict[str, Any] | None, frame: int, settings: dict[str, Any], scale: float
) -> tuple[Poses, Any]:
    """The poses of a frame, and its box of parameters as [(name, lower, upper)].

    Args:
        path: The camera path.
        given: The perturbation object of another file or of options, which wins over the path's.
        frame: Number in the path.
        settings: The options that the result was made with.
        scale: `dataset_scale`.
    """
    root = read_json(path, "camera path", "say with --camera-path-filename where it lies now")
    try:
        entries = root["camera_path"]
        own = entries[frame].get("perturbation") or root.get("perturbation") or {}
        spec = own if given is None else given
        camera = _camera(root, entries[frame], float(settings.get("downscale_factor") or 1.0))
        after = entries[(frame + 1) % len(entries)]
        following = np.array(after["camera_to_world"], np.float64).reshape(4, 4)[:3]
        turn = math.pi / 180.0 if spec.get("angle_units", "radians") == "degrees" else 1.0
        length = scale if spec.get("units", "normalised") == "dataset" else 1.0
        ranges = {}
        for key, names, factor in (("translation", SHIFTS, length), ("rotation", tuple(TURNS), turn)):
            for name in names:
                ends = spec.get(key, {}).get(name, 0.0)
                low, high = (-ends, ends) if isinstance(ends, (int, float)) else ends
                ranges[name] = (factor * low, factor * high) if factor != 1.0 else (float(low), float(high))
        if spec.get("sweep", "keyframes") == "segments":
            ranges["segment"] = (0.0, 1.0)
        orbit = spec.get("orbit")
        if orbit is not None:
            ends = orbit["azimuth"]
            low, high = (-ends, ends) if isinstance(ends, (int, float)) else ends
            ranges["azimuth"] = (turn * low, turn * high)
            orbit = (np.array(orbit["target"], np.float64), np.array(orbit["axis"], np.float64))
    except (KeyError, IndexError, TypeError, ValueError, AttributeError):
        raise BadInput(f"frame {frame} or its set of poses cannot be read", path) from None
    for name in ("scene", "hue", "saturation"):
        if spec.get(name) is not None:
            raise BadInput(f"the set varies {name}, which this program does not check", path, f"perturbation.{name}")
    free = [(name, low, high) for name, (low, high) in ranges.items() if low < high]
    poses = Poses(
        camera,
        tuple(name for name, _, _ in free),
        {
            name: low
            for name, (low, high) in ranges.items()
            if low == high and (low != 0.0 or name in ("segment", "azimuth"))
        },
        spec.get("frame", "camera") == "world",
        orbit,
        following if "segment" in ranges else None,
    )
    return poses, free


def given_set(settings: dict[str, Any], moved: Path | None) -> dict[str, Any] | None:
    """The perturbation object that the options name; None: the path's own."""
    axes = {"translation": SHIFTS, "rotation": tuple(TURNS)}
    if any(settings.get(name) is not None for name in axes):
        found: dict[str, Any] = {name: settings.get(name) for name in ("units", "angle_units") if settings.get(name)}
        for name, keys in axes.items():
            radii = settings.get(name)
            if radii is not None:
                found[name] = dict(zip(keys, radii if len(radii) == 3 else list(radii) * 3, strict=True))
        return found
    file = moved or settings.get("perturbation_filename")
    if file is None:
        return None
    root = read_json(Path(file), "perturbation file", "say with --perturbation-filename where it lies now")
    return root["perturbation"] if "camera_path" in root and "perturbation" in root else root


def _camera(root: dict[str, Any], entry: dict[str, Any], down: float) -> Camera:
    pose = np.array(entry["camera_to_world"], np.float64).reshape(4, 4)[:3]
    width, height = int(root["render_width"]), int(root["render_height"])
    fov = entry.get("fov")
    fov = root["default_fov"] if fov is None else fov
    focal = float(height / 2.0 / np.tan(float(fov) * (np.pi / 180.0) / 2.0))
    if down == 1.0:
        return Camera(pose, focal, focal, width / 2.0, height / 2.0, width, height)
    # nerfstudio holds the factor and the centre in float32
    scale = np.float32(1.0 / down)
    cx, cy = (float(np.float32(side / 2.0) * scale) for side in (width, height))
    wide, tall = (int(np.float32(side) * scale) for side in (width, height))
    return Camera(pose, focal * float(scale), focal * float(scale), cx, cy, wide, tall)


__all__ = ["RULES", "BadInput", "dataset_scale", "given_set", "read_json", "read_poses", "read_scene"]
