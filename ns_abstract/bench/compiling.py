"""Measures what each kernel costs to compile at first use."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from ns_abstract.api.files import PathJob
from ns_abstract.bench.sets import pose_set
from ns_abstract.execution.worker_cache import Recipe, load
from ns_abstract.geometry.poses import PoseBox

#: Functions that a row names: those that took most by themselves.
_NAMED = 3


@dataclass
class _Running:
    """A function while it compiles: its clocks at the start, and processor seconds of ``inner`` functions."""

    name: str
    wall: float
    processor: float
    inner: float = 0.0


@dataclass
class _Recorder:
    """Records the kernels that numba compiles while registered for numba's events "compile" and "llvm_lock"."""

    stage: str = ""
    rows: list[dict[str, Any]] = field(default_factory=list)
    _running: list[_Running] = field(default_factory=list)
    _own: dict[str, float] = field(default_factory=dict)
    _llvm: float = 0.0
    _locked: list[float] = field(default_factory=list)

    def start(self, event: Any) -> None:
        """Record that a function begins to compile."""
        function = event.data["dispatcher"].py_func
        name = f"{function.__module__.removeprefix('ns_abstract.')}.{function.__name__}"
        self._running.append(_Running(name, time.perf_counter(), time.process_time()))

    def end(self, event: Any) -> None:
        """Record that it is compiled; a kernel gets its row then."""
        last = self._running.pop()
        seconds = time.process_time() - last.processor
        self._own[last.name] = self._own.get(last.name, 0.0) + seconds - last.inner
        if self._running:
            self._running[-1].inner += seconds
            return
        most = sorted(self._own.items(), key=lambda item: -item[1])[:_NAMED]
        self.rows.append({
            "stage": self.stage,
            "kernel": last.name,
            "functions": len(self._own),
            "wall s": time.perf_counter() - last.wall,
            "processor s": seconds,
            "LLVM s": self._llvm,
            "of it": ", ".join(f"{name.rpartition('.')[2]} {own:.1f}" for name, own in most),
        })  # fmt: skip
        self._own, self._llvm = {}, 0.0

    def lock(self, _: Any) -> None:
        """Record that LLVM's lock is taken; it may be nested."""
        self._locked.append(time.perf_counter())

    def unlock(self, _: Any) -> None:
        """Record that LLVM's lock is released, and add the time to LLVM's."""
        since = self._locked.pop()
        if not self._locked:
            self._llvm += time.perf_counter() - since


@contextmanager
def recording() -> Iterator[_Recorder]:
    """Yield a recorder of what is compiled inside the block."""
    from numba.core import event

    recorder = _Recorder()

    class Listener(event.Listener):
        def __init__(self, start: Callable[[Any], None], end: Callable[[Any], None]) -> None:
            self.on_start, self.on_end = start, end  # pyright: ignore[reportAttributeAccessIssue]

        def on_start(self, event: Any) -> None: ...

        def on_end(self, event: Any) -> None: ...

    compiled, locked = Listener(recorder.start, recorder.end), Listener(recorder.lock, recorder.unlock)
    with event.install_listener("numba:compile", compiled), event.install_listener("numba:llvm_lock", locked):
        yield recorder


def _measured(recipe: Recipe[Any], poses: PoseBox) -> list[dict[str, Any]]:
    """Return the rows of one process without cached kernels."""
    view = load(recipe).method.frame(poses)
    with recording() as recorded:
        for stage in (*view.stages, None):
            recorded.stage = stage or "the rest"
            view.warm_up(stage)
    return recorded.rows


@contextmanager
def _without_kernels() -> Iterator[None]:
    """Let processes that start inside the block find no cached kernel, and store none."""
    from ns_abstract.arithmetic.kernel_cache import SESSION, VARIABLE

    before = dict(os.environ)
    with tempfile.TemporaryDirectory(prefix="ns-abstract-compiling-") as folder:
        os.environ.pop(SESSION, None)
        os.environ[VARIABLE] = str(Path(folder) / "kernels")
        try:
            yield
        finally:
            os.environ.clear()
            os.environ.update(before)


def compile_times(job: PathJob, name: str, frame: int) -> list[dict[str, Any]]:
    """Return a row for each kernel of a frame, compiled in one new process, and rows for stages and the sum.

    ``name``: of the set of poses; see `sets.SETS`. A row has the stage, the number of linked functions, seconds by the
    clock, of the processor, and inside LLVM, and the function that took most.
    """
    with _without_kernels(), ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        rows = pool.submit(_measured, job.recipe, pose_set(job, name, frame)).result()
    counted = ("functions", "wall s", "processor s", "LLVM s")
    total = {key: sum(row[key] for row in rows) for key in counted}
    return [{"set": name, **row} for row in [*rows, {"stage": "all", "kernel": "", **total, "of it": ""}]]
