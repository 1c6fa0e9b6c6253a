"""The documentation site: it builds, and browsers show its formulas."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from browser import Browser, chromium
from test_architecture import project
from waiting import until

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built site."""
    pytest.importorskip("latex2mathml", reason="the extra [docs] is not installed")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


@pytest.mark.slow
def test_no_formula_stays_raw(site):
    formulas = 0
    for page in site.rglob("index.html"):
        html = re.sub(r"<(code|script|pre)\b.*?</\1>", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        assert "$" not in html, f"{page.parent.name}: {html[html.index('$') - 40 : html.index('$') + 40]!r}"
        assert "arithmatex" not in html, page.parent.name
        formulas += html.count("<math")
    assert formulas > 700


@pytest.mark.slow
def test_start_page_notebooks_and_commands(site):
    """The start page says how to install and what can be asked; notebooks and commands have pages."""
    start = (site / "index.html").read_text(encoding="utf-8")
    for word in ("pip install", "ns-abstract-reach", "ns-abstract-certify", "notebooks/bound_a_scene/", "to_torch"):
        assert word in start, word
    for notebook in (ROOT / "docs" / "notebooks").glob("*.ipynb"):
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        page = (site / "notebooks" / notebook.stem / "index.html").read_text(encoding="utf-8")
        kinds = [kind for cell in cells for output in cell.get("outputs", ()) for kind in output.get("data", {})]
        assert page.count("data:image/png;base64,") >= kinds.count("image/png") > 0
        code = next(cell for cell in cells if cell["cell_type"] == "code")
        assert page.count('class="language-python"') == sum(cell["cell_type"] == "code" for cell in cells)
        assert "".join(code["source"]).split("(")[0].split()[-1] in page
    commands = (site / "commands" / "index.html").read_text(encoding="utf-8")
    for name in project()["scripts"]:
        assert f"usage: {name}" in commands, name
    assert "--tyro-write-completion" in commands


@pytest.mark.skipif(chromium() is None, reason="Chromium is not installed")
def test_browser_shows_formulas(site, tmp_path):
    with Browser((site / "dev" / "design" / "index.html").as_uri(), tmp_path / "profile") as page:
        until(lambda: page.ask("document.querySelectorAll('math').length > 700"), "the page")
        # on a busy machine the last ones are laid out after they are counted
        hidden = (
            "[...document.querySelectorAll('math')].filter(f => f.getBoundingClientRect().height < 1)"
            ".map(f => f.outerHTML)"
        )
        until(lambda: page.ask(hidden) == [], "every formula has a height")
        # a fraction is higher than a line of text only where the browser lays formulas out
        fractions = page.ask(
            "[...document.querySelectorAll('math[display=block] mfrac')].map(f => f.getBoundingClientRect().height)"
        )
        assert max(fractions) > 25
