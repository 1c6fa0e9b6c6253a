"""Drawings of a certificate's cameras as frusta over the scene, from above and from the side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.report.figures import number
from ns_abstract.report.html import fill
from ns_abstract.report.outside import (
    PICTURE_WIDTH,
    PLANS,
    PlotWindow,
    SceneDrawing,
    about,
    behind,
    draw_plane,
    plane_axes,
    sideways,
)
from ns_abstract.report.svg import through

Float64 = NDArray[np.float64]

#: Cells drawn at most, and the verdicts in the order in which they are drawn.
MOST = 400
#: Of these at least so many of every verdict, if it has them.
_OF_VERDICT = 50
_ORDER = ("certified", "unknown", "falsified")
#: Poses of all sets that are looked at for where cameras may stand, and by parameter at most.
_POSES, _STEPS = 2000, 17
#: Least side of what is shown, normalised units; a frustum's length as part of what is shown, and of the window.
_LEAST, _LENGTH, _OF_WINDOW = 0.1, 0.1, 0.035
#: Spreads the drawn ones of many equally wide cells.
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class CellCamera:
    """The camera at the middle of a cell, which is number ``row`` of its frame.

    ``pose`` [3, 4] is camera-to-world in the normalised frame; ``rays`` [4, 3] are unit vectors through the picture's
    corners, in order around it, world axes.
    """

    frame: int
    row: int
    verdict: str
    pose: Float64
    rays: Float64


def corner_rays(camera: PinholeCamera, pose: Float64) -> Float64:
    """Return unit vectors [4, 3] through the picture's corners, in order around it, world axes, for a pose [3, 4]."""
    left, right = ((x - camera.cx) / camera.fx for x in (0.0, float(camera.width)))
    top, bottom = ((camera.cy - y) / camera.fy for y in (0.0, float(camera.height)))
    rays = np.array([(left, top, -1.0), (right, top, -1.0), (right, bottom, -1.0), (left, bottom, -1.0)])
    rays = rays @ pose[:, :3].T
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def cell_cameras(
    pose_sets: Mapping[int, PoseBox], rows: Mapping[int, Sequence[Mapping[str, Any]]], names: Sequence[str]
) -> tuple[list[CellCamera], int]:
    """Return the cameras at the middles of the widest cells, at most `MOST`, and the number of cells left out.

    Some of every verdict are returned. ``rows``: by frame, cells with lower, upper, verdict. ``names``: all parameters,
    in the order of the cells' ends.
    """
    keys = [(frame, k) for frame, frame_rows in rows.items() for k in range(len(frame_rows))]
    width = np.concatenate(
        [np.ones(0), *(_shares(pose_sets[f].box, frame_rows, names) for f, frame_rows in rows.items())]
    )
    # by parts of their sets; of equal ones some from everywhere
    order = np.lexsort(((_GOLDEN * np.arange(len(keys))) % 1.0, -width.round(12)))
    # a verdict that has narrow cells alone is to be seen, too
    kinds = np.array([rows[keys[n][0]][keys[n][1]]["verdict"] for n in order], str)
    first = np.concatenate([np.flatnonzero(kinds == kind)[:_OF_VERDICT] for kind in _ORDER])
    order = np.concatenate([order[first], np.delete(order, first)])
    frame_rows = []
    for frame, k in sorted(keys[n] for n in order[:MOST]):
        row, poses = rows[frame][k], pose_sets[frame]
        middle = {n: 0.5 * (a + b) for n, a, b in zip(names, row["lower"], row["upper"], strict=True)}
        pose = poses.pose(np.array([middle[name] for name in poses.box.names]))
        frame_rows.append(CellCamera(frame, k, row["verdict"], pose, corner_rays(poses.camera, pose)))
    return frame_rows, len(keys) - len(frame_rows)


def _shares(box: Any, rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Float64:
    """Return the fraction [n] of the set's volume that each cell fills."""
    sides = np.ones((len(rows), 0))
    if rows and box.names:
        columns = [list(names).index(name) for name in box.names]
        ends = [np.array([row[key] for row in rows], np.float64)[:, columns] for key in ("lower", "upper")]
        sides = (ends[1] - ends[0]) / (np.array(box.upper) - np.array(box.lower))
    return sides.prod(axis=1)


def standing(pose_sets: Mapping[int, PoseBox]) -> tuple[Float64, Float64]:
    """Return ends [3], [3] of a box around the sets' camera positions: of poses that vary one parameter each."""
    axes = sum(poses.box.dimensions for poses in pose_sets.values())
    steps = min(_STEPS, max(2, _POSES // max(1, axes)))
    places = []
    for poses in pose_sets.values():
        middle = np.asarray(poses.box.middle, np.float64)
        values = [middle]
        for axis, ends in enumerate(zip(poses.box.lower, poses.box.upper, strict=True)):
            for value in np.linspace(*ends, steps):
                values.append(middle.copy())
                values[-1][axis] = value
        places += [poses.pose(v)[:, 3] for v in values]
    return np.min(places, axis=0), np.max(places, axis=0)


def looked_at(pose_sets: Mapping[int, PoseBox], outside: SceneDrawing | None) -> Float64:
    """Return points [n, 3] in front of the cameras in the middles of the sets, at the median depth of what they see.

    Cameras that see no opaque element have none.
    """
    points: list[Float64] = []
    opaque = np.zeros((0, 3)) if outside is None else outside.opaque_places
    for poses in pose_sets.values():
        pose = poses.pose(np.asarray(poses.box.middle, np.float64))
        rays, ahead = corner_rays(poses.camera, pose), -pose[:, 2]
        away = opaque - pose[:, 3]
        # inside of the pyramid of the corners' rays, whose sides are seen from one side all the way around
        sides = away @ np.cross(rays, np.roll(rays, -1, axis=0)).T
        depths = (away @ ahead)[(sides > 0.0).all(axis=1) | (sides < 0.0).all(axis=1)]
        depths = depths[depths > 0.0]
        points += [pose[:, 3] + float(np.median(depths)) * ahead] if len(depths) else []
    return np.array(points, np.float64).reshape(-1, 3)


def upward(pose_sets: Mapping[int, PoseBox]) -> int:
    """Return the world axis of an orbit, nearly, so that it is drawn in its plane; 2 if no set has an orbit."""
    for poses in pose_sets.values():
        if (orbit := poses.perturbation.orbit) is not None:
            return int(np.argmax(np.abs(orbit.axis)))
    return 2


def cameras_entry(cameras: Sequence[CellCamera], left_out: int) -> dict[str, Any]:
    """Return the content of the key ``cameras`` of report.json."""

    def rounded(values: Float64) -> list[float]:
        return [float(f"{v:.6g}") for v in values]

    cells = [
        {
            "frame": camera.frame,
            "verdict": camera.verdict,
            "position": rounded(camera.pose[:, 3]),
            "direction": rounded(-camera.pose[:, 2] / np.linalg.norm(camera.pose[:, 2])),
        }
        for camera in cameras
    ]
    return {"cells": cells, "left_out": left_out}


@dataclass(frozen=True)
class CameraPlot:
    """A drawing of cameras in a plane; ``nearest`` as in `ns_abstract.report.outside.SceneDrawing.picture`.

    ``shapes`` are cameras and the corners of their frusta, normalised units, in the order in which they are drawn.
    """

    title: str
    nearest: float
    window: PlotWindow
    shapes: list[tuple[CellCamera, list[tuple[float, float]]]]


@dataclass(frozen=True)
class CameraDrawings:
    """The drawings of cameras on a page.

    ``ends`` [3], [3] bound a box about where cameras stand, normalised units. ``outside`` draws the scene behind them;
    None: it has no elements with a place of their own. ``up`` is the axis from whose tip the plan is drawn; see
    `upward`. ``sights`` [n, 3] are points that are shown as well; see `looked_at`.
    """

    cells: Sequence[CellCamera]
    left_out: int
    ends: tuple[Float64, Float64]
    outside: SceneDrawing | None
    up: int = 2
    sights: Float64 = field(default_factory=lambda: np.zeros((0, 3)))

    def views(self, width: int) -> list[CameraPlot]:
        """Return the drawings from above and from the side, in pictures ``width`` pixels wide."""
        low, high = self.ends
        span = float((high - low).max())
        room = _LENGTH * max(span, _LEAST)
        around = room + 0.5 * max(0.0, _LEAST - span)
        plots = []
        for axes, title, nearest in (
            # a ceiling would hide everything
            (PLANS[self.up], "from above" if self.up == 2 else f"along {'xyz'[self.up]}", float(high[self.up])),
            (sideways(low, high, self.up), "from the side", np.inf),
        ):
            chosen = list(axes)
            shown = np.array([low - around, high + around, *self.sights])[:, chosen]
            window = about(self.outside, axes, shown.min(axis=0), shown.max(axis=0), nearest, width)
            length = min(room, _OF_WINDOW * (window.high[0] - window.low[0]))
            shapes = []
            for camera in sorted(self.cells, key=lambda cell: _ORDER.index(cell.verdict)):
                place = camera.pose[:, 3]
                points = np.concatenate([place[None], place + length * camera.rays])[:, chosen]
                shapes.append((camera, _hull([(a, b) for a, b in points.tolist()])))
            plots.append(CameraPlot(title, nearest, window, shapes))
        return plots

    def plots(self, numbers: Mapping[tuple[int, int], int]) -> list[tuple[Markup, str, str]]:
        """Return plot, title, and caption on the scene, of the views from above and from the side."""
        drawings = []
        for view in self.views(PICTURE_WIDTH):
            x, y = plane_axes(view.window)
            shapes = []
            for camera, corners in view.shapes:
                cell = numbers.get((camera.frame, camera.row))
                data = "" if cell is None else f' data-cell="{cell}"'
                way = through((x(a), y(b)) for a, b in corners)
                shapes.append(f'<path class="{camera.verdict}"{data} d="{way}Z"/>')
            marks = f'<g class="frusta">{"".join(shapes)}</g>'
            plot = draw_plane(self.outside, view.window, view.nearest, marks, f"Cameras seen {view.title}")
            drawings.append((plot, view.title, behind(self.outside, view.nearest, "cameras alone")))
        return drawings

    def html(self, numbers: Mapping[tuple[int, int], int]) -> Markup:
        """Return the page's section; cells with ``numbers``, by frame and position, can be clicked."""
        if not self.cells:
            return Markup()
        where = " · ".join(
            f"{name} {number(a, 4)}" if a == b else f"{name} {number(a, 4)} to {number(b, 4)}"
            for name, a, b in zip("xyz", *(end.tolist() for end in self.ends), strict=True)
        )
        return fill("cameras.html", figures=self.plots(numbers), left_out=self.left_out, where=where)


def _hull(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the corners of the convex hull of points (Andrew's monotone chain)."""
    rising = sorted(set(points))
    if len(rising) < 3:
        return rising

    def half(along: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        corners: list[tuple[float, float]] = []
        for c in along:
            while len(corners) > 1:
                a, b = corners[-2:]
                if (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0.0:
                    break
                corners.pop()
            corners.append(c)
        return corners[:-1]

    return half(rising) + half(rising[::-1])
