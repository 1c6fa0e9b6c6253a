"""The work of ``ns-abstract-render``; imported only when it is asked for."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ns_abstract.arithmetic.selfcheck import check_functions
from ns_abstract.pipeline import LEAST_SECONDS, Job, Settings, check_frames
from ns_abstract.refine.result import FrameResult, TracePoint
from ns_abstract.report.record import Report, Run

if TYPE_CHECKING:
    from ns_abstract.cli.render import Render


def settings_of(options: Render) -> Settings:
    """The part of the options that says what is bounded."""
    names = {field.name for field in dataclasses.fields(Settings)}
    given = {name: value for name, value in vars(options).items() if name in names}
    if options.workers is None:
        given["workers"] = 1 if options.engine == "dask" else len(os.sched_getaffinity(0))
    return Settings(**given)


def make_run(job: Job, options: Render, frames: tuple[int, ...], problems: list[str]) -> Run:
    """What the report says about the command; ``problems`` of the platform take the guarantee away."""
    guarantee = "sampled" if problems else job.method.guarantee
    limits = [f"The platform's arithmetic failed the self-check, so nothing is guaranteed: {p}" for p in problems]
    return Run(
        guarantee=guarantee,
        renderer=job.method.program,
        scene=job.describe(),
        frames=frames,
        fingerprint=job.fingerprint,
        settings=dataclasses.asdict(options),
        plan=job.plan,
        command=("ns-abstract-render", *sys.argv[1:]),
        limits=tuple(limits),
    )


def render_path(options: Render, stop: Callable[[], bool], seconds_by_frame: float) -> bool:
    """Bound the frames and write the results; returns whether every frame has one.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    console = Console(stderr=True, highlight=False)
    job = Job(settings_of(options))
    frames = check_frames(options.frames, job.frame_count)
    problems = check_functions()
    with ExitStack() as stack:
        client = None
        if options.engine == "dask":
            from ns_abstract.cli.cluster import local_workers
            from ns_abstract.engines import connected

            client = stack.enter_context(connected(options.scheduler_address, local_workers(job)))
        run = make_run(job, options, frames, problems)
        report = (Report.resume if options.resume else Report)(options.output_dir, run)
        for problem in problems:
            console.print(f"warning: {problem}", markup=False)
        for reason in report.ignored:
            console.print(f"not used: {reason}", markup=False)
        _introduce(console, job, report)
        _fill(report, job, options, client, stop, console, seconds_by_frame)
    if report.missing:
        console.print(f"no bounds yet for frames {', '.join(map(str, report.missing))}: raise --time-budget, --resume")
    console.print(f"report: {options.output_dir / 'report.html'}", markup=False, soft_wrap=True)
    return not report.missing


def _fill(
    report: Report,
    job: Job,
    options: Render,
    client: Any,
    stop: Callable[[], bool],
    console: Console,
    seconds_by_frame: float,
) -> None:
    """Bound what is pending and write it, here or through the Dask ``client``."""
    # a frame without bounds comes before one that could be tighter
    missing = set(report.missing)
    pending = sorted(report.pending, key=lambda index: index not in missing)
    budget = options.time_budget if options.time_budget is not None else seconds_by_frame * max(1, len(pending))
    try:
        if client is not None:
            from ns_abstract.cli.cluster import bound_on_cluster

            results = bound_on_cluster(client, job, options, pending, budget, stop)
        else:
            results = _bound_here(job, options, pending, budget, stop, console)
        for result in results:
            entry = report.add(result)
            _tell(console, entry)
    finally:
        # also after a failure: what is finished is written
        report.finish("interrupted" if stop() else "budget" if report.missing else "done")


def _introduce(console: Console, job: Job, report: Report) -> None:
    scene = job.scene
    program = job.method.program
    console.print(f"{scene.name}: {job.method.content}, {program['name']} {program['version']}", markup=False)
    for note in (*scene.notes, *job.plan):
        console.print(f"  {note}", markup=False, soft_wrap=True)
    if report.kept:
        console.print(f"  kept from before: frames {', '.join(map(str, report.kept))}", markup=False)


def _tell(console: Console, entry: dict[str, Any]) -> None:
    if entry["status"] == "missing":
        console.print(f"frame {entry['index']}: no bounds before the time was over", markup=False)
        return
    ratio = "" if entry["ratio"] is None else f", {entry['ratio']:.3f} times the renders'"
    console.print(
        f"frame {entry['index']}: mean gap {entry['mpg']:.4f}{ratio}, {entry['cells']} cells, "
        f"{entry['seconds']:.1f} s, {entry['status']}",
        markup=False,
    )
    for sentence in entry["plan"]:
        console.print(f"  {sentence}", markup=False, soft_wrap=True)


def _bound_here(
    job: Job, options: Render, pending: list[int], budget: float, stop: Callable[[], bool], console: Console
) -> Iterator[FrameResult]:
    """Frame after frame on this machine; what one leaves of the time is shared by the rest."""
    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[state]}"),
        TimeElapsedColumn(),
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )
    with progress:
        whole = progress.add_task("frames", total=max(1, len(pending)), state="compiling kernels on first use")
        job.warm_up(pending[0] if pending else None)
        deadline = time.perf_counter() + budget
        for done, index in enumerate(pending):
            # one frame is always tried, so that resuming with any budget gets on
            if stop() or (done and time.perf_counter() >= deadline):
                return
            share = max(LEAST_SECONDS, (deadline - time.perf_counter()) / (len(pending) - done))
            meter = _Meter(progress, whole, done, index, share, options.target_ratio)
            yield job.bound(
                index,
                job.goal(options.target_ratio, share),
                keep_leaves=options.save_cells,
                stopped=stop,
                progress=meter,
            )
            progress.update(whole, completed=done + 1)


class _Meter:
    """Turns a frame's trace into a progress bar with the current ratio and an estimate of the rest."""

    def __init__(self, progress: Progress, task: Any, done: int, index: int, seconds: float, target: float) -> None:
        self.progress, self.task, self.done, self.index = progress, task, done, index
        self.seconds, self.target = seconds, target
        self.first: TracePoint | None = None

    def __call__(self, point: TracePoint, cover: float) -> None:
        part = min(0.99, point.seconds / self.seconds)
        if cover < 1.0:
            state = f"frame {self.index}: covering the set, {cover:.0%}"
        else:
            ratio = point.mpg / point.mpg_witness if point.mpg_witness > 0.0 else float("inf")
            left = self._left(point, ratio)
            state = f"frame {self.index}: ratio {ratio:.3f} (target {self.target:g}), {left:.0f} s left"
            part = max(part, min(0.99, point.seconds / (point.seconds + left))) if left > 0.0 else part
        self.progress.update(self.task, completed=self.done + part, state=state)

    def _left(self, point: TracePoint, ratio: float) -> float:
        """Seconds to the target if ``ratio - 1`` goes on falling in proportion to 1 / time; at most the budget."""
        rest = max(0.0, self.seconds - point.seconds)
        goal = self.target - 1.0
        if goal <= 0.0 or ratio <= self.target:
            return rest if goal <= 0.0 else 0.0
        return min(rest, point.seconds * ((ratio - 1.0) / goal - 1.0))
