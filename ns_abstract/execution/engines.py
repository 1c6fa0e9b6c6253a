"""Engines that run tasks: their interface, and those in this process and in processes of this machine.

An engine returns each task's result exactly once, in any order, even if workers die; `cluster` has another engine.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from ns_abstract.execution.cancellation import WorkCancelledError, cancel_when, end_with_parent
from ns_abstract.io.errors import InputError

#: Asks a worker to give up its task at the next `check_cancelled`.
_GIVE_UP = signal.SIGUSR1
#: Times that a task is begun again when its worker dies.
RETRIES = 3
#: Variables that make numerical libraries use one thread; read when they are imported.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
#: A worker's first word: what it imports at its start is there.
_BEGUN = None

Task = tuple[Callable[..., Any], tuple[Any, ...]]


class Machine(NamedTuple):
    """Numbers of an engine's processes and threads on one machine."""

    processes: int
    threads: int


class Engine(Protocol):
    """Runs tasks and returns their results."""

    @property
    def capacity(self) -> int:
        """Number of open tasks that keep the engine busy."""
        ...

    @property
    def threads(self) -> int:
        """Number of tasks that run at a time."""
        ...

    @property
    def shares(self) -> bool:
        """Whether tasks use the objects of this process, without a copy."""
        ...

    @property
    def starting(self) -> bool:
        """Whether workers still load what they need for their first result, which takes seconds."""
        ...

    def machine(self) -> Machine:
        """Return the numbers for the machine with most threads."""
        ...

    def submit(self, key: int, function: Callable[..., Any], *arguments: Any) -> None:
        """Submit a task under a number that no other open task has."""
        ...

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        """Return numbers and results of finished tasks, after waiting up to ``seconds`` for one.

        Raises:
            Exception: What a task raised.
            InputError: The workers of a task die again and again.
        """
        ...

    def close(self) -> None:
        """Drop open tasks and end the workers."""
        ...


class SerialEngine:
    """Runs tasks in this process; `collect` runs one."""

    capacity = 1
    threads = 1
    shares = True
    starting = False

    def __init__(self) -> None:
        self._tasks: list[tuple[int, Task]] = []

    def machine(self) -> Machine:
        return Machine(1, 1)

    def submit(self, key: int, function: Callable[..., Any], *arguments: Any) -> None:
        self._tasks.append((key, (function, arguments)))

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        if not self._tasks:
            return []
        key, (function, arguments) = self._tasks.pop(0)
        return [(key, function(*arguments))]

    def close(self) -> None:
        self._tasks.clear()


class _WorkerProcess(NamedTuple):
    process: Any
    connection: Connection


class Processes:
    """Runs tasks in new processes of this machine, one thread each; a dead one is replaced, its task restarted."""

    shares = False

    def __init__(self, count: int) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._idle: list[_WorkerProcess] = []
        self._busy: dict[Connection, tuple[_WorkerProcess, int, Task]] = {}
        self._deaths: dict[int, int] = {}
        self._begun: set[Connection] = set()
        self.starting = True
        self.capacity = count
        self._waiting: list[tuple[int, Task]] = []

    @property
    def threads(self) -> int:
        """One for each process."""
        return self.capacity

    def machine(self) -> Machine:
        """Return the numbers of this machine."""
        return Machine(self.capacity, self.capacity)

    @property
    def pids(self) -> list[int]:
        """Process numbers of the started workers."""
        return [w.process.pid for w in (*self._idle, *(worker for worker, _, _ in self._busy.values()))]

    @property
    def unfinished(self) -> int:
        """Number of tasks that `collect` has not returned."""
        return len(self._busy) + len(self._waiting)

    def _start(self) -> _WorkerProcess:
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
        return _WorkerProcess(process, ours)

    def submit(self, key: int, function: Callable[..., Any], *arguments: Any) -> None:
        self._waiting.append((key, (function, arguments)))
        self._feed()

    def abandon(self) -> None:
        """Cancel running tasks; `collect` returns `WorkCancelledError` as their results."""
        self._waiting.clear()
        for worker, _, _ in self._busy.values():
            if worker.process.is_alive():
                os.kill(worker.process.pid, _GIVE_UP)

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
        begun = connection in self._begun
        self._begun.discard(connection)
        connection.close()
        worker.process.join()
        if not begun and (worker.process.exitcode or 0) > 0 and (script := unguarded_script()):
            raise needs_guard(script)
        self._deaths[key] = self._deaths.get(key, 0) + 1
        if self._deaths[key] > RETRIES:
            raise InputError(
                f"a worker process ended {self._deaths[key]} times at the same work (code {worker.process.exitcode})",
                fix="memory may be short: give fewer --workers; what is finished is stored",
            )
        self._waiting.insert(0, (key, task))

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        results: list[tuple[int, Any]] = []
        for connection in wait(list(self._busy), seconds):
            assert isinstance(connection, Connection)
            try:
                answer = connection.recv()
            except (EOFError, OSError):
                self._replace(connection)
                continue
            if answer is _BEGUN:
                self._begun.add(connection)
                continue
            good, value = answer
            worker, key, _ = self._busy.pop(connection)
            self._idle.append(worker)
            self.starting = False
            if not good:
                raise value
            results.append((key, value))
        self._feed()
        return results

    def close(self) -> None:
        workers = [*self._idle, *(worker for worker, _, _ in self._busy.values())]
        self._idle, self._busy, self._waiting = [], {}, []
        self._begun.clear()
        for worker in workers:
            worker.process.terminate()
        for worker in workers:
            worker.process.join()
            worker.connection.close()


def unguarded_script() -> Path | None:
    """Return the main script if new processes, which import it again, would run its work again; else None."""
    name = getattr(sys.modules.get("__main__"), "__file__", None)
    try:
        # how the guard is spelled does not matter
        return None if name is None or "__main__" in Path(name).read_text(encoding="utf-8") else Path(name)
    except (OSError, ValueError):
        return None


def needs_guard(script: Path) -> InputError:
    return InputError(
        "a worker process ended before it could work: it imports the started script again, which has no guard",
        file=script,
        field="workers",
        fix='put what the script does under `if __name__ == "__main__":`, or give workers=1',
    )


def _serve(connection: Connection) -> None:
    """Run a worker: receive tasks, send (success, result or exception), until the connection ends."""
    end_with_parent()
    cancel_requested = threading.Event()

    # a terminal sends Ctrl-C to all; the parent decides
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(_GIVE_UP, lambda number, frame: cancel_requested.set())
    connection.send(_BEGUN)
    while True:
        try:
            function, arguments = connection.recv()
        except EOFError:
            return
        cancel_requested.clear()
        try:
            with cancel_when(cancel_requested.is_set):
                answer = (True, function(*arguments))
        except WorkCancelledError as given_up:
            answer = (True, given_up)
        except Exception as error:
            answer = (False, error)
        connection.send(answer)
