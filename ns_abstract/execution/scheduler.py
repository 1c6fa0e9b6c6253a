"""The scheduler: keeps an engine busy with tasks of any kind."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any, NamedTuple

from ns_abstract.execution.engines import Engine

#: Seconds between looks at results and at a request to stop.
PATIENCE = 0.5


class Task(NamedTuple):
    """Work for an engine: a function and its arguments, under a name that no other task has."""

    name: Hashable
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def work(
    engine: Engine, offer: Callable[[int], Iterable[Task]], stop: Callable[[], bool]
) -> Iterator[list[tuple[Any, Any]]]:
    """Yield names and results as they arrive, each once, in any order.

    Ends when nothing is under way after an offer, or when ``stop`` says so; what is not finished is then given up, and
    the engine is closed.

    Args:
        offer: The next tasks, at most so many; asked whenever there is room.
        stop: Asked at least every `PATIENCE` seconds while others work, and after every task in this process.
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
