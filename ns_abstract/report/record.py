"""Writes ``report.json`` and all other files of a result while frames are finished."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from ns_abstract.io.atomic import write_text
from ns_abstract.io.errors import InputError
from ns_abstract.io.folder import first_command, remove_parts, unwritable
from ns_abstract.io.jsonio import is_number, load_json
from ns_abstract.io.stamps import file_stamp
from ns_abstract.io.version import ADVISORY, stale
from ns_abstract.refine.result import FrameResult, TracePoint, merged
from ns_abstract.report.figures import ShownUnits, layer_metrics, metrics, seconds_to, short_guarantee
from ns_abstract.report.files import (
    StoredFrame,
    check_frame,
    frame_index,
    frame_name,
    layer_name,
    load_frame,
    save_frame,
)
from ns_abstract.report.picture import layer_figure, previews, save_figure, save_picture
from ns_abstract.report.run import CommandRun, differences, guarantee_text, plain, sides

Status = Literal["done", "partial", "missing"]
Outcome = Literal["done", "budget", "interrupted"]

_JSON_LIMIT = 2**30
# The page is written again when this much time has passed, or this many times what it takes.
_PAGE_SECONDS, _PAGE_SHARE = 10.0, 20.0
#: Longest side of a picture on a page.
PREVIEW_PIXELS = 256
#: Most frames that the page shows pictures of; its table has all.
PAGE_FRAMES = 60
#: Characters of the page that its numbers may take, all frames together, and most bytes of a frame file that is read
#: again for them.
_PLAY_CHARACTERS, _PLAY_FILE = 10_000_000, 512 << 20

METRICS = {
    "mpg": "mean over the pixels of the Euclidean norm over RGB of upper - lower",
    "xpg": "maximum over the pixels of the same norm",
    "mpg_witness": "mpg of the pixel-wise least and largest values that were really rendered",
    "xpg_witness": "xpg of the same",
    "ratio": "mpg / mpg_witness; null where that is no finite number; never below 1 for sound bounds",
    "seconds": "wall time spent on the frame",
    "seconds_to_ratio": "seconds after which mpg was at most so many times mpg_witness; null: never",
    "covered": "part of the set that the cells of a trace point cover; nothing but [0, 1] holds of a pixel below 1",
    "cells": "cells (boxes of parameters) bounded",
    "sha256": "of the npz files; a file that is another one is not continued with --resume, nor exported",
    "images": "RGB in [0, 1], so gaps lie in [0, sqrt(3)]",
}

_LIMITS = {
    "gsplat": "Weakest link: the bounds hold as far as the device follows gsplat's formulas within CUDA's documented "
    "errors, which were compared with exact results on one GPU (an H100). CUDA gsplat was run there, and nothing that "
    "it rendered was outside.",
    "paper": "Weakest link: Algorithm 1 is the paper's, not what Nerfstudio shows; use the gsplat renderer for that.",
}


def frame_digests(document: Any) -> dict[str, str]:
    """Return the SHA-256 digests of the frame files by name from a report.json; malformed entries are left out."""
    digests = document.get("sha256") if isinstance(document, dict) else None
    return {str(k): v for k, v in digests.items() if isinstance(v, str)} if isinstance(digests, dict) else {}


def explanations(document: Any) -> dict[int, tuple[str, ...]]:
    """Return the explanations of frames in a report.json, which others may have written."""
    frames = document.get("frames") if isinstance(document, dict) else None
    texts = {}
    for entry in frames if isinstance(frames, list) else ():
        if isinstance(entry, dict) and isinstance(entry.get("index"), int):
            lines = entry.get("explanation")
            if isinstance(lines, list) and all(isinstance(line, str) for line in lines):
                texts[entry["index"]] = tuple(lines)
    return texts


def failed_self_check(problem: str) -> str:
    """Return the condition on the guarantee after a failed self-check of a platform's arithmetic."""
    return f"The platform's arithmetic failed the self-check, so nothing is guaranteed: {problem}"


@dataclass(frozen=True, kw_only=True)
class RunRecord(CommandRun):
    """A command's run over ``frames``, the requested numbers of the camera path's entries.

    Of its ``settings``, ``target_ratio`` decides when a frame is done; with a true ``save_cells``, stored frames
    without leaf cells are computed again. ``size`` is height and width of the pictures; None: those of the stored
    frames. ``intrinsics`` are the pictures' `Intrinsics` by frame.
    """

    frames: tuple[int, ...]
    size: tuple[int, int] | None = None
    intrinsics: Mapping[int, Mapping[str, float]] = field(default_factory=dict)


class Report:
    """Writes a command's results as they come: ``frame_*.npz``, ``frame_*.png``, report.json, report.html.

    Every file is whole at all times; a frame is in report.json only after its file is on disk.

    Args:
        output_dir: Made if it is absent.
        keep_stored: Continue in the folder: stored frames with the same fingerprint are kept, requested or not.
            Truncated, damaged or foreign frame files are not used; see ``ignored``.

    Attributes:
        kept: Numbers of the frames kept from an earlier run.
        ignored: A sentence on each stored frame that was not kept, with the reason.

    Raises:
        InputError: The folder cannot be written, or its report, which is to be kept, has another fingerprint.
    """

    def __init__(self, output_dir: str | os.PathLike[str], run: RunRecord, *, keep_stored: bool = False) -> None:
        folder = self.folder = Path(output_dir)
        self.kept: list[int] = []
        self.ignored: list[str] = []
        self._entries: dict[int, dict[str, Any]] = {}
        self._before: dict[int, tuple[float, int, tuple[TracePoint, ...]]] = {}
        self._digests: dict[str, str] = {}
        self._previews: dict[int, Mapping[str, bytes]] = {}
        self._plays: dict[int, str | None] = {}
        self._undrawn: set[int] = set()
        self._explained: dict[int, tuple[str, ...]] = {}
        self._state = "running"
        self._page_due = 0.0
        self._describe(run)
        guarantee_text(run.guarantee)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            remove_parts(folder)
            self._present = sorted(path.name for kind in ("npz", "png") for path in folder.glob(f"frame_*.{kind}"))
        except OSError as error:
            raise unwritable(folder, error) from None
        self._first_command = first_command(self.folder) if keep_stored else None
        if keep_stored:
            self._keep()
        self._publish(page=True)

    def _describe(self, run: RunRecord) -> None:
        """Let report.json and the files of frames describe ``run`` from now on."""
        self.run = run
        self._about = plain(
            {
                "guarantee": run.guarantee,
                "renderer": run.renderer,
                "scene": run.scene,
                "fingerprint": run.fingerprint,
                "target_ratio": run.settings.get("target_ratio"),
            }
        )

    def _without_guarantee(self, problems: Sequence[str]) -> None:
        """Withdraw the guarantee of the whole report, as a process with a failed self-check bounded part of it."""
        limits = tuple(dict.fromkeys([*self.run.limits, *map(failed_self_check, problems)]))
        self._describe(replace(self.run, guarantee="sampled", limits=limits))

    def _keep(self) -> None:
        run, path = self.run, self.folder / "report.json"
        digests: dict[str, str] = {}
        explained: dict[int, tuple[str, ...]] = {}
        if path.exists():
            try:
                old = load_json(path, "report", limit=_JSON_LIMIT)
            except InputError as error:
                old = None
                self.ignored.append(f"report.json: {error.problem}")
            digests = frame_digests(old)
            explained = explanations(old)
            prints = old.get("fingerprint") if isinstance(old, dict) else None
            if isinstance(prints, dict):
                if problem := stale(prints, run.fingerprint):
                    raise InputError(
                        f"the results in this folder were {problem}",
                        file=path,
                        field="--resume",
                        fix=f"leave it out to bound all frames again; {ADVISORY}",
                    )
                changed = differences(prints, run.fingerprint)
                if changed:
                    raise InputError(
                        f"the results in this folder differ in {', '.join(changed[:4])}"
                        + (f" and {len(changed) - 4} more" if len(changed) > 4 else ""),
                        file=path,
                        field="fingerprint",
                        fix="give another --output-dir, or leave out --resume to start again",
                    )
        stored_before = (frame_index(self.folder / file) for file in self._present)
        for index in sorted({index for index in stored_before if index is not None}):
            path = self.folder / frame_name(index, "npz")
            try:
                stored = load_frame(path, leaves=False, size=run.size)
                digest = file_stamp(path)["sha256"]
            except InputError as error:
                self.ignored.append(f"{path.name}: {error.problem}")
                continue
            if digest == digests.get(path.name):
                self._digests[path.name] = digest
            prints = stored.about.get("fingerprint")
            prints = prints if isinstance(prints, dict) else {}
            if problem := stale(prints, run.fingerprint):
                self.ignored.append(f"{path.name}: {problem}")
            elif differences(prints, run.fingerprint):
                self.ignored.append(f"{path.name}: computed with other settings")
            elif stored.about.get("guarantee") != run.guarantee:
                # the settings say which guarantee is meant: this one lost it on a machine that failed the self-check
                self.ignored.append(f"{path.name}: has another guarantee, {stored.about.get('guarantee')}")
            elif path.name not in self._digests:
                self.ignored.append(f"{path.name}: not as report.json knows it, so it is computed again")
            elif run.settings.get("save_cells") and not stored.has_leaves:
                self.ignored.append(f"{path.name}: has no leaf cells")
            else:
                result = stored.result
                self._explained[index] = explained.get(index, ())
                self._entries[index] = self._entry(result, self._stored_status(stored))
                self._before[index] = result.seconds, result.cells, result.trace
                if not path.with_suffix(".png").exists():
                    self._undrawn.add(index)
                self.kept.append(index)

    def _stored_status(self, stored: StoredFrame) -> str:
        """Return a stored frame's status under the present target: a stricter one makes done frames partial."""
        if not stored.result.bounded:
            return "missing"
        before, now = stored.about.get("target_ratio"), self.run.settings.get("target_ratio")
        if stored.status == "done" and is_number(before) and is_number(now) and now >= before:
            return "done"
        return "done" if self._reached(stored.result) else "partial"

    def _reached(self, result: FrameResult) -> bool:
        """Return whether a frame reaches the target ratio."""
        target = self.run.settings.get("target_ratio")
        figures = metrics(result)
        if target is None or figures["mpg"] == 0.0 or not result.box.dimensions:
            return True
        return figures["ratio"] is not None and figures["ratio"] <= target

    @property
    def pending(self) -> list[int]:
        """Requested frames that are not done, in the order of the command."""
        return [k for k in self.run.frames if self._entries.get(k, {}).get("status") != "done"]

    @property
    def missing(self) -> list[int]:
        """Requested frames without any bound but [0, 1]."""
        return [k for k in self.run.frames if self._entries.get(k, {}).get("status", "missing") == "missing"]

    def explain(self, index: int, lines: Sequence[str]) -> None:
        """Write sentences on why the bounds of an added frame are loose.

        Raises:
            InputError: A file cannot be written.
        """
        self._explained[index] = tuple(lines)
        self._publish(page=time.monotonic() >= self._page_due)

    def add(self, result: FrameResult, status: Status | None = None, *, picture: bool = True) -> dict[str, Any]:
        """Write one frame and bring the report up to date; returns the frame's entry in report.json.

        May be called again as a frame gets tighter: ``seconds``, ``cells`` and ``trace`` are those of this command so
        far. Bounds are intersected with those on disk (`merged`), which holds for the frames of an earlier command too;
        its time and trace are put in front. ``status``: "done", or "partial" where the work ended before its target;
        decided by ``target_ratio`` if None. A frame without bounds is always "missing". ``picture``: whether to draw
        the PNG now; otherwise `draw` or `finish` does. Raises ValueError as `ns_abstract.report.files.check_frame`, so
        that nothing unsound is written, and InputError where a file cannot be written.
        """
        check_frame(result)
        if result.problems:
            self._without_guarantee(result.problems)
        index = result.index
        path = self.folder / frame_name(index, "npz")
        stored = self.stored(index)
        if stored is not None:
            seconds, cells, trace = self._before.get(index, (0.0, 0, ()))
            result = merged(replace(stored, seconds=seconds, cells=cells, trace=trace), result)
        if not result.bounded:
            status = "missing"
        elif status is None:
            status = "done" if self._reached(result) else "partial"
        try:
            save_frame(path, result, status=status, about=self._about)
            self._digests[path.name] = file_stamp(path)["sha256"]
            self._entries[index] = self._entry(result, status)
            self._previews.pop(index, None)
            self._plays[index] = self._played(result)
            self._undrawn.add(index)
            if picture:
                self._draw(result)
        except OSError as error:
            raise unwritable(self.folder, error) from None
        self._publish(page=time.monotonic() >= self._page_due)
        return self._entries[index]

    def stored(self, index: int) -> FrameResult | None:
        """Return a frame as this command, or a resumed earlier one, has stored it, without leaves.

        None: it is not stored, or its file has been changed since; it is then replaced.
        """
        path = self.folder / frame_name(index, "npz")
        if index in self._entries and path.exists() and file_stamp(path)["sha256"] == self._digests.get(path.name):
            return load_frame(path, leaves=False).result
        return None

    def draw(self, index: int) -> None:
        """Draw the PNG of an added frame, unless it exists. Raises InputError where it cannot be written."""
        try:
            if index in self._undrawn:
                self._draw(load_frame(self.folder / frame_name(index, "npz"), leaves=False).result)
        except OSError as error:
            raise unwritable(self.folder, error) from None

    def _draw(self, result: FrameResult) -> None:
        self._draw_files(result)
        self._previews[result.index] = self._small(result)
        self._undrawn.discard(result.index)

    def _draw_files(self, result: FrameResult) -> None:
        name = str(self.run.scene.get("name", ""))
        path = self.folder / frame_name(result.index, "png")
        guarantee = short_guarantee(self.run.guarantee, self.run.scene.get("bounded"))
        save_picture(path, result, guarantee=guarantee, about=name, units=ShownUnits.of(self.run.scene))
        for layer in result.layers:
            save_figure(self.folder / layer_name(result.index, layer), layer_figure(result, layer), 120)

    def _small(self, result: FrameResult) -> Mapping[str, bytes]:
        """Return PNGs of a frame for the page."""
        return previews(result, PREVIEW_PIXELS)

    def finish(self, outcome: Outcome) -> dict[str, Any]:
        """Write the last report.json and report.html.

        ``outcome``: "done", "budget" (the time ended first) or "interrupted" (by a signal or an error). Returns the
        content of report.json.
        """
        self._state = outcome
        # first what must not be lost
        self._publish(page=False)
        for index in sorted(self._undrawn):
            self.draw(index)
        self._publish(page=True)
        return self.document()

    def interrupted(self) -> None:
        """Mark the report as interrupted, without drawing anything."""
        self._state = "interrupted"
        self._publish(page=True)

    def _entry(self, result: FrameResult, status: str) -> dict[str, Any]:
        height, width = result.lower.shape[:2]
        return plain(
            {
                "index": result.index,
                **metrics(result),
                "seconds": result.seconds,
                "cells": result.cells,
                "trace": [vars(point) for point in result.trace],
                "seconds_to_ratio": {f"{mark:g}": seconds for mark, seconds in seconds_to(result.trace).items()},
                "status": status,
                "parameters": sides(result.box),
                "height": height,
                "width": width,
                "plan": result.plan,
                "files": {kind: frame_name(result.index, kind) for kind in ("npz", "png")}
                | {name: layer_name(result.index, name) for name in result.layers},
                **({"layers": layer_metrics(result)} if result.layers else {}),
            }
        )

    def document(self) -> dict[str, Any]:
        """Return the content of report.json (contract, version 1)."""
        run = self.run
        name = str(run.renderer.get("name", ""))
        beside = {"intrinsics": run.intrinsics, "explanation": self._explained}
        written = {file for entry in self._entries.values() for file in entry["files"].values()}
        return plain(
            run.head()
            | {
                "limits": [*([_LIMITS[name]] if name in _LIMITS else []), *run.limits],
                "frames": [
                    self._entries[k] | {name: value for name, about in beside.items() if (value := about.get(k))}
                    for k in sorted(self._entries)
                ],
                "frames_asked": run.frames,
                "missing": self.missing,
                # a run that was killed never gets to say so
                "interrupted": self._state in ("running", "interrupted"),
            }
            | run.tail(self._state, METRICS)
            | {
                **({"first_command": first} if (first := self._first_command) else {}),
                "sha256": self._digests,
                "kept": self.kept,
                "ignored": self.ignored,
                "other_files": [file for file in self._present if file not in written],
            }
        )

    def _publish(self, *, page: bool) -> None:
        document = self.document()
        try:
            text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
            write_text(self.folder / "report.json", f"{text}\n")
            if page:
                self._write_page(document)
        except OSError as error:
            raise unwritable(self.folder, error) from None

    def _write_page(self, document: dict[str, Any]) -> None:
        begin = time.monotonic()
        text = self._page(document)
        write_text(self.folder / "report.html", text)
        took = time.monotonic() - begin
        self._page_due = time.monotonic() + max(_PAGE_SECONDS, _PAGE_SHARE * took)

    def _page(self, document: dict[str, Any]) -> str:
        from ns_abstract.report.page import render_page, shown_frames

        pictures = {}
        for entry in shown_frames(document["frames"], PAGE_FRAMES):
            pictures[entry["index"]] = self._preview(entry["index"])
        plays = {index: play for index in pictures if (play := self._play(index)) is not None}
        return render_page(document, pictures, plays)

    def _played(self, result: FrameResult) -> str | None:
        from ns_abstract.report.play import play_data

        if not result.bounded:
            return None
        return play_data(result, _PLAY_CHARACTERS // max(1, min(len(self.run.frames), PAGE_FRAMES)))

    def _play(self, index: int) -> str | None:
        if index not in self._plays:
            path = self.folder / frame_name(index, "npz")
            small_enough = path.stat().st_size <= _PLAY_FILE
            self._plays[index] = self._played(load_frame(path, leaves=True).result) if small_enough else None
        return self._plays[index]

    def _preview(self, index: int) -> Mapping[str, bytes]:
        if index not in self._previews:
            result = load_frame(self.folder / frame_name(index, "npz"), leaves=False).result
            self._previews[index] = self._small(result)
        return self._previews[index]
