"""What the manual tells users to type is typed here: the tutorial's blocks in their order, and the notebooks."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
#: Seconds after which a step counts as hanging.
PATIENCE = 600

pytestmark = pytest.mark.skipif(not DOCS.is_dir(), reason="the documentation is not beside the tests")


def blocks(page: Path, kinds: tuple[str, ...]) -> list[tuple[str, str]]:
    """The fenced blocks of these kinds, in order."""
    return re.findall(rf"^```({'|'.join(kinds)})\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)


def environment() -> dict[str, str]:
    """This environment's commands first."""
    return os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"}


def run(command: list[str], folder: Path) -> str:
    done = subprocess.run(
        command, cwd=folder, env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
def test_tutorial(tmp_path: Path) -> None:
    """Every command ends well, and what the text says of the results is true of them."""
    found = blocks(DOCS / "tutorial.md", ("sh", "python"))
    kinds = [kind for kind, _ in found]
    first, last = kinds.index("python"), len(kinds) - kinds[::-1].index("python")
    assert set(kinds[first:last]) == {"python"} and kinds.count("sh") == 3
    for _, text in found[:first]:
        run(["bash", "-ec", text], tmp_path)
    script = tmp_path / "tutorial.py"
    check = """
assert (result.lower <= result.upper).all() and 1.0 <= result.ratio
assert cert.certified > 0.5 and cert.falsified > 0.05, (cert.certified, cert.falsified)
assert all(cell.lower[0] > -0.01 for cell in cert.cells if cell.verdict == "certified")
"""
    script.write_text("\n".join(text for _, text in found[first:last]) + check)
    run([sys.executable, str(script)], tmp_path)
    assert (tmp_path / "frame.npz").is_file() and (tmp_path / "net.onnx").is_file()
    for _, text in found[last:]:
        run(["bash", "-ec", text], tmp_path)
    assert (tmp_path / "abstract" / "report.html").is_file()
    report = json.loads((tmp_path / "certificate" / "report.json").read_text())
    assert report["state"] in ("done", "budget")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bound_a_scene", "certify_a_classifier"])
def test_notebook(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A notebook runs from top to bottom in an empty folder, and was stored with its results."""
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    book = nbformat.read(DOCS / "notebooks" / f"{name}.ipynb", as_version=4)
    shown = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("text/html" in output.get("data", {}) for output in shown), "stored without results"
    for variable, value in environment().items():
        monkeypatch.setenv(variable, value)
    client = nbclient.NotebookClient(
        book, timeout=PATIENCE, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    fresh = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("text/html" in output.get("data", {}) for output in fresh)
    assert not any(output.output_type == "error" for output in fresh)
