"""JSON Schemas of the files that users write: the set of poses, the property, the closed loop.

Keys, types and choices are those of the readers' own tables. A schema is wider than its reader, which also knows the
network and the scene: what a schema refuses, the reader refuses, too. Editors complete and check files by them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from ns_abstract.io.jsonio import MODERATE
from ns_abstract.perturbation.specification import FILE_KEYS, ROTATIONS, TRANSLATIONS
from ns_abstract.perturbation.variations import KEYS, SELECT_KEYS, VARIATIONS
from ns_abstract.reach import dynamics, loop
from ns_abstract.verify import preprocess
from ns_abstract.verify.picture_properties import CHANNELS, COMMON, PICTURE_TYPES, STATISTICS
from ns_abstract.verify.properties import COMPONENTS
from ns_abstract.verify.property_reading import property_keys

Schema = dict[str, Any]

DRAFT = "https://json-schema.org/draft/2020-12/schema"
_NULL: Schema = {"type": "null"}
_NUMBER: Schema = {"type": "number"}
_POSITIVE: Schema = {"type": "number", "exclusiveMinimum": 0}
_TEXT: Schema = {"type": "string", "minLength": 1}


def _object(keys: Mapping[str, Schema], required: Iterable[str] = (), **more: Any) -> Schema:
    """Return the JSON schema of an object that has the ``required`` keys, and no key besides ``keys``."""
    return {
        "type": "object", "properties": dict(keys), "required": list(required), "additionalProperties": False, **more
    }  # fmt: skip


def _list(of: Schema, least: int = 0, most: int | None = None, **more: Any) -> Schema:
    return {"type": "array", "items": of, "minItems": least, **({} if most is None else {"maxItems": most}), **more}


def _numbers(count: int, **more: Any) -> Schema:
    return _list(_NUMBER, count, count, **more)


def _fields(names: Iterable[str], schemas: Mapping[str, Schema]) -> dict[str, Schema]:
    """Return the JSON schemas of all ``names``, by key; a name that ``schemas`` lacks accepts any value."""
    return {name: schemas.get(name, {}) for name in names}


_INTERVAL = _numbers(2, description="[low, high]")
_RANGE: Schema = {
    "anyOf": [{"type": "number", "minimum": 0}, _INTERVAL],
    "description": "a number r for [-r, r], or [low, high]",
}
_NAMED: Schema = {"description": "the schema that an editor checks this file by"}
_MATRIX = _list(_list(_NUMBER, 1), 1)


def _select() -> Schema:
    """Return the JSON schema of a selection of Gaussians."""
    select = {
        "box": _list(_numbers(3), 2, 2, description="[[x0, y0, z0], [x1, y1, z1]]"),
        "indices": {"anyOf": [_list({"type": "integer", "minimum": 0}, 1), _TEXT]},
        "opacity": _INTERVAL,
        "color": _object({"min": _numbers(3), "max": _numbers(3)}, minProperties=1),
    }
    return _object(_fields(SELECT_KEYS, select))


def perturbation_schema() -> Schema:
    varied = _object(
        _fields(KEYS, {"select": _select(), **dict.fromkeys(VARIATIONS, _RANGE)}),
        ["select"],
        anyOf=[{"required": [name]} for name in VARIATIONS],
    )
    shift = {
        "anyOf": [
            {"type": "number", "minimum": 0, "maximum": 1},
            _list({"type": "number", "minimum": -1, "maximum": 1}, 2, 2),
        ]
    }
    orbit = _object({"target": _numbers(3), "axis": _numbers(3), "azimuth": _RANGE}, ["target", "axis", "azimuth"])
    schemas: dict[str, Schema] = {
        "version": {"const": 1},
        "frame": {"enum": ["camera", "world"]},
        "units": {"enum": ["normalised", "dataset"]},
        "angle_units": {"enum": ["radians", "degrees"]},
        "translation": _object(dict.fromkeys(TRANSLATIONS, _RANGE)),
        "rotation": _object(dict.fromkeys(ROTATIONS, _RANGE)),
        "sweep": {"enum": ["keyframes", "segments"]},
        "orbit": {"anyOf": [_NULL, orbit]},
        "scene": _list(varied, 1),
        "hue": shift,
        "saturation": shift,
    }
    keys = {name: {"description": FILE_KEYS[name], **schema} for name, schema in _fields(FILE_KEYS, schemas).items()}
    return _whole("perturbation", "Set of camera poses", _object(keys))


def _preprocess() -> Schema:
    ends = {"mean": _numbers(3), "std": _list(_POSITIVE, 3, 3), "range": _numbers(2)}
    sizes = {"resize": {"anyOf": [_NULL, _list({"type": "integer", "minimum": 1, "maximum": 16384}, 2, 2)]}}
    choices: dict[str, Schema] = {"layout": {"enum": ["NCHW", "NHWC"]}, "channels": {"enum": ["RGB", "BGR"]}}
    return _object(_fields(preprocess.KEYS, {**sizes, **ends, **choices}))


def property_schema() -> Schema:
    """Return the JSON schema of a property file; keys that a type needs are stated under the type."""
    count: Schema = {"type": "integer", "minimum": 1, "maximum": 10**9}
    share: Schema = {"type": "number", "minimum": MODERATE[0], "exclusiveMaximum": 1}
    tolerance = [
        _object({"relative": _POSITIVE}, ["relative"]),
        _object({"absolute": {"anyOf": [_POSITIVE, _list(_POSITIVE, 1)]}}, ["absolute"]),
    ]
    target = {
        "anyOf": [{"enum": ["camera", "object", "distance"]}, _list({"anyOf": [_NUMBER, {"enum": list(COMPONENTS)}]})]
    }
    schemas: dict[str, Schema] = {
        "preprocess": _preprocess(),
        "partitions": {"anyOf": [_NULL, count, _list(count, 1)]},
        "output": _TEXT,
        "label": {"type": "integer", "minimum": 0},
        "target": target,
        "tolerance": {"anyOf": tolerance},
        "origin": _numbers(3),
        "scale": _NUMBER,
        "class": {"anyOf": [_NULL, {"type": "integer", "minimum": 0}]},
        "iou": {"anyOf": [_NULL, share]},
        "confidence": share,
        "box": {"anyOf": [_NULL, _numbers(4)]},
        "file": _TEXT,
    }
    needed = {
        "classification": ["label"], "regression": ["target", "tolerance"], "vnnlib": ["file"],
        "detection": ["class", "iou", "confidence"],
    }  # fmt: skip
    kinds = {
        name: (_fields(keys, schemas), needed.get(name, [])) for name, keys in property_keys().items()
    }  # fmt: skip
    top = {
        "preprocess": _object({"resize": _preprocess()["properties"]["resize"]}),
        "partitions": schemas["partitions"],
    }
    beside = {"$schema": _NAMED, **_fields(COMMON, top)}
    statements = _statements()
    kinds |= {name: ({**keys, **beside}, required) for name, (keys, required) in statements.items()}
    cases: list[Schema] = [
        {
            "if": {"properties": {"type": {"const": name}}, "required": ["type"]},
            "then": _object({"$schema": _NAMED, **keys, "type": {"const": name}}, required),
        }
        for name, (keys, required) in kinds.items()
    ]
    joined, parts = _joined_statements()
    several = {"anyOf": [_object({**one, **beside}, list(one)) for one in joined]}
    cases.append({"if": {"not": {"required": ["type"]}}, "then": several})
    root: Schema = {"type": "object", "properties": {"type": {"enum": list(kinds)}}, "allOf": cases, "$defs": parts}
    return _whole("property", "What is to hold on every picture", root)


def _statements() -> dict[str, tuple[dict[str, Schema], list[str]]]:
    """Return keys of the properties of the picture by type, and those that are needed."""
    size: Schema = {"type": "integer", "minimum": 0}
    box = {"anyOf": [_NULL, {"const": "all"}, _list(size, 4, 4)]}
    schemas: dict[str, Schema] = {
        "select": _select(),
        "weight": {"type": "number", "minimum": MODERATE[0], "maximum": 1},
        "pixels": {"type": "integer", "minimum": 1},
        "fraction": {"type": "number", "exclusiveMinimum": 0, "maximum": 1},
        "distance": {"type": "number", "minimum": MODERATE[0], "maximum": MODERATE[1]},
        "units": {"enum": ["normalised", "dataset"]},
        "measure": {"enum": ["weight", "expected"]},
        "statistic": {"enum": list(STATISTICS)},
        "channel": {"enum": list(CHANNELS)},
        "min": {"type": "number", "minimum": -1, "maximum": 1},
        "max": {"type": "number", "minimum": -1, "maximum": 1},
        "region": box,
        "minus": box,
        "mask": {"anyOf": [_NULL, _TEXT]},
    }
    needed = {"visible": ["select"], "clear": ["distance"]}
    return {name: (_fields(kind.keys, schemas), needed.get(name, [])) for name, kind in PICTURE_TYPES.items()}


def _joined_statements() -> tuple[list[Schema], Schema]:
    """Return statements that are joined by all or any, and their parts under "$defs"."""
    parts = _list({"$ref": "#/$defs/statement"}, 1)
    joined: list[Schema] = [{name: parts} for name in ("all", "any")]
    single = [
        _object({**keys, "type": {"const": n}}, ["type", *required]) for n, (keys, required) in _statements().items()
    ]
    return joined, {"statement": {"anyOf": [*single, *(_object(one, list(one)) for one in joined)]}}


def _views(beside: Mapping[str, Schema]) -> list[Schema]:
    """Return properties of the picture along a loop, with keys ``beside`` their own."""
    beside = {"preprocess": _object({"resize": _preprocess()["properties"]["resize"]}), **beside}
    single = [
        _object({**keys, **beside, "type": {"const": n}}, ["type", *required])
        for n, (keys, required) in _statements().items()
    ]
    return [*single, *(_object({**one, **beside}, list(one)) for one in _joined_statements()[0])]


def _motion() -> Schema:
    """Return the laws of motion, by type."""
    schemas: dict[str, Schema] = {
        "A": _MATRIX, "B": _MATRIX, "c": _list(_NUMBER, 1), "file": _TEXT, "speed": _NUMBER, "lag": _POSITIVE,
        "gravity": _POSITIVE, "axes": {"type": "integer", "minimum": 1, "maximum": dynamics.MOST // 3},
        "drag": _NUMBER, "quadratic_drag": _NUMBER,
    }  # fmt: skip
    needed = {
        "affine": ["A", "B"], "double integrator": ["axes"], "fixed wing": ["speed"], "quadrotor": ["lag"],
        "onnx": ["file"],
    }  # fmt: skip
    laws = [
        _object({**_fields(keys, schemas), "type": {"const": name}}, ["type", *needed.get(name, [])])
        for name, keys in dynamics.KEYS.items()
    ]
    return {"anyOf": laws}


def loop_schema() -> Schema:
    per_state = {"type": "object", "additionalProperties": {"anyOf": [_NULL, _RANGE]}}
    initial = {"type": "object", "additionalProperties": {"anyOf": [_NUMBER, _INTERVAL]}}
    end = {"type": ["number", "null"]}
    box = {"type": "object", "minProperties": 1, "additionalProperties": _list(end, 2, 2)}
    half_space = _object({"normal": _list(_NUMBER, 1), "at_least": _NUMBER}, ["normal", "at_least"])
    outside = _object({"half_space": half_space}, ["half_space"])
    clip = {"anyOf": [_NULL, _list(_INTERVAL, 1)]}
    pose = {"anyOf": [_list(_numbers(4), 4, 4), _numbers(16)]}
    turn = _object({"offset": _NUMBER, "row": _list(_NUMBER, 1)})
    camera = {
        "camera_to_world": pose,
        "fov": _POSITIVE,
        "fx": _POSITIVE,
        "fy": _POSITIVE,
        "cx": _NUMBER,
        "cy": _NUMBER,
        "position": _object({"offset": _numbers(3), "matrix": _list(_list(_NUMBER, 1), 3, 3)}, ["matrix"]),
        **dict.fromkeys(ROTATIONS, turn),
    }
    names, when = {"type": "string", "minLength": 1, "maxLength": 40}, {"when": {"enum": ["end", "any"]}}
    schemas: dict[str, Schema] = {
        "version": {"const": 1},
        "state": _list(names, 1, dynamics.MOST - 1, uniqueItems=True),
        "units": _list({"type": "string", "maxLength": 39}, 1),
        "initial": initial,
        "steps": {"type": "integer", "minimum": 1, "maximum": loop.MOST_STEPS},
        "sampling_time": _POSITIVE,
        "dynamics": _motion(),
        "disturbance": per_state,
        "camera": _object(camera, ["camera_to_world", "position"]),
        "network": _TEXT,
        "preprocess": _preprocess(),
        "control": _object({"gain": _MATRIX, "goal": _list(_NUMBER, 1), "clip": clip}),
        "unsafe": _list({"anyOf": [_object({"box": box}, ["box"]), outside, *_views({})]}),
        "goal": {"anyOf": [_object({"box": box, **when}, ["box"]), *_views(when)]},
        "output": _TEXT,
    }  # fmt: skip
    required = ["version", "state", "initial", "steps", "sampling_time", "dynamics", "camera", "network", "control"]
    root = _object(_fields(loop.KEYS, schemas), required, anyOf=[{"required": ["unsafe"]}, {"required": ["goal"]}])
    root["$defs"] = _joined_statements()[1]
    return _whole("loop", "A camera, a network and a law of motion in a closed loop", root)


def _whole(name: str, title: str, root: Schema) -> Schema:
    """Return the JSON schema of a file, which editors find under "$schema"."""
    properties = {"$schema": _NAMED, **root["properties"]}
    return {"$schema": DRAFT, "$id": f"urn:ns-abstract:{name}:1", "title": title, **root, "properties": properties}


def schema_files() -> dict[str, bytes]:
    schemas = {"perturbation": perturbation_schema(), "property": property_schema(), "loop": loop_schema()}
    return {f"{name}.schema.json": (json.dumps(schema, indent=1) + "\n").encode() for name, schema in schemas.items()}
