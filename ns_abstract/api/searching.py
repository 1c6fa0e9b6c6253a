"""The search over open cells, for every kind of question."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from ns_abstract.arithmetic.kernel_cache import store as kernels
from ns_abstract.execution.ending import AbandonedError, Deadline, abandoning
from ns_abstract.execution.engines import Engine
from ns_abstract.execution.scheduler import Task, work
from ns_abstract.execution.stopping import StopRequest
from ns_abstract.verify.cells import Cell, Grid
from ns_abstract.verify.search import Findings
from ns_abstract.verify.store import Block, Store

#: Seconds between notes of progress, and between reports.
_TRACE, _REPORT = 1.0, 30.0
#: Examines cells of a grid of the frame with this number.
Examine = Callable[[int, Grid, tuple[Cell, ...]], Findings]


def paced(
    store: Store, told: Callable[[], object], report: Callable[[], object] = lambda: None
) -> Callable[[float], None]:
    """Return what a search does between results: now and then a point of the trace and ``told``, rarely ``report``."""
    traced = reported = time.perf_counter()

    def between(instant: float) -> None:
        nonlocal traced, reported
        if instant - traced >= _TRACE:
            traced = instant
            store.trace()
            told()
        if instant - reported >= _REPORT:
            reported = instant
            report()

    return between


def search_blocks(
    store: Store,
    engine: Engine,
    grids: dict[int, Grid],
    here: Examine,
    there: tuple[Callable[..., Findings], Any],
    *,
    deadline: Deadline,
    stop: StopRequest,
    keep: Callable[[Block, Any], object],
    between: Callable[[float], object],
    waits: bool = True,
) -> None:
    """Examine open blocks until none is left, the time is over or ``stop`` says so.

    Until the engine's workers have started, this process examines blocks, too: a kill in the first seconds keeps those.

    Args:
        store: Where blocks come from and findings go.
        engine: Where blocks are examined; closed at the end.
        grids: By frame.
        here: In this process.
        there: For others: a function of a module, and what it takes before the arguments of ``here``.
        deadline: When to end.
        stop: Asked at least twice a second, and ends a block at once in this process.
        keep: Given every block and its findings before they are stored.
        between: Told the reading of the clock after results, and twice a second where others work.
        waits: Whether one block is waited for however late it is, so that resuming with any budget gets on.
    """
    # workers take the kernels that were compiled here
    kernels().publish()
    flying: dict[int, Block] = {}
    finished = 0 if waits else 1

    def offer(room: int) -> Iterator[Task]:
        if deadline.late and (flying or finished):
            return
        for block in store.pending(set(flying), room):
            flying[block.number] = block
            found = block.frame, grids[block.frame], block.cells
            if engine.shares:
                yield Task(block.number, examined, found)
            else:
                yield Task(block.number, there[0], (there[1], *found))

    def over() -> bool:
        return stop() or (deadline.late and finished > 0)

    def examined(index: int, grid: Grid, cells: tuple[Cell, ...]) -> Findings | None:
        # in this process a block is given up at the deadline or a signal
        try:
            with stop.at_once(), abandoning(lambda: deadline.late and finished > 0):
                return here(index, grid, cells)
        except (KeyboardInterrupt, AbandonedError):
            return None

    def take(block: Block, findings: Findings | None) -> None:
        nonlocal finished
        if findings is None:
            return
        keep(block, findings)
        store.close_block(block, findings, grids[block.frame])
        finished += 1

    for results in work(engine, offer, over):
        for number, findings in results:
            take(flying.pop(number), findings)
        if engine.starting and not over():
            for block in store.pending(set(flying), 1):
                take(block, examined(block.frame, grids[block.frame], block.cells))
        between(time.perf_counter())
