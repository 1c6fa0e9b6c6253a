"""Writes the result of a comparison of two scenes: files of frames, report.json, report.html."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ns_abstract.refine.result import FrameResult
from ns_abstract.report.figures import ShownUnits, number
from ns_abstract.report.files import StoredFrame, frame_name
from ns_abstract.report.html import counted, set_of, whole_page
from ns_abstract.report.picture import GAP_COLORS, color_stops, heat, panels_figure, preview, save_figure, to_bytes
from ns_abstract.report.record import PAGE_FRAMES, PREVIEW_PIXELS, Report, RunRecord

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: A frame is done where its largest bound is at most so much above what was rendered, whatever the ratio.
LEAST_ROOM = 1e-3
_FRAME_FIGURES = ("mpg", "xpg", "mpg_witness", "xpg_witness", "ratio", "seconds_to_ratio")
#: [H, W, 3] pictures of A and B of a frame at parameter values [d].
Pictures = Callable[[int, Sequence[float]], tuple[np.ndarray, np.ndarray]]

METRICS = {
    "largest_upper": "no picture of A differs from that of B at the same pose by more, at any pixel and channel",
    "largest_lower": "rendered pictures differ by as much",
    "mean_upper": "mean over pixels and channels of the bounds; pixels may reach them at different poses",
    "mean_lower": "the same of the largest differences rendered",
    "worst": "the pose of the largest difference that was rendered, and that difference",
    "verdict": "with --tolerance: certified (no picture differs by more), falsified (the worst pose does), unknown",
    "seconds": "wall time spent on the frame",
    "covered": "part of the set that was bounded at least once at a point of the trace; no bound but 1 holds below 1",
    "cells": "cells (boxes of parameters) bounded",
    "sha256": "of the npz files; a file that is another one is not continued with --resume",
    "images": "RGB in [0, 1], so differences lie in [0, 1]; 1/255 is 0.0039",
}


def difference_figures(result: FrameResult) -> dict[str, float]:
    """Return largest and mean values, over pixels and channels, of the bound and of rendered differences."""
    return {
        "largest_upper": float(result.upper.max()),
        "largest_lower": float(result.witness_upper.max()),
        "mean_upper": float(result.upper.mean(dtype=np.float64)),
        "mean_lower": float(result.witness_upper.mean(dtype=np.float64)),
    }


def verdict(result: FrameResult, tolerance: float, guarantee: str) -> str:
    """Return whether pictures differ by at most the tolerance: "certified", "falsified" or "unknown".

    "falsified" needs a stored pose whose rendered pictures differ by more, "certified" a guarantee.
    """
    if result.largest is not None and result.largest.value > tolerance:
        return "falsified"
    if guarantee != "sampled" and result.bounded and float(result.upper.max()) <= tolerance:
        return "certified"
    return "unknown"


def overall(verdicts: Sequence[str], complete: bool) -> str:
    """Return the verdict on all frames: "falsified" if any frame is; "certified" if all are."""
    if "falsified" in verdicts:
        return "falsified"
    return "certified" if complete and verdicts and set(verdicts) == {"certified"} else "unknown"


class ComparisonReport(Report):
    """Writes a comparison's results as they come; see `Report`.

    ``output_dir``: made if it is absent. ``tolerance``: largest allowed difference; None: no verdict. Raises InputError
    where the folder cannot be written, or holds other results that were to be kept.
    """

    def __init__(
        self,
        output_dir: str | os.PathLike[str],
        run: RunRecord,
        pictures: Pictures,
        tolerance: float | None,
        *,
        keep_stored: bool = False,
    ) -> None:
        self.pictures, self.tolerance = pictures, tolerance
        super().__init__(output_dir, run, keep_stored=keep_stored)

    def _reached(self, result: FrameResult) -> bool:
        if self.tolerance is not None:
            return verdict(result, self.tolerance, self.run.guarantee) != "unknown"
        figures, target = difference_figures(result), self.run.settings["target_ratio"]
        largest = figures["largest_lower"]
        return result.bounded and figures["largest_upper"] <= max(target * largest, largest + LEAST_ROOM)

    def _stored_status(self, stored: StoredFrame) -> str:
        """Return a stored frame's status under the present tolerance, whatever the earlier one was."""
        if not stored.result.bounded:
            return "missing"
        return "done" if self._reached(stored.result) else "partial"

    def _entry(self, result: FrameResult, status: str) -> dict[str, Any]:
        entry = super()._entry(result, status)
        for name in _FRAME_FIGURES:
            del entry[name]
        entry |= difference_figures(result)
        entry["trace"] = [
            {
                "seconds": p.seconds, "cells": p.cells, "largest_upper": p.mpg, "largest_lower": p.mpg_witness,
                "covered": p.covered,
            }
            for p in result.trace
        ]  # fmt: skip
        largest = result.largest
        entry["worst"] = None if largest is None else {"pose": list(largest.pose), "difference": largest.value}
        if self.tolerance is not None:
            entry["verdict"] = verdict(result, self.tolerance, self.run.guarantee)
        return entry

    def document(self) -> dict[str, Any]:
        document = super().document() | {"kind": "comparison", "metrics": METRICS, "tolerance": self.tolerance}
        frames = document["frames"]
        for name in ("largest_upper", "largest_lower"):
            document[name] = max((entry[name] for entry in frames), default=None)
        if self.tolerance is not None:
            indices = {entry["index"] for entry in frames}
            verdicts = [entry["verdict"] for entry in frames if entry["index"] in self.run.frames]
            document["verdict"] = overall(verdicts, indices >= set(self.run.frames))
        return document

    def _draw_files(self, result: FrameResult) -> None:
        figure = difference_figure(result, self._panels(result), str(self.run.scene.get("name", "")), self.tolerance)
        save_figure(self.folder / frame_name(result.index, "png"), figure, 120)

    def _panels(self, result: FrameResult) -> list[tuple[str, np.ndarray, bool]]:
        """Return title, picture [H, W, 3] or greatest difference over channels [H, W], and whether it is the latter."""
        assert result.largest is not None
        first, second = self.pictures(result.index, result.largest.pose)
        difference = np.abs(first.astype(np.float64) - second)
        return [
            ("A at the worst pose", first, False),
            ("B at the worst pose", second, False),
            ("difference there", difference.max(axis=-1), True),
            ("rendered, over all poses", result.witness_upper.max(axis=-1), True),
            ("upper bound, over all poses", result.upper.max(axis=-1), True),
        ]

    def _small(self, result: FrameResult) -> Mapping[str, bytes]:
        top = float(result.upper.max())
        return {
            title: preview(heat(image, top) if hot else to_bytes(image), PREVIEW_PIXELS)
            for title, image, hot in self._panels(result)
        }

    def _played(self, result: FrameResult) -> str | None:
        return None

    def _page(self, document: dict[str, Any]) -> str:
        frames = sorted(document["frames"], key=lambda entry: -entry["largest_upper"])[:PAGE_FRAMES]
        ordered = sorted(frames, key=lambda entry: entry["index"])
        return comparison_page(document, {entry["index"]: self._preview(entry["index"]) for entry in ordered})


def difference_figure(
    result: FrameResult, panels: Sequence[tuple[str, np.ndarray, bool]], about: str, tolerance: float | None
) -> Figure:
    """Return a frame's figure: both scenes at the worst pose, their difference, and the maps, on one colour scale."""
    top = float(result.upper.max()) or 1.0
    figures = difference_figures(result)
    text = (
        f"Frame {result.index}  ·  {about}  ·  largest difference between {number(figures['largest_lower'])} and "
        f"{number(figures['largest_upper'])}"
    )
    text = text if tolerance is None else f"{text}  ·  tolerance {number(tolerance)}"
    pictures = [
        (title, image, GAP_COLORS, top) if hot else (title, to_bytes(image), None, top) for title, image, hot in panels
    ]
    return panels_figure(pictures, text, bars=[len(panels) - 1])


_TITLES = {
    "certified": ("good", "No picture differs by more than the tolerance"),
    "falsified": ("bad", "Some picture differs by more than the tolerance"),
    "unknown": ("fair", "Undecided"),
}


def comparison_page(document: Mapping[str, Any], pictures: Mapping[int, Mapping[str, bytes]]) -> str:
    """Return the page of a comparison: HTML, self-contained, every text of the document escaped.

    Args:
        pictures: By number of the frames shown, PNGs by title.
    """
    frames, scene = document["frames"], document["scene"]
    other = Path(str(scene["other"].get("source", ""))).name
    units = ShownUnits.of(scene)
    kind, title = "good", "How far apart the pictures are"
    if document["tolerance"] is not None:
        kind, title = _TITLES[document["verdict"]]
    elif document["missing"]:
        kind = "fair"
    if document["guarantee"] == "sampled":
        kind, title = "bad", "No guarantee: rendered samples only"
    return whole_page(
        "comparison.html",
        title=f"Differences of {scene.get('name', 'scene')}",
        d=document,
        kind=kind,
        heading=title,
        counted=counted,
        other=other,
        sets=list({set_of(entry, units) or "one camera pose": None for entry in frames}),
        set_of=lambda entry: set_of(entry, units),
        shown=[entry for entry in frames if entry["index"] in pictures],
        pictures=pictures,
        gradient=", ".join(color_stops()),
        pose=_pose,
    )


def _pose(entry: Mapping[str, Any]) -> str:
    """Return the worst pose of a frame in words."""
    pairs = zip(entry["parameters"], entry["worst"]["pose"], strict=True)
    return ", ".join(f"{p['name']} {number(value, 6)} {p['unit']}".strip() for p, value in pairs) or "the only one"
