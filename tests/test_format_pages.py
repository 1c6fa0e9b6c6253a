"""A page of the documentation for every format, each with a command that its program takes."""

from __future__ import annotations

import importlib
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from test_architecture import project

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = sorted((DOCS / "formats").glob("*.md"))
SCRIPTS: dict[str, str] = project()["scripts"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_of_the_page_are_taken(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert blocks and page.read_text(encoding="utf-8").count("# ") >= 1
    for line in "".join(blocks).replace("\\\n", " ").splitlines():
        words = shlex.split(line.rpartition("&& ")[2])
        module, _, name = SCRIPTS[words[0]].partition(":")
        parsed: list[Any] = []

        def run(main: Any, options: Any, relief: str = "", parsed: list[Any] = parsed, **more: Any) -> None:
            parsed.append(options())

        monkeypatch.setattr(importlib.import_module(module), "run", run)
        monkeypatch.setattr(sys, "argv", words)
        getattr(importlib.import_module(module), name)()
        assert len(parsed) == 1, line


def test_every_page_is_in_the_site() -> None:
    text = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    entries = yaml.safe_load(re.sub(r"!!python/\S+", "", text))["nav"]
    named = next(entry["Formats"] for entry in entries if "Formats" in entry)
    assert sorted(value for entry in named for value in entry.values()) == [f"formats/{page.name}" for page in PAGES]
    overview = (DOCS / "formats.md").read_text(encoding="utf-8")
    assert all(f"formats/{page.name}" in overview for page in PAGES if page.stem != "schemas")
