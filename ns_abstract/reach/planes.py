"""Plots of a loop: cells, tubes, runs and sets, projected to planes of camera positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.reach.loop import HalfSpace, Loop
from ns_abstract.report.outside import ABOVE, PlotWindow, SceneDrawing, about, sideways

Float64 = NDArray[np.float64]

#: Cells drawn at most.
_MOST_CELLS = 4000


@dataclass(frozen=True)
class Marks:
    """The boxes and lines of a plot in the plane's coordinates, each with its CSS class."""

    boxes: list[tuple[str, Float64, Float64]]
    lines: list[tuple[str, Float64]]

    @property
    def ends(self) -> tuple[Float64, Float64] | None:
        """Return the ends [2], [2] of a box around everything; None where there is nothing."""
        points = [p for _, low, high in self.boxes for p in (low, high)] + [p for _, line in self.lines for p in line]
        return (np.min(points, axis=0), np.max(points, axis=0)) if points else None


def plane_marks(
    document: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    loop: Loop,
    matrix: Float64,
    offset: Float64,
    axes: tuple[int, int] | None = None,
) -> Marks:
    """Return the cells, tubes and runs of a report, projected to a plane.

    Args:
        matrix, offset: [2, n], [2] of the map from states to the plane.
        axes: The two world axes of the plane, for tubes of camera positions; None: the plane has others.
    """
    names = [p["name"] for p in document["parameters"]]
    boxes = []

    def box(kind: str, lower: Float64, upper: Float64) -> None:
        middle, half = matrix @ (0.5 * (lower + upper)) + offset, np.abs(matrix) @ (0.5 * (upper - lower))
        boxes.append((kind, middle - half, middle + half))

    for row in rows[:_MOST_CELLS]:
        lower, upper = loop.lower.copy(), loop.upper.copy()
        for name, low, high in zip(names, row["lower"], row["upper"], strict=True):
            lower[loop.names.index(name)], upper[loop.names.index(name)] = low, high
        box(row["verdict"], lower, upper)
    for tube in document["tubes"]:
        for low, high in tube["tube"] if axes is None else tube["camera"]:
            if axes is None:
                box("tube", np.array(low, np.float64), np.array(high, np.float64))
            else:
                ends = (np.array(end, np.float64)[list(axes)] for end in (low, high))
                boxes.append(("tube", *ends))
    runs = [("run", states) for states in document["simulated_states"]]
    runs += [("run bad", entry["states"]) for entry in document["falsifying"]]
    lines = []
    for kind, states in runs:
        # a state that is no number is null there
        points = np.array([x for x in states if None not in list(x)], np.float64).reshape(-1, len(loop.names))
        lines.append((kind, points @ matrix.T + offset))
    boxes = [entry for entry in boxes if np.isfinite(entry[1]).all() and np.isfinite(entry[2]).all()]
    return Marks(boxes, [(kind, line) for kind, line in lines if len(line)])


def region(
    half_spaces: Sequence[HalfSpace], loop: Loop, axes: tuple[int, int], window: PlotWindow, sign: float
) -> list[tuple[float, float]]:
    """Return the polygon of the states in a window that lie within all half-spaces, in camera coordinates of a plane.

    It is empty where the set does not depend on the two coordinates alone, as it cannot be drawn then. Half-spaces
    along the viewing axis are left out.

    Args:
        axes: The plane's two world axes.
        sign: 1: within the half-spaces; -1: within their complements.
    """
    matrix, offset = loop.camera.place
    states_of_axis = [np.flatnonzero(row) for row in matrix]
    if any(len(states_of_axis[axis]) != 1 for axis in axes) or states_of_axis[axes[0]][0] == states_of_axis[axes[1]][0]:
        return []
    states = [int(states_of_axis[axis][0]) for axis in axes]
    third = states_of_axis[3 - sum(axes)]
    (left, bottom), (right, top) = window.low, window.high
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    used = 0
    for half_space in half_spaces:
        depends_on = set(np.flatnonzero(half_space.normal).tolist())
        if len(third) == 1 and depends_on == {int(third[0])}:
            continue
        if not depends_on <= set(states):
            return []
        used += 1
        slopes = [half_space.normal[k] / matrix[axis, k] for axis, k in zip(axes, states, strict=True)]
        level = half_space.offset + sum(s * offset[axis] for s, axis in zip(slopes, axes, strict=True))
        corners = _clipped(corners, sign * slopes[0], sign * slopes[1], sign * level)
    return corners if used else []


def _clipped(corners: list[tuple[float, float]], a: float, b: float, level: float) -> list[tuple[float, float]]:
    """Return the part of a convex polygon where ``a x + b y >= level``."""
    corners_inside = []
    for (x, y), (u, v) in zip(corners, [*corners[1:], *corners[:1]], strict=True):
        here, there = a * x + b * y - level, a * u + b * v - level
        if here >= 0.0:
            corners_inside.append((x, y))
        if (here < 0.0) != (there < 0.0) and here != there:
            part = here / (here - there)
            corners_inside.append((x + part * (u - x), y + part * (v - y)))
    return corners_inside


@dataclass(frozen=True)
class LoopPlot:
    """A plot of a loop in the plane of two world axes, to the right and up; the scene above ``clip`` is not drawn."""

    title: str
    axes: tuple[int, int]
    clip: float
    marks: Marks
    window: PlotWindow


def views(
    document: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], loop: Loop, outside: SceneDrawing | None, width: int
) -> list[LoopPlot]:
    """Return plots from above and from the side, ``width`` pixels wide; none where the camera does not move."""
    matrix, offset = loop.camera.place
    if not matrix.any():
        return []
    extent = plane_marks(document, rows, loop, matrix[:2], offset[:2], ABOVE).ends
    if extent is None:
        return []
    plots = []
    for axes, title in ((ABOVE, "from above"), (sideways(*extent), "from the side")):
        marks = plane_marks(document, rows, loop, matrix[list(axes)], offset[list(axes)], axes)
        ends, clip = marks.ends, np.inf
        assert ends is not None
        if axes == ABOVE:
            # a ceiling would hide everything
            up = plane_marks(document, rows, loop, matrix[[0, 2]], offset[[0, 2]], (0, 2)).ends
            assert up is not None
            clip = float(up[1][1])
        plots.append(LoopPlot(title, axes, clip, marks, about(outside, axes, *ends, clip, width)))
    return plots
