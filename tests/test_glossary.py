"""The glossary for developers and the code use the same words: every term is a name, and no synonym is one."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [page for page in (ROOT / "docs" / "dev" / "glossary.md",) if page.exists()]
if not PAGES:
    pytest.skip("the documents are not beside the tests", allow_module_level=True)


def rows(text: str) -> list[tuple[str, list[str], list[str]]]:
    """Every row of the tables: the term, the names that it has in the code, and the words that are not used for it."""
    found = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if line.startswith("|") and len(cells) == 4 and cells[0] not in ("term", "---"):
            found.append((cells[0], re.findall(r"`([^`]+)`", cells[2]), re.findall(r"`([^`]+)`", cells[3])))
    return found


ROWS = rows(PAGES[0].read_text(encoding="utf-8"))


@cache
def names() -> frozenset[str]:
    """Names of modules, classes, functions, parameters and variables of the package."""
    every: set[str] = set()
    for path in (ROOT / "ns_abstract").rglob("*.py"):
        every.add(path.stem)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                every.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                every.add(node.id)
            elif isinstance(node, ast.arg):
                every.add(node.arg)
    return frozenset(every)


def broken(rows: list[tuple[str, list[str], list[str]]], names: frozenset[str]) -> list[str]:
    """What the glossary says and the code does not keep."""
    missing = [f"{term}: no {name}" for term, own, _ in rows for name in own if name not in names]
    return missing + [f"{term}: {word} is a name" for term, _, others in rows for word in others if word in names]


@pytest.mark.slow
def test_terms_are_names_and_synonyms_are_not() -> None:
    assert len(ROWS) > 30
    assert broken(ROWS, names()) == []


def test_every_row_names_code() -> None:
    assert [term for term, own, _ in ROWS if not own] == []
    terms = [term for term, _, _ in ROWS]
    assert len(set(terms)) == len(terms)


def test_a_missing_term_and_a_synonym_are_found() -> None:
    table = "| term | meaning | in the code | not |\n|---|---|---|---|\n| cell | a box | `Cell` | `Brick` |\n"
    assert rows(table) == [("cell", ["Cell"], ["Brick"])]
    assert broken(rows(table), frozenset({"Cell"})) == []
    assert broken(rows(table), frozenset({"Box"})) == ["cell: no Cell"]
    assert broken(rows(table), frozenset({"Cell", "Brick"})) == ["cell: Brick is a name"]
