"""Compiled kernels that are kept on disk belong to the sources that they were compiled from."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import ns_abstract

PROGRAM = """
import numpy as np
from ns_abstract.arithmetic.forms import settle
settle(np.zeros((4, 3)), 0, 1, 1)
print(sum(settle.stats.cache_hits.values()), sum(settle.stats.cache_misses.values()))
"""


def test_other_module_changed(tmp_path: Path) -> None:
    """Kernels of one module are compiled again where another one, whose constants they hold, has changed."""
    package = tmp_path / "ns_abstract"
    shutil.copytree(Path(next(iter(ns_abstract.__path__))), package, ignore=shutil.ignore_patterns("__pycache__"))
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA")} | {"PYTHONPATH": str(tmp_path)}

    def run() -> str:
        command = [sys.executable, "-c", PROGRAM]
        return subprocess.run(
            command, env=environment, cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout.strip()

    assert run() == "0 1"
    assert run() == "1 0"
    units = package / "arithmetic" / "units.py"
    units.write_text(units.read_text(encoding="utf-8") + "\n# another version\n", encoding="utf-8")
    assert run() == "0 1"
    assert run() == "1 0"
