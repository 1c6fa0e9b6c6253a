"""The display of progress for all commands and for notebooks."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

from ns_abstract.io.errors import visible
from ns_abstract.report.figures import number

#: Seconds between lines where nothing can be redrawn.
_EVERY = 15.0


def plain_console() -> Any:
    """Return a console on stderr that prints texts literally, without terminal control characters.

    Where the reader of a pipe is gone it raises BrokenPipeError, as files do; rich would exit with code 1.
    """
    from rich.console import Console

    class Plain(Console):
        def print(self, *objects: Any, **more: Any) -> None:
            texts = (visible(o) if isinstance(o, str) else o for o in objects)
            super().print(*texts, **{"markup": False, "soft_wrap": True, **more})

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    return Plain(stderr=True, highlight=False)


class WorkProgress(Protocol):
    """What a display shows of the progress of bounding, certifying or reaching."""

    @property
    def done(self) -> float:
        """Fraction of the work that is done, from 0 to 1."""
        ...

    @property
    def sentence(self) -> str:
        """The result so far, as a sentence."""
        ...

    @property
    def elapsed(self) -> float:
        """Seconds of work so far."""
        ...

    @property
    def total_budget(self) -> float:
        """Seconds that the work may take."""
        ...


@dataclass(frozen=True)
class ShownProgress:
    """A `WorkProgress` of plain values."""

    done: float
    sentence: str
    elapsed: float
    total_budget: float


def time_text(point: WorkProgress, first: WorkProgress) -> str:
    """Return the seconds used, and those left at the pace since ``first``, at most the budget's, as text."""
    rest = max(0.0, point.total_budget - point.elapsed)
    gained = point.done - first.done
    rate = (1.0 - point.done) * (point.elapsed - first.elapsed) / gained if gained > 0.0 else math.inf
    budget = f" of {number(point.total_budget)}" if math.isfinite(point.total_budget) else ""
    used = f"{point.elapsed:.0f}{budget} s used"
    if point.done >= 1.0:
        return used
    if rate < rest:
        return f"{used}, about {rate:.0f} s left"
    return f"{used}, at most {rest:.0f} s left" if math.isfinite(rest) else used


class ProgressBar:
    """A live line of progress, to be passed as ``on_progress`` to `ns_abstract.bound`, `certify` and `reach`.

    The line is redrawn on a terminal and in a notebook; elsewhere a new line is printed every 15 seconds. Use it in a
    ``with`` block, which ends the line.

    Args:
        console: A console of rich; None: one on stderr.
    """

    def __init__(self, console: Any = None) -> None:
        self._console = console
        self._first: WorkProgress | None = None
        self._bar: Any = None
        self._task: Any = None
        self._cell: Any = None
        self._said = -math.inf

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the line; later calls begin a new one."""
        if self._bar is not None:
            self._bar.stop()
        self._first = self._bar = self._cell = None

    def __call__(self, point: WorkProgress) -> None:
        if self._first is None:
            self._begin(point)
        assert self._first is not None
        used = time_text(point, self._first)
        if self._bar is not None:
            self._bar.update(self._task, completed=point.done, sentence=point.sentence, used=used)
        elif self._cell is not None:
            self._cell.update({"text/plain": f"{point.done:.0%} · {point.sentence} · {used}"}, raw=True)
        elif time.monotonic() - self._said >= _EVERY:
            self._said = time.monotonic()
            self._console.print(f"{point.done:4.0%} · {point.sentence} · {used}", markup=False, soft_wrap=True)

    def _begin(self, point: WorkProgress) -> None:
        from rich.progress import BarColumn, Progress, TextColumn

        self._first, self._said = point, time.monotonic()
        if self._console is None and "ipykernel" in sys.modules:
            # which a notebook has, and nothing else needs
            display = import_module("IPython.display").display
            self._cell = display({"text/plain": ""}, raw=True, display_id=True)
            return
        self._console = self._console or plain_console()
        if self._console.is_terminal:
            columns = BarColumn(bar_width=20), TextColumn("{task.fields[sentence]} · {task.fields[used]}", markup=False)
            self._bar = Progress(*columns, console=self._console, transient=True)
            self._task = self._bar.add_task("", total=1.0, sentence="", used="")
            self._bar.start()
