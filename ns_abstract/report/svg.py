"""Plots as SVG: axes, curves and legends, styled by CSS classes of the pages' style sheet."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from markupsafe import Markup, escape

from ns_abstract.report.figures import number


def draw_svg(width: float, height: float, title: str, marks: str, *, kind: str = "") -> Markup:
    """Return an SVG of ``marks``, which are SVG elements; the title is escaped."""
    named = f' class="{kind}"' if kind else ""
    size = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    return Markup(f'<svg{named} role="img" {size}><title>{escape(title)}</title>{marks}</svg>')


def through(points: Iterable[tuple[float, float]]) -> str:
    """Return the SVG path data of a polyline."""
    return "M" + "L".join(f"{a:.1f},{b:.1f}" for a, b in points)


class PlotAxis:
    """One axis of a plot: maps data to SVG units, and places ticks."""

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
            ticks = [k * 10.0**e for e in range(first, last + 1, every) for k in steps]
            ticks = [v for v in ticks if v > 0.0 and self.low <= math.log10(v) <= self.high]
            if len(ticks) >= 3:
                break
        return ticks


def draw_plot(
    x: PlotAxis | None, y: PlotAxis, labels: tuple[str, str], marks: str, *, size: tuple[int, int], title: str,
) -> Markup:  # fmt: skip
    """Return an SVG with axes below ``marks``; without ``x`` the marks bring their own labels."""
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
    parts.append(f'<text x="{middle:.1f}" y="{height - 4}" text-anchor="middle">{escape(labels[0])}</text>')
    parts.append(f'<text x="4" y="12">{escape(labels[1])}</text>')
    return draw_svg(width, height, title, "".join(parts) + marks)


def draw_line(points: list[tuple[float, float]], kind: str, dots: bool, *, joined: bool = True) -> str:
    """Return a polyline in SVG units with a CSS class ``kind``; ``dots`` marks its points."""
    path = ""
    if points and joined:
        path = f'<path class="{kind}" d="{through(points)}"/>'
    if dots:
        path += "".join(f'<circle class="{kind}" cx="{a:.1f}" cy="{b:.1f}" r="3"/>' for a, b in points)
    return path


def draw_legend(entries: Sequence[tuple[str, str]], right: float) -> str:
    """Return labels, given as (CSS class, text), aligned to the right end."""
    parts, x = [], right
    for kind, label in reversed(entries):
        parts.append(f'<text class="{kind}" x="{x:.1f}" y="12" text-anchor="end">{label}</text>')
        x -= 7.0 * len(label) + 12.0
    return "".join(parts)


def stairs(points: Sequence[tuple[float, float]], end: float) -> list[tuple[float, float]]:
    """Return the step function that keeps each value until the next point, up to ``end``."""
    corners: list[tuple[float, float]] = []
    stops = [*(start for start, _ in points[1:]), end]
    for (start, value), stop in zip(points, stops, strict=False):
        corners += [(start, value), (stop, value)]
    return corners
