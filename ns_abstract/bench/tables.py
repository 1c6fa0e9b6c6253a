"""Writes rows of figures as a table on the terminal, CSV and Markdown."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


def text(value: Any) -> str:
    """A figure with four digits, a count with separators, a dash for nothing."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """A Markdown table of rows with equal keys."""
    names = list(rows[0])
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(text(row[name]) for name in names) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def write(rows: Sequence[dict[str, Any]], folder: Path, name: str, title: str) -> None:
    """``NAME.csv`` and ``NAME.md`` in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / f"{name}.csv", "w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    (folder / f"{name}.md").write_text(f"# {title}\n\n{markdown(rows)}")


@dataclass
class Table:
    """A table that grows: every row is on the terminal and in the files once it is there.

    Attributes:
        folder, name, title: See `write`.
    """

    folder: Path
    name: str
    title: str
    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(self, *rows: dict[str, Any]) -> None:
        """Print and write more rows."""
        lines = markdown(rows).splitlines()
        print("\n".join(lines[2 if self.rows else 0 :]), flush=True)
        self.rows += rows
        write(self.rows, self.folder, self.name, self.title)
