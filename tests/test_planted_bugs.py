"""The list of planted bugs stays usable: every change applies, the table is whole, and kernels also run interpreted."""

from __future__ import annotations

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from benchmark_scripts import script

ROOT = Path(__file__).resolve().parents[1]
mutants = script("mutants")


@pytest.mark.slow
def test_every_change_applies() -> None:
    """In the file that is named, each on its own, and to something else than what stands there."""
    for fault in mutants.FAULTS:
        text = (ROOT / "ns_abstract" / fault.file).read_text(encoding="utf-8")
        assert mutants.apply(text, fault) != text, fault.name
    assert len({fault.name for fault in mutants.FAULTS}) == len(mutants.FAULTS)


def test_the_tests_exist() -> None:
    for fault in mutants.FAULTS:
        file, _, rest = fault.test.partition("::")
        text = (ROOT / "tests" / file).read_text(encoding="utf-8")
        for name in rest.partition("[")[0].split("::"):
            assert re.search(rf"(def|class) {name}\b", text), fault.test


def test_table_has_every_fault() -> None:
    text = mutants.REPORT.read_text(encoding="utf-8")
    outcomes = mutants.read_outcomes(text)
    assert mutants.table(outcomes) == text, "out of date: python benchmarks/mutants.py --table"
    assert {one.verdict for one in outcomes.values()} == {"killed"}
    # what was changed since it was run is told apart
    fault = mutants.FAULTS[0]
    changed = dataclasses.replace(fault, new=fault.new + " ")
    assert mutants.digest(fault) in outcomes and mutants.digest(changed) not in outcomes


@pytest.mark.slow
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
