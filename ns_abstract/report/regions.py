"""Sections of a certificate's page: regions where a property fails, and a slider of poses along a set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ns_abstract.report.figures import ShownUnits, number, unit_of_axis
from ns_abstract.report.html import fill

Float64 = NDArray[np.float64]

#: Regions with pictures; boxes that look for neighbours together; outputs that are told.
MOST, _TOGETHER, _OUTPUTS = 6, 64, 10
#: Pictures of the slider.
MOST_STOPS = 24
_FULL_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class FailureRegion:
    """A connected region of falsified ``cells``, positions in their frame, of ``share`` of the set's volume.

    ``lower`` and ``upper`` [n] are ends of the box around them, all parameters. ``pose`` [n] is the counterexample with
    the least ``margin``; None where that is no number.
    """

    frame: int
    cells: tuple[int, ...]
    share: float
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    pose: tuple[float, ...]
    margin: float | None


@dataclass(frozen=True)
class PoseImage:
    """A picture at ``values`` [n] of all parameters, the network's ``outputs`` [m] and the property's ``margin``.

    A margin that is no number is None.
    """

    title: str
    values: Sequence[float]
    png: bytes
    outputs: Sequence[float]
    margin: float | None


def touching(lower: Float64, upper: Float64) -> NDArray[np.int64]:
    """Return the region number [n] of closed boxes [n, d]; boxes that share a point belong to one region."""
    count = len(lower)
    region_numbers = np.full(count, -1, np.int64)
    left = np.arange(count)
    regions = 0
    while left.size:
        region_numbers[left[0]] = regions
        edge, left = left[:1], left[1:]
        while edge.size:
            some, edge = edge[-_TOGETHER:], edge[:-_TOGETHER]
            low, high = lower[some], upper[some]
            near = ((lower[left] <= high.max(axis=0)) & (upper[left] >= low.min(axis=0))).all(axis=1)
            maybe = left[near]
            meets = (lower[maybe, None] <= high) & (upper[maybe, None] >= low)
            new = np.asarray(meets.all(axis=2)).any(axis=1)
            region_numbers[maybe[new]] = regions
            edge = np.concatenate([edge, maybe[new]])
            near[near] = new
            left = left[~near]
        regions += 1
    return region_numbers


def falsified_regions(
    entries: Sequence[Mapping[str, Any]], rows: Mapping[int, Sequence[Mapping[str, Any]]]
) -> list[FailureRegion]:
    """Return the regions of all frames, the largest parts of their sets first, single poses last.

    ``entries`` are frames of report.json: index and parameters (name, lower, upper); ``rows`` are by frame its cells:
    lower, upper, verdict, margin, counterexample.
    """
    regions = []
    for entry in entries:
        cells = rows.get(entry["index"], ())
        broken = [k for k, row in enumerate(cells) if row["verdict"] == "falsified"]
        if not broken:
            continue
        lower, upper = (np.array([cells[k][key] for k in broken], np.float64) for key in ("lower", "upper"))
        range_of = _ranges(entry["parameters"])
        free = range_of > 0.0
        shares = ((upper - lower)[:, free] / range_of[free]).prod(axis=1)
        margins = np.array([-np.inf if (m := cells[k]["margin"]) is None else m for k in broken])
        numbers = touching(lower, upper)
        order = np.argsort(numbers, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1):
            worst = cells[broken[members[np.argmin(margins[members])]]]
            regions.append(
                FailureRegion(
                    entry["index"],
                    tuple(broken[k] for k in members),
                    float(shares[members].sum()),
                    tuple(lower[members].min(axis=0).tolist()),
                    tuple(upper[members].max(axis=0).tolist()),
                    tuple(worst["counterexample"]),
                    worst["margin"],
                )
            )
    # a set of one pose has no volume: behind all that have one
    return sorted(regions, key=lambda region: (region.lower == region.upper, -region.share, region.frame, region.cells))


def _ranges(parameters: Sequence[Mapping[str, Any]]) -> Float64:
    return np.array([p["upper"] - p["lower"] for p in parameters], np.float64)


def distances(poses: Float64, pose: Sequence[float], parameters: Sequence[Mapping[str, Any]]) -> Float64:
    """Return distances [n] of poses [n, d] from a pose, each varying parameter in units of its range."""
    range_of = _ranges(parameters)
    free = range_of > 0.0
    return np.linalg.norm((poses - np.asarray(pose, np.float64))[:, free] / range_of[free], axis=1)


def nearest(
    rows: Sequence[Mapping[str, Any]],
    verdict: str,
    pose: Sequence[float],
    parameters: Sequence[Mapping[str, Any]],
    count: int = 1,
) -> list[tuple[int, list[float]]]:
    """Return the position of, and the nearest pose in, the ``count`` cells of a verdict that are nearest to a pose [n].

    Distances are in units of the ranges of ``parameters``, which have names and ends.
    """
    some = [k for k, row in enumerate(rows) if row["verdict"] == verdict]
    if not some:
        return []
    lower, upper = (np.array([rows[k][key] for k in some], np.float64) for key in ("lower", "upper"))
    poses = np.clip(np.asarray(pose, np.float64), lower, upper)
    order = np.argsort(distances(poses, pose, parameters), kind="stable")[:count]
    return [(some[n], poses[n].tolist()) for n in order]


def regions_html(
    regions: Sequence[FailureRegion],
    pictures: Sequence[tuple[PoseImage, PoseImage | None]],
    parameters: Mapping[int, Sequence[Mapping[str, Any]]],
    why: str,
    units: ShownUnits | None = None,
) -> Markup:
    """Return the page's section on regions; ``pictures`` are of the first ones, ``why`` says why there are no more."""
    if not regions:
        return Markup()
    blocks = []
    for region, (broken, right) in zip(regions, pictures, strict=False):
        sides = parameters[region.frame]
        box = ", ".join(
            (units or ShownUnits()).interval(p["name"], p["unit"], a, b)
            for p, a, b in zip(sides, region.lower, region.upper, strict=True)
            if p["lower"] < p["upper"]
        )
        told = reported_outputs(broken.outputs, right and right.outputs)
        both = [broken, right] if right else [broken]
        blocks.append(
            {
                "region": region,
                "box": box,
                "pictures": [(one, _pose(one, other, sides)) for one, other in zip(both, both[::-1], strict=True)],
                "right": right,
                "rows": [(k, [_value(one.outputs[k]) for one in both]) for k in told],
                "more": len(broken.outputs) - len(told),
            }
        )
    return fill("regions.html", regions=regions, shown=blocks, why=why)


def _pose(one: PoseImage, other: PoseImage, sides: Sequence[Mapping[str, Any]]) -> str:
    """Return a pose's varying parameters as text, and which of them equal the other picture's."""
    return ", ".join(
        f"{p['name']} = {number(v, 5)}" + (" (same)" if other is not one and other.values[k] == v else "")
        for k, (p, v) in enumerate(zip(sides, one.values, strict=True))
        if p["lower"] < p["upper"]
    )


def reported_outputs(broken: Sequence[float], right: Sequence[float] | None, most: int = _OUTPUTS) -> list[int]:
    """Return the numbers of the outputs to report: all, or those that differ most (without ``right``: the largest)."""
    values = np.asarray(broken, np.float64)
    change = np.abs(values if right is None else values - np.asarray(right, np.float64))
    order = np.argsort(-np.where(np.isfinite(change), change, np.inf), kind="stable")[:most]
    return sorted(order.tolist())


def _value(value: float) -> str:
    return number(value) if np.isfinite(value) else "not finite"


@dataclass(frozen=True)
class WalkPose:
    """A pose that the slider shows, ``values`` [n] of all parameters.

    ``verdict`` is that of the cell that holds it, "unknown" where none does. ``proven`` is the proved lower bound of
    the margin, where the cell is certified.
    """

    frame: int
    values: tuple[float, ...]
    verdict: str
    proven: float | None
    at: str


def direction(parameters: Sequence[Mapping[str, Any]]) -> int | None:
    """Return the number of the parameter that the slider follows: segment, else azimuth, else the first that varies."""
    free = [k for k, p in enumerate(parameters) if p["lower"] < p["upper"]]
    named = {parameters[k]["name"]: k for k in reversed(free)}
    return next((named[name] for name in ("segment", "azimuth") if name in named), free[0] if free else None)


def stops(
    entries: Sequence[Mapping[str, Any]],
    rows: Mapping[int, Sequence[Mapping[str, Any]]],
    units: ShownUnits | None = None,
    most: int = MOST_STOPS,
) -> list[WalkPose]:
    """Return poses along each frame's set in turn, evenly spaced, the other parameters in the middle.

    Args:
        entries: Frames of report.json: index and parameters (name, unit, lower, upper).
        most: Largest number of poses; of more frames an evenly spaced selection is taken.
    """
    if len(entries) > most:
        entries = [entries[k * (len(entries) - 1) // (most - 1)] for k in range(most)]
    each, units = most // max(1, len(entries)), units or ShownUnits()
    poses = []
    for position, entry in enumerate(entries):
        cells = rows.get(entry["index"], ())
        ends = cell_ends(cells)
        parameters = entry["parameters"]
        axis = direction(parameters)
        middle = [0.5 * (p["lower"] + p["upper"]) for p in parameters]
        if axis is None or each < 2:
            poses.append(_stop(entry, cells, ends, units, middle, None))
            continue
        low, high = parameters[axis]["lower"], parameters[axis]["upper"]
        name = parameters[axis]["name"]
        # the end is the next one's beginning, or its own
        follows = position + 1 < len(entries) and name == "segment"
        closed = name == "azimuth" and high - low >= _FULL_TURN * (1.0 - 1e-9)
        for value in np.linspace(low, high, each, endpoint=not (follows or closed)).tolist():
            poses.append(_stop(entry, cells, ends, units, [*middle[:axis], value, *middle[axis + 1 :]], axis))
    return poses


def _stop(
    entry: Mapping[str, Any],
    cells: Sequence[Mapping[str, Any]],
    ends: tuple[NDArray[np.float64], NDArray[np.float64]],
    units: ShownUnits,
    values: list[float],
    axis: int | None,
) -> WalkPose:
    row = cell_at(cells, values, ends)
    at = f"frame {entry['index']}"
    if axis is not None:
        p = entry["parameters"][axis]
        unit, factor = units.axis(p["unit"])
        at += f", {p['name']} = {number(values[axis] * factor, 4)} {unit_of_axis(unit)}"
    verdict = "unknown" if row is None else row["verdict"]
    return WalkPose(
        entry["index"], tuple(values), verdict, row["margin"] if row and verdict == "certified" else None, at
    )


def cell_ends(rows: Sequence[Mapping[str, Any]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return lower and upper ends [n, d] of cells."""
    lower, upper = (np.array([row[key] for row in rows], np.float64) for key in ("lower", "upper"))
    return lower, upper


def cell_at(
    rows: Sequence[Mapping[str, Any]],
    values: Sequence[float],
    ends: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> Mapping[str, Any] | None:
    """Return the cell that holds a pose, or None; where several meet, a certified one, which includes its boundary.

    ``ends``: those of the rows (`cell_ends`), to be passed where several poses are looked up.
    """
    if not rows:
        return None
    lower, upper = cell_ends(rows) if ends is None else ends
    inside = np.flatnonzero(((lower <= values) & (upper >= values)).all(axis=1)).tolist()
    order = ("certified", "falsified", "unknown")
    return min((rows[k] for k in inside), key=lambda row: order.index(row["verdict"]), default=None)


def coarse_first(count: int) -> list[int]:
    """Return 0 to ``count`` - 1 in an order of which every beginning is spread evenly."""
    bits = max(1, (count - 1).bit_length())
    return sorted(range(count), key=lambda k: int(f"{k:0{bits}b}"[::-1], 2))


def walk_html(poses: Sequence[tuple[WalkPose, PoseImage]]) -> Markup:
    """Return the page's section with all pictures; `walk.js` shows the one at the slider."""
    return fill("walk.html", stops=poses) if len(poses) > 1 else Markup()
