"""Certificates: `certify`, its result, and the search that the command line runs, too."""

from __future__ import annotations

import io
import os
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ns_abstract.api.bounding import listener
from ns_abstract.api.certification import MEMORY, Certification, PropertySource, Question, examine_block, examine_here
from ns_abstract.api.job import Job
from ns_abstract.api.margins import NOT_ASKED, SHARE, Margins, certified_cells
from ns_abstract.api.poses import PoseSet
from ns_abstract.api.scenes import Scene
from ns_abstract.api.searching import paced, search_blocks
from ns_abstract.api.showing import look_closer
from ns_abstract.execution.ending import AbandonedError, abandoning
from ns_abstract.execution.engines import Engine, EngineName, started
from ns_abstract.execution.stopping import StopRequest, interruptible
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.io.memory import allowed_memory
from ns_abstract.report.cameras import Cameras, cameras_entry, cell_cameras, standing
from ns_abstract.report.certificate import CertifiedRun, LastReport, certificate_document, coverage, verdict
from ns_abstract.report.certificate_page import Closer, certificate_page, percent
from ns_abstract.report.notebook import verdicts_html
from ns_abstract.report.outside import Outside
from ns_abstract.report.picture import preview, to_bytes
from ns_abstract.report.record import file_stamp
from ns_abstract.report.verdict_picture import clear_pictures, write_pictures
from ns_abstract.verify.cells import Grid
from ns_abstract.verify.eight_bit import Picture
from ns_abstract.verify.network import NetworkArithmetic
from ns_abstract.verify.network.explain import check_cell
from ns_abstract.verify.scene_margin import CAMERA_KINDS, KINDS, PLACES, SceneMargin, check_scenes
from ns_abstract.verify.search import Findings
from ns_abstract.verify.store import IMAGES, Block, Store, fractions
from ns_abstract.verify.substitution import MODES, STEP, Comparison, compare, gains, spread_by_volume

#: Seconds that pictures for the last report may take beyond the budget, where they are made ray by ray.
_LAST = 5.0
#: Counterexamples in report.json by frame, and images of each kind on the page.
_EXAMPLES, _IMAGES = 5, 6
_PIXELS = 256
#: Cells whose picture the page shows when they are chosen, and its longest side.
_SEEN, _SEEN_PIXELS = 64, 96
#: Cells that are bounded in weaker ways besides, part of the time for it, and seconds that it may always take.
_COMPARED, _COMPARE_SHARE, _COMPARE_LEAST = 5, 0.03, 1.0


def network_memory(limit: float | None, workers: int) -> int:
    """Bytes for the network's bounds of one of ``workers`` processes; ``limit`` in GiB for all, or None."""
    # half: images and torch need room beside the bounds; a power of two, so that it hardly depends on the moment
    return min(MEMORY, 1 << int(np.log2(max(2.0, 0.5 * allowed_memory(limit) / workers))))


def check_network_memory(found: Certification, limit: float | None, workers: int) -> None:
    """Refuse a network one cell of which takes more memory than a process may.

    Raises:
        InputError: It does, about.
    """
    dimensions = max(1, len(found.parameters))
    check_cell(found.network, dimensions, allowed_memory(limit) / (1 if found.job.rays else workers))


@dataclass(frozen=True)
class CertifyProgress:
    """Where a search stands: mean fractions over the frames, and seconds.

    Attributes:
        certified, falsified, unknown: Fractions of the parameter volume that have this verdict.
        open: The rest, which is still to be examined.
        seconds: Time spent.
    """

    certified: float
    falsified: float
    unknown: float
    open: float
    seconds: float


class CertificateRun:
    """The search of some frames, with its store and its report.

    Args:
        job: What is certified.
        frames: Numbers of the frames.
        folder: Output folder.
        settings: What the report says that was asked for.
        command: The command line, or the call.
    """

    def __init__(
        self,
        job: Certification,
        frames: Sequence[int],
        folder: Path,
        settings: Mapping[str, Any],
        command: tuple[str, ...],
    ) -> None:
        self.job, self.frames, self.folder = job, tuple(frames), folder
        self.grids: dict[int, Grid] = {}
        self.shown: list[dict[str, Any]] = []
        self.seen: dict[tuple[int, int], dict[str, Any]] = {}
        self.rows: dict[int, list[dict[str, Any]]] = {}
        self.closer: Closer | None = None
        self.cameras: Cameras | None = None
        self.last = LastReport(folder)
        #: When no more pictures are rendered for the report, and who may say so before.
        self.over = float("inf")
        self.stop: Callable[[], bool] = lambda: False
        self.scene_margin: dict[str, Any] = {"skipped": NOT_ASKED, "kinds": []}
        prop = job.property
        self.about = CertifiedRun(
            guarantee=job.job.method.guarantee,
            network_guarantee=job.network.guarantee(job.model.arithmetic),
            renderer={name: job.job.method.program[name] for name in ("name", "version")},
            scene=job.job.describe(),
            model={
                **file_stamp(job.question.model),
                "input": job.network.input_shape,
                "output": job.network.output_shape,
            },
            property=job.question.source.value,
            sentence=prop.sentence(),
            settings=settings,
            fingerprint=job.fingerprint,
            command=command,
            plan=(*job.job.plan, *job.scenes, *prop.notes),
            picture=job.picture,
            assumptions=job.assumptions,
        )

    def open(self, *, resume: bool) -> Store:
        """The store, with the frames begun."""
        store = Store(self.folder, self.job.fingerprint, self.job.parameters, self.job.fixed, resume=resume)
        with store.told():
            for index in self.frames:
                grid = store.grid(index, self.job.job.pose_sets[index].box)
                if grid is None:
                    grid = self.job.grid(index)
                    store.begin(index, grid, self.job.first_blocks(grid))
                self.grids[index] = grid
            # frames of an earlier command that were not asked for now
            for tally in store.tallies():
                if tally.frame not in self.grids:
                    box = self.job.job.pose_sets[tally.frame].box
                    stored = store.grid(tally.frame, box)
                    assert stored is not None
                    self.grids[tally.frame] = stored
        return store

    def search(
        self,
        store: Store,
        engine: Engine,
        deadline: float,
        stop: StopRequest,
        on_progress: Callable[[CertifyProgress], object] = lambda progress: None,
        report: bool = True,
    ) -> None:
        """Examine open blocks until none is left, the time is over or ``stop`` says so.

        Args:
            store: Of `open`.
            engine: Where blocks are examined; closed at the end.
            deadline: Reading of `time.perf_counter`.
            stop: Asked at least twice a second.
            on_progress: Told about once a second.
            report: Whether to bring the report up to date now and then.
        """
        search_blocks(
            store,
            engine,
            self.grids,
            lambda *found: examine_here(self.job, *found),
            (examine_block, self.job.recipe),
            deadline=deadline,
            stop=stop,
            keep=lambda block, findings: self._keep_images(store, block, findings),
            between=paced(
                store,
                lambda: on_progress(self.progress(store)),
                (lambda: self.report(store, "running")) if report else lambda: None,
            ),
            # rays may take longer than there is time for; other blocks are waited for once
            waits=not self.job.job.rays,
        )
        store.trace()

    def progress(self, store: Store) -> CertifyProgress:
        """Where the search stands."""
        shares = [fractions(tally) for tally in store.tallies()]
        mean = {key: sum(s[key] for s in shares) / len(shares) for key in shares[0]}
        return CertifyProgress(mean["certified"], mean["falsified"], mean["unknown"], mean["open"], store.seconds)

    def run(
        self,
        engine: Callable[[ExitStack], Engine],
        budget: float,
        stop: StopRequest,
        *,
        resume: bool = False,
        on_open: Callable[[Store], object] = lambda store: None,
        on_progress: Callable[[CertifyProgress], object] = lambda progress: None,
        report: bool = True,
        scene_margin: bool = False,
        on_margin: Callable[[SceneMargin], object] = lambda found: None,
    ) -> dict[str, Any]:
        """Search, and write the results as they come.

        Args:
            engine: Starts the engine, which ends with the stack.
            budget: Seconds.
            stop: Asked at least twice a second.
            resume: Whether to go on with what the folder holds.
            on_open: Called with the store before the search, when there is a report.
            on_progress: Told about once a second.
            report: Whether to write report.json and report.html, and to compare with weaker bounds.
            scene_margin: Whether to look for the largest variation of the scene for which what is certified holds, in
                half of the time.
            on_margin: Told what it is, kind by kind.

        Returns:
            Content of report.json.

        Raises:
            InputError: The folder cannot be used, there is not enough time to begin, or the scene has no margin.
        """
        if scene_margin:
            check_scenes(any(p.perturbation.scene for p in self.job.job.pose_sets), self.job.job.rays)
        searching = (1.0 - SHARE) * budget if scene_margin else budget
        begin, rays, self.stop = time.perf_counter(), self.job.job.rays, stop
        with ExitStack() as stack:
            # a signal waits until there is a store to report on
            store = self.open(resume=resume)
            stack.callback(store.close)
            stack.enter_context(store.told())
            stack.enter_context(stop.last_words(self.last.interrupted))
            substitution = None
            # where every ray is costly, all that is done is
            self.over = begin + budget if rays else float("inf")
            try:
                with stop.at_once():
                    if report:
                        clear_pictures(self.folder)
                        self.report(store, "running", pictures=False)
                    self._foresee(budget)
                    on_open(store)
                    if report:
                        # renders pictures, for which kernels may have to be compiled
                        self.report(store, "running")
                deadline = (begin if rays else time.perf_counter()) + (1.0 - _COMPARE_SHARE) * searching
                with ExitStack() as engines:
                    self.search(store, engine(engines), deadline, stop, on_progress, report)
                if report and not stop():
                    with suppress(KeyboardInterrupt), stop.at_once():
                        substitution = self.compare(store)
                if scene_margin and not stop():
                    rows = {tally.frame: store.leaves(tally.frame, "certified") for tally in store.tallies()}
                    margins = Margins(certified_cells(rows, self._box), self.job.settle, store, on_margin)
                    try:
                        places = [kind for kind in PLACES if self.job.places(kind)]
                        margins.find(deadline + SHARE * budget, stop, (*KINDS, *CAMERA_KINDS, *places))
                    finally:
                        margins.keep()
                        self.scene_margin = margins.entry
            finally:
                # also after a failure: what is finished is written
                self.over += _LAST
                store.finish(self.grids)
                state = "interrupted" if stop() else "budget" if store.open_blocks else "done"
                document = self.report(store, state, substitution) if report else self.document(store, state)[0]
            self.rows = {tally.frame: store.leaves(tally.frame) for tally in store.tallies()}
        return document

    def _foresee(self, budget: float) -> None:
        try:
            self.job.foresee(self.frames[0], budget)
        except InputError:
            # there is no time for pictures either
            self.over = float("-inf")
            raise

    def _keep_images(self, store: Store, block: Block, findings: Findings) -> None:
        """Store the images of counterexamples before the cells are said to be falsified."""
        for leaf in findings.leaves:
            if leaf.counterexample is None or leaf.image is None or leaf.outputs is None:
                continue
            place = "_".join(f"{a}-{b}" for a, b in zip(leaf.cell.first, leaf.cell.past, strict=True)) or "pose"
            values = np.array(leaf.counterexample)
            buffer = io.BytesIO()
            arrays: dict[str, Any] = {
                "image": leaf.image,
                "outputs": leaf.outputs,
                "values": values,
                "names": np.array(self.grids[block.frame].box.names, str),
                "camera_to_world": self.job.job.pose_sets[block.frame].pose(values),
                "margin": np.array(np.nan if leaf.margin is None else leaf.margin),
            }
            arrays |= {f"scene_{name}": array for name, array in (leaf.scene or {}).items()}
            np.savez(buffer, **arrays)
            store.keep_image(f"frame_{block.frame:05d}_{place}", buffer.getvalue())

    def _kept_image(self, frame: int, pose: np.ndarray) -> np.ndarray | None:
        """The stored image of a counterexample."""
        files = sorted((self.folder / IMAGES).glob(f"frame_{frame:05d}_*.npz"))
        return next((image for file in files if (image := _image_at(file, pose)) is not None), None)

    # ---------------------------------------------------------------- weaker bounds

    def compare(self, store: Store) -> dict[str, Any]:
        """Bound a few certified cells in weaker ways as well, in a small part of the search's time."""
        allowed = max(_COMPARE_LEAST, _COMPARE_SHARE * store.seconds)
        cells = [
            (tally.frame, box)
            for tally in store.tallies()
            for row in store.leaves(tally.frame, "certified")
            if (box := self._box(tally.frame, row)).dimensions
        ]
        if not cells:
            return substitution_entry([], "no cell of more than one pose is certified")
        effort = store.effort
        each = effort["worker_seconds"] / max(1, effort["cells_bounded"]) * len(MODES)
        if each > allowed:
            reason = f"bounding one cell in {len(MODES)} ways takes about {each:.0f} s, {allowed:.0f} s may be used"
            return substitution_entry([], reason)
        found: list[tuple[int, Comparison]] = []
        begin = time.perf_counter()
        with suppress(AbandonedError), abandoning(lambda: time.perf_counter() >= begin + allowed):
            for number in spread_by_volume([_volume(self.grids[frame].box, box) for frame, box in cells], _COMPARED):
                frame, box = cells[number]
                result = compare(self.job.search(frame, self.grids[frame]), box, begin + allowed)
                if result is None:
                    break
                found.append((frame, result))
        reason = None if found else f"the time for it, {allowed:.0f} s, was over before one cell was done"
        return substitution_entry(found, reason, time.perf_counter() - begin)

    def _box(self, frame: int, row: Mapping[str, Any]) -> ParameterBox:
        """A cell that was read back."""
        names, box = [name for name, _ in self.job.parameters], self.grids[frame].box
        for axis, name in enumerate(box.names):
            column = names.index(name)
            box = box.replace(axis, row["lower"][column], row["upper"][column])
        return box

    # ---------------------------------------------------------------- report

    def document(
        self, store: Store, state: str, substitution: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[int, list[dict[str, Any]]]]:
        """Content of report.json, and the cells by frame."""
        rows = {tally.frame: store.leaves(tally.frame) for tally in store.tallies()}
        entries = [self._entry(tally, rows[tally.frame]) for tally in store.tallies()]
        sets = {frame: self.job.job.pose_sets[frame] for frame in rows}
        cells, left_out = cell_cameras(sets, rows, [name for name, _ in self.job.parameters])
        self.cameras = Cameras(cells, left_out, self._standing, self._outside)
        document = certificate_document(
            self.about,
            entries,
            state=state,
            trace=store.points,
            seconds=store.seconds,
            effort=store.effort,
            reasons=store.reasons,
            cells_seal={"rows": store.seal.rows, "sum": store.seal.text},
            substitution=substitution or substitution_entry([], "made when the search ends without being interrupted"),
            scene_margin=self.scene_margin,
            cameras=cameras_entry(cells, left_out),
        )
        return document, rows

    @cached_property
    def _standing(self) -> tuple[np.ndarray, np.ndarray]:
        """Where cameras may stand; the same for every report, so that the scene is drawn once."""
        return standing({frame: self.job.job.pose_sets[frame] for frame in self.grids})

    @cached_property
    def _outside(self) -> Outside | None:
        elements = self.job.job.method.elements()
        return None if elements is None else Outside(elements)

    def report(
        self, store: Store, state: str, substitution: Mapping[str, Any] | None = None, *, pictures: bool = True
    ) -> dict[str, Any]:
        """Write report.json and report.html, with new pictures or those there are; returns the former's content."""
        document, rows = self.document(store, state, substitution)
        # kernels may have to be compiled for others
        if pictures and state != "interrupted":
            self.shown = self._pictures(rows)
            # positions of cells change while they are split
            self.seen = {} if state == "running" else self._cell_pictures(rows)
        elif self.seen:
            self.seen = {}
        ended = state in ("done", "budget")
        self.closer = look_closer(self.job, document["frames"], rows, self._kept_image, self._late) if ended else None
        self.last.write(
            document,
            lambda: certificate_page(document, rows, self.shown, self.seen, self.cameras, self.closer),
        )
        if ended:
            write_pictures(self.folder, document, rows, self.cameras)
        return document

    def _late(self) -> bool:
        return time.perf_counter() >= self.over or self.stop()

    def _entry(self, tally: Any, rows: list[dict[str, Any]]) -> dict[str, Any]:
        shares = fractions(tally)
        names = [name for name, _ in self.job.parameters]
        box = self.job.job.pose_sets[tally.frame].box
        fixed = self.job.fixed[tally.frame]
        sides = {n: (low, high) for n, low, high in zip(box.names, box.lower, box.upper, strict=True)}
        counts = {kind: sum(row["verdict"] == kind for row in rows) for kind in ("certified", "falsified", "unknown")}
        # cells that an ended command has left open stand as unknown without a margin or a time
        left = sum(row["verdict"] == "unknown" and row["seconds"] == 0.0 for row in rows)
        broken = _worst(rows)
        proven = [row["margin"] for row in rows if row["verdict"] == "certified"]
        total = self.job.partitions(self.grids[tally.frame])
        return {
            "index": tally.frame,
            "parameters": [
                {
                    "name": name,
                    "unit": unit,
                    "lower": sides.get(name, (fixed.get(name, 0.0),) * 2)[0],
                    "upper": sides.get(name, (fixed.get(name, 0.0),) * 2)[1],
                }
                for name, unit in self.job.parameters
            ],
            "coverage": {
                "certified": shares["certified"],
                "falsified": shares["falsified"],
                "unknown": shares["unknown"] + shares["open"],
                "not_examined": shares["open"],
            },
            "cells": {**counts, "unknown": counts["unknown"] - left, "open": left if tally.open else 0},
            "sampled": {
                "poses": tally.poses,
                "right": tally.holding,
                "sampled_right": tally.holding / tally.poses if tally.poses else None,
            },
            # unknown units were sampled; those count where the property was seen to hold at every sample
            "partition": None
            if total is None
            else {
                "partitions": total,
                "certified": tally.certified,
                "right": tally.certified + tally.unknown - tally.undecided,
                "undecided": tally.undecided,
                "not_examined": tally.open,
            },
            "least_margin": min(proven, default=None),
            "counterexamples": [
                {"values": dict(zip(names, row["counterexample"], strict=True)), "margin": row["margin"]}
                for row in broken[:_EXAMPLES]
            ],
        }

    def _pictures(self, rows: Mapping[int, list[dict[str, Any]]]) -> list[dict[str, Any]]:
        """A sample, the certified image with the smallest margin, and counterexamples."""
        names = [name for name, _ in self.job.parameters]
        wanted: list[tuple[str, str, int, list[float]]] = []
        first = min(rows)
        box = self.job.job.pose_sets[first].box
        middle = dict(zip(box.names, box.middle.tolist(), strict=True))
        wanted.append(("sample", f"frame {first}, middle of its set", first, [middle.get(n, 0.0) for n in names]))
        proven = [(r["margin"], k, r) for k, found in rows.items() for r in found if r["verdict"] == "certified"]
        if proven:
            margin, frame, row = min(proven, key=lambda item: item[:2])
            pose = [0.5 * (a + b) for a, b in zip(row["lower"], row["upper"], strict=True)]
            wanted.append(("worst certified", f"frame {frame}, margin at least {margin:.4g}", frame, pose))
        broken = [(_depth(row), frame, row) for frame, found in rows.items() for row in _worst(found)]
        for _, frame, row in sorted(broken, key=lambda item: item[:2])[:_IMAGES]:
            margin = row["margin"]
            text = f"frame {frame}, margin {'not a number' if margin is None else f'{margin:.4g}'}"
            wanted.append(("counterexample", text, frame, row["counterexample"]))
        found = []
        with suppress(AbandonedError):
            for title, text, frame, values in wanted:
                found.append({"title": title, "text": text, "png": self._drawn(frame, values, _PIXELS)})
        return found

    def _drawn(self, frame: int, values: Sequence[float], side: int) -> bytes:
        """PNG of the picture at parameter values in the order of all parameters.

        Raises:
            AbandonedError: There is no time for more pictures.
        """
        known = dict(zip((name for name, _ in self.job.parameters), values, strict=True))
        pictures = self.job.pictures(frame)
        pose = np.array([known[name] for name in pictures.box.names])
        # of another scene of the set, maybe
        image = self._kept_image(frame, pose) if pictures.pose_set.perturbation.scene else None
        if image is None:
            with abandoning(lambda: time.perf_counter() >= self.over):
                image = pictures.image(pose)
        return preview(to_bytes(image), side)

    def _cell_pictures(self, rows: Mapping[int, list[dict[str, Any]]]) -> dict[tuple[int, int], dict[str, Any]]:
        """By frame and position, a picture of some cells: the same number of each verdict, evenly spread."""
        kinds = {
            kind: [(frame, k) for frame, found in rows.items() for k, row in enumerate(found) if row["verdict"] == kind]
            for kind in ("certified", "falsified", "unknown")
        }
        share = _SEEN // max(1, sum(map(bool, kinds.values())))
        wanted = [key for keys in kinds.values() for key in keys[:: max(1, -(-len(keys) // share))]]
        found = {}
        with suppress(AbandonedError):
            for frame, k in wanted:
                row = rows[frame][k]
                values, text = row["counterexample"], "the counterexample's picture"
                if values is None:
                    values = [0.5 * (a + b) for a, b in zip(row["lower"], row["upper"], strict=True)]
                    text = "one picture, at the cell's middle"
                found[frame, k] = {"png": self._drawn(frame, values, _SEEN_PIXELS), "text": text}
        return found


def _image_at(file: Path, pose: np.ndarray) -> np.ndarray | None:
    """Return a stored counterexample's image if it is that of ``pose``; None also if the file was changed."""
    try:
        with np.load(file, allow_pickle=False) as stored:
            image = stored["image"] if np.array_equal(stored["values"], pose) else None
            return None if image is None or image.ndim != 3 or image.dtype != np.float32 else image
    except (OSError, ValueError, LookupError, zipfile.BadZipFile):
        return None


def _volume(whole: ParameterBox, part: ParameterBox) -> float:
    """Return the share of a set's volume that a cell takes."""
    sides = zip(part.lower, part.upper, whole.lower, whole.upper, strict=True)
    return float(np.prod([(high - low) / (most - least) for low, high, least, most in sides]))


def substitution_entry(
    compared: Sequence[tuple[int, Comparison]], skipped: str | None, seconds: float = 0.0
) -> dict[str, Any]:
    """The key ``substitution`` of report.json.

    Args:
        compared: Frames and cells.
        skipped: Why there are none, or None.
        seconds: Spent on them.
    """

    def entry(frame: int, found: Comparison) -> dict[str, Any]:
        box = found.box
        half = [0.5 * (high - low) for low, high in zip(box.lower, box.upper, strict=True)]
        return {
            "frame": frame,
            "parameters": list(box.names),
            "lower": list(box.lower),
            "upper": list(box.upper),
            "margin": {mode: value if np.isfinite(value) else None for mode, value in found.margins.items()},
            "half_width": {
                mode: None if factor is None else [factor * h for h in half] for mode, factor in found.factors.items()
            },
            "at_least": list(found.open_ended),
        }

    return {
        "modes": dict(MODES),
        "cells": [entry(frame, found) for frame, found in compared],
        "wider_than": gains([found for _, found in compared]),
        "step": STEP,
        "skipped": skipped,
        "seconds": seconds,
    }


def _depth(row: Mapping[str, Any]) -> float:
    """Return the margin of a counterexample; NaN sorts before all numbers."""
    return -np.inf if row["margin"] is None else row["margin"]


def _worst(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the falsified cells, worst first, one for each counterexample."""
    found = sorted((row for row in rows if row["verdict"] == "falsified"), key=_depth)
    return list({tuple(row["counterexample"]): row for row in reversed(found)}.values())[::-1]


@dataclass(frozen=True)
class CertifiedCell:
    """A cell of the search.

    Attributes:
        frame: Number of its set of poses.
        lower, upper: Ends of its box, in the order of `Certificate.parameters`.
        verdict: "certified", "falsified" or "unknown".
        margin: Proved lower bound of the property's margin; the margin of the counterexample; or None.
        counterexample: Parameters of a pose whose image breaks the property, or None.
    """

    frame: int
    lower: np.ndarray
    upper: np.ndarray
    verdict: Literal["certified", "falsified", "unknown"]
    margin: float | None
    counterexample: np.ndarray | None


@dataclass(frozen=True)
class Certificate:
    """A certificate: what was proved and falsified of a network over a set of poses.

    Attributes:
        certified, falsified, unknown: Fractions of the parameter volume, mean over the sets; they add up to 1.
        cells: What the fractions are made of.
        verdict: "falsified" if any pose breaks the property, "certified" if all is proved, else "unknown".
        parameters: Names and units of the cells' axes.
        sentence: The property in words, as the end of "on every image ...".
        guarantee: Of the pictures: "float32-sound" or "real-sound".
        network_guarantee: What holds of the network, one sentence each.
        state: "done", "budget" (the time ended first) or "interrupted".
        seconds: Time spent.
        report: Content of report.json.
    """

    certified: float
    falsified: float
    unknown: float
    cells: tuple[CertifiedCell, ...] = field(repr=False)
    verdict: str
    parameters: tuple[tuple[str, str], ...]
    sentence: str
    guarantee: str
    network_guarantee: tuple[str, ...] = field(repr=False)
    state: str
    seconds: float
    report: dict[str, Any] = field(repr=False)

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """What the verdict rests on, and where each choice came from."""
        return tuple(Assumption(**entry) for entry in self.report["assumptions"])

    @property
    def interrupted(self) -> bool:
        """Whether the work was ended by Ctrl-C or by ``on_progress``."""
        return self.state == "interrupted"

    def _repr_html_(self) -> str:
        shares = {"certified": self.certified, "falsified": self.falsified, "unknown": self.unknown}
        lines = [
            f"{self.verdict}: on every image {self.sentence}",
            ", ".join(f"{kind} {percent(share)}" for kind, share in shares.items()),
            f"{self.guarantee}; {len(self.cells)} cells, {self.seconds:.1f} s; {self.state}",
        ]
        return verdicts_html(shares, lines)


def certify(
    scene: Scene,
    poses: PoseSet | Sequence[PoseSet],
    model: str | os.PathLike[str],
    property: Mapping[str, Any] | str | os.PathLike[str],
    *,
    time_budget: float = 600.0,
    output_dir: str | os.PathLike[str] | None = None,
    arithmetic: str | None = None,
    network_arithmetic: NetworkArithmetic = "float32",
    picture: Picture = "float",
    resume: bool = False,
    on_progress: Callable[[CertifyProgress], object] | None = None,
    workers: int = 1,
    engine: EngineName = "local",
    scheduler_address: str | None = None,
    memory_limit: float | None = None,
    scene_margin: bool = False,
) -> Certificate:
    """Prove, or break, a property of a network on every picture that a scene shows over sets of poses.

    Ctrl-C and ``on_progress`` returning False end the work between two cells, with what is known.

    Args:
        scene: The scene.
        poses: One set, or several.
        model: Network, .onnx or .pt2 of torch.export.
        property: What is to hold, as the object of a property file, or that file.
        time_budget: Seconds for all sets together.
        output_dir: Folder for cells.sqlite, the report and counterexamples, as ns-abstract-certify writes them; None:
            nothing is kept on disk.
        arithmetic: "float32" or "real", of the pictures; None: float32.
        network_arithmetic: "float32": every float32 evaluation of the network; "real": the exact network alone.
        picture: "float": the renderer's floats; "8-bit": these rounded to multiples of 1/255, as files have them.
        resume: Whether to go on with what ``output_dir`` holds.
        on_progress: Told about once a second.
        workers: Processes (for a NeRF: that bound rays, which all cells share); with more than one, a script needs
            ``if __name__ == "__main__":``.
        engine: "dask" spreads the cells over a Dask cluster.
        scheduler_address: HOST:PORT of its scheduler; None: a cluster on this machine.
        memory_limit: GiB; None: 80 % of what is free.
        scene_margin: Whether to look, in half of the time, for the largest variation of the Gaussians for which what is
            certified holds; see the report's key ``scene_margin``.

    Raises:
        InputError: An argument cannot be used.
    """
    if not 0.0 < time_budget < float("inf"):
        raise InputError(f"found {time_budget}", field="time_budget", fix="give a positive number")
    if workers < 1:
        raise InputError(f"found {workers}", field="workers", fix="give a number of at least 1")
    if picture not in ("float", "8-bit"):
        raise InputError(f"found {picture}", field="picture", fix="use float or 8-bit")
    if resume and output_dir is None:
        raise InputError("given without output_dir", field="resume", fix="give the folder to go on with")
    sets = [poses] if isinstance(poses, PoseSet) else list(poses)
    if not sets:
        raise InputError("found no set", field="poses", fix="give at least one PoseSet")
    given = property if isinstance(property, Mapping) else Path(property)
    question = Question(Path(model), PropertySource.of(given))
    drawn = [question.drawn(entry.of(scene)) for entry in sets]
    memory = network_memory(memory_limit, workers)
    job = Job(scene, drawn, arithmetic=arithmetic, workers=workers)
    found = Certification(job, question, memory, network_arithmetic=network_arithmetic, picture=picture)
    check_network_memory(found, memory_limit, workers)
    settings = {
        "time_budget": time_budget,
        "arithmetic": arithmetic,
        "picture": picture,
        "workers": workers,
        "engine": engine,
    }
    with ExitStack() as stack:
        folder = Path(output_dir) if output_dir is not None else Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="ns-abstract-"))
        )  # fmt: skip
        stop = stack.enter_context(interruptible())
        run = CertificateRun(found, range(len(drawn)), folder, settings, ("ns_abstract.certify",))
        document = run.run(
            lambda engines: engines.enter_context(started(engine, scheduler_address, 1 if scene.rays else workers)),
            time_budget,
            stop,
            resume=resume,
            on_progress=listener(stop, on_progress),
            report=output_dir is not None,
            scene_margin=scene_margin,
        )
    return certificate(run, document)


def certificate(run: CertificateRun, document: Mapping[str, Any]) -> Certificate:
    """The result of a search that has ended."""
    cells = [
        CertifiedCell(
            frame,
            np.array(row["lower"], np.float64),
            np.array(row["upper"], np.float64),
            row["verdict"],
            row["margin"],
            None if row["counterexample"] is None else np.array(row["counterexample"], np.float64),
        )
        for frame, rows in sorted(run.rows.items())
        for row in rows
    ]
    covered = coverage(document["frames"])
    return Certificate(
        certified=covered["certified"],
        falsified=covered["falsified"],
        unknown=covered["unknown"],
        cells=tuple(cells),
        verdict=verdict(document["frames"]),
        parameters=tuple(run.job.parameters),
        sentence=run.about.sentence,
        guarantee=run.about.guarantee,
        network_guarantee=run.about.network_guarantee,
        state=document["state"],
        seconds=document["seconds"],
        report=dict(document),
    )
