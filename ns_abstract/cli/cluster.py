"""Spreads the frames of a path over a Dask cluster (extra "cluster")."""

from __future__ import annotations

import dataclasses
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from ns_abstract.errors import InputError
from ns_abstract.pipeline import Job, Settings
from ns_abstract.refine.engine import Goal
from ns_abstract.refine.result import FrameResult

if TYPE_CHECKING:
    from ns_abstract.cli.render import Render

#: Seconds between looks at results and at a request to stop.
_PATIENCE = 0.5
#: Time that a scheduler is given to answer.
_CONNECT = "10s"
#: Times a frame is tried again when its worker dies.
_RETRIES = 3

_jobs: dict[Settings, Job] = {}


def bound_frame(
    settings: Settings, fingerprint: dict[str, Any], index: int, goal: Goal, keep_leaves: bool
) -> FrameResult:
    """One frame on a worker, which opens the scene once and keeps it.

    Raises:
        InputError: The worker reads other files under the same names than the command did.
    """
    if settings not in _jobs or _jobs[settings].fingerprint != fingerprint:
        _jobs.clear()
        job = Job(settings)
        if job.fingerprint != fingerprint:
            raise InputError(
                "the worker finds other content than this machine",
                file=settings.load_config,
                fix="give the workers the same files under the same paths",
            )
        _jobs[settings] = job
    job = _jobs[settings]
    job.warm_up(index)
    return job.bound(index, goal, keep_leaves=keep_leaves)


@contextmanager
def connected(address: str | None) -> Iterator[Any]:
    """A client of the scheduler at ``address``, or of a cluster on this machine if None.

    Raises:
        InputError: Dask is missing or its scheduler does not answer.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("needs the package dask", field="--engine", fix="pip install 'ns-abstract[cluster]'") from None
    try:
        if address is None:
            # one worker: its kernels use every core
            client: Any = Client(n_workers=1, threads_per_worker=1, dashboard_address=None)
        else:
            client = Client(address, timeout=_CONNECT)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"no scheduler answers at {address} ({type(error).__name__})",
            field="--scheduler-address",
            fix="start one with `dask scheduler` and workers with `dask worker HOST:PORT --nthreads 1`",
        ) from None
    with client:
        yield client


def bound_on_cluster(
    client: Any, job: Job, options: Render, pending: list[int], budget: float, stop: Callable[[], bool]
) -> Iterator[FrameResult]:
    """Frames as they are finished, each once, whatever workers come and go.

    The workers must see the run folder under the same path. The time budget is shared as if every
    thread of the cluster worked on one frame at a time.

    Args:
        client: Of `connected`.
        job: What is bounded.
        options: The command's options.
        pending: Frames to bound.
        budget: Seconds for all of them.
        stop: Asked twice a second; true gives up what is not finished.
    """
    from distributed import wait

    if not pending:
        return
    workers = max(1, sum(client.nthreads().values()))
    rounds = -(-len(pending) // workers)
    goal = job.goal(options.target_ratio, budget / rounds)
    settings, fingerprint = _with_whole_paths(job.settings), job.fingerprint
    # a scheduler serves several commands: equal keys would hand one the results of another
    command = secrets.token_hex(8)
    waiting = {
        client.submit(
            bound_frame,
            settings,
            fingerprint,
            index,
            goal,
            options.save_cells,
            key=f"frame-{index}-{command}",
            retries=_RETRIES,
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


def _with_whole_paths(settings: Settings) -> Settings:
    """The same for a worker, whose working directory is another one."""
    file = settings.perturbation_filename
    return dataclasses.replace(
        settings,
        load_config=settings.load_config.absolute(),
        camera_path_filename=settings.camera_path_filename.absolute(),
        perturbation_filename=None if file is None else file.absolute(),
    )
