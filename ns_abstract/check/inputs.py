"""The checker's own reader of run folders, .ply files, camera paths and perturbation files; it runs nothing in them."""

from __future__ import annotations

import hashlib
import json
import math
import re
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
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
#: Keys of objects, by their kind or the key that holds them, and words that may stand under a key.
_KEYS = {
    "picture": "type channel statistic region minus min max", "visible": "type select region weight fraction pixels",
    "clear": "type distance region weight units measure", "all": "", "any": "", "select": "box",
    "class": "type label", "preprocess": "resize", "input": "resize mean std layout channels range",
    "loop": "version initial steps sampling_time dynamics disturbance camera control unsafe goal",
    "dynamics": "type A B c", "control": "gain goal clip", "unsafe": "box half_space", "goal": "box when",
    "half_space": "normal at_least", "camera": "camera_to_world fov fx fy cx cy position yaw pitch roll",
    "perturbation": "version frame units translation angle_units rotation sweep orbit",
    "translation": "x y z", "rotation": "yaw pitch roll", "orbit": "target axis azimuth",
    "position": "offset matrix", "yaw": "offset row", "pitch": "offset row", "roll": "offset row",
}  # fmt: skip
_WORDS = {
    "type": "affine classification clear picture visible", "layout": "NCHW", "channels": "RGB BGR", "region": "all",
    "channel": "luminance r g b", "statistic": "mean least greatest", "measure": "weight", "when": "end any",
    "units": "normalised dataset", "frame": "camera world", "angle_units": "radians degrees",
    "sweep": "keyframes segments",
}  # fmt: skip
#: Keys of whole numbers from 0 on, and of ranges by their names, whose single numbers are radii but for initial states.
_WHOLE = ("label", "pixels", "region", "minus", "resize", "steps")
_RANGES = ("initial", "disturbance", "box", "translation", "rotation")
FIX = "audit a result of what docs/check.md names"
#: Bytes of the largest text that is read.
_TEXT = 256 << 20
#: The mode that a comment of a .ply file stands for.
_MODES = {("splatrendermode", "mip"): "antialiased", ("splatrendermode", "default"): "classic"}
_MODES |= {("antialiased", w): ("antialiased", "classic")[w in ("0", "false")] for w in ("1", "true", "0", "false")}
_MOVED = "say with --load-config where the scene lies now"
_SCENE = "give the run of the result"
_CONVERT = "of another format: ns-abstract-export ply --load-config FILE --output-filename scene.ply, then check with "
_CONVERT += "--load-config scene.ply; the digest says whether these are the result's numbers"


class BadInput(ValueError):
    """Raised where a ``file`` or a ``field`` of it cannot be used; it says the ``problem`` and perhaps the ``fix``."""

    def __init__(self, problem: str, file: Any = None, field: str | None = None, fix: str | None = None) -> None:
        super().__init__(problem)
        self.problem, self.file, self.field, self.fix = problem, file, field, fix


def check_keys(value: Any, key: str, states: Collection[str] = (), file: Any = "report.json") -> None:
    """Raise BadInput where an object has keys, words or numbers that this program would pass over or misread.

    ``key`` is the object's kind, or the key that holds ``value``; ``states`` of a loop are keys of ranges.
    """
    wrong, ranges = [], key in ("clip", "azimuth") or key.startswith("range of ")
    if isinstance(value, dict):
        wrong = sorted(value.keys() - set(_KEYS[key].split() if key in _KEYS else states))
        for name, part in value.items():
            check_keys(part, f"range of {key}" if key in _RANGES else name, states, file)
    elif isinstance(value, list):
        ends = [v for v in value if isinstance(v, (int, float))]
        wrong = ends if ranges and ends != sorted(ends) else []
        for part in value:
            check_keys(part, "clip" if ranges else key, states, file)
    elif isinstance(value, (bool, str)):
        wrong = [] if value in _WORDS.get(key, "").split() else [value]
    elif value is not None:
        least = 0 if key in _WHOLE or (ranges and key not in ("clip", "range of initial")) else -math.inf
        whole = key not in _WHOLE or isinstance(value, int)
        known = math.isfinite(value) and value >= least and (key != "version" or value == 1)
        wrong = [] if whole and known else [value]
    if wrong:
        raise BadInput(f"has {', '.join(map(str, wrong))}, which is not checked", file, key, FIX)


@contextmanager
def reading(file: Any, problem: str, fix: str | None = None) -> Iterator[None]:
    """Turn exceptions inside the block, as libraries raise for damaged files, into a `BadInput` that names the file."""
    try:
        yield
    except BadInput:
        raise
    except Exception:
        raise BadInput(problem, file, fix=fix) from None


def read_json(file: Path, what: str, fix: str | None = None) -> dict[str, Any]:
    """Return the JSON object of a file; ``what``: what messages call the file."""
    with reading(file, f"this {what} cannot be read", fix):
        if not file.is_file():
            raise BadInput(f"no such {what}", file, fix=fix)
        if file.stat().st_size > _TEXT:
            raise BadInput(f"this {what} is too large", file, fix=fix)
        if not isinstance(content := json.loads(file.read_bytes()), dict):
            raise BadInput("the top level is not an object", file, fix=fix)
    return content


def read_scene(file: Path, report: dict[str, Any]) -> ActivatedScene | CheckedField:
    """Return the scene in config.yml, its folder or a .ply; raise BadInput unless its digest is the result's."""
    settings, about, renderer = report["settings"], report["scene"], report["renderer"]
    file, folder = file / "config.yml" if file.is_dir() else file, file.is_dir()
    if not file.is_file():
        raise BadInput("no such run", file, fix=_CONVERT if folder else _MOVED)
    if renderer["name"] == "nerf-uniform":
        scene, digest = _read_field(file, settings, renderer)
        rays = {"near": scene.near, "far": scene.far, "samples": scene.samples, "background": list(scene.background)}
        if any(part.get(name, value) != value for part in (about, renderer) for name, value in rays.items()):
            raise BadInput("the result was made with other samples or another background", file, fix=_SCENE)
    else:
        with file.open("rb") as stream:
            ply = stream.read(4) in (b"ply\n", b"ply\r")
        stored, mode, background, sigmoid, degree = (_read_ply if ply else _read_splats)(file, settings)
        mode, background = settings.get("rasterize_mode") or mode, settings.get("background") or background
        if degree > 3:
            raise BadInput(f"has spherical harmonics of degree {degree}", file, fix=_SCENE)
        background = np.array(background, np.float32)
        stored = [np.ascontiguousarray(a, np.float32) for a in _drawn(stored, file, settings)]
        stated = [about.get("rasterize_mode"), about.get("background"), about.get("gaussians", len(stored[0]))]
        if stated != [mode, background.tolist(), len(stored[0])]:
            raise BadInput("the result was made with another mode, background or number of Gaussians", file, fix=_SCENE)
        digest = hashlib.sha256(b"".join(a.tobytes() for a in (*stored, background)))
        digest.update(repr(("sigmoid" if sigmoid else "sh", degree, mode)).encode())
        scene = activated(stored, sigmoid, degree, mode == "antialiased", background, renderer["version"])
    if digest.hexdigest() != report["fingerprint"].get("scene"):
        raise BadInput("is not the scene of the result (its digest differs)", file, fix=_SCENE)
    return scene


def _drawn(stored: list[Array], file: Path, settings: dict[str, Any]) -> list[Array]:
    """Return the arrays of the Gaussians that gsplat draws; raise BadInput for numbers that float32 holds otherwise."""
    means, logs, quats, logits, sh = stored
    with np.errstate(over="ignore", invalid="ignore"):
        squares, scales = np.square(quats.astype(np.float64)).sum(axis=1), np.exp(logs.astype(np.float64))
    drawn = np.isfinite(means).all(1) & np.isfinite(quats).all(1) & ~np.isnan(logs).any(1) & (squares > 0.0)
    least, most = 2.0**-126 * (1.0 + 1e-6), 2.0**128 * (1.0 - 1e-6)
    whole = (scales <= most).all(1) & ~np.isnan(logits) & np.isfinite(sh).all((1, 2))
    # what float32 flushes to zero, or has no room for, is drawn as something else
    normal = ((scales >= least) | (logs == -np.inf)).all(1) & (squares >= 2.0**-100) & (squares <= most)
    kept = drawn & whole
    if (kept & ~normal).any() or ((drawn & ~whole).any() and not settings.get("drop_nan_gaussians")):
        raise BadInput("holds numbers that are not finite, or not normal in float32", file)
    return [a[kept] for a in stored]


def _read_run(file: Path, settings: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a run's model configuration, and the model's tensors by name."""
    with reading(file, "cannot be read as a run's configuration", _CONVERT):
        # makes texts, lists and mappings of whatever Python objects are written down
        root = yaml.BaseLoader(file.read_text(encoding="utf-8")).get_single_data()
        model, parts = dict(root["pipeline"]["model"]), root.get("relative_model_dir") or "nerfstudio_models"
        folder = file.parent / (parts if isinstance(parts, str) else "/".join(parts))
        step = root.get("load_step", "null") if settings.get("load_step") is None else settings["load_step"]
        step = None if step in ("null", "") else int(step)
    names = {int(p.stem[5:]): p for p in folder.glob("step-*.ckpt") if p.stem[5:].isdecimal()}
    if not names or (step is not None and step not in names):
        raise BadInput("no such checkpoint" if names else "no checkpoints", folder, fix="give the whole run folder")
    checkpoint = names[max(names) if step is None else step]
    scalar, kinds = np.float64(0.0).__reduce__()[0], [type(np.dtype(code)) for code in ("f8", "f4", "i8", "i4", "?")]
    safe = [(scalar, "numpy.core.multiarray.scalar"), (scalar, "numpy._core.multiarray.scalar"), np.dtype, *kinds]
    with reading(checkpoint, "cannot be read as a checkpoint"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with torch.serialization.safe_globals(safe):
            state = torch.load(checkpoint, map_location="cpu", weights_only=True)["pipeline"]
        found = ((re.fullmatch(r"(?:module\.)?_model\.(?:module\.)?(.*)", key), value) for key, value in state.items())
        return model, {name[1]: value for name, value in found if name}


def same_network(model: Path, stated: dict[str, Any]) -> bool:
    """Return whether a network and its files of external data have the stated digests."""
    import onnx

    if not model.is_file() or sha256(model) != stated["sha256"]:
        return False
    with reading(model, "is not a network that can be read"):
        tensors, folder = onnx.load(str(model), load_external_data=False).graph.initializer, model.resolve().parent
        files = {(folder / e.value).resolve() for t in tensors for e in t.external_data if e.key == "location"}
        if not all(file.is_file() for file in files):
            raise BadInput("lacks a file of its constants", model, fix="say with --model where it lies now")
        return {str(f.relative_to(folder)): sha256(f) for f in files} == (stated.get("data") or {})


def sha256(file: Path) -> str:
    """Return the SHA-256 digest of a file."""
    content = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(1 << 24):
            content.update(block)
    return content.hexdigest()


def _color(value: Any) -> tuple[float, ...]:
    return _COLORS[value.lower()] if isinstance(value, str) else tuple(float(v) for v in value)


def _read_splats(file: Path, settings: dict[str, Any]) -> tuple[Any, ...]:
    model, state = _read_run(file, settings)
    with reading(file, "holds no Gaussians of Splatfacto"):
        state = {key.removeprefix("gauss_params."): value for key, value in state.items()}
        stored, interval = int(model.get("sh_degree", 3)), int(model.get("sh_degree_interval", 1000))
        degree, count = min(30000 // interval, stored), len(state["means"])
        names = ("means", "scales", "quats", "opacities", "features_dc")
        *rows, opacities, dc = (state[name].float().numpy() for name in names)
        rest = state.get("features_rest", torch.zeros(0)).float().numpy().reshape(count, -1, 3)
        sh = np.concatenate([dc.reshape(count, 1, 3), rest[:, : (degree + 1) ** 2 - 1]], axis=1)
        background = _color(model.get("background_color", "random"))
    rows = [*rows, opacities.reshape(-1), sh]
    return rows, model.get("rasterize_mode", "classic"), background, stored == 0, degree


def _read_ply(file: Path, settings: dict[str, Any]) -> tuple[Any, ...]:
    import plyfile

    with reading(file, "cannot be read as a 3DGS .ply", _CONVERT):
        data = plyfile.PlyData.read(str(file))
        vertex = data["vertex"].data

        def columns(*names: str) -> Array:
            return np.array([vertex[name] for name in names], np.float32)

        more = sum(name.startswith("f_rest_") for name in vertex.dtype.names)
        rest = columns(*(f"f_rest_{k}" for k in range(more))).reshape(3, -1, len(vertex)).T
        sh = np.concatenate([columns("f_dc_0", "f_dc_1", "f_dc_2").T[:, None], rest], axis=1)
        scales, turns = columns("scale_0", "scale_1", "scale_2"), columns("rot_0", "rot_1", "rot_2", "rot_3")
        stored = [columns("x", "y", "z").T, scales.T, turns.T, columns("opacity")[0], sh]
    if "filter_3D" in vertex.dtype.names:
        raise BadInput("has a filter, which this program does not apply", file, "filter_3D", _CONVERT)
    mode = "classic"
    for line in (*data.comments, *data.obj_info):
        match = re.fullmatch(r"(splatrendermode|antialiased)\b[\s:=]*(.*)", line.strip(), re.IGNORECASE)
        if match:
            word = match[2].strip().strip("'\"").lower()
            mode = _MODES.get((match[1].lower(), word))
            if mode is None and not settings.get("rasterize_mode"):
                raise BadInput(f"found {word!r}", file, f"comment {match[1]}", "give a scene of 3D Gaussians")
    # a file of degree 0 holds spherical harmonics, too
    return stored, mode, (0.0, 0.0, 0.0), False, math.isqrt(sh.shape[1]) - 1


def _read_field(file: Path, settings: dict[str, Any], renderer: dict[str, Any]) -> tuple[CheckedField, Any]:
    """Return a vanilla NeRF's fine field sampled at equal bins, and the digest of field, rays and background."""
    if settings.get("occupancy_grid"):
        raise BadInput("is declared empty by a grid, which this program does not read", file, "occupancy_grid")
    model, state = _read_run(file, settings)
    with reading(file, "holds no field of vanilla-nerf"):
        color = settings.get("background") or model.get("background_color", "white")
        background = tuple(float(np.float32(v)) for v in _color("black" if color == "random" else color))
        tensors = {k: v.float().numpy() for k, v in state.items() if k.startswith("field_fine.")}
        far = float((model.get("collider_params") or {}).get("far_plane", 6.0))
        near, samples = float(settings.get("near_plane") or 0.0), int(renderer["samples"])
        field = CheckedField(tensors, near, far, samples, background)
    arrays = (repr(array.shape).encode() + np.ascontiguousarray(array).tobytes() for array in field.arrays)
    digest = hashlib.sha256(b"".join(arrays))
    codes = ", ".join(f"Encoding(count={n}, least=0.0, most={m})" for n, m in field.counts)
    sampling = f"{near=!r}, {far=!r}, {samples=}, importance=0, {background=!r}"
    digest.update(f"({codes}, Sampling(kind='uniform', {sampling}))".encode())
    return field, digest


def dataset_scale(config: Path) -> float:
    """Return normalised units per unit of transforms.json."""
    file = (config if config.is_dir() else config.parent) / "dataparser_transforms.json"
    stated = read_json(file, "dataparser transform") if file.is_file() else {"scale": 1.0, "transform": np.eye(3, 4)}
    size = (float((np.array(stated["transform"], np.float64)[:, :3] ** 2).sum()) / 3.0) ** 0.5
    return float(stated["scale"]) * (size if abs(size - 1.0) > 1e-3 else 1.0)


def read_poses(
    path: Path, given: dict[str, Any] | None, frame: int, settings: dict[str, Any], scale: float, names: Any = ()
) -> tuple[Poses, list[tuple[str, float, float]]]:
    """Return a frame's poses, and (name, lower, upper) of the parameters in ``names`` and of all that vary."""
    # the perturbation object ``given``, of another file or of options, wins over the path's; ``settings`` are the
    # options that the result was made with, ``scale`` is that of `dataset_scale`
    root = read_json(path, "camera path", "say with --camera-path-filename where it lies now")
    with reading(path, f"frame {frame} or its set of poses cannot be read"):
        entries, entry = root["camera_path"], root["camera_path"][frame]
        spec = (entry.get("perturbation") or root.get("perturbation") or {}) if given is None else given
        check_keys({k: v for k, v in spec.items() if k != "$schema"}, "perturbation", file=path)
        if any(at.get("camera_type", "perspective") != "perspective" or at.get("crop") for at in (root, entry)):
            raise BadInput("has a crop, or a camera that is not perspective", path, "camera_type")
        camera = _camera(root, entry, float(settings.get("downscale_factor") or 1.0))
        cycle = frame + 1 < len(entries) or (root.get("is_cycle") is True and len(entries) > 1)
        swept = spec.get("sweep", "keyframes") == "segments" and cycle
        turn = math.pi / 180.0 if spec.get("angle_units", "radians") == "degrees" else 1.0
        length = scale if spec.get("units", "normalised") == "dataset" else 1.0
        shifts, turns, orbit = (spec.get(key) or {} for key in ("translation", "rotation", "orbit"))
        ends = {n: (shifts.get(n, 0.0), length) for n in SHIFTS} | {n: (turns.get(n, 0.0), turn) for n in TURNS}
        ends |= {"segment": ((0.0, 1.0), 1.0)} if swept else {}
        ends |= {"azimuth": (orbit["azimuth"], turn)} if orbit else {}
        about = (np.array(orbit["target"], np.float64), np.array(orbit["axis"], np.float64)) if orbit else None
        ranges = {}
        for name, (value, factor) in ends.items():
            low, high = (-value, value) if isinstance(value, (int, float)) else value
            ranges[name] = (float(factor * low), float(factor * high))
        following = _pose(entries[(frame + 1) % len(entries)]) if swept else None
    # cells hold what varies in any frame
    names = dict.fromkeys([*names, *(name for name, (low, high) in ranges.items() if low < high)])
    free = [(name, *ranges.get(name, (0.0, 0.0))) for name in names]
    point = {n: a for n, (a, b) in ranges.items() if a == b and (a != 0.0 or n in ("segment", "azimuth"))}
    world = spec.get("frame", "camera") == "world"
    return Poses(camera, tuple(names), point, world, about, following), free


def stated_set(settings: dict[str, Any], moved: Path | None) -> dict[str, Any] | None:
    """Return the perturbation object that the options name; None: that in the camera path counts."""
    axes = {"translation": SHIFTS, "rotation": tuple(TURNS)}
    radii = {name: settings[name] for name in axes if settings.get(name) is not None}
    if radii:
        units: dict[str, Any] = {name: settings.get(name) for name in ("units", "angle_units") if settings.get(name)}
        return units | {n: dict(zip(axes[n], v if len(v) == 3 else list(v) * 3, strict=True)) for n, v in radii.items()}
    if (file := moved or settings.get("perturbation_filename")) is None:
        return None
    root = read_json(Path(file), "perturbation file", "say with --perturbation-filename where it lies now")
    return root["perturbation"] if "camera_path" in root and "perturbation" in root else root


def _pose(entry: dict[str, Any]) -> Array:
    return np.array(entry["camera_to_world"], np.float64).reshape(4, 4)[:3]


def _camera(root: dict[str, Any], entry: dict[str, Any], down: float) -> CheckedCamera:
    width, height = int(root["render_width"]), int(root["render_height"])
    own = {key: root.get(key) if entry.get(key) is None else entry[key] for key in ("fx", "fy", "cx", "cy")}
    fov = entry["fov"] if "fov" in entry else root.get("default_fov")
    fx, fy, cx, cy = intrinsics(own, fov, width, height)
    if down != 1.0:
        # nerfstudio holds the factor and the centre in float32
        scale = np.float32(1.0 / down)
        fx, fy, cx, cy = fx * float(scale), fy * float(scale), *(float(np.float32(place) * scale) for place in (cx, cy))
        width, height = (int(np.float32(side) * scale) for side in (width, height))
    return CheckedCamera(_pose(entry), fx, fy, cx, cy, width, height)


def intrinsics(own: dict[str, Any], fov: Any, width: float, height: float) -> tuple[float, float, float, float]:
    """Return fx, fy, cx and cy in pixels: as ``own`` states them, else from the vertical angle of view, centred."""
    if own.get("fx") is None:
        own = own | {"fx": height / 2.0 / np.tan(float(fov) * (np.pi / 180.0) / 2.0)}
    default = {"fy": own["fx"], "cx": width / 2.0, "cy": height / 2.0}
    fx, fy, cx, cy = (float(default[n] if own.get(n) is None else own[n]) for n in ("fx", "fy", "cx", "cy"))
    if not min(fx, fy) > 0.0:
        raise ValueError("no focal length")
    return fx, fy, cx, cy
