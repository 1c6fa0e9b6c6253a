"""``report.json``, and everything else that is written while frames are finished."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import math
import os
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError
from ns_abstract.io.folder import first_command, remove_parts, unwritable
from ns_abstract.io.jsonio import file_size, is_number, load_json
from ns_abstract.io.version import ADVISORY, stale
from ns_abstract.io.version import VERSION as PACKAGE
from ns_abstract.refine.result import ExtraOutput, FrameResult, TracePoint, greater
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

VERSION = 1

Status = Literal["done", "partial", "missing"]
Outcome = Literal["done", "budget", "interrupted"]

_JSON_LIMIT = 2**30
# The page is written again when this much time has passed, or this many times what it takes.
_PAGE_SECONDS, _PAGE_SHARE = 10.0, 20.0
_PREVIEW_PIXELS = 256
#: Most frames that the page shows pictures of; its table has all.
PAGE_FRAMES = 60
#: Characters of the page that its numbers may take, all frames together, and most bytes of a frame file that is read
#: again for them.
_PLAY_CHARACTERS, _PLAY_FILE = 10_000_000, 512 << 20
_CHUNK = 2**20

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

_PROGRAMS = {"gsplat": "gsplat's formulas give", "paper": "the paper's Algorithm 1 gives"}
_LIMITS = {
    "gsplat": "Weakest link: the bounds hold as far as the device follows gsplat's formulas within CUDA's documented "
    "errors, which were compared with exact results on one GPU (an H100). CUDA gsplat was run there, and nothing that "
    "it rendered was outside.",
    "paper": "Weakest link: Algorithm 1 is the paper's, not what Nerfstudio shows; use the gsplat renderer for that.",
}


def guarantee_text(guarantee: str, renderer: str = "gsplat", bounded: str | None = None) -> str:
    """Return the text of a guarantee, as the end of a sentence about an abstract image.

    Args:
        guarantee: "float32-sound", "real-sound" or "sampled".
        renderer: Name of the bounded renderer.
        bounded: What of the scene is bounded, such as "of the Gaussians alone"; None: all of it.

    Raises:
        ValueError: The guarantee is not one of the three.
    """
    program = _PROGRAMS.get(renderer, f"{renderer} gives")
    texts = {
        "float32-sound": f"encloses the image that {program} in real numbers and in every float32 evaluation "
        "with CUDA fast-math error constants",
        "real-sound": "encloses the real-number renderer and this package's float64 evaluation",
        "sampled": "is not a guarantee: it holds only the images that were rendered",
    }
    if guarantee not in texts:
        raise ValueError(f"guarantee {guarantee!r} is not one of {', '.join(texts)}")
    if bounded is None or guarantee == "sampled":
        return texts[guarantee]
    return f"{texts[guarantee]}, {bounded}: the run's model may draw more, of which nothing is said"


def plain(value: Any) -> Any:
    """``value`` as strict JSON: tuples and arrays as lists, paths as text, no NaN or infinity (null).

    Raises:
        TypeError: A value has no JSON form.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (np.generic, np.ndarray)):
        return plain(value.tolist())
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def file_stamp(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Identity of a file by content: ``name``, ``bytes`` and ``sha256``; a moved file keeps it.

    Raises:
        InputError: The file is absent or cannot be read.
    """
    path = Path(path)
    size = file_size(path, "file")
    digest = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            while chunk := stream.read(_CHUNK):
                digest.update(chunk)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=path, fix="check the permissions") from None
    return {"name": path.name, "bytes": size, "sha256": digest.hexdigest()}


def frame_digests(document: Any) -> dict[str, str]:
    """SHA-256 of the frame files by name, as report.json has them; what is damaged is left out."""
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


def versions() -> dict[str, str | None]:
    """Versions of what computed the bounds; None where a package has no metadata."""
    versions_found: dict[str, str | None] = {"python": platform.python_version(), "machine": platform.machine()}
    versions_found["ns-abstract"] = PACKAGE
    for name in ("numpy", "numba"):
        try:
            versions_found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions_found[name] = None
    return versions_found


def failed_self_check(problem: str) -> str:
    """The condition on the guarantee that a problem of a platform's arithmetic makes."""
    return f"The platform's arithmetic failed the self-check, so nothing is guaranteed: {problem}"


@dataclass(frozen=True)
class RunRecord:
    """The record of a command's run; all mappings must have a JSON form (see `plain`).

    Attributes:
        guarantee: "float32-sound", "real-sound" or "sampled".
        renderer: ``name`` and ``version`` of the bounded program.
        scene: ``name``, and whatever describes the scene (source, number of Gaussians, ...).
        frames: Numbers of the camera path's entries that were asked for.
        fingerprint: Whatever changes the set of images: scene file (`file_stamp`), camera path,
            perturbation, renderer, arithmetic, downscale factor. Results are mixed only where it is
            the same. Effort (time budget, target ratio, seed) does not belong here.
        settings: The command's options; ``target_ratio`` decides when a frame is done, and with a true
            ``save_cells`` stored frames without leaf cells are computed again.
        plan: What was left out for this scene and why, one sentence each.
        command: The command line.
        limits: Further conditions on the guarantee, one sentence each.
        size: Height and width of the pictures; None: any that stored frames have.
        assumptions: What the bounds rest on, and where each choice came from.
        intrinsics: By frame the pictures' `Intrinsics`.
    """

    guarantee: str
    renderer: Mapping[str, str]
    scene: Mapping[str, Any]
    frames: tuple[int, ...]
    fingerprint: Mapping[str, Any]
    settings: Mapping[str, Any]
    plan: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    limits: tuple[str, ...] = ()
    size: tuple[int, int] | None = None
    assumptions: tuple[Assumption, ...] = ()
    intrinsics: Mapping[int, Mapping[str, float]] = field(default_factory=dict)


def _leaves_of(value: Any, path: str = "") -> dict[str, Any]:
    """Dotted paths and values of a JSON tree."""
    if isinstance(value, dict) and (value or not path):
        leaves: dict[str, Any] = {}
        for key, item in value.items():
            leaves |= _leaves_of(item, f"{path}.{key}" if path else str(key))
        return leaves
    return {path: value}


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Dotted paths where two JSON trees differ."""
    first, second = _leaves_of(plain(old)), _leaves_of(plain(new))
    absent = object()
    return [key for key in {**first, **second} if first.get(key, absent) != second.get(key, absent)]


def merged(older: FrameResult, newer: FrameResult) -> FrameResult:
    """Return the intersection of two results for one frame; both enclose the set, so it does.

    Times and cells add up; the trace of ``newer`` follows that of ``older`` and never gets worse.

    Raises:
        ValueError: The two are of different frames, boxes or sizes.
    """
    same = [(r.index, r.box, r.lower.shape, sorted(r.layers)) for r in (older, newer)]
    if same[0] != same[1]:
        raise ValueError(f"frame {newer.index}: the stored result is of another set of images")
    outer = min((point.mpg for point in older.trace), default=math.inf)
    inner = max((point.mpg_witness for point in older.trace), default=0.0)
    covered = max((point.covered for point in older.trace), default=0.0)
    later = tuple(
        TracePoint(
            older.seconds + point.seconds,
            older.cells + point.cells,
            min(outer, point.mpg),
            max(inner, point.mpg_witness),
            max(covered, point.covered),
        )
        for point in newer.trace
    )
    return replace(
        newer,
        lower=np.maximum(older.lower, newer.lower),
        upper=np.minimum(older.upper, newer.upper),
        witness_lower=np.minimum(older.witness_lower, newer.witness_lower),
        witness_upper=np.maximum(older.witness_upper, newer.witness_upper),
        seconds=older.seconds + newer.seconds,
        cells=older.cells + newer.cells,
        trace=older.trace + later,
        bounded=older.bounded or newer.bounded,
        layers={name: _merged_layer(older.layers[name], layer) for name, layer in newer.layers.items()},
        largest=greater(older.largest, newer.largest),
    )


def _merged_layer(older: ExtraOutput, newer: ExtraOutput) -> ExtraOutput:
    return ExtraOutput(
        np.maximum(older.lower, newer.lower),
        np.minimum(older.upper, newer.upper),
        np.minimum(older.witness_lower, newer.witness_lower),
        np.maximum(older.witness_upper, newer.witness_upper),
        newer.image,
    )


class Report:
    """Writes a command's results as they come: ``frame_*.npz``, ``frame_*.png``, report.json, report.html.

    Every file is whole at all times; a frame stands in report.json only after its file is on disk.

    Args:
        output_dir: Made if it is absent.
        run: What is computed.
        keep_stored: See `resume`.

    Attributes:
        kept: Numbers of the frames taken over from an earlier run.
        ignored: Stored frames that were not, with the reason, one sentence each.

    Raises:
        InputError: The folder cannot be written.
    """

    def __init__(self, output_dir: str | os.PathLike[str], run: RunRecord, *, keep_stored: bool = False) -> None:
        self._start(Path(output_dir), run)
        self._first_command = first_command(self.folder) if keep_stored else None
        if keep_stored:
            self._keep()
        self._publish(page=True)

    @classmethod
    def resume(cls, output_dir: str | os.PathLike[str], run: RunRecord) -> Report:
        """Continue in a folder: frames stored with the same fingerprint are kept, asked for or not.

        A folder without results starts afresh. Truncated, damaged or foreign frame files are not used;
        see ``ignored``.

        Raises:
            InputError: The folder's report has another fingerprint, or the folder cannot be written.
        """
        return cls(output_dir, run, keep_stored=True)

    def _start(self, folder: Path, run: RunRecord) -> None:
        self.folder, self.run = folder, run
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
        self._started = _now()
        self._page_due = 0.0
        self._packages = versions()
        self._describe(run)
        guarantee_text(run.guarantee)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            remove_parts(folder)
            self._found = sorted(path.name for kind in ("npz", "png") for path in folder.glob(f"frame_*.{kind}"))
        except OSError as error:
            raise unwritable(folder, error) from None

    def _describe(self, run: RunRecord) -> None:
        """Take ``run`` for what report.json and the files of frames say from now on."""
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
        """Say of the whole report that a process whose self-check failed bounded some of it."""
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
        stored_before = (frame_index(self.folder / file) for file in self._found)
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
        """Status under the present target: a stricter one re-opens frames that were done."""
        if not stored.result.bounded:
            return "missing"
        before, now = stored.about.get("target_ratio"), self.run.settings.get("target_ratio")
        if stored.status == "done" and is_number(before) and is_number(now) and now >= before:
            return "done"
        return "done" if self._reached(stored.result) else "partial"

    def _reached(self, result: FrameResult) -> bool:
        """Whether a frame is as tight as was asked for."""
        target = self.run.settings.get("target_ratio")
        figures = metrics(result)
        if target is None or figures["mpg"] == 0.0 or not result.box.dimensions:
            return True
        return figures["ratio"] is not None and figures["ratio"] <= target

    @property
    def pending(self) -> list[int]:
        """Frames asked for that are not done, in the order of the command."""
        return [k for k in self.run.frames if self._entries.get(k, {}).get("status") != "done"]

    @property
    def missing(self) -> list[int]:
        """Frames asked for of which no bound but [0, 1] is known."""
        return [k for k in self.run.frames if self._entries.get(k, {}).get("status", "missing") == "missing"]

    def explain(self, index: int, lines: Sequence[str]) -> None:
        """Say in words why the bounds of a frame that was added are loose.

        Raises:
            InputError: A file cannot be written.
        """
        self._explained[index] = tuple(lines)
        self._publish(page=time.monotonic() >= self._page_due)

    def add(self, result: FrameResult, status: Status | None = None, *, picture: bool = True) -> dict[str, Any]:
        """Write one frame and bring the report up to date.

        May be called again as a frame gets tighter: ``seconds``, ``cells`` and ``trace`` are those of
        this command so far. Bounds are intersected with those on disk (`merged`), which holds for the
        frames of an earlier command too; its time and trace are put in front.

        Args:
            result: The frame.
            status: "done", or "partial" where the work ended before its target; decided by
                ``target_ratio`` if None. A frame without bounds is always "missing".
            picture: Whether to draw the PNG now; otherwise `draw` or `finish` does.

        Returns:
            The frame's entry in report.json.

        Raises:
            ValueError: As `ns_abstract.report.files.check_frame`: nothing unsound is written.
            InputError: A file cannot be written.
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
        """A frame as this command or, if it is resumed, an earlier one has stored it, without leaves.

        None: there is none, or others have changed its file since, which is then replaced.
        """
        path = self.folder / frame_name(index, "npz")
        if index in self._entries and path.exists() and file_stamp(path)["sha256"] == self._digests.get(path.name):
            return load_frame(path, leaves=False).result
        return None

    def draw(self, index: int) -> None:
        """Draw the PNG of a frame that was added, unless it is drawn.

        Raises:
            InputError: A file cannot be written.
        """
        try:
            if index in self._undrawn:
                self._draw(load_frame(self.folder / frame_name(index, "npz"), leaves=False).result)
        except OSError as error:
            raise unwritable(self.folder, error) from None

    def _draw(self, result: FrameResult) -> None:
        from ns_abstract.report.picture import previews, save_layer_picture, save_picture

        name = str(self.run.scene.get("name", ""))
        path = self.folder / frame_name(result.index, "png")
        guarantee = short_guarantee(self.run.guarantee, self.run.scene.get("bounded"))
        save_picture(path, result, guarantee=guarantee, about=name, units=ShownUnits.of(self.run.scene))
        for layer in result.layers:
            save_layer_picture(self.folder / layer_name(result.index, layer), result, layer)
        self._previews[result.index] = previews(result, _PREVIEW_PIXELS)
        self._undrawn.discard(result.index)

    def finish(self, outcome: Outcome) -> dict[str, Any]:
        """Write the last report.json and report.html.

        Args:
            outcome: "done", "budget" (the time ended first) or "interrupted" (by a signal).

        Returns:
            The content of report.json.
        """
        self._state = outcome
        # first what must not be lost
        self._publish(page=False)
        for index in sorted(self._undrawn):
            self.draw(index)
        self._publish(page=True)
        return self.document()

    def interrupted(self) -> None:
        """Say that the work was ended where it was; nothing is drawn."""
        self._state = "interrupted"
        self._publish(page=True)

    def _entry(self, result: FrameResult, status: str) -> dict[str, Any]:
        height, width = result.lower.shape[:2]
        box = result.box
        return plain(
            {
                "index": result.index,
                **metrics(result),
                "seconds": result.seconds,
                "cells": result.cells,
                "trace": [
                    {
                        "seconds": p.seconds,
                        "cells": p.cells,
                        "mpg": p.mpg,
                        "mpg_witness": p.mpg_witness,
                        "covered": p.covered,
                    }
                    for p in result.trace
                ],
                "seconds_to_ratio": {f"{mark:g}": seconds for mark, seconds in seconds_to(result.trace).items()},
                "status": status,
                "parameters": [
                    {"name": name, "unit": unit, "lower": low, "upper": high}
                    for name, unit, low, high in zip(box.names, box.units, box.lower, box.upper, strict=True)
                ],
                "height": height,
                "width": width,
                "plan": result.plan,
                "files": {kind: frame_name(result.index, kind) for kind in ("npz", "png")}
                | {name: layer_name(result.index, name) for name in result.layers},
                **({"layers": layer_metrics(result)} if result.layers else {}),
            }
        )

    def document(self) -> dict[str, Any]:
        """The content of report.json (contract, version 1)."""
        run = self.run
        name = str(run.renderer.get("name", ""))
        beside = {"intrinsics": run.intrinsics, "explanation": self._explained}
        written = {file for entry in self._entries.values() for file in entry["files"].values()}
        return plain(
            {
                "version": VERSION,
                "guarantee": run.guarantee,
                "guarantee_text": guarantee_text(run.guarantee, name, run.scene.get("bounded")),
                "limits": [*([_LIMITS[name]] if name in _LIMITS else []), *run.limits],
                "renderer": run.renderer,
                "scene": run.scene,
                "assumptions": [vars(entry) for entry in run.assumptions],
                "plan": run.plan,
                "frames": [
                    self._entries[k] | {name: value for name, about in beside.items() if (value := about.get(k))}
                    for k in sorted(self._entries)
                ],
                "frames_asked": run.frames,
                "missing": self.missing,
                # a run that was killed never gets to say so
                "interrupted": self._state in ("running", "interrupted"),
                "state": self._state,
                "metrics": METRICS,
                "settings": run.settings,
                "fingerprint": run.fingerprint,
                "command": run.command,
                **({"first_command": first} if (first := self._first_command) else {}),
                "sha256": self._digests,
                "packages": self._packages,
                "started": self._started,
                "updated": _now(),
                "kept": self.kept,
                "ignored": self.ignored,
                "other_files": [file for file in self._found if file not in written],
            }
        )

    def _publish(self, *, page: bool) -> None:
        document = self.document()
        try:
            text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
            write_atomic(self.folder / "report.json", lambda stream: stream.write(f"{text}\n".encode()))
            if page:
                self._write_page(document)
        except OSError as error:
            raise unwritable(self.folder, error) from None

    def _write_page(self, document: dict[str, Any]) -> None:
        from ns_abstract.report.page import render_page, shown_frames

        begin = time.monotonic()
        pictures = {}
        for entry in shown_frames(document["frames"], PAGE_FRAMES):
            pictures[entry["index"]] = self._preview(entry["index"])
        plays = {index: play for index in pictures if (play := self._play(index)) is not None}
        text = render_page(document, pictures, plays)
        write_atomic(self.folder / "report.html", lambda stream: stream.write(text.encode()))
        took = time.monotonic() - begin
        self._page_due = time.monotonic() + max(_PAGE_SECONDS, _PAGE_SHARE * took)

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
            from ns_abstract.report.picture import previews

            result = load_frame(self.folder / frame_name(index, "npz"), leaves=False).result
            self._previews[index] = previews(result, _PREVIEW_PIXELS)
        return self._previews[index]


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
