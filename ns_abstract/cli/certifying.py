"""The work of ``ns-abstract-certify``; imported only when it is asked for."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ns_abstract.api.certification import Certification, CertifySettings, open_certification
from ns_abstract.api.certifying import CertificateRun, CertifyProgress, check_network_memory, network_memory
from ns_abstract.api.compiling import compile_beside
from ns_abstract.api.job import check_frames
from ns_abstract.cli.common import Stop, plain_console
from ns_abstract.execution.engines import EngineName, Tls, started
from ns_abstract.report.certificate import coverage
from ns_abstract.report.figures import percent
from ns_abstract.verify.store import Store


@dataclass(frozen=True)
class Order:
    """What the command line asks for.

    Attributes:
        settings: The files, without the memory.
        frames: Entries of the camera path, or None for all.
        output_dir: Folder for the results.
        budget: Seconds.
        engine, scheduler_address, tls, workers: Where the work is done; workers None: one by core.
        resume: Whether to go on.
        memory_limit: GiB, or None.
        scene_margin: Whether to look for the largest variation of the scene.
        options: All options, for the report.
    """

    settings: CertifySettings
    frames: tuple[int, ...] | None
    output_dir: Path
    budget: float
    engine: EngineName
    scheduler_address: str | None
    tls: Tls | None
    workers: int | None
    resume: bool
    memory_limit: float | None
    scene_margin: bool
    options: Mapping[str, Any]


class _Display:
    """What the terminal shows."""

    def __init__(self, console: Console, progress: Progress) -> None:
        self.console, self.progress = console, progress
        self.task = progress.add_task("cells", total=1.0, state="")

    def opened(self, store: Store) -> None:
        if store.resumed:
            text = f"  {store.count} cells kept from before, {store.open_blocks} blocks open"
            self.console.print(text, markup=False)

    def told(self, point: CertifyProgress) -> None:
        shares = {"certified": point.certified, "falsified": point.falsified, "unknown": point.unknown}
        state = ", ".join(f"{kind} {percent(share)}" for kind, share in shares.items())
        self.progress.update(self.task, completed=1.0 - point.open, state=state)


def _introduce(console: Console, job: Certification, run: CertificateRun) -> None:
    method = job.job.method
    console.print(f"{method.name}: {method.content}; {job.network.source.name}; {run.about.sentence}", markup=False)
    for note in run.about.plan:
        console.print(f"  {note}", markup=False, soft_wrap=True)


def certify_path(order: Order, stop: Stop) -> bool:
    """Search the frames and write the results; returns whether every frame has one.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    console = plain_console()
    workers = order.workers or len(os.sched_getaffinity(0))
    memory = network_memory(order.memory_limit, workers)
    with stop.at_once():
        job = open_certification(dataclasses.replace(order.settings, memory=memory))
        check_network_memory(job, order.memory_limit, workers)
        frames = check_frames(order.frames, job.job.frame_count)
        run = CertificateRun(job, frames, order.output_dir, order.options, ("ns-abstract-certify", *sys.argv[1:]))
    _introduce(console, job, run)

    def opened(store: Store) -> None:
        display.opened(store)
        if order.engine == "local":
            # once, and not in every worker
            with stop.at_once():
                compile_beside(job.job, frames[0])

    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn(),
        TimeRemainingColumn(), console=console, disable=not console.is_terminal, transient=True,
    )  # fmt: skip
    with progress:
        display = _Display(console, progress)
        document = run.run(
            # the processes of a NeRF bound its rays, which all cells share
            lambda stack: stack.enter_context(
                started(order.engine, order.scheduler_address, 1 if job.job.rays else workers, order.tls)
            ),
            order.budget,
            stop,
            resume=order.resume,
            on_open=opened,
            on_progress=display.told,
            scene_margin=order.scene_margin,
            on_margin=lambda found: console.print(f"scene margin: {found.sentence}", markup=False, soft_wrap=True),
        )
    covered = coverage(document["frames"])
    parts = ", ".join(f"{kind} {percent(covered[kind])}" for kind in ("certified", "falsified", "unknown"))
    console.print(f"{document['verdict']}: {parts}", markup=False)
    if document["partitions"]:
        both = document["partitions"]
        more = f", undecided {percent(both['undecided'])} (no finite margin)" if both["undecided"] else ""
        console.print(f"PCP-V {percent(both['PCP-V'])}, PCP-S {percent(both['PCP-S'])}{more}", markup=False)
    console.print(f"report: {order.output_dir / 'report.html'}", markup=False, soft_wrap=True)
    return all(entry["sampled"]["poses"] for entry in document["frames"])
