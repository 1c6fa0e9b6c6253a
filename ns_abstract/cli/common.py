"""What the command lines share: exit codes, signals, one-line errors."""

from __future__ import annotations

import atexit
import gc
import io
import logging
import os
import re
import resource
import signal
import socket
import sys
import threading
from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, suppress
from types import FrameType
from typing import Any, NoReturn

from ns_abstract.execution.stopping import StopRequest, is_interruption
from ns_abstract.io.errors import InputError

DONE, BAD_INPUT, INTERRUPTED = 0, 2, 3
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
#: Seconds that a signal may wait for the interpreter.
_PATIENCE = 3.0
#: Bytes of address space below which torch and the compiler cannot start.
_LEAST_ADDRESS_SPACE = 4 << 30
_SHORTAGE = (
    "can't allocate memory", "cannot allocate memory", "bad_alloc", "failed to allocate memory", "out of memory",
)  # fmt: skip
_NO_TEMPORARY_FOLDER = "No usable temporary directory"
#: New objects after which garbage is collected: imports make many that stay.
_GARBAGE = 50_000
#: Most characters of a complaint about options, which may repeat long options.
_COMPLAINT = 600

# threads that wait, awake, for milliseconds slow down those that work; OpenMP reads this when it is first loaded
os.environ.setdefault("GOMP_SPINCOUNT", "3000")


class SignalStop(StopRequest):
    """Turns SIGINT and SIGTERM into a request to stop; a second signal stops at once."""

    def __init__(self) -> None:
        super().__init__()
        self._heard = threading.Semaphore(0)

    def handle(self, number: int, frame: FrameType | None) -> None:
        self._heard.release()
        super().handle(number, frame)
        # the signal may have come in the middle of a print, which cannot begin another one
        with suppress(OSError):
            os.write(2, b"stopping; what is finished is being saved (once more: stop at once)\n")

    @contextmanager
    def installed(self) -> Iterator[SignalStop]:
        """Handle the signals inside the block."""
        with self.handling(*_SIGNALS), self._watched():
            yield self

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """End the process where the interpreter does not get to handle a signal: compilers take minutes."""
        receiver, sender = socket.socketpair()
        sender.setblocking(False)
        former = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)

        def watch() -> None:
            # ends when the other side is closed; the bytes are numbers of signals
            while number := receiver.recv(1):
                if number[0] in _SIGNALS and not self._heard.acquire(timeout=_PATIENCE):
                    # a full disk is no reason to stay
                    with suppress(InputError, OSError):
                        self.say_last_words()
                    print("interrupted", file=sys.stderr, flush=True)
                    os._exit(INTERRUPTED)

        watcher = threading.Thread(target=watch, name="signals", daemon=True)
        watcher.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(former)
            sender.close()
            watcher.join()
            receiver.close()


def command(program: str, kind: Any, parts: Mapping[str, Any] | None = None, about: str = "") -> Callable[[], Any]:
    """Return a function that parses a command line, or prints the command's version or help and leaves.

    Args:
        program: The console script.
        kind: What tyro reads: a dataclass, or a union of the parts.
        parts: Sub-commands by name: a dataclass, or an instance with the defaults.
        about: What the sub-commands are for.
    """

    def read() -> Any:
        import tyro

        from ns_abstract.cli.help import help_page

        text = help_page(program, kind, sys.argv[1:], parts or {}, about)
        if text is not None:
            print(text)
            raise SystemExit(DONE)
        return tyro.cli(kind, prog=program)

    return read


class _ToStderr(logging.Handler):
    """Logging handler that writes to the present `sys.stderr`."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr, flush=True)


def show_log() -> None:
    """Print the package's log messages to stderr, one line each."""
    log = logging.getLogger("ns_abstract")
    if not log.handlers:
        handler = _ToStderr()
        handler.setFormatter(logging.Formatter("%(message)s"))
        log.addHandler(handler)
        log.setLevel(logging.INFO)
        log.propagate = False


def parse(read: Callable[[], Any]) -> Any:
    """Call ``read``, which parses the command line with tyro, and turn its complaint into one line.

    Raises InputError where the options cannot be used. Raises SystemExit: help was asked for and printed.
    """
    empty = [position for position, word in enumerate(sys.argv[1:], 1) if word == "" or word.endswith("=")]
    if empty:
        before = sys.argv[empty[0]].rstrip("=") or sys.argv[empty[0] - 1]
        raise InputError("is empty", field=before if before.startswith("-") else "an option", fix="give a value")
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            return read()
    except SystemExit as leave:
        if leave.code != BAD_INPUT:
            raise
        raise mistake(complaint(said.getvalue())) from None


def complaint(text: str) -> str:
    """Return the message of an error box that tyro prints, as one line."""
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
        if words and not words.startswith(("For full helptext", "Argument helptext", "Arguments similar to")):
            points.append(words.partition(" Got errors:")[0].rstrip("."))
    text = "; ".join(points) or "the options cannot be read"
    return text if len(text) <= _COMPLAINT else f"{text[: _COMPLAINT - 3]}..."


def _named(lines: list[str]) -> list[str]:
    """Return the names of options in lines of a help page: those at line starts with the least indentation."""
    matches = [match for line in lines if (match := re.match(r"( +)(--?[a-z][\w-]*)", line))]
    outermost = min((len(match[1]) for match in matches), default=0)
    return [match[2] for match in matches if len(match[1]) == outermost]


def run(
    main: Callable[..., int], options: Callable[[], Any], relief: str = "raise --downscale-factor or free memory"
) -> NoReturn:
    """Parse options, run ``main`` and leave with its exit code; a user's mistake is one line and exit code 2.

    Args:
        main: Gets the options.
        options: Parses them.
        relief: What a user can do where memory is short.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # names of files need not be text
            stream.reconfigure(errors="backslashreplace")
    show_log()
    gc.set_threshold(_GARBAGE)
    # memory goes back with the process
    atexit.register(gc.freeze)
    over = False

    def leave(number: int, frame: FrameType | None) -> None:
        # once the work has ended, there is nothing left to be told
        if over:
            os._exit(INTERRUPTED)
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        # until `SignalStop` handles them, and after
        for number in _SIGNALS:
            signal.signal(number, leave)
        sys.unraisablehook = _end_lost_interruptions
    try:
        try:
            parsed = parse(options)
            _check_address_space()
            code = main(parsed)
        finally:
            over = True
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        code = BAD_INPUT
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interruption(error):
            raise
        print("interrupted", file=sys.stderr)
        # Python would end by the signal where the interruption left executed text, as a dataclass has; this forgets it
        namedtuple("Executed", ())
        # finalizers of what the interruption left half built have nothing to say
        sys.unraisablehook = lambda _: None
        code = INTERRUPTED
    except BrokenPipeError:
        # what is left in the streams goes nowhere; flushing it at the end would fail again
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(nowhere, stream)
        code = INTERRUPTED
    except Exception as error:
        detail = " ".join(str(error).split())[:200]
        if _is_shortage(error):
            print(f"error: not enough memory{': ' + detail if detail else ''}; {relief}", file=sys.stderr)
        elif isinstance(error, FileNotFoundError) and _NO_TEMPORARY_FOLDER in detail:
            # libraries look for one as they are imported
            print(f"error: {error.strerror}; set TMPDIR to a folder where files may be made", file=sys.stderr)
        else:
            raise
        code = BAD_INPUT
    sys.exit(code)


def _end_lost_interruptions(lost: sys.UnraisableHookArgs) -> None:
    """End the process where a signal came inside a finalizer, which swallows the exception; print other errors."""
    if lost.exc_value is None or not is_interruption(lost.exc_value):
        sys.__unraisablehook__(lost)
        return
    print("interrupted", file=sys.stderr, flush=True)
    os._exit(INTERRUPTED)


def _is_shortage(error: Exception) -> bool:
    """Whether memory was short; torch, onnxruntime and the loader of libraries say so in words alone."""
    words = str(error).lower()
    return isinstance(error, MemoryError) or any(part in words for part in _SHORTAGE)


def _check_address_space() -> None:
    """Libraries end the process where they get no memory or no thread.

    Raises:
        InputError: A limit leaves too little.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    # once they are loaded, what is left is a matter of the work
    loaded = "torch" in sys.modules and "numba" in sys.modules
    if limit != resource.RLIM_INFINITY and limit < _LEAST_ADDRESS_SPACE and not loaded:
        raise InputError(
            f"the address space is limited to {limit / 2**30:.1f} GiB",
            fix=f"raise `ulimit -v` to at least {_LEAST_ADDRESS_SPACE >> 10}, or use --memory-limit instead",
        )


def _is(word: str, kind: type) -> bool:
    try:
        kind(word)
    except ValueError:
        return False
    return True


def _value(detail: str) -> tuple[str, str] | None:
    """Return the unusable word and a fix, from tyro's text on a value that is no number; None for other texts."""
    quoted = re.search(r"(?:from|float:|base 10:|arguments:) (\[.*\]|'.*')", detail)
    words = re.findall(r"'([^']*)'", quoted[1]) if quoted else []
    expected = detail.split(" could be", maxsplit=1)[0]
    numbers = [word for word in words if not _is(word, float)]
    if not words or (quoted and "type" in detail and not re.search("FLOAT|INT", expected)):
        return None
    whole = "INT" in expected or "int()" in detail or (not numbers and "arguments:" in detail)
    bad = (numbers or [word for word in words if not _is(word, int)]) if whole else numbers
    kind = "whole number" if whole else "number"
    count = len(re.findall("FLOAT|INT", expected))
    if "[" in expected:
        fix = f"give {kind}s"
    else:
        fix = f"give {count} {kind}s" if count > 1 else f"give a {kind}"
    return f"found {' '.join(bad or words)}", fix


def mistake(text: str) -> InputError:
    """Return tyro's complaint as an InputError, reworded if it is a frequent one."""
    field, problem, fix = None, text, None
    if (match := re.match(r"Error parsing (--[\w.-]+): (.*)", text)) and (value := _value(match[2])):
        field, (problem, fix) = match[1], value
    elif match := re.match(r"invalid choice '(.*)' for argument '(--[\w.-]+)'. Expected one of \((.*)\)", text):
        field, problem = match[2], f"found {match[1]}"
        fix = "use " + " or ".join(re.findall("'([^']*)'", match[3]))
    elif match := re.match(r"Missing value for argument '(--[\w.-]+)'", text):
        field, problem, fix = match[1], "no value", "give one"
    elif match := re.match(r"Unrecognized options: (.*?)(?:; perhaps (.*))?$", text):
        field = re.split(", |; ", match[1])[0]
        problem = "unknown option" if field.startswith("-") else "is no option's value"
        parts = re.search(r"Available subcommands: (.*)", text)
        fix = f"perhaps {match[2]}" if match[2] else f"use {parts[1]}" if parts else None
    elif match := re.match(r"Expected one of \{(.*)\}", text):
        problem, fix = "no sub-command", f"use {match[1]}"
    return InputError(problem, field=field, fix="; ".join(filter(None, (fix, "--help lists the options"))))
