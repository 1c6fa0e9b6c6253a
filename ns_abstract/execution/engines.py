"""Engines that run tasks: this process, processes of this machine, or a Dask cluster.

An engine takes tasks (a function of a module and picklable arguments) and hands back each one's result
exactly once, in any order, whatever workers die on the way.
"""

from __future__ import annotations

import multiprocessing
import os
import secrets
import signal
import ssl
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol
from urllib.parse import urlsplit

from ns_abstract.execution.cancellation import WorkCancelledError, cancel_when, end_with_parent
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size

#: Asks a worker to give up its task at the next `check_cancelled`.
_GIVE_UP = signal.SIGUSR1
#: Times that a task is begun again when its worker dies.
_RETRIES = 3
_LOOPBACK = "127.0.0.1"
#: Seconds that a scheduler is given to be reached, and as many to say that it is one.
_CONNECT = 10.0
#: Seconds that a cluster without workers, or a scheduler that does not answer, is waited for.
_GONE = 30.0
#: Seconds that the first try to fetch a finished result may take; each further one has twice as many.
_FETCH = 5.0
#: Variables that make numerical libraries use one thread; read when they are imported.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
#: A worker's first word: what it imports at its start is there.
_BEGUN = None
#: Makes torch give memory back and fault it in again for every cell, 1.6 times slower.
_TRIM = "MALLOC_TRIM_THRESHOLD_"

Task = tuple[Callable[..., Any], tuple[Any, ...]]


class Machine(NamedTuple):
    """Processes and threads of an engine on one machine."""

    processes: int
    threads: int


class Engine(Protocol):
    """The interface of an engine: it accepts tasks and returns their results."""

    @property
    def capacity(self) -> int:
        """Tasks that can usefully be handed in at a time."""
        ...

    @property
    def threads(self) -> int:
        """Tasks that are worked on at a time."""
        ...

    @property
    def shares(self) -> bool:
        """Whether tasks see the objects of this process."""
        ...

    @property
    def starting(self) -> bool:
        """Whether workers are still on their way to a first result, which takes them seconds."""
        ...

    def machine(self) -> Machine:
        """The machine with most to do."""
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


class SerialEngine:
    """This process; `collect` does one task."""

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
    """Fresh processes of this machine, one thread each; one that dies is replaced and its task begun again.

    Args:
        count: Number of processes.
    """

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
        """One by process."""
        return self.capacity

    def machine(self) -> Machine:
        """This one."""
        return Machine(self.capacity, self.capacity)

    @property
    def pids(self) -> list[int]:
        """Process numbers of the workers that were started."""
        return [w.process.pid for w in (*self._idle, *(worker for worker, _, _ in self._busy.values()))]

    @property
    def unfinished(self) -> int:
        """Tasks that `collect` has not given back."""
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
        """Ask running tasks to end early; `collect` gives `WorkCancelledError` as the result of those that do."""
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
        if not begun and (worker.process.exitcode or 0) > 0 and (script := _unguarded_script()):
            raise _needs_guard(script)
        self._deaths[key] = self._deaths.get(key, 0) + 1
        if self._deaths[key] > _RETRIES:
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


def _unguarded_script() -> Path | None:
    """The script that fresh processes import once more, if its work would begin again there."""
    name = getattr(sys.modules.get("__main__"), "__file__", None)
    try:
        # how the guard is spelled does not matter
        return None if name is None or "__main__" in Path(name).read_text(encoding="utf-8") else Path(name)
    except (OSError, ValueError):
        return None


def _needs_guard(script: Path) -> InputError:
    return InputError(
        "a worker process ended before it could work: it imports the started script again, which has no guard",
        file=script,
        field="workers",
        fix='put what the script does under `if __name__ == "__main__":`, or give workers=1',
    )


def _serve(connection: Connection) -> None:
    """Run a worker: receive tasks, send (good, result or exception), until the connection ends."""
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


class Cluster:
    """A Dask cluster. Its workers must see the input files under the same paths.

    Args:
        client: Of `connected`.
    """

    shares = False
    starting = False

    def __init__(self, client: Any) -> None:
        self.client = client
        self._futures: dict[Any, int] = {}
        # a scheduler serves several commands: equal keys would hand one the results of another
        self._command = secrets.token_hex(8)
        self._lost_since: float | None = None
        self._tasks: dict[int, Task] = {}
        self._losses = 0
        self._threads = 1
        self._patience = _FETCH

    @property
    def threads(self) -> int:
        """Threads of all workers together."""
        self._threads = self._now() or self._threads
        return self._threads

    def _now(self) -> int:
        """Threads that answer."""
        if self.client.status != "running":
            return 0
        try:
            return sum(self.client.nthreads().values())
        except (OSError, CancelledError):
            return 0

    def machine(self) -> Machine:
        """The one with most processes, and with most threads."""
        processes: Counter[str | None] = Counter()
        tasks: Counter[str | None] = Counter()
        for address, threads in self.client.nthreads().items():
            host = urlsplit(address).hostname
            processes[host] += 1
            tasks[host] += threads
        return Machine(max(processes.values(), default=1), max(1, *tasks.values(), 1))

    @property
    def capacity(self) -> int:
        # one more each, so that no worker waits for this process
        return 2 * self.threads

    def submit(self, key: int, function: Callable[..., Any], *arguments: Any) -> None:
        self._tasks[key] = function, arguments
        self._submit(key)

    def _submit(self, key: int) -> None:
        function, arguments = self._tasks[key]
        future = self.client.submit(
            function, *arguments, key=f"ns-abstract-{key}-{self._command}", retries=_RETRIES, pure=False
        )
        self._futures[future] = key

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        from distributed import KilledWorker
        from distributed import TimeoutError as LateError
        from distributed import wait as wait_for
        from distributed.comm.core import CommClosedError

        if not self._futures:
            return []
        results: list[tuple[int, Any]] = []
        try:
            waited: Any = wait_for(list(self._futures), timeout=seconds, return_when="FIRST_COMPLETED")
            fetched = [future for future in waited.done if self._fetch(future, results)]
        except LateError:
            self._look()
            return []
        except KilledWorker:
            raise InputError(
                f"workers of the cluster ended {_RETRIES + 1} times at the same work",
                fix="memory may be short: give them more of it; what is finished is stored",
            ) from None
        except (CancelledError, CommClosedError):
            self._again()
            return []
        if not fetched:
            self._look()
            return []
        self._lost_since = None
        for future in fetched:
            del self._tasks[self._futures.pop(future)]
        return results

    def _fetch(self, future: Any, results: list[tuple[int, Any]]) -> bool:
        """Append a result; False if it does not come, because the worker that held it is gone: it is made anew."""
        # the built-in one from Python 3.11 on
        from distributed import TimeoutError as LateError

        try:
            value = future.result(timeout=self._patience)
        except LateError:
            # a large result over a slow line needs longer, and would never come whole
            self._patience *= 2.0
            return False
        self._patience = _FETCH
        results.append((self._futures[future], value))
        return True

    def _again(self) -> None:
        """Hand everything in once more: with the connection its tasks were lost.

        Raises:
            InputError: The scheduler does not answer any more.
        """
        end = time.monotonic() + _GONE
        while self.client.status == "connecting" and time.monotonic() < end:
            time.sleep(0.1)
        self._losses += 1
        if self.client.status != "running" or self._losses > _RETRIES:
            raise self._gone("is gone")
        lost = list(self._futures.values())
        self._futures.clear()
        self._command = secrets.token_hex(8)
        for key in lost:
            self._submit(key)

    def _look(self) -> None:
        """Refuse to wait for ever.

        Raises:
            InputError: The scheduler, or every worker, has been gone for a while.
        """
        if self._now():
            self._lost_since = None
            return
        now = time.monotonic()
        self._lost_since = self._lost_since or now
        if self.client.status == "closed" or now - self._lost_since > _GONE:
            raise self._gone("has no workers left" if self.client.status == "running" else "is gone")

    @staticmethod
    def _gone(problem: str) -> InputError:
        return InputError(
            f"the scheduler {problem}",
            field="--scheduler-address",
            fix="start scheduler and workers again, then go on with --resume; what is finished is stored",
        )

    def close(self) -> None:
        if self.client.status == "running":
            from distributed import TimeoutError as LateError

            with suppress(CancelledError, OSError, LateError):
                self.client.cancel(list(self._futures), force=True)
        self._futures.clear()


@dataclass(frozen=True)
class Tls:
    """Files (PEM) with which a client and a scheduler know each other, as Dask's own options have them.

    Attributes:
        ca_file: Who signs the others' certificates.
        cert, key: This client's own.
    """

    ca_file: Path
    cert: Path
    key: Path

    @classmethod
    def of(cls, ca_file: Path | None, cert: Path | None, key: Path | None, address: str | None) -> Tls | None:
        """What options say; None if none is given.

        Raises:
            InputError: Some are missing, a file cannot be read, or there is no scheduler to talk to.
        """
        options = {"--tls-ca-file": ca_file, "--tls-cert": cert, "--tls-key": key}
        if not any(options.values()):
            return None
        for name, file in options.items():
            if file is None:
                raise InputError("missing", field=name, fix=f"give all of {', '.join(options)}")
            file_size(file, "PEM file")
        if address is None:
            raise InputError("given without --scheduler-address", field="--tls-ca-file", fix="leave it out")
        assert ca_file is not None and cert is not None and key is not None
        _check_pem(ca_file, cert, key)
        return cls(ca_file, cert, key)


def _check_pem(ca_file: Path, cert: Path, key: Path) -> None:
    """Refuse files that hold no certificates.

    Raises:
        InputError: A file is no PEM file, or the key is another one's or needs a password.
    """

    def password() -> str:
        raise ValueError("the key needs a password")

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    for name, file, load in (
        ("--tls-ca-file", ca_file, lambda: context.load_verify_locations(ca_file)),
        ("--tls-cert", cert, lambda: context.load_cert_chain(cert, key, password)),
    ):
        try:
            load()
        except (OSError, ValueError) as error:
            words = " ".join(str(getattr(error, "reason", None) or error).replace("_", " ").lower().split())
            raise InputError(
                f"no certificate in PEM form, or not with this key ({words[:80]})",
                file=file,
                field=name,
                fix="give the files that `dask scheduler` was started with",
            ) from None


def _within(seconds: float, make: Callable[[], Any]) -> Any:
    """What ``make`` returns, if it does so in time: Dask waits for ever where a port takes connections in silence.

    Raises:
        OSError: It does not, or what answers is no scheduler.
        ValueError, TypeError: As ``make``.
    """
    results: list[Any] = []
    failed: list[Exception] = []

    def work() -> None:
        try:
            results.append(make())
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=work, name="connecting", daemon=True)
    thread.start()
    thread.join(seconds)
    if failed and isinstance(failed[0], (OSError, ValueError, TypeError)):
        raise failed[0]
    if failed:
        # what is no message of Dask's is taken for one, and its first bytes for sizes
        raise ConnectionError(type(failed[0]).__name__)
    if not results:
        raise TimeoutError
    return results[0]


@contextmanager
def connected(address: str | None, workers: int = 1, tls: Tls | None = None) -> Iterator[Any]:
    """A Dask client of the scheduler at ``address``, or of a cluster on this machine if None.

    That cluster and its dashboard listen on the loopback interface alone.

    Args:
        address: HOST:PORT.
        workers: Processes of the cluster on this machine, one thread each.
        tls: Encrypts the connection to ``address``, and both ends prove who they are.

    Raises:
        InputError: Dask is missing or its scheduler does not answer.
    """
    try:
        from dask import config
        from distributed import Client, Security
    except ImportError:
        raise InputError("needs the package dask", field="--engine", fix="pip install 'ns-abstract[cluster]'") from None
    try:
        if address is None:
            name = "distributed.nanny.pre-spawn-environ"
            settings = {key: value for key, value in config.get(name, {}).items() if key != _TRIM}
            with config.set({name: settings}):
                client: Any = Client(n_workers=workers, threads_per_worker=1, host=_LOOPBACK, dashboard_address=None)
        elif tls is None:
            client = _within(2.0 * _CONNECT, lambda: Client(address, timeout=_CONNECT))
        else:
            security = Security(
                require_encryption=True,
                tls_ca_file=str(tls.ca_file),
                tls_client_cert=str(tls.cert),
                tls_client_key=str(tls.key),
            )
            where = address if "://" in address else f"tls://{address}"
            client = _within(2.0 * _CONNECT, lambda: Client(where, timeout=_CONNECT, security=security))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"no scheduler answers at {address} ({type(error).__name__})",
            field="--scheduler-address",
            fix="start one with `dask scheduler` and workers with `dask worker HOST:PORT --nthreads 1`",
        ) from None
    except RuntimeError:
        # of a cluster on this machine: its workers cannot start
        script = _unguarded_script() if address is None else None
        if script is None:
            raise
        raise _needs_guard(script) from None
    try:
        yield client
    finally:
        # a client whose scheduler is gone may fail at its end, too
        with suppress(OSError, RuntimeError, TimeoutError):
            client.close()


EngineName = Literal["local", "dask"]


@contextmanager
def started(name: EngineName, address: str | None, workers: int, tls: Tls | None = None) -> Iterator[Engine]:
    """An engine, closed at the end of the block.

    Args:
        name: "dask", or "local": this process if there is one worker, otherwise processes.
        address: HOST:PORT of a Dask scheduler; None: a cluster on this machine.
        workers: Processes on this machine.
        tls: As for `connected`.

    Raises:
        InputError: As `connected`.
    """
    with ExitStack() as stack:
        if name == "dask":
            engine: Engine = Cluster(stack.enter_context(connected(address, workers, tls)))
        else:
            engine = SerialEngine() if workers == 1 else Processes(workers)
        stack.callback(engine.close)
        yield engine
