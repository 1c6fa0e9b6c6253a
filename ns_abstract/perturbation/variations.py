"""Variations of a scene's Gaussians: the key ``"scene"`` of the perturbation file."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.io.errors import InputError
from ns_abstract.io.fields import Fail, Range, Vector, interval, known, vector
from ns_abstract.io.jsonio import file_beside, load_json, read_bytes, read_text, show

#: What an entry of the list may hold.
VARIATIONS = ("mean", "opacity", "color")
KEYS = ("select", *VARIATIONS)
SELECT_KEYS = ("box", "indices", "opacity", "color")

_INDEX_BYTES = 256 << 20
_INDEX_FIX = "write whole numbers of at least 0: a list, or the name of a .json, .npy or .txt file"


@dataclass(frozen=True)
class Selection:
    """A set of Gaussians: those that every rule given picks; all without a rule.

    The stored mean lies in ``box`` (normalised frame), ``indices`` count from 0, and the activated colour of band 0
    (RGB) lies between its ends.
    """

    box: tuple[Vector, Vector] | None = None
    indices: tuple[int, ...] | None = None
    opacity: Range | None = None
    color_min: Vector | None = None
    color_max: Vector | None = None


@dataclass(frozen=True)
class SceneVariation:
    """Ranges around the stored values, for each selected Gaussian independently (design.md, S1).

    Attributes:
        mean: Of every coordinate of the mean, world axes, normalised units; None: fixed.
        opacity: Of the activated opacity; the sum is clipped to [0, 1].
        color: Of every channel of the activated colour; the sum is clamped as the program clamps colours.
    """

    select: Selection
    mean: Range | None = None
    opacity: Range | None = None
    color: Range | None = None
    name: str = field(default="scene", compare=False, repr=False)


def parse_selection(value: object, name: str, fail: Fail, folder: Path | None) -> Selection:
    """Check a ``select`` object; see `ns_abstract.io.fields` and `parse_perturbation`.

    Raises:
        InputError: A key is unknown, a value has the wrong type or is reversed, an index file cannot be used.
    """
    if not isinstance(value, dict):
        raise fail(name, f"found {show(value)}", f"write an object with {', '.join(SELECT_KEYS)}")
    known(value, SELECT_KEYS, f"{name}.", fail)
    box = None
    if "box" in value:
        corners = value["box"]
        if not (isinstance(corners, list) and len(corners) == 2):
            raise fail(f"{name}.box", f"found {show(corners)}", "write [[x0, y0, z0], [x1, y1, z1]]")
        low, high = (vector(corner, f"{name}.box", fail) for corner in corners)
        _ordered(low, high, f"{name}.box", fail)
        box = low, high
    low_color = high_color = None
    if "color" in value:
        rule = value["color"]
        if not isinstance(rule, dict) or not rule:
            raise fail(f"{name}.color", f"found {show(rule)}", 'write {"min": [r, g, b], "max": [r, g, b]}')
        known(rule, ("min", "max"), f"{name}.color.", fail)
        low_color = vector(rule["min"], f"{name}.color.min", fail) if "min" in rule else None
        high_color = vector(rule["max"], f"{name}.color.max", fail) if "max" in rule else None
        if low_color is not None and high_color is not None:
            _ordered(low_color, high_color, f"{name}.color", fail)
    return Selection(
        box=box,
        indices=_indices(value["indices"], f"{name}.indices", fail, folder) if "indices" in value else None,
        opacity=interval(value["opacity"], f"{name}.opacity", fail, symmetric=False) if "opacity" in value else None,
        color_min=low_color,
        color_max=high_color,
    )


def selection_object(select: Selection) -> dict[str, Any]:
    """Return the content of a file for a selection; `parse_selection` reads it back as the same one."""
    content: dict[str, Any] = {}
    if select.box is not None:
        content["box"] = [list(corner) for corner in select.box]
    if select.indices is not None:
        content["indices"] = list(select.indices)
    if select.opacity is not None:
        content["opacity"] = list(select.opacity)
    colors = {"min": select.color_min, "max": select.color_max}
    if any(color is not None for color in colors.values()):
        content["color"] = {name: list(color) for name, color in colors.items() if color is not None}
    return content


def _ordered(low: Vector, high: Vector, name: str, fail: Fail) -> None:
    for a, b in zip(low, high, strict=True):
        if a > b:
            raise fail(name, f"the interval [{a:g}, {b:g}] is reversed", "write the smaller corner first")


def _indices(value: object, name: str, fail: Fail, folder: Path | None) -> tuple[int, ...]:
    """Return numbers of Gaussians, ascending, each once."""
    if isinstance(value, str):
        try:
            array = _index_file(file_beside(folder or Path(), value))
        except InputError as error:
            where = "" if error.file is None else f"{error.file}: "
            raise fail(name, f"{where}{error.problem}", error.fix or _INDEX_FIX) from None
    elif isinstance(value, list):
        array = _whole_numbers(value)
    else:
        raise fail(name, f"found {show(value)}", _INDEX_FIX)
    if array is None or array.ndim != 1:
        raise fail(name, "not a list of whole numbers", _INDEX_FIX)
    if array.size == 0:
        raise fail(name, "the list is empty", _INDEX_FIX)
    if array.min() < 0:
        raise fail(name, f"found {int(array.min())}", _INDEX_FIX)
    return tuple(np.unique(array).tolist())


def _whole_numbers(values: list[Any]) -> np.ndarray | None:
    good = all(isinstance(v, int) and not isinstance(v, bool) and abs(v) < 2**62 for v in values)
    return np.array(values, np.int64) if good else None


def _index_file(file: Path) -> np.ndarray | None:
    """Return the whole numbers in an index file; None where it holds anything else."""
    kind = file.suffix.lower()
    if kind == ".json":
        content = load_json(file, "index file", _INDEX_BYTES)
        return _whole_numbers(content) if isinstance(content, list) else None
    if kind == ".npy":
        try:
            array = np.load(io.BytesIO(read_bytes(file, "index file", _INDEX_BYTES)), allow_pickle=False)
        except InputError:
            raise
        except Exception as error:  # numpy raises many types on damaged files
            text = " ".join(str(error).split())[:120] or type(error).__name__
            raise InputError(f"damaged .npy: {text}", file=file, fix=_INDEX_FIX) from None
        fits = isinstance(array, np.ndarray) and array.dtype.kind in "iu" and not (array > 2**62).any()
        return array.astype(np.int64) if fits else None
    if kind == ".txt":
        words = read_text(file, "index file", _INDEX_BYTES).split()
        return np.array(words, np.int64) if all(w.isascii() and w.isdigit() and len(w) < 19 for w in words) else None
    raise InputError(f"unknown kind of file {show(file.suffix)}", file=file, fix=_INDEX_FIX)
