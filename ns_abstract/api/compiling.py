"""Kernels compiled side by side at first use: each process compiles some of a frame's stages and keeps them on disk."""

from __future__ import annotations

import logging
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Sequence

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
    order = pickle.dumps((job.recipe, index))
    compiled = [0] * len(parts)
    workers: list[subprocess.Popen[bytes]] = []

    def listen(number: int, worker: subprocess.Popen[bytes]) -> None:
        assert worker.stdout is not None
        for line in worker.stdout:
            if line.strip().isdigit():
                compiled[number] = int(line)

    try:
        for number, part in enumerate(parts):
            # a session of its own: signals are this process' to handle
            worker = subprocess.Popen(
                [sys.executable, "-m", "ns_abstract.api.compiling", *part],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
            workers.append(worker)
            assert worker.stdin is not None
            worker.stdin.write(order)
            worker.stdin.flush()
            threading.Thread(target=listen, args=(number, worker), daemon=True).start()
        said = time.monotonic()
        while running := [part for part, worker in zip(parts, workers, strict=True) if worker.poll() is None]:
            time.sleep(0.1)
            if time.monotonic() - said > _PACE:
                said = time.monotonic()
                names = ", ".join(stage.replace("_", " ") for part in running for stage in part)
                _log.info("compiling kernels (first use only): %d done; at work: %s", sum(compiled), names)
    except OSError:
        # no room for processes: this one compiles
        pass
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()
    store().refresh()


def _watch() -> None:
    """Say how many kernels are done; end this process with the one that started it."""
    while True:
        time.sleep(1.0)
        try:
            print(store().compiled, flush=True)
        except OSError:
            os._exit(1)


def main() -> None:
    """Compile the stages that the command line names, of the job and the frame that stand on stdin."""
    recipe, index = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_watch, daemon=True).start()
    frame = opened(recipe).frame(index)
    for stage in sys.argv[1:]:
        frame.warm_up(stage)
        store().publish()


if __name__ == "__main__":
    main()
