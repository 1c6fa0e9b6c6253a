"""A Dask cluster as an engine, and its connection."""

from __future__ import annotations

import secrets
import ssl
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ns_abstract.execution.engines import RETRIES, Machine, Task, needs_guard, unguarded_script
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size

_LOOPBACK = "127.0.0.1"
#: Seconds that a scheduler is given to be reached, and as many to say that it is one.
_CONNECT = 10.0
#: Seconds that a cluster without workers, or a scheduler that does not answer, is waited for.
_GONE = 30.0
#: Seconds that the first try to fetch a finished result may take; each further one has twice as many.
_FETCH = 5.0
#: Makes torch give memory back and fault it in again for every cell, 1.6 times slower.
_TRIM = "MALLOC_TRIM_THRESHOLD_"


class Cluster:
    """Runs tasks on a Dask cluster through a client of `connected`; workers need input files under the same paths."""

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
        """Return the number of threads of the workers that are connected now."""
        if self.client.status != "running":
            return 0
        try:
            return sum(self.client.nthreads().values())
        except (OSError, CancelledError):
            return 0

    def machine(self) -> Machine:
        """Return the largest numbers of processes and of threads on one machine."""
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
            function, *arguments, key=f"ns-abstract-{key}-{self._command}", retries=RETRIES, pure=False
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
                f"workers of the cluster ended {RETRIES + 1} times at the same work",
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
        """Append a finished result and return True; submit the task again and return False if its worker is gone."""
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
        """Submit all open tasks again after a lost connection. InputError if the scheduler is gone."""
        end = time.monotonic() + _GONE
        while self.client.status == "connecting" and time.monotonic() < end:
            time.sleep(0.1)
        self._losses += 1
        if self.client.status != "running" or self._losses > RETRIES:
            raise self._gone("is gone")
        lost = list(self._futures.values())
        self._futures.clear()
        self._command = secrets.token_hex(8)
        for key in lost:
            self._submit(key)

    def _look(self) -> None:
        """Raise InputError if the scheduler, or every worker, has been gone for a while."""
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
    """PEM files with which a client and a scheduler authenticate each other, as in Dask's own options.

    Attributes:
        ca_file: The certificate authority that signed both certificates.
    """

    ca_file: Path
    cert: Path
    key: Path

    @classmethod
    def of(cls, ca_file: Path | None, cert: Path | None, key: Path | None, address: str | None) -> Tls | None:
        """Return the files that options name; None if they name none.

        Raises:
            InputError: Some are missing, a file cannot be read, or no scheduler address is given.
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
    """Raise InputError for a file that is not PEM, and for a key of another certificate or with a password."""

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
    """Return the result of ``make`` if it comes in time: Dask waits for ever on a port that accepts and stays silent.

    Raises:
        OSError: It does not come in time, or the other end is no scheduler.
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
    """Yield a Dask client of the scheduler at ``address``, or of a new cluster on this machine if None.

    The new cluster has ``workers`` processes of one thread and listens on the loopback interface alone. ``tls``
    encrypts the connection to ``address`` and authenticates both ends.
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
        script = unguarded_script() if address is None else None
        if script is None:
            raise
        raise needs_guard(script) from None
    try:
        yield client
    finally:
        # a client whose scheduler is gone may fail at its end, too
        with suppress(OSError, RuntimeError, TimeoutError):
            client.close()
