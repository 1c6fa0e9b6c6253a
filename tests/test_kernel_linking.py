"""Functions that only kernels call have no machine code, and are what they are when Python calls them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from ns_abstract.arithmetic import kernel_linking
from ns_abstract.arithmetic.kernel_cache import store
from ns_abstract.arithmetic.kernel_linking import LinkedOnly
from ns_abstract.bench.compiling import recording


def kernel(function: Any, module: str = "ns_abstract.of_a_test") -> Any:
    function.__module__ = module
    return njit(error_model="numpy")(function)


def chain(module: str) -> tuple[Any, Any, Any]:
    """Three functions, each of which calls the one before it."""

    def least(x, y):
        return min(x, y) / 3.0

    def shifted(x, y):
        return inner(x, y) + 1.0

    def total(values):
        found = 0.0
        for k in range(values.size):
            found += middle(values[k], 0.5)
        return found

    inner = kernel(least)
    middle = kernel(shifted)
    return inner, middle, kernel(total, module)


def by_hand(values: list[float]) -> float:
    found = 0.0
    for value in values:
        found += min(value, 0.5) / 3.0 + 1.0
    return found


def linked_only(function: Any) -> list[bool]:
    return [isinstance(result.entry_point, LinkedOnly) for result in function.overloads.values()]


def test_functions_within_a_kernel_have_no_machine_code() -> None:
    inner, middle, outer = chain("ns_abstract.of_a_test")
    values, done = [0.1, 0.7, -2.0], store().functions
    assert outer(np.array(values)) == by_hand(values) and store().functions >= done + 3
    assert [linked_only(function) for function in (inner, middle, outer)] == [[True], [True], [False]]
    # Python calls it, the second kernel links what has machine code now
    middle.compile("float64(float64, float64)")
    assert [linked_only(function) for function in (inner, middle)] == [[True], [False]]
    assert middle(0.1, 0.5) == by_hand([0.1])
    assert [linked_only(function) for function in (inner, middle)] == [[True], [False]]

    def twice(values):
        return outer(values) + inner(values[0], 0.5)

    assert kernel(twice)(np.array(values)) == by_hand(values) + 0.1 / 3.0


def test_seconds_of_a_kernel_are_those_of_what_it_is_linked_from() -> None:
    _, middle, outer = chain("ns_abstract.of_a_test")
    with recording() as found:
        found.stage = "a stage"
        outer(np.array([0.1]))
        middle(0.1, 0.5)
    assert [(row["stage"], row["kernel"].rpartition(".")[2]) for row in found.rows] == [
        ("a stage", "total"), ("a stage", "shifted"),
    ]  # fmt: skip
    first, second = found.rows
    # and what numba compiles for them; the second kernel has the innermost function from the first
    assert first["functions"] >= 3 > second["functions"] >= 1
    assert all(row["processor s"] > 0.0 and 0.0 < row["LLVM s"] <= row["wall s"] for row in found.rows)


def test_kernels_of_others_are_compiled_as_numba_does() -> None:
    """Also where they call what has no machine code by then."""
    _, middle, outer = chain("elsewhere")
    assert kernel(lambda x: middle(x, 0.5) + 1.0)(0.1) == by_hand([0.1]) + 1.0
    assert linked_only(middle) == [True]
    assert outer(np.array([0.1, 0.7])) == by_hand([0.1, 0.7])
    assert linked_only(middle) == linked_only(outer) == [False]
    assert not kernel_linking.within_kernel()


def test_a_failure_ends_the_compilation() -> None:
    def wrong(x):
        return x.nothing

    inner = kernel(wrong)
    with pytest.raises(TypingError, match="nothing"):
        kernel(lambda x: inner(x) + 1.0)(1.0)
    assert not kernel_linking.within_kernel()
    test_functions_within_a_kernel_have_no_machine_code()


def test_callers_are_linked_before_what_they_call() -> None:
    """LLVM drops what nothing calls yet."""

    class Library(SimpleNamespace):
        __hash__ = object.__hash__  # pyright: ignore[reportAssignmentType]
        __eq__ = object.__eq__

    def made(*needed: Any, linked_only: bool = True) -> Any:
        return Library(_linking_libraries=list(needed), linked_only=linked_only)

    hidden = made()
    whole = made(hidden, linked_only=False)
    last = made()
    second = made(last, whole)
    first = made(last)
    # ``first`` comes first, and so ``last`` does before ``second`` unless it waits for it
    for needed in ([first, second], [second, first], [last, first, second]):
        found = kernel_linking._all_linked(made(*needed, linked_only=False))
        assert set(found) == {first, second, last, whole} and len(found) == 4
        assert found.index(last) > max(found.index(first), found.index(second))
