"""Where work is done: in this process, in processes of this machine, or on a Dask cluster.

An engine takes tasks (a function of a module and picklable arguments) and hands back each one's result
exactly once, in any order, whatever workers die on the way.
"""

from __future__ import annotations

import multiprocessing
import os
import secrets
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, Protocol

from ns_abstract.errors import InputError

#: Times that a task is begun again when its worker dies.
_RETRIES = 3
#: Time that a scheduler is given to answer.
_CONNECT = "10s"
#: Variables that make numerical libraries use one thread; read when they are imported.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
#: Makes torch give memory back and fault it in again for every cell, 1.6 times slower.
_TRIM = "MALLOC_TRIM_THRESHOLD_"

Task = tuple[Callable[..., Any], tuple[Any, ...]]


class Engine(Protocol):
    """What takes tasks."""

    @property
    def capacity(self) -> int:
        """Tasks that can usefully be handed in at a time."""
        ...

    def submit(self, key: int, function: Callable[..., Any], *arguments: Any) -> None:
        """Hand in a task under a number that no other unfinished task has."""
        ...

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        """Keys and results that have come, after waiting up to ``seconds`` for one.

        Raises:
            Exception: What a task raised.
            InputError: The workers of a task die again and again.
        """
        ...

    def close(self) -> None:
        """Give up what is not finished and end the workers."""
        ...


class Here:
    """This process; `collect` does one task."""

    capacity = 1

    def __init__(self) -> None:
        self._tasks: list[tuple[int, Task]] = []

    def submit(self, key: int, function: Callable[..., Any], *arguments: Any) -> None:
        self._tasks.append((key, (function, arguments)))

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        if not self._tasks:
            return []
        key, (function, arguments) = self._tasks.pop(0)
        return [(key, function(*arguments))]

    def close(self) -> None:
        self._tasks.clear()


class _Worker(NamedTuple):
    process: Any
    connection: Connection


class Processes:
    """Fresh processes of this machine, one thread each; one that dies is replaced and its task begun again.

    Args:
        count: Number of processes.
    """

    def __init__(self, count: int) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._idle: list[_Worker] = []
        self._busy: dict[Connection, tuple[_Worker, int, Task]] = {}
        self._deaths: dict[int, int] = {}
        self.capacity = count
        self._waiting: list[tuple[int, Task]] = []

    @property
    def pids(self) -> list[int]:
        """Process numbers of the workers that were started."""
        return [w.process.pid for w in (*self._idle, *(worker for worker, _, _ in self._busy.values()))]

    def _start(self) -> _Worker:
        ours, theirs = self._context.Pipe()
        before = {name: os.environ.get(name) for name in _THREADS}
        os.environ.update(dict.fromkeys(_THREADS, "1"))
        try:
            process = self._context.Process(target=_serve, args=(theirs,), daemon=True)
            process.start()
        finally:
            for name, value in before.items():
                os.environ.pop(name, None) if value is None else os.environ.__setitem__(name, value)
        # so that the end of the process ends the connection
        theirs.close()
        return _Worker(process, ours)

    def submit(self, key: int, function: Callable[..., Any], *arguments: Any) -> None:
        self._waiting.append((key, (function, arguments)))
        self._feed()

    def _feed(self) -> None:
        while self._waiting and len(self._busy) < self.capacity:
            worker = self._idle.pop() if self._idle else self._start()
            key, task = self._waiting.pop(0)
            self._busy[worker.connection] = (worker, key, task)
            try:
                worker.connection.send(task)
            except OSError:
                self._replace(worker.connection)

    def _replace(self, connection: Connection) -> None:
        worker, key, task = self._busy.pop(connection)
        connection.close()
        worker.process.join()
        self._deaths[key] = self._deaths.get(key, 0) + 1
        if self._deaths[key] > _RETRIES:
            raise InputError(
                f"a worker process ended {self._deaths[key]} times at the same work (code {worker.process.exitcode})",
                fix="memory may be short: give fewer --workers; what is finished is stored",
            )
        self._waiting.insert(0, (key, task))

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        found: list[tuple[int, Any]] = []
        for connection in wait(list(self._busy), seconds):
            assert isinstance(connection, Connection)
            try:
                good, value = connection.recv()
            except (EOFError, OSError):
                self._replace(connection)
                continue
            worker, key, _ = self._busy.pop(connection)
            self._idle.append(worker)
            if not good:
                raise value
            found.append((key, value))
        self._feed()
        return found

    def close(self) -> None:
        workers = [*self._idle, *(worker for worker, _, _ in self._busy.values())]
        self._idle, self._busy, self._waiting = [], {}, []
        for worker in workers:
            worker.process.terminate()
        for worker in workers:
            worker.process.join()
            worker.connection.close()


def _serve(connection: Connection) -> None:
    """A worker's life: tasks in, (good, result or exception) out, until the connection ends."""
    # a terminal sends Ctrl-C to all; the parent decides
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    while True:
        try:
            function, arguments = connection.recv()
        except EOFError:
            return
        try:
            answer = (True, function(*arguments))
        except Exception as error:
            answer = (False, error)
        connection.send(answer)


class Cluster:
    """A Dask cluster. Its workers must see the input files under the same paths.

    Args:
        client: Of `connected`.
    """

    def __init__(self, client: Any) -> None:
        self.client = client
        self._futures: dict[Any, int] = {}
        # a scheduler serves several commands: equal keys would hand one the results of another
        self._command = secrets.token_hex(8)

    @property
    def threads(self) -> int:
        """Threads of all workers together."""
        return max(1, sum(self.client.nthreads().values()))

    @property
    def capacity(self) -> int:
        # one more each, so that no worker waits for this process
        return 2 * self.threads

    def submit(self, key: int, function: Callable[..., Any], *arguments: Any) -> None:
        future = self.client.submit(
            function, *arguments, key=f"ns-abstract-{key}-{self._command}", retries=_RETRIES, pure=False
        )
        self._futures[future] = key

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        from distributed import wait as wait_for

        if not self._futures:
            return []
        try:
            waited: Any = wait_for(list(self._futures), timeout=seconds, return_when="FIRST_COMPLETED")
        except TimeoutError:
            return []
        results = [(self._futures[future], future.result()) for future in waited.done]
        for future in waited.done:
            del self._futures[future]
        return results

    def close(self) -> None:
        for future in self._futures:
            future.cancel()
        self._futures.clear()


@contextmanager
def connected(address: str | None, workers: int = 1) -> Iterator[Any]:
    """A Dask client of the scheduler at ``address``, or of a cluster on this machine if None.

    Args:
        address: HOST:PORT.
        workers: Processes of the cluster on this machine, one thread each.

    Raises:
        InputError: Dask is missing or its scheduler does not answer.
    """
    try:
        from dask import config
        from distributed import Client
    except ImportError:
        raise InputError("needs the package dask", field="--engine", fix="pip install 'ns-abstract[cluster]'") from None
    try:
        if address is None:
            name = "distributed.nanny.pre-spawn-environ"
            kept = {key: value for key, value in config.get(name, {}).items() if key != _TRIM}
            with config.set({name: kept}):
                client: Any = Client(n_workers=workers, threads_per_worker=1, dashboard_address=None)
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
