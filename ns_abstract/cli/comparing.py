"""The work of ``ns-abstract-compare``; imported only when it is asked for."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ns_abstract.api import bounding
from ns_abstract.api.comparing import ComparisonJob, check_comparison, open_comparison
from ns_abstract.api.compiling import compile_beside
from ns_abstract.api.job import check_frames, platform_problems
from ns_abstract.cli.common import SignalStop, plain_console
from ns_abstract.cli.options import stated
from ns_abstract.io.folder import claim
from ns_abstract.report.comparison import ComparisonReport
from ns_abstract.report.figures import listed, number
from ns_abstract.report.record import RunRecord, failed_self_check

if TYPE_CHECKING:
    from ns_abstract.cli.commands import Compare

#: Seconds by frame where no time budget is given.
_SECONDS_BY_FRAME = 60.0


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
        run = _run_record(job, options, frames, problems)
        report = ComparisonReport(folder, run, job.pictures, options.tolerance, keep_stored=options.resume)
        for problem in problems:
            console.print(f"warning: {problem}", markup=False)
        for reason in report.ignored:
            console.print(f"not used: {reason}", markup=False)
        _introduce(console, job, report)
        stack.enter_context(stop.last_words(report.interrupted))
        pending = report.pending
        budget = options.time_budget if options.time_budget is not None else _SECONDS_BY_FRAME * max(1, len(pending))
        progress = Progress(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn(),
            console=console, disable=not console.is_terminal, transient=True,
        )  # fmt: skip
        try:
            if pending and options.where.engine == "local":
                with stop.at_once():
                    compile_beside(job, pending[0])
            with progress:
                task = progress.add_task("frames", total=max(1, len(pending)), state="compiling kernels on first use")

                def on_progress(point: bounding.Progress) -> None:
                    state = f"frame {point.frame}: at most {number(point.mpg)}, rendered {number(point.mpg_witness)}"
                    done = point.frames_done + min(0.99, point.seconds / point.budget)
                    progress.update(task, completed=done, state=state)

                results = bounding.bound_frames(
                    job, pending, engine=engine, budget=budget, target_ratio=options.target_ratio, stop=stop,
                    on_progress=on_progress, found_before=report.stored,
                )  # fmt: skip
                for done, result in enumerate(results, 1):
                    _tell(console, report.add(result, picture=False))
                    report.draw(result.index)
                    progress.update(task, completed=done)
        finally:
            # also after a failure: what is finished is written
            document = report.finish("interrupted" if stop() else "budget" if report.missing else "done")
    if report.missing:
        console.print(
            f"no bounds yet for frames {listed(report.missing)}: raise --time-budget, --resume", soft_wrap=True
        )
    elif options.tolerance is not None:
        console.print(f"{document['verdict']}: tolerance {number(options.tolerance)}", markup=False)
    console.print(f"report: {folder / 'report.html'}", markup=False, soft_wrap=True)
    return not report.missing


def _run_record(job: ComparisonJob, options: Compare, frames: tuple[int, ...], problems: tuple[str, ...]) -> RunRecord:
    """What the report says about the command; ``problems`` of the platform take the guarantee away."""
    camera = job.pose_sets[0].camera
    return RunRecord(
        guarantee="sampled" if problems else job.method.guarantee,
        renderer=job.method.program,
        scene=job.describe(),
        assumptions=job.assumptions,
        frames=frames,
        fingerprint=job.fingerprint,
        settings=stated(options),
        plan=job.plan,
        command=("ns-abstract-compare", *sys.argv[1:]),
        limits=tuple(map(failed_self_check, problems)),
        size=(camera.height, camera.width),
    )


def _introduce(console: Console, job: ComparisonJob, report: ComparisonReport) -> None:
    for letter, method in (("A", job.method), ("B", job.other.method)):
        program = method.program
        console.print(
            f"{letter}: {method.name}: {method.content}, {program['name']} {program['version']}", markup=False
        )
        for note in method.notes:
            console.print(f"  {note}", markup=False, soft_wrap=True)
    for note in (*job.notes, *job.plan):
        console.print(f"  {note}", markup=False, soft_wrap=True)
    console.print(f"  frame: {job.frame_choice.origin}", markup=False, soft_wrap=True)
    if report.kept:
        console.print(f"  kept from before: frames {listed(report.kept)}", markup=False, soft_wrap=True)


def _tell(console: Console, entry: dict[str, Any]) -> None:
    if entry["status"] == "missing":
        console.print(f"frame {entry['index']}: no bounds before the time was over", markup=False)
        return
    console.print(
        f"frame {entry['index']}: largest difference at most {number(entry['largest_upper'])}, rendered "
        f"{number(entry['largest_lower'])}; mean at most {number(entry['mean_upper'])}, rendered "
        f"{number(entry['mean_lower'])}; {entry['seconds']:.1f} s, {entry.get('verdict', entry['status'])}",
        markup=False, soft_wrap=True,
    )  # fmt: skip
