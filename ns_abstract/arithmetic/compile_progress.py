"""Lines of text that report the progress of compiling kernels."""

from __future__ import annotations

import time


class CompileProgress:
    """Makes lines on the progress of compiling, with the larger estimate by seconds and by functions done.

    ``functions``: about how many functions all kernels have. ``seconds``: how long compiling them took when it was
    measured. ``pace``: seconds between two lines.
    """

    def __init__(self, functions: int, seconds: float, pace: float) -> None:
        self.functions, self.seconds, self._pace = functions, seconds, pace
        self._begin = time.monotonic()
        self._shown = self._begin

    def line(self, done: int) -> str:
        """Return the line to print when ``done`` functions are compiled."""
        used = time.monotonic() - self._begin
        done = min(done, self.functions)
        # the first ones say little about the others, but more than a time that is over
        telling = done > self.functions // 3 or used > self.seconds
        by_count = used * (self.functions - done) / done if done and telling else 0.0
        left = max(self.seconds - used, by_count, 1.0)
        return f"compiling kernels (first use only): {done} of {self.functions} functions, about {left:.0f} s left"

    def due(self) -> bool:
        """Whether it is time for the next line."""
        now = time.monotonic()
        due = now - self._shown > self._pace
        if due:
            self._shown = now
        return due
