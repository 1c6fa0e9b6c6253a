"""Lines of the package by feature, from the table in lines.toml: ``python benchmarks/lines.py``.

Lines are all of a file: code, comments, docstrings and blank ones.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tomllib

TABLE = Path(__file__).with_suffix(".toml")
PACKAGE = TABLE.parent.parent / "ns_abstract"


def rows_of(name: str, table: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the features and rows that a file of the package matches; there must be one."""
    return [
        (feature, row)
        for feature, entry in table.items()
        for row in entry["rows"]
        if name == row or (row.endswith("/") and name.startswith(row))
    ]


def function_lines(path: Path, names: set[str]) -> int:
    """Return the lines of a file's functions, classes and methods ("Class.method"). KeyError: there is none."""
    found: dict[str, int] = {}

    def visit(nodes: list[ast.stmt], within: str) -> None:
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                start = min([node.lineno, *(item.lineno for item in node.decorator_list)])
                found[within + node.name] = (node.end_lineno or 0) - start + 1
                visit(node.body if isinstance(node, ast.ClassDef) else [], f"{node.name}.")

    visit(ast.parse(path.read_text(encoding="utf-8")).body, "")
    return sum(found[name] for name in names)


def moved(table: dict[str, Any]) -> Iterator[tuple[str, str, int]]:
    """Yield what functions take from their file's feature: the file, the feature that they belong to, and lines."""
    for feature, entry in table.items():
        names: dict[str, set[str]] = {}
        for item in entry.get("functions", []):
            name, function = item.split(":")
            names.setdefault(name, set()).add(function)
        for name, functions in names.items():
            yield name, feature, function_lines(PACKAGE / name, functions)


def sums(table: dict[str, Any]) -> Counter[str]:
    """Return lines by feature."""
    found: Counter[str] = Counter()
    for path in PACKAGE.rglob("*.py"):
        ((feature, _row),) = rows_of(path.relative_to(PACKAGE).as_posix(), table)
        found[feature] += path.read_text(encoding="utf-8").count("\n")
    for name, feature, lines in moved(table):
        found[rows_of(name, table)[0][0]] -= lines
        found[feature] += lines
    return found


if __name__ == "__main__":
    table = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    result = sums(table)
    for existed, title in ((True, "what existed"), (False, "later features")):
        group = {feature: lines for feature, lines in result.items() if table[feature].get("existed", False) == existed}
        print(f"{sum(group.values()):7,} {title}")
        for feature, lines in sorted(group.items(), key=lambda entry: -entry[1]):
            print(f"{lines:11,} {feature}")
