"""The picture of error against run time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ns_abstract.refine.result import FrameResult


def save_curves(path: Path, results: Mapping[str, FrameResult]) -> None:
    """Left: ratio - 1 against seconds, log-log. Right: outer (solid) and witness (dashed) MPG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for label, result in results.items():
        points = [p for p in result.trace if p.mpg_witness > 0.0 and p.seconds > 0.0]
        seconds = [p.seconds for p in points]
        (line,) = left.loglog(seconds, [max(p.mpg / p.mpg_witness - 1.0, 1e-6) for p in points], label=label)
        right.semilogx(seconds, [p.mpg for p in points], color=line.get_color(), label=label)
        right.semilogx(seconds, [p.mpg_witness for p in points], color=line.get_color(), linestyle="--")
    left.set(xlabel="seconds", ylabel="MPG / witness MPG - 1")
    right.set(xlabel="seconds", ylabel="MPG (dashed: witness)")
    for axes in (left, right):
        axes.grid(True, which="both", alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    left.legend(fontsize=8)
    figure.savefig(path, dpi=130)
