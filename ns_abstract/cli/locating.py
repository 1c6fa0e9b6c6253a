"""The work of ``ns-abstract-locate``; imported only when it is asked for."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ns_abstract.api.cell_search import CellSearch, Request
from ns_abstract.api.compiling import compile_beside
from ns_abstract.api.job import check_frames
from ns_abstract.api.locating import LocateProgress, LocationQuestion
from ns_abstract.api.location import open_location
from ns_abstract.cli.common import SignalStop, plain_console
from ns_abstract.cli.options import stated
from ns_abstract.report.figures import percent
from ns_abstract.verify.store import Store

if TYPE_CHECKING:
    from ns_abstract.cli.locate import Locate

#: Seconds where no time budget is given.
_SECONDS = 600.0
_ANSWERS = {
    "none": "none: no pose of the set made the photo",
    "possible": "possible: a rendered pose explains the photo",
    "unknown": "unknown: no rendered pose explains the photo",
}


def locate_photo(options: Locate, stop: SignalStop) -> None:
    """Search the frames and write the results.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    console = plain_console()
    with stop.at_once():
        location = open_location(options.settings)
        frames = check_frames(options.frames, location.job.frame_count)
        question = LocationQuestion(location, frames, stated(options), ("ns-abstract-locate", *sys.argv[1:]))
    method, photo = location.job.method, location.photo
    console.print(
        f"{method.name}: {method.content}; {photo.allowed} of {int(photo.counted.sum())} pixels may show anything",
        markup=False,
    )
    for note in question.about.plan:
        console.print(f"  {note}", markup=False, soft_wrap=True)

    def opened(store: Store) -> None:
        if store.resumed:
            console.print(f"  {store.open_blocks} cells open from before", markup=False)
        if options.where.engine == "local":
            # once, and not in every worker
            with stop.at_once():
                compile_beside(location.job, frames[0])

    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn(),
        console=console, disable=not console.is_terminal, transient=True,
    )  # fmt: skip
    with progress:
        task = progress.add_task("poses", total=1.0, state="")

        def on_progress(point: LocateProgress) -> None:
            best = "" if point.outliers is None else f", best pose misses {point.outliers} pixels"
            progress.update(task, completed=1.0 - point.left, state=f"{percent(point.left)} left{best}")

        document = CellSearch(question, options.output_dir).run(
            lambda stack: stack.enter_context(
                options.where.started(1 if location.job.rays else options.where.processes)
            ),
            stop,
            Request(options.time_budget or _SECONDS, options.resume, on_open=opened, on_progress=on_progress),
        )
    left = percent(document["possible_volume"])
    console.print(f"{_ANSWERS[document['answer']]}; {left} of the set left", markup=False)
    if document["answer"] != "possible" and document["best"] is not None:
        missed = document["best"]["outliers"]
        text = f"  best pose misses {missed} pixels: --noise and --outliers must allow the scene's own error"
        console.print(text, markup=False, soft_wrap=True)
    console.print(f"report: {options.output_dir / 'report.html'}", markup=False, soft_wrap=True)
