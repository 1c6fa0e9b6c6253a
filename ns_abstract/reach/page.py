"""``report.html`` of a loop: tubes from above and from the side, the initial box's cells by verdict, widths by step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from ns_abstract.reach.film import SHOWN
from ns_abstract.reach.loop import Loop
from ns_abstract.reach.planes import LoopPlot, Marks, plane_marks, region, views
from ns_abstract.reach.search import QUESTIONS
from ns_abstract.report.figures import ShownUnits
from ns_abstract.report.html import SEARCH_STATES, set_of, whole_page
from ns_abstract.report.outside import PICTURE_WIDTH, SceneDrawing, behind, draw_plane, plane_axes
from ns_abstract.report.svg import PlotAxis, draw_legend, draw_line, draw_plot

_SIZE = 560, 320
_FILM_NAMES = {"lower": "lower", "upper": "upper", "gap": "gap", "image": "render"}
_TITLES = {
    "reaches": ("good", "Every run stays safe and reaches the goal"),
    "safe": ("good", "Every run stays safe"),
    "falsified": ("bad", "Some run goes wrong"),
    "unknown": ("fair", "Unknown"),
}


def loop_page(
    document: Mapping[str, Any],
    rows: Mapping[int, Sequence[Mapping[str, Any]]],
    loop: Loop,
    outside: SceneDrawing | None = None,
    strips: Sequence[tuple[int, bytes]] = (),
) -> str:
    """Return the page of a loop: HTML, self-contained, every text of the ``document`` escaped.

    Args:
        outside: Draws the scene behind the tubes; None: the scene has no elements with a position.
        strips: Steps of the film and their PNGs.
    """
    name = str(document["scene"].get("name", "scene"))
    kind, heading = _TITLES[document["verdict"]]

    units = ShownUnits()

    def cell(entry: Mapping[str, Any]) -> str:
        pairs = zip(document["parameters"], entry["lower"], entry["upper"], strict=True)
        return " · ".join(units.interval(p["name"], p["unit"], a, b) for p, a, b in pairs) or "one state"

    return whole_page(
        "loop.html",
        ["loop.css"],
        title=f"Loop on {name}",
        d=document,
        name=name,
        kind=kind,
        heading=heading,
        state=SEARCH_STATES.get(document["state"]),
        initial=set_of(document, units) or "one state",
        course=loop,
        pictures=_pictures(document, rows, loop, outside),
        film_rows=[_FILM_NAMES[name] for name in SHOWN],
        strips=strips,
        widths=_widths(document),
        cell=cell,
        runs_text=runs_text,
    )


def runs_text(question: str, simulated: Mapping[str, Any]) -> str:
    """Return a sentence on how many simulated runs did what a question asks."""
    runs = simulated["runs"]
    if not runs:
        return "no run was simulated"
    well = "stayed safe" if question == "safe" else "stayed safe and reached the goal"
    return f"{round(simulated['went_well'] * runs):,} of {runs:,} simulated runs {well}"


def _pictures(
    document: Mapping[str, Any],
    rows: Mapping[int, Sequence[Mapping[str, Any]]],
    loop: Loop,
    outside: SceneDrawing | None,
) -> list[tuple[str, str, str, Markup]]:
    """Return title, legend, text on the scene, and plot, of the views from above and from the side.

    A camera that only turns has one plot, in the plane of two states.
    """
    last = max(rows, default=None)
    cells = [] if last is None else rows[last]
    plot_arguments = (
        ""
        if last is None
        else f" Cells by the verdict on “{QUESTIONS[last]}”: green certified, red falsified, grey unknown."
    )
    figures = [
        _seen(view, document, loop, outside, plot_arguments)
        for view in views(document, cells, loop, outside, PICTURE_WIDTH)
    ]
    if figures or len(loop.names) < 2:
        return figures
    marks = plane_marks(document, cells, loop, np.eye(2, len(loop.names)), np.zeros(2))
    ends = marks.ends
    if ends is None:
        return []
    width, height = _SIZE
    x = PlotAxis(ends[0][0], ends[1][0], 52, width - 12, log=False)
    y = PlotAxis(ends[0][1], ends[1][1], height - 34, 20, log=False)
    one, two = (f"{name} {unit}".strip() for name, unit in list(zip(loop.names, loop.units, strict=True))[:2])
    title = "Seen by its first two states"
    plot = draw_plot(x, y, (one, two), _drawn(marks, x, y), size=_SIZE, title=title)
    return [(title, f"{_MARKS_TEXT} tubes of a few certified cells.{plot_arguments}", "", plot)]


_MARKS_TEXT = "Grey: simulated runs; red: stored runs that go wrong; blue outlines:"


def _drawn(marks: Marks, x: PlotAxis, y: PlotAxis) -> str:
    text = "".join(
        f'<rect class="{kind}" x="{x(low[0]):.1f}" y="{y(high[1]):.1f}" '
        f'width="{max(1.0, x(high[0]) - x(low[0])):.1f}" height="{max(1.0, y(low[1]) - y(high[1])):.1f}"/>'
        for kind, low, high in marks.boxes
    )
    return text + "".join(draw_line([(x(a), y(b)) for a, b in line], kind, False) for kind, line in marks.lines)


def _seen(
    view: LoopPlot, document: Mapping[str, Any], loop: Loop, outside: SceneDrawing | None, asked: str
) -> tuple[str, str, str, Markup]:
    window, marks = view.window, ""
    x, y = plane_axes(window)
    sets = [("unsafe", faces, -1.0) for faces in loop.unsafe]
    sets += [] if loop.goal is None or not loop.goal.faces else [("goal", loop.goal.faces, 1.0)]
    legend = set()
    for kind, faces, sign in sets:
        corners = region(faces, loop, view.axes, window, sign)
        if corners:
            legend.add(kind)
            points = " ".join(f"{x(a):.1f},{y(b):.1f}" for a, b in corners)
            marks += f'<polygon class="{kind}" points="{points}"/>'
    dashed = {"unsafe": "red, dashed: unsafe sets", "goal": "green, dashed: the goal"}
    extra = "".join(f"; {text}" for kind, text in dashed.items() if kind in legend)
    title = f"Seen {view.title}"
    plot = draw_plane(outside, window, view.clip, marks + _drawn(view.marks, x, y), title)
    scene = behind(outside, view.clip, "tubes alone")
    text = (
        f"Where the camera is, in the run's normalised frame. {_MARKS_TEXT} boxes of all positions at a step, for a "
        f"few certified cells{extra}.{asked}"
    )
    return title, text, scene, plot


def _widths(document: Mapping[str, Any]) -> list[tuple[Mapping[str, Any], Markup]]:
    """Return the tubes that the page shows, each with a plot of its width by step."""
    figures = []
    for tube in document["tubes"]:
        curves = [("kept", "dependence kept", tube["width"])]
        curves += [(m, {"step": "within a step", "none": "none"}[m], w) for m, w in tube["width_by_dependence"].items()]
        curves.append(("run", "simulated", tube["width_simulated"]))
        values = [v for _, _, line in curves for v in line if v is not None and v > 0.0]
        if not values:
            continue
        width, height = _SIZE
        x = PlotAxis(0, max(len(line) for _, _, line in curves) - 1, 52, width - 12, log=False)
        y = PlotAxis(min(values), max(values), height - 34, 20, log=True)
        marks = "".join(
            draw_line([(x(k), y(v)) for k, v in enumerate(line) if v is not None and v > 0.0], kind, False)
            for kind, _, line in curves
        )
        marks += draw_legend([(kind, label) for kind, label, _ in curves], width - 12)
        figures.append((tube, draw_plot(x, y, ("step", "width"), marks, size=_SIZE, title="Width by step")))
    return figures
