"""Notebooks as pages: cells, and the results that they were stored with."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File


def _result(output: dict[str, Any]) -> str:
    """A stored result as Markdown."""
    data = {kind: "".join(text) for kind, text in output.get("data", {}).items()}
    if "text/html" in data:
        # a blank line would end the block of HTML
        return "<div>" + re.sub(r"\n\s*\n", "\n", data["text/html"]) + "</div>"
    if "image/png" in data:
        return f'<img alt="result of the cell above" src="data:image/png;base64,{data["image/png"].strip()}">'
    text = data.get("text/plain") or "".join(output.get("text", ()))
    return f"```text\n{text.rstrip()}\n```" if text else ""


def page(notebook: Path) -> str:
    """A notebook as a page's source."""
    parts = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(f"```python\n{source}\n```" if cell["cell_type"] == "code" else source)
        parts += [_result(output) for output in cell.get("outputs", ())]
    return "\n\n".join(part for part in parts if part)


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """The site's files with a page for every notebook."""
    for notebook in sorted(Path(config["docs_dir"]).glob("notebooks/*.ipynb")):
        name = notebook.relative_to(config["docs_dir"]).with_suffix(".md").as_posix()
        files.append(File.generated(config, name, content=page(notebook)))
    return files
