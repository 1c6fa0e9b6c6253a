"""Verdicts as SVG files, drawn as on the page: ``verdicts_00000.svg`` by frame, ``cameras.svg``."""

from __future__ import annotations

import re
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape

from ns_abstract.io.atomic import write_text
from ns_abstract.io.folder import unwritable
from ns_abstract.report.cameras import CameraDrawings
from ns_abstract.report.certificate_page import along_path, verdict_drawings
from ns_abstract.report.figures import ShownUnits, percent
from ns_abstract.report.verdict_maps import BAD, GOOD, OPEN, free_parameters, maps_of, matrix_svg

CellRows = Sequence[Mapping[str, Any]]
#: Frames with a picture; height of the title, and of a line of the legend.
MOST, _TITLE, _LEGEND = 8, 26, 24
_NAMES = re.compile(r"verdicts_(\d{5,}|path)\.(svg|png)|cameras\.(svg|png)")
_COLORS = {
    kind: "#{:02x}{:02x}{:02x}".format(*color)
    for kind, color in (("certified", GOOD), ("falsified", BAD), ("unknown", OPEN))
}
#: Without the page's variables, which programs other than browsers do not know.
_STYLE = (
    "".join(f".{k}{{fill:{c}}} .ring .{k},.frusta .{k}{{stroke:{c}}} " for k, c in _COLORS.items())
    + "text{font:11px sans-serif;fill:#5c6066} .axis{stroke:#dcdcd6} .frame{fill:none;stroke:#dcdcd6} "
    ".broken{stroke:#1c1d20;stroke-width:1.2;fill:none} .halo{stroke:#fff;stroke-width:3.2;fill:none} "
    ".ring path{stroke-width:.5} .frusta path{fill-opacity:.45;stroke-width:1} image.pixels{image-rendering:pixelated}"
)


def _size(plot: str) -> tuple[float, float]:
    size = re.search(r'width="([\d.]+)" height="([\d.]+)"', plot)
    assert size is not None
    return float(size.group(1)), float(size.group(2))


def standalone(plots: Sequence[Markup], text: str, covered: Mapping[str, float]) -> str:
    """Return an SVG file of plots below each other, with a title and a legend of the verdicts' fractions."""
    sizes = [_size(plot) for plot in plots]
    width = max(480.0, *(w for w, _ in sizes))
    marks, y = [], float(_TITLE)
    for plot, (_, height) in zip(plots, sizes, strict=True):
        marks.append(str(plot).replace("<svg", f'<svg y="{y:g}"', 1))
        y += height
    for k, kind in enumerate(_COLORS):
        at = 12 + 156 * k
        marks.append(f'<rect class="{kind}" x="{at}" y="{y + 7:g}" width="10" height="10"/>')
        marks.append(f'<text x="{at + 15}" y="{y + 16:g}">{kind} {escape(percent(covered[kind]))}</text>')
    height = y + _LEGEND
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
        f'height="{height:g}"><style>{_STYLE}</style><rect width="100%" height="100%" fill="white"/>'
        f'<text x="12" y="17">{escape(text)}</text>{"".join(marks)}</svg>\n'
    )


def _frame(entry: Mapping[str, Any], rows: CellRows) -> str | None:
    """Return the drawing of the verdicts over a frame's set; None for a single pose."""
    free = free_parameters(entry["parameters"])
    if not free or not rows:
        return None
    text = f"frame {entry['index']}"
    if len(free) > 2:
        plot = matrix_svg(maps_of(rows, entry), [entry["parameters"][k] for k in free])
        text += ": below the diagonal certified, above it falsified"
    else:
        ((plot, *_),), _ = verdict_drawings([entry], {entry["index"]: rows}, {})
    return standalone([plot], text, entry["coverage"])


def clear_pictures(folder: Path) -> None:
    """Remove the pictures of an earlier command: they would contradict report.json."""
    for file in list(folder.iterdir()):
        if _NAMES.fullmatch(file.name) and stat.S_ISREG(file.lstat().st_mode):
            file.unlink(missing_ok=True)


def write_pictures(
    folder: Path, document: Mapping[str, Any], rows: Mapping[int, CellRows], cameras: CameraDrawings | None
) -> list[str]:
    """Write the pictures of a certificate, each whole or not at all, and return their names.

    Raises:
        InputError: The folder cannot be written.
    """
    entries, covered = document["frames"], document["coverage"]
    files: dict[str, str | None] = {}
    if way := along_path(entries):
        _, ((plot, _),) = verdict_drawings(way, rows, {})
        files["verdicts_path"] = standalone([plot], "from keyframe to keyframe", covered)
    else:
        units = ShownUnits.of(document["scene"])
        for entry in entries[:MOST]:
            name = f"verdicts_{entry['index']:05d}"
            files[name] = _frame(*units.drawn(entry, rows.get(entry["index"], ())))
    if cameras is not None and cameras.cells:
        files["cameras"] = standalone([plot for plot, *_ in cameras.plots({})], "cameras of cells", covered)
    written = []
    for name, text in files.items():
        if text is None:
            continue
        try:
            write_text(folder / f"{name}.svg", text)
        except OSError as error:
            raise unwritable(folder, error) from None
        written.append(f"{name}.svg")
    return written
