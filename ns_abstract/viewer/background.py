"""Abstract images for a viewer: requests are answered at once with the best bounds so far (design.md, W2).

The bounding itself runs in worker processes (`ns_abstract.viewer.worker`). One works, one is kept
ready in reserve: a worker that is still busy with what nobody wants any more is ended and the other
takes over, so that a long cell never delays a new view, and a worker that dies takes nothing with it.
"""

from __future__ import annotations

import atexit
import multiprocessing
import os
import queue
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from ns_abstract.viewer.views import Snapshot, Source, ViewRequest

#: Memory for pictures that were seen before.
_CACHE_BYTES = 256 << 20
#: A worker that ends sooner than this after its start is not replaced at once.
_SHORT_LIFE = 5.0
#: Views that are known to have been asked for before.
_REMEMBERED = 64
#: Of several browsers: seconds after which a view that nobody asked for again is nobody's, and patiences of the scene
#: after which another one's turn comes.
_HOLD, _TURN = 1.5, 25.0

_Key = tuple[Any, ...]


@dataclass(frozen=True)
class Status:
    """The background's ``state``: "off" (nothing to bound), "starting", "working", "idle" or "failed".

    ``detail`` is for people; empty where the state says all.
    """

    state: str
    detail: str = ""


class _Process:
    """One worker process and the two threads that talk to it."""

    def __init__(self, receive: Callable[[_Process, tuple[Any, ...] | None], None]) -> None:
        here, there = multiprocessing.Pipe()
        # the worker finds this package wherever it was imported from
        package = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join(part for part in (package, os.environ.get("PYTHONPATH")) if part)
        self.started = time.monotonic()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "ns_abstract.viewer.worker", str(there.fileno())],
            pass_fds=[there.fileno()],
            stdin=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": path},
        )
        there.close()
        #: token of the scene that its kernels are compiled for
        self.scene: int | None = None
        #: number of the request that it works on
        self.busy: int | None = None
        self._connection: Connection = here
        self._receiver = receive
        self._outbox: queue.SimpleQueue[tuple[Any, ...] | None] = queue.SimpleQueue()
        for work in (self._send, self._receive):
            threading.Thread(target=work, daemon=True, name="abstract-images").start()

    def post(self, message: tuple[Any, ...]) -> None:
        """Send ``message`` without waiting."""
        self._outbox.put(message)

    def end(self) -> None:
        """Kill the process, which holds no results."""
        self._outbox.put(None)
        self.process.kill()

    def _send(self) -> None:
        while (message := self._outbox.get()) is not None:
            try:
                self._connection.send(message)
            except OSError:
                return

    def _receive(self) -> None:
        try:
            while True:
                self._receiver(self, self._connection.recv())
        except (EOFError, OSError):
            self._outbox.put(None)
            self.process.wait()
            self._receiver(self, None)


class Background:
    """Bounds views in the background and remembers what it found.

    All methods return at once and may be called from any thread.

    Args:
        changed: Called from a thread of the background whenever there is something new to show.
        reserve: Whether a second worker is kept ready.
    """

    def __init__(self, changed: Callable[[], object] = lambda: None, *, reserve: bool = True) -> None:
        self.changed = changed
        self.problems: tuple[str, ...] = ()
        self._reserve = reserve
        self._lock = threading.RLock()
        self._source: tuple[int, Source] | None = None
        self._workers: list[_Process] = []
        self._cache: OrderedDict[_Key, Snapshot] = OrderedDict()
        #: number, key and view of the newest request, and the seconds it was given
        self._wanted: tuple[int, _Key, ViewRequest, float] | None = None
        self._asked = 0.0
        self._answered = True
        self._failures: dict[_Key, str] = {}
        #: when views were asked for last, the newest last, and since when some of them wait
        self._seen: OrderedDict[_Key, float] = OrderedDict()
        self._waiting: dict[_Key, float] = {}
        self._closed = False

    # --- what is asked -------------------------------------------------------------------------

    def show(self, source: Source) -> None:
        """Bound views of ``source`` from now on; the workers start and compile."""
        with self._lock:
            self._closed = False
            atexit.unregister(self.close)
            atexit.register(self.close)
            token = 0 if self._source is None else self._source[0] + 1
            self._source = token, source
            self._wanted, self._answered = None, True
            self._failures.clear()
            self._seen.clear()
            self._waiting.clear()
            for worker in self._workers:
                worker.post(("scene", token, source))
            self._start_missing_workers()

    def best(self, view: ViewRequest, seconds: float) -> Snapshot | None:
        """Return the best known snapshot of ``view``, or None, and request better bounds.

        Args:
            seconds: Time that the work on the view's own size may take.
        """
        with self._lock:
            if self._source is None or self._closed:
                return None
            key = (self._source[0], *view.key)
            snapshot = self._known(key, view)
            done = snapshot is not None and snapshot.final and snapshot.size >= (view.camera.height, view.camera.width)
            before = key in self._seen
            self._seen[key] = time.monotonic()
            self._seen.move_to_end(key)
            while len(self._seen) > _REMEMBERED:
                self._waiting.pop(self._seen.popitem(last=False)[0], None)
            known = done or key in self._failures or self._is_wanted(key, view)
            if not (known or (before and self._waits(key))):
                self._ask(key, view, seconds, 0 if snapshot is None or not snapshot.final else max(snapshot.size))
            return snapshot

    def more(self, seconds: float) -> None:
        """Refine the view of the newest request for ``seconds`` more."""
        with self._lock:
            if self._wanted is not None and self._source is not None:
                _, key, view, _ = self._wanted
                self._failures.pop(key, None)
                self._ask(key, view, seconds, view.side - 1)

    @property
    def status(self) -> Status:
        """Return the present state of the background process."""
        with self._lock:
            if self._source is None or self._closed:
                return Status("off")
            if self._wanted is not None and self._wanted[1] in self._failures:
                return Status("failed", self._failures[self._wanted[1]])
            if not self._workers:
                return Status("failed", "the bounding process ended right after its start")
            if self._workers[0].scene != self._source[0]:
                return Status("starting", "reading the scene, compiling kernels on first use")
            return Status("idle" if self._answered else "working")

    def close(self) -> None:
        """End the workers; `show` starts new ones."""
        with self._lock:
            self._closed = True
            workers, self._workers = self._workers, []
        for worker in workers:
            worker.end()
        atexit.unregister(self.close)

    # --- requests ------------------------------------------------------------------------------

    def _known(self, key: _Key, view: ViewRequest) -> Snapshot | None:
        snapshot = self._cache.get(key)
        if snapshot is None or not view.fits(*snapshot.size):
            return None
        self._cache.move_to_end(key)
        return snapshot

    def _waits(self, key: _Key) -> bool:
        """Whether a view that was seen before waits for the one that is worked on, as both are looked at.

        A moving camera shows views that were not seen before. Two browsers ask for theirs in turn, and work on neither
        would come to an end if each ended the other's.
        """
        now = time.monotonic()
        since = self._waiting.pop(key, now)
        if self._answered or self._wanted is None or self._source is None or key == self._wanted[1]:
            return False
        if self._seen.get(self._wanted[1], 0.0) >= since:
            since = now
        if now - since >= _HOLD or now - self._asked >= _TURN * self._source[1].patience:
            return False
        self._waiting[key] = since
        timer = threading.Timer(_HOLD, self._tell)
        timer.daemon = True
        timer.start()
        return True

    def _is_wanted(self, key: _Key, view: ViewRequest) -> bool:
        """Whether the newest request has the same ``key``, and pictures at least as large as those of ``view``."""
        return self._wanted is not None and self._wanted[1] == key and self._wanted[2].side >= view.side

    def _ask(self, key: _Key, view: ViewRequest, seconds: float, known: int) -> None:
        number = 0 if self._wanted is None else self._wanted[0] + 1
        self._wanted, self._answered, self._asked = (number, key, view, seconds), False, time.monotonic()
        self._start_missing_workers()
        if self._workers:
            self._workers[0].post(("work", number, view, seconds, known))
        assert self._source is not None
        timer = threading.Timer(self._source[1].patience, self._replace_stuck_worker)
        timer.daemon = True
        timer.start()

    # --- workers -------------------------------------------------------------------------------

    def _start_missing_workers(self) -> None:
        """Start workers, with the scene loaded, until there are one and `_reserve` more; none once closed."""
        while not self._closed and self._source is not None and len(self._workers) < 1 + self._reserve:
            worker = _Process(self._take)
            worker.post(("scene", *self._source))
            self._workers.append(worker)

    def _replace_stuck_worker(self) -> None:
        """End the first worker if it is stuck with an older request, and send the newest one to the reserve."""
        with self._lock:
            if self._closed or self._wanted is None or self._source is None or len(self._workers) < 2:
                return
            first, second = self._workers
            late = time.monotonic() - self._asked >= self._source[1].patience
            if self._answered or not late or first.busy in (None, self._wanted[0]) or second.scene != self._source[0]:
                return
            self._workers.pop(0)
            first.end()
            self._send_request()
            self._start_missing_workers()

    def _send_request(self) -> None:
        """Send the newest request to the first worker."""
        if self._workers and self._wanted is not None and not self._answered:
            number, _, view, seconds = self._wanted
            self._workers[0].post(("work", number, view, seconds, 0))

    def _take(self, worker: _Process, message: tuple[Any, ...] | None) -> None:
        """Handle a worker's message; None: it has ended."""
        with self._lock:
            if worker not in self._workers:
                return
            if message is None:
                self._lost(worker)
            else:
                self._heard(worker, *message)
        self._tell()

    def _tell(self) -> None:
        """Call ``changed``: there may be new bounds or another status."""
        try:
            self.changed()
        except Exception as error:
            # whoever looks may be gone: what is known stays, and the worker is heard on
            print(f"the viewer was not told of new bounds: {type(error).__name__}: {error}", file=sys.stderr)

    def _lost(self, worker: _Process) -> None:
        was_first = worker is self._workers[0]
        self._workers.remove(worker)
        if was_first and self._wanted is not None and worker.busy == self._wanted[0]:
            code = worker.process.returncode
            self._failures[self._wanted[1]] = f"the bounding process ended with code {code} (out of memory?)"
            self._answered = True
        elif was_first:
            self._send_request()
        if time.monotonic() - worker.started >= _SHORT_LIFE:
            self._start_missing_workers()

    def _heard(self, worker: _Process, kind: str, *content: Any) -> None:
        if kind == "ready":
            worker.scene, self.problems = content
            self._replace_stuck_worker()
            return
        if kind == "begin":
            worker.busy = content[0]
            return
        number = content[0]
        if kind in ("done", "error"):
            worker.busy = None
        if self._wanted is None or number != self._wanted[0] or worker is not self._workers[0]:
            return
        key, view = self._wanted[1:3]
        if kind == "picture":
            self._store(key, view, content[1])
        elif kind == "error":
            self._failures[key] = content[1]
            self._answered = True
        elif kind == "done":
            self._answered = True

    def _store(self, key: _Key, view: ViewRequest, snapshot: Snapshot) -> None:
        old = self._known(key, view)
        if old is not None and (old.size > snapshot.size or (snapshot.says_less(old) and not snapshot.final)):
            return
        self._cache[key] = snapshot
        self._cache.move_to_end(key)
        total = sum(entry.bytes for entry in self._cache.values())
        while total > _CACHE_BYTES and len(self._cache) > 1:
            total -= self._cache.popitem(last=False)[1].bytes
