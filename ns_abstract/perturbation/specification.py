"""The perturbation file: which poses around a camera path belong to the set."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ns_abstract.io.errors import InputError
from ns_abstract.io.fields import Fail, Range, interval, known, vector
from ns_abstract.io.jsonio import InputTuning, load_json, show
from ns_abstract.perturbation.variations import KEYS, VARIATIONS, SceneVariation, parse_selection, selection_object

TRANSLATIONS = ("x", "y", "z")
ROTATIONS = ("yaw", "pitch", "roll")

#: Keys of the file, and what may stand there.
FILE_KEYS = {
    "version": "1",
    "frame": '"camera" or "world"',
    "units": '"normalised" or "dataset"',
    "angle_units": '"radians" or "degrees"',
    "translation": 'an object with x, y, z, such as {"x": 0.01}',
    "rotation": 'an object with yaw, pitch, roll, such as {"yaw": 0.01}',
    "sweep": '"keyframes" or "segments"',
    "orbit": "an object with target, axis, azimuth",
    "scene": "a list of variations of the scene",
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
        scene: What varies of a Splatfacto scene; entry by entry, Gaussian by Gaussian.
        hue, saturation: Ranges (turns, and of 1) of what is added to the colours of all points of a NeRF together;
            None: nothing.
        units, angle_units: Units in which the set was stated, for people alone; the ranges above are normalised units
            and radians whatever they are.
    """

    frame: Literal["camera", "world"] = "camera"
    translation: Mapping[str, Range] = field(default_factory=dict)
    rotation: Mapping[str, Range] = field(default_factory=dict)
    sweep: Literal["keyframes", "segments"] = "keyframes"
    orbit: Orbit | None = None
    scene: tuple[SceneVariation, ...] = field(default=(), repr=False)
    hue: Range | None = None
    saturation: Range | None = None
    units: str = field(default="normalised", repr=False, compare=False)
    angle_units: str = field(default="radians", repr=False, compare=False)


def load_perturbation(path: str | Path, *, dataset_scale: float | None = 1.0) -> Perturbation:
    """Read a perturbation file; a camera path that holds a ``perturbation`` object also serves.

    Args:
        dataset_scale: Normalised units per unit of transforms.json (dataparser_transforms.json); None: not known.

    Raises:
        InputError: The file or a field in it cannot be used.
    """
    path = Path(path)
    root = load_json(path, "perturbation file")
    try:
        if isinstance(root, dict) and "camera_path" in root and "perturbation" in root:
            _refuse_overrides(root["camera_path"])
            root = root["perturbation"]
        return parse_perturbation(root, dataset_scale=dataset_scale, field_prefix="", folder=path.parent)
    except InputError as error:
        raise error.within(path) from None


def _refuse_overrides(entries: object) -> None:
    """Refuse entries of a camera path that have sets of their own, which one set for all cannot hold."""
    for k, entry in enumerate(entries if isinstance(entries, list) else ()):
        if isinstance(entry, dict) and entry.get("perturbation") is not None:
            raise InputError(
                "an entry of this path has a set of its own",
                field=f"camera_path[{k}].perturbation",
                fix="give this file as the camera path, or the set for all entries in a file of its own",
            )


def unit_length(units: str, dataset_scale: float | None, fail: Fail) -> float:
    """Return the normalised units per unit of ``units``, "normalised" or "dataset".

    Raises:
        InputError: Units of the data set are meant, and ``dataset_scale`` is None: the scene does not say them.
    """
    if units != "dataset":
        return 1.0
    if dataset_scale is None:
        fix = "put the run's dataparser_transforms.json beside its config.yml, or use normalised units"
        raise fail("units", "found dataset, and the scene does not say the units of its data set", fix)
    return dataset_scale


def parse_perturbation(
    value: object,
    *,
    dataset_scale: float | None = 1.0,
    field_prefix: str = "perturbation.",
    folder: Path | None = None,
) -> Perturbation:
    """Check a parsed ``perturbation`` object and convert the camera's translations to the normalised frame.

    Args:
        dataset_scale: See `load_perturbation`.
        folder: Index files are looked for here; None: in the working directory.

    Raises:
        InputError: A key is unknown, a value has the wrong type, an interval is reversed, a number
            is not finite, an index file cannot be used, or the variation is one of a NeRF.
    """

    def fail(name: str, problem: str, fix: str) -> InputError:
        return InputError(problem, field=f"{field_prefix}{name}".strip("."), fix=fix)

    if not isinstance(value, dict):
        raise fail("", f"found {show(value)}", "write an object")
    known(value, FILE_KEYS, "", fail)
    if value.get("version", 1) != 1 or isinstance(value.get("version"), bool):
        raise fail("version", f"found {show(value['version'])}", "this program reads version 1")
    frame = _choice(value, "frame", ("camera", "world"), fail)
    units = _choice(value, "units", ("normalised", "dataset"), fail)
    angle_units = _choice(value, "angle_units", ("radians", "degrees"), fail)
    turn = math.pi / 180.0 if angle_units == "degrees" else 1.0
    sweep = _choice(value, "sweep", ("keyframes", "segments"), fail)
    shifts = {name: interval(value[name], name, fail) for name in ("hue", "saturation") if name in value}
    for name, (low, high) in shifts.items():
        if low < -1.0 or high > 1.0:
            raise fail(name, f"found {show(value[name])}", "stay within -1 and 1")
    ranges = _ranges(value, "translation", TRANSLATIONS, fail)
    translation = _scaled(ranges, unit_length(units, dataset_scale, fail) if ranges else 1.0)
    rotation, orbit = _scaled(_ranges(value, "rotation", ROTATIONS, fail), turn), _orbit(value, fail, turn)
    scene = _scene(value, fail, field_prefix, folder)
    parts: dict[str, Mapping[str, Sequence[float]]] = {"translation": translation, "rotation": rotation}
    if orbit is not None:
        parts["orbit"] = {"target": orbit.target, "azimuth": orbit.azimuth}
    parts |= {
        f"scene[{k}]": {name: ends for name in VARIATIONS if (ends := getattr(entry, name)) is not None}
        for k, entry in enumerate(scene)
    }
    _refuse_huge(parts, fail)
    return Perturbation(
        frame=frame,  # pyright: ignore[reportArgumentType]
        translation=translation,
        rotation=rotation,
        sweep=sweep,  # pyright: ignore[reportArgumentType]
        orbit=orbit,
        scene=scene,
        hue=shifts.get("hue"),
        saturation=shifts.get("saturation"),
        units=units,
        angle_units=angle_units,
    )


def perturbation_object(perturbation: Perturbation) -> dict[str, Any]:
    """Return the content of a perturbation file for a set; `parse_perturbation` reads it back as the same set."""

    def ranges(limits: Mapping[str, Range]) -> dict[str, list[float]]:
        return {name: list(ends) for name, ends in limits.items()}

    content: dict[str, Any] = {
        "version": 1,
        "frame": perturbation.frame,
        "translation": ranges(perturbation.translation),
        "rotation": ranges(perturbation.rotation),
        "sweep": perturbation.sweep,
    }
    if (orbit := perturbation.orbit) is not None:
        content["orbit"] = {"target": list(orbit.target), "axis": list(orbit.axis), "azimuth": list(orbit.azimuth)}
    for name in ("hue", "saturation"):
        if (shift := getattr(perturbation, name)) is not None:
            content[name] = list(shift)
    if perturbation.scene:
        content["scene"] = [
            {"select": selection_object(entry.select)}
            | ranges({key: limits for key in VARIATIONS if (limits := getattr(entry, key)) is not None})
            for entry in perturbation.scene
        ]
    return content


def _choice(value: Mapping[str, Any], name: str, choices: tuple[str, ...], fail: Fail) -> str:
    chosen = value.get(name, choices[0])
    if chosen not in choices or not isinstance(chosen, str):
        raise fail(name, f"found {show(chosen)}", f"write {' or '.join(choices)}")
    return chosen


def _ranges(value: Mapping[str, Any], name: str, keys: tuple[str, ...], fail: Fail) -> dict[str, Range]:
    inner = value.get(name, {})
    if not isinstance(inner, dict):
        raise fail(name, f"found {show(inner)}", f"write {FILE_KEYS[name]}")
    known(inner, keys, f"{name}.", fail)
    return {key: interval(inner[key], f"{name}.{key}", fail) for key in keys if key in inner}


def _refuse_huge(parts: Mapping[str, Mapping[str, Sequence[float]]], fail: Fail) -> None:
    """Refuse numbers whose differences and products could overflow; they are normalised units and radians."""
    for part, entries in parts.items():
        for name, numbers in entries.items():
            most = max(map(abs, numbers))
            if not most <= InputTuning.largest:
                raise fail(f"{part}.{name}", f"reaches {most:g}", f"stay within {InputTuning.largest:g} in size")


def _scaled(limits: Mapping[str, Range], factor: float) -> dict[str, Range]:
    return {name: (factor * low, factor * high) for name, (low, high) in limits.items()}


def _scene(value: Mapping[str, Any], fail, prefix: str, folder: Path | None) -> tuple[SceneVariation, ...]:
    if "scene" not in value:
        return ()
    entries = value["scene"]
    if not isinstance(entries, list) or not entries:
        raise fail("scene", f"found {show(entries)}", "write a list of objects with select, mean, opacity, color")
    variations = []
    for k, entry in enumerate(entries):
        name = f"scene[{k}]"
        if not isinstance(entry, dict):
            raise fail(name, f"found {show(entry)}", f"write an object with {', '.join(KEYS)}")
        known(entry, KEYS, f"{name}.", fail)
        if "select" not in entry:
            raise fail(f"{name}.select", "missing", "say which Gaussians vary; {} stands for all")
        if not any(key in entry for key in VARIATIONS):
            raise fail(name, "nothing varies", "write mean, opacity or color")
        ranges = {key: interval(entry[key], f"{name}.{key}", fail) for key in VARIATIONS if key in entry}
        select = parse_selection(entry["select"], f"{name}.select", fail, folder)
        variations.append(SceneVariation(select, **ranges, name=f"{prefix}{name}"))
    return tuple(variations)


def _orbit(value: Mapping[str, Any], fail: Fail, turn: float) -> Orbit | None:
    if value.get("orbit") is None:
        return None
    inner = value["orbit"]
    if not isinstance(inner, dict):
        raise fail("orbit", f"found {show(inner)}", f"write {FILE_KEYS['orbit']}")
    known(inner, ("target", "axis", "azimuth"), "orbit.", fail)
    for name in ("target", "axis", "azimuth"):
        if name not in inner:
            raise fail(f"orbit.{name}", "missing", f"write {FILE_KEYS['orbit']}")
    axis = vector(inner["axis"], "orbit.axis", fail)
    with np.errstate(over="ignore"):
        length = float(np.linalg.norm(axis))
    if not InputTuning.nothing < length < np.inf:
        raise fail("orbit.axis", f"has length {length:g}", "write a direction, such as [0, 0, 1]")
    low, high = interval(inner["azimuth"], "orbit.azimuth", fail)
    return Orbit(target=vector(inner["target"], "orbit.target", fail), axis=axis, azimuth=(turn * low, turn * high))
