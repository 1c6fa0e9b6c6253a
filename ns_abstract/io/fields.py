"""Checks of the fields of a perturbation object; the caller's ``fail`` makes the InputError that is raised."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import is_number, show

Range = tuple[float, float]
Vector = tuple[float, float, float]
#: Makes the error of a field from its name, what is wrong, and how to mend it.
Fail = Callable[[str, str, str], InputError]


def fail(name: str, problem: str, fix: str) -> InputError:
    """Return an InputError of the field ``name``."""
    return InputError(problem, field=name, fix=fix)


def known(value: Mapping[str, Any], keys: Collection[str], prefix: str, fail: Fail) -> None:
    """Raise the error of a key of ``value`` that is not in ``keys``; "$schema" is allowed if ``prefix`` is empty."""
    for key in value:
        if key not in keys and (prefix or key != "$schema"):
            raise fail(f"{prefix}{show(key).strip(chr(39))}", "unknown key", f"the keys are {', '.join(keys)}")


def interval(value: object, name: str, fail: Fail, *, symmetric: bool = True) -> Range:
    """Return an interval [low, high]; if ``symmetric``, a number r >= 0 means [-r, r]."""
    if symmetric and is_number(value):
        if value < 0:  # pyright: ignore[reportOperatorIssue]
            raise fail(name, f"found {show(value)}", "a radius is not negative; write [low, high] for an interval")
        return -float(value), float(value)  # pyright: ignore[reportArgumentType]
    kind = "a radius or an interval" if symmetric else "an interval"
    if not (isinstance(value, list) and len(value) == 2 and all(is_number(v) for v in value)):
        raise fail(name, f"found {show(value)}", f"write {kind} [low, high] of finite numbers")
    low, high = float(value[0]), float(value[1])
    if low > high:
        raise fail(name, f"the interval [{low:g}, {high:g}] is reversed", "write the smaller end first")
    return low, high


def vector(value: object, name: str, fail: Fail) -> Vector:
    """Return ``value``, a list of three finite numbers, as floats; raises the error of the field ``name`` otherwise."""
    if not (isinstance(value, list) and len(value) == 3 and all(is_number(v) for v in value)):
        raise fail(name, f"found {show(value)}", "write three finite numbers")
    return float(value[0]), float(value[1]), float(value[2])
