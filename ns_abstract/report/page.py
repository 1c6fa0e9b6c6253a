"""``report.html`` of abstract images: one file that loads nothing from the network."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from markupsafe import Markup

from ns_abstract.report.figures import MARKS, ShownUnits, number
from ns_abstract.report.html import counted, set_of, whole_page
from ns_abstract.report.picture import color_stops, color_table
from ns_abstract.report.play import play_moves
from ns_abstract.report.svg import PlotAxis, draw_legend, draw_line, draw_plot, stairs, through

#: Points drawn of one curve.
_CURVE_POINTS = 200
#: Frames whose details are unfolded.
_OPEN_FRAMES = 4

_STATS = (
    ("mpg", "MPG", "mean pixel gap: how wide the bounds are, over all pixels"),
    ("mpg_witness", "MPG of renders", "the same of images really rendered; the true one is at least this"),
    ("ratio", "ratio", "MPG / MPG of renders: 1 would be exact"),
    ("xpg", "XPG", "gap of the widest pixel (at most √3 = 1.732)"),
    ("xpg_witness", "XPG of renders", "the same of images really rendered"),
    ("seconds", "seconds", "time spent on this frame"),
    ("cells", "cells", "boxes of parameters that were bounded one by one"),
)


def shown_frames(frames: Sequence[Mapping[str, Any]], most: int) -> list[Mapping[str, Any]]:
    """Return the frames whose pictures the page shows: all, or the ``most`` with the greatest MPG, in order."""
    if len(frames) <= most:
        return list(frames)
    widest = sorted(frames, key=lambda entry: -entry["mpg"])[:most]
    return sorted(widest, key=lambda entry: entry["index"])


def render_page(
    document: Mapping[str, Any], pictures: Mapping[int, Mapping[str, bytes]], plays: Mapping[int, str] | None = None
) -> str:
    """Return the page of a report: HTML, self-contained, every text of the document escaped.

    ``document`` is the content of report.json (`ns_abstract.report.record.Report.document`). By number of the frames
    shown, ``pictures`` are PNGs lower, upper, gap, witness and image, and ``plays`` what
    `ns_abstract.report.play.play_data` returns.
    """
    name, frames = str(document["scene"].get("name", "scene")), document["frames"]
    sampled = document["guarantee"] == "sampled"
    plays = {} if sampled else plays or {}
    path_curve = _path_curve(frames)
    notes = [f"Not used: {line}" for line in document["ignored"]]
    if others := document["other_files"]:
        names = ", ".join(others[:8]) + (", …" if len(others) > 8 else "")
        notes.append(f"Files of earlier commands in this folder, which this report does not describe: {names}")
    units = ShownUnits.of(document["scene"])

    def sides(entry: Mapping[str, Any]) -> str:
        return set_of(entry, units) or "one camera pose"

    return whole_page(
        "render.html",
        scripts=("sliders.js", "play.js") if plays else (),
        title=f"Abstract images of {name}",
        d=document,
        name=name,
        program=" ".join(str(v) for key in ("name", "version") if (v := document["renderer"].get(key))),
        sampled=sampled,
        verdict=_verdict(document),
        sets=list({sides(entry): None for entry in frames}),
        set_of=sides,
        plays=plays,
        moves=any(play_moves(text) for text in plays.values()),
        colors=color_table,
        gradient=lambda: ", ".join(color_stops()),
        overview=_overview(frames),
        path_curve=path_curve,
        reached=[f"ratio {mark:g}: {_reached(frames, f'{mark:g}')}" for mark in MARKS]
        if path_curve and "seconds_to_ratio" in frames[0]
        else [],
        shown=[entry for entry in frames if entry["index"] in pictures],
        open_frames=_OPEN_FRAMES,
        pictures=pictures,
        captions=lambda entry: _captions(entry, sampled),
        curve=_curve,
        stats=_STATS,
        notes=notes,
    )


def _verdict(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the headline of the page: kind and title, the number of frames with bounds, and further sentences."""
    frame_count, missing = len(document["frames_asked"]), len(document["missing"])
    bounded = frame_count - missing
    sampled = document["guarantee"] == "sampled"
    frames = document["frames"]
    if sampled:
        kind, title = "bad", f"No guarantee: rendered samples of {counted(frame_count, 'frame')}"
    elif not bounded:
        kind, title = "bad", f"No bounds yet: 0 of {counted(frame_count, 'frame')}"
    elif missing:
        kind, title = "fair", f"Bounds for {bounded} of {counted(frame_count, 'frame')}"
    else:
        # bounds that could be much tighter are no success
        kind = "fair" if any(entry["status"] == "partial" for entry in frames) else "good"
        title = f"Bounds for all {counted(frame_count, 'frame')}" if frame_count > 1 else "Bounds for the frame"
    lines = []
    ratios = [entry["ratio"] for entry in frames if entry["ratio"] is not None and entry["status"] != "missing"]
    if ratios and not sampled:
        worst = max((entry for entry in frames if entry["ratio"] in ratios), key=lambda entry: entry["ratio"])
        lines.append(
            f"Tightness: the mean gap is at most {number(median(ratios))} times the true one"
            + (f" (median; widest {number(worst['ratio'])}, frame {worst['index']})." if len(ratios) > 1 else ".")
        )
    partial = [entry for entry in frames if entry["status"] == "partial"]
    if partial:
        lines.append(
            f"{counted(len(partial), 'frame')} ended before the target ratio; such bounds hold, but could be tighter."
        )
    state = {
        "running": "The command was still running, or was killed, when this page was written.",
        "interrupted": "The command was interrupted; what had been finished is here.",
        "budget": "The time budget ended first.",
    }.get(document["state"])
    if state:
        lines.append(state)
    if missing:
        numbers = ", ".join(map(str, document["missing"][:20])) + (", …" if missing > 20 else "")
        lines.append(f"No bounds of frame{'' if missing == 1 else 's'} {numbers}.")
    return {"kind": kind, "title": title, "bounded": bounded, "lines": lines}


def _captions(entry: Mapping[str, Any], sampled: bool) -> Sequence[tuple[str, str, str]]:
    """Return keys, labels and captions of a frame's pictures."""
    captions = (
        ("lower", "lower image", "least values of the samples") if sampled else
        ("lower", "lower bound", "no image of the set is darker"),
        ("upper", "upper image", "largest values of the samples") if sampled else
        ("upper", "upper bound", "no image of the set is brighter"),
        ("gap", "gap", "length over RGB of upper − lower"),
        ("witness", "gap of renders", "what rendering has shown, same scale"),
        ("image", "one render", "at the middle of the set"),
    )  # fmt: skip
    for name, figures in entry.get("layers", {}).items():
        mean = f"mean {number(figures['mean_gap'])}, at most {number(figures['ratio'])} times the true one"
        captions += (
            (f"{name}_lower", f"{name}, lower", ""), (f"{name}_upper", f"{name}, upper", ""),
            (f"{name}_gap", f"{name}, upper − lower", mean), (f"{name}_image", f"{name}, one render", ""),
        )  # fmt: skip
    return captions


def _thinned(trace: Sequence[Mapping[str, float]]) -> list[Mapping[str, float]]:
    """Return points of a trace after the first moment, thinned where there are many; the last one is kept."""
    stride = max(1, math.ceil(len(trace) / _CURVE_POINTS))
    points = [point for k, point in enumerate(trace) if k % stride == 0 or k == len(trace) - 1]
    return [point for point in points if point["seconds"] > 0.0]


def _seen(trace: Sequence[Mapping[str, float]]) -> list[Mapping[str, float]]:
    """Return the points of a trace from the first cover of the whole set on; all points where there is none."""
    covered = [point for point in trace if point.get("covered", 1.0) >= 1.0 and point["mpg_witness"] > 0.0]
    return covered or list(trace)


def _curve(entry: Mapping[str, Any]) -> Markup | None:
    """Return the plot of a frame's error against run time, both axes logarithmic; None where all errors are zero."""
    points = _thinned(_seen(entry["trace"]))
    outer = [(point["seconds"], point["mpg"]) for point in points if point["mpg"] > 0.0]
    inner = [(point["seconds"], point["mpg_witness"]) for point in points if point["mpg_witness"] > 0.0]
    if not outer:
        return None
    values = [value for _, value in outer + inner]
    end = max(t for t, _ in outer + inner)
    x = PlotAxis(min(t for t, _ in outer + inner), end, 52, 408, log=True)
    y = PlotAxis(min(values), max(values), 216, 26, log=True)
    upper = [(x(t), y(v)) for t, v in stairs(outer, end)]
    lower = [(x(t), y(v)) for t, v in stairs(inner, end)]
    band = ""
    if len(upper) > 2 and len(lower) > 2 and outer[0][0] == inner[0][0]:
        band = f'<path class="band" d="{through(upper + lower[::-1])}Z"/>'
    marks = band + draw_line(upper, "outer", False) + draw_line(lower, "inner", False)
    if len(points) <= 25:
        marks += draw_line([(x(t), y(v)) for t, v in outer], "outer", True, joined=False)
        marks += draw_line([(x(t), y(v)) for t, v in inner], "inner", True, joined=False)
    marks += draw_legend((("outer", "bounds (MPG)"), ("inner", "MPG of renders")), 408)
    labels = ("seconds of work (log)", "mean pixel gap (log)")
    return draw_plot(x, y, labels, marks, size=(420, 256), title="Mean pixel gap against run time")


def _path_curve(frames: Sequence[Mapping[str, Any]]) -> Markup | None:
    """Return the plot of all frames' errors against their run times, with the mean; None for a single frame."""
    traces = [thinned for entry in frames if len(thinned := _thinned(entry["trace"])) > 1]
    if len(traces) < 2:
        return None
    times = sorted({point["seconds"] for trace in traces for point in trace})
    every = max(1, math.ceil(len(times) / _CURVE_POINTS))
    times = [*times[::every], times[-1]]
    begin = min(_seen(entry["trace"])[0]["seconds"] for entry in frames if len(_thinned(entry["trace"])) > 1)
    times = [time for time in times if time >= begin] or times[-1:]

    def at(trace: Sequence[Mapping[str, float]], key: str, before: float) -> list[float]:
        values_at, position, value = [], 0, before
        for time in times:
            while position < len(trace) and trace[position]["seconds"] <= time:
                value = trace[position][key]
                position += 1
            values_at.append(value)
        return values_at

    end = times[-1]
    lines: dict[str, list[list[float]]] = {
        "outer": [at(trace, "mpg", math.sqrt(3.0)) for trace in traces],
        "inner": [at(trace, "mpg_witness", 0.0) for trace in traces],
    }
    positive = [v for frame_values in lines.values() for values in frame_values for v in values if v > 0.0]
    if not positive:
        return None
    x, y = PlotAxis(times[0], end, 52, 988, log=True), PlotAxis(min(positive), max(positive), 236, 26, log=True)
    marks = ""
    for kind, frame_values in lines.items():
        mean = [sum(same) / len(same) for same in zip(*frame_values, strict=True)]
        for values, strength in (*((values, " one") for values in frame_values), (mean, "")):
            points = [(t, v) for t, v in zip(times, values, strict=True) if v > 0.0]
            if points:
                marks += draw_line([(x(t), y(v)) for t, v in stairs(points, end)], f"{kind}{strength}", False)
    marks += draw_legend((("outer", "bounds (MPG)"), ("inner", "MPG of renders")), 988)
    labels = ("seconds of work on each frame (log)", "mean pixel gap (log)")
    return draw_plot(x, y, labels, marks, size=(1000, 276), title="Mean pixel gap of the path against run time")


def _reached(frames: Sequence[Mapping[str, Any]], mark: str) -> str:
    times = [seconds for entry in frames if (seconds := entry["seconds_to_ratio"].get(mark)) is not None]
    if not times:
        return "no frame"
    return f"{len(times)} of {counted(len(frames), 'frame')}, after {number(median(times), 3)} s (median)"


def _overview(frames: Sequence[Mapping[str, Any]]) -> Markup | None:
    """Return the plot of MPG along the path; None for a single frame."""
    frames = [entry for entry in frames if entry["status"] != "missing"]
    if len(frames) < 2:
        return None
    x = PlotAxis(-0.5, len(frames) - 0.5, 52, 988, log=False)
    y = PlotAxis(0.0, 1.05 * max(entry["mpg"] for entry in frames), 176, 26, log=False)
    half = min(14.0, 0.42 * (x(1) - x(0)))
    every = math.ceil(len(frames) / 24)
    marks = ""
    for k, entry in enumerate(frames):
        at, high, low = x(k), y(entry["mpg"]), y(entry["mpg_witness"])
        marks += (
            f'<rect class="band" x="{at - half:.1f}" y="{high:.1f}" width="{2 * half:.1f}" height="{low - high:.1f}"/>'
        )
        marks += "".join(
            f'<path class="{kind}" d="M{at - half:.1f},{level:.1f}h{2 * half:.1f}"/>'
            for kind, level in (("outer", high), ("inner", low))
        )
        if k % every == 0:
            marks += f'<text x="{at:.1f}" y="{y.start + 15:.1f}" text-anchor="middle">{entry["index"]}</text>'
    marks += draw_legend((("outer", "bounds (MPG)"), ("inner", "MPG of renders")), 988)
    return draw_plot(
        None, y, ("frame", "mean pixel gap"), marks, size=(1000, 216), title="Mean pixel gap of every frame"
    )
