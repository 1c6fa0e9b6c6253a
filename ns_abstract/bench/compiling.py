"""What compiling costs at first use, by kernel."""

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
    """A function that is being compiled: its clocks when it began, and processor seconds ``inner`` compiled for it."""

    name: str
    wall: float
    processor: float
    inner: float = 0.0


@dataclass
class _Recorder:
    """Rows of the kernels that numba compiles while it is registered (numba's events "compile" and "llvm_lock")."""

    stage: str = ""
    rows: list[dict[str, Any]] = field(default_factory=list)
    _running: list[_Running] = field(default_factory=list)
    _own: dict[str, float] = field(default_factory=dict)
    _llvm: float = 0.0
    _locked: list[float] = field(default_factory=list)

    def start(self, event: Any) -> None:
        """A function's turn begins."""
        function = event.data["dispatcher"].py_func
        name = f"{function.__module__.removeprefix('ns_abstract.')}.{function.__name__}"
        self._running.append(_Running(name, time.perf_counter(), time.process_time()))

    def end(self, event: Any) -> None:
        """It is compiled; a kernel's row is done with it."""
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
        """LLVM's lock is taken, once more where it is held."""
        self._locked.append(time.perf_counter())

    def unlock(self, _: Any) -> None:
        """It is given back."""
        since = self._locked.pop()
        if not self._locked:
            self._llvm += time.perf_counter() - since


@contextmanager
def recording() -> Iterator[_Recorder]:
    """What is compiled inside becomes rows."""
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
    """The rows of one process, which has no kernel."""
    view = load(recipe).method.frame(poses)
    with recording() as recorded:
        for stage in (*view.stages, None):
            recorded.stage = stage or "the rest"
            view.warm_up(stage)
    return recorded.rows


@contextmanager
def _without_kernels() -> Iterator[None]:
    """Processes that start inside find no kernel, and keep none."""
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
    """Seconds that each kernel of a frame takes to compile in one new process, stage by stage, and all together.

    ``name``: of the set of poses; see `sets.SETS`. Returns by kernel: its stage, how many functions it is linked from,
    seconds by the clock, of the processor, and inside LLVM, and what took most of it.
    """
    with _without_kernels(), ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        rows = pool.submit(_measured, job.recipe, pose_set(job, name, frame)).result()
    counted = ("functions", "wall s", "processor s", "LLVM s")
    total = {key: sum(row[key] for row in rows) for key in counted}
    return [{"set": name, **row} for row in [*rows, {"stage": "all", "kernel": "", **total, "of it": ""}]]
