"""Kernels compiled side by side at first use: processes compile stages of a frame into one folder of kernels."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection

from ns_abstract.api.job import Job
from ns_abstract.arithmetic.compile_progress import CompileProgress
from ns_abstract.arithmetic.kernel_cache import SESSION, KernelMissingError, store
from ns_abstract.execution.worker_cache import load
from ns_abstract.refine.protocol import Frame

#: Seconds between two lines on progress, and between two times that kernels are published.
_PACE = 5.0
#: Functions of a stage and the seconds that one core took for them; measured for one parameter (benchmarks.md).
_MEASURED = {
    "pixel_stage": (233, 30.0), "gaussian_stage": (111, 18.0), "moving_colors": (33, 8.0), "render": (9, 3.0),
}  # fmt: skip
#: The same of a stage that was not measured.
_UNMEASURED = (50, 20.0)

_log = logging.getLogger("ns_abstract.kernels")


def shares(stages: Sequence[str], count: int) -> list[list[str]]:
    """Return at most ``count`` groups of stages, given slowest first: the first ones alone, the rest together."""
    count = max(1, min(count, len(stages)))
    return [[stage] for stage in stages[: count - 1]] + [list(stages[count - 1 :])]


def missing(frame: Frame) -> list[str]:
    """Return the frame's stages whose kernels are not in the cache."""
    stages = []
    for stage in frame.stages:
        try:
            with store().complete():
                frame.warm_up(stage)
        except KernelMissingError:
            stages.append(stage)
    return stages


def _progress(parts: Sequence[Sequence[str]]) -> CompileProgress:
    """Return the progress of stages that are compiled side by side."""
    measured = [[_MEASURED.get(stage, _UNMEASURED) for stage in part] for part in parts]
    functions = sum(count for part in measured for count, _ in part)
    return CompileProgress(functions, max(sum(seconds for _, seconds in part) for part in measured), _PACE)


def compile_beside(job: Job, index: int, processes: int | None = None) -> None:
    """Compile the kernels that frame ``index`` needs and the cache lacks, in several processes, each once.

    What they cannot compile is left to this process. ``processes``: how many; None: one for every core.
    """
    frame = job.frame(index)
    if not frame.stages or not (stages := missing(frame)):
        return
    parts = shares(stages, len(os.sched_getaffinity(0)) if processes is None else processes)
    progress = _progress(parts)
    _log.info(progress.line(0))
    if len(parts) < 2:
        return
    compiled = [0] * len(parts)
    workers: list[subprocess.Popen[bytes]] = []
    lines: list[Connection] = []
    with ExitStack() as stack, suppress(OSError):
        # where there is no room for processes, this one compiles
        for part in parts:
            here, there = Pipe()
            lines.append(here)
            stack.callback(here.close)
            with there:
                command = [sys.executable, "-m", "ns_abstract.api.compiling", str(there.fileno()), *part]
                # a session of its own: signals are this process' to handle
                workers.append(worker := subprocess.Popen(
                    command, pass_fds=[there.fileno()], start_new_session=True,
                    env=os.environ | {SESSION: str(store().session)},
                    stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                ))  # fmt: skip
            stack.callback(_end, worker)
            here.send((job.recipe, index))
        while any(worker.poll() is None for worker in workers):
            time.sleep(0.1)
            compiled = [_latest(line, before) for line, before in zip(lines, compiled, strict=True)]
            if progress.due():
                _log.info(progress.line(sum(compiled)))
                store().publish()
    store().publish()


def _end(worker: subprocess.Popen[bytes]) -> None:
    worker.kill()
    worker.wait()


def _latest(line: Connection, before: int) -> int:
    """Return the newest number waiting on ``line``, without blocking; ``before`` if there is none or it is closed."""
    with suppress(EOFError, OSError):
        while line.poll():
            before = int(line.recv())
    return before


def _watch(line: Connection) -> None:
    """Send the number of compiled kernels over ``line``; end this process when its parent has ended."""
    while True:
        time.sleep(1.0)
        try:
            line.send(store().functions)
        except OSError:
            os._exit(1)


def main() -> None:
    """Compile stages of the job and the frame that come over a pipe; arguments: its file descriptor, the stages."""
    line = Connection(int(sys.argv[1]))
    recipe, index = line.recv()
    threading.Thread(target=_watch, args=(line,), daemon=True).start()
    frame = load(recipe).frame(index)
    for stage in sys.argv[2:]:
        frame.warm_up(stage)


if __name__ == "__main__":
    main()
