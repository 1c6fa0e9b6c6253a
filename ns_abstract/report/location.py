"""The report of ``ns-abstract-locate``, where a photo was taken: report.json, report.html."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ns_abstract.geometry.poses import PoseBox
from ns_abstract.refine.protocol import SceneElements
from ns_abstract.report.cameras import CameraDrawings, cell_cameras, looked_at, standing
from ns_abstract.report.figures import number, unit_of_axis
from ns_abstract.report.html import whole_page
from ns_abstract.report.outside import SceneDrawing
from ns_abstract.report.picture import heat, preview, to_bytes
from ns_abstract.report.run import CommandRun, plain, sides
from ns_abstract.report.verdict_maps import LEFT, NONE, OPEN, pairs_svg

Row = Mapping[str, Any]
#: Longest side of pictures on the page, and the difference that its scale ends at.
_PIXELS, _LARGEST = 384, 0.25
#: Places along a parameter of a map.
_BINS = 48
#: Colours of what may have made the photo, and of where the best pose is.
_POSSIBLE, _BEST = (29, 116, 64), (179, 38, 30)

METRICS = {
    "possible_volume": "part of the parameter volume that is not excluded, mean over the frames' sets",
    "boxes_volume": "part of it that the cells of cells.sqlite which are not excluded take: boxes around this",
    "hull": "the smallest box around all that is not excluded; null: no pose of the sets made the photo",
    "best": "of all rendered poses the one that explains most, and how many counted pixels it does not explain",
    "answer": "none (proved: no pose of the sets made the photo), possible (a rendered pose explains it), unknown",
    "excluded": "cells no pose of which made the photo: more pixels than the outliers allow lie beyond the bounds",
    "possible": "cells with a rendered pose that explains the photo, in the column counterexample",
    "unknown": "the rest",
    "explains": "all counted pixels but the allowed ones differ by no more than the noise and half a step of 8 bits",
}
_HEADINGS = {
    "none": ("good", "No pose of the set made this photo"),
    "possible": ("good", "The photo is explained by poses of the set"),
    "unknown": ("fair", "No pose found that explains the photo, and not all of them excluded"),
}


def location_document(
    run: CommandRun,
    photo: Mapping[str, Any],
    parameters: Sequence[tuple[str, str]],
    sets: Mapping[int, PoseBox],
    rows: Mapping[int, Sequence[Row]],
    left: Mapping[int, float],
    poses: Mapping[int, Sequence[Any]],
    figures: Mapping[str, Any],
    *,
    state: str,
) -> dict[str, Any]:
    """Return the content of report.json.

    Args:
        run: The command's run.
        photo: The photo, and how far a render may differ from it: keys of report.json.
        parameters: Names and units of the table ``parameters``.
        sets: By frame, the poses.
        rows: By frame, the cells.
        left: By frame, the fraction of the set that is not excluded.
        poses: Rendered poses by frame, the best first, with ``values`` and ``outliers``.
        figures: See `ns_abstract.report.certificate.search_figures`.
        state: "done", "budget" or "interrupted".
    """
    frames = [_frame(parameters, frame, sets[frame], rows[frame], left[frame], poses[frame]) for frame in sorted(rows)]
    hulls = [entry["hull"] for entry in frames if entry["hull"] is not None]
    bests = [dict(entry["best"], frame=entry["index"]) for entry in frames if entry["best"] is not None]
    best = min(bests, key=lambda entry: entry["outliers"], default=None)
    hull = None
    if hulls:
        hull = {
            "lower": np.min([entry["lower"] for entry in hulls], axis=0),
            "upper": np.max([entry["upper"] for entry in hulls], axis=0),
        }
    if not hulls:
        answer = "none"
    else:
        answer = "possible" if best is not None and best["outliers"] <= photo["allowed"] else "unknown"
    return plain(
        run.head()
        | {
            "answer": answer,
            **{
                name: sum(entry[name] for entry in frames) / max(1, len(frames))
                for name in ("possible_volume", "boxes_volume")
            },
            "hull": hull,
            "best": best,
            "photo": photo,
            "frames": frames,
            "trace": [{"seconds": p["seconds"], "searched_left": 1.0 - p["certified"]} for p in figures["trace"]],
            "seconds": figures["seconds"],
            "effort": figures["effort"],
        }
        | run.tail(state, METRICS)
    )


def _frame(
    parameters: Sequence[tuple[str, str]],
    index: int,
    poses: PoseBox,
    rows: Sequence[Row],
    possible: float,
    explaining: Sequence[Any],
) -> dict[str, Any]:
    box = poses.box
    entries = sides(box, parameters, poses.fixed)
    left = [row for row in rows if row["verdict"] != "excluded"]
    columns = [[name for name, _ in parameters].index(name) for name in box.names]

    def volume(row: Row) -> float:
        shares = np.subtract(row["upper"], row["lower"])[columns] / np.subtract(box.upper, box.lower)
        return float(np.prod(shares))

    boxes = min(1.0, sum(map(volume, left)))
    hull = None
    if left:
        hull = {
            "lower": np.min([row["lower"] for row in left], axis=0),
            "upper": np.max([row["upper"] for row in left], axis=0),
        }
    best = None
    if explaining:
        values = dict(zip(box.names, explaining[0].values, strict=True))
        pose = [values.get(entry["name"], entry["lower"]) for entry in entries]
        matrix = poses.pose(np.array(explaining[0].values))
        best = {"pose": pose, "outliers": explaining[0].outliers, "camera_to_world": matrix}
    return {
        "index": index,
        "intrinsics": poses.camera.intrinsics._asdict(),
        "parameters": entries,
        "possible_volume": min(boxes, possible),
        "boxes_volume": boxes,
        "hull": hull,
        "best": best,
        "cells": {kind: sum(row["verdict"] == kind for row in rows) for kind in ("excluded", "possible", "unknown")},
    }


def location_pictures(
    levels: NDArray[np.uint8], picture: NDArray[np.floating] | None, missed: NDArray[np.bool_] | None
) -> dict[str, bytes]:
    """Return PNGs of the photo, the best render, their difference, and the pixels that the render does not explain."""
    images = {"photo": levels}
    if picture is not None and missed is not None:
        gap = np.abs(picture.astype(np.float64) - levels / 255.0).max(axis=-1)
        images["best render"] = to_bytes(picture)
        images["difference"] = heat(gap, _LARGEST)
        images["not explained"] = np.where(missed[..., None], np.array(_BEST, np.uint8), levels // 4 + 191)
    return {title: preview(image, _PIXELS) for title, image in images.items()}


def location_page(
    document: Mapping[str, Any],
    rows: Mapping[int, Sequence[Row]],
    sets: Mapping[int, PoseBox],
    pictures: Mapping[str, bytes],
    elements: SceneElements | None,
) -> str:
    """Return the page of a report, every text of the document escaped."""
    kind, heading = _HEADINGS[document["answer"]]
    left = {frame: [_colored(row) for row in cells if row["verdict"] != "excluded"] for frame, cells in rows.items()}
    names = [p["name"] for p in document["frames"][0]["parameters"]] if document["frames"] else []
    cells, left_out = cell_cameras(sets, left, names)
    outside = None if elements is None else SceneDrawing(elements)
    cameras = CameraDrawings(cells, left_out, standing(sets), outside, sights=looked_at(sets, outside))
    maps = [(entry, svg) for entry in document["frames"] if (svg := pair_svg(entry, rows[entry["index"]])) is not None]
    return whole_page(
        "location.html",
        styles=("certificate.css",),
        title=f"Where a photo of {document['scene'].get('name', 'the scene')} was taken",
        d=document,
        kind=kind,
        heading=heading,
        maps=maps,
        drawings=cameras.plots({}) if cells else [],
        pictures=pictures,
        largest=_LARGEST,
    )


def _colored(row: Row) -> dict[str, Any]:
    """Return a cell with the verdict whose colour it has in drawings of cameras."""
    return {**row, "verdict": "certified" if row["verdict"] == "possible" else "unknown"}


def pair_svg(entry: Mapping[str, Any], rows: Sequence[Row]) -> Markup | None:
    """Return maps of the possible cells over all pairs of parameters, in the set (below the diagonal) and their hull.

    A place is coloured if some value of the other parameters is possible there.
    """
    parameters = entry["parameters"]
    free = [k for k, p in enumerate(parameters) if p["lower"] < p["upper"]]
    if len(free) < 2 or entry["hull"] is None:
        return None
    left = [row for row in rows if row["verdict"] != "excluded"]
    ends = np.array([[row["lower"], row["upper"]] for row in left], np.float64)[:, :, free]
    possible = np.array([row["verdict"] == "possible" for row in left])
    whole = np.array([[parameters[k][end] for k in free] for end in ("lower", "upper")], np.float64)
    hull = np.array([entry["hull"]["lower"], entry["hull"]["upper"]], np.float64)[:, free]
    best = None if entry["best"] is None else np.array(entry["best"]["pose"], np.float64)[free]
    moving = [parameters[k] for k in free]
    pictures = {}
    for i, j in itertools.permutations(range(len(free)), 2):
        window = whole if i > j else hull
        image = _touched(ends[:, :, (j, i)], possible, window[:, (j, i)], None if best is None else best[[j, i]])
        pictures[i, j] = image, "the set" if i > j else "the hull"

    def labels(k: int, x: float, y: float, panel: int, bottom: float) -> list[str]:
        p = moving[k]
        label = escape(f"{p['name']} ({unit_of_axis(p['unit'])})")
        middle = f'x="{x + 0.5 * panel:.0f}" text-anchor="middle"'
        return [
            f'<text {middle} y="{bottom + 13}">{label}</text>',
            f'<text {middle} y="{bottom + 28}">{number(whole[0, k], 3)} to {number(whole[1, k], 3)}</text>',
            f'<text x="{LEFT - 4}" y="{y + 0.5 * panel + 4:.0f}" text-anchor="end">{escape(str(p["name"]))}</text>',
            f'<text {middle} y="{y + 0.5 * panel:.0f}">left:</text>',
            f'<text {middle} y="{y + 0.5 * panel + 14:.0f}">{number(hull[0, k], 3)}</text>',
            f'<text {middle} y="{y + 0.5 * panel + 28:.0f}">{number(hull[1, k], 3)}</text>',
        ]

    return pairs_svg("What is left over pairs of parameters", moving, pictures, labels)


def _touched(
    ends: NDArray[np.float64], possible: NDArray[np.bool_], window: NDArray[np.float64], best: Any
) -> NDArray[np.uint8]:
    """Return a picture [bins, bins, 3] of the bins, of two parameters, that boxes with ``ends`` [n, 2, 2] touch."""
    low, width = window[0], np.maximum(window[1] - window[0], np.finfo(np.float64).tiny)
    first = np.clip(np.floor((ends[:, 0] - low) / width * _BINS), 0, _BINS - 1).astype(int)
    last = np.clip(np.ceil((ends[:, 1] - low) / width * _BINS), 1, _BINS).astype(int)
    last = np.maximum(last, first + 1)
    image = np.full((_BINS, _BINS, 3), NONE, np.uint8)
    for kind, color in ((False, OPEN), (True, _POSSIBLE)):
        for k in np.flatnonzero(possible == kind):
            image[first[k, 1] : last[k, 1], first[k, 0] : last[k, 0]] = color
    if best is not None:
        at = np.clip(np.floor((best - low) / width * _BINS), 0, _BINS - 1).astype(int)
        image[at[1], at[0]] = _BEST
    return image[::-1]
