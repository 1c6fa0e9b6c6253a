"""What CONTRIBUTING.md and docs/dev/architecture.md cite exists, and what they count is so."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "ns_abstract"
PAGES = [ROOT / "CONTRIBUTING.md", ROOT / "docs" / "dev" / "architecture.md"]
if not all(page.exists() for page in PAGES):
    pytest.skip("the documentation is not beside the tests", allow_module_level=True)
#: What paths in the pages begin at.
HOMES = (ROOT, PACKAGE, *(PACKAGE / name for name in ("methods", "arithmetic", "verify")))
#: Files that users write or commands leave, and words of other programs.
FOREIGN = {"LOOP.json", "report.json", "Unreleased", "release", "site"}


@cache
def names() -> frozenset[str]:
    """All that is defined or set in the package and its tests, and what pyproject.toml names."""
    found = set(re.findall(r"[\w-]+", (ROOT / "pyproject.toml").read_text(encoding="utf-8")))
    for path in [*PACKAGE.rglob("*.py"), *(ROOT / "tests").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                found.add(node.id)
            elif isinstance(node, ast.arg):
                found.add(node.arg)
    return frozenset(found)


def problems(text: str) -> list[str]:
    """What ``text`` cites, in backticks, links or commands, that there is not."""
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S)
    plain = re.sub(r"^```\w*\n.*?^```", "", text, flags=re.M | re.S)
    spans = set(re.findall(r"`([^`]+)`", plain))
    words = {word for span in spans for word in span.split()}
    words |= {
        word for block in fenced for word in block.split() if "/" in word and not word.startswith((".venv", "dist"))
    }
    cited = {word.strip("'\",") for word in words} - FOREIGN
    paths = {word for word in cited if re.fullmatch(r"[\w.-]*(/[\w.-]*)+|[\w-]+\.(py|md|toml|json|txt)", word)}
    found = [word for word in paths if not any((home / word).exists() for home in HOMES)]
    links = set(re.findall(r"\]\(([\w./-]+)(?:#[\w-]+)?\)", plain))
    found += [link for link in links if not (ROOT / link).exists()]
    # of commands, only the paths
    found += [word for word in spans - paths - FOREIGN if re.fullmatch(r"[A-Za-z_]\w*", word) and word not in names()]
    return sorted(found)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_is_cited_exists(page: Path) -> None:
    assert problems(page.read_text(encoding="utf-8")) == []


@pytest.mark.slow
def test_what_is_missing_is_noticed() -> None:
    text = (
        "`no/such.py`, [a](docs/no.md), `NoSuchName`, `tests/wall.py`, `Rasteriser`\n```sh\npytest tests/no.py\n```\n"
    )
    assert problems(text) == ["NoSuchName", "docs/no.md", "no/such.py", "tests/no.py"]


def test_every_folder_has_its_line() -> None:
    text = PAGES[0].read_text(encoding="utf-8")
    told = {name for row in re.findall(r"^\| (`[^|]*) \|", text, re.M) for name in re.findall(r"`(\w+)/`", row)}
    assert told == {path.parent.name for path in PACKAGE.glob("*/__init__.py")}


def test_lines_of_the_smallest_representation() -> None:
    (said,) = re.findall(r"`tests/wall.py` is a whole one in (\d+) lines", PAGES[0].read_text(encoding="utf-8"))
    lines = (ROOT / "tests" / "wall.py").read_text(encoding="utf-8").count("\n")
    assert abs(lines - int(said)) <= 0.1 * int(said)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_other_figures(page: Path) -> None:
    """Counts of lines, files, tests, kernels or parameters go stale; what is counted is counted by a test."""
    text = page.read_text(encoding="utf-8").replace("whole one in 200 lines", "")
    assert re.findall(r"\b\d[\d,]* (?:lines|files|tests|kernels|modules|faults)\b|parameters is \d+", text) == []
