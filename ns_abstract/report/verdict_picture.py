"""Verdicts as pictures to keep: ``verdicts_00000.png`` by frame, ``verdicts_path.png``, ``cameras.png``.

Matplotlib is imported when a picture is drawn, not before.
"""

from __future__ import annotations

import io
import re
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.folder import unwritable
from ns_abstract.report.cameras import Cameras
from ns_abstract.report.certificate_page import LAST, along_path, is_ring, path_spans
from ns_abstract.report.figures import number, percent, unit_of_axis
from ns_abstract.report.verdict_maps import BAD, GOOD, OPEN, free_parameters, maps_of, matrix_rows, mixed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Rows = Sequence[Mapping[str, Any]]
#: Frames with a picture; cells drawn one by one; places along a parameter where there are more; width of cameras.
MOST, _MOST_CELLS, _FINE, _WIDTH = 8, 4000, 160, 900
_NAMES = re.compile(r"verdicts_(\d{5,}|path)\.png|cameras\.png")
_COLORS = {"certified": GOOD, "falsified": BAD, "unknown": OPEN}
_ABOUT = {"Software": "ns_abstract"}
_INK, _SOFT = "#1a1a1a", "#555555"


def _hex(kind: str) -> str:
    return "#{:02x}{:02x}{:02x}".format(*_COLORS[kind])


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), facecolor="white", layout="constrained")


def _titled(figure: Figure, text: str, covered: Mapping[str, float]) -> None:
    """Title, and the verdicts' colours with their parts."""
    from matplotlib.patches import Patch

    marks = [Patch(color=_hex(kind), label=f"{kind} {percent(covered[kind])}") for kind in _COLORS]
    figure.suptitle(text, fontsize=10, color=_INK, parse_math=False)
    figure.legend(handles=marks, loc="outside lower center", ncols=3, frameon=False, fontsize=8)


def _label(parameter: Mapping[str, Any]) -> str:
    return f"{parameter['name']} ({unit_of_axis(parameter['unit'])})"


def _collected(
    axes: Axes, shapes: Sequence[Any], kinds: Sequence[str], strength: float = 1.0, line: float = 0.2
) -> None:
    from matplotlib.collections import PatchCollection

    edges = [_hex(kind) for kind in kinds]
    faces = [(*(v / 255.0 for v in _COLORS[kind]), strength) for kind in kinds]
    axes.add_collection(PatchCollection(list(shapes), facecolor=faces, edgecolor=edges, lw=line))


def _examples(rows: Rows) -> np.ndarray:
    """[n, d] counterexamples, each once."""
    found = {tuple(e): None for row in rows if (e := row["counterexample"]) is not None}
    return np.array(list(found), np.float64)


def _along(axes: Axes, spans: Sequence[tuple[float, float, str, float | None]], offset: float = 0.0) -> None:
    from matplotlib.patches import Rectangle

    shapes = [Rectangle((low + offset, 0.0), high - low, 1.0) for low, high, *_ in spans]
    _collected(axes, shapes, [kind for _, _, kind, _ in spans])
    if broken := [at + offset for *_, at in spans if at is not None]:
        axes.plot(broken, np.full(len(broken), -0.12), "|", color=_INK, ms=5, mew=0.8)
    axes.set(ylim=(-0.25, 1.0), yticks=[])


def _ring(axes: Axes, rows: Rows, column: int) -> None:
    from matplotlib.patches import Wedge

    angles = [(np.degrees(row["lower"][column]), np.degrees(row["upper"][column])) for row in rows]
    shapes = [Wedge((0.0, 0.0), 1.0, low, high, width=0.33) for low, high in angles]
    _collected(axes, shapes, [row["verdict"] for row in rows])
    if len(broken := _examples(rows)):
        axes.plot(0.63 * np.cos(broken[:, column]), 0.63 * np.sin(broken[:, column]), ".", color=_INK, ms=2.5)
    for degrees in range(0, 360, 45):
        place = 1.13 * np.cos(np.radians(degrees)), 1.13 * np.sin(np.radians(degrees))
        axes.text(*place, f"{degrees}°", ha="center", va="center", fontsize=8, color=_SOFT)
    axes.text(0.0, 0.0, "azimuth", ha="center", va="center", fontsize=9, color=_SOFT)
    axes.set(xlim=(-1.25, 1.25), ylim=(-1.25, 1.25), aspect="equal")
    axes.axis("off")


def _plane(axes: Axes, rows: Rows, entry: Mapping[str, Any], free: Sequence[int]) -> None:
    from matplotlib.patches import Rectangle

    i, j = free
    sides = [entry["parameters"][k] for k in free]
    extent = sides[0]["lower"], sides[0]["upper"], sides[1]["lower"], sides[1]["upper"]
    if len(rows) > _MOST_CELLS:
        axes.imshow(mixed(maps_of(rows, entry, _FINE)), extent=extent, aspect="auto", interpolation="nearest")
    else:
        shapes = [
            Rectangle(
                (row["lower"][i], row["lower"][j]), row["upper"][i] - row["lower"][i], row["upper"][j] - row["lower"][j]
            )
            for row in rows
        ]
        _collected(axes, shapes, [row["verdict"] for row in rows])
    if len(broken := _examples(rows)):
        for color, width in (("white", 2.0), (_INK, 0.8)):
            axes.plot(broken[:, i], broken[:, j], "x", color=color, ms=3.5, mew=width, clip_on=False, zorder=5)
    axes.set(xlim=extent[:2], ylim=extent[2:], xlabel=_label(sides[0]), ylabel=_label(sides[1]))
    if sides[0]["unit"] == sides[1]["unit"]:
        axes.set_aspect("equal")


def _matrix(figure: Figure, rows: Rows, entry: Mapping[str, Any], free: Sequence[int]) -> None:
    sides = [entry["parameters"][k] for k in free]
    d = len(sides)
    places: Any = figure.subplots(d, d, squeeze=False)
    for row, pictures in enumerate(matrix_rows(maps_of(rows, entry), d)):
        for column, picture in enumerate(pictures):
            axes = places[row][column]
            axes.imshow(picture, interpolation="nearest", aspect="auto", extent=(0.0, 1.0, 0.0, 1.0))
            axes.set(xticks=[], yticks=[])
            for spine in axes.spines.values():
                spine.set_color("#c8c8c2")
            if row == d - 1:
                axes.set_xticks([0.0, 1.0], [number(sides[column][key], 3) for key in ("lower", "upper")], fontsize=7)
                axes.set_xlabel(_label(sides[column]), fontsize=9)
            if column == 0:
                axes.set_yticks([0.0, 1.0], [number(sides[row][key], 3) for key in ("lower", "upper")], fontsize=7)
                axes.set_ylabel(sides[row]["name"], fontsize=9)


def frame_figure(entry: Mapping[str, Any], rows: Rows) -> Figure | None:
    """The verdicts over a frame's set, by the number of its parameters; None of a single pose.

    Args:
        entry: The frame in report.json.
        rows: Its cells.
    """
    free = free_parameters(entry["parameters"])
    if not free or not rows:
        return None
    text = f"frame {entry['index']}"
    if len(free) == 1 and is_ring(entry["parameters"][free[0]]):
        figure = _figure(4.6, 5.0)
        _ring(figure.subplots(), rows, free[0])
    elif len(free) == 1:
        figure, side = _figure(7.2, 1.9), entry["parameters"][free[0]]
        axes = figure.subplots()
        _along(axes, path_spans(entry, rows, 0.0))
        axes.set(xlim=(side["lower"], side["upper"]), xlabel=_label(side))
    elif len(free) == 2:
        figure = _figure(6.0, 6.0)
        _plane(figure.subplots(), rows, entry, free)
    else:
        size = max(6.0, 1.4 * len(free))
        figure = _figure(size, size + 0.3)
        _matrix(figure, rows, entry, free)
        text += ": below the diagonal certified, above it falsified"
    _titled(figure, text, entry["coverage"])
    return figure


def path_figure(entries: Sequence[Mapping[str, Any]], rows: Mapping[int, Rows], covered: Mapping[str, float]) -> Figure:
    """The verdicts along a path that is swept from keyframe to keyframe."""
    figure = _figure(8.2, 2.0)
    axes = figure.subplots()
    ways = sum(bool(free_parameters(entry["parameters"])) for entry in entries)
    for position, entry in enumerate(entries):
        _along(axes, path_spans(entry, rows.get(entry["index"], ()), LAST * ways), position)
        axes.axvline(position, color=_SOFT, lw=0.6)
    every = max(1, len(entries) // 20)
    ticks = range(0, len(entries), every)
    axes.set_xticks(list(ticks), [str(entries[k]["index"]) for k in ticks])
    axes.set(xlim=(0.0, ways * (1.0 + LAST if ways < len(entries) else 1.0)), xlabel="keyframe that the way begins at")
    _titled(figure, "from keyframe to keyframe", covered)
    return figure


def cameras_figure(cameras: Cameras, covered: Mapping[str, float]) -> Figure:
    """Frusta of cells over the scene, from above and from the side."""
    from matplotlib.patches import Polygon
    from PIL import Image

    views = cameras.views(_WIDTH)
    shapes = [view.window.size[1] / view.window.size[0] for view in views]
    figure = _figure(8.2, 7.4 * sum(shapes) + 1.6)
    places: Any = figure.subplots(2, 1, height_ratios=shapes)
    for axes, view in zip(places, views, strict=True):
        (left, bottom), (right, top) = view.window.low, view.window.high
        if cameras.outside is not None:
            data = cameras.outside.picture(view.window, view.nearest)
            scene = Image.open(io.BytesIO(data)).convert("RGB")
            axes.imshow(scene, extent=(left, right, bottom, top), interpolation="antialiased")
        kinds = [camera.verdict for camera, _ in view.shapes]
        _collected(axes, [Polygon(corners) for _, corners in view.shapes], kinds, 0.4, 0.6)
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        axes.set_title(f"cameras {view.title}", fontsize=9, color=_INK)
        axes.set(xlabel=f"{'xyz'[view.window.axes[0]]} (units)", ylabel=f"{'xyz'[view.window.axes[1]]} (units)")
    _titled(figure, "", covered)
    return figure


def clear_pictures(folder: Path) -> None:
    """Remove the pictures of an earlier command: they would not show what report.json says."""
    for file in list(folder.iterdir()):
        if _NAMES.fullmatch(file.name) and stat.S_ISREG(file.lstat().st_mode):
            file.unlink(missing_ok=True)


def write_pictures(
    folder: Path, document: Mapping[str, Any], rows: Mapping[int, Rows], cameras: Cameras | None
) -> list[str]:
    """Write the pictures of a certificate, each whole or not at all; returns their names.

    Args:
        folder: Where.
        document: Content of report.json.
        rows: Cells by frame.
        cameras: Where cameras stand.

    Raises:
        InputError: The folder cannot be written.
    """
    entries = document["frames"]
    figures: dict[str, Figure | None] = {}
    if way := along_path(entries):
        figures["verdicts_path"] = path_figure(way, rows, document["coverage"])
    else:
        for entry in entries[:MOST]:
            figures[f"verdicts_{entry['index']:05d}"] = frame_figure(entry, rows.get(entry["index"], ()))
    if cameras is not None and cameras.cells:
        figures["cameras"] = cameras_figure(cameras, document["coverage"])
    written = []
    for name, figure in figures.items():
        if figure is None:
            continue
        try:
            write_atomic(
                folder / f"{name}.png",
                lambda stream, figure=figure: figure.savefig(stream, format="png", dpi=100, metadata=_ABOUT),
            )
        except OSError as error:
            raise unwritable(folder, error) from None
        written.append(f"{name}.png")
    return written
