"""``report.html`` of ``ns-abstract-certify``: the verdict first, then where, why and how long."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from ns_abstract.report.cameras import Cameras
from ns_abstract.report.figures import interval, number, percent, unit_of_axis
from ns_abstract.report.margins import scene_margin
from ns_abstract.report.page import Axis, counted, draw_line, draw_plot, reproduce, script, uri, whole_page
from ns_abstract.report.record import plain
from ns_abstract.report.regions import Region, Shown, regions_html
from ns_abstract.report.verdict_maps import TEXT, free_parameters, maps_of, matrix_svg, mixed, pixels
from ns_abstract.report.walk import Stop, walk_html

_STYLE = """
svg .certified { fill: var(--good); } svg .falsified { fill: var(--bad); } svg .unknown { fill: #9aa0a6; }
svg text.certified, svg text.falsified, svg text.unknown { stroke: none; }
svg path.c-certified, svg path.c-falsified, svg path.c-unknown { fill: none; stroke-width: 2; }
svg path.c-certified { stroke: var(--good); } svg path.c-falsified { stroke: var(--bad); }
svg path.c-unknown { stroke: #9aa0a6; }
.key i { display: inline-block; width: .8em; height: .8em; margin: 0 .35em 0 1em; border-radius: 2px; }
.certified-back { background: var(--good); } .falsified-back { background: var(--bad); }
.unknown-back { background: #9aa0a6; } .certified-ink { color: var(--good); } .falsified-ink { color: var(--bad); }
svg .frusta path { fill-opacity: .45; stroke-width: 1; } svg .frusta .certified { stroke: var(--good); }
svg .frusta .falsified { stroke: var(--bad); } svg .frusta .unknown { stroke: #5f6368; }
svg [data-cell] { cursor: pointer; } svg [data-cell].chosen { stroke: var(--ink); stroke-width: 2.5; }
#cell { background: var(--card); border: 1px solid var(--line); border-radius: 6px; padding: .8rem 1.2rem;
  flex: 1 1 20rem; }
#cell img { width: 16rem; max-width: 100%; } #cell h3 { margin: 0 0 .4rem; font-size: 1rem; }
svg .ring path { stroke-width: .5; } svg .ring .certified { stroke: var(--good); }
svg .ring .falsified { stroke: var(--bad); } svg .ring .unknown { stroke: #9aa0a6; }
svg .broken { stroke: var(--ink); stroke-width: 1.2; fill: none; }
svg .halo { stroke: var(--card); stroke-width: 3.2; fill: none; }
svg image.pixels { image-rendering: pixelated; } svg .frame { fill: none; stroke: var(--line); }
.region { background: var(--card); border: 1px solid var(--line); border-radius: 6px; padding: .4rem 1.2rem .8rem;
  margin: .7rem 0; } .region figure { flex: 0 1 15rem; } .region table { width: auto; }
#walk-verdicts { display: flex; gap: 2px; margin: .3rem 0 .8rem; } #walk-verdicts i { flex: 1; height: .8rem; }
#walk-verdicts i.here { outline: 2px solid var(--ink); } #walk.moves .images { display: block; max-width: 20rem; }
#walk.moves figcaption span { display: none; } #walk label, #walk-verdicts { max-width: 40rem; }
#walk label { display: block; font-size: .9rem; } #walk input { width: 100%; margin: .3rem 0 0; }
#cell button { font: inherit; font-size: .85rem; margin-right: .5rem; }
"""
_VERDICTS = ("certified", "falsified", "unknown")
_COLUMNS = ("cells certified", "falsified", "unknown", "open", "sampled right", "least proven margin")
#: Most frames drawn one by one.
_MOST_ROWS = 200
_MOST_POINTS = 400
#: Most cells that can be chosen one by one; neighbours of one verdict are drawn as one where there are more.
_MOST_CELLS = 4000
#: Places along a parameter where cells are drawn together; counterexamples marked, and frames with maps of all pairs.
_FINE, _MOST_MARKS, _MOST_MATRICES = 160, 400, 4
#: An orbit is drawn as a ring from so many radians on.
_RING = 1.0


@dataclass(frozen=True)
class Closer:
    """Details that were computed when a search ended: regions of failure, poses with pictures.

    Attributes:
        regions: Where the property fails.
        pictures: Of the first of them: a counterexample, and the nearest pose that was seen to be right.
        stops: Poses along the sets, with pictures.
        why: Why there are no more pictures, as the end of a sentence; empty if there were not to be more.
    """

    regions: Sequence[Region] = ()
    pictures: Sequence[tuple[Shown, Shown | None]] = ()
    stops: Sequence[tuple[Stop, Shown]] = ()
    why: str = ""


def certificate_page(
    document: Mapping[str, Any],
    cells: Mapping[int, Sequence[Mapping[str, Any]]],
    pictures: Sequence[Mapping[str, Any]],
    seen: Mapping[tuple[int, int], Mapping[str, Any]] | None = None,
    cameras: Cameras | None = None,
    closer: Closer | None = None,
) -> str:
    """The page of a certificate.

    Args:
        document: Content of report.json.
        cells: By frame, rows lower, upper, verdict in the order of ``document``'s parameters.
        pictures: ``title``, ``text`` and ``png`` of images to show, in order.
        seen: ``text`` and ``png`` of a pose in a cell, by frame and position of the cell in it.
        cameras: Where cameras stand.
        closer: Regions and poses that were looked at more closely.

    Returns:
        HTML, self-contained; every text of the document is escaped.
    """
    name = str(document["scene"].get("name", "scene"))
    numbers, closer = _numbered(document, cells), closer or Closer()
    sides = {entry["index"]: entry["parameters"] for entry in document["frames"]}
    scripts = ["cells.js"] if numbers else []
    scripts += ["sliders.js", "walk.js"] if len(closer.stops) > 1 else []
    body = [
        _verdict(document, name),
        _map(document, cells, numbers),
        _cell_data(document, cells, numbers, seen or {}) if numbers else "",
        _matrices(document, cells),
        regions_html(closer.regions, closer.pictures, sides, closer.why),
        walk_html(closer.stops),
        "" if cameras is None else cameras.html(numbers),
        _pictures(pictures),
        _counterexamples(document),
        _time(document),
        _substitution(document),
        scene_margin(document["scene_margin"]),
        _frames(document),
        _guarantee(document),
        _files(),
        reproduce(document),
    ]
    return whole_page(f"Certificate of {name}", body, _STYLE, script(*scripts))


def _numbered(
    document: Mapping[str, Any], cells: Mapping[int, Sequence[Mapping[str, Any]]]
) -> dict[tuple[int, int], int]:
    """Numbers of the cells that can be chosen, by frame and position; none where there are too many."""
    found: dict[tuple[int, int], int] = {}
    for entry in document["frames"][:_MOST_ROWS]:
        for position in range(len(cells.get(entry["index"], ()))):
            found[entry["index"], position] = len(found)
    return found if len(found) <= _MOST_CELLS else {}


def _cell_data(
    document: Mapping[str, Any],
    cells: Mapping[int, Sequence[Mapping[str, Any]]],
    numbers: Mapping[tuple[int, int], int],
    seen: Mapping[tuple[int, int], Mapping[str, Any]],
) -> str:
    """Return the data of cells that the page's script shows, as JSON that cannot end a tag."""
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
    return f'<script type="application/json" id="cell-data">{text}</script>'


_CELL = (
    '<div id="cell" hidden><h3 id="cell-title"></h3><table><tbody id="cell-values"></tbody></table>'
    '<p><img id="cell-picture" class="pixels" alt="a picture of the cell" hidden></p><p id="cell-caption" '
    'class="soft"></p><button id="cell-before">cell before</button><button id="cell-next">next cell</button></div>'
)


def _verdict(document: Mapping[str, Any], name: str) -> str:
    covered, model = document["coverage"], str(document["model"].get("name", "the network"))
    titles = {
        "certified": ("good", "Certified: the property holds on every image"),
        "falsified": ("bad", f"Falsified; certified on {percent(covered['certified'])} of the poses"),
        "unknown": ("fair", f"Undecided; certified on {percent(covered['certified'])} of the poses"),
    }
    kind, title = titles[document["verdict"]]
    lines = [
        f"For every camera pose in the green part ({percent(covered['certified'])} of the set, by volume): render "
        f"<b>{escape(name)}</b> with {escape(' '.join(map(str, document['renderer'].values())))} and show the image to "
        f"<b>{escape(model)}</b>; then {escape(document['property_text'])}.",
        f"Falsified: {percent(covered['falsified'])}, cells with a pose whose image was rendered again and breaks the "
        f"property. Unknown: {percent(covered['unknown'])}"
        + (
            f", of which {percent(covered['not_examined'])} were not examined before the end."
            if covered["not_examined"]
            else "."
        ),
    ]
    sampled = document["sampled"]
    if sampled["poses"]:
        lines.append(
            f"Sampling {sampled['poses']:,} evenly spread poses, the property holds at "
            f"{percent(sampled['sampled_right'])} of them"
            + (
                f"; {percent(min(1.0, document['certified_of_sampled_right']))} of that share is certified."
                if document["certified_of_sampled_right"] is not None
                else "."
            )
        )
    parts = document["partitions"]
    if parts:
        lines.append(
            f"Fixed partition of {parts['partitions']:,} parts: PCP-V {percent(parts['PCP-V'])} certified, PCP-S "
            f"{percent(parts['PCP-S'])} right under sampling"
            + (f", {percent(parts['undecided'])} undecided (no finite margin)." if parts["undecided"] else ".")
        )
    state = {
        "running": "The command was still running, or was killed, when this page was written.",
        "interrupted": "The command was interrupted; go on with --resume.",
        "budget": "The time budget ended first; go on with --resume.",
    }.get(document["state"])
    if state:
        lines.append(state)
    key = "".join(f'<i class="{kind}-back"></i>{kind}' for kind in _VERDICTS)
    return (
        f'<p class="soft">Certificate of {escape(model)} on {escape(name)}</p><div class="verdict {kind}">'
        f"<h1>{escape(title)}</h1>{''.join(f'<p>{line}</p>' for line in lines)}"
        f'<p class="soft key">{key}</p></div>'
    )


def _merged(rows: Sequence[Mapping[str, Any]], axis: int) -> list[tuple[float, float, str]]:
    """Neighbouring cells of one verdict along one parameter as one span."""
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
    """The cells along one parameter, one by one if they have numbers."""
    if numbers:
        return [
            (row["lower"][axis], row["upper"][axis], row["verdict"], numbers[frame, k]) for k, row in enumerate(rows)
        ]
    return [(low, high, kind, None) for low, high, kind in _merged(rows, axis)]


def _chosen(number_of: int | None) -> str:
    return "" if number_of is None else f' data-cell="{number_of}"'


def _map(
    document: Mapping[str, Any],
    cells: Mapping[int, Sequence[Mapping[str, Any]]],
    numbers: Mapping[tuple[int, int], int],
) -> str:
    """Where: rings of one azimuth, strips of one other parameter, maps of two, bars of more."""
    frames = document["frames"][:_MOST_ROWS]
    drawn, bars = [], []
    if way := along_path(frames):
        drawn.append(_path(way, cells, numbers))
    for entry in [] if way else frames:
        free = free_parameters(entry["parameters"])
        rows, parameters = cells.get(entry["index"], ()), entry["parameters"]
        if rows and len(free) == 1:
            spans, marks = _spans(rows, free[0], entry["index"], numbers), [e[free[0]] for e in _broken(rows)]
            if is_ring(parameters[free[0]]):
                drawn.append(_figure(_ring(spans, parameters[free[0]], marks), entry, "seen from the axis's tip"))
            else:
                drawn.append(_figure(_strip(spans, parameters[free[0]], marks), entry, ""))
        elif rows and len(free) == 2:
            drawn.append(_figure(_plane(rows, entry, free, numbers), entry, ""))
        else:
            bars.append(entry)
    text = "".join(drawn)
    if bars:
        text += _bars(bars, numbers, cells)
    more = len(document["frames"]) - len(frames)
    note = f"<p>{counted(more, 'further frame')} in the table below.</p>" if more > 0 else ""
    hint = '<p class="soft" id="cell-hint" hidden>Click a cell for its margin and a picture.</p>' if numbers else ""
    if 'class="broken"' in text:
        hint += '<p class="soft">Small marks are counterexamples.</p>'
    return f'<h2>Where</h2>{hint}<div class="below">{text}{_CELL if numbers else ""}</div>{note}'


def _figure(svg: str, entry: Mapping[str, Any], note: str) -> str:
    covered = entry["coverage"]
    about = ", ".join(f"{kind} {percent(covered[kind])}" for kind in _VERDICTS)
    return f"<figure>{svg}<figcaption><b>frame {entry['index']}</b> {about} {note}</figcaption></figure>"


def _svg(width: int, height: int, title: str, marks: str) -> str:
    return (
        f'<svg role="img" viewBox="0 0 {width} {height}" width="{width}" height="{height}">'
        f"<title>{escape(title)}</title>{marks}</svg>"
    )


def is_ring(parameter: Mapping[str, Any]) -> bool:
    """Whether a parameter is drawn as a ring."""
    return parameter["name"] == "azimuth" and parameter["upper"] - parameter["lower"] >= _RING


def along_path(frames: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """All frames if each is a way from one keyframe to the next, or the last keyframe, and nothing else varies."""
    for position, entry in enumerate(frames):
        names = [entry["parameters"][k]["name"] for k in free_parameters(entry["parameters"])]
        if names != ["segment"] and (names or position < len(frames) - 1):
            return []
    return list(frames) if len(frames) > 1 else []


def path_spans(
    entry: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], last: float
) -> list[tuple[float, float, str, float | None]]:
    """Cells of a frame of a path: from and to where, verdict, and where the counterexample is.

    Args:
        entry: The frame.
        rows: Its cells.
        last: How wide a keyframe by itself is drawn.
    """
    free = free_parameters(entry["parameters"])
    found = []
    for row in rows:
        low, high = (row["lower"][free[0]], row["upper"][free[0]]) if free else (0.0, last)
        example = row.get("counterexample")
        at = None if example is None else example[free[0]] if free else 0.5 * last
        found.append((low, high, row["verdict"], at))
    return found


#: How wide the last keyframe of a path is drawn, as a part of the path.
LAST = 0.015


def _broken(rows: Sequence[Mapping[str, Any]]) -> list[Sequence[float]]:
    """Counterexamples, each once; some of many, evenly spread."""
    found = list({tuple(e): e for row in rows if (e := row.get("counterexample")) is not None}.values())
    return found[:: max(1, -(-len(found) // _MOST_MARKS))]


def _ring(spans: Sequence[_Span], parameter: Mapping[str, Any], broken: Sequence[float]) -> str:
    """Azimuth 0 to the right, counter-clockwise."""
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
    return _svg(340, 340, "Verdicts around the orbit", "".join(marks))


def _strip(spans: Sequence[_Span], parameter: Mapping[str, Any], broken: Sequence[float]) -> str:
    axis = Axis(parameter["lower"], parameter["upper"], 20, 700, log=False)
    marks = _along(spans, axis, broken)
    marks += [
        f'<text x="{axis(tick):.1f}" y="58" text-anchor="middle">{number(tick, 3)}</text>' for tick in axis.ticks()
    ]
    label = escape(f"{parameter['name']} ({parameter['unit']})")
    marks.append(f'<text x="360" y="74" text-anchor="middle">{label}</text>')
    return _svg(720, 80, f"Verdicts along {parameter['name']}", "".join(marks))


def _along(spans: Sequence[_Span], axis: Axis, broken: Sequence[float], offset: float = 0.0) -> list[str]:
    """Cells side by side, counterexamples below them."""
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
) -> str:
    """All ways from keyframe to keyframe, one after another."""
    ways = sum(bool(free_parameters(entry["parameters"])) for entry in frames)
    last = LAST * ways
    axis = Axis(0.0, ways + (last if ways < len(frames) else 0.0), 20, 1000, log=False)
    marks = []
    for position, entry in enumerate(frames):
        found = path_spans(entry, cells.get(entry["index"], ()), last)
        spans = [(a, b, kind, numbers.get((entry["index"], k))) for k, (a, b, kind, _) in enumerate(found)]
        broken = sorted({at for *_, at in found if at is not None})
        marks += _along(spans, axis, broken[:: max(1, -(-len(broken) // _MOST_MARKS))], position)
        at = axis(position)
        marks.append(f'<path class="axis" d="M{at:.1f},4V48"/>')
        if position % math.ceil(len(frames) / 24) == 0:
            marks.append(f'<text x="{at:.1f}" y="60" text-anchor="middle">{entry["index"]}</text>')
    marks.append('<text x="510" y="76" text-anchor="middle">keyframe that the way begins at</text>')
    svg = _svg(1020, 82, "Verdicts along the path", "".join(marks))
    return f"<figure>{svg}<figcaption>the whole path, from keyframe to keyframe</figcaption></figure>"


def _plane(
    rows: Sequence[Mapping[str, Any]],
    entry: Mapping[str, Any],
    free: Sequence[int],
    numbers: Mapping[tuple[int, int], int],
) -> str:
    i, j = free
    parameters = [entry["parameters"][k] for k in free]
    x = Axis(parameters[0]["lower"], parameters[0]["upper"], 58, 438, log=False)
    y = Axis(parameters[1]["lower"], parameters[1]["upper"], 400, 20, log=False)
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
    labels = [escape(f"{p['name']} ({unit_of_axis(p['unit'])})") for p in parameters]
    return draw_plot(x, y, (labels[0], labels[1]), marks, size=(450, 440), title="Verdicts over two parameters")


def _matrices(document: Mapping[str, Any], cells: Mapping[int, Sequence[Mapping[str, Any]]]) -> str:
    """Maps of all pairs of parameters, for sets of more than two; those that are certified least if there are many."""
    several = [
        entry
        for entry in document["frames"]
        if cells.get(entry["index"]) and len(free_parameters(entry["parameters"])) > 2
    ]
    if not several:
        return ""
    chosen = sorted(several, key=lambda entry: entry["coverage"]["certified"])[:_MOST_MATRICES]
    figures = "".join(
        _figure(
            matrix_svg(
                maps_of(cells[entry["index"]], entry),
                [entry["parameters"][k] for k in free_parameters(entry["parameters"])],
            ),
            entry,
            "",
        )
        for entry in sorted(chosen, key=lambda entry: entry["index"])
    )
    more = len(several) - len(chosen)
    note = f"<p>{counted(more, 'further frame')}, none of them certified less.</p>" if more else ""
    return f"<h2>Verdicts over pairs of parameters</h2><p>{TEXT}</p>{figures}{note}"


def _bars(
    entries: Sequence[Mapping[str, Any]],
    numbers: Mapping[tuple[int, int], int],
    cells: Mapping[int, Sequence[Mapping[str, Any]]],
) -> str:
    """One stacked bar by frame; a part stands for its cell of the least margin."""
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
    svg = _svg(680, len(entries) * step + 4, "Parts of each frame's set", "".join(marks))
    return f"<figure>{svg}<figcaption>parts of each frame's set, by frame</figcaption></figure>"


def _least(rows: Sequence[Mapping[str, Any]], kind: str) -> int | None:
    """The cell of a verdict whose margin is the least; one without a margin if all are."""
    found = [k for k, row in enumerate(rows) if row["verdict"] == kind]
    return min(found, key=lambda k: math.inf if (m := rows[k].get("margin")) is None else m, default=None)


def _pictures(pictures: Sequence[Mapping[str, Any]]) -> str:
    if not pictures:
        return ""
    figures = "".join(
        f'<figure><img class="pixels" src="{uri(entry["png"])}" alt="{escape(entry["title"])}">'
        f"<figcaption><b>{escape(entry['title'])}</b><br>{escape(entry['text'])}</figcaption></figure>"
        for entry in pictures
    )
    return f'<h2>Images</h2><div class="images">{figures}</div>'


def _counterexamples(document: Mapping[str, Any]) -> str:
    found = [(entry["index"], example) for entry in document["frames"] for example in entry["counterexamples"]]
    total = sum(entry["cells"]["falsified"] for entry in document["frames"])
    if not total:
        return ""
    rows = "".join(
        f"<tr><td>{index}</td><td>{number(example['margin'])}</td>"
        f'<td class="left">{escape(", ".join(f"{k} = {v!r}" for k, v in example["values"].items()))}</td></tr>'
        for index, example in found
    )
    return (
        f"<h2>Counterexamples</h2><p>{counted(total, 'cell')} with a pose that breaks the property; the worst of each "
        "frame are here, all are in cells.sqlite, their images in the folder counterexamples.</p>"
        '<div class="wide"><table><thead><tr><th>frame</th><th>margin</th><th class="left">pose</th></tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _time(document: Mapping[str, Any]) -> str:
    trace = document["trace"]
    stride = max(1, math.ceil(len(trace) / _MOST_POINTS))
    points = [p for k, p in enumerate(trace) if k % stride == 0 or k == len(trace) - 1]
    effort = document["effort"]
    text = (
        f"<h2>Time</h2><p>{number(document['seconds'])} s of wall time, {number(effort['worker_seconds'])} s of work; "
        f"the network was bounded on {counted(int(effort['cells_bounded']), 'cell')}.</p>"
    )
    if len(points) < 2:
        return text
    x = Axis(0.0, max(p["seconds"] for p in points), 52, 628, log=False)
    y = Axis(0.0, 1.0, 216, 26, log=False)
    marks = "".join(
        draw_line([(x(p["seconds"]), y(p[kind])) for p in points], f"c-{kind}", False) for kind in _VERDICTS
    )
    return text + draw_plot(
        x, y, ("seconds", "part of the set"), marks, size=(640, 256), title="Certified, falsified and unknown over time"
    )


def _substitution(document: Mapping[str, Any]) -> str:
    """Return the section on substitution: margins and certified half-widths by mode of bounding."""
    entry = document["substitution"]
    title = "<h2>What the shared parameters are worth</h2>"
    if entry["skipped"]:
        return f"{title}<p>Not compared: {escape(entry['skipped'])}.</p>"
    modes = list(entry["modes"])

    def widths(cell: Mapping[str, Any], mode: str) -> str:
        half = cell["half_width"][mode]
        if half is None:
            return "none found"
        text = " · ".join(number(value, 3) for value in half)
        return f"≥ {text}" if mode in cell["at_least"] else text

    rows = "".join(
        f'<tr><td>{cell["frame"]}</td><td class="left">'
        + escape(
            ", ".join(
                f"{name} = {number(0.5 * (low + high), 5)} ± {number(0.5 * (high - low), 3)}"
                for name, low, high in zip(cell["parameters"], cell["lower"], cell["upper"], strict=True)
            )
        )
        + "</td>"
        + "".join(f"<td>{number(cell['margin'][mode])}</td>" for mode in modes)
        + "".join(f"<td>{widths(cell, mode)}</td>" for mode in modes)
        + "</tr>"
        for cell in entry["cells"]
    )
    head = "".join(f"<th>{kind}, {escape(mode)}</th>" for kind in ("margin", "half-width") for mode in modes)
    terms = "".join(f"<dt>{escape(mode)}</dt><dd>{escape(text)}</dd>" for mode, text in entry["modes"].items())
    wider = ", ".join(
        f"{number(gain, 3)} times those of {escape(mode)}" for mode, gain in entry["wider_than"].items() if gain
    )
    return (
        f"{title}<p>Certified cells about evenly spread poses, bounded in weaker ways, too "
        f"(in {number(entry['seconds'], 2)} s): the proven margin on the cell, and the largest half-width about its "
        f"middle that is certified, in steps of {number(entry['step'], 3)}."
        + (f" Half-widths are {wider} (geometric mean)." if wider else "")
        + f'</p><div class="wide"><table><thead><tr><th>frame</th><th class="left">cell</th>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div><dl>{terms}</dl>"
    )


def _frames(document: Mapping[str, Any]) -> str:
    def row(entry: Mapping[str, Any]) -> str:
        covered, cells = entry["coverage"], entry["cells"]
        box = " · ".join(
            interval(p["name"], p["unit"], p["lower"], p["upper"])
            for p in entry["parameters"]
            if p["lower"] < p["upper"]
        )
        parts = "".join(f"<td>{percent(covered[kind])}</td>" for kind in _VERDICTS)
        counts = "".join(f"<td>{cells[kind]}</td>" for kind in (*_VERDICTS, "open"))
        return (
            f'<tr><td>{entry["index"]}</td><td class="left">{escape(box or "one pose")}</td>{parts}{counts}'
            f"<td>{percent(entry['sampled']['sampled_right'])}</td><td>{number(entry['least_margin'])}</td></tr>"
        )

    head = "".join(f"<th>{name}</th>" for name in (*_VERDICTS, *_COLUMNS))
    reasons = "".join(
        f"<li>{escape(reason)}: {counted(cells, 'cell')}</li>" for reason, cells in document["unknown_because"].items()
    )
    return (
        f'<h2>Frames</h2><div class="wide"><table><thead><tr><th>frame</th><th class="left">set</th>{head}</tr></thead>'
        f"<tbody>{''.join(map(row, document['frames']))}</tbody></table></div>"
        + (f"<p>Why cells are unknown:</p><ul>{reasons}</ul>" if reasons else "")
    )


_PICTURES = {
    "float": "the float image in [0, 1], not its rounding to 8 bits in a file",
    "8-bit": "the image rounded to 8 bits, round(255 x) / 255, by any float32 program and either way at a tie",
}


def _guarantee(document: Mapping[str, Any]) -> str:
    lines = [
        f"Images: guarantee <b>{escape(document['guarantee'])}</b>, each {escape(document['guarantee_text'])}.",
        f"What is bounded is {_PICTURES[document['picture']]}; preprocessing in float32 is part of it. Resizing means "
        "rendering at the network's resolution.",
        "Network: " + escape("; ".join(document["network_guarantee"])) + ".",
        *(escape(limit) for limit in document["limits"]),
    ]
    plan = "".join(f"<li>{escape(line)}</li>" for line in document["plan"])
    terms = "".join(f"<dt>{escape(key)}</dt><dd>{escape(text)}</dd>" for key, text in document["metrics"].items())
    return (
        "<h2>What is guaranteed</h2>"
        + "".join(f"<p>{line}</p>" for line in lines)
        + (f"<p>Left out or set aside:</p><ul>{plan}</ul>" if plan else "")
        + f"<h2>What the numbers mean</h2><dl>{terms}</dl>"
    )


def _files() -> str:
    code = (
        "import json, sqlite3\n"
        'base = sqlite3.connect("cells.sqlite")\n'
        'base.execute("SELECT name, unit FROM parameters ORDER BY position").fetchall()\n'
        'for frame, lower, upper, verdict, margin, seconds, example in base.execute("SELECT * FROM cells"):\n'
        "    lower, upper = json.loads(lower), json.loads(upper)   # a box of the parameters"
    )
    return f"<h2>How to read the files</h2><pre>{escape(code)}</pre>"
