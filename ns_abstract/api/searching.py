"""The search for verdicts on cells, whatever is asked about them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from ns_abstract.execution.ending import AbandonedError, abandoning
from ns_abstract.execution.engines import Engine
from ns_abstract.execution.scheduler import Task, work
from ns_abstract.execution.stopping import StopRequest
from ns_abstract.verify.cells import Cell, Grid
from ns_abstract.verify.search import Findings
from ns_abstract.verify.store import Block, Store

#: Examines cells of a grid of the frame with this number.
Examine = Callable[[int, Grid, tuple[Cell, ...]], Findings]


def search_blocks(
    store: Store,
    engine: Engine,
    grids: dict[int, Grid],
    here: Examine,
    there: tuple[Callable[..., Findings], Any],
    *,
    deadline: float,
    stop: StopRequest,
    keep: Callable[[Block, Any], object],
    between: Callable[[float], object],
    waits: bool = True,
) -> None:
    """Examine open blocks until none is left, the time is over or ``stop`` says so.

    Args:
        store: Where blocks come from and findings go.
        engine: Where blocks are examined; closed at the end.
        grids: By frame.
        here: For an engine that shares this process.
        there: For others: a function of a module, and what it takes before the arguments of ``here``.
        deadline: Reading of `time.perf_counter`.
        stop: Asked at least twice a second.
        keep: Given every block and its findings before they are stored.
        between: Told the reading of the clock after results, and twice a second where others work.
        waits: Whether one block is waited for however late it is, so that resuming with any budget gets on.
    """
    flying: dict[int, Block] = {}
    finished = 0 if waits else 1

    def late() -> bool:
        return time.perf_counter() >= deadline

    def offer(room: int) -> Iterator[Task]:
        if late() and (flying or finished):
            return
        for block in store.pending(set(flying), room):
            flying[block.number] = block
            found = block.frame, grids[block.frame], block.cells
            if engine.shares:
                yield Task(block.number, examined, found)
            else:
                yield Task(block.number, there[0], (there[1], *found))

    def over() -> bool:
        return stop() or (late() and finished > 0)

    def examined(index: int, grid: Grid, cells: tuple[Cell, ...]) -> Findings | None:
        # in this process a block is given up at the deadline or a signal
        try:
            with stop.at_once(), abandoning(lambda: late() and finished > 0):
                return here(index, grid, cells)
        except (KeyboardInterrupt, AbandonedError):
            return None

    for results in work(engine, offer, over):
        for number, findings in results:
            block = flying.pop(number)
            if findings is None:
                continue
            keep(block, findings)
            store.close_block(block, findings, grids[block.frame])
            finished += 1
        between(time.perf_counter())
