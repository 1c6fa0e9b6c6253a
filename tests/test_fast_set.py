"""The fast set (``-m "not slow"``) looks at everything: at each file of tests, and at each that has planted faults."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest
from benchmark_scripts import script

TESTS = Path(__file__).resolve().parent
FILES = sorted(path.name for path in TESTS.glob("test_*.py"))
#: Of one whole session of a user each, which is slow or nothing.
WHOLE = {"test_browser.py", "test_tutorial.py"}
#: Sources whose planted faults show alone in what takes seconds: a certified loop, kernels that are compiled anew,
#: skipped fragments in every mode, a whole search of a network.
LONG = {
    "verify/scene_pictures.py",
    "api/loop_job.py",
    "arithmetic/kernel_cache.py",
    "methods/splat/threshold_crossings.py",
    "reach/film.py",
}


@cache
def functions(file: str) -> dict[str, set[str]]:
    """Names of the test functions of a file, and the marks of each."""
    found = {}
    for node in ast.walk(ast.parse((TESTS / file).read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            marks = {ast.unparse(one).partition("(")[0].rpartition(".")[2] for one in node.decorator_list}
            # slow_cases leaves cases out of functions that have them
            assert "slow_cases" not in marks or "parametrize" in marks, f"{file}: {node.name}"
            assert not {"slow", "slow_cases"} <= marks, f"{file}: {node.name}"
            found[node.name] = marks
    return found


@pytest.mark.parametrize("file", FILES)
def test_every_file_has_a_fast_test(file: str) -> None:
    assert any("slow" not in marks for marks in functions(file).values()) == (file not in WHOLE)


def test_every_file_with_planted_faults_has_a_fast_test() -> None:
    """One that a planted fault makes fail."""
    faults = script("planted").FAULTS
    fast = set()
    for fault in faults:
        file, *_, name = fault.test.partition("[")[0].split("::")
        if "slow" not in functions(file)[name]:
            fast.add(fault.file)
    assert {fault.file for fault in faults} - fast == LONG


def test_cases_that_are_left_out(pytestconfig: pytest.Config) -> None:
    """The first case of a function with `slow_cases` stays, and every so many after it."""

    class Item:
        def __init__(self, nodeid: str, mark: pytest.Mark | None) -> None:
            self.nodeid, self.mark, self.marks = nodeid, mark, []

        def get_closest_marker(self, name: str) -> pytest.Mark | None:
            return self.mark if self.mark is not None and self.mark.name == name else None

        def add_marker(self, name: str) -> None:
            self.marks.append(name)

    one, every = pytest.mark.slow_cases.mark, pytest.mark.slow_cases(every=3).mark
    items = [Item(f"a::f[{k}]", one) for k in range(3)] + [Item(f"a::g[{k}]", every) for k in range(7)]
    items.append(Item("a::h", None))
    pytestconfig.pluginmanager.get_plugin(str(TESTS / "conftest.py")).pytest_collection_modifyitems(items)
    assert [k for k, item in enumerate(items) if not item.marks] == [0, 3, 6, 9, 10]
