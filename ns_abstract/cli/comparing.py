"""The work of ``ns-abstract-compare``; imported only when it is asked for."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from rich.console import Console

from ns_abstract.api import bounding
from ns_abstract.api.comparing import ComparisonJob, check_comparison, open_comparison
from ns_abstract.api.compiling import compile_beside
from ns_abstract.api.job import check_frames, platform_problems
from ns_abstract.cli.common import SignalStop, plain_console
from ns_abstract.cli.frames import run_record, seconds_of, tell_missing, tell_problems
from ns_abstract.io.folder import claim
from ns_abstract.report.comparison import ComparisonReport
from ns_abstract.report.figures import listed, number
from ns_abstract.report.progress import ProgressBar, ShownProgress

if TYPE_CHECKING:
    from ns_abstract.cli.commands import Compare


def compare_path(options: Compare, stop: SignalStop) -> bool:
    """Bound the frames and write the results; returns whether every frame has one.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    check_comparison(options.tolerance, options.target_ratio, options.time_budget)
    console, folder = plain_console(), options.output_dir
    with stop.at_once():
        job = open_comparison(options.settings, options.other_source, options.tolerance)
        frames = check_frames(options.frames, job.frame_count)
        problems = platform_problems()
    with ExitStack() as stack:
        stack.enter_context(claim(folder))
        workers = bounding.local_workers(job) if options.where.engine == "dask" else 1
        engine = stack.enter_context(options.where.started(workers))
        run = run_record("ns-abstract-compare", job, options, frames, problems)
        report = ComparisonReport(folder, run, job.pictures, options.tolerance, keep_stored=options.resume)
        tell_problems(console, report, problems)
        _introduce(console, job, report)
        stack.enter_context(stop.last_words(report.interrupted))
        pending = report.pending
        budget = seconds_of(options, pending)
        try:
            if pending and options.where.engine == "local":
                with stop.at_once():
                    compile_beside(job, pending[0])
            with ProgressBar(console) as progress:

                def on_progress(point: bounding.Progress) -> None:
                    text = f"frame {point.frame}: at most {number(point.mpg)}, rendered {number(point.mpg_witness)}"
                    # mpg is a difference here, which the sentence of bounds would misname
                    progress(ShownProgress(point.done, text, point.elapsed, point.total_budget))

                results = bounding.bound_frames(
                    job, pending, engine=engine, budget=budget, target_ratio=options.target_ratio, stop=stop,
                    on_progress=on_progress, found_before=report.stored,
                )  # fmt: skip
                for result in results:
                    _tell(console, report.add(result, picture=False))
                    report.draw(result.index)
        finally:
            # also after a failure: what is finished is written
            document = report.finish("interrupted" if stop() else "budget" if report.missing else "done")
    tell_missing(console, report)
    if not report.missing and options.tolerance is not None:
        console.print(f"{document['verdict']}: tolerance {number(options.tolerance)}")
    console.print(f"report: {folder / 'report.html'}")
    return not report.missing


def _introduce(console: Console, job: ComparisonJob, report: ComparisonReport) -> None:
    for letter, method in (("A", job.method), ("B", job.other.method)):
        program = method.program
        console.print(f"{letter}: {method.name}: {method.content}, {program['name']} {program['version']}")
        for note in method.notes:
            console.print(f"  {note}")
    for warning in job.warnings:
        console.print(f"warning: {warning}")
    for note in (*(note for note in job.notes if note not in job.warnings), *job.plan):
        console.print(f"  {note}")
    console.print(f"  frame: {job.frame_choice.origin}")
    if job.background_choice is not None:
        console.print(f"  background: {job.background_choice.value}, {job.background_choice.origin}")
    if report.kept:
        console.print(f"  kept from before: frames {listed(report.kept)}")


def _tell(console: Console, entry: dict[str, Any]) -> None:
    if entry["status"] == "missing":
        console.print(f"frame {entry['index']}: no bounds before the time was over")
        return
    console.print(
        f"frame {entry['index']}: largest difference at most {number(entry['largest_upper'])}, rendered "
        f"{number(entry['largest_lower'])}; mean at most {number(entry['mean_upper'])}, rendered "
        f"{number(entry['mean_lower'])}; {entry['seconds']:.1f} s, {entry.get('verdict', entry['status'])}"
    )  # fmt: skip
