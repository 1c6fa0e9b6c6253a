"""Pictures and network outputs of selected poses for a certificate's page, in bounded time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import torch

from ns_abstract.api.certification import Certification, FramePictures
from ns_abstract.execution.cancellation import WorkCancelledError, cancel_when, check_cancelled
from ns_abstract.io.errors import InputError
from ns_abstract.report import regions as broken
from ns_abstract.report import walk
from ns_abstract.report.certificate_page import CertificateDetails
from ns_abstract.report.figures import ShownUnits
from ns_abstract.report.picture import preview
from ns_abstract.report.regions import FailureRegion, PoseImage
from ns_abstract.verify.properties import Claim

#: Seconds that all of it may take; the longest side of a picture; cells without a verdict that are tried for a right
#: pose where none is certified.
SECONDS, _PIXELS, _TRIED = 10.0, 160, 4
_OVER = ", without pictures: there was no time for them"

CellRows = Mapping[int, Sequence[Mapping[str, Any]]]


class _PoseRenderer:
    """Renders poses and shows them to the network."""

    def __init__(self, job: Certification, cached: Callable[[int, np.ndarray], np.ndarray | None]) -> None:
        self._job, self._kept = job, cached
        self._names = [name for name, _ in job.job.parameters]
        self._frames: dict[int, tuple[FramePictures, Claim]] = {}

    def look(self, title: str, frame: int, values: Sequence[float]) -> PoseImage:
        """The picture at values of all parameters, the network's outputs and the margin.

        Raises:
            WorkCancelledError: There is no time for it.
        """
        check_cancelled()
        if frame not in self._frames:
            pictures = self._job.pictures(frame)
            self._frames[frame] = pictures, self._job.claim(pictures)
        pictures, claim = self._frames[frame]
        pose = np.array([values[self._names.index(name)] for name in pictures.box.names], np.float64)
        # of another scene of the set, maybe
        image = self._kept(frame, pose) if pictures.pose_set.perturbation.scene else None
        if image is None:
            image = pictures.image(pose)
        outputs = np.asarray(self._job.model.outputs(image[None]), np.float64)
        with torch.no_grad():
            margin = float(claim.margin(torch.from_numpy(outputs), torch.from_numpy(pose[None]))[0])
        png = preview(pictures.shown(image, pose), _PIXELS)
        return PoseImage(title, values, png, outputs[0].tolist(), margin if np.isfinite(margin) else None)

    def right(self, region: FailureRegion, rows: CellRows, parameters: Sequence[Mapping[str, Any]]) -> PoseImage | None:
        """The nearest certified pose; where none is, the middle of a near cell at which the network is right."""
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
    job: Certification,
    entries: Sequence[Mapping[str, Any]],
    rows: CellRows,
    cached: Callable[[int, np.ndarray], np.ndarray | None],
    over: Callable[[], bool],
) -> CertificateDetails:
    """Regions where the property fails, and poses along the sets, with pictures.

    Args:
        cached: The stored image of a counterexample, by frame and pose.
        over: Whether no more pictures are to be rendered; `SECONDS` from now none are, either.
    """
    end = time.perf_counter() + SECONDS
    looks = _PoseRenderer(job, cached)
    regions = broken.falsified_regions(entries, rows)
    sides = {entry["index"]: entry["parameters"] for entry in entries}
    pictures: list[tuple[PoseImage, PoseImage | None]] = []
    stops = walk.stops(entries, rows, ShownUnits.of(job.job.describe()))
    pictures_by_frame: dict[int, PoseImage] = {}
    why = _OVER
    # a property that makes no sense for a frame is told by who searches
    with suppress(WorkCancelledError, InputError), cancel_when(lambda: over() or time.perf_counter() >= end):
        for region in regions[: broken.MOST]:
            picture = looks.look("counterexample", region.frame, region.pose)
            pictures.append((picture, looks.right(region, rows, sides[region.frame])))
        why = ""
        for k in walk.coarse_first(len(stops)) if len(stops) > 1 else []:
            pictures_by_frame[k] = looks.look(stops[k].at, stops[k].frame, stops[k].values)
    return CertificateDetails(
        regions, pictures, [(stops[k], pictures_by_frame[k]) for k in sorted(pictures_by_frame)], why
    )
