"""The console scripts.

Imports take a second, in which a signal ends a command as it does later: by one line and exit code 3. In other programs
that import this package signals are theirs.
"""

import multiprocessing
import os
import signal
import sys
import threading
from types import FrameType


def _is_command() -> bool:
    """Whether this process is a console script, or ``python -m`` of one, and no worker of it."""
    script = os.path.basename(sys.argv[0] if sys.argv else "").startswith("ns-abstract-")
    module = any(word.startswith(f"{__name__}.") for word in sys.orig_argv[1:4])
    first = multiprocessing.parent_process() is None and threading.current_thread() is threading.main_thread()
    return (script or module) and first


def _leave(number: int, frame: FrameType | None) -> None:
    # nothing is to be saved yet
    os.write(2, b"interrupted\n")
    os._exit(3)


if _is_command():
    for _number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(_number, _leave)
