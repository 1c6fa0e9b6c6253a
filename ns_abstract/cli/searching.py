"""The work of ``ns-abstract-certify`` and ``ns-abstract-locate``, and searches; imported only when it is asked for."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from ns_abstract.api.cell_search import CellQuestion, CellSearch, Request
from ns_abstract.api.certification import Certification, open_certification
from ns_abstract.api.certifying import CertificateQuestion, check_network_memory, network_memory
from ns_abstract.api.compiling import compile_beside
from ns_abstract.api.job import Job, check_frames
from ns_abstract.api.locating import LocationQuestion
from ns_abstract.api.location import Location, open_location
from ns_abstract.api.sequence import open_sequence
from ns_abstract.cli.common import SignalStop
from ns_abstract.cli.sets import stated
from ns_abstract.execution.engine_options import EngineOptions
from ns_abstract.io.photos import missing_photos
from ns_abstract.report.certificate import coverage
from ns_abstract.report.figures import frames_listed, percent
from ns_abstract.report.progress import ProgressBar, plain_console
from ns_abstract.verify.store import Store

if TYPE_CHECKING:
    from ns_abstract.cli.commands import Certify, Locate

#: Seconds where no time budget is given.
_CERTIFY_SECONDS, _LOCATE_SECONDS = 1800.0, 600.0
_ANSWERS = {
    "none": "none: no pose of the set made the photo",
    "possible": "possible: a rendered pose explains the photo",
    "unknown": "unknown: no rendered pose explains the photo",
}


def searched(
    question: CellQuestion[Any],
    folder: Path,
    where: EngineOptions,
    stop: SignalStop,
    console: Any,
    job: Job,
    frame: int,
    request: Request,
    kept: Callable[[Store], str],
    introduce: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Search for verdicts as ``request`` says, with a bar of progress; returns the content of report.json.

    Args:
        job: Of the pictures; the kernels of its ``frame`` are compiled first, once and not in every worker.
        kept: What is told of a search that goes on with an earlier one.
        introduce: Prints what is searched for, once nothing of it is refused: an error is the only line then.
    """

    def opened(store: Store) -> None:
        introduce()
        if store.resumed:
            console.print(f"  {kept(store)}")
        if where.engine == "local":
            with stop.at_once():
                compile_beside(job, frame)

    with ProgressBar(console) as progress:
        return CellSearch(question, folder).run(
            # the processes of a NeRF bound its rays, which all cells share
            lambda stack: stack.enter_context(where.started(1 if job.rays else where.processes)),
            stop,
            dataclasses.replace(
                request,
                on_open=opened,
                on_progress=progress,
                on_margin=lambda margin: console.print(f"scene margin: {margin.sentence}"),
            ),
        )


def kept_cells(store: Store) -> str:
    """Return a sentence on the cells that a continued search has examined and has not."""
    return f"{store.count} cells kept from before, {store.open_blocks} blocks of cells still to be examined"


def say_if_late(console: Any, document: dict[str, Any]) -> None:
    """Print how to continue a search, if the time budget ended it."""
    if document["state"] == "budget":
        console.print("the time budget ended first: go on with --resume")


def locate_photos(options: Locate, stop: SignalStop) -> None:
    """Search the frames for one photo or for a sequence of them, and write the results."""
    console = plain_console()
    if options.image_sequence is None:
        with stop.at_once():
            location = open_location(options.settings)
            frames = check_frames(options.frames, location.job.frame_count)
        introduce = partial(_tell, console, location)
        _search(options, stop, console, location, frames, options.output_dir, options.resume, introduce)
        return
    with stop.at_once():
        settings = options.settings
        assert options.motion is not None
        photos = open_sequence(
            settings, options.image_sequence, options.motion, options.output_dir, options.frames, options.resume
        )
    if (warning := missing_photos(photos.images)) is not None:
        console.print(f"warning: {warning}")
    untold = [photos.first]

    def search(location: Location, frames: tuple[int, ...], folder: Path) -> dict[str, Any]:
        first = bool(untold)

        def introduce() -> None:
            if untold:
                _tell(console, untold.pop())
            console.print(f"{location.file}")

        # later photos' sets follow from what is left of this one: what their folders hold is of other sets
        resume = options.resume and first and (folder / "cells.sqlite").exists()
        return _search(options, stop, console, location, frames, folder, resume, introduce)

    document = photos.follow(search)
    if document["not_examined"] and document["state"] == "done":
        text = f"none: no pose explains {document['images'][-1]['image']['name']}, {document['not_examined']} after it"
        console.print(f"{text} not examined")
    console.print(f"report: {options.output_dir / 'report.json'}")


def _tell(console: Any, location: Location) -> None:
    """Print the calibration, the number of pixels that may be outliers, and warnings."""
    method, photo, calibration = location.job.method, location.photo, location.calibration
    if calibration is not None:
        text = f"calibrated on {calibration.photos} training photos ({calibration.psnr:.1f} dB): noise"
        console.print(f"{text} {calibration.noise:.4f}, outliers {calibration.outliers:g}")
    console.print(
        f"{method.name}: {method.content}; {photo.allowed} of {int(photo.counted.sum())} pixels may show anything"
    )
    for warning in location.job.warnings:
        console.print(f"warning: {warning}")


def _search(
    options: Locate,
    stop: SignalStop,
    console: Any,
    location: Location,
    frames: tuple[int, ...],
    folder: Path,
    resume: bool,
    introduce: Callable[[], None],
) -> dict[str, Any]:
    """Locate one photo; returns the content of its report.json. ``introduce``: as in `searched`."""
    question = LocationQuestion(location, frames, stated(options), ("ns-abstract-locate", *sys.argv[1:]))

    def introduced() -> None:
        introduce()
        for note in question.about.plan:
            console.print(f"  {note}")

    request = Request(options.time_budget or _LOCATE_SECONDS, resume, rows=False)
    document = searched(
        question, folder, options.where, stop, console, location.job, frames[0], request,
        lambda store: f"{store.open_blocks} cells still to be examined from before",
        introduced,
    )  # fmt: skip
    left, boxes = (percent(document[name]) for name in ("possible_volume", "boxes_volume"))
    console.print(f"{_ANSWERS[document['answer']]}; {left} of the set left")
    if boxes != left:
        console.print(f"  cells.sqlite has boxes around it, which take {boxes} of the set")
    late = [entry["index"] for entry in document["frames"] if entry["best"] is None and entry["possible_volume"] > 0.0]
    if document["state"] != "done" and late:
        console.print(f"  not examined before the time was over: {frames_listed(late)}")
    elif document["answer"] != "possible" and document["best"] is not None and document["state"] == "done":
        missed = document["best"]["outliers"]
        text = f"  best pose misses {missed} pixels: --noise and --outliers must allow the scene's own error"
        console.print(text)
    if options.image_sequence is None:
        # a sequence goes on with the next photo
        say_if_late(console, document)
    console.print(f"report: {folder / 'report.html'}")
    return document


def _introduce(console: Console, job: Certification, plan: Sequence[str]) -> None:
    method = job.job.method
    console.print(f"{method.name}: {method.content}; {job.question.name}; {job.property.sentence()}")
    for warning in job.job.warnings:
        console.print(f"warning: {warning}")
    for note in plan:
        console.print(f"  {note}")


def certify_path(options: Certify, stop: SignalStop) -> bool:
    """Search the frames and write the results; returns whether every frame has one."""
    console = plain_console()
    workers = options.where.processes
    memory = network_memory(options.memory_limit, workers)
    with stop.at_once():
        job = open_certification(dataclasses.replace(options.settings, memory=memory))
        check_network_memory(job, options.memory_limit, workers)
        frames = check_frames(options.frames, job.job.frame_count)
        question = CertificateQuestion(job, frames, stated(options), ("ns-abstract-certify", *sys.argv[1:]))
    budget = options.time_budget or _CERTIFY_SECONDS
    document = searched(
        question, options.output_dir, options.where, stop, console, job.job, frames[0],
        Request(budget, options.resume, rows=False, scene_margin=options.scene_margin),
        kept_cells,
        lambda: _introduce(console, job, question.about.plan),
    )  # fmt: skip
    covered = coverage(document["frames"])
    parts = ", ".join(f"{kind} {percent(covered[kind])}" for kind in ("certified", "falsified", "unknown"))
    left = f" (of it not examined {percent(covered['not_examined'])})" if covered["not_examined"] else ""
    console.print(f"{document['verdict']}: {parts}{left}")
    if (proved := document["certified_of_sampled_right"]) is not None:
        console.print(f"of the sampled poses where the property holds, {percent(min(1.0, proved))} are proved")
    if document["partitions"]:
        both = document["partitions"]
        more = f", {percent(both['undecided'])} unknown (no finite margin)" if both["undecided"] else ""
        text = f"{percent(both['PCP-V'])} are proved (PCP-V), {percent(both['PCP-S'])} right at every sample (PCP-S)"
        console.print(f"of {both['partitions']:,} fixed parts, {text}{more}")
    say_if_late(console, document)
    console.print(f"report: {options.output_dir / 'report.html'}")
    return all(entry["sampled"]["poses"] for entry in document["frames"])
