"""The page of commands: what each prints for --help."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import entry_points
from typing import Any

_PLACE = "<!-- help of every command -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page's source with the help of every console script of the package."""
    if _PLACE not in markdown:
        return markdown
    scripts = {e.name: e.module for e in entry_points(group="console_scripts") if e.module.startswith("ns_abstract.")}
    parts = []
    for name, module in sorted(scripts.items()):
        call = f"import sys; sys.argv[0] = {name!r}; from {module} import main; main()"
        told = subprocess.run([sys.executable, "-c", call, "--help"], capture_output=True, text=True, check=True).stdout
        parts.append(f"## {name}\n\n```text\n{told.rstrip()}\n```")
    return markdown.replace(_PLACE, "\n\n".join(parts))
