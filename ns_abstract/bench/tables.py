"""Writes rows of figures as a table on the terminal, as CSV and as Markdown."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ns_abstract.refine.result import FrameResult


def text(value: Any) -> str:
    """Return a figure with four digits, a count with separators, a dash for None."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table of rows with equal keys."""
    names = list(rows[0])
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(text(row[name]) for name in names) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def write(rows: Sequence[dict[str, Any]], folder: Path, name: str, title: str) -> None:
    """Write ``NAME.csv`` and ``NAME.md`` to ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / f"{name}.csv", "w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    (folder / f"{name}.md").write_text(f"# {title}\n\n{markdown(rows)}")


@dataclass
class Table:
    """A table that grows: every row is printed and written to the files at once.

    Attributes:
        folder, name, title: See `write`.
    """

    folder: Path
    name: str
    title: str
    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(self, *rows: dict[str, Any]) -> None:
        """Print and write more rows."""
        lines = markdown(rows).splitlines()
        print("\n".join(lines[2 if self.rows else 0 :]), flush=True)
        self.rows += rows
        write(self.rows, self.folder, self.name, self.title)


def save_curves(path: Path, results: Mapping[str, FrameResult]) -> None:
    """Plot ratio - 1 against seconds (log-log) at the left; bounds' (solid) and witness (dashed) MPG at the right."""
    figure, left, right = _two_panels()
    for label, result in results.items():
        points = [p for p in result.trace if p.mpg_witness > 0.0 and p.seconds > 0.0]
        seconds = [p.seconds for p in points]
        (line,) = left.loglog(seconds, [max(p.mpg / p.mpg_witness - 1.0, 1e-6) for p in points], label=label)
        right.semilogx(seconds, [p.mpg for p in points], color=line.get_color(), label=label)
        right.semilogx(seconds, [p.mpg_witness for p in points], color=line.get_color(), linestyle="--")
    left.set(xlabel="seconds", ylabel="MPG / witness MPG - 1")
    right.set(xlabel="seconds", ylabel="MPG (dashed: witness)")
    _finish(left, right)
    figure.savefig(path, dpi=130)


def plot_scaling(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Left: nanoseconds by Gaussian-pixel pair against Gaussians, by size of the picture. Right: peak memory."""
    figure, left, right = _two_panels()
    for size in dict.fromkeys(row["size"] for row in rows):
        same_size = [row for row in rows if row["size"] == size]
        counts = [row["Gaussians"] for row in same_size]
        (line,) = left.loglog(counts, [row["cell ns / pair"] for row in same_size], marker="o", label=f"{size}, cell")
        left.loglog(counts, [row["render ns / pair"] for row in same_size], color=line.get_color(), linestyle="--")
        right.semilogx(counts, [row["peak GiB"] for row in same_size], marker="o", color=line.get_color(), label=size)
    left.set(xlabel="Gaussians", ylabel="ns by Gaussian and pixel (dashed: concrete render)")
    right.set(xlabel="Gaussians", ylabel="peak memory of the process, GiB")
    _finish(left, right)
    figure.savefig(path, dpi=130)


def _two_panels() -> Any:
    """Return a figure and its two axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, *figure.subplots(1, 2)


def _finish(*panels: Any) -> None:
    for axes in panels:
        axes.grid(True, which="both", alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend(fontsize=8)
