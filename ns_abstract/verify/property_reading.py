"""Reads property files: checks their keys, and makes the properties that they state."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from ns_abstract.io.errors import InputError
from ns_abstract.io.fields import fail, known
from ns_abstract.io.jsonio import FIX_MODERATE, MODERATE, file_beside, is_moderate, is_number, show, unusable
from ns_abstract.verify.preprocess import parse_preprocess
from ns_abstract.verify.properties import (
    CLASSES,
    COMPONENTS,
    HEAD,
    Classification,
    Detection,
    Property,
    Regression,
    TrueValues,
    VnnLibProperty,
)
from ns_abstract.verify.vnnlib import load_vnnlib

_COMMON = ("type", "preprocess", "partitions", "output")


class _KeySetting(NamedTuple):
    """What a parser needs beside the JSON object: its folder, the network's input and output sizes, the picture."""

    folder: Path
    inputs: int
    outputs: int
    height: int
    width: int
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]


class _Type(NamedTuple):
    """A type of property: its keys, and the function that makes it from the JSON object and the common attributes."""

    keys: tuple[str, ...]
    parse: Callable[[dict[str, Any], _KeySetting, dict[str, Any]], Property]


def loading(root: Any) -> dict[str, Any]:
    """Return the keyword arguments for `load_network` in a parsed PROP.json: the output, and the pictures' size."""
    if not isinstance(root, dict):
        return {}
    output = root.get("output")
    if "output" in root and not (isinstance(output, str) and output):
        raise unusable(output, field="output", fix="write the name of one of the network's outputs")
    return parse_preprocess(root.get("preprocess", {})).loading(output)


def parse_property(root: Any, folder: Path, input_shape: tuple[int, ...], output_shape: tuple[int, ...]) -> Property:
    """Return the property that a parsed PROP.json describes; files that it names lie in ``folder``."""
    if not isinstance(root, dict):
        raise InputError(f"the top level is {show(root)}, not an object", fix='write {"type": ...}')
    kind = root.get("type")
    if not isinstance(kind, str) or kind not in _TYPES:
        raise InputError(
            "missing" if kind is None else f"found {show(kind)}", field="type", fix=f"write one of {', '.join(_TYPES)}"
        )
    known(root, (*_COMMON, *_TYPES[kind].keys), "", fail)
    preprocess = parse_preprocess(root.get("preprocess", {}))
    height, width = preprocess.size(input_shape)
    common: dict[str, Any] = {"preprocess": preprocess, "partitions": parse_partitions(root)}
    sizes = math.prod(input_shape), math.prod(output_shape), height, width
    setting = _KeySetting(folder, *sizes, input_shape, output_shape)
    return _TYPES[kind].parse(root, setting, common)


def property_keys() -> dict[str, tuple[str, ...]]:
    """Return the keys of a property file by its type, those of all types first."""
    return {name: (*_COMMON, *kind.keys) for name, kind in _TYPES.items()}


def parse_partitions(root: dict[str, Any]) -> tuple[int, ...] | None:
    """Return the fixed partition that a parsed PROP.json states, or None."""
    value = root.get("partitions")
    if value is None:
        return None
    counts = value if isinstance(value, list) else [value]
    if not counts or not all(type(v) is int and 1 <= v <= 10**9 for v in counts):
        raise unusable(value, field="partitions", fix="write a number of parts, or a list with one by parameter")
    return tuple(counts)


def _classification(root: dict[str, Any], setting: _KeySetting, common: dict[str, Any]) -> Property:
    label, outputs = root.get("label"), setting.outputs
    if outputs < 2:
        raise InputError(f"the network has {outputs} output", field="type", fix="use a classifier")
    fix = f"write an integer from 0 to {outputs - 1}, the number of an output"
    if "label" not in root:
        raise InputError("missing", field="label", fix=fix)
    if type(label) is not int or not 0 <= label < outputs:
        raise unusable(label, field="label", fix=fix)
    return Classification(label=label, classes=outputs, **common)


def _regression(root: dict[str, Any], setting: _KeySetting, common: dict[str, Any]) -> Property:
    target, outputs = root.get("target"), setting.outputs
    if target in ("camera", "object"):
        target = [f"{target}.{axis}" for axis in "xyz"]
    elif target == "distance":
        target = [target]
    if not isinstance(target, list) or not all(is_moderate(v) or v in COMPONENTS for v in target):
        names = f"numbers ({FIX_MODERATE}) or {', '.join(COMPONENTS)}"
        raise unusable(root.get("target"), field="target", fix=f"write camera, object, distance, or a list of {names}")
    if len(target) != outputs:
        raise InputError(
            f"{len(target)} values, the network has {outputs} outputs", field="target", fix="write one value by output"
        )
    origin = root.get("origin", [0.0, 0.0, 0.0])
    if not (isinstance(origin, list) and len(origin) == 3 and all(is_moderate(v) for v in origin)):
        raise unusable(origin, field="origin", fix=f"write a point of the normalised frame, each number {FIX_MODERATE}")
    scale = root.get("scale", 1.0)
    if not is_moderate(scale) or scale == 0:
        raise unusable(scale, field="scale", fix=f"write a number other than 0: {FIX_MODERATE}")
    tolerance = root.get("tolerance")
    if not isinstance(tolerance, dict) or len(tolerance) != 1 or not set(tolerance) <= {"absolute", "relative"}:
        raise unusable(tolerance, field="tolerance", fix='write {"relative": 0.2} or {"absolute": 0.1}')
    absolute: tuple[float, ...] | None = None
    relative: float | None = None
    name, value = next(iter(tolerance.items()))
    values: list[Any] = value if isinstance(value, list) and name == "absolute" else [value]
    if not all(is_moderate(v) and v > 0 for v in values) or len(values) not in (1, outputs):
        more = f" or {outputs} of them" if name == "absolute" else ""
        low, high = MODERATE
        raise unusable(value, field=f"tolerance.{name}", fix=f"write a number from {low:g} to {high:g}{more}")
    if name == "absolute":
        absolute = tuple(float(v) for v in values)
    else:
        relative = float(values[0])
    x, y, z = (float(v) for v in origin)
    truth = TrueValues(tuple(v if isinstance(v, str) else float(v) for v in target), (x, y, z), float(scale))
    return Regression(truth=truth, absolute=absolute, relative=relative, **common)


def _detection(root: dict[str, Any], setting: _KeySetting, common: dict[str, Any]) -> Property:
    outputs, height, width = setting.outputs, setting.height, setting.width
    grid = math.isqrt(outputs // HEAD)
    if outputs != HEAD * grid * grid or grid == 0 or height != width or height % grid:
        raise InputError(
            f"{outputs} outputs of a {height} x {width} picture are no VOC TinyYOLO head",
            field="type",
            fix=f"use a network with outputs [{HEAD}, g, g] and square pictures with a multiple of g pixels",
        )
    for name in ("class", "iou"):
        if name not in root:
            raise InputError("missing", field=name, fix="write a number, or null")
    label, iou, confidence, box = root["class"], root["iou"], root.get("confidence"), root.get("box")
    if label is not None and (type(label) is not int or not 0 <= label < CLASSES):
        raise unusable(
            label, field="class", fix=f"write an integer from 0 to {CLASSES - 1}, or null for objectness alone"
        )
    for name, value in (("iou", iou), ("confidence", confidence)):
        if not (name == "iou" and value is None) and not (is_number(value) and MODERATE[0] <= value < 1):
            raise unusable(value, field=name, fix=f"write a number from {MODERATE[0]:g} to 1")
    if box is not None:
        good = isinstance(box, list) and len(box) == 4 and all(is_moderate(v) for v in box)
        if not good or not (box[0] < box[2] and box[1] < box[3]):
            raise unusable(box, field="box", fix="write [x0, y0, x1, y1] in pixels of the network's input")
        if iou is None:
            raise InputError("given without iou", field="box", fix="write an iou, or remove the box")
        box = (float(box[0]), float(box[1]), float(box[2]), float(box[3]))
    return Detection(
        label=label,
        confidence=float(confidence),  # pyright: ignore[reportArgumentType]
        iou=None if iou is None else float(iou),
        box=box,
        grid=grid,
        stride=height / grid,
        **common,
    )


def _vnnlib(root: dict[str, Any], setting: _KeySetting, common: dict[str, Any]) -> Property:
    name = root.get("file")
    if not isinstance(name, str) or not name:
        raise unusable(name, field="file", fix="write the name of a VNN-LIB file, relative to this one")
    file = file_beside(setting.folder, name, "file")
    return VnnLibProperty(file=file, unsafe=load_vnnlib(file, setting.output_shape, setting.input_shape), **common)


_TYPES = {
    "classification": _Type(("label",), _classification),
    "regression": _Type(("target", "tolerance", "origin", "scale"), _regression),
    "detection": _Type(("class", "iou", "confidence", "box"), _detection),
    "vnnlib": _Type(("file",), _vnnlib),
}
