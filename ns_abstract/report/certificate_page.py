"""``report.html`` of ``ns-abstract-certify``: the verdict first, then where, why and how long."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup, escape

from ns_abstract.report.cameras import CameraDrawings
from ns_abstract.report.figures import ShownUnits, is_ring, number, percent, unit_of_axis
from ns_abstract.report.html import SEARCH_STATES, set_of, uri, whole_page
from ns_abstract.report.regions import FailureRegion, PoseImage, WalkPose, regions_html, walk_html
from ns_abstract.report.run import plain
from ns_abstract.report.svg import PlotAxis, draw_line, draw_plot, draw_svg
from ns_abstract.report.verdict_maps import free_parameters, maps_of, matrix_svg, mixed, pixels

_VERDICTS = ("certified", "falsified", "unknown")
#: Most frames drawn one by one.
_MOST_ROWS = 200
_MOST_POINTS = 400
#: Most cells that can be chosen one by one; neighbours of one verdict are drawn as one where there are more.
_MOST_CELLS = 4000
#: Places along a parameter where cells are drawn together; counterexamples marked, and frames with maps of all pairs.
_FINE, _MOST_MARKS, _MOST_MATRICES = 160, 400, 4


@dataclass(frozen=True)
class CertificateDetails:
    """Details that are computed when a search ends: regions of failure, and poses with pictures.

    ``pictures`` show a counterexample of each of the first regions beside the nearest certified pose. ``why`` ends a
    sentence on why there are no more; empty if none were left out.
    """

    regions: Sequence[FailureRegion] = ()
    pictures: Sequence[tuple[PoseImage, PoseImage | None]] = ()
    stops: Sequence[tuple[WalkPose, PoseImage]] = ()
    why: str = ""


def certificate_page(
    document: Mapping[str, Any],
    cells: Mapping[int, Sequence[Mapping[str, Any]]],
    pictures: Sequence[Mapping[str, Any]],
    seen: Mapping[tuple[int, int], Mapping[str, Any]] | None = None,
    cameras: CameraDrawings | None = None,
    closer: CertificateDetails | None = None,
) -> str:
    """Return the page of a certificate: HTML, self-contained, every text of the document escaped.

    ``cells`` are by frame rows lower, upper, verdict in the order of ``document``'s parameters; ``pictures`` have
    ``title``, ``text`` and ``png``; ``seen`` are ``text`` and ``png`` of a pose in a cell, by frame and position of the
    cell in it; ``closer`` are the details of the end of the search.
    """
    name, units = str(document["scene"].get("name", "scene")), ShownUnits.of(document["scene"])
    numbers, closer = _numbered(document, cells), closer or CertificateDetails()
    sides = {entry["index"]: entry["parameters"] for entry in document["frames"]}
    covered = percent(document["coverage"]["certified"])
    kind, heading = {
        "certified": ("good", "Certified: the property holds on every image"),
        "falsified": ("bad", f"Falsified; certified on {covered} of the poses"),
        "unknown": ("fair", f"Unknown; certified on {covered} of the poses"),
    }[document["verdict"]]
    with_leaves = [units.drawn(entry, cells.get(entry["index"], ())) for entry in document["frames"]]
    frames, rows = [entry for entry, _ in with_leaves], {entry["index"]: leaves for entry, leaves in with_leaves}
    maps, drawn = verdict_drawings(frames[:_MOST_ROWS], rows, numbers)
    matrices, more_matrices = _matrices(frames, rows)
    scripts = ["cells.js"] if numbers else []
    scripts += ["sliders.js", "walk.js"] if len(closer.stops) > 1 else []
    return whole_page(
        "certificate.html",
        ["certificate.css"],
        scripts,
        title=f"Certificate of {name}",
        d=document,
        name=name,
        model=str(document["model"].get("name", "the network")),
        kind=kind,
        heading=heading,
        state=SEARCH_STATES.get(document["state"]),
        verdicts=_VERDICTS,
        numbered=bool(numbers),
        maps=maps,
        drawn=drawn,
        marked=any('class="broken"' in svg for svg, *_ in (*maps, *drawn)),
        more_frames=len(document["frames"]) - _MOST_ROWS,
        cell_data=_cell_data(document, cells, numbers, seen or {}) if numbers else None,
        matrices=matrices,
        more_matrices=more_matrices,
        regions=regions_html(closer.regions, closer.pictures, sides, closer.why, units),
        walk=walk_html(closer.stops),
        cameras="" if cameras is None else cameras.html(numbers),
        pictures=pictures,
        falsified=sum(entry["cells"]["falsified"] for entry in document["frames"]),
        time=_time(document["trace"]),
        example_text=lambda entry, values: ", ".join(
            units.value(p["name"], p["unit"], values[p["name"]]) for p in entry["parameters"]
        ),
        set_of=lambda entry: set_of({"parameters": [p for p in entry["parameters"] if p["lower"] < p["upper"]]}, units),
    )


def _numbered(
    document: Mapping[str, Any], cells: Mapping[int, Sequence[Mapping[str, Any]]]
) -> dict[tuple[int, int], int]:
    """Return numbers of the cells that can be clicked, by frame and position; empty where there are too many."""
    numbers: dict[tuple[int, int], int] = {}
    for entry in document["frames"][:_MOST_ROWS]:
        for position in range(len(cells.get(entry["index"], ()))):
            numbers[entry["index"], position] = len(numbers)
    return numbers if len(numbers) <= _MOST_CELLS else {}


def _cell_data(
    document: Mapping[str, Any],
    cells: Mapping[int, Sequence[Mapping[str, Any]]],
    numbers: Mapping[tuple[int, int], int],
    seen: Mapping[tuple[int, int], Mapping[str, Any]],
) -> Markup:
    """Return the page script's data on cells, as JSON that ends no HTML tag."""
    pictures: list[tuple[str, str]] = []
    rows = []
    for frame, position in numbers:
        row, picture = cells[frame][position], seen.get((frame, position))
        number_of = None
        if picture is not None:
            number_of = len(pictures)
            pictures.append((uri(picture["png"]), picture["text"]))
        example = row.get("counterexample")
        rows.append((frame, row["verdict"], row["lower"], row["upper"], row.get("margin"), example, number_of))
    first = document["frames"][0]["parameters"]
    data = {"parameters": [(p["name"], p["unit"]) for p in first], "cells": rows, "pictures": pictures}
    text = json.dumps(plain(data), allow_nan=False).replace("<", "\\u003c")
    return Markup(text)


def _merged(rows: Sequence[Mapping[str, Any]], axis: int) -> list[tuple[float, float, str]]:
    """Return spans (from, to, verdict) along one parameter, with neighbouring cells of one verdict merged."""
    spans: list[tuple[float, float, str]] = []
    for row in rows:
        low, high, kind = row["lower"][axis], row["upper"][axis], row["verdict"]
        if spans and spans[-1][2] == kind and spans[-1][1] == low:
            spans[-1] = (spans[-1][0], high, kind)
        else:
            spans.append((low, high, kind))
    return spans


#: A part of a map: first and past end, verdict, and the number of the cell if it can be chosen.
_Span = tuple[float, float, str, "int | None"]


def _spans(rows: Sequence[Mapping[str, Any]], axis: int, frame: int, numbers: Mapping[Any, int]) -> list[_Span]:
    """Return the cells along one parameter as spans, unmerged if they have numbers."""
    if numbers:
        return [
            (row["lower"][axis], row["upper"][axis], row["verdict"], numbers[frame, k]) for k, row in enumerate(rows)
        ]
    return [(low, high, kind, None) for low, high, kind in _merged(rows, axis)]


def _chosen(number_of: int | None) -> str:
    return "" if number_of is None else f' data-cell="{number_of}"'


def verdict_drawings(
    frames: Sequence[Mapping[str, Any]],
    cells: Mapping[int, Sequence[Mapping[str, Any]]],
    numbers: Mapping[tuple[int, int], int],
) -> tuple[list[tuple[Markup, Mapping[str, Any], str]], list[tuple[Markup, str]]]:
    """Return drawings of verdicts over sets: of single frames with their notes, of several frames with captions.

    One azimuth is a ring, another single parameter a strip, two parameters a map; sets of more have bars.
    """
    if way := along_path(frames):
        return [], [(_path(way, cells, numbers), "the whole path, from keyframe to keyframe")]
    maps, bars = [], []
    for entry in frames:
        free = free_parameters(entry["parameters"])
        rows, parameters = cells.get(entry["index"], ()), entry["parameters"]
        if rows and len(free) == 1:
            spans, marks = _spans(rows, free[0], entry["index"], numbers), [e[free[0]] for e in _broken(rows)]
            if is_ring(parameters[free[0]]):
                maps.append((_ring(spans, parameters[free[0]], marks), entry, "seen along the axis, from above"))
            else:
                maps.append((_strip(spans, parameters[free[0]], marks), entry, ""))
        elif rows and len(free) == 2:
            maps.append((_plane(rows, entry, free, numbers), entry, ""))
        else:
            bars.append(entry)
    return maps, [(_bars(bars, numbers, cells), "parts of each frame's set, by frame")] if bars else []


def along_path(frames: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return all frames if each is a segment of the path, or its last keyframe, and nothing else varies; else none."""
    for position, entry in enumerate(frames):
        names = [entry["parameters"][k]["name"] for k in free_parameters(entry["parameters"])]
        if names != ["segment"] and (names or position < len(frames) - 1):
            return []
    return list(frames) if len(frames) > 1 else []


def path_spans(
    entry: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], last: float
) -> list[tuple[float, float, str, float | None]]:
    """Return the cells of a path's frame as (from, to, verdict, position of the counterexample or None).

    Args:
        last: Width at which a single keyframe is drawn.
    """
    free = free_parameters(entry["parameters"])
    spans = []
    for row in rows:
        low, high = (row["lower"][free[0]], row["upper"][free[0]]) if free else (0.0, last)
        example = row.get("counterexample")
        at = None if example is None else example[free[0]] if free else 0.5 * last
        spans.append((low, high, row["verdict"], at))
    return spans


#: How wide the last keyframe of a path is drawn, as a part of the path.
LAST = 0.015


def _broken(rows: Sequence[Mapping[str, Any]]) -> list[Sequence[float]]:
    """Return distinct counterexamples; of many, an evenly spread selection."""
    counterexamples = list({tuple(e): e for row in rows if (e := row.get("counterexample")) is not None}.values())
    return counterexamples[:: max(1, -(-len(counterexamples) // _MOST_MARKS))]


def _ring(spans: Sequence[_Span], parameter: Mapping[str, Any], broken: Sequence[float]) -> Markup:
    """Return the ring of an orbit's verdicts: azimuth 0 is at the right, counter-clockwise."""
    middle, inner, outer = 170.0, 92.0, 138.0
    marks = []
    for low, high, kind, number_of in spans:
        pieces = max(1, math.ceil((high - low) / 2.0))
        for k in range(pieces):
            start = low + (high - low) * k / pieces
            end = low + (high - low) * (k + 1) / pieces
            corners = [
                (middle + r * math.cos(a), middle - r * math.sin(a))
                for r, a in ((outer, start), (outer, end), (inner, end), (inner, start))
            ]
            (a, b), (c, d), (e, f), (g, h) = corners
            marks.append(
                f'<path class="{kind}"{_chosen(number_of)} d="M{a:.2f},{b:.2f}A{outer},{outer} 0 0 0 '
                f'{c:.2f},{d:.2f}L{e:.2f},{f:.2f}A{inner},{inner} 0 0 1 {g:.2f},{h:.2f}Z"/>'
            )
    marks = ['<g class="ring">', *marks, "</g>"]
    for angle in broken:
        (a, b), (c, d) = ((middle + r * math.cos(angle), middle - r * math.sin(angle)) for r in (inner - 7, inner - 2))
        marks.append(f'<path class="broken" d="M{a:.2f},{b:.2f}L{c:.2f},{d:.2f}"/>')
    for degrees in range(0, 360, 45):
        angle = math.radians(degrees)
        x, y = middle + 155 * math.cos(angle), middle - 155 * math.sin(angle) + 4
        marks.append(f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="middle">{degrees}°</text>')
    marks.append(f'<text x="{middle}" y="{middle + 4}" text-anchor="middle">{escape(parameter["name"])}</text>')
    return draw_svg(340, 340, "Verdicts around the orbit", "".join(marks))


def _strip(spans: Sequence[_Span], parameter: Mapping[str, Any], broken: Sequence[float]) -> Markup:
    axis = PlotAxis(parameter["lower"], parameter["upper"], 20, 700, log=False)
    marks = _along(spans, axis, broken)
    marks += [
        f'<text x="{axis(tick):.1f}" y="58" text-anchor="middle">{number(tick, 3)}</text>' for tick in axis.ticks()
    ]
    label = escape(f"{parameter['name']} ({parameter['unit']})")
    marks.append(f'<text x="360" y="74" text-anchor="middle">{label}</text>')
    return draw_svg(720, 80, f"Verdicts along {parameter['name']}", "".join(marks))


def _along(spans: Sequence[_Span], axis: PlotAxis, broken: Sequence[float], offset: float = 0.0) -> list[str]:
    """Return SVG of cells side by side along an axis, with counterexamples below them."""
    marks = [
        f'<rect class="{kind}"{_chosen(n)} x="{axis(offset + a):.2f}" y="8" '
        f'width="{max(0.3, axis(offset + b) - axis(offset + a)):.2f}" height="32"/>'
        for a, b, kind, n in spans
    ]
    return marks + [f'<path class="broken" d="M{axis(offset + v):.2f},41v5"/>' for v in broken]


def _path(
    frames: Sequence[Mapping[str, Any]],
    cells: Mapping[int, Sequence[Mapping[str, Any]]],
    numbers: Mapping[tuple[int, int], int],
) -> Markup:
    """Return one strip of the verdicts along all segments of a path, in order."""
    ways = sum(bool(free_parameters(entry["parameters"])) for entry in frames)
    last = LAST * ways
    axis = PlotAxis(0.0, ways + (last if ways < len(frames) else 0.0), 20, 1000, log=False)
    marks = []
    for position, entry in enumerate(frames):
        frame_spans = path_spans(entry, cells.get(entry["index"], ()), last)
        spans = [(a, b, kind, numbers.get((entry["index"], k))) for k, (a, b, kind, _) in enumerate(frame_spans)]
        broken = sorted({at for *_, at in frame_spans if at is not None})
        marks += _along(spans, axis, broken[:: max(1, -(-len(broken) // _MOST_MARKS))], position)
        at = axis(position)
        marks.append(f'<path class="axis" d="M{at:.1f},4V48"/>')
        if position % math.ceil(len(frames) / 24) == 0:
            marks.append(f'<text x="{at:.1f}" y="60" text-anchor="middle">{entry["index"]}</text>')
    marks.append('<text x="510" y="76" text-anchor="middle">keyframe that the way begins at</text>')
    return draw_svg(1020, 82, "Verdicts along the path", "".join(marks))


def _plane(
    rows: Sequence[Mapping[str, Any]],
    entry: Mapping[str, Any],
    free: Sequence[int],
    numbers: Mapping[tuple[int, int], int],
) -> Markup:
    i, j = free
    parameters = [entry["parameters"][k] for k in free]
    x = PlotAxis(parameters[0]["lower"], parameters[0]["upper"], 58, 438, log=False)
    y = PlotAxis(parameters[1]["lower"], parameters[1]["upper"], 400, 20, log=False)
    if len(rows) > _MOST_CELLS:
        marks = (
            f'<image class="pixels" x="58" y="20" width="380" height="380" preserveAspectRatio="none" '
            f'href="{uri(pixels(mixed(maps_of(rows, entry, _FINE))))}"/>'
        )
    else:
        marks = "".join(
            f'<rect class="{row["verdict"]}"{_chosen(numbers.get((entry["index"], k)))} x="{x(row["lower"][i]):.2f}" '
            f'y="{y(row["upper"][j]):.2f}" '
            f'width="{x(row["upper"][i]) - x(row["lower"][i]):.2f}" '
            f'height="{y(row["lower"][j]) - y(row["upper"][j]):.2f}"/>'
            for k, row in enumerate(rows)
        )
    places = "".join(f"M{x(e[i]) - 2.5:.1f},{y(e[j]) - 2.5:.1f}l5,5m-5,0l5,-5" for e in _broken(rows))
    if places:
        marks += "".join(f'<path class="{kind}" d="{places}" pointer-events="none"/>' for kind in ("halo", "broken"))
    labels = [f"{p['name']} ({unit_of_axis(p['unit'])})" for p in parameters]
    return draw_plot(x, y, (labels[0], labels[1]), marks, size=(450, 440), title="Verdicts over two parameters")


def _matrices(
    frames: Sequence[Mapping[str, Any]], cells: Mapping[int, Sequence[Mapping[str, Any]]]
) -> tuple[list[tuple[Markup, Mapping[str, Any]]], int]:
    """Return maps of all pairs of parameters with their frames, and the number of frames left out.

    Sets of more than two parameters have such maps; of many frames, those with the least certified fractions.
    """
    several = [entry for entry in frames if cells.get(entry["index"]) and len(free_parameters(entry["parameters"])) > 2]
    chosen = sorted(several, key=lambda entry: entry["coverage"]["certified"])[:_MOST_MATRICES]
    drawings = [
        (
            matrix_svg(
                maps_of(cells[entry["index"]], entry),
                [entry["parameters"][k] for k in free_parameters(entry["parameters"])],
            ),
            entry,
        )
        for entry in sorted(chosen, key=lambda entry: entry["index"])
    ]
    return drawings, len(several) - len(chosen)


def _bars(
    entries: Sequence[Mapping[str, Any]],
    numbers: Mapping[tuple[int, int], int],
    cells: Mapping[int, Sequence[Mapping[str, Any]]],
) -> Markup:
    """Return one stacked bar of verdicts by frame; each part links to its cell of the least margin."""
    step, width = 14, 600
    marks = []
    for row, entry in enumerate(entries):
        left = 60.0
        marks.append(f'<text x="54" y="{row * step + 11}" text-anchor="end">{entry["index"]}</text>')
        for kind in _VERDICTS:
            size = width * entry["coverage"][kind]
            least = _least(cells.get(entry["index"], ()), kind)
            chosen = _chosen(None if least is None else numbers.get((entry["index"], least)))
            marks.append(
                f'<rect class="{kind}"{chosen} x="{left:.2f}" y="{row * step + 1}" width="{size:.2f}" '
                f'height="{step - 2}"/>'
            )
            left += size
    return draw_svg(680, len(entries) * step + 4, "Parts of each frame's set", "".join(marks))


def _least(rows: Sequence[Mapping[str, Any]], kind: str) -> int | None:
    """Return the position of the cell of a verdict with the least margin; None: there is no cell of it."""
    of_verdict = [k for k, row in enumerate(rows) if row["verdict"] == kind]
    return min(of_verdict, key=lambda k: math.inf if (m := rows[k].get("margin")) is None else m, default=None)


def _time(trace: Sequence[Mapping[str, float]]) -> Markup:
    """Return a plot of the set's fractions by verdict over time; empty where the trace has one moment."""
    stride = max(1, math.ceil(len(trace) / _MOST_POINTS))
    points = [p for k, p in enumerate(trace) if k % stride == 0 or k == len(trace) - 1]
    if len(points) < 2:
        return Markup()
    x = PlotAxis(0.0, max(p["seconds"] for p in points), 52, 628, log=False)
    y = PlotAxis(0.0, 1.0, 216, 26, log=False)
    marks = "".join(
        draw_line([(x(p["seconds"]), y(p[kind])) for p in points], f"c-{kind}", False) for kind in _VERDICTS
    )
    return draw_plot(
        x, y, ("seconds", "part of the set"), marks, size=(640, 256), title="Certified, falsified and unknown over time"
    )
