"""Every file of the package stands in one row of the table of features."""

from __future__ import annotations

import pytest

pytest.importorskip("tomllib", reason="tomllib comes with Python 3.11")
from benchmark_scripts import script

lines = script("lines")
TABLE = lines.tomllib.loads(lines.TABLE.read_text(encoding="utf-8"))
FILES = [path.relative_to(lines.PACKAGE).as_posix() for path in sorted(lines.PACKAGE.rglob("*.py"))]


def test_every_file_is_in_one_row() -> None:
    assert {name: rows for name in FILES if len(rows := lines.rows_of(name, TABLE)) != 1} == {}


def test_every_row_has_files_and_functions_that_are_there() -> None:
    used = {row for name in FILES for _feature, row in lines.rows_of(name, TABLE)}
    assert {row for entry in TABLE.values() for row in entry["rows"]} == used
    assert all(count > 0 for _name, _feature, count in lines.moved(TABLE))


def test_sums_are_all_lines() -> None:
    total = sum(path.read_text(encoding="utf-8").count("\n") for path in lines.PACKAGE.rglob("*.py"))
    assert sum(lines.sums(TABLE).values()) == total
