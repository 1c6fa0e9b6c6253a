"""Checks of arguments and options: numbers in their ranges, and paths; an InputError names ``field`` and the fix."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import FIX_ACCESS, show, unusable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import DTypeLike

#: Most nested lists and mappings in a value for `plain`, and most processes.
_DEEPEST = 64
_MOST_WORKERS = 1 << 16


def float64_of(value: Any) -> float:
    """Return ``value`` as float64, infinite where it is too large; NaN where it is no number (bool is none)."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def positive(value: Any, field: str) -> float:
    """Return ``value`` as a number above 0 and below infinity, from the argument or option ``field``.

    Raises InputError: it is none.
    """
    number = float64_of(value)
    if not 0.0 < number < math.inf:
        raise unusable(value, field=field, fix="give a positive number")
    return number


def at_least(value: Any, least: float, field: str) -> float:
    """Return ``value`` as a finite number that is no smaller than ``least``. Raises InputError where it is none."""
    number = float64_of(value)
    if not least <= number < math.inf:
        raise unusable(value, field=field, fix=f"give a number of at least {least:g}")
    return number


def whole(value: Any, least: int, field: str, most: int | None = None) -> int:
    """Return ``value`` as an integer from ``least`` to ``most``. Raises InputError where it is none."""
    number = int(value) if isinstance(value, Integral) and not isinstance(value, bool) else None
    if number is None or number < least or (most is not None and number > most):
        limits = f"a whole number of at least {least}" if most is None else f"{least} to {most}"
        raise unusable(value, field=field, fix=f"give {limits}")
    return number


def flag(value: Any, field: str) -> bool:
    """Return ``value`` as a bool, from the argument ``field``.

    Raises InputError: it is none; texts such as "no" would count as true.
    """
    if isinstance(value, bool):
        return value
    import numpy as np  # not for ``--help``

    if not isinstance(value, np.bool_):
        raise unusable(value, field=field, fix="give True or False")
    return bool(value)


def array_of(value: Any, dtype: DTypeLike | None = None) -> np.ndarray | None:
    """Return ``value`` as a NumPy array; None if it cannot be converted, such as a tensor that requires gradients."""
    import numpy as np

    try:
        return np.asarray(value, dtype)
    except Exception:  # what libraries' objects raise is theirs
        return None


def one_of(value: Any, names: Sequence[str], field: str) -> str:
    """Return ``value``, which is one of ``names``. Raises InputError where it is none."""
    if not (isinstance(value, str) and value in names):
        raise unusable(value, field=field, fix=f"use {' or '.join(names)}")
    return value


def workers_of(value: Any) -> int:
    """Return ``value`` as a number of processes. Raises InputError where no machine has so many."""
    return whole(value, 1, "workers", _MOST_WORKERS)


def callback(value: Any) -> None:
    """Raise InputError where ``on_progress`` is neither None nor something that can be called."""
    if value is not None and not callable(value):
        raise unusable(value, field="on_progress", fix="give a function of one argument, or None")


def plain(value: Any, depth: int = 0) -> Any:
    """Return ``value`` as a file of JSON has it: numpy's numbers and arrays, and tuples, become numbers and lists.

    ``depth``: how many lists and mappings hold it. Raises InputError where these are more than any file needs.
    """
    import numpy as np

    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    held = isinstance(value, Mapping) or (isinstance(value, Sequence) and not isinstance(value, str | bytes))
    if held and depth >= _DEEPEST:
        raise InputError("is nested too deeply, or holds itself", fix="give numbers, lists and mappings as in a file")
    if isinstance(value, Mapping):
        return {name: plain(entry, depth + 1) for name, entry in value.items()}
    return [plain(entry, depth + 1) for entry in value] if held else value


def file_path(value: Any, field: str) -> Path:
    """Return ``value`` as a path. Raises InputError where it can name no file; the file may be absent."""
    if not isinstance(value, str | os.PathLike):
        raise unusable(value, field=field, fix="give the path of a file")
    try:
        os.stat(value)
    except (OSError, ValueError) as error:
        # pathlib's tests of files pass on all errors but these
        if getattr(error, "errno", None) not in (errno.ENOENT, errno.ENOTDIR, errno.EBADF, errno.ELOOP):
            problem, name = f"cannot be opened: {getattr(error, 'strerror', None) or error}", show(os.fspath(value))
            raise InputError(problem, file=name, field=field, fix=FIX_ACCESS) from None
    return Path(value)
