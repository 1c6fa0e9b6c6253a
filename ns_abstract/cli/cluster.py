"""Spreads the frames of a path over a Dask cluster (extra "cluster")."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from ns_abstract.errors import InputError
from ns_abstract.pipeline import Job, Settings
from ns_abstract.refine.engine import Goal
from ns_abstract.refine.result import FrameResult

if TYPE_CHECKING:
    from ns_abstract.cli.render import Render

#: Seconds between looks at results and at a request to stop.
_PATIENCE = 0.5
#: Times a frame is tried again when its worker dies.
_RETRIES = 3

_jobs: dict[Settings, Job] = {}


def bound_frame(settings: Settings, index: int, goal: Goal, keep_leaves: bool) -> FrameResult:
    """One frame on a worker, which opens the scene once and keeps it."""
    if settings not in _jobs:
        _jobs.clear()
        _jobs[settings] = Job(settings)
    job = _jobs[settings]
    job.warm_up(index)
    return job.bound(index, goal, keep_leaves=keep_leaves)


def bound_on_cluster(
    job: Job, options: Render, pending: list[int], budget: float, stop: Callable[[], bool]
) -> Iterator[FrameResult]:
    """Frames as they are finished, each once, whatever workers come and go.

    The workers must see the run folder under the same path. The time budget is shared as if every
    thread of the cluster worked on one frame at a time.

    Raises:
        InputError: Dask is missing or its scheduler does not answer.
    """
    try:
        from distributed import Client, wait
    except ImportError:
        raise InputError("needs the package dask", field="--engine", fix="pip install 'ns-abstract[cluster]'") from None
    if not pending:
        return
    try:
        if options.scheduler_address is None:
            client: Any = Client(n_workers=1, threads_per_worker=1, dashboard_address=None)
        else:
            client = Client(options.scheduler_address, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(
            f"no scheduler answers at {options.scheduler_address} ({type(error).__name__})",
            field="--scheduler-address",
            fix="start one with `dask scheduler` and workers with `dask worker HOST:PORT --nthreads 1`",
        ) from None
    with client:
        workers = max(1, sum(client.nthreads().values()))
        rounds = -(-len(pending) // workers)
        goal = job.goal(options.target_ratio, budget / rounds)
        waiting = {
            client.submit(
                bound_frame, job.settings, index, goal, options.save_cells, key=f"frame-{index}-{id(job)}", retries=_RETRIES
            )
            for index in pending
        }
        while waiting and not stop():
            try:
                finished = wait(waiting, timeout=_PATIENCE, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                continue
            for future in finished:
                waiting.discard(future)
                yield future.result()
        for future in waiting:
            future.cancel()
