"""Reads the folder of a result, and checks its structure exactly, without rendering."""

from __future__ import annotations

import hashlib
import json
import math
import os
import sqlite3
import zipfile
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.check.inputs import BadInput, read_json, reading, sha256

Array = Any

#: Bytes of arrays of one frame, and rows of a table, that are read at most.
_MOST, _ROWS = min(32 << 30, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2), 10_000_000
#: Arrays of a frame file, and their types.
_KINDS = {"tile": "<i4", "box_lower": "<f8", "box_upper": "<f8"}
_KINDS |= {f"{of}{side}": "<f4" for of in ("", "witness_", "b_", "A_") for side in ("lower", "upper")}
_AGAIN, _BOX = "make the result again", ("name", "lower", "upper")
_WHERE = "give the output folder of ns-abstract-render, ns-abstract-certify or ns-abstract-reach"


@dataclass(frozen=True)
class StoredCells:
    """The cells of a frame, or of a question about a loop; arrays as docs/results.md describes them."""

    #: Number of the frame or question.
    index: int
    #: Parameters of the set and their ranges.
    names: tuple[str, ...]
    lower: Array
    upper: Array
    #: ``box_lower`` and ``box_upper`` [n, d]; of pictures, those of the frame file by name.
    arrays: dict[str, Array]
    #: Of a certificate or loop, by cell: verdict, margin, counterexample.
    verdicts: list[tuple[str, float | None, list[float] | None]] | None = None


def read_report(folder: Path) -> dict[str, Any]:
    """Return report.json of a result, of the version and kinds that can be checked."""
    if not folder.is_dir():
        raise BadInput("no such folder", folder, fix=_WHERE)
    report = read_json(file := folder / "report.json", "report", _WHERE)
    if report.get("version") != 1:
        raise BadInput(f"found {report.get('version')!r}", file, "version", "this program reads version 1")
    for name in ("settings", "fingerprint", "scene", "renderer"):
        if not isinstance(report.get(name), dict):
            raise BadInput("missing", file, name, _WHERE)
    if report.get("kind") == "comparison" or "answer" in report:
        raise BadInput("results of ns-abstract-compare and ns-abstract-locate are not checked", file, fix=_WHERE)
    return report


def read_cells(folder: Path, name: str, index: int, digest: object) -> StoredCells:
    """Return the cells of a frame file, whose digest, sizes and types are checked before arrays are unpacked."""
    with reading(file := folder / name, "cannot be read as a frame file", _AGAIN):
        if sha256(file) != digest:
            raise BadInput("is not the file that the report names (sha256)", file, fix=_AGAIN)
        with zipfile.ZipFile(file) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _MOST:
                raise BadInput("is too large", file)
        with np.load(file, allow_pickle=False) as archive:
            if "box_lower" not in archive:
                raise BadInput("keeps no cells", file, fix="run ns-abstract-render with --save-cells")
            arrays, table = {key: archive[key] for key in _KINDS}, archive["parameters"]
        (n, d), picture, side = arrays["box_lower"].shape, arrays["lower"].shape, arrays["b_lower"].shape[1]
        square = n, side, side, 3
        shapes = {"": picture, "witness": picture, "tile": (n, 2), "box": (n, d), "b": square, "A": (*square, d)}
        for key, array in arrays.items():
            shape, kind = shapes[key if key == "tile" else key.rpartition("_")[0]], np.dtype(_KINDS[key])
            if array.shape != shape or array.dtype != kind or picture[2:] != (3,):
                raise BadInput(f"{key} is not {kind} {list(shape)}", file, fix=_AGAIN)
            if not np.isfinite(array).all():
                raise BadInput("holds numbers that are not finite", file, fix=_AGAIN)
        if table.shape != (d,) or table.dtype.names != ("name", "unit", "lower", "upper"):
            raise BadInput("parameters are no table of names and ranges", file, fix=_AGAIN)
    return StoredCells(index, tuple(map(str, table["name"])), table["lower"], table["upper"], arrays)


def read_verdicts(folder: Path, report: dict[str, Any]) -> list[StoredCells]:
    """Return the cells of a certificate by frame, or those of a loop by question (0 safe, 1 reaches)."""
    file, rows, total, loop, cells = folder / "cells.sqlite", 0, 0, report.get("kind") == "loop", []
    by_frame: dict[int, list[Any]] = {}
    with reading(file, "cannot be read as the cells of this result", _AGAIN):
        frames = [{"index": k, "parameters": report["parameters"]} for k in (0, 1)] if loop else report["frames"]
        if loop and _initial(report["loop"]) != [[p.get(key) for key in _BOX] for p in report["parameters"]]:
            raise BadInput("is of other initial states than the loop's", folder / "report.json", "parameters", _AGAIN)
        # in a folder that cannot be written, SQLite could not make its file beside a finished table
        fixed = "" if os.access(folder, os.W_OK) or Path(f"{file}-wal").exists() else "&immutable=1"
        base = sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro{fixed}", uri=True)
        # rows that stand for what is still to be examined
        query = "SELECT value FROM search_state WHERE key = 'open_rows'"
        left = set(json.loads((base.execute(query).fetchone() or ["[]"])[0]))
        stated = [name for (name,) in base.execute("SELECT name FROM parameters ORDER BY position")]
        columns = "rowid, frame, lower, upper, verdict, margin, seconds, counterexample"
        for number, *row in base.execute(f"SELECT {columns} FROM cells LIMIT {_ROWS}"):
            frame, low, high, verdict, margin, _, example = row
            boxes, kind = [json.loads(low), json.loads(high)], "open" if number in left else verdict
            by_frame.setdefault(frame, []).append((boxes, kind, margin, json.loads(example or "null")))
            if number not in left:
                total += int.from_bytes(hashlib.sha256(json.dumps(row).encode()).digest(), "big")
                rows += 1
        base.close()
        if {"rows": rows, "sum": f"{total % (1 << 256):064x}"} != report["cells_seal"]:
            raise BadInput("does not hold the cells that the report names (cells_seal)", file, fix=_AGAIN)
        sets = {int(frame["index"]): frame["parameters"] for frame in frames}
        for index, entries in sorted(by_frame.items()):
            names, first, last = ([p[key] for p in sets[index]] for key in _BOX)
            boxes = np.array([entry[0] for entry in entries], np.float64)
            if boxes.shape != (len(entries), 2, len(names)) or not np.isfinite(boxes).all() or names != stated:
                raise ValueError
            arrays, verdicts = {"box_lower": boxes[:, 0], "box_upper": boxes[:, 1]}, [entry[1:] for entry in entries]
            cells.append(StoredCells(index, tuple(names), np.array(first), np.array(last), arrays, verdicts))
    return cells


def _initial(loop: dict[str, Any]) -> list[list[Any]]:
    """Return [name, lower, upper] of each component that varies over a loop's initial states."""
    ends = {name: np.ravel(loop["initial"][name]).tolist() for name in loop["state"]}
    return [[name, *values] for name, values in ends.items() if values[0] < values[-1]]


def structural_faults(cells: StoredCells, report: dict[str, Any]) -> list[str]:
    """Return the faults of a frame's cells: they must be a partition of the set, all pixels bounded, counts right."""
    entries = [f for f in report.get("frames", ()) if f["index"] == cells.index]
    # what an entry says that nobody looks at would stand unchecked
    wrong = ["the report has more than one entry of it"] if entries[1:] else []
    if cells.verdicts is not None:
        return wrong + _tally_faults(cells, report)
    a, entry = cells.arrays, entries[0]
    (height, width, _), side = a["lower"].shape, a["b_lower"].shape[1]
    places = {(r, c) for r in range(0, height, side) for c in range(0, width, side)}
    ranges = [list(p) for p in zip(cells.names, cells.lower, cells.upper, strict=True)]
    inside = (a["lower"] <= a["witness_lower"]) & (a["witness_upper"] <= a["upper"])
    claims = {
        "a lower bound exceeds the upper bound": (a["lower"] <= a["upper"]).all(),
        "a picture that was rendered lies outside of the bounds": inside.all(),
        "the report says another set of poses": ranges == [[p[key] for key in _BOX] for p in entry["parameters"]],
        "the report says another size": [entry["height"], entry["width"]] == [height, width],
        "the cells' tiles are not those of the picture": set(map(tuple, a["tile"].tolist())) == places,
    }
    wrong += [text for text, holds in claims.items() if not holds]
    gaps = [np.linalg.norm(a[f"{k}upper"] - a[f"{k}lower"], axis=-1).astype(float) for k in ("", "witness_")]
    # there is no ratio where no picture differs
    found = [*(f(gap) for gap in gaps for f in (np.mean, np.max)), entry["mpg"] / (entry["mpg_witness"] or np.inf)]
    for name, gap in zip(("mpg", "xpg", "mpg_witness", "xpg_witness", "ratio"), found, strict=True):
        if not abs(gap - (entry[name] or 0.0)) <= 1e-6 + 1e-5 * gap:
            wrong.append(f"{name} is {gap:.9g}, the report says {entry[name]}")
    checked: dict[bytes, Fraction | None] = {}
    for tile in np.unique(a["tile"], axis=0):
        members = (a["tile"] == tile).all(axis=1)
        low, high = a["box_lower"][members], a["box_upper"][members]
        key = low.tobytes() + high.tobytes()
        if key not in checked:
            checked[key] = partition(low, high, cells.lower, cells.upper)
        if checked[key] != 1:
            return [*wrong, f"the cells of tile {tile.tolist()} are no partition of the set"]
    return wrong


def entries_of(report: dict[str, Any]) -> dict[int, dict[str, Any]]:
    """Return the report's counts and volume fractions of cells, by number of the question or frame."""
    if report.get("kind") == "loop":
        return {k: report["questions"][n] for k, n in enumerate(("safe", "reaches")) if n in report["questions"]}
    return {f["index"]: f | f["coverage"] for f in report["frames"]}


def _tally_faults(cells: StoredCells, report: dict[str, Any]) -> list[str]:
    """Return where the report's counts and fractions of a frame or question differ from its cells' verdicts."""
    loop, entry = report.get("kind") == "loop", entries_of(report)[cells.index]
    wrong, verdicts = [], np.array([v[0] for v in cells.verdicts or []])
    low, high, whole = cells.arrays["box_lower"], cells.arrays["box_upper"], (cells.lower, cells.upper)
    covered = partition(low, high, *whole)
    if covered is None:
        return ["cells overlap, or leave the set"]
    for kind in ("certified", "falsified", "unknown"):
        # what is still to be examined is unknown; of cells, only a loop's report counts it so
        part = (verdicts == kind) | ((verdicts == "open") & (kind == "unknown"))
        count = int((part if loop else verdicts == kind).sum())
        if count != entry["cells"][kind]:
            wrong.append(f"the report counts {entry['cells'][kind]} {kind} cells, the table {count}")
        share = partition(low[part], high[part], *whole)
        if share is None or not abs(share - entry[kind]) <= 1e-9:
            wrong.append(f"{kind} cells are {float(share or 0):.9g} of the set, the report says {entry[kind]:.9g}")
    if (left := int((verdicts == "open").sum())) != entry["cells"].get("open", left):
        wrong.append(f"the report counts {entry['cells']['open']} cells to be examined, the table {left}")
    least = min((v[1] for v in cells.verdicts or () if v[0] == "certified" and v[1] is not None), default=None)
    wrong += [] if entry["least_margin"] == least else [f"the least margin is {least}, not {entry['least_margin']}"]
    return wrong + ([] if covered == 1 else ["the cells are no partition of the set"])


def partition(low: Array, high: Array, first: Array, last: Array) -> Fraction | None:
    """Return the fraction of the box [first, last] that boxes [n, d] fill, exact; None if they overlap or leave it."""
    if not ((low >= first) & (high <= last) & (low <= high)).all():
        return None
    # what is fixed in this frame has no volume
    low, high, first, last = (a[..., first < last] for a in (low, high, first, last))
    order = np.argsort(low[:, 0], kind="stable") if low.shape[1] else np.arange(len(low))
    low, high = low[order], high[order]
    for k in range(len(low)):
        # those that begin behind the end of this one along the first parameter are apart from it
        stop = np.searchsorted(low[:, 0], high[k, 0], "left") if low.shape[1] else len(low)
        if not ((high[k + 1 : stop] <= low[k]) | (low[k + 1 : stop] >= high[k])).any(axis=1).all():
            return None

    def volume(a: Array, b: Array) -> Fraction:
        # a float64 is a rational number
        return math.prod(map(Fraction.__sub__, map(Fraction, b.tolist()), map(Fraction, a.tolist())), start=Fraction(1))

    return sum(map(volume, low, high), Fraction(0)) / volume(first, last)
