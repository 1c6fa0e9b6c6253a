"""The perturbation file: which poses around a camera path belong to the set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ns_abstract.errors import InputError
from ns_abstract.jsonio import is_number, load_json, show

TRANSLATIONS = ("x", "y", "z")
ROTATIONS = ("yaw", "pitch", "roll")

Range = tuple[float, float]

_KEYS = {
    "version": "1",
    "frame": '"camera" or "world"',
    "units": '"normalised" or "dataset"',
    "translation": "an object with x, y, z",
    "rotation": "an object with yaw, pitch, roll",
    "sweep": '"keyframes" or "segments"',
    "orbit": "an object with target, axis, azimuth",
    "scene": "variations of the scene",
    "hue": "a number",
    "saturation": "a number",
}


@dataclass(frozen=True)
class Orbit:
    """Rigid rotation of the camera about the axis through ``target``; azimuth in radians."""

    target: tuple[float, float, float]
    axis: tuple[float, float, float]
    azimuth: Range


@dataclass(frozen=True)
class Perturbation:
    """A set of poses around a camera path (the file's version 1).

    Attributes:
        frame: Axes of ``translation``: "camera" (x right, y up, z back) or "world".
        translation: Ranges of x, y, z, in units of the normalised frame.
        rotation: Ranges of yaw, pitch, roll, radians.
        sweep: "keyframes", or "segments": the pose also moves from each entry to the next.
        orbit: Optional orbit, applied before translation and rotation.
    """

    frame: Literal["camera", "world"] = "camera"
    translation: Mapping[str, Range] = field(default_factory=dict)
    rotation: Mapping[str, Range] = field(default_factory=dict)
    sweep: Literal["keyframes", "segments"] = "keyframes"
    orbit: Orbit | None = None


def load_perturbation(path: str | Path, *, dataset_scale: float = 1.0) -> Perturbation:
    """Read a perturbation file; a camera path that holds a ``perturbation`` object also serves.

    Args:
        path: The file.
        dataset_scale: Normalised units per unit of transforms.json (dataparser_transforms.json).

    Raises:
        InputError: The file or a field in it cannot be used.
    """
    path = Path(path)
    root = load_json(path, "perturbation file")
    if isinstance(root, dict) and "camera_path" in root and "perturbation" in root:
        root = root["perturbation"]
    try:
        return parse_perturbation(root, dataset_scale=dataset_scale, field_prefix="")
    except InputError as error:
        raise error.within(path) from None


def parse_perturbation(
    value: object, *, dataset_scale: float = 1.0, field_prefix: str = "perturbation."
) -> Perturbation:
    """Check a parsed ``perturbation`` object and convert lengths to the normalised frame.

    Raises:
        InputError: A key is unknown, a value has the wrong type, an interval is reversed, a number
            is not finite, or the variation is not one of a Splatfacto camera.
    """

    def fail(name: str, problem: str, fix: str) -> InputError:
        return InputError(problem, field=f"{field_prefix}{name}".strip("."), fix=fix)

    if not isinstance(value, dict):
        raise fail("", f"found {show(value)}", "write an object")
    _known(value, _KEYS, "", fail)
    if value.get("version", 1) != 1 or isinstance(value.get("version"), bool):
        raise fail("version", f"found {show(value['version'])}", "this program reads version 1")
    frame = _choice(value, "frame", ("camera", "world"), fail)
    units = _choice(value, "units", ("normalised", "dataset"), fail)
    sweep = _choice(value, "sweep", ("keyframes", "segments"), fail)
    for name in ("hue", "saturation"):
        if name in value:
            raise fail(name, "varies the colours of a NeRF, not of a Splatfacto scene", "remove the key")
    if "scene" in value:
        raise fail("scene", "this version bounds sets of camera poses only", "remove the key")
    translation = _ranges(value, "translation", TRANSLATIONS, fail)
    if units == "dataset":
        translation = {name: (dataset_scale * low, dataset_scale * high) for name, (low, high) in translation.items()}
    return Perturbation(
        frame=frame,  # pyright: ignore[reportArgumentType]
        translation=translation,
        rotation=_ranges(value, "rotation", ROTATIONS, fail),
        sweep=sweep,  # pyright: ignore[reportArgumentType]
        orbit=_orbit(value, fail),
    )


def _known(value: Mapping[str, Any], keys, prefix: str, fail) -> None:
    for key in value:
        if key not in keys:
            raise fail(f"{prefix}{show(key).strip(chr(39))}", "unknown key", f"the keys are {', '.join(keys)}")


def _choice(value: Mapping[str, Any], name: str, choices: tuple[str, ...], fail) -> str:
    found = value.get(name, choices[0])
    if found not in choices or not isinstance(found, str):
        raise fail(name, f"found {show(found)}", f"write {' or '.join(choices)}")
    return found


def _range(value: object, name: str, fail, *, symmetric: bool = True) -> Range:
    """An interval [low, high]; a number r >= 0 means [-r, r]."""
    if symmetric and is_number(value):
        if value < 0:  # pyright: ignore[reportOperatorIssue]
            raise fail(name, f"found {show(value)}", "a radius is not negative; write [low, high] for an interval")
        return -float(value), float(value)  # pyright: ignore[reportArgumentType]
    kind = "a radius or an interval" if symmetric else "an interval"
    if not (isinstance(value, list) and len(value) == 2 and all(is_number(v) for v in value)):
        raise fail(name, f"found {show(value)}", f"write {kind} [low, high] of finite numbers")
    low, high = float(value[0]), float(value[1])
    if low > high:
        raise fail(name, f"the interval [{low:g}, {high:g}] is reversed", "write the smaller end first")
    return low, high


def _ranges(value: Mapping[str, Any], name: str, keys: tuple[str, ...], fail) -> dict[str, Range]:
    inner = value.get(name, {})
    if not isinstance(inner, dict):
        raise fail(name, f"found {show(inner)}", f"write {_KEYS[name]}")
    _known(inner, keys, f"{name}.", fail)
    return {key: _range(inner[key], f"{name}.{key}", fail) for key in keys if key in inner}


def _vector(value: object, name: str, fail) -> tuple[float, float, float]:
    if not (isinstance(value, list) and len(value) == 3 and all(is_number(v) for v in value)):
        raise fail(name, f"found {show(value)}", "write three finite numbers")
    return float(value[0]), float(value[1]), float(value[2])


def _orbit(value: Mapping[str, Any], fail) -> Orbit | None:
    if value.get("orbit") is None:
        return None
    inner = value["orbit"]
    if not isinstance(inner, dict):
        raise fail("orbit", f"found {show(inner)}", f"write {_KEYS['orbit']}")
    _known(inner, ("target", "axis", "azimuth"), "orbit.", fail)
    for name in ("target", "axis", "azimuth"):
        if name not in inner:
            raise fail(f"orbit.{name}", "missing", f"write {_KEYS['orbit']}")
    axis = _vector(inner["axis"], "orbit.axis", fail)
    with np.errstate(over="ignore"):
        length = float(np.linalg.norm(axis))
    if not 1e-12 < length < np.inf:
        raise fail("orbit.axis", f"has length {length:g}", "write a direction, such as [0, 0, 1]")
    return Orbit(
        target=_vector(inner["target"], "orbit.target", fail),
        axis=axis,
        azimuth=_range(inner["azimuth"], "orbit.azimuth", fail),
    )
