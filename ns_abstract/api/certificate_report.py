"""The report on a certificate: figures, and pictures of samples, of counterexamples and of cells."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ns_abstract.api.cell_search import CellSearch
from ns_abstract.api.certification import Certification, FramePictures
from ns_abstract.execution.cancellation import WorkCancelledError, cancel_when, check_cancelled
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.arrays import open_archive
from ns_abstract.io.errors import InputError
from ns_abstract.report import regions as broken
from ns_abstract.report.cameras import CameraDrawings, cameras_entry, cell_cameras, looked_at, standing, upward
from ns_abstract.report.certificate import certificate_document, search_figures
from ns_abstract.report.certificate_page import CertificateDetails, certificate_page
from ns_abstract.report.figures import ShownUnits
from ns_abstract.report.outside import SceneDrawing
from ns_abstract.report.picture import preview
from ns_abstract.report.regions import FailureRegion, PoseImage, coarse_first
from ns_abstract.report.regions import stops as poses_along
from ns_abstract.report.run import CommandRun, sides
from ns_abstract.report.verdict_picture import write_pictures
from ns_abstract.verify.properties import Claim
from ns_abstract.verify.store import Store, Tally, fractions
from ns_abstract.verify.store_file import IMAGES

#: Counterexamples in report.json by frame, and images of each kind on the page.
_EXAMPLES, _IMAGES = 5, 6
_PIXELS = 256
#: Numbers of a stored image that is read at most.
_MOST_NUMBERS = 1 << 28
#: Cells whose picture the page shows when they are chosen, and its longest side.
_SEEN, _SEEN_PIXELS = 64, 96
#: Seconds that a closer look may take; the longest side of its pictures; cells without a verdict that are tried for a
#: right pose where none is certified.
SECONDS, _CLOSE_PIXELS, _TRIED = 10.0, 160, 4
_OVER = ", without pictures: there was no time for them"
CellRows = Mapping[int, Sequence[Mapping[str, Any]]]


class CertificateReport:
    """Writes report.json and report.html of a search."""

    def __init__(self, job: Certification, about: CommandRun, search: CellSearch[Any]) -> None:
        self.job, self.about, self.search = job, about, search
        self.renderer = PoseRenderer(job, self._kept_image)
        self.shown: list[dict[str, Any]] = []
        self.seen: dict[tuple[int, int], dict[str, Any]] = {}
        self.cameras: CameraDrawings | None = None

    def document(self, store: Store, state: str) -> tuple[dict[str, Any], dict[int, list[dict[str, Any]]]]:
        """Return the content of report.json, and the cells' rows by frame."""
        rows = {tally.frame: store.leaves(tally.frame) for tally in store.tallies()}
        entries = [self._entry(tally, rows[tally.frame]) for tally in store.tallies()]
        sets = {frame: self.job.job.pose_sets[frame] for frame in rows}
        cells, left_out = cell_cameras(sets, rows, [name for name, _ in self.job.job.parameters])
        self.cameras = CameraDrawings(cells, left_out, self._standing, self._outside, upward(sets), self._sights)
        claim = {
            "property": self.job.question.source.value,
            "property_text": self.job.property.sentence(),
            "network_guarantee": self.job.question.guarantee(self.job.arithmetic),
            "picture": self.job.picture,
            "model": self.job.question.describe(),
        }
        document = certificate_document(
            self.about, claim, entries, search_figures(store), state=state,
            scene_margin=self.search.scene_margin, cameras=cameras_entry(cells, left_out),
        )  # fmt: skip
        return document, rows

    def write(self, state: str, *, pictures: bool = True) -> dict[str, Any]:
        """Write report.json and report.html, with new or earlier pictures; returns the content of report.json."""
        search = self.search
        document, rows = self.document(search.store, state)
        # kernels may have to be compiled for others
        if pictures and state != "interrupted":
            self.shown = self._pictures(rows)
            # positions of cells change while they are split
            self.seen = {} if state == "running" else self._cell_pictures(rows)
        elif self.seen:
            self.seen = {}
        ended = state in ("done", "budget")
        frames = document["frames"]
        closer = look_closer(self.renderer, frames, rows, search.deadline) if ended else None
        search.last.write(
            document, lambda: certificate_page(document, rows, self.shown, self.seen, self.cameras, closer)
        )
        if ended:
            write_pictures(search.folder, document, rows, self.cameras)
        return document

    @cached_property
    def _standing(self) -> tuple[np.ndarray, np.ndarray]:
        """Ends of a box of possible camera positions; equal in all reports, so that the scene is drawn once."""
        return standing(self._sets)

    @cached_property
    def _sights(self) -> np.ndarray:
        return looked_at(self._sets, self._outside)

    @property
    def _sets(self) -> dict[int, PoseBox]:
        return {frame: self.job.job.pose_sets[frame] for frame in self.search.grids}

    @cached_property
    def _outside(self) -> SceneDrawing | None:
        elements = self.job.job.method.elements()
        return None if elements is None else SceneDrawing(elements)

    def _kept_image(self, frame: int, pose: np.ndarray) -> np.ndarray | None:
        """Return the stored image of a counterexample at ``pose``; None where none is stored."""
        files = sorted((self.search.folder / IMAGES).glob(f"frame_{frame:05d}_*.npz"))
        return next((image for file in files if (image := _image_at(file, pose)) is not None), None)

    def _entry(self, tally: Tally, rows: list[dict[str, Any]]) -> dict[str, Any]:
        shares = fractions(tally)
        names = [name for name, _ in self.job.job.parameters]
        poses = self.job.job.pose_sets[tally.frame]
        counts = {kind: sum(row["verdict"] == kind for row in rows) for kind in ("certified", "falsified", "unknown")}
        # cells that an ended command has left open stand as unknown without a margin or a time
        left = sum(row["verdict"] == "unknown" and row["seconds"] == 0.0 for row in rows)
        broken = _worst(rows)
        proven = [row["margin"] for row in rows if row["verdict"] == "certified"]
        total = self.job.partitions(self.search.grids[tally.frame])
        return {
            "index": tally.frame,
            "intrinsics": poses.camera.intrinsics._asdict(),
            "parameters": sides(poses.box, self.job.job.parameters, poses.fixed),
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
        """Return the page's pictures: a sample, the certified image with the smallest margin, and counterexamples."""
        names = [name for name, _ in self.job.job.parameters]
        wanted: list[tuple[str, str, int, list[float]]] = []
        first = min(rows)
        box = self.job.job.pose_sets[first].box
        middle = dict(zip(box.names, box.middle.tolist(), strict=True))
        wanted.append(("sample", f"frame {first}, middle of its set", first, [middle.get(n, 0.0) for n in names]))
        proven = [(r["margin"], k, r) for k, cells in rows.items() for r in cells if r["verdict"] == "certified"]
        if proven:
            margin, frame, row = min(proven, key=lambda item: item[:2])
            pose = [0.5 * (a + b) for a, b in zip(row["lower"], row["upper"], strict=True)]
            wanted.append(("worst certified", f"frame {frame}, margin at least {margin:.4g}", frame, pose))
        broken = [(_depth(row), frame, row) for frame, cells in rows.items() for row in _worst(cells)]
        for _, frame, row in sorted(broken, key=lambda item: item[:2])[:_IMAGES]:
            margin = row["margin"]
            text = f"frame {frame}, margin {'not a number' if margin is None else f'{margin:.4g}'}"
            wanted.append(("counterexample", text, frame, row["counterexample"]))
        pictures = []
        with suppress(WorkCancelledError):
            for title, text, frame, values in wanted:
                pictures.append({"title": title, "text": text, "png": self._drawn(frame, values, _PIXELS)})
        return pictures

    def _drawn(self, frame: int, values: Sequence[float], side: int) -> bytes:
        """Return the PNG of the picture at parameter values in the order of all parameters.

        Raises:
            WorkCancelledError: There is no time for more pictures.
        """
        with self.search.deadline.enforced():
            pictures, pose, image = self.renderer.image(frame, values)
        return preview(pictures.shown(image, pose), side)

    def _cell_pictures(self, rows: Mapping[int, list[dict[str, Any]]]) -> dict[tuple[int, int], dict[str, Any]]:
        """Return pictures of some cells by frame and position: equally many of each verdict, evenly spread."""
        kinds = {
            kind: [(frame, k) for frame, cells in rows.items() for k, row in enumerate(cells) if row["verdict"] == kind]
            for kind in ("certified", "falsified", "unknown")
        }
        share = _SEEN // max(1, sum(map(bool, kinds.values())))
        wanted = [key for keys in kinds.values() for key in keys[:: max(1, -(-len(keys) // share))]]
        pictures = {}
        with suppress(WorkCancelledError):
            for frame, k in wanted:
                row = rows[frame][k]
                values, text = row["counterexample"], "the counterexample's picture"
                if values is None:
                    values = [0.5 * (a + b) for a, b in zip(row["lower"], row["upper"], strict=True)]
                    text = "one picture, at the cell's middle"
                pictures[frame, k] = {"png": self._drawn(frame, values, _SEEN_PIXELS), "text": text}
        return pictures


def _image_at(file: Path, pose: np.ndarray) -> np.ndarray | None:
    """Return the [H, W, 3] image of a stored counterexample; None if the file is unreadable or of another pose."""
    try:
        with open_archive(file, "counterexample", "") as stored:
            shape, kind = stored.declared["image"]
            fits = len(shape) == 3 and kind == np.float32 and math.prod(shape) <= _MOST_NUMBERS
            if not fits or stored.declared["values"][0] != pose.shape:
                return None
            return stored.read("image") if np.array_equal(stored.read("values"), pose) else None
    except InputError:
        return None


def _depth(row: Mapping[str, Any]) -> float:
    """Return the key that sorts falsified cells, worst first: the margin, or -inf where no margin is stored."""
    return -np.inf if row["margin"] is None else row["margin"]


def _worst(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of falsified cells by rising margin; only the worst of those that share a counterexample is kept."""
    broken = sorted((row for row in rows if row["verdict"] == "falsified"), key=_depth)
    return list({tuple(row["counterexample"]): row for row in reversed(broken)}.values())[::-1]


class PoseRenderer:
    """Renders poses and evaluates the network on the pictures."""

    def __init__(self, job: Certification, cached: Callable[[int, np.ndarray], np.ndarray | None]) -> None:
        self.job, self._kept = job, cached
        self._names = [name for name, _ in job.job.parameters]
        self._frames: dict[int, FramePictures] = {}
        self._claims: dict[int, Claim] = {}

    def image(self, frame: int, values: Sequence[float]) -> tuple[FramePictures, np.ndarray, np.ndarray]:
        """Return frame's pictures, the frame's own entries of ``values`` (of all parameters), and the picture there."""
        if frame not in self._frames:
            self._frames[frame] = self.job.pictures(frame)
        pictures = self._frames[frame]
        pose = np.array([values[self._names.index(name)] for name in pictures.box.names], np.float64)
        # of another scene of the set, maybe
        image = self._kept(frame, pose) if pictures.pose_set.perturbation.scene else None
        return pictures, pose, pictures.image(pose) if image is None else image

    def look(self, title: str, frame: int, values: Sequence[float]) -> PoseImage:
        """Return the picture at ``values`` of all parameters, with the network's outputs and the margin.

        Raises:
            WorkCancelledError: There is no time for it.
        """
        check_cancelled()
        pictures, pose, image = self.image(frame, values)
        if frame not in self._claims:
            self._claims[frame] = self.job.claim(pictures)
        outputs = np.asarray(self.job.model.outputs(image[None]), np.float64)
        with torch.no_grad():
            margin = float(self._claims[frame].margin(torch.from_numpy(outputs), torch.from_numpy(pose[None]))[0])
        png = preview(pictures.shown(image, pose), _CLOSE_PIXELS)
        return PoseImage(title, values, png, outputs[0].tolist(), margin if np.isfinite(margin) else None)

    def right(self, region: FailureRegion, rows: CellRows, parameters: Sequence[Mapping[str, Any]]) -> PoseImage | None:
        """Return the nearest certified pose, or the middle of a near cell where the network is right; None: neither."""
        cells = rows[region.frame]
        for _, pose in broken.nearest(cells, "certified", region.pose, parameters):
            return self.look("nearest certified pose", region.frame, pose)
        for k, _ in broken.nearest(cells, "unknown", region.pose, parameters, _TRIED):
            pose = [0.5 * (a + b) for a, b in zip(cells[k]["lower"], cells[k]["upper"], strict=True)]
            picture = self.look("a near pose, right but not certified", region.frame, pose)
            if picture.margin is not None and picture.margin > 0.0:
                return picture
        return None


def look_closer(
    looks: PoseRenderer, entries: Sequence[Mapping[str, Any]], rows: CellRows, over: Callable[[], bool]
) -> CertificateDetails:
    """Return regions where the property fails, and poses along the sets, with pictures.

    ``over``: whether no more pictures are to be rendered; `SECONDS` from now none are, either.
    """
    end = time.perf_counter() + SECONDS
    regions = broken.falsified_regions(entries, rows)
    sides = {entry["index"]: entry["parameters"] for entry in entries}
    pictures: list[tuple[PoseImage, PoseImage | None]] = []
    stops = poses_along(entries, rows, ShownUnits.of(looks.job.job.describe()))
    pictures_by_frame: dict[int, PoseImage] = {}
    why = _OVER
    # a property that makes no sense for a frame is told by who searches
    with suppress(WorkCancelledError, InputError), cancel_when(lambda: over() or time.perf_counter() >= end):
        for region in regions[: broken.MOST]:
            picture = looks.look("counterexample", region.frame, region.pose)
            pictures.append((picture, looks.right(region, rows, sides[region.frame])))
        why = ""
        for k in coarse_first(len(stops)) if len(stops) > 1 else []:
            pictures_by_frame[k] = looks.look(stops[k].at, stops[k].frame, stops[k].values)
    return CertificateDetails(
        regions, pictures, [(stops[k], pictures_by_frame[k]) for k in sorted(pictures_by_frame)], why
    )
