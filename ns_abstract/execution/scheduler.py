"""Keeps an engine busy with tasks of any kind."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any, NamedTuple

from ns_abstract.execution.engines import Engine

#: Seconds between looks at results and at a request to stop.
PATIENCE = 0.5


class Task(NamedTuple):
    """A task for an engine: a function and its arguments, under a unique name."""

    name: Hashable
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def work(
    engine: Engine, offer: Callable[[int], Iterable[Task]], stop: Callable[[], bool]
) -> Iterator[list[tuple[Any, Any]]]:
    """Yield names and results as they arrive, each once, in any order.

    Ends when no task is open after an offer, or when ``stop`` returns True; open tasks are then dropped, and the engine
    is closed.

    Args:
        offer: Returns the next tasks, at most so many; called whenever there is capacity.
        stop: Called at least every `PATIENCE` seconds while others work, and after every task in this process.
    """
    flying: dict[int, Hashable] = {}
    number = 0
    try:
        while not stop():
            for task in offer(engine.capacity - len(flying)):
                flying[number] = task.name
                engine.submit(number, task.function, *task.arguments)
                number += 1
            if not flying:
                return
            yield [(flying.pop(key), result) for key, result in engine.collect(PATIENCE)]
    finally:
        engine.close()
