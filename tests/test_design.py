"""docs/dev/design.md and the code name each other: every label cites functions that say so, and tests that exist."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DESIGN = ROOT / "docs" / "dev" / "design.md"
if not DESIGN.exists():
    pytest.skip("the documents are not beside the tests", allow_module_level=True)
TEXT = DESIGN.read_text(encoding="utf-8")
#: Label and what stands below it, up to the next label or section.
LABELS = re.findall(r"(?ms)^\*\*([A-Z]\d+)[ .].*?(?=^\*\*[A-Z]\d+[ .]|^## |\Z)", TEXT)
BODIES = {
    m.group(1): m.group(0) for m in re.finditer(r"(?ms)^\*\*([A-Z]\d+)[ .].*?(?=^\*\*[A-Z]\d+[ .]|^## |\Z)", TEXT)
}
#: Names in backticks that are none of this package: of gsplat, CUDA, torch, the shell.
FOREIGN = re.compile(r"torch\.|np\.|[a-z_]+\.cuh?$|add_blur$|expf$|__|rsqrt|sqrt|bmm$|everywhere$|SystemError$|ceil$")


def named(body: str, what: str) -> list[str]:
    """The dotted names in the last line of a label that begins with ``what``."""
    lines = re.findall(rf"\*{what}:\*\s+((?:`[^`]+`(?:,\s+)?)+)", body)
    return re.findall(r"`([^`]+)`", lines[-1]) if lines else []


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def find(dotted: str) -> tuple[ast.Module, ast.AST]:
    """The module and the node that ``dotted`` names below the package.

    Raises:
        LookupError: There is no such thing.
    """
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        path = (ROOT / "ns_abstract").joinpath(*parts[:count]).with_suffix(".py")
        if not path.exists():
            continue
        module = tree(path)
        node: ast.AST = module
        for name in parts[count:]:
            found = [
                child
                for child in getattr(node, "body", ())
                if isinstance(child, ast.FunctionDef | ast.ClassDef) and child.name == name
            ]
            if not found:
                raise LookupError(f"{dotted}: no {name} in {path.name}")
            node = found[-1]
        return module, node
    raise LookupError(f"{dotted}: no such module")


def cited(docstring: str) -> set[str]:
    """Labels that a docstring cites, alone, in lists or in ranges."""
    found = set()
    for first, low, high in re.findall(r"\b([A-Z])(\d+)(?:-[A-Z](\d+))?\b", docstring):
        found |= {f"{first}{k}" for k in range(int(low), int(high or low) + 1)}
    return found


def test_labels_are_in_order() -> None:
    for section in re.split(r"(?m)^## ", TEXT)[1:]:
        numbers = [int(n) for n in re.findall(r"(?m)^\*\*[A-Z](\d+)[ .]", section)]
        first = numbers[0] if numbers else 1
        assert first in (0, 1) and numbers == list(range(first, first + len(numbers))), section[:40]
    assert len(LABELS) == len(set(LABELS)) > 60


@pytest.mark.slow_cases(every=4)
@pytest.mark.parametrize("label", LABELS)
def test_code_says_the_label(label: str) -> None:
    """Each function that a label names cites the label, in its docstring or (a module) in its own."""
    names = named(BODIES[label], "Code")
    assert names, "cites no code"
    for name in names:
        module, node = find(name)
        docstring = ast.get_docstring(node) if node is not module else ast.get_docstring(module)  # pyright: ignore[reportArgumentType]
        assert label in cited(docstring or ""), f"{name} does not cite {label}"


@pytest.mark.slow_cases
@pytest.mark.parametrize("label", LABELS)
def test_tests_exist(label: str) -> None:
    names = named(BODIES[label], "Tests")
    assert names, "names no test"
    for name in names:
        module, function = name.split(".")
        path = ROOT / "tests" / f"{module}.py"
        assert path.exists(), name
        assert function in {n.name for n in ast.walk(tree(path)) if isinstance(n, ast.FunctionDef)}, name


@pytest.mark.slow
def test_names_in_the_text_exist() -> None:
    """What stands in backticks is the name of something, somewhere in the package."""
    defined = set()
    for path in (ROOT / "ns_abstract").rglob("*.py"):
        defined |= {path.stem, path.parent.name, path.name}
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                defined.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                defined.add(node.id)
            elif isinstance(node, ast.arg):
                defined.add(node.arg)
            elif isinstance(node, ast.Attribute):
                defined.add(node.attr)
    names = set(re.findall(r"`([A-Za-z_][\w.]*)(?:\(\))?`", re.sub(r"\*(Code|Tests):\*[^*]*", "", TEXT)))
    assert (
        sorted(n for n in names if not FOREIGN.match(n) and not set(n.removesuffix(".py").split(".")) & defined) == []
    )


def test_other_labels_are_noticed() -> None:
    assert cited("see B1-B3, O1 and (design.md, G10)") == {"B1", "B2", "B3", "O1", "G10"}
    with pytest.raises(LookupError):
        find("methods.splat.blend.no_such_thing")
    with pytest.raises(LookupError):
        find("methods.no_such_module.name")
