"""What the command lines share: exit codes, signals, one-line errors."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

from ns_abstract.errors import InputError

DONE, BAD_INPUT, INTERRUPTED = 0, 2, 3


class Stop:
    """Turns SIGINT and SIGTERM into a request to stop; a second signal stops at once."""

    def __init__(self) -> None:
        self.signal: int | None = None

    def __call__(self) -> bool:
        return self.signal is not None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number
        print("stopping; what is finished is being saved (once more: stop at once)", file=sys.stderr, flush=True)

    @contextmanager
    def installed(self) -> Iterator[Stop]:
        """Handle the signals inside the block."""
        before = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def run(main: Callable[..., int], options: Callable[[], Any]) -> NoReturn:
    """Parse options, run ``main`` and leave with its exit code; a user's mistake is one line and exit code 2."""
    try:
        code = main(options())
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        code = BAD_INPUT
    except MemoryError as error:
        detail = " ".join(str(error).split())
        print(
            f"error: not enough memory{': ' + detail if detail else ''}; raise --downscale-factor or free memory",
            file=sys.stderr,
        )
        code = BAD_INPUT
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        code = INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()
        code = INTERRUPTED
    sys.exit(code)
