"""``report.html`` of a loop: tubes from above and from the side, the initial box's cells by verdict, widths by step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from ns_abstract.reach.film import SHOWN
from ns_abstract.reach.loop import Loop
from ns_abstract.reach.planes import Marks, View, plane_marks, region, views
from ns_abstract.reach.search import QUESTIONS
from ns_abstract.report.certificate_page import percent
from ns_abstract.report.figures import interval, number, short_guarantee
from ns_abstract.report.margins import scene_margin
from ns_abstract.report.outside import PICTURE_WIDTH, Outside, behind, draw_plane, plane_axes
from ns_abstract.report.page import Axis, draw_legend, draw_line, draw_plot, reproduce, uri, whole_page

_STYLE = """
svg rect.certified { fill: var(--good); fill-opacity: .45; } svg rect.falsified { fill: var(--bad); fill-opacity: .45; }
svg rect.unknown { fill: #9aa0a6; fill-opacity: .3; } svg rect.tube { fill: none; stroke: #0b57d0; stroke-width: 1.3; }
svg polygon.unsafe { fill: var(--bad); fill-opacity: .13; stroke: var(--bad); stroke-dasharray: 5 3; }
svg polygon.goal { fill: none; stroke: #00695c; stroke-width: 1.5; stroke-dasharray: 5 3; }
.film { display: flex; gap: .4rem; } .film figure { flex: none; } .film figcaption { text-align: center; }
.film img { width: 5.2rem; image-rendering: pixelated; } .film .names { display: flex; flex-direction: column;
  justify-content: space-around; font-size: .82rem; color: var(--soft); padding-bottom: 1.4rem; }
svg path.run { fill: none; stroke: #5f6368; stroke-width: 1; stroke-opacity: .6; }
svg path.bad { stroke: var(--bad); stroke-width: 2; }
svg path.kept { fill: none; stroke: var(--good); stroke-width: 2; }
svg path.step { fill: none; stroke: #b06000; stroke-width: 2; }
svg path.none { fill: none; stroke: var(--bad); stroke-width: 2; }
svg text.kept, svg text.step, svg text.none, svg text.run { stroke: none; }
svg text.kept { fill: var(--good); } svg text.step { fill: #b06000; } svg text.none { fill: var(--bad); }
"""
_SIZE = 560, 320
_FILM_NAMES = {"lower": "lower", "upper": "upper", "gap": "gap", "image": "render"}
_TITLES = {
    "reaches": ("good", "Every run stays safe and reaches the goal"),
    "safe": ("good", "Every run stays safe"),
    "falsified": ("bad", "Some run goes wrong"),
    "unknown": ("fair", "Undecided"),
}


def loop_page(
    document: Mapping[str, Any],
    rows: Mapping[int, Sequence[Mapping[str, Any]]],
    loop: Loop,
    outside: Outside | None = None,
    strips: Sequence[tuple[int, bytes]] = (),
) -> str:
    """The page.

    Args:
        document: Content of report.json.
        rows: By number of the question, the cells: lower, upper, verdict.
        loop: The loop.
        outside: Draws the scene behind the tubes; None: it has no elements with a place of their own.
        strips: Steps of the film and their PNGs.

    Returns:
        HTML, self-contained; every text of the document is escaped.
    """
    name = str(document["scene"].get("name", "scene"))
    kind, title = _TITLES[document["verdict"]]
    lines = [
        f"Initial states: {escape(' · '.join(_side(p) for p in document['parameters']) or 'one state')}; {loop.steps} "
        f"steps of {number(loop.dt)} s of {escape(loop.dynamics.name)} dynamics, {escape(document['dynamics'])}."
    ]
    for question, entry in document["questions"].items():
        runs = entry["simulated"]
        lines.append(
            f"<b>{question}</b>: certified on {percent(entry['certified'])} of the initial box, falsified on "
            f"{percent(entry['falsified'])}, unknown on {percent(entry['unknown'])}; of {runs['runs']} random runs "
            f"{percent(runs['went_well'])} went well. Certified means: {escape(entry['text'])}."
        )
    body = [
        f'<p class="soft">A network in the loop on {escape(name)}</p><div class="verdict {kind}"><h1>{title}</h1>'
        + "".join(f"<p>{line}</p>" for line in lines)
        + "</div>",
        *_pictures(document, rows, loop, outside),
        _film(document, strips),
        _widths(document),
        scene_margin(document["scene_margin"]),
        _guarantee(document),
        reproduce(document),
    ]
    return whole_page(f"Loop on {name}", body, _STYLE)


def _side(parameter: Mapping[str, Any]) -> str:
    return interval(parameter["name"], parameter["unit"], parameter["lower"], parameter["upper"])


def _pictures(
    document: Mapping[str, Any],
    rows: Mapping[int, Sequence[Mapping[str, Any]]],
    loop: Loop,
    outside: Outside | None,
) -> list[str]:
    """The loop from above and from the side; where the camera only turns, in the plane of two states."""
    last = max(rows, default=None)
    cells = [] if last is None else rows[last]
    asked = (
        ""
        if last is None
        else f" Cells by the verdict on “{QUESTIONS[last]}”: green certified, red falsified, grey undecided."
    )
    found = [
        _seen(view, document, loop, outside, asked) for view in views(document, cells, loop, outside, PICTURE_WIDTH)
    ]
    if found or len(loop.names) < 2:
        return found
    marks = plane_marks(document, cells, loop, np.eye(2, len(loop.names)), np.zeros(2))
    ends = marks.ends
    if ends is None:
        return []
    width, height = _SIZE
    x = Axis(ends[0][0], ends[1][0], 52, width - 12, log=False)
    y = Axis(ends[0][1], ends[1][1], height - 34, 20, log=False)
    one, two = (escape(f"{name} {unit}".strip()) for name, unit in list(zip(loop.names, loop.units, strict=True))[:2])
    title = "Seen by its first two states"
    plot = draw_plot(x, y, (one, two), _drawn(marks, x, y), size=_SIZE, title=title)
    return [f"<h2>{title}</h2><p>{_MARKS_TEXT} tubes of a few certified cells.{asked}</p>{plot}"]


_MARKS_TEXT = "Grey: simulated runs; red: stored runs that go wrong; blue outlines:"


def _drawn(marks: Marks, x: Axis, y: Axis) -> str:
    text = "".join(
        f'<rect class="{kind}" x="{x(low[0]):.1f}" y="{y(high[1]):.1f}" '
        f'width="{max(1.0, x(high[0]) - x(low[0])):.1f}" height="{max(1.0, y(low[1]) - y(high[1])):.1f}"/>'
        for kind, low, high in marks.boxes
    )
    return text + "".join(draw_line([(x(a), y(b)) for a, b in line], kind, False) for kind, line in marks.lines)


def _seen(view: View, document: Mapping[str, Any], loop: Loop, outside: Outside | None, asked: str) -> str:
    window, marks = view.window, ""
    x, y = plane_axes(window)
    sets = [("unsafe", faces, -1.0) for faces in loop.unsafe]
    sets += [] if loop.goal is None else [("goal", loop.goal.faces, 1.0)]
    shown = set()
    for kind, faces, sign in sets:
        corners = region(faces, loop, view.axes, window, sign)
        if corners:
            shown.add(kind)
            points = " ".join(f"{x(a):.1f},{y(b):.1f}" for a, b in corners)
            marks += f'<polygon class="{kind}" points="{points}"/>'
    dashed = {"unsafe": "red, dashed: unsafe sets", "goal": "green, dashed: the goal"}
    extra = "".join(f"; {text}" for kind, text in dashed.items() if kind in shown)
    title = f"Seen {view.title}"
    plot = draw_plane(outside, window, view.nearest, marks + _drawn(view.marks, x, y), title)
    scene = behind(outside, view.nearest, "tubes alone")
    return (
        f"<h2>{title}</h2><p>Where the camera is, in the run's normalised frame. {_MARKS_TEXT} boxes of all positions "
        f"at a step, for a few certified cells{extra}.{asked} {scene}</p>{plot}"
    )


def _film(document: Mapping[str, Any], strips: Sequence[tuple[int, bytes]]) -> str:
    """Some steps of the film, side by side."""
    film = document["film"]
    if film is None:
        return ""
    if "skipped" in film:
        return f"<h2>Along a tube</h2><p>No film: {escape(film['skipped'])}.</p>"
    height, width = film["size"]
    names = "".join(f"<span>{_FILM_NAMES[name]}</span>" for name in SHOWN)
    figures = "".join(
        f'<figure><img src="{uri(data)}" alt="step {step}"><figcaption>{step}</figcaption></figure>'
        for step, data in strips
    )
    file = escape(film["file"])
    return (
        f"<h2>Along a tube</h2><p>What the camera may see at a step of the tube of {escape(_cell(document, film))}, "
        f"{film['verdict']}, in {width} × {height} pixels: lower and upper bound of every pixel over all poses of the "
        f"tube, their gap (brightest: {number(max(film['largest_gap']))}), and the picture from the tube's middle. All "
        f'steps: <a href="{file}">{file}</a>.</p><div class="wide"><div class="film"><div class="names">{names}</div>'
        f"{figures}</div></div>"
    )


def _widths(document: Mapping[str, Any]) -> str:
    """Widths by step of the tubes that are shown."""
    found = []
    for tube in document["tubes"]:
        curves = [("kept", "dependence kept", tube["width"])]
        curves += [(m, {"step": "within a step", "none": "none"}[m], w) for m, w in tube["width_by_dependence"].items()]
        curves.append(("run", "simulated", tube["width_simulated"]))
        values = [v for _, _, line in curves for v in line if v is not None and v > 0.0]
        if not values:
            continue
        width, height = _SIZE
        x = Axis(0, max(len(line) for _, _, line in curves) - 1, 52, width - 12, log=False)
        y = Axis(min(values), max(values), height - 34, 20, log=True)
        marks = "".join(
            draw_line([(x(k), y(v)) for k, v in enumerate(line) if v is not None and v > 0.0], kind, False)
            for kind, _, line in curves
        )
        marks += draw_legend([(kind, label) for kind, label, _ in curves], width - 12)
        found.append(
            f"<p>Cell {escape(_cell(document, tube))}: mean width of the states by step, and of {tube['runs']} "
            "simulated runs.</p>" + draw_plot(x, y, ("step", "width"), marks, size=_SIZE, title="Width by step")
        )
    return "<h2>Width of the tubes</h2>" + "".join(found) if found else ""


def _cell(document: Mapping[str, Any], entry: Mapping[str, Any]) -> str:
    """The cell that an entry of the report is about."""
    pairs = zip(document["parameters"], entry["lower"], entry["upper"], strict=True)
    return " · ".join(interval(p["name"], p["unit"], a, b) for p, a, b in pairs) or "one state"


def _guarantee(document: Mapping[str, Any]) -> str:
    guarantee = short_guarantee(document["guarantee"], document["scene"].get("bounded"))
    lines = [
        "What is certified: sequences of states where every next one is f(x, u) + w, f in real numbers or in float64 "
        "as this program evaluates it, w anything in its box; u comes from the picture of the pose at x by the network "
        "and the control law. Between sampling times nothing is said.",
        f"Pictures: <b>{escape(guarantee)}</b>, each bound {escape(document['guarantee_text'])}.",
        "Network: " + escape("; ".join(document["network_guarantee"])) + ".",
    ]
    if "dynamics_guarantee" in document:
        lines.append("f, a network of its own: " + escape("; ".join(document["dynamics_guarantee"])) + ".")
    reasons = "".join(f"<li>{escape(text)}: {count}</li>" for text, count in document["unknown_because"].items())
    plan = "".join(f"<li>{escape(line)}</li>" for line in document["plan"])
    terms = "".join(f"<dt>{escape(key)}</dt><dd>{escape(text)}</dd>" for key, text in document["metrics"].items())
    return (
        "<h2>What is guaranteed</h2>"
        + "".join(f"<p>{line}</p>" for line in lines)
        + (f"<p>Left out or set aside:</p><ul>{plan}</ul>" if plan else "")
        + (f"<p>Why cells are unknown, and how many:</p><ul>{reasons}</ul>" if reasons else "")
        + f"<h2>What the numbers mean</h2><dl>{terms}</dl>"
    )
