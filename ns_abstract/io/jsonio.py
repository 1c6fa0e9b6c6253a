"""Strict reading of text and JSON files written by other programs.

Every failure is an :class:`ns_abstract.io.errors.InputError` that names the file.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from ns_abstract.io.digests import record
from ns_abstract.io.errors import InputError

JSON_BYTES_LIMIT = 32 * 2**20
JSON_DEPTH_LIMIT = 64
# float() of an integer with this many digits cannot overflow.
INTEGER_DIGITS_LIMIT = 308


@dataclass(frozen=True)
class InputTuning:
    """Limits of numbers in files; others are refused, so no bound depends on the limits."""

    #: Least and largest size of numbers whose products and squares are to keep clear of overflow and underflow.
    least: float = 1e-15
    largest: float = 1e15
    #: A length or determinant below is taken for 0.
    nothing: float = 1e-12
    #: By how much a rotation may miss an orthonormal one (bounds take it as it is written), and a last row (0, 0, 0,
    #: 1).
    rotation: float = 1e-3
    last_row: float = 1e-6
    #: The limit ``rotation`` for keyframes that a segment connects: rounding to float32.
    segment: float = 2e-6
    #: Relative difference of intrinsics up to which two cameras are one.
    lens: float = 1e-6
    #: Most normalised units by which float32 may move a camera of a data set.
    placed: float = 1e-3


MODERATE = InputTuning.least, InputTuning.largest
FIX_MODERATE = f"0, or between {MODERATE[0]:g} and {MODERATE[1]:g} in size"
FIX_ACCESS = "check the path, the links on the way and the permissions"

_TOKEN = re.compile(
    r'(?P<string>"[^"\\]*(?:\\.[^"\\]*)*")(?P<key>\s*:)?'
    r"|(?P<bracket>[\[\]{}])"
    r"|(?P<constant>-?Infinity|NaN)"
    r"|(?P<number>-?\d[\d.]*(?:[eE][-+]?\d+)?)",
    re.DOTALL,
)
# Strings are matched so that brackets in them are not.
_BRACKET = re.compile(r'[\[\]{}]|"[^"\\]*(?:\\.[^"\\]*)*"', re.DOTALL)


def show(value: Any) -> str:
    """Return a short one-line text of a value for error messages."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, str):
        text = ascii(value)
    elif isinstance(value, float) or (isinstance(value, int) and abs(value) < 10**40):
        text = repr(value)
    elif isinstance(value, int):
        text = "an integer of more than 40 digits"
    elif isinstance(value, dict):
        text = f"a mapping of {len(value)} keys"
    elif isinstance(value, (list, tuple)):
        text = f"a list of {len(value)} items"
    else:
        text = f"a value of type {type(value).__name__}"
    return text if len(text) <= 60 else f"{text[:57]}..."


def is_number(value: Any) -> TypeGuard[int | float]:
    """Whether ``value`` is a finite int or float that float64 can hold (bool is not a number)."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


def is_moderate(value: Any) -> TypeGuard[int | float]:
    """Whether ``value`` is a number that is 0 or neither tiny nor huge (`MODERATE`)."""
    return is_number(value) and (value == 0 or MODERATE[0] <= abs(value) <= MODERATE[1])


def file_size(path: Path, what: str, fix: str | None = None) -> int:
    """Return the size in bytes of a regular file.

    ``what``: what the file should be, for messages, such as "checkpoint". ``fix``: what to do when it is absent. Raises
    InputError where the file is absent, not accessible or not a regular file.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        raise InputError(f"no such {what}", file=path, fix=fix or "check the path") from None
    except OSError as error:
        raise InputError(
            f"{what} cannot be opened: {error.strerror or type(error).__name__}", file=path, fix=FIX_ACCESS
        ) from None
    except ValueError:
        raise InputError(f"not a valid path for a {what}", file=show(str(path)), fix="check the path") from None
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"is a folder, not a {what}", file=path, fix="give the file inside it")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"not a regular file, so not a {what}", file=path, fix="copy it to a regular file")
    return status.st_size


def unusable(value: Any, *, field: str, fix: str, file: Path | None = None) -> InputError:
    """Return an InputError which states that ``field`` holds the unusable ``value``."""
    return InputError(f"found {show(value)}", file=file, field=field, fix=fix)


def file_beside(folder: Path, name: str, field: str = "") -> Path:
    """Return the path of the file ``name``, relative to ``folder``, that a file there names in ``field``.

    Raises InputError: the name leads out of the folder, also through links.
    """
    try:
        target, inside = (folder / name).resolve(), folder.resolve()
        good = target != inside and target.is_relative_to(inside)
    except (OSError, ValueError, RuntimeError):
        good = False
    if not good or "\0" in name:
        problem = f"{show(name)} leads out of the folder"
        raise InputError(problem, field=field or None, fix="put the file beside the one that names it")
    return folder / name


def read_bytes(path: Path, what: str, limit: int) -> bytes:
    """Return contents of a regular file of at most ``limit`` bytes.

    Raises InputError: as :func:`file_size`, or the file is larger than ``limit`` or unreadable.
    """
    size = file_size(path, what)
    if size > limit:
        raise InputError(
            f"{what} has {size} bytes, more than the limit of {limit}",
            file=path,
            fix="check that this is the file meant",
        )
    try:
        with path.open("rb") as stream:
            # one byte more: the file may grow between the two calls; Python makes room for all that is asked for
            data = stream.read(size + 1)
    except OSError as error:
        raise InputError(
            f"{what} cannot be read: {error.strerror or type(error).__name__}", file=path, fix="check the permissions"
        ) from None
    if len(data) > size:
        raise InputError(f"{what} grew while it was read", file=path, fix="wait until it is written")
    record(path, lambda: hashlib.sha256(data))
    return data


def read_text(path: Path, what: str, limit: int) -> str:
    """Return contents of a UTF-8 file of at most ``limit`` bytes; a byte-order mark is dropped.

    Raises InputError: as :func:`read_bytes`, or the file is empty or not UTF-8.
    """
    data = read_bytes(path, what, limit)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{what} is not UTF-8 text (byte {error.start})", file=path, fix="save it as UTF-8") from None
    if not text.strip():
        raise InputError(f"{what} is empty", file=path, fix="write the file again")
    return text


def load_json(path: Path, what: str = "JSON file", limit: int = JSON_BYTES_LIMIT, depth: int = JSON_DEPTH_LIMIT) -> Any:
    """Parse a JSON file strictly, as :func:`parse_json` does.

    Raises InputError: as :func:`read_text` and :func:`parse_json`.
    """
    return parse_json(read_text(path, what, limit), file=path, depth=depth)


def parse_json(text: str, file: str | Path | None = None, depth: int = JSON_DEPTH_LIMIT) -> Any:
    """Parse JSON strictly: no repeated keys, no NaN or infinity, bounded nesting and numbers.

    Returns dict, list, str, bool, None, int or float; every number is finite in float64. Raises InputError: with the
    line number of the first fault.
    """
    strict = _Strict()
    try:
        value = json.loads(
            text,
            parse_int=strict.integer,
            parse_float=strict.real,
            parse_constant=strict.constant,
            object_pairs_hook=strict.mapping,
        )
    except json.JSONDecodeError as error:
        raise InputError(
            f"not valid JSON: {error.msg} at line {error.lineno}, column {error.colno}",
            file=file,
            fix="correct the syntax" if text.lstrip().startswith(("{", "[")) else "give a JSON file",
        ) from None
    except RecursionError:
        raise InputError(f"JSON nested more than {depth} levels deep", file=file, fix="remove the nesting") from None
    if not strict.good or _deeper(text, depth):
        _check_tokens(text, file, depth)
    return value


class _Strict:
    """Hooks of json.loads that clear ``good`` at values to be refused; `_check_tokens` then finds the line."""

    def __init__(self) -> None:
        self.good = True

    def integer(self, text: str) -> int:
        if len(text) <= INTEGER_DIGITS_LIMIT:
            return int(text)
        self.good = False
        return 0

    def real(self, text: str) -> float:
        value = float(text)
        self.good &= math.isfinite(value)
        return value

    def constant(self, text: str) -> float:
        self.good = False
        return math.nan

    def mapping(self, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        self.good &= len(content) == len(pairs)
        return content


def _deeper(text: str, depth: int) -> bool:
    """Whether brackets of valid JSON are nested more than ``depth`` deep."""
    level = 0
    for bracket in _BRACKET.findall(text):
        if bracket in ("[", "{"):
            level += 1
            if level > depth:
                return True
        elif bracket in ("]", "}"):
            level -= 1
    return False


def _check_tokens(text: str, file: str | Path | None, depth: int) -> None:
    """Raise InputError with the line of the first fault that Python's json module accepts in ``text``.

    Faults are repeated keys, NaN, infinity, numbers too large for float64, and nesting of over ``depth`` levels.
    """
    open_objects: list[set[str]] = []
    for token in _TOKEN.finditer(text):
        problem = fix = key = None
        if token["key"]:
            key = json.loads(token["string"])
            if key in open_objects[-1]:
                problem, fix = f"key {show(key)} stands twice in one object", "keep one of them"
            open_objects[-1].add(key)
        elif token["bracket"]:
            if token["bracket"] in "[{":
                open_objects.append(set())
                if len(open_objects) > depth:
                    problem, fix = f"JSON nested more than {depth} levels deep", "remove the nesting"
            else:
                open_objects.pop()
        elif token["constant"]:
            problem, fix = f"{token['constant']} is not a JSON number", "write a finite number"
        elif token["number"] and not _representable(token["number"]):
            problem, fix = "number too large for float64", "write a smaller number"
        if problem:
            line = text.count("\n", 0, token.start()) + 1
            field = None if key is None else show(key).strip("'")
            raise InputError(f"{problem} (line {line})", file=file, field=field, fix=fix)


def _representable(number: str) -> bool:
    if number.lstrip("-").isdigit():
        return len(number) <= INTEGER_DIGITS_LIMIT
    return math.isfinite(float(number))
