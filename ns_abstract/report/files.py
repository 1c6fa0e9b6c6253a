"""Frame files: each is written whole or not at all, and checked completely when it is read."""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.arrays import Archive, open_archive
from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import is_number, parse_json
from ns_abstract.io.memory import check_memory
from ns_abstract.refine.result import (
    EXTRA_OUTPUT_ARRAYS,
    EXTRA_OUTPUTS,
    ExtraOutput,
    FrameResult,
    Leaves,
    RenderedMaximum,
    SampleImages,
    TracePoint,
)

FORMAT = "ns-abstract frame"
VERSION = 1
#: Arrays [H, W, 3] of every frame file.
IMAGES = ("lower", "upper", "witness_lower", "witness_upper", "image")
#: Arrays [H, W] of a frame file with further outputs, by name and field of `ExtraOutput`: ``depth_lower``.
LAYER_NAMES = {f"{name}_{array}": (name, array) for name in EXTRA_OUTPUTS for array in EXTRA_OUTPUT_ARRAYS}
#: Arrays of a frame file with leaf cells.
LEAVES = tuple(field.name for field in fields(Leaves))
#: Arrays of a frame file with leaf cells: poses of the set, and what was rendered there.
VIEWS = ("view_values", "view_images")
#: Arrays of the frame file of a difference of two scenes.
DIFFERENCES = ("difference_upper", "difference_lower")

_NAME = re.compile(r"frame_(\d{5,})\.npz")
_IGNORED = "the frame is computed again"
# Level 6 takes longer and saves 1 to 3 % more of two real frames.
_COMPRESSION = 1
#: Most bytes of the record (a text of 4 bytes by character) and of the table of parameters.
_RECORD_LIMIT, _TABLE_LIMIT = 64 << 20, 1 << 20


def frame_name(index: int, suffix: str) -> str:
    """Return the file name of one frame: ``frame_00000.npz``."""
    return f"frame_{index:05d}.{suffix}"


def layer_name(index: int, name: str) -> str:
    """Return the file name of a frame's picture of a further output: ``frame_00000_depth.png``."""
    return f"frame_{index:05d}_{name}.png"


def frame_index(path: Path) -> int | None:
    """Return the frame number in the name of a frame file, or None for any other name."""
    match = _NAME.fullmatch(path.name)
    return int(match[1]) if match else None


def check_frame(result: FrameResult) -> None:
    """Raise ValueError for a result that no sound refinement can have.

    That is: shapes or types disagree, a number is not finite, a value leaves [0, 1], bounds cross, or a rendered image
    lies outside the bounds.
    """

    def fail(problem: str) -> ValueError:
        return ValueError(f"frame {result.index}: {problem}")

    shape = result.lower.shape
    if len(shape) != 3 or shape[2] != 3 or 0 in shape:
        raise fail(f"images are [H, W, 3], found {list(shape)}")
    for name in IMAGES:
        array = getattr(result, name)
        if array.dtype != np.float32 or array.shape != shape:
            raise fail(f"{name} is {array.dtype} {list(array.shape)}, not float32 {list(shape)}")
        # the polarity refuses NaN too
        if not (array.min() >= 0.0 and array.max() <= 1.0):
            raise fail(f"{name} has values that are not in [0, 1]")
    order = ("lower", "witness_lower", "image", "witness_upper", "upper")
    for low, high in itertools.pairwise(order):
        excess = float((getattr(result, low) - getattr(result, high)).max())
        if not excess <= 0.0:
            raise fail(f"{low} exceeds {high} by {excess:.3g}; the bounds are not sound")
    for name, layer in result.layers.items():
        _check_layer(name, layer, shape[:2], fail)
    box = result.box
    if result.largest is not None:
        value, pose = result.largest
        if not (0.0 <= value <= float(result.witness_upper.max()) and box.contains(np.array(pose).reshape(-1))):
            raise fail("the largest value is not one that was rendered of the set")
    if not len(box.names) == len(box.units) == len(box.lower) == len(box.upper):
        raise fail("the box has sides of different number")
    for name, low, high in zip(box.names, box.lower, box.upper, strict=True):
        if not (math.isfinite(low) and math.isfinite(high) and low <= high):
            raise fail(f"parameter {name} ranges from {low} to {high}")
    numbers = [result.seconds, *(v for p in result.trace for v in (p.seconds, p.mpg, p.mpg_witness))]
    if not all(math.isfinite(v) and v >= 0.0 for v in numbers):
        raise fail("times and gaps must be finite and not negative")
    if not all(0.0 <= point.covered <= 1.0 for point in result.trace):
        raise fail("a part of the set that is covered lies between 0 and 1")
    if result.leaves is not None:
        _check_leaves(result.leaves, box.dimensions, fail)
    if result.views is not None:
        _check_views(result, result.views, fail)


def _check_views(result: FrameResult, views: SampleImages, fail: Callable[[str], ValueError]) -> None:
    values, images, box = views.values, views.images, result.box
    if values.dtype != np.float64 or values.ndim != 2 or values.shape[1] != box.dimensions:
        raise fail(f"views: values are {values.dtype} {list(values.shape)}, not float64 [n, {box.dimensions}]")
    if images.dtype != np.float32 or images.shape != (values.shape[0], *result.lower.shape):
        raise fail(f"views: images are {images.dtype} {list(images.shape)}")
    # the polarity refuses NaN too
    if not ((values >= np.array(box.lower)).all() and (values <= np.array(box.upper)).all()):
        raise fail("views: a pose is not one of the set")
    if not ((images >= result.lower).all() and (images <= result.upper).all()):
        raise fail("views: a render lies outside the bounds; the bounds are not sound")


def _check_layer(name: str, layer: ExtraOutput, shape: tuple[int, ...], fail: Callable[[str], ValueError]) -> None:
    for field in EXTRA_OUTPUT_ARRAYS:
        array = getattr(layer, field)
        if array.dtype != np.float32 or array.shape != shape:
            raise fail(f"{name}_{field} is {array.dtype} {list(array.shape)}, not float32 {list(shape)}")
        # an upper bound may be infinite; the polarity refuses NaN too
        most = np.inf if name == "depth" else 1.0
        finite = field == "upper" or np.isfinite(array).all()
        if not (finite and array.min() >= 0.0 and array.max() <= most):
            raise fail(f"{name}_{field} has values that no such output has")
    for low, high in itertools.pairwise(("lower", "witness_lower", "image", "witness_upper", "upper")):
        if not (getattr(layer, low) <= getattr(layer, high)).all():
            raise fail(f"{name}_{low} exceeds {name}_{high}; the bounds are not sound")


def _check_leaves(leaves: Leaves, d: int, fail: Callable[[str], ValueError]) -> None:
    count = leaves.tile.shape[0]
    side = leaves.b_lower.shape[1:2]
    pixels = (count, *side, *side, 3)
    shapes = {
        "box_lower": (count, d),
        "box_upper": (count, d),
        "tile": (count, 2),
        "A_lower": (*pixels, d),
        "A_upper": (*pixels, d),
        "b_lower": pixels,
        "b_upper": pixels,
    }
    for name, shape in shapes.items():
        array = getattr(leaves, name)
        kind = np.int32 if name == "tile" else np.float64 if name.startswith("box") else np.float32
        if array.shape != shape or array.dtype != kind:
            raise fail(f"leaves: {name} is {array.dtype} {list(array.shape)}, not {np.dtype(kind)} {list(shape)}")
        if not np.isfinite(array).all():
            raise fail(f"leaves: {name} has values that are not finite")


def _parameters(box: ParameterBox) -> np.ndarray:
    """Return the parameters as [d] records (name, unit, lower, upper)."""
    text = max([1, *map(len, box.names), *map(len, box.units)])
    kind = [("name", f"U{text}"), ("unit", f"U{text}"), ("lower", "f8"), ("upper", "f8")]
    return np.array(list(zip(box.names, box.units, box.lower, box.upper, strict=True)), kind)


def save_frame(
    path: str | os.PathLike[str], result: FrameResult, *, status: str = "done", about: Mapping[str, Any] | None = None
) -> None:
    """Write ``frame_00000.npz``; every array reads with ``np.load(path, allow_pickle=False)``.

    The file holds ``lower``, ``upper``, ``witness_lower``, ``witness_upper`` and ``image`` [H, W, 3]
    float32, ``parameters`` [d] (fields name, unit, lower, upper), ``record`` (a JSON text), the arrays
    [H, W] of further outputs as ``depth_lower``, ``accumulation_witness_upper`` and so on, and, where
    the result has leaves, the arrays of `ns_abstract.refine.result.Leaves` under their own names, and
    ``view_values`` [n, d] and ``view_images`` [n, H, W, 3], renders across the set. Of a difference of two scenes,
    ``difference_upper`` and ``difference_lower`` are ``upper`` and ``witness_upper`` by their meaning.

    Args:
        status: "done", "partial" or "missing".
        about: What was bounded, for the reader of the single file; strict JSON.

    Raises:
        ValueError: As `check_frame`, or ``about`` is not JSON.
        OSError: The file cannot be written.
    """
    check_frame(result)
    record = {
        "format": FORMAT,
        "version": VERSION,
        "index": int(result.index),
        "status": status,
        "bounded": bool(result.bounded),
        "seconds": float(result.seconds),
        "cells": int(result.cells),
        "plan": list(result.plan),
        "trace": [
            [float(p.seconds), int(p.cells), float(p.mpg), float(p.mpg_witness), float(p.covered)] for p in result.trace
        ],
        "about": dict(about or {}),
    }
    if result.largest is not None:
        record["largest"] = [float(result.largest.value), [float(v) for v in result.largest.pose]]
    arrays: dict[str, np.ndarray] = {name: getattr(result, name) for name in IMAGES}
    arrays["parameters"] = _parameters(result.box)
    arrays["record"] = np.array(json.dumps(record, allow_nan=False))
    if result.largest is not None:
        arrays |= dict(zip(DIFFERENCES, (result.upper, result.witness_upper), strict=True))
    arrays |= {full: getattr(result.layers[n], a) for full, (n, a) in LAYER_NAMES.items() if n in result.layers}
    if result.leaves is not None:
        arrays |= {name: getattr(result.leaves, name) for name in LEAVES}
    if result.views is not None:
        arrays |= dict(zip(VIEWS, (result.views.values, result.views.images), strict=True))

    def write(stream: BinaryIO) -> None:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=_COMPRESSION) as archive:
            for name, array in arrays.items():
                entry = zipfile.ZipInfo(f"{name}.npy")
                # coefficients are noise to the compressor
                entry.compress_type = zipfile.ZIP_STORED if name in LEAVES else zipfile.ZIP_DEFLATED
                with archive.open(entry, "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)

    write_atomic(path, write)


@dataclass(frozen=True)
class StoredFrame:
    """A frame file's content.

    Attributes:
        status: "done", "partial" or "missing".
        about: What was bounded, as given to `save_frame`.
        has_leaves: Whether the file has leaf cells, read or not.
    """

    result: FrameResult
    status: str
    about: dict[str, Any]
    has_leaves: bool


def load_frame(
    path: str | os.PathLike[str], *, leaves: bool = True, size: tuple[int, int] | None = None
) -> StoredFrame:
    """Read a frame file and check all of it; nothing in the file is run.

    Args:
        path: A file that `save_frame` wrote.
        leaves: Whether to read the leaf cells, which may be large.
        size: Height and width that the frame must have; None: any for which there is memory.

    Raises:
        InputError: The file is absent, truncated, damaged or not a frame file, or holds what no
            sound refinement can have. The reason is in ``problem``.
    """
    path = Path(path)

    def fail(problem: str) -> InputError:
        return InputError(problem, file=path, fix=_IGNORED)

    if not path.exists():
        raise fail("no such file")
    try:
        with open_archive(path, "frame file", _IGNORED) as archive:
            missing = {*IMAGES, "parameters", "record"} - set(archive.declared)
            if missing:
                raise fail(f"not a frame file: no {', '.join(sorted(missing))}")
            has_leaves = set(LEAVES) <= set(archive.declared)
            _check_declared(archive, size, has_leaves and leaves, path)
            stored = _parse(archive, has_leaves, leaves)
        check_frame(stored.result)
    except InputError as error:
        raise error if error.file else fail(error.problem) from None
    except ValueError as error:
        raise fail(f"cannot be read: {type(error).__name__}: {error}") from None
    named = frame_index(path)
    if named is not None and named != stored.result.index:
        raise fail(f"holds frame {stored.result.index}")
    return stored


def _check_declared(archive: Archive, size: tuple[int, int] | None, leaves: bool, path: Path) -> None:
    """Refuse arrays that no frame has, or that do not fit into memory, before they are unpacked."""
    (shape, kind) = archive.declared["lower"]
    if len(shape) != 3 or shape[2] != 3 or kind != np.float32:
        raise InputError(f"lower is {kind} {list(shape)[:4]}, not float32 [H, W, 3]")
    for name in IMAGES:
        if archive.declared[name] != (shape, kind):
            raise InputError(
                f"{name} is {archive.declared[name][1]} {list(archive.declared[name][0])[:4]}, unlike lower"
            )
    for name in LAYER_NAMES:
        if name in archive.declared and archive.declared[name] != (shape[:2], kind):
            raise InputError(f"{name} is unlike lower")
    if size is not None and shape[:2] != size:
        raise InputError(f"has {shape[1]} x {shape[0]} pixels, not {size[1]} x {size[0]}")
    for name, most in (("record", _RECORD_LIMIT), ("parameters", _TABLE_LIMIT)):
        rows, kind = archive.declared[name]
        if math.prod(rows) * kind.itemsize > most:
            raise InputError(f"{name} has {math.prod(rows) * kind.itemsize:,} bytes")
    more = (*LEAVES, *(name for name in VIEWS if name in archive.declared)) if leaves else ()
    wanted = (*IMAGES, *more, *(name for name in LAYER_NAMES if name in archive.declared))
    needed = sum(math.prod(archive.declared[name][0]) * archive.declared[name][1].itemsize for name in wanted)
    check_memory(2 * needed, path, "the frame")


def _parse(archive: Archive, has_leaves: bool, read_leaves: bool) -> StoredFrame:
    record = parse_json(str(archive.read("record")[()]))
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise InputError("not a frame file")
    if record.get("version") != VERSION:
        raise InputError(f"frame file of version {record.get('version')}, not {VERSION}")
    table = archive.read("parameters")
    if table.ndim != 1 or table.dtype.names != ("name", "unit", "lower", "upper"):
        raise InputError("the parameters are not a list of (name, unit, lower, upper)")
    box = ParameterBox(
        tuple(map(str, table["name"])),
        tuple(map(str, table["unit"])),
        tuple(map(float, table["lower"])),
        tuple(map(float, table["upper"])),
    )
    layers = {}
    for name in EXTRA_OUTPUTS:
        stored_layers = [full for full, (layer, _) in LAYER_NAMES.items() if layer == name and full in archive.declared]
        if stored_layers and len(stored_layers) < len(EXTRA_OUTPUT_ARRAYS):
            raise InputError(f"not all arrays of {name}")
        if stored_layers:
            layers[name] = ExtraOutput(*(archive.read(full) for full in stored_layers))
    result = FrameResult(
        index=_integer(record["index"]),
        box=box,
        **{name: archive.read(name) for name in IMAGES},  # type: ignore[arg-type]
        seconds=float(record["seconds"]),
        cells=_integer(record["cells"]),
        # files of earlier versions say nothing of what was covered: all of it
        trace=tuple(
            TracePoint(float(s), _integer(c), float(m), float(w), *map(float, rest))
            for s, c, m, w, *rest in record["trace"]
        ),
        plan=tuple(map(str, record["plan"])),
        bounded=record["bounded"] is True,
        leaves=Leaves(**{name: archive.read(name) for name in LEAVES}) if has_leaves and read_leaves else None,
        layers=layers,
        views=SampleImages(*(archive.read(name) for name in VIEWS))
        if read_leaves and set(VIEWS) <= set(archive.declared)
        else None,
        largest=_maximum(record.get("largest")),
    )
    if record["status"] not in ("done", "partial", "missing"):
        raise InputError("the status is not one of done, partial, missing")
    return StoredFrame(result, record["status"], dict(record["about"]), has_leaves)


def _maximum(stored: Any) -> RenderedMaximum | None:
    if stored is None:
        return None
    if not (isinstance(stored, list) and len(stored) == 2 and isinstance(stored[1], list)):
        raise InputError("the largest value is not a value and a pose")
    if not all(is_number(v) for v in (stored[0], *stored[1])):
        raise InputError("the largest value and its pose are not numbers")
    return RenderedMaximum(float(stored[0]), tuple(map(float, stored[1])))


def _integer(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError("found something other than a count")
    return value
