"""A slider of the certificate's page: poses along a set, each with its verdict and picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from ns_abstract.report.figures import ShownUnits, number, unit_of_axis
from ns_abstract.report.html import fill
from ns_abstract.report.regions import PoseImage

#: Pictures of the slider.
MOST = 24
_FULL_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class WalkPose:
    """A pose that the slider shows, with its verdict.

    Attributes:
        values: [n] all parameters.
        verdict: Of the cell that it lies in; "unknown" where there is none.
        proven: The proved lower bound of the margin, where it is certified.
    """

    frame: int
    values: tuple[float, ...]
    verdict: str
    proven: float | None
    at: str


def direction(parameters: Sequence[Mapping[str, Any]]) -> int | None:
    """Position of the parameter to walk along: the way along a path, around an orbit, else the first that varies."""
    free = [k for k, p in enumerate(parameters) if p["lower"] < p["upper"]]
    named = {parameters[k]["name"]: k for k in reversed(free)}
    return next((named[name] for name in ("segment", "azimuth") if name in named), free[0] if free else None)


def stops(
    entries: Sequence[Mapping[str, Any]],
    rows: Mapping[int, Sequence[Mapping[str, Any]]],
    units: ShownUnits | None = None,
    most: int = MOST,
) -> list[WalkPose]:
    """Poses along every frame's set in turn, evenly spread, the other parameters in the middle.

    Args:
        entries: Frames of report.json: index and parameters (name, unit, lower, upper).
        most: Most poses; of more frames some, evenly spread.
    """
    if len(entries) > most:
        entries = [entries[k * (len(entries) - 1) // (most - 1)] for k in range(most)]
    each, units = most // max(1, len(entries)), units or ShownUnits()
    poses = []
    for position, entry in enumerate(entries):
        parameters = entry["parameters"]
        axis = direction(parameters)
        middle = [0.5 * (p["lower"] + p["upper"]) for p in parameters]
        if axis is None or each < 2:
            poses.append(_stop(entry, rows, units, middle, None))
            continue
        low, high = parameters[axis]["lower"], parameters[axis]["upper"]
        name = parameters[axis]["name"]
        # the end is the next one's beginning, or its own
        follows = position + 1 < len(entries) and name == "segment"
        closed = name == "azimuth" and high - low >= _FULL_TURN * (1.0 - 1e-9)
        for value in np.linspace(low, high, each, endpoint=not (follows or closed)).tolist():
            poses.append(_stop(entry, rows, units, [*middle[:axis], value, *middle[axis + 1 :]], axis))
    return poses


def _stop(
    entry: Mapping[str, Any],
    rows: Mapping[int, Sequence[Mapping[str, Any]]],
    units: ShownUnits,
    values: list[float],
    axis: int | None,
) -> WalkPose:
    row = cell_at(rows.get(entry["index"], ()), values)
    at = f"frame {entry['index']}"
    if axis is not None:
        p = entry["parameters"][axis]
        unit, factor = units.axis(p["unit"])
        at += f", {p['name']} = {number(values[axis] * factor, 4)} {unit_of_axis(unit)}"
    verdict = "unknown" if row is None else row["verdict"]
    return WalkPose(
        entry["index"], tuple(values), verdict, row["margin"] if row and verdict == "certified" else None, at
    )


def cell_at(rows: Sequence[Mapping[str, Any]], values: Sequence[float]) -> Mapping[str, Any] | None:
    """The cell that holds a pose; where several meet a certified one, which holds for its ends, too."""
    if not rows:
        return None
    lower, upper = (np.array([row[key] for row in rows], np.float64) for key in ("lower", "upper"))
    inside = np.flatnonzero(((lower <= values) & (upper >= values)).all(axis=1)).tolist()
    order = ("certified", "falsified", "unknown")
    return min((rows[k] for k in inside), key=lambda row: order.index(row["verdict"]), default=None)


def coarse_first(count: int) -> list[int]:
    """0 to ``count`` - 1 in an order whose every beginning is spread over the whole."""
    bits = max(1, (count - 1).bit_length())
    return sorted(range(count), key=lambda k: int(f"{k:0{bits}b}"[::-1], 2))


def walk_html(poses: Sequence[tuple[WalkPose, PoseImage]]) -> Markup:
    """The page's part: all pictures; `walk.js` shows one at a time, as the slider stands."""
    return fill("walk.html", stops=poses) if len(poses) > 1 else Markup()
