"""Spreads the frames of a path, and the tiles of a frame, over a Dask cluster (extra "cluster")."""

from __future__ import annotations

import dataclasses
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np

from ns_abstract.engines import Cluster
from ns_abstract.errors import InputError
from ns_abstract.pipeline import LEAST_SECONDS, Job, Settings, check_content, with_whole_paths
from ns_abstract.refine.engine import Goal, groups, shared_goal
from ns_abstract.refine.result import FrameResult, PartResult

if TYPE_CHECKING:
    from ns_abstract.cli.render import Render

#: Seconds between looks at results and at a request to stop.
_PATIENCE = 0.5
#: Groups of tiles by thread of the cluster: their costs differ.
_GROUPS_BY_THREAD = 2

_jobs: dict[Settings, tuple[Job, set[int]]] = {}
_opening = threading.Lock()


class Part(NamedTuple):
    """One task.

    Attributes:
        index: Entry of the camera path.
        tiles: Numbers of its tiles; None: all.
    """

    index: int
    tiles: np.ndarray | None


def bound_part(
    settings: Settings, fingerprint: dict[str, Any], part: Part, goal: Goal, keep_leaves: bool, neighbours: int = 1
) -> PartResult:
    """One task on a worker, which opens the scene once and keeps it.

    Args:
        settings, fingerprint: Of the job, and what the worker's files must agree with.
        part: What to bound.
        goal: When to stop.
        keep_leaves: Whether the result carries linear sets.
        neighbours: Tasks that share this machine's cores.

    Raises:
        InputError: The worker reads other files under the same names than the command did.
    """
    import numba

    most: int = numba.config.NUMBA_NUM_THREADS  # pyright: ignore[reportPrivateImportUsage, reportAttributeAccessIssue]
    numba.set_num_threads(max(1, min(len(os.sched_getaffinity(0)) // neighbours, most)))
    with _opening:
        if settings not in _jobs or _jobs[settings][0].fingerprint != fingerprint:
            _jobs.clear()
            job = Job(settings)
            check_content(job.fingerprint, fingerprint, settings.load_config)
            _jobs[settings] = job, set()
        job, warm = _jobs[settings]
        if part.index not in warm:
            job.warm_up(part.index)
            warm.add(part.index)
    return job.bound_part(part.index, goal, part.tiles, keep_leaves=keep_leaves)


def local_workers(job: Job) -> int:
    """Processes of a cluster on this machine: as many as there are cores and the scene fits into memory."""
    return max(1, min(len(os.sched_getaffinity(0)), job.memory // (2 * job.base_memory)))


def bound_on_cluster(
    client: Any, job: Job, options: Render, pending: list[int], budget: float, stop: Callable[[], bool]
) -> Iterator[FrameResult]:
    """Frames as they are finished, each once, whatever workers come and go.

    Where the cluster has more threads than there are frames, each frame is divided into groups of tiles. A frame is
    there when all its groups are. The workers must see the run folder under the same path. What a task leaves of the
    time budget is shared by those that are still to be begun.

    Args:
        client: Of `ns_abstract.engines.connected`.
        job: What is bounded.
        options: The command's options.
        pending: Frames to bound.
        budget: Seconds for all of them.
        stop: Asked twice a second; true gives up what is not finished.

    Raises:
        InputError: The scene does not fit into the memory as often as there are workers on a machine.
    """
    if not pending:
        return
    engine = Cluster(client)
    count = -(-_GROUPS_BY_THREAD * engine.threads // len(pending)) if engine.threads > len(pending) else 1
    neighbours, leaf_bytes = _shares(client, job)
    settings = dataclasses.replace(with_whole_paths(job.settings), workers=1)
    fingerprint = job.fingerprint
    deadline = time.perf_counter() + budget
    queue = [
        Part(index, tiles) for index in pending for tiles in ([None] if count == 1 else groups(job.frame(index), count))
    ]
    expected = Counter(part.index for part in queue)
    goals: dict[int, Goal] = {}
    flying: dict[int, Part] = {}
    found: dict[int, list[PartResult]] = {}
    number = 0
    try:
        while (queue or flying) and not stop():
            # no more than can be worked on, so that later ones know how much time is left
            while queue and len(flying) < engine.threads:
                left = deadline - time.perf_counter()
                # frames that are begun are finished, and one always is begun
                if left <= 0.0 and goals and queue[0].index not in goals:
                    queue.clear()
                    break
                part = queue.pop(0)
                if part.index not in goals:
                    goals[part.index] = _goal(job, part, options, leaf_bytes)
                share = max(LEAST_SECONDS, left / -(-(len(queue) + 1) // engine.threads))
                goal = dataclasses.replace(goals[part.index], seconds=share)
                number += 1
                flying[number] = part
                engine.submit(
                    number, bound_part, settings, fingerprint, part, goal, options.save_cells, neighbours
                )
            for key, result in engine.collect(_PATIENCE):
                index = flying.pop(key).index
                found.setdefault(index, []).append(result)
                if len(found[index]) == expected[index]:
                    yield job.joined(found.pop(index))
    finally:
        engine.close()


def _goal(job: Job, part: Part, options: Render, leaf_bytes: int) -> Goal:
    goal = dataclasses.replace(job.goal(options.target_ratio, 0.0), leaf_bytes=leaf_bytes)
    return goal if part.tiles is None else shared_goal(job.frame(part.index), part.index, goal, job.settings.seed)


def _shares(client: Any, job: Job) -> tuple[int, int]:
    """Tasks at a time on the machine with most of them, and the bytes that each may use for its leaves."""
    processes: Counter[str | None] = Counter()
    tasks: Counter[str | None] = Counter()
    for address, threads in client.nthreads().items():
        host = urlsplit(address).hostname
        processes[host] += 1
        tasks[host] += threads
    most = max(processes.values(), default=1)
    if job.settings.memory_limit is not None and most * job.base_memory > job.memory:
        raise InputError(
            f"{most} workers on one machine need {most * job.base_memory / 2**30:.1f} GiB, "
            f"{job.memory / 2**30:.1f} GiB may be used",
            field="--memory-limit",
            fix="raise it, or start fewer workers",
        )
    neighbours = max(1, max(tasks.values(), default=1))
    return neighbours, job.leaf_bytes(most) // neighbours
