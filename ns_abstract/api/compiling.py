"""Kernels compiled side by side at first use: each process compiles some of a frame's stages and keeps them on disk."""

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
from ns_abstract.arithmetic.kernel_cache import store
from ns_abstract.execution.opening import opened

#: Seconds between two words on progress.
_PACE = 5.0

_log = logging.getLogger("ns_abstract.kernels")


def shares(stages: Sequence[str], count: int) -> list[list[str]]:
    """Stages, the slowest first, in at most ``count`` parts: the first ones alone, the rest together."""
    count = max(1, min(count, len(stages)))
    return [[stage] for stage in stages[: count - 1]] + [list(stages[count - 1 :])]


def compile_beside(job: Job, index: int, processes: int | None = None) -> None:
    """Compile what frame ``index`` needs in several processes, if no kernel is there yet.

    What they cannot compile is left to this process, which takes the others' kernels from the folder of kernels.

    Args:
        job: The scene with its sets.
        index: Number of a frame.
        processes: How many; None: one for every core.
    """
    stages = job.frame(index).stages
    parts = shares(stages, len(os.sched_getaffinity(0)) if processes is None else processes) if stages else []
    if len(parts) < 2 or not store().empty:
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
                    stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                ))  # fmt: skip
            stack.callback(_end, worker)
            here.send((job.recipe, index))
        said = time.monotonic()
        while running := [part for part, worker in zip(parts, workers, strict=True) if worker.poll() is None]:
            time.sleep(0.1)
            compiled = [_latest(line, before) for line, before in zip(lines, compiled, strict=True)]
            if time.monotonic() - said > _PACE:
                said = time.monotonic()
                names = ", ".join(stage.replace("_", " ") for part in running for stage in part)
                _log.info("compiling kernels (first use only): %d done; at work: %s", sum(compiled), names)
    store().refresh()


def _end(worker: subprocess.Popen[bytes]) -> None:
    worker.kill()
    worker.wait()


def _latest(line: Connection, before: int) -> int:
    """The last number that a worker has sent."""
    with suppress(EOFError, OSError):
        while line.poll():
            before = int(line.recv())
    return before


def _watch(line: Connection) -> None:
    """Say how many kernels are done; end this process with the one that started it."""
    while True:
        time.sleep(1.0)
        try:
            line.send(store().compiled)
        except OSError:
            os._exit(1)


def main() -> None:
    """Compile stages of the job and the frame that come over a pipe; arguments: its file descriptor, the stages."""
    line = Connection(int(sys.argv[1]))
    recipe, index = line.recv()
    threading.Thread(target=_watch, args=(line,), daemon=True).start()
    frame = opened(recipe).frame(index)
    for stage in sys.argv[2:]:
        frame.warm_up(stage)
        store().publish()


if __name__ == "__main__":
    main()
