"""What the command lines share: exit codes, signals, one-line errors."""

from __future__ import annotations

import io
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr
from types import FrameType
from typing import Any, NoReturn

from ns_abstract.errors import InputError

DONE, BAD_INPUT, INTERRUPTED = 0, 2, 3

# threads that wait, awake, for milliseconds slow down those that work; OpenMP reads this when it is first loaded
os.environ.setdefault("GOMP_SPINCOUNT", "3000")


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


def parse(read: Callable[[], Any]) -> Any:
    """Call ``read``, which parses the command line with tyro, and turn its complaint into one line.

    Raises:
        InputError: The options cannot be used.
        SystemExit: Help was asked for and printed.
    """
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            return read()
    except SystemExit as leave:
        if leave.code != BAD_INPUT:
            raise
        raise InputError(complaint(said.getvalue()), fix="--help lists the options") from None


def complaint(text: str) -> str:
    """The point of an error box that tyro prints, as one line."""
    # on a terminal there are colours, elsewhere the box may have no lines
    lines = re.sub(r"\x1b\[[0-9;]*m", "", text).splitlines()
    sections: list[list[str]] = [[]]
    # the title comes first and repeats what follows
    for line in lines[1:]:
        inner = re.sub(r"^\s*│|│\s*$", "", line).rstrip()
        if re.fullmatch(r"[\s─╰╯-]*[─-]{8}[\s─╰╯-]*", inner):
            sections.append([])
        elif inner:
            sections[-1].append(inner)
    points = []
    for section in sections:
        words = " ".join(" ".join(section).split())
        if words.startswith("Missing from"):
            words = f"missing {', '.join(_named(section))}"
        if words.startswith("Perhaps you meant"):
            words = f"perhaps {' or '.join(_named(section))}"
        if words and not words.startswith(("For full helptext", "Argument helptext")):
            points.append(words.partition(" Got errors:")[0].rstrip("."))
    return "; ".join(points) or "the options cannot be read"


def _named(lines: list[str]) -> list[str]:
    """Options that lines begin with; their help stands below them, further in."""
    found = [match for line in lines if (match := re.match(r"( +)(--?[a-z][\w-]*)", line))]
    outermost = min((len(match[1]) for match in found), default=0)
    return [match[2] for match in found if len(match[1]) == outermost]


def run(main: Callable[..., int], options: Callable[[], Any]) -> NoReturn:
    """Parse options, run ``main`` and leave with its exit code; a user's mistake is one line and exit code 2."""
    try:
        code = main(parse(options))
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
