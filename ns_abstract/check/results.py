"""Reading of a result's folder, and what can be checked of its structure alone: exactly, without a picture."""

from __future__ import annotations

import hashlib
import math
import zipfile
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.check.inputs import BadInput, read_json

Array = Any

_KEEP = "run ns-abstract-render with --save-cells"
#: Bytes of arrays of one frame that are read at most.
_MOST = 32 << 30


@dataclass(frozen=True)
class Cells:
    """A frame's bounds and linear sets; arrays as docs/results.md describes them.

    Attributes:
        index: Number of the frame.
        names, lower, upper: Parameters of the set and their ranges.
        arrays: By name; ``lower`` and ``upper`` [H, W, 3], ``box_lower`` [n, d] and so on.
    """

    index: int
    names: tuple[str, ...]
    lower: Array
    upper: Array
    arrays: dict[str, Array]


def read_report(folder: Path) -> dict[str, Any]:
    """The report of a finished result."""
    if not folder.is_dir():
        raise BadInput("no such folder", folder, fix="give the output folder of ns-abstract-render")
    if (folder / "cells.sqlite").exists():
        problem = "holds the cells of a certificate, and this program checks results of ns-abstract-render"
        raise BadInput(problem, folder, fix="render the set with --save-cells and check that")
    report = read_json(folder / "report.json", "report", "give the output folder of ns-abstract-render")
    if report.get("version") != 1:
        raise BadInput(
            f"found {report.get('version')!r}", folder / "report.json", "version", "this program reads version 1"
        )
    for name, kind in (("settings", dict), ("sha256", dict), ("fingerprint", dict), ("frames", list), ("scene", dict)):
        if not isinstance(report.get(name), kind):
            raise BadInput("missing", folder / "report.json", name, "give the output folder of ns-abstract-render")
    return report


def read_cells(folder: Path, name: str, index: int, digest: object) -> Cells:
    """A frame file, checked before anything in it is unpacked."""
    file = folder / name
    try:
        content = hashlib.sha256()
        with file.open("rb") as stream:
            while block := stream.read(1 << 24):
                content.update(block)
        if content.hexdigest() != digest:
            raise BadInput("is not the file that the report names (sha256)", file, fix="render the frame again")
        with zipfile.ZipFile(file) as archive:
            declared = {entry.filename.removesuffix(".npy"): _header(archive, entry) for entry in archive.infolist()}
    except (OSError, zipfile.BadZipFile, ValueError, KeyError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput("cannot be read as a frame file", file, fix="render the frame again") from None
    if "box_lower" not in declared:
        raise BadInput("keeps no cells", file, fix=_KEEP)
    try:
        n, d = declared["box_lower"][0]
        (h, w, _), side = declared["lower"][0], declared["b_lower"][0][1]
    except (KeyError, ValueError, IndexError):
        raise BadInput("is not a frame file", file, fix="render the frame again") from None
    tiles, single, double = (n, side, side, 3), np.dtype("<f4"), np.dtype("<f8")
    wanted = {"lower": ((h, w, 3), single), "upper": ((h, w, 3), single), "tile": ((n, 2), np.dtype("<i4"))}
    wanted |= dict.fromkeys(("box_lower", "box_upper"), ((n, d), double))
    wanted |= dict.fromkeys(("b_lower", "b_upper"), (tiles, single))
    wanted |= dict.fromkeys(("A_lower", "A_upper"), ((*tiles, d), single))
    for name_, (shape, kind) in wanted.items():
        if declared.get(name_) != (shape, kind):
            raise BadInput(f"{name_} is not {kind} {list(shape)}", file, fix="render the frame again")
    shape, kind = declared.get("parameters", ((), None))
    if shape != (d,) or kind is None or kind.names != ("name", "unit", "lower", "upper") or kind.itemsize > 1 << 16:
        raise BadInput("parameters are no table of names and ranges", file, fix="render the frame again")
    if sum(math.prod(s) * k.itemsize for s, k in wanted.values()) > _MOST:
        raise BadInput("is too large", file)
    try:
        with np.load(file, allow_pickle=False) as archive:
            arrays = {name_: archive[name_] for name_ in wanted}
            table = archive["parameters"]
    except (OSError, ValueError, zipfile.BadZipFile, zipfile.LargeZipFile):
        raise BadInput("cannot be unpacked", file, fix="render the frame again") from None
    if not all(np.isfinite(a).all() for a in arrays.values()):
        raise BadInput("holds numbers that are not finite", file, fix="render the frame again")
    return Cells(index, tuple(map(str, table["name"])), table["lower"], table["upper"], arrays)


def _header(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of an array, from its first bytes."""
    with archive.open(entry) as member:
        version = np.lib.format.read_magic(member)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, kind = read(member)
    if kind.hasobject or fortran:
        raise ValueError("objects are not read")
    return shape, kind


def structure(cells: Cells) -> list[str]:
    """What is wrong with a frame's cells: every tile's cells must be a partition of the set, every pixel bounded."""
    a, wrong = cells.arrays, []
    height, width, _ = a["lower"].shape
    side = a["b_lower"].shape[1]
    if not (a["lower"] <= a["upper"]).all():
        wrong.append("a lower bound exceeds the upper bound")
    wanted = {(r, c) for r in range(0, height, side) for c in range(0, width, side)}
    tiles = [tuple(map(int, t)) for t in a["tile"]]
    if set(tiles) != wanted:
        wrong.append("the cells' tiles are not those of the picture")
    if (a["box_lower"] > a["box_upper"]).any():
        wrong.append("a cell's range is reversed")
    groups: dict[tuple[int, ...], list[int]] = {}
    for k, tile in enumerate(tiles):
        groups.setdefault(tile, []).append(k)
    seen: dict[bytes, bool] = {}
    for tile, members in groups.items():
        low, high = a["box_lower"][members], a["box_upper"][members]
        key = low.tobytes() + high.tobytes()
        if key not in seen:
            seen[key] = partition(low, high, cells.lower, cells.upper)
        if not seen[key]:
            wrong.append(f"the cells of tile {list(tile)} are no partition of the set")
            break
    return wrong


def partition(low: Array, high: Array, first: Array, last: Array) -> bool:
    """Whether boxes [n, d] tile the box [first, last]: within it, disjoint inside, of its volume; in exact numbers."""
    if not ((low >= first) & (high <= last) & (low <= high)).all():
        return False
    for k in range(len(low)):
        apart = ((high[k + 1 :] <= low[k]) | (low[k + 1 :] >= high[k])).any(axis=1)
        if not apart.all():
            return False
    # a float64 is a rational number
    rows = (zip(a, b, strict=True) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    volume = sum(math.prod(Fraction(b) - Fraction(a) for a, b in row) for row in rows)
    whole = math.prod(Fraction(b) - Fraction(a) for a, b in zip(first.tolist(), last.tolist(), strict=True))
    return volume == whole
