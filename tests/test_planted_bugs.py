"""The list of planted bugs stays usable: every change applies, and the kernels also run interpreted."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MUTANTS = ROOT / "benchmarks" / "mutants.py"


@pytest.mark.skipif(not MUTANTS.exists(), reason="the benchmarks are not beside the tests")
def test_every_change_applies() -> None:
    command = [sys.executable, MUTANTS, "--list"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def test_kernels_run_interpreted() -> None:
    tests = [f"{ROOT / 'tests' / 'test_bounds.py'}::{name}" for name in ("test_near_plane_alone", "test_ties")]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests],
        check=False,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )
    assert done.returncode == 0, done.stdout[-3000:]
