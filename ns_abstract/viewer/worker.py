"""The process that bounds what the viewer shows: small pictures first, the newest request only.

A process of its own, because compiled kernels hold the interpreter for as long as a cell takes, and
because it can be ended at any time. It talks to `ns_abstract.viewer.background` through a private
pipe.  To the worker: ("scene", token, source), ("work", number, view, seconds, known side). From it:
("ready", token, problems), ("begin", number), ("picture", number, snapshot), ("done", number),
("error", number, text).
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from ns_abstract.arithmetic.selfcheck import check_functions
from ns_abstract.execution.cancellation import WorkCancelledError
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.io.errors import InputError
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.refine.result import TracePoint
from ns_abstract.viewer.views import Snapshot, Source, ViewRequest

#: Seconds that a request waits for a newer one: the camera may still be moving.
_SETTLE = 0.08
#: Seconds between pictures of one refinement.
_BETWEEN = 0.3
#: Where a view is good enough.
_RATIO = 1.05
_LEAF_BYTES = 512 << 20


class BoundsWorker:
    """Answers requests until the other end of the pipe is closed."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.source: Source | None = None
        self.problems: tuple[str, ...] = ()
        self.refinement: Refinement | None = None
        self.about: tuple[Any, ...] = ()
        self._waiting: list[tuple[Any, ...]] = []

    def run(self) -> None:
        self.problems = tuple(check_functions())
        while True:
            kind, *content = self._next()
            if kind == "scene":
                token, self.source = content
                self.refinement = None
                assert self.source is not None
                self.source.warm_up()
                self.connection.send(("ready", token, self.problems))
                continue
            number = content[0]
            self.connection.send(("begin", number))
            try:
                self._work(*content)
            except InputError as error:
                self.refinement = None
                self.connection.send(("error", number, str(error)))
            except (ArithmeticError, ValueError, IndexError, AssertionError, MemoryError) as error:
                self.refinement = None
                self.connection.send(("error", number, f"{type(error).__name__}: {error}"))

    def _next(self) -> tuple[Any, ...]:
        """Waits for messages, returns the first in line; a "work" request replaces one just ahead of it."""
        while True:
            patience = None if not self._waiting else _SETTLE if self._waiting[0][0] == "work" else 0.0
            if not self.connection.poll(patience):
                return self._waiting.pop(0)
            message = self.connection.recv()
            # a newer request takes the place of the one before it
            if message[0] == "work" and self._waiting and self._waiting[-1][0] == "work":
                self._waiting.pop()
            self._waiting.append(message)

    def _work(self, number: int, view: ViewRequest, seconds: float, known: int) -> None:
        assert self.source is not None
        perturbation, key = view.perturbation, (view.key, view.camera.height, view.camera.width)
        if self.refinement is not None and self.about == key and self.refinement.covered:
            refinement = self.refinement
            refinement.progress = _Teller(self, number, refinement)
            refinement.proceed(self._goal(refinement.trace[-1].seconds + seconds))
            self.tell(number, refinement, final=not self._stopped())
        else:
            for camera, share in view.stages(seconds, known, self.source.ladder):
                if not self._bound(number, camera, perturbation, share, key if camera is view.camera else ()):
                    return
        if not self._stopped():
            self.connection.send(("done", number))

    def _bound(
        self, number: int, camera: PinholeCamera, perturbation: Any, seconds: float, about: tuple[Any, ...]
    ) -> bool:
        """Refine one size; False if a newer message waits."""
        assert self.source is not None
        frame = self.source.frame(camera, perturbation)
        refinement = Refinement(
            frame, 0, self._goal(seconds), stopped=self._stopped, scene_samples=frame.scene_samples(0)
        )
        refinement.progress = _Teller(self, number, refinement)
        self.refinement, self.about = refinement, about
        with suppress(WorkCancelledError):
            refinement.run()
        stopped = self._stopped()
        if refinement.covered:
            self.tell(number, refinement, final=not stopped)
        return not stopped

    def _goal(self, seconds: float) -> RefinementGoal:
        return RefinementGoal(_RATIO, seconds, None, _LEAF_BYTES)

    def _stopped(self) -> bool:
        return self.connection.poll()

    def tell(self, number: int, refinement: Refinement, *, final: bool) -> None:
        assert self.source is not None
        guarantee = "sampled" if self.problems else self.source.guarantee
        self.connection.send(("picture", number, Snapshot.of(refinement.snapshot(), final=final, guarantee=guarantee)))


class _Teller:
    """Sends pictures of a refinement that goes on, not too often."""

    def __init__(self, worker: BoundsWorker, number: int, refinement: Refinement) -> None:
        self.worker, self.number, self.refinement = worker, number, refinement
        self.last = -_BETWEEN

    def __call__(self, point: TracePoint, share: float) -> None:
        if self.refinement.covered and time.monotonic() - self.last >= _BETWEEN:
            self.worker.tell(self.number, self.refinement, final=False)
            self.last = time.monotonic()


def main() -> None:
    """Serve the pipe whose file descriptor is the only argument."""
    os.nice(10)
    try:
        BoundsWorker(Connection(int(sys.argv[1]))).run()
    except (EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        # the viewer has ended
        pass


if __name__ == "__main__":
    main()
