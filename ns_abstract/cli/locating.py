"""The work of ``ns-abstract-locate``; imported only when it is asked for."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ns_abstract.api.cell_search import CellSearch, Request
from ns_abstract.api.compiling import compile_beside
from ns_abstract.api.job import check_frames
from ns_abstract.api.locating import LocationQuestion
from ns_abstract.api.location import Location, open_location
from ns_abstract.api.sequence import open_sequence
from ns_abstract.cli.common import SignalStop, plain_console
from ns_abstract.cli.options import stated
from ns_abstract.report.figures import listed, percent
from ns_abstract.report.progress import ProgressBar
from ns_abstract.verify.store import Store

if TYPE_CHECKING:
    from ns_abstract.cli.commands import Locate

#: Seconds where no time budget is given.
_SECONDS = 600.0
_ANSWERS = {
    "none": "none: no pose of the set made the photo",
    "possible": "possible: a rendered pose explains the photo",
    "unknown": "unknown: no rendered pose explains the photo",
}


def locate_photos(options: Locate, stop: SignalStop) -> None:
    """Search the frames for one photo or for a sequence of them, and write the results.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    console = plain_console()
    if options.image_sequence is None:
        with stop.at_once():
            location = open_location(options.settings)
            frames = check_frames(options.frames, location.job.frame_count)
        _tell(console, location)
        _search(options, stop, console, location, frames, options.output_dir)
        return
    with stop.at_once():
        settings = options.settings
        assert options.motion is not None
        photos = open_sequence(
            settings, options.image_sequence, options.motion, options.output_dir, options.frames, options.resume
        )
    _tell(console, photos.first)

    def search(location: Location, frames: tuple[int, ...], folder: Path) -> dict[str, Any]:
        console.print(f"{location.file}")
        return _search(options, stop, console, location, frames, folder)

    document = photos.follow(search)
    if document["not_examined"] and document["state"] == "done":
        text = f"none: no pose explains {document['images'][-1]['image']['name']}, {document['not_examined']} after it"
        console.print(f"{text} not examined")
    console.print(f"report: {options.output_dir / 'report.json'}")


def _tell(console: Any, location: Location) -> None:
    """Print what is looked for."""
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
    options: Locate, stop: SignalStop, console: Any, location: Location, frames: tuple[int, ...], folder: Path
) -> dict[str, Any]:
    """Locate one photo; returns the content of its report.json."""
    # a photo of a sequence that was not begun has no folder yet
    resume = options.resume and (options.image_sequence is None or (folder / "cells.sqlite").exists())
    question = LocationQuestion(location, frames, stated(options), ("ns-abstract-locate", *sys.argv[1:]))
    for note in question.about.plan:
        console.print(f"  {note}")

    def opened(store: Store) -> None:
        if store.resumed:
            console.print(f"  {store.open_blocks} cells still to be examined from before")
        if options.where.engine == "local":
            # once, and not in every worker
            with stop.at_once():
                compile_beside(location.job, frames[0])

    with ProgressBar(console) as progress:
        document = CellSearch(question, folder).run(
            lambda stack: stack.enter_context(
                options.where.started(1 if location.job.rays else options.where.processes)
            ),
            stop,
            Request(options.time_budget or _SECONDS, resume, on_open=opened, on_progress=progress),
        )
    left = percent(document["possible_volume"])
    console.print(f"{_ANSWERS[document['answer']]}; {left} of the set left")
    late = [entry["index"] for entry in document["frames"] if entry["best"] is None and entry["possible_volume"] > 0.0]
    if document["state"] != "done" and late:
        console.print(f"  not examined before the time was over: frames {listed(late)}; give more --time-budget")
    elif document["answer"] != "possible" and document["best"] is not None and document["state"] == "done":
        missed = document["best"]["outliers"]
        text = f"  best pose misses {missed} pixels: --noise and --outliers must allow the scene's own error"
        console.print(text)
    console.print(f"report: {folder / 'report.html'}")
    return document
