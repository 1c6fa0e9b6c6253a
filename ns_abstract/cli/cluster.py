"""Spreads the frames of a path over a Dask cluster (extra "cluster")."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from ns_abstract.engines import Cluster, spread
from ns_abstract.errors import InputError
from ns_abstract.pipeline import Job, Settings
from ns_abstract.refine.engine import Goal
from ns_abstract.refine.result import FrameResult

if TYPE_CHECKING:
    from ns_abstract.cli.render import Render

#: Seconds between looks at results and at a request to stop.
_PATIENCE = 0.5

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


def bound_on_cluster(
    client: Any, job: Job, options: Render, pending: list[int], budget: float, stop: Callable[[], bool]
) -> Iterator[FrameResult]:
    """Frames as they are finished, each once, whatever workers come and go.

    The workers must see the run folder under the same path. The time budget is shared as if every
    thread of the cluster worked on one frame at a time.

    Args:
        client: Of `ns_abstract.engines.connected`.
        job: What is bounded.
        options: The command's options.
        pending: Frames to bound.
        budget: Seconds for all of them.
        stop: Asked twice a second; true gives up what is not finished.
    """
    if not pending:
        return
    engine = Cluster(client)
    rounds = -(-len(pending) // engine.threads)
    goal = job.goal(options.target_ratio, budget / rounds)
    settings, fingerprint = _with_whole_paths(job.settings), job.fingerprint
    tasks = [(k, (bound_frame, (settings, fingerprint, k, goal, options.save_cells))) for k in pending]
    for _, result in spread(engine, tasks, _PATIENCE, stop):
        yield result


def _with_whole_paths(settings: Settings) -> Settings:
    """The same for a worker, whose working directory is another one."""
    file = settings.perturbation_filename
    return dataclasses.replace(
        settings,
        load_config=settings.load_config.absolute(),
        camera_path_filename=settings.camera_path_filename.absolute(),
        perturbation_filename=None if file is None else file.absolute(),
    )
