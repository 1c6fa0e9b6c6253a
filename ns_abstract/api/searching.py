"""The search over open cells, for every kind of question."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from ns_abstract.arithmetic.kernel_cache import store as kernels
from ns_abstract.execution.cancellation import Deadline, WorkCancelledError, cancel_when
from ns_abstract.execution.engines import Engine
from ns_abstract.execution.scheduler import Task, work
from ns_abstract.execution.stopping import StopRequest
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.search_results import BlockResult
from ns_abstract.verify.store import CellBlock, Store

#: Seconds between notes of progress, and between reports.
_TRACE, _REPORT = 1.0, 30.0
#: Examines cells of a grid of the frame with this number.
Examine = Callable[[int, CellGrid, tuple[Cell, ...]], BlockResult]


def periodic_report(
    store: Store, on_progress: Callable[[], object], report: Callable[[], object] = lambda: None
) -> Callable[[float], None]:
    """Return what a search does between results: often a point of the trace and ``on_progress``, rarely ``report``."""
    traced = reported = time.perf_counter()

    def tick(instant: float) -> None:
        nonlocal traced, reported
        if instant - traced >= _TRACE:
            traced = instant
            store.trace()
            on_progress()
        if instant - reported >= _REPORT:
            reported = instant
            report()

    return tick


def search_blocks(
    store: Store,
    engine: Engine,
    grids: dict[int, CellGrid],
    examine: Examine,
    on_workers: tuple[Callable[..., BlockResult], Any],
    *,
    deadline: Deadline,
    stop: StopRequest,
    keep: Callable[[CellBlock, Any], object],
    on_tick: Callable[[float], object],
    finish_one: bool = True,
) -> None:
    """Examine open blocks until none is left, the time is over or ``stop`` says so.

    Until the engine's workers have started, this process examines blocks, too: a kill in the first seconds keeps those.

    Args:
        engine: Where blocks are examined; closed at the end.
        on_workers: For others: a function of a module, and what it takes before the arguments of ``examine``.
        stop: Asked at least twice a second, and ends a block at once in this process.
        keep: Given every block and its findings before they are stored.
        on_tick: Told the reading of the clock after results, and twice a second where others work.
        finish_one: Whether one block is waited for however late it is, so that resuming with any budget gets on.
    """
    # workers take the kernels that were compiled here
    kernels().publish()
    flying: dict[int, CellBlock] = {}
    finished = 0 if finish_one else 1

    def offer(room: int) -> Iterator[Task]:
        if deadline.late and (flying or finished):
            return
        for block in store.pending(set(flying), room):
            flying[block.number] = block
            arguments = block.frame, grids[block.frame], block.cells
            if engine.shares:
                yield Task(block.number, examined, arguments)
            else:
                yield Task(block.number, on_workers[0], (on_workers[1], *arguments))

    def over() -> bool:
        return stop() or (deadline.late and finished > 0)

    def examined(index: int, grid: CellGrid, cells: tuple[Cell, ...]) -> BlockResult | None:
        # in this process a block is given up at the deadline or a signal
        try:
            with stop.at_once(), cancel_when(lambda: deadline.late and finished > 0):
                return examine(index, grid, cells)
        except (KeyboardInterrupt, WorkCancelledError):
            return None

    def take(block: CellBlock, findings: BlockResult | None) -> None:
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
        on_tick(time.perf_counter())
