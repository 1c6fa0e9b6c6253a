"""Requests to stop, made by a signal or by the caller."""

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
    """A request to stop that is checked between pieces of work; a second signal stops at once."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._asked = False
        self._raising = 0
        self._last: Callable[[], object] = lambda: None

    def __call__(self) -> bool:
        return self._asked

    def ask(self) -> None:
        """Ask for it."""
        self._asked = True

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Inside the block there is nothing to save: a signal, also one before, raises KeyboardInterrupt."""
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
        """Inside the block, ``write`` says what is there if the process ends in a library call, on any thread."""
        before, self._last = self._last, write
        try:
            yield
        finally:
            self._last = before

    def say_last_words(self) -> None:
        """Called by who ends the process."""
        self._last()

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: take it as a request, or end the work where it is."""
        again, self.signal = self.signal is not None, number
        self._asked = True
        if again or self._raising:
            raise KeyboardInterrupt

    @contextmanager
    def handling(self, *numbers: int) -> Iterator[None]:
        """Handle the signals inside the block."""
        before = {number: signal.signal(number, self.handle) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def interruptible() -> Iterator[StopRequest]:
    """Yield a request that Ctrl-C sets, where Python's own handler would raise KeyboardInterrupt.

    In other threads, and programs that handle the signal themselves, signals are left alone.
    """
    stop = StopRequest()
    main = threading.current_thread() is threading.main_thread()
    if main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with stop.handling(signal.SIGINT):
            yield stop
    else:
        yield stop
