"""Requests to stop, by a signal or by the caller."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


def is_interruption(error: BaseException) -> bool:
    """Return whether an error means that a signal interrupted the work (compiled functions raise SystemError then)."""
    if isinstance(error, SystemError):
        return isinstance(error.__cause__, KeyboardInterrupt)
    return isinstance(error, KeyboardInterrupt)


class StopRequest:
    """A request to stop that work checks between its parts; a second signal stops at once."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._asked = False
        self._raising = 0
        self._last: Callable[[], object] = lambda: None

    def __call__(self) -> bool:
        return self._asked

    def ask(self) -> None:
        """Request to stop."""
        self._asked = True

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Let a signal inside the block, and one before it, raise KeyboardInterrupt: there is nothing to save."""
        self._raising += 1
        try:
            if self.signal is not None:
                raise KeyboardInterrupt
            yield
        except SystemError as error:
            if is_interruption(error):
                raise KeyboardInterrupt from error
            raise
        finally:
            self._raising -= 1

    @contextmanager
    def last_words(self, write: Callable[[], object]) -> Iterator[None]:
        """Call ``write`` if a second signal ends the process inside the block, on any thread."""
        before, self._last = self._last, write
        try:
            yield
        finally:
            self._last = before

    def say_last_words(self) -> None:
        """Call the function of `last_words`, just before the process is ended."""
        self._last()

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: record the request, or end the work at once."""
        again, self.signal = self.signal is not None, number
        self._asked = True
        if again or self._raising:
            raise KeyboardInterrupt

    @contextmanager
    def handling(self, *numbers: int) -> Iterator[None]:
        """Install `handle` for the signals inside the block."""
        before = {number: signal.signal(number, self.handle) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def interruptible() -> Iterator[StopRequest]:
    """Yield a request that Ctrl-C sets, where Python's own handler would raise KeyboardInterrupt.

    In other threads, and in programs that handle the signal themselves, signals are left alone.
    """
    stop = StopRequest()
    main = threading.current_thread() is threading.main_thread()
    if main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with stop.handling(signal.SIGINT):
            yield stop
    else:
        yield stop
