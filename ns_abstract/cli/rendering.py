"""The work of ``ns-abstract-render``; imported only when it is asked for."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rich.console import Console

from ns_abstract.api import bounding
from ns_abstract.api.compiling import compile_beside
from ns_abstract.api.explaining import check_explained, explain
from ns_abstract.api.files import open_job
from ns_abstract.api.job import Job, check_frames, platform_problems
from ns_abstract.cli.common import SignalStop, plain_console
from ns_abstract.cli.frames import run_record, seconds_of, tell_missing, tell_problems
from ns_abstract.execution.engines import Engine
from ns_abstract.io.folder import claim
from ns_abstract.refine.result import Leaves
from ns_abstract.report.figures import listed
from ns_abstract.report.progress import ProgressBar
from ns_abstract.report.record import Report

if TYPE_CHECKING:
    from ns_abstract.cli.commands import Render

#: Bytes of linear sets by frame up to which they are stored without --save-cells, and cells that a small frame takes.
_SMALL_LEAVES, _USUAL_CELLS = 8 << 20, 16


def render_path(options: Render, stop: SignalStop) -> bool:
    """Bound the frames and write the results; returns whether every frame has one.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    console, folder = plain_console(), options.output_dir
    assert folder is not None
    with stop.at_once():
        job = open_job(options.settings)
        frames = check_frames(options.frames, job.frame_count)
        if options.explain:
            check_explained(job)
        problems = platform_problems()
    with ExitStack() as stack:
        # before the workers: another command may be writing there
        stack.enter_context(claim(folder))
        # frames follow one another in this process; a NeRF has processes of its own
        workers = bounding.local_workers(job) if options.where.engine == "dask" else 1
        engine = stack.enter_context(options.where.started(workers))
        run = run_record("ns-abstract-render", job, options, frames, problems)
        report = (Report.resume if options.resume else Report)(folder, run)
        tell_problems(console, report, problems)
        _introduce(console, job, report)
        stack.enter_context(stop.last_words(report.interrupted))
        _fill(report, job, options, engine, stop, console)
    tell_missing(console, report)
    console.print(f"report: {folder / 'report.html'}")
    return not report.missing


def _fill(report: Report, job: Job, options: Render, engine: Engine, stop: SignalStop, console: Console) -> None:
    """Bound what is pending and write it."""
    # a frame without bounds comes before one that could be tighter
    missing = set(report.missing)
    pending = sorted(report.pending, key=lambda index: index not in missing)
    budget = seconds_of(options, pending)
    small = bool(pending) and _leaf_bytes(job, pending[0]) * _USUAL_CELLS <= _SMALL_LEAVES
    try:
        if pending and options.where.engine == "local":
            with stop.at_once():
                compile_beside(job, report.pending[0])
        with ProgressBar(console) as progress:
            results = bounding.bound_frames(
                job, pending, engine=engine, budget=budget, target_ratio=options.target_ratio,
                keep_leaves=options.save_cells or options.explain or small, stop=stop, on_progress=progress,
                found_before=report.stored,
            )  # fmt: skip
            for result in results:
                # first what was asked for: drawing loads matplotlib
                leaves = result.leaves if options.save_cells or (small and _fits(result.leaves)) else None
                stored_result = replace(result, leaves=leaves)
                _tell(console, report.add(stored_result, picture=False))
                report.draw(result.index)
                if options.explain and result.bounded and not stop():
                    with stop.at_once():
                        lines = tuple(explain(job, result.index, result, options.seed).lines())
                    report.explain(result.index, lines)
                    for line in lines[1:]:
                        console.print(line)
    finally:
        # also after a failure: what is finished is written
        report.finish("interrupted" if stop() else "budget" if report.missing else "done")


def _leaf_bytes(job: Job, index: int) -> int:
    """Bytes of the linear sets of one cell of a frame."""
    camera, box = job.pose_sets[index].camera, job.pose_sets[index].box
    return 0 if job.rays else camera.width * camera.height * 3 * 2 * (box.dimensions + 1) * 4


def _fits(leaves: Leaves | None) -> bool:
    """Whether linear sets are few enough to be stored without being asked for."""
    return leaves is not None and sum(getattr(leaves, name).nbytes for name in vars(leaves)) <= _SMALL_LEAVES


def _introduce(console: Console, job: Job, report: Report) -> None:
    method = job.method
    program = method.program
    about = f"{method.name}: {method.content}, {program['name']} {program['version']}"
    console.print(about)
    for warning in job.warnings:
        console.print(f"warning: {warning}")
    for note in (*method.notes, *(note for note in job.notes if note not in job.warnings), *job.plan):
        console.print(f"  {note}")
    if report.kept:
        console.print(f"  kept from before: frames {listed(report.kept)}")


def _tell(console: Console, entry: dict[str, Any]) -> None:
    if entry["status"] == "missing":
        console.print(f"frame {entry['index']}: no bounds before the time was over")
        return
    ratio = "" if entry["ratio"] is None else f", at most {entry['ratio']:.3f} times the true one"
    console.print(
        f"frame {entry['index']}: mean gap {entry['mpg']:.4f}{ratio}, {entry['cells']} cells, "
        f"{entry['seconds']:.1f} s, {entry['status']}"
    )
    for sentence in entry["plan"]:
        console.print(f"  {sentence}")
