"""What commands that bound a path frame by frame have in common."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.console import Console

from ns_abstract.api.job import Job
from ns_abstract.cli.commands import Compare, Render
from ns_abstract.cli.options import stated
from ns_abstract.report.figures import listed
from ns_abstract.report.record import Report, RunRecord, failed_self_check

#: Seconds by frame where no time budget is given.
_SECONDS_BY_FRAME = 60.0


def run_record(
    program: str, job: Job, options: Render | Compare, frames: tuple[int, ...], problems: tuple[str, ...]
) -> RunRecord:
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
        command=(program, *sys.argv[1:]),
        limits=tuple(map(failed_self_check, problems)),
        size=(camera.height, camera.width),
        intrinsics={frame: job.pose_sets[frame].camera.intrinsics._asdict() for frame in frames},
    )


def seconds_of(options: Render | Compare, pending: Sequence[int]) -> float:
    """The time budget for what is pending."""
    return _SECONDS_BY_FRAME * max(1, len(pending)) if options.time_budget is None else options.time_budget


def tell_problems(console: Console, report: Report, problems: Sequence[str]) -> None:
    """Print why there is no guarantee, and what of an earlier run is not used."""
    for problem in problems:
        console.print(f"warning: {problem}")
    for reason in report.ignored:
        console.print(f"not used: {reason}")


def tell_missing(console: Console, report: Report) -> None:
    """Print which frames have no bounds, if some have none."""
    if report.missing:
        console.print(f"no bounds yet for frames {listed(report.missing)}: raise --time-budget, --resume")
