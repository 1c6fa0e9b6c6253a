"""The work of ``ns-abstract-certify``; imported only when it is asked for."""

from __future__ import annotations

import dataclasses
import sys
from typing import TYPE_CHECKING

from rich.console import Console

from ns_abstract.api.cell_search import CellSearch, Request
from ns_abstract.api.certification import Certification, open_certification
from ns_abstract.api.certifying import CertificateQuestion, check_network_memory, network_memory
from ns_abstract.api.compiling import compile_beside
from ns_abstract.api.job import check_frames
from ns_abstract.cli.common import SignalStop, plain_console
from ns_abstract.cli.options import stated
from ns_abstract.report.certificate import CertifiedRun, coverage
from ns_abstract.report.figures import percent
from ns_abstract.report.progress import ProgressBar
from ns_abstract.verify.store import Store

if TYPE_CHECKING:
    from ns_abstract.cli.commands import Certify

#: Seconds where no time budget is given.
_SECONDS = 1800.0


def _introduce(console: Console, job: Certification, about: CertifiedRun) -> None:
    method = job.job.method
    console.print(f"{method.name}: {method.content}; {job.question.name}; {about.sentence}")
    for warning in job.job.warnings:
        console.print(f"warning: {warning}")
    for note in about.plan:
        console.print(f"  {note}")


def certify_path(options: Certify, stop: SignalStop) -> bool:
    """Search the frames and write the results; returns whether every frame has one.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    console = plain_console()
    workers = options.where.processes
    memory = network_memory(options.memory_limit, workers)
    with stop.at_once():
        job = open_certification(dataclasses.replace(options.settings, memory=memory))
        check_network_memory(job, options.memory_limit, workers)
        frames = check_frames(options.frames, job.job.frame_count)
        question = CertificateQuestion(job, frames, stated(options), ("ns-abstract-certify", *sys.argv[1:]))
    _introduce(console, job, question.about)

    def opened(store: Store) -> None:
        if store.resumed:
            text = f"  {store.count} cells kept from before, {store.open_blocks} blocks still to be examined"
            console.print(text)
        if options.where.engine == "local":
            # once, and not in every worker
            with stop.at_once():
                compile_beside(job.job, frames[0])

    with ProgressBar(console) as progress:
        document = CellSearch(question, options.output_dir).run(
            # the processes of a NeRF bound its rays, which all cells share
            lambda stack: stack.enter_context(options.where.started(1 if job.job.rays else workers)),
            stop,
            Request(
                options.time_budget or _SECONDS,
                options.resume,
                scene_margin=options.scene_margin,
                on_open=opened,
                on_progress=progress,
                on_margin=lambda found: console.print(f"scene margin: {found.sentence}"),
            ),
        )
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
    console.print(f"report: {options.output_dir / 'report.html'}")
    return all(entry["sampled"]["poses"] for entry in document["frames"])
