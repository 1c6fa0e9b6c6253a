"""JSON Schemas of the files that users write: what a reader takes they take, and they notice what readers refuse."""

from __future__ import annotations

import copy
import functools
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from test_corpus import LOOP, PREPROCESS, ROWS
from test_keys import SET

from ns_abstract.api import schemas
from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.reach.loop import parse_loop
from ns_abstract.verify.picture_properties import PICTURE_TYPES, is_of_picture, parse_picture_property
from ns_abstract.verify.property_reading import loading, parse_property, property_keys

ROOT = Path(__file__).resolve().parents[1]
OUTPUTS = 125 * 2 * 2
EXAMPLES: dict[str, list[dict[str, Any]]] = {
    "perturbation": [
        SET,
        {"$schema": "perturbation.schema.json", "translation": {"x": [-0.1, 0.2]}, "orbit": None, "hue": [-0.5, 1]},
        {"scene": [{"select": {"box": [[0] * 3, [1] * 3], "color": {"min": [0] * 3}, "opacity": [0, 1]}, "color": 1}]},
    ],
    "property": [
        {"$schema": "s", "type": "classification", "label": 2, "preprocess": PREPROCESS, "partitions": 3},
        {"type": "regression", "target": ["camera.x", 0.5], "tolerance": {"absolute": [0.1, 0.2]}, "origin": [0, 1, 2],
         "scale": 2.0, "partitions": [1, 2], "output": "y"},
        {"type": "regression", "target": "distance", "tolerance": {"relative": 0.2}},
        {"type": "detection", "class": None, "iou": 0.5, "confidence": 0.45, "box": [0, 0, 4, 4]},
        {"type": "vnnlib", "file": "unsafe.vnnlib",
         "preprocess": {"resize": None, "std": [1, 2, 3], "mean": [0, 0, 0], "layout": "NCHW", "channels": "BGR",
                        "range": [0, 255]}},
    ],
    "picture": [
        {"$schema": "s", "type": "visible", "select": {"box": [[0, 0, 0], [1, 1, 1]]}, "weight": 0.5, "pixels": 40,
         "preprocess": {"resize": [8, 8]}, "partitions": 2},
        {"type": "visible", "select": {}, "fraction": 0.5, "mask": "mask.png"},
        {"type": "clear", "distance": 0.5, "units": "dataset", "measure": "expected", "region": "all"},
        {"$schema": "s", "preprocess": {}, "all": [
            {"type": "picture", "statistic": "mean", "channel": "luminance", "min": 0.1, "max": 0.5,
             "region": [0, 0, 4, 4], "minus": [4, 4, 8, 8]},
            {"any": [{"type": "clear", "distance": 1.0, "weight": 0.4}]},
        ]},
    ],
    "loop": [
        LOOP,
        {
            "$schema": "s", "version": 1, "state": ["x", "y", "h"], "units": ["m", "m", "rad"], "output": "y",
            "initial": {"x": 0.1, "y": [0, 0.1], "h": 0}, "steps": 3, "sampling_time": 0.1, "network": "net.onnx",
            "dynamics": {"type": "unicycle", "speed": 2.0}, "disturbance": {"x": 0.01, "y": None},
            "camera": {"camera_to_world": [float(i % 5 == 0) for i in range(16)], "fov": 50,
                       "position": {"offset": [0, 0, 1], "matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]},
                       "yaw": {"offset": 0.1, "row": [0, 0, 1]}},
            "control": {"gain": [[1.0, 2.0]], "goal": [0, 1], "clip": [[-1, 1]]},
            "unsafe": [{"half_space": {"normal": [1, 0, 0], "at_least": 2}}],
            "goal": {"box": {"x": [1, None]}, "when": "any"},
        },
        *({**LOOP, "dynamics": d, "state": [*"abcdef"[:n]], "initial": dict.fromkeys("abcdef"[:n], 0.0),
           "unsafe": [{"box": {"a": [1, 2]}}],
           "camera": {**LOOP["camera"], "position": {"matrix": [[1.0] * n] * 3}}}
          for n, d in ((4, {"type": "double integrator", "axes": 2, "drag": 0.1, "quadratic_drag": 0.1}),
                       (5, {"type": "fixed wing", "speed": 2}), (5, {"type": "quadrotor", "lag": 1, "gravity": 9}),
                       (1, {"type": "affine", "A": [[1]], "B": [[1]], "c": [0]}))),
    ],
}  # fmt: skip


def _property(value: Any, folder: Path) -> None:
    sizes = {"regression": (1,) if "distance" in str(value) else (2,), "detection": (OUTPUTS,), "vnnlib": (2,)}
    kind = str(value.get("type")) if isinstance(value, dict) else ""
    loading(value)
    parse_property(value, folder, (3, 16, 16), sizes.get(kind, (3,)))


def _no(value: Any) -> None:
    raise InputError("not of a picture", field="type", fix="")


READERS: dict[str, Callable[[Any, Path], object]] = {
    "perturbation": lambda value, folder: parse_perturbation(value, folder=folder),
    "property": _property,
    "picture": lambda value, folder: parse_picture_property(value, folder) if is_of_picture(value) else _no(value),
    "loop": parse_loop,
}
#: Properties of the picture are of the same file.
SCHEMAS = {"picture": "property"}
#: How often the schema notices what the reader refuses, at least: the reader also knows scene, network and ranges.
NOTICED = 0.85


@functools.cache
def checkers() -> dict[str, Any]:
    """Validators by kind of file; importing their package takes seconds, so it waits for the first test."""
    jsonschema = pytest.importorskip("jsonschema")
    documents = {name: getattr(schemas, f"{SCHEMAS.get(name, name)}_schema")() for name in EXAMPLES}
    for document in documents.values():
        jsonschema.Draft202012Validator.check_schema(document)
    return {name: jsonschema.Draft202012Validator(document) for name, document in documents.items()}


def taken(kind: str, value: Any, folder: Path) -> bool:
    try:
        READERS[kind](value, folder)
    except InputError:
        return False
    return True


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    lines = "(declare-const Y_0 Real)(declare-const Y_1 Real)(assert (<= Y_0 Y_1))"
    (tmp_path / "unsafe.vnnlib").write_text(lines)
    Image.new("L", (32, 32), 255).save(tmp_path / "mask.png")
    return tmp_path


def damaged(value: Any) -> Iterator[Any]:
    """The value with each part replaced by parts of other types, each key removed, and a key more in each object."""

    def walk(part: Any, put: Callable[[Any], Any]) -> Iterator[Any]:
        for other in (None, True, "far", -1, 1e6, [], {}, [1], [2, 1], 0.5, 3):
            yield put(other)
        if isinstance(part, Mapping):
            yield put({**part, "bogus": 1})
            for key in part:
                yield put({k: v for k, v in part.items() if k != key})
                yield from walk(part[key], lambda new, key=key: put({**part, key: new}))
        elif isinstance(part, list):
            yield put([*part, *part[-1:]])
            for k in range(min(len(part), 2)):
                yield from walk(part[k], lambda new, k=k: put([*part[:k], new, *part[k + 1 :]]))

    yield from walk(copy.deepcopy(value), lambda new: new)


@pytest.mark.slow
@pytest.mark.parametrize("kind", EXAMPLES)
def test_what_the_reader_takes_the_schema_takes(kind: str, folder: Path) -> None:
    refused = noticed = 0
    for example in EXAMPLES[kind]:
        assert taken(kind, example, folder) and checkers()[kind].is_valid(example), example
        for value in damaged(example):
            good = checkers()[kind].is_valid(value)
            if taken(kind, value, folder):
                assert good, (value, next(checkers()[kind].iter_errors(value)).message)
            else:
                refused, noticed = refused + 1, noticed + (not good)
    assert noticed >= NOTICED * refused > 100, (noticed, refused)


@pytest.mark.slow
def test_the_corpus_has_no_file_that_a_schema_refuses_alone(folder: Path) -> None:
    kinds = {"spec": ("perturbation", SET), "prop": ("property", EXAMPLES["property"][0]), "loop": ("loop", LOOP)}
    count = 0
    for case in ROWS.values():
        for name, change in case.changes.items():
            if name not in kinds:
                continue
            kind, value = kinds[name]
            file = folder / "file.json"
            file.write_text(json.dumps(value))
            try:
                if callable(change):
                    change(file)
                    value = json.loads(file.read_text()) if file.is_file() else file.unlink()
                else:
                    value = json.loads(change) if isinstance(change, (str, bytes)) else change
            except (ValueError, OSError, RecursionError, InputError):
                continue
            finally:
                if not file.is_file():
                    file.rmdir() if file.is_dir() else file.unlink(missing_ok=True)
            count += 1
            assert checkers()[kind].is_valid(value) or not taken(kind, value, folder), case.name
    assert count > 50


def test_every_key_of_the_readers_has_a_schema_of_its_own() -> None:
    for kind, checker in checkers().items():
        text = json.dumps(checker.schema)
        assert text.count(": {}") == 0, kind
    cases = checkers()["property"].schema["allOf"]
    pictures = {name: (*kind.keys, "preprocess", "partitions") for name, kind in PICTURE_TYPES.items()}
    for (name, keys), case in zip((property_keys() | pictures).items(), cases[:-1], strict=True):
        assert {*keys, "type", "$schema"} == case["then"]["properties"].keys(), name


def test_the_published_schemas_are_those_of_the_readers() -> None:
    """docs/schemas is written by ``ns-abstract-export schemas --output-dir docs/schemas``."""
    for name, content in schemas.schema_files().items():
        assert (ROOT / "docs" / "schemas" / name).read_bytes() == content, name
