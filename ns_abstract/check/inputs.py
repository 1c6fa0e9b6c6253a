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

from ns_abstract.check.fields import CheckedField
from ns_abstract.check.poses import SHIFTS, TURNS, CheckedCamera, Poses
from ns_abstract.check.splats import ActivatedScene, activated

Array = Any

_COLORS = {
    "random": (0.1490, 0.1647, 0.2157), "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0),
    "red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0), "blue": (0.0, 0.0, 1.0),
}  # fmt: skip
#: Bytes of the largest text that is read.
_TEXT = 256 << 20
_MODES = {"mip": "antialiased", "1": "antialiased", "true": "antialiased"}
_MODES |= {"default": "classic", "0": "classic", "false": "classic"}
_MOVED = "say with --load-config where the scene lies now"
_SCENE = "give the run of the result"
_CONVERT = "of another format: ns-abstract-export ply --load-config FILE --output-filename scene.ply, then check with "
_CONVERT += "--load-config scene.ply; the digest says whether these are the result's numbers"


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
        content = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(f"this {what} cannot be read", file, fix=fix) from None
    if not isinstance(content, dict):
        raise BadInput("the top level is not an object", file, fix=fix)
    return content


def read_scene(file: Path, report: dict[str, Any]) -> ActivatedScene | CheckedField:
    """The scene that a result is about: what its digest in the report says, or nothing.

    Args:
        file: config.yml, its folder or .ply.
        report: Of the result.
    """
    settings, about, renderer = report["settings"], report["scene"], report["renderer"]
    folder = file.is_dir()
    file = file / "config.yml" if folder else file
    if not file.is_file():
        raise BadInput("no such run", file, fix=_CONVERT if folder else _MOVED)
    with file.open("rb") as stream:
        ply = stream.read(4) in (b"ply\n", b"ply\r")
    if renderer["name"] == "nerf-uniform":
        scene, digest = _read_field(*_read_run(file, settings), file, settings, renderer)
        digest = digest.hexdigest()
    else:
        (*stored, mode, background, sigmoid, degree) = (_read_ply if ply else _read_splats)(file, settings)
        mode, background = settings.get("rasterize_mode") or mode, settings.get("background") or background
        background = np.array(background, np.float32)
        if mode != about.get("rasterize_mode") or [float(v) for v in background] != about.get("background"):
            raise BadInput("the result was made with another mode or background", file, fix=_SCENE)
        stored = [np.ascontiguousarray(a, np.float32) for a in _drawn(stored, file, settings)]
        digest = hashlib.sha256(b"".join(a.tobytes() for a in (*stored, background)))
        digest.update(repr(("sigmoid" if sigmoid else "sh", degree, mode)).encode())
        about = {"sigmoid": sigmoid, "degree": degree, "antialiased": mode == "antialiased", "background": background}
        scene, digest = activated(*stored, **about, version=renderer["version"]), digest.hexdigest()
    if digest != report["fingerprint"].get("scene"):
        raise BadInput("is not the scene of the result (its digest differs)", file, fix=_SCENE)
    return scene


def _drawn(stored: list[Array], file: Path, settings: dict[str, Any]) -> list[Array]:
    """The Gaussians that gsplat draws: those of finite means and quaternions, and of scales that are numbers."""
    means, logs, quats, logits, sh = stored
    with np.errstate(over="ignore", invalid="ignore"):
        squares, scales = np.square(quats.astype(np.float64)).sum(axis=1), np.exp(logs.astype(np.float64))
    drawn = np.isfinite(means).all(1) & np.isfinite(quats).all(1) & ~np.isnan(logs).any(1) & (squares > 0.0)
    whole = (scales <= np.finfo(np.float32).max * (1.0 - 1e-6)).all(1) & ~np.isnan(logits) & np.isfinite(sh).all((1, 2))
    if (drawn & ~whole).any() and not settings.get("drop_nan_gaussians"):
        raise BadInput("holds numbers that are not finite", file)
    return [a[drawn & whole] for a in stored]


def _read_run(file: Path, settings: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """A run's model configuration and its tensors by their names in the model."""
    try:
        # makes texts, lists and mappings of whatever Python objects are written down
        root = yaml.BaseLoader(file.read_text(encoding="utf-8")).get_single_data()
        model, parts = dict(root["pipeline"]["model"]), root.get("relative_model_dir") or "nerfstudio_models"
        folder = file.parent / (parts if isinstance(parts, str) else "/".join(parts))
        step = root.get("load_step", "null") if settings.get("load_step") is None else settings["load_step"]
        step = None if step in ("null", "") else int(step)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, yaml.YAMLError):
        raise BadInput("cannot be read as a run's configuration", file, fix=_CONVERT) from None
    steps = ((re.fullmatch(r"step-(\d+)\.ckpt", p.name), p) for p in sorted(folder.glob("step-*.ckpt")))
    names = {int(match[1]): p for match, p in steps if match}
    if not names or (step is not None and step not in names):
        raise BadInput("no such checkpoint" if names else "no checkpoints", folder, fix="give the whole run folder")
    checkpoint = names[max(names) if step is None else step]
    scalar, kinds = np.float64(0.0).__reduce__()[0], [type(np.dtype(code)) for code in ("f8", "f4", "i8", "i4", "?")]
    safe = [(scalar, "numpy.core.multiarray.scalar"), (scalar, "numpy._core.multiarray.scalar"), np.dtype, *kinds]
    try:
        with torch.serialization.safe_globals(safe), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            state = torch.load(checkpoint, map_location="cpu", weights_only=True)["pipeline"]
        state = {key.removeprefix("module."): value for key, value in state.items()}
    except Exception:  # torch raises whatever a damaged file makes it run into
        raise BadInput("cannot be read as a checkpoint", checkpoint) from None
    inside = ((key.removeprefix("_model."), value) for key, value in state.items() if key.startswith("_model."))
    return model, {key.removeprefix("module."): value for key, value in inside}


def _color(value: Any) -> tuple[float, ...]:
    return _COLORS[value.lower()] if isinstance(value, str) else tuple(float(v) for v in value)


def _read_splats(file: Path, settings: dict[str, Any]) -> tuple[Any, ...]:
    model, state = _read_run(file, settings)
    prefix = "" if "means" in state else "gauss_params."
    try:
        stored, interval = int(model.get("sh_degree", 3)), int(model.get("sh_degree_interval", 1000))
        degree = min(30000 // interval, stored)
        a = {n: state[prefix + n].float().numpy() for n in ("means", "scales", "quats", "opacities", "features_dc")}
        count, rest = len(a["means"]), state.get(f"{prefix}features_rest", torch.zeros(0)).float().numpy()
        rest = rest.reshape(count, -1, 3)[:, : (degree + 1) ** 2 - 1]
        sh = np.concatenate([a["features_dc"].reshape(count, 1, 3), rest], axis=1)
        background = _color(model.get("background_color", "random"))
        if not count:
            raise ValueError("no Gaussians")
        rows = a["means"], a["scales"], a["quats"], a["opacities"].reshape(-1), sh
    except (KeyError, ValueError, TypeError, AttributeError, ZeroDivisionError):
        raise BadInput("holds no Gaussians of Splatfacto", file) from None
    return *rows, model.get("rasterize_mode", "classic"), background, stored == 0, degree


def _read_ply(file: Path, settings: dict[str, Any]) -> tuple[Any, ...]:
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
        if not len(dc):
            raise ValueError("no Gaussians")
    except Exception:  # plyfile raises whatever a damaged file makes it run into
        raise BadInput("cannot be read as a 3DGS .ply", file, fix=_CONVERT) from None
    if "filter_3D" in columns:
        raise BadInput("has a filter, which this program does not apply", file, "filter_3D", _CONVERT)
    mode = "classic"
    for line in (*data.comments, *data.obj_info):
        match = re.fullmatch(r"(splatrendermode|antialiased)\b[\s:=]*(.*)", line.strip(), re.IGNORECASE)
        if match:
            value = match[2].strip().strip("'\"").lower()
            matches = value in _MODES and (value in ("mip", "default")) == (match[1].lower() == "splatrendermode")
            if not matches and not settings.get("rasterize_mode"):
                raise BadInput(f"found {value!r}", file, f"comment {match[1]}", "give a scene of 3D Gaussians")
            mode = _MODES[value] if matches else "classic"
    # a file of degree 0 holds spherical harmonics, too
    return *stored, columns["opacity"], sh, mode, (0.0, 0.0, 0.0), False, math.isqrt(sh.shape[1]) - 1


def _read_field(model: dict[str, Any], state: dict[str, Any], file: Path, settings: Any, renderer: Any) -> Any:
    """The fine field of vanilla-nerf on equal bins, and the digest of what is drawn."""
    if settings.get("occupancy_grid"):
        raise BadInput("is declared empty by a grid, which this program does not read", file, "occupancy_grid")
    try:
        params = model.get("collider_params") or {}
        far, near = float(params.get("far_plane", 6.0)), float(settings.get("near_plane") or 0.0)
        background = settings.get("background") or (0.0,) * 3
        if not settings.get("background") and model.get("background_color", "white") != "random":
            background = _color(model.get("background_color", "white"))
        background = tuple(float(np.float32(v)) for v in background)
        field = CheckedField({k: v.float().numpy() for k, v in state.items() if k.startswith("field_fine.")})
        field.near, field.far, field.samples, field.background = near, far, int(renderer["samples"]), background
    except (KeyError, ValueError, TypeError, AttributeError):
        raise BadInput("holds no field of vanilla-nerf", file) from None
    digest = hashlib.sha256()
    for array in field.arrays:
        digest.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    codes = ", ".join(f"Encoding(count={n}, least=0.0, most={m})" for n, m in field.counts)
    sampling = f"near={near!r}, far={far!r}, samples={field.samples}, importance=0, background={background!r}"
    digest.update(f"({codes}, Sampling(kind='uniform', {sampling}))".encode())
    return field, digest


def dataset_scale(config: Path) -> float:
    """Normalised units per unit of transforms.json."""
    file = (config if config.is_dir() else config.parent) / "dataparser_transforms.json"
    return float(read_json(file, "dataparser transform")["scale"]) if file.is_file() else 1.0


def read_poses(path: Path, given: dict[str, Any] | None, frame: int, settings: dict[str, Any], scale: float) -> Any:
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
        entries, angle = root["camera_path"], math.pi / 180.0
        spec = (entries[frame].get("perturbation") or root.get("perturbation") or {}) if given is None else given
        camera = _camera(root, entries[frame], float(settings.get("downscale_factor") or 1.0))
        cycle = frame + 1 < len(entries) or (root.get("is_cycle") is True and len(entries) > 1)
        swept = spec.get("sweep", "keyframes") == "segments" and cycle
        following = np.array(entries[(frame + 1) % len(entries)]["camera_to_world"], np.float64).reshape(4, 4)[:3]
        turn = angle if spec.get("angle_units", "radians") == "degrees" else 1.0
        length = scale if spec.get("units", "normalised") == "dataset" else 1.0
        orbit, ends = spec.get("orbit"), {}
        for key, names, factor in (("translation", SHIFTS, length), ("rotation", tuple(TURNS), turn)):
            ends |= {name: (spec.get(key, {}).get(name, 0.0), factor) for name in names}
        ends |= {"segment": ((0.0, 1.0), 1.0)} if swept else {}
        if orbit is not None:
            ends["azimuth"] = (orbit["azimuth"], turn)
            orbit = (np.array(orbit["target"], np.float64), np.array(orbit["axis"], np.float64))
        ranges = {}
        for name, (value, factor) in ends.items():
            low, high = (-value, value) if isinstance(value, (int, float)) else value
            ranges[name] = (factor * low, factor * high) if factor != 1.0 else (float(low), float(high))
    except (KeyError, IndexError, TypeError, ValueError, AttributeError):
        raise BadInput(f"frame {frame} or its set of poses cannot be read", path) from None
    for name in ("scene", "hue", "saturation"):
        if spec.get(name) is not None:
            raise BadInput(f"the set varies {name}, which this program does not check", path, f"perturbation.{name}")
    free = [(name, low, high) for name, (low, high) in ranges.items() if low < high]
    point = {n: a for n, (a, b) in ranges.items() if a == b and (a != 0.0 or n in ("segment", "azimuth"))}
    world, names = spec.get("frame", "camera") == "world", tuple(name for name, _, _ in free)
    return Poses(camera, names, point, world, orbit, following if swept else None), free


def given_set(settings: dict[str, Any], moved: Path | None) -> dict[str, Any] | None:
    """The perturbation object that the options name; None: the path's own."""
    axes = {"translation": SHIFTS, "rotation": tuple(TURNS)}
    if any(settings.get(name) is not None for name in axes):
        units: dict[str, Any] = {name: settings.get(name) for name in ("units", "angle_units") if settings.get(name)}
        radii = {name: settings[name] for name in axes if settings.get(name) is not None}
        return units | {n: dict(zip(axes[n], v if len(v) == 3 else list(v) * 3, strict=True)) for n, v in radii.items()}
    file = moved or settings.get("perturbation_filename")
    if file is None:
        return None
    root = read_json(Path(file), "perturbation file", "say with --perturbation-filename where it lies now")
    return root["perturbation"] if "camera_path" in root and "perturbation" in root else root


def _camera(root: dict[str, Any], entry: dict[str, Any], down: float) -> CheckedCamera:
    pose = np.array(entry["camera_to_world"], np.float64).reshape(4, 4)[:3]
    width, height = int(root["render_width"]), int(root["render_height"])
    own = {key: root.get(key) if entry.get(key) is None else entry[key] for key in ("fx", "fy", "cx", "cy")}
    fov = root.get("default_fov") if entry.get("fov") is None else entry["fov"]
    fx, fy, cx, cy = lens(own, fov, width, height)
    if down == 1.0:
        return CheckedCamera(pose, fx, fy, cx, cy, width, height)
    # nerfstudio holds the factor and the centre in float32
    scale = np.float32(1.0 / down)
    cx, cy = (float(np.float32(place) * scale) for place in (cx, cy))
    wide, tall = (int(np.float32(side) * scale) for side in (width, height))
    return CheckedCamera(pose, fx * float(scale), fy * float(scale), cx, cy, wide, tall)


def lens(own: dict[str, Any], fov: Any, width: float, height: float) -> tuple[float, float, float, float]:
    """fx, fy, cx and cy in pixels: those of ``own`` that are stated, else by the vertical angle and the middle."""
    if own.get("fx") is None:
        fx = float(height / 2.0 / np.tan(float(fov) * (np.pi / 180.0) / 2.0))
    else:
        fx = float(own["fx"])
    fy = fx if own.get("fy") is None else float(own["fy"])
    cx, cy = (float(side / 2.0 if own.get(n) is None else own[n]) for n, side in (("cx", width), ("cy", height)))
    return fx, fy, cx, cy
