"""Docstrings cite what exists: names in single backticks are of the package, its files, or words that it reads."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import ns_abstract

PACKAGE = Path(ns_abstract.__file__).parent
#: A name, also of a module's or class' part, but not ``code``.
CITED = re.compile(r"(?<!`)`([A-Za-z_][\w.]*)(?:\(\))?`(?!`)")


def docstrings(tree: ast.Module) -> list[tuple[int, str]]:
    kinds = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    nodes = [node for node in ast.walk(tree) if isinstance(node, kinds)]
    return [(getattr(node, "lineno", 1), text) for node in nodes if (text := ast.get_docstring(node))]


def names_in(tree: ast.Module) -> set[str]:
    """Whatever is defined, assigned, imported or read from a file by that name."""
    found: set[str] = set()
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name) | ast.AsyncFunctionDef(name) | ast.ClassDef(name) | ast.Name(name):
                found.add(name)
            case ast.arg(name) | ast.Attribute(_, name):
                found.add(name)
            case ast.alias(name, other):
                found.update((other or name).split("."))
            case ast.Constant(str(name)) if name.isidentifier():
                found.add(name)
    return found


@cache
def trees() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def known() -> frozenset[str]:
    every = {name for path in PACKAGE.rglob("*") for name in (path.name, path.stem)}
    return frozenset(every.union(*map(names_in, trees().values())))


def missing(text: str, known: frozenset[str] | set[str]) -> list[str]:
    """Cited names that are nowhere."""
    return [name for name in CITED.findall(text) if name not in known and name.split(".")[-1] not in known]


@pytest.mark.slow
def test_names_in_docstrings_exist() -> None:
    wrong = [
        f"{path.relative_to(PACKAGE)}:{line} {name}"
        for path, tree in trees().items()
        for line, text in docstrings(tree)
        for name in missing(text, known())
    ]
    assert wrong == []


def test_names_that_are_nowhere_are_noticed() -> None:
    tree = ast.parse('class Box:\n    """Of `Box.low`, `half()` and ``half``."""\n    low = names["key"]\n')
    ((line, text),) = docstrings(tree)
    assert line == 1 and missing(text, names_in(tree)) == ["half"]
    assert missing("`key`, `Box.high`, `names`", names_in(tree)) == ["Box.high"]
