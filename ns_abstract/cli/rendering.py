"""The work of ``ns-abstract-render`` and ``ns-abstract-compare``; imported only when it is asked for."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, TypeVar

from rich.console import Console

from ns_abstract.api import bounding
from ns_abstract.api.comparing import check_comparison, open_comparison
from ns_abstract.api.compiling import compile_beside
from ns_abstract.api.explaining import check_explained, explain
from ns_abstract.api.files import open_job
from ns_abstract.api.job import Job, check_frames, platform_problems
from ns_abstract.cli.commands import Compare, Render
from ns_abstract.cli.common import SignalStop
from ns_abstract.cli.sets import stated
from ns_abstract.io.folder import claim
from ns_abstract.refine.protocol import Method
from ns_abstract.refine.result import FrameResult, Leaves
from ns_abstract.report.comparison import ComparisonReport
from ns_abstract.report.figures import frames_listed, number
from ns_abstract.report.progress import ProgressBar, ShownProgress, plain_console
from ns_abstract.report.record import Report, RunRecord, failed_self_check

R = TypeVar("R", bound=Report)
#: Seconds by frame where no time budget is given.
_SECONDS_BY_FRAME = 60.0
#: Bytes of linear sets by frame up to which they are stored without --save-cells, and cells that a small frame takes.
_SMALL_LEAVES, _USUAL_CELLS = 8 << 20, 16


def render_path(options: Render, stop: SignalStop) -> bool:
    """Bound the frames and write the results; returns whether every frame has one."""
    console, folder = plain_console(), options.output_dir
    assert folder is not None
    with stop.at_once():
        job = open_job(options.settings)
        if options.explain:
            check_explained(job)
    small = _leaf_bytes(job) * _USUAL_CELLS <= _SMALL_LEAVES

    def take(report: Report, result: FrameResult) -> None:
        leaves = result.leaves if options.save_cells or (small and _fits(result.leaves)) else None
        _tell(console, report.add(replace(result, leaves=leaves), picture=False), _bounds_lines)
        report.draw(result.index)
        if options.explain and result.bounded and not stop():
            with stop.at_once():
                lines = tuple(explain(job, result.index, result, options.seed).lines())
            report.explain(result.index, lines)
            for line in lines[1:]:
                console.print(line)

    report = _bounded(
        options, stop, console, job,
        lambda run: Report(folder, run, keep_stored=options.resume),
        lambda report: _introduce(console, job, report, {"": job.method}),
        take,
        keep_leaves=options.save_cells or options.explain or small,
    )  # fmt: skip
    console.print(f"report: {folder / 'report.html'}")
    return not report.missing


def compare_path(options: Compare, stop: SignalStop) -> bool:
    """Bound the frames and write the results; returns whether every frame has one."""
    check_comparison(options.tolerance, options.target_ratio, options.time_budget)
    console, folder = plain_console(), options.output_dir
    with stop.at_once():
        job = open_comparison(options.settings, options.other_source, options.tolerance)
    more = [f"frame: {job.frame_choice.origin}"]
    if job.background_choice is not None:
        more.append(f"background: {job.background_choice.value}, {job.background_choice.origin}")

    def take(report: ComparisonReport, result: FrameResult) -> None:
        _tell(console, report.add(result, picture=False), _difference_lines)
        report.draw(result.index)

    def shown(progress: ProgressBar) -> Callable[[bounding.Progress], None]:
        def show(point: bounding.Progress) -> None:
            text = f"frame {point.frame}: at most {number(point.mpg)}, rendered {number(point.mpg_witness)}"
            # mpg is a difference here, which the sentence of bounds would misname
            progress(ShownProgress(point.done, text, point.elapsed, point.total_budget))

        return show

    report = _bounded(
        options, stop, console, job,
        lambda run: ComparisonReport(folder, run, job.pictures, options.tolerance, keep_stored=options.resume),
        lambda report: _introduce(console, job, report, {"A: ": job.method, "B: ": job.other.method}, more),
        take,
        shown=shown,
    )  # fmt: skip
    if not report.missing and options.tolerance is not None:
        console.print(f"{report.document()['verdict']}: tolerance {number(options.tolerance)}")
    console.print(f"report: {folder / 'report.html'}")
    return not report.missing


def _bounded(
    options: Render | Compare,
    stop: SignalStop,
    console: Console,
    job: Job,
    make: Callable[[RunRecord], R],
    introduce: Callable[[R], None],
    take: Callable[[R, FrameResult], None],
    *,
    keep_leaves: bool = False,
    shown: Callable[[ProgressBar], Callable[[bounding.Progress], None]] = lambda progress: progress,
) -> R:
    """Bound what is pending of the frames, and return the finished report.

    Args:
        make: Opens the report on a run.
        introduce: Prints what is bounded.
        take: Writes a result as it comes.
        shown: What of the progress the bar shows.
    """
    folder = options.output_dir
    assert folder is not None
    with stop.at_once():
        frames = check_frames(options.frames, job.frame_count)
        problems = platform_problems()
    with ExitStack() as stack:
        # before the workers: another command may be writing there
        stack.enter_context(claim(folder))
        # frames follow one another in this process; a NeRF has processes of its own
        workers = bounding.local_workers(job) if options.where.engine == "dask" else 1
        engine = stack.enter_context(options.where.started(workers))
        report = make(_run_record(job, options, frames, problems))
        failed = True
        try:
            for text in (*(f"warning: {p}" for p in problems), *(f"not used: {reason}" for reason in report.ignored)):
                console.print(text)
            introduce(report)
            stack.enter_context(stop.last_words(report.interrupted))
            # a frame without bounds comes before one that could be tighter
            missing = set(report.missing)
            pending = sorted(report.pending, key=lambda index: index not in missing)
            budget = _SECONDS_BY_FRAME * max(1, len(pending)) if options.time_budget is None else options.time_budget
            if pending and options.where.engine == "local":
                with stop.at_once():
                    compile_beside(job, pending[0])
            with ProgressBar(console) as progress:
                results = bounding.bound_frames(
                    job, pending, engine=engine, budget=budget, target_ratio=options.target_ratio,
                    keep_leaves=keep_leaves, stop=stop, on_progress=shown(progress), found_before=report.stored,
                )  # fmt: skip
                for result in results:
                    take(report, result)
            failed = False
        finally:
            # also after a failure: what is finished is written
            report.finish("interrupted" if stop() or failed else "budget" if report.missing else "done")
    if report.missing:
        console.print(f"no bounds yet for {frames_listed(report.missing)}: raise --time-budget, --resume")
    _say_what_next(console, report, pending)
    return report


def _say_what_next(console: Console, report: Report, pending: Sequence[int]) -> None:
    """Print which frames ended before the target, or, if none was ``pending``, that all had reached it."""
    if partial := sorted(set(report.pending) - set(report.missing)):
        console.print(f"{frames_listed(partial)} ended before the target: go on with --resume")
    elif not pending:
        console.print("every frame has reached the target: nothing is left to do but for a stricter one")


def _run_record(job: Job, options: Render | Compare, frames: tuple[int, ...], problems: tuple[str, ...]) -> RunRecord:
    """Return the report's record of the command; ``problems`` of the platform make the guarantee "sampled"."""
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
        command=(f"ns-abstract-{type(options).__name__.lower()}", *sys.argv[1:]),
        limits=tuple(map(failed_self_check, problems)),
        size=(camera.height, camera.width),
        intrinsics={frame: job.pose_sets[frame].camera.intrinsics._asdict() for frame in frames},
    )


def _leaf_bytes(job: Job) -> int:
    """Return the bytes of the float32 linear sets of one cell of the first frame; 0 for a job that bounds rays."""
    camera, box = job.pose_sets[0].camera, job.pose_sets[0].box
    return 0 if job.rays else camera.width * camera.height * 3 * 2 * (box.dimensions + 1) * 4


def _fits(leaves: Leaves | None) -> bool:
    """Whether linear sets exist and take at most `_SMALL_LEAVES` bytes, so that they are stored by default."""
    return leaves is not None and sum(getattr(leaves, name).nbytes for name in vars(leaves)) <= _SMALL_LEAVES


def _introduce(
    console: Console, job: Job, report: Report, methods: dict[str, Method], more: Sequence[str] = ()
) -> None:
    for letter, method in methods.items():
        program = method.program
        console.print(f"{letter}{method.name}: {method.content}, {program['name']} {program['version']}")
        for note in method.notes:
            console.print(f"  {note}")
    for warning in job.warnings:
        console.print(f"warning: {warning}")
    for note in (*(note for note in job.notes if note not in job.warnings), *job.plan, *more):
        console.print(f"  {note}")
    if report.kept:
        console.print(f"  kept from before: {frames_listed(report.kept)}")


def _tell(console: Console, entry: dict[str, Any], lines: Callable[[dict[str, Any]], Sequence[str]]) -> None:
    if entry["status"] == "missing":
        console.print(f"frame {entry['index']}: no bounds before the time was over")
        return
    first, *others = lines(entry)
    console.print(f"frame {entry['index']}: {first}")
    for line in others:
        console.print(f"  {line}")


def _bounds_lines(entry: dict[str, Any]) -> Sequence[str]:
    ratio = "" if entry["ratio"] is None else f", at most {entry['ratio']:.3f} times the true one"
    effort = f"{entry['cells']} cells, {entry['seconds']:.1f} s, {entry['status']}"
    return [f"mean gap {entry['mpg']:.4f}{ratio}, {effort}", *entry["plan"]]


def _difference_lines(entry: dict[str, Any]) -> Sequence[str]:
    return [
        f"largest difference at most {number(entry['largest_upper'])}, rendered {number(entry['largest_lower'])}; "
        f"mean at most {number(entry['mean_upper'])}, rendered {number(entry['mean_lower'])}; "
        f"{entry['seconds']:.1f} s, {entry.get('verdict', entry['status'])}"
    ]
