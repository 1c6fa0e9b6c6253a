"""``report.html`` of a loop: tubes from above and from the side, the initial box's cells by verdict, widths by step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from ns_abstract.reach.loop import Loop
from ns_abstract.reach.search import QUESTIONS
from ns_abstract.report.certificate_page import percent
from ns_abstract.report.figures import interval, number
from ns_abstract.report.margins import scene_margin
from ns_abstract.report.page import Axis, draw_legend, draw_line, draw_plot, reproduce, whole_page

_STYLE = """
svg rect.certified { fill: var(--good); fill-opacity: .45; } svg rect.falsified { fill: var(--bad); fill-opacity: .45; }
svg rect.unknown { fill: #9aa0a6; fill-opacity: .3; } svg rect.tube { fill: none; stroke: var(--good); }
svg path.run { fill: none; stroke: #5f6368; stroke-width: 1; } svg path.bad { stroke: var(--bad); stroke-width: 2; }
svg path.kept { fill: none; stroke: var(--good); stroke-width: 2; }
svg path.step { fill: none; stroke: #b06000; stroke-width: 2; }
svg path.none { fill: none; stroke: var(--bad); stroke-width: 2; }
svg text.kept, svg text.step, svg text.none, svg text.run { stroke: none; }
svg text.kept { fill: var(--good); } svg text.step { fill: #b06000; } svg text.none { fill: var(--bad); }
"""
_SIZE = 560, 320
#: Falsifying runs and cells drawn at most.
_MOST_CELLS = 4000
_TITLES = {
    "reaches": ("good", "Every run stays safe and reaches the goal"),
    "safe": ("good", "Every run stays safe"),
    "falsified": ("bad", "Some run goes wrong"),
    "unknown": ("fair", "Undecided"),
}


def loop_page(document: Mapping[str, Any], rows: Mapping[int, Sequence[Mapping[str, Any]]], loop: Loop) -> str:
    """The page.

    Args:
        document: Content of report.json.
        rows: By number of the question, the cells: lower, upper, verdict.
        loop: The loop.

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
        *_pictures(document, rows, loop),
        _widths(document),
        scene_margin(document["scene_margin"]),
        _guarantee(document),
        reproduce(document),
    ]
    return whole_page(f"Loop on {name}", body, _STYLE)


def _side(parameter: Mapping[str, Any]) -> str:
    return interval(parameter["name"], parameter["unit"], parameter["lower"], parameter["upper"])


def _pictures(document: Mapping[str, Any], rows: Mapping[int, Sequence[Mapping[str, Any]]], loop: Loop) -> list[str]:
    """Planes of states: from above and from the side where the camera's position moves with them."""
    # the states that move the camera along the world's axes most
    moved = {
        name: int(np.argmax(np.abs(row)))
        for name, row in zip(loop.camera.names, loop.camera.factors, strict=True)
        if name in "xyz"
    }
    planes = [(a, b, text) for a, b, text in (("x", "y", "from above"), ("x", "z", "from the side"))]
    found = []
    for one, two, text in planes:
        if one in moved and two in moved and moved[one] != moved[two]:
            found.append(_plane(document, rows, loop, (moved[one], moved[two]), text))
    if not found and len(loop.names) > 1:
        found.append(_plane(document, rows, loop, (0, 1), "by its first two states"))
    return found


def _plane(
    document: Mapping[str, Any],
    rows: Mapping[int, Sequence[Mapping[str, Any]]],
    loop: Loop,
    axes: tuple[int, int],
    text: str,
) -> str:
    one, two = axes
    boxes: list[tuple[str, float, float, float, float]] = []
    names = [p["name"] for p in document["parameters"]]
    last = max(rows, default=None)
    for row in [] if last is None else rows[last][:_MOST_CELLS]:
        lower, upper = loop.lower.copy(), loop.upper.copy()
        for name, low, high in zip(names, row["lower"], row["upper"], strict=True):
            lower[loop.names.index(name)], upper[loop.names.index(name)] = low, high
        boxes.append((row["verdict"], lower[one], upper[one], lower[two], upper[two]))
    for tube in document["tubes"]:
        boxes += [("tube", low[one], high[one], low[two], high[two]) for low, high in tube["tube"]]
    lines = [("run", states) for states in document["simulated_states"]]
    lines += [("run bad", entry["states"]) for entry in document["falsifying"]]
    points = [
        (kind, [(x[one], x[two]) for x in states if x[one] is not None and x[two] is not None])
        for kind, states in lines
    ]
    across = [v for box in boxes for v in box[1:3]] + [x for _, line in points for x, _ in line]
    down = [v for box in boxes for v in box[3:5]] + [y for _, line in points for _, y in line]
    if not across:
        return ""
    width, height = _SIZE
    x = Axis(min(across), max(across), 52, width - 12, log=False)
    y = Axis(min(down), max(down), height - 34, 20, log=False)
    marks = "".join(
        f'<rect class="{kind}" x="{x(a):.1f}" y="{y(d):.1f}" width="{max(1.0, x(b) - x(a)):.1f}" '
        f'height="{max(1.0, y(c) - y(d)):.1f}"/>'
        for kind, a, b, c, d in boxes
    )
    marks += "".join(draw_line([(x(a), y(b)) for a, b in line], kind, False) for kind, line in points)
    title = f"Seen {text}"
    asked = "" if last is None else f" Cells by the verdict on “{QUESTIONS[last]}”: green certified, red falsified."
    labels = (
        escape(f"{loop.names[one]} {loop.units[one]}".strip()),
        escape(f"{loop.names[two]} {loop.units[two]}".strip()),
    )
    return (
        f"<h2>{title}</h2><p>Grey: simulated runs; red: stored runs that go wrong; outlines: tubes of a few certified "
        f"cells.{asked}</p>" + draw_plot(x, y, labels, marks, size=_SIZE, title=title)
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
        pairs = zip(document["parameters"], tube["lower"], tube["upper"], strict=True)
        cell = " · ".join(interval(p["name"], p["unit"], a, b) for p, a, b in pairs)
        found.append(
            f"<p>Cell {escape(cell)}: mean width of the states by step, and of {tube['runs']} simulated runs.</p>"
            + draw_plot(x, y, ("step", "width"), marks, size=_SIZE, title="Width by step")
        )
    return "<h2>Width of the tubes</h2>" + "".join(found) if found else ""


def _guarantee(document: Mapping[str, Any]) -> str:
    lines = [
        "What is certified: sequences of states where every next one is f(x, u) + w, f in real numbers or in float64 "
        "as this program evaluates it, w anything in its box; u comes from the picture of the pose at x by the network "
        "and the control law. Between sampling times nothing is said.",
        f"Pictures: <b>{escape(document['guarantee'])}</b>, each bound {escape(document['guarantee_text'])}.",
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
