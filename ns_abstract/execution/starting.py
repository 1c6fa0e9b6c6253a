"""Starts the engine that options name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Literal

from ns_abstract.execution.cluster import Cluster, Tls, connected
from ns_abstract.execution.engines import Engine, Processes, SerialEngine

EngineName = Literal["local", "dask"]


@contextmanager
def started(name: EngineName, address: str | None, workers: int, tls: Tls | None = None) -> Iterator[Engine]:
    """Yield an engine and close it: a cluster for "dask", else processes, or this process for one worker."""
    with ExitStack() as stack:
        if name == "dask":
            engine: Engine = Cluster(stack.enter_context(connected(address, workers, tls)))
        else:
            engine = SerialEngine() if workers == 1 else Processes(workers)
        stack.callback(engine.close)
        yield engine
