"""``report.html``: the report for people, in one file that needs nothing from the net."""

from __future__ import annotations

import base64
import hashlib
import math
import shlex
from collections.abc import Mapping, Sequence
from functools import cache
from html import escape
from pathlib import Path
from statistics import median
from typing import Any

from ns_abstract.report.figures import MARKS, interval, number, short_guarantee

#: Points drawn of one curve.
_CURVE_POINTS = 200
#: Frames whose details are unfolded.
_OPEN_FRAMES = 4

STYLE = """
:root { color-scheme: light dark; --paper: #fbfbf9; --card: #ffffff; --ink: #1c1d20; --soft: #5c6066; --line: #dcdcd6;
  --outer: #c0430f; --inner: #1769aa; --band: rgba(192, 67, 15, .13); --good: #1d7440; --fair: #9a6400; --bad: #b3261e; }
@media (prefers-color-scheme: dark) { :root { --paper: #131417; --card: #1b1d21; --ink: #e8e8e4; --soft: #a0a4ab;
  --line: #34373d; --outer: #ff8a50; --inner: #6db9f2; --band: rgba(255, 138, 80, .17); --good: #6fcf8e; --fair: #e3b341;
  --bad: #ff8a80; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1.2rem 4rem; max-width: 68rem; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: .4rem 0 .6rem; } h2 { font-size: 1.2rem; margin: 2.4rem 0 .6rem; }
p, ul { margin: .5rem 0; max-width: 50rem; } a { color: var(--inner); } h1, p, li, td, dd { overflow-wrap: anywhere; }
.soft, figcaption, .stat small { color: var(--soft); } .verdict { background: var(--card); border: 1px solid var(--line);
  border-left: 5px solid var(--good); border-radius: 6px; padding: .8rem 1.2rem 1rem; } .verdict.fair { border-left-color: var(--fair); }
.verdict.bad { border-left-color: var(--bad); } .tag { font-size: .8rem; border: 1px solid currentColor; border-radius: 1rem;
  padding: .08rem .6rem; white-space: nowrap; font-weight: 500; } .done { color: var(--good); } .partial { color: var(--fair); }
.missing { color: var(--bad); } details { background: var(--card); border: 1px solid var(--line); border-radius: 6px;
  margin: .7rem 0; padding: 0 1.2rem; } details[open] { padding-bottom: 1rem; } summary { cursor: pointer; padding: .7rem 0;
  font-weight: 600; } summary .soft { font-weight: 400; margin-left: .6rem; } .images { display: grid; gap: .8rem;
  grid-template-columns: repeat(auto-fit, minmax(10.5rem, 1fr)); } figure { margin: 0; } figure img { display: block;
  width: 100%; border: 1px solid var(--line); } img.pixels { image-rendering: pixelated; } figcaption { font-size: .82rem;
  line-height: 1.35; margin-top: .3rem; } .scale { display: flex; align-items: center; gap: .6rem; font-size: .82rem;
  color: var(--soft); margin: .7rem 0; } .scale i { height: .7rem; flex: 0 1 16rem; border: 1px solid var(--line); }
.below { display: flex; flex-wrap: wrap; gap: 1rem 2rem; align-items: flex-start; margin-top: .8rem; } .stats { display: grid;
  grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: .8rem 1.2rem; flex: 1 1 24rem; } .stat b { display: block;
  font-size: 1.25rem; font-variant-numeric: tabular-nums; } .stat span { font-size: .85rem; } .stat small { display: block;
  font-size: .8rem; line-height: 1.35; } svg { max-width: 100%; height: auto; } svg text { fill: var(--soft); font-size: 11px; }
svg .axis { stroke: var(--line); } svg .outer { stroke: var(--outer); } svg .inner { stroke: var(--inner); }
svg path.outer, svg path.inner { fill: none; stroke-width: 2; } svg path.one { stroke-width: 1; opacity: .35; } svg circle.outer { fill: var(--outer); stroke: none; }
svg circle.inner { fill: var(--inner); stroke: none; } svg .band { fill: var(--band); } svg text.outer { fill: var(--outer);
  stroke: none; } svg text.inner { fill: var(--inner); stroke: none; } .wide { overflow-x: auto; } table { border-collapse: collapse;
  font-size: .88rem; font-variant-numeric: tabular-nums; width: 100%; } th, td { text-align: right; padding: .28rem .6rem;
  border-bottom: 1px solid var(--line); } th { color: var(--soft); font-weight: 500; white-space: nowrap; } .left { text-align: left; }
pre { background: var(--card); border: 1px solid var(--line); border-radius: 6px; padding: .8rem 1rem; overflow-x: auto;
  font: 13px/1.5 ui-monospace, "SF Mono", Menlo, Consolas, monospace; white-space: pre-wrap; overflow-wrap: anywhere; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.2rem; } code { font: .9em ui-monospace, "SF Mono", Menlo, Consolas, monospace; } dt { font-weight: 600; } dd { margin: 0; }
#play { background: var(--card); border: 1px solid var(--line); border-radius: 6px; padding: 1rem 1.2rem; display: grid;
  grid-template-columns: minmax(16rem, 26rem) minmax(16rem, 1fr); gap: .6rem 1.6rem; } #play[hidden], #play [hidden] { display: none; }
#play canvas { width: 100%; } #play-curve { max-width: 30rem; } #play-picture { image-rendering: pixelated; border: 1px solid var(--line); cursor: crosshair; touch-action: none; }
#play label { display: block; font-size: .9rem; } #play .choice label { display: inline-block; margin-right: .9rem; }
#play-sliders input { width: 100%; } #play-caption { min-height: 2.8em; } #play-values td { text-align: right; }
@media (max-width: 44rem) { #play { grid-template-columns: 1fr; } }
@media print { #play { display: none; } details { break-inside: avoid; } }
"""

_STATS = (
    ("mpg", "MPG", "mean pixel gap: how wide the bounds are, over all pixels"),
    ("mpg_witness", "witness MPG", "the same of images really rendered; the true one is at least this"),
    ("ratio", "ratio", "MPG / witness MPG: 1 would be exact"),
    ("xpg", "XPG", "gap of the widest pixel (at most √3 = 1.732)"),
    ("xpg_witness", "witness XPG", "the same of images really rendered"),
    ("seconds", "seconds", "time spent on this frame"),
    ("cells", "cells", "boxes of parameters that were bounded one by one"),
)


def shown_frames(frames: Sequence[Mapping[str, Any]], most: int) -> list[Mapping[str, Any]]:
    """The frames whose pictures the page shows: all, or the ``most`` with the greatest MPG, in order."""
    if len(frames) <= most:
        return list(frames)
    widest = sorted(frames, key=lambda entry: -entry["mpg"])[:most]
    return sorted(widest, key=lambda entry: entry["index"])


def render_page(
    document: Mapping[str, Any],
    pictures: Mapping[int, Mapping[str, bytes]],
    plays: Mapping[int, str] | None = None,
) -> str:
    """The page of a report.

    Args:
        document: Content of report.json (`ns_abstract.report.record.Report.document`).
        pictures: For the frames shown, by number: PNGs lower, upper, gap, witness and image.
        plays: Frames to play with, by number, as `ns_abstract.report.play.play_data` gives them.

    Returns:
        HTML, self-contained; every text of the document is escaped.
    """
    name = str(document["scene"].get("name", "scene"))
    frames = document["frames"]
    sampled = document["guarantee"] == "sampled"
    body = [_verdict(document, name)]
    plays = {} if document["guarantee"] == "sampled" else plays or {}
    if plays:
        body.append(_play(plays))
    if frames:
        body += [_overview(document), _path_curve(frames)]
    shown = [entry for entry in frames if entry["index"] in pictures]
    if shown:
        body.append("<h2>Frames</h2>")
        if len(shown) < len(frames):
            body.append(f"<p>The {len(shown)} frames with the widest bounds; the table below has all.</p>")
        body += [
            _frame(entry, pictures[entry["index"]], sampled=sampled, opened=position < _OPEN_FRAMES)
            for position, entry in enumerate(shown)
        ]
    body += [_plan(document), _table(document), _numbers(document), _files(document), reproduce(document)]
    return whole_page(f"Abstract images of {name}", body, script=script("sliders.js", "play.js") if plays else "")


@cache
def script(*names: str) -> str:
    """Scripts that lie beside this module, one after another."""
    return "".join((Path(__file__).parent / name).read_text(encoding="utf-8") for name in names)


def whole_page(title: str, body: Sequence[str], more_style: str = "", script: str = "") -> str:
    """A page of ``body``'s parts, with the style sheet and no way to load anything.

    The only code that the browser runs in it is ``script``, which the page's policy names by its hash.
    """
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = f"; script-src 'sha256-{digest}'" if script else ""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        # the browser itself then refuses other scripts and everything from elsewhere
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        f"style-src 'unsafe-inline'{allowed}\">\n"
        f"<title>{escape(title)}</title>\n<style>{STYLE}{more_style}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in body if part)
        + (f"\n<script>{script}</script>" if script else "")
        + "\n</body>\n</html>\n"
    )


_SHOWN = (("lower", "lower"), ("upper", "upper"), ("gap", "gap"), ("witness", "witness gap"), ("image", "render"))


def _play(plays: Mapping[int, str]) -> str:
    """Bounds at a pose that the reader chooses; `play.js` brings it to life and shows it."""
    from ns_abstract.report.picture import color_table

    options = "".join(f'<option value="{k}">frame {index}</option>' for k, index in enumerate(plays))
    shown = "".join(
        f'<label><input type="radio" name="play-shown" value="{key}"{" checked" if key == "lower" else ""}> '
        f"{text}</label>"
        for key, text in _SHOWN
    )
    data = "".join(f'<script type="text/plain" class="play-data">{text}</script>' for text in plays.values())
    heads = "".join(f"<th>{text}</th>" for text in ("", "lower", "upper", "least rendered", "largest rendered"))
    return (
        f'<h2>Move the camera</h2><div id="play" hidden data-colors="{color_table()}"><div>'
        '<canvas id="play-picture" tabindex="0" width="1" height="1" aria-label="the picture; arrow keys move '
        'the pixel that is told about"></canvas><p id="play-caption" class="soft"></p></div><div>'
        f'<label{" hidden" if len(plays) == 1 else ""}>show <select id="play-frame">{options}</select></label>'
        f'<p class="choice">{shown}</p><div id="play-pose"><div id="play-sliders"></div><label><input type="checkbox" '
        'id="play-whole"> the whole set at once</label></div><p id="play-none" class="soft" hidden>Bounds of single '
        "poses are not in this page: they need <code>--save-cells</code>, and room.</p>"
        f'<p id="play-where" class="soft"></p><table><thead><tr>{heads}</tr></thead><tbody id="play-values"></tbody>'
        '</table><label id="play-axis-label" hidden>over <select id="play-axis"></select></label>'
        '<canvas id="play-curve" width="480" height="230" hidden aria-label="bounds of the pixel over one parameter; '
        'dots are renders"></canvas></div></div>'
        "<p>Lower and upper bound at the sliders' pose are those of the cell around it, which are linear in the "
        "parameters; numbers are rounded outward to the last digit shown. The render is the nearest one that was made.</p>"
        + data
    )


def counted(number_of: int, noun: str) -> str:
    """A number of things in words."""
    return f"{number_of:,} {noun}{'' if number_of == 1 else 's'}"


def _program(document: Mapping[str, Any]) -> str:
    renderer = document["renderer"]
    return " ".join(str(renderer[key]) for key in ("name", "version") if renderer.get(key))


def _verdict(document: Mapping[str, Any], name: str) -> str:
    asked, missing = len(document["frames_asked"]), len(document["missing"])
    bounded = asked - missing
    sampled = document["guarantee"] == "sampled"
    frames, of = document["frames"], document["scene"].get("bounded")
    if sampled:
        kind, title = "bad", f"No guarantee: rendered samples of {counted(asked, 'frame')}"
    elif not bounded:
        kind, title = "bad", f"No bounds yet: 0 of {counted(asked, 'frame')}"
    elif missing:
        kind, title = "fair", f"Bounds for {bounded} of {counted(asked, 'frame')}"
    else:
        kind, title = "good", f"Bounds for all {counted(asked, 'frame')}" if asked > 1 else "Bounds for the frame"
    lines = []
    if sampled:
        lines.append(
            f"The lower and upper images hold what {escape(_program(document))} showed of <b>{escape(name)}</b> at "
            "sampled camera poses. Other poses of the sets may show something else."
        )
    elif bounded:
        lines.append(
            f"For each of them: take any camera pose of the frame's set and render <b>{escape(name)}</b> with "
            f"{escape(_program(document))}. Every pixel{'' if of is None else f' {escape(of)}'} lies between the "
            "frame's lower and upper image."
        )
    sets = {_set(entry) for entry in frames}
    if len(sets) == 1:
        lines.append(f"The set of every frame: {escape(sets.pop())}, around its entry of the camera path.")
    elif sets:
        lines.append("The frames have different sets, which stand with each frame below.")
    lines.append(
        f"Guarantee <b>{escape(short_guarantee(document['guarantee'], of))}</b>: the abstract image "
        f"{escape(document['guarantee_text'])}."
    )
    lines += [escape(limit) for limit in document["limits"]]
    ratios = [entry["ratio"] for entry in frames if entry["ratio"] is not None and entry["status"] != "missing"]
    if ratios and not sampled:
        worst = max((entry for entry in frames if entry["ratio"] in ratios), key=lambda entry: entry["ratio"])
        lines.append(
            f"Tightness: the bounds are {number(median(ratios))} times as wide as what was really rendered"
            + (f" (median; at most {number(worst['ratio'])}, frame {worst['index']})." if len(ratios) > 1 else ".")
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
    return (
        f'<p class="soft">Abstract images of {escape(name)}</p><div class="verdict {kind}"><h1>{escape(title)}</h1>'
        + "".join(f"<p>{line}</p>" for line in lines)
        + "</div>"
    )


def uri(data: bytes) -> str:
    """A PNG as an address that needs no file."""
    return "data:image/png;base64," + base64.b64encode(data).decode()


def _set(entry: Mapping[str, Any]) -> str:
    sides = [interval(p["name"], p["unit"], p["lower"], p["upper"]) for p in entry["parameters"]]
    return " · ".join(sides) or "one camera pose"


def _frame(entry: Mapping[str, Any], pictures: Mapping[str, bytes], *, sampled: bool, opened: bool) -> str:
    captions = (
        ("lower", "lower image", "least values of the samples") if sampled else
        ("lower", "lower bound", "no image of the set is darker"),
        ("upper", "upper image", "largest values of the samples") if sampled else
        ("upper", "upper bound", "no image of the set is brighter"),
        ("gap", "gap", "length over RGB of upper − lower"),
        ("witness", "witness gap", "what rendering has shown, same scale"),
        ("image", "one render", "at the middle of the set"),
    )  # fmt: skip
    for name, figures in entry.get("layers", {}).items():
        mean = f"mean {number(figures['mean_gap'])}, {number(figures['ratio'])} times the renders'"
        captions += (
            (f"{name}_lower", f"{name}, lower", ""), (f"{name}_upper", f"{name}, upper", ""),
            (f"{name}_gap", f"{name}, upper − lower", mean), (f"{name}_image", f"{name}, one render", ""),
        )  # fmt: skip
    small = ' class="pixels"' if max(entry["height"], entry["width"]) <= 256 else ""
    images = "".join(
        f'<figure><img{small} src="{uri(pictures[key])}" alt="{label} of frame {entry["index"]}">'
        f"<figcaption><b>{label}</b><br>{text}</figcaption></figure>"
        for key, label, text in captions
    )
    stats = "".join(
        f'<div class="stat"><span>{label}</span><b>{number(entry[key])}</b><small>{text}</small></div>'
        for key, label, text in _STATS
    )
    warning = (
        '<p class="missing">No bound but [0, 1] is known: the time ended before this frame was done.</p>'
        if entry["status"] == "missing"
        else ""
    )
    plan = "".join(f"<li>{escape(line)}</li>" for line in entry["plan"])
    why = escape("\n".join(entry.get("explanation", ())))
    links = " · ".join(f'<a href="{escape(file)}">{escape(file)}</a>' for file in entry["files"].values())
    return (
        f'<details{" open" if opened else ""} id="frame{entry["index"]}"><summary>Frame {entry["index"]} '
        f'<span class="tag {entry["status"]}">{entry["status"]}</span><span class="soft">MPG {number(entry["mpg"])}, '
        f"ratio {number(entry['ratio'])}</span></summary>{warning}"
        f'<p class="soft">{escape(_set(entry))} · {entry["width"]} × {entry["height"]} pixels</p>'
        f'<div class="images">{images}</div>'
        f'<div class="scale">gap 0 <i style="background: linear-gradient(90deg, {_gradient()})"></i> '
        f"{number(entry['xpg'])}</div>"
        f'<div class="below"><div class="stats">{stats}</div>{_curve(entry)}</div>'
        + (f"<p>Left out for this frame:</p><ul>{plan}</ul>" if plan else "")
        + (f"<p>Why it is loose:</p><pre>{why}</pre>" if why else "")
        + f'<p class="soft">{links}</p></details>'
    )


def _gradient() -> str:
    from ns_abstract.report.picture import color_stops

    return ", ".join(color_stops())


class Axis:
    """One axis of a plot: data to SVG units, and where its ticks stand."""

    def __init__(self, low: float, high: float, start: float, end: float, *, log: bool) -> None:
        self.log, self.start, self.end = log, start, end
        if log:
            low, high = math.log10(low), math.log10(high)
            if high - low < 0.3:
                middle = 0.5 * (low + high)
                low, high = middle - 0.15, middle + 0.15
        elif high <= low:
            high = low + 1.0
        pad = 0.04 * (high - low) if log else 0.0
        self.low, self.high = low - pad, high + pad

    def __call__(self, value: float) -> float:
        value = math.log10(value) if self.log else value
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self) -> list[float]:
        if not self.log:
            span = self.high - self.low
            decade = 10.0 ** math.floor(math.log10(span))
            step = next(k * decade for k in (0.2, 0.5, 1.0, 2.0) if span / (k * decade) <= 6.0)
            first, last = math.ceil(self.low / step), math.floor(self.high / step)
            return [k * step for k in range(first, last + 1)]
        first, last = math.floor(self.low), math.ceil(self.high)
        every = max(1, math.ceil((last - first) / 6))
        for steps in ((1,), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
            found = [k * 10.0**e for e in range(first, last + 1, every) for k in steps]
            found = [v for v in found if v > 0.0 and self.low <= math.log10(v) <= self.high]
            if len(found) >= 3:
                break
        return found


def draw_plot(
    x: Axis | None, y: Axis, labels: tuple[str, str], marks: str, *, size: tuple[int, int], title: str,
) -> str:  # fmt: skip
    """An SVG with axes, ``marks`` above them; without ``x`` the marks bring their own labels."""
    width, height = size
    start, end = (x.start, x.end) if x else (52, width - 12)
    parts = []
    if x is not None:
        for value in x.ticks():
            at = x(value)
            parts.append(f'<line class="axis" x1="{at:.1f}" x2="{at:.1f}" y1="{y.start:.1f}" y2="{y.end:.1f}"/>')
            parts.append(f'<text x="{at:.1f}" y="{y.start + 15:.1f}" text-anchor="middle">{number(value, 3)}</text>')
    for value in y.ticks():
        at = y(value)
        parts.append(f'<line class="axis" x1="{start:.1f}" x2="{end:.1f}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{start - 6:.1f}" y="{at + 4:.1f}" text-anchor="end">{number(value, 3)}</text>')
    middle = 0.5 * (start + end)
    parts.append(f'<text x="{middle:.1f}" y="{height - 4}" text-anchor="middle">{labels[0]}</text>')
    parts.append(f'<text x="4" y="12">{labels[1]}</text>')
    return (
        f'<svg role="img" viewBox="0 0 {width} {height}" width="{width}" height="{height}">'
        f"<title>{title}</title>{''.join(parts)}{marks}</svg>"
    )


def draw_line(points: list[tuple[float, float]], kind: str, dots: bool, *, joined: bool = True) -> str:
    """A curve through points in SVG units, of a class of the style sheet; ``dots`` marks them."""
    path = ""
    if points and joined:
        path = f'<path class="{kind}" d="M' + "L".join(f"{a:.1f},{b:.1f}" for a, b in points) + '"/>'
    if dots:
        path += "".join(f'<circle class="{kind}" cx="{a:.1f}" cy="{b:.1f}" r="3"/>' for a, b in points)
    return path


def draw_legend(entries: Sequence[tuple[str, str]], right: float) -> str:
    """Labels of (class, text) from the right end on."""
    parts, x = [], right
    for kind, label in reversed(entries):
        parts.append(f'<text class="{kind}" x="{x:.1f}" y="12" text-anchor="end">{label}</text>')
        x -= 7.0 * len(label) + 12.0
    return "".join(parts)


def _stairs(points: Sequence[tuple[float, float]], end: float) -> list[tuple[float, float]]:
    """What is known between the points: a bound holds until a better one is there."""
    found: list[tuple[float, float]] = []
    stops = [*(start for start, _ in points[1:]), end]
    for (start, value), stop in zip(points, stops, strict=False):
        found += [(start, value), (stop, value)]
    return found


def _thinned(trace: Sequence[Mapping[str, float]]) -> list[Mapping[str, float]]:
    """Points after the first moment, some of many, the last one always."""
    stride = max(1, math.ceil(len(trace) / _CURVE_POINTS))
    kept = [point for k, point in enumerate(trace) if k % stride == 0 or k == len(trace) - 1]
    return [point for point in kept if point["seconds"] > 0.0]


def _curve(entry: Mapping[str, Any]) -> str:
    """Error against run time, both axes logarithmic; zero has no place on them and is left out."""
    kept = _thinned(entry["trace"])
    outer = [(point["seconds"], point["mpg"]) for point in kept if point["mpg"] > 0.0]
    inner = [(point["seconds"], point["mpg_witness"]) for point in kept if point["mpg_witness"] > 0.0]
    if not outer:
        return '<p class="soft">No progress over time was recorded for this frame.</p>'
    values = [value for _, value in outer + inner]
    end = max(t for t, _ in outer + inner)
    x = Axis(min(t for t, _ in outer + inner), end, 52, 408, log=True)
    y = Axis(min(values), max(values), 216, 26, log=True)
    upper = [(x(t), y(v)) for t, v in _stairs(outer, end)]
    lower = [(x(t), y(v)) for t, v in _stairs(inner, end)]
    band = ""
    if len(upper) > 2 and len(lower) > 2:
        band = '<path class="band" d="M' + "L".join(f"{a:.1f},{b:.1f}" for a, b in upper + lower[::-1]) + 'Z"/>'
    marks = band + draw_line(upper, "outer", False) + draw_line(lower, "inner", False)
    if len(kept) <= 25:
        marks += draw_line([(x(t), y(v)) for t, v in outer], "outer", True, joined=False)
        marks += draw_line([(x(t), y(v)) for t, v in inner], "inner", True, joined=False)
    marks += draw_legend((("outer", "bounds (MPG)"), ("inner", "witness MPG")), 408)
    labels = ("seconds of work (log)", "mean pixel gap (log)")
    plot = draw_plot(x, y, labels, marks, size=(420, 256), title="Mean pixel gap against run time")
    return f"<div>{plot}{_times(entry)}</div>"


def _times(entry: Mapping[str, Any]) -> str:
    """Seconds to each ratio."""
    reached = entry.get("seconds_to_ratio") or {}
    parts = [
        f"{mark} after {number(seconds, 3)} s" if seconds is not None else f"{mark} not reached"
        for mark, seconds in reached.items()
    ]
    return f'<p class="soft">Ratio {", ".join(parts)}.</p>' if parts else ""


def _path_curve(frames: Sequence[Mapping[str, Any]]) -> str:
    """Error against run time of the whole path: every frame on its own clock, and their mean."""
    traces = [kept for entry in frames if len(kept := _thinned(entry["trace"])) > 1]
    if len(traces) < 2:
        return ""
    times = sorted({point["seconds"] for trace in traces for point in trace})
    every = max(1, math.ceil(len(times) / _CURVE_POINTS))
    times = [*times[::every], times[-1]]

    def at(trace: Sequence[Mapping[str, float]], key: str, before: float) -> list[float]:
        found, position, value = [], 0, before
        for time in times:
            while position < len(trace) and trace[position]["seconds"] <= time:
                value = trace[position][key]
                position += 1
            found.append(value)
        return found

    end = times[-1]
    lines: dict[str, list[list[float]]] = {
        "outer": [at(trace, "mpg", math.sqrt(3.0)) for trace in traces],
        "inner": [at(trace, "mpg_witness", 0.0) for trace in traces],
    }
    positive = [v for found in lines.values() for values in found for v in values if v > 0.0]
    if not positive:
        return ""
    x, y = Axis(times[0], end, 52, 988, log=True), Axis(min(positive), max(positive), 236, 26, log=True)
    marks = ""
    for kind, found in lines.items():
        for values, strength in (*((values, " one") for values in found), (_means(found), "")):
            points = [(t, v) for t, v in zip(times, values, strict=True) if v > 0.0]
            if points:
                marks += draw_line([(x(t), y(v)) for t, v in _stairs(points, end)], f"{kind}{strength}", False)
    marks += draw_legend((("outer", "bounds (MPG)"), ("inner", "witness MPG")), 988)
    labels = ("seconds of work on each frame (log)", "mean pixel gap (log)")
    plot = draw_plot(x, y, labels, marks, size=(1000, 276), title="Mean pixel gap of the path against run time")
    rows = "".join(
        f"<li>ratio {mark:g}: {_reached(frames, f'{mark:g}')}</li>" for mark in MARKS if "seconds_to_ratio" in frames[0]
    )
    return (
        "<h2>Error against run time</h2><p>Thin lines are frames, each from its own beginning, the strong ones their "
        "mean. Until its set is covered once, a frame has nothing but [0, 1], a mean gap of √3.</p>"
        f"{plot}<ul>{rows}</ul>"
    )


def _means(lines: Sequence[Sequence[float]]) -> list[float]:
    return [sum(values) / len(values) for values in zip(*lines, strict=True)]


def _reached(frames: Sequence[Mapping[str, Any]], mark: str) -> str:
    found = [seconds for entry in frames if (seconds := entry["seconds_to_ratio"].get(mark)) is not None]
    if not found:
        return "no frame"
    return f"{len(found)} of {counted(len(frames), 'frame')}, after {number(median(found), 3)} s (median)"


def _overview(document: Mapping[str, Any]) -> str:
    """MPG along the path; nothing for a single frame."""
    frames = [entry for entry in document["frames"] if entry["status"] != "missing"]
    if len(frames) < 2:
        return ""
    sampled = document["guarantee"] == "sampled"
    x = Axis(-0.5, len(frames) - 0.5, 52, 988, log=False)
    y = Axis(0.0, 1.05 * max(entry["mpg"] for entry in frames), 176, 26, log=False)
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
    marks += draw_legend((("outer", "bounds (MPG)"), ("inner", "witness MPG")), 988)
    plot = draw_plot(
        None, y, ("frame", "mean pixel gap"), marks, size=(1000, 216), title="Mean pixel gap of every frame"
    )  # fmt: skip
    text = "Samples only: the true mean gaps may be larger." if sampled else "The true mean gap lies in the bar."
    return f"<h2>Along the path</h2><p>{text}</p>{plot}"


def _plan(document: Mapping[str, Any]) -> str:
    plan = "".join(f"<li>{escape(line)}</li>" for line in document["plan"])
    if not plan:
        return "<h2>What was left out</h2><p>Nothing: the whole scene was bounded.</p>"
    return f"<h2>What was left out, and why</h2><ul>{plan}</ul>"


def _table(document: Mapping[str, Any]) -> str:
    if not document["frames"]:
        return ""
    rows = []
    for entry in document["frames"]:
        cells = "".join(f"<td>{number(entry[key])}</td>" for key, _, _ in _STATS)
        links = " ".join(f'<a href="{escape(file)}">{escape(kind)}</a>' for kind, file in entry["files"].items())
        rows.append(
            f"<tr><td>{entry['index']}</td>{cells}"
            f'<td class="left {entry["status"]}">{entry["status"]}</td><td class="left">{links}</td></tr>'
        )
    head = "".join(f"<th>{label}</th>" for _, label, _ in _STATS)
    return (
        '<h2>All frames</h2><div class="wide"><table><thead><tr><th>frame</th>'
        f'{head}<th class="left">status</th><th class="left">files</th></tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _numbers(document: Mapping[str, Any]) -> str:
    terms = "".join(f"<dt>{escape(key)}</dt><dd>{escape(text)}</dd>" for key, text in document["metrics"].items())
    if document["guarantee"] == "sampled":
        text = "All figures are of images that were really rendered; what other poses of a set show is not known."
    else:
        text = (
            "The bounds enclose every image of the set, so their gap is at least the true one. Images that were really "
            "rendered (witnesses) give a gap that is at most the true one. The ratio of the two says how much the "
            "method can have lost."
        )
    return f"<h2>What the numbers mean</h2><p>{text}</p><dl>{terms}</dl>"


def _files(document: Mapping[str, Any]) -> str:
    whole = "least and largest samples" if document["guarantee"] == "sampled" else "enclose every image of the set"
    code = (
        'import numpy as np\nframe = np.load("frame_00000.npz")       # no pickles inside\n'
        'frame["lower"], frame["upper"]              # [H, W, 3] float32, '
        f"{whole}\n"
        'frame["witness_lower"], frame["witness_upper"]  # least and largest values really rendered\n'
        'frame["parameters"]                         # fields name, unit, lower, upper: the set\n'
        'frame["image"], str(frame["record"])        # one render; what was bounded, as JSON'
    )
    notes = [f"Not used: {escape(line)}" for line in document["ignored"]]
    others = document["other_files"]
    if others:
        names = ", ".join(others[:8]) + (", …" if len(others) > 8 else "")
        notes.append(f"Files of earlier commands in this folder, which this report does not describe: {escape(names)}")
    extra = f"<ul>{''.join(f'<li>{note}</li>' for note in notes)}</ul>" if notes else ""
    cells = (
        "<p>With <code>--save-cells</code> a frame file also holds its leaf cells, one row per (cell, tile): "
        "<code>box_lower</code>, <code>box_upper</code> [L, d], <code>tile</code> [L, 2] (first row, first column), "
        "<code>A_lower</code>, <code>A_upper</code> [L, s, s, 3, d], <code>b_lower</code>, <code>b_upper</code> "
        "[L, s, s, 3]. With the box scaled to p in [−1, 1]<sup>d</sup>, every pixel lies in [A_lower p + b_lower, "
        "A_upper p + b_upper].</p>"
    )
    return f"<h2>How to read the files</h2><pre>{escape(code)}</pre>{cells}{extra}"


def _assumptions(document: Mapping[str, Any]) -> str:
    rows = "".join(
        "<tr>" + "".join(f'<td class="left">{escape(entry[key])}</td>' for key in ("name", "value", "origin")) + "</tr>"
        for entry in document["assumptions"]
    )
    head = "".join(f'<th class="left">{title}</th>' for title in ("choice", "value", "where it came from"))
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
    return f'<h2>What this rests on</h2><div class="wide">{table}</div>' if rows else ""


def reproduce(document: Mapping[str, Any]) -> str:
    """Assumptions, command line, versions and fingerprints."""
    command = " ".join(shlex.quote(str(part)) for part in document["command"])
    rows = [("scene", document["scene"]), ("renderer", document["renderer"]), ("settings", document["settings"])]
    rows += [("packages", document["packages"]), ("fingerprint", document["fingerprint"])]
    table = "".join(
        f'<tr><td class="left">{escape(title)}</td><td class="left">{escape(key)}</td>'
        f'<td class="left">{escape(_text(value))}</td></tr>'
        for title, mapping in rows
        for key, value in mapping.items()
    )
    return (
        _assumptions(document)
        + "<h2>How to reproduce</h2>"
        + (f"<pre>{escape(command)}</pre>" if command else "")
        + f'<p class="soft">Started {escape(document["started"])}, this page written {escape(document["updated"])}.</p>'
        + f'<div class="wide"><table><tbody>{table}</tbody></table></div>'
    )


def _text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return ", ".join(f"{key}: {_text(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(map(_text, value))
    return str(value)
