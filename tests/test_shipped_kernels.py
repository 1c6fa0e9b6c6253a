"""Kernels that an installation brings are loaded on processors of their level, for these sources alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import ns_abstract
from ns_abstract.arithmetic import shipped_kernels
from ns_abstract.arithmetic.shipped_kernels import LEVELS, SHIPPED, runs, shipped_folder

PROGRAM = """
import hashlib
import numpy as np
from ns_abstract.arithmetic.forms import set_norms
values = np.random.default_rng(0).normal(size=(4, 3))
set_norms(values, 0, 1, 1)
print(sum(set_norms.stats.cache_hits.values()), hashlib.sha256(values.tobytes()).hexdigest())
"""
KEY = "0" * 64


def features(names: frozenset[str]) -> str:
    return ",".join([*(f"+{name}" for name in names), "-amx-tile"])


@pytest.fixture
def package(tmp_path: Path) -> Path:
    for level in LEVELS:
        (tmp_path / SHIPPED / level / KEY[:32]).mkdir(parents=True)
    return tmp_path


@pytest.mark.parametrize(
    ("has", "level"),
    [
        (LEVELS["x86-64-v4"], "x86-64-v4"),
        (LEVELS["x86-64-v4"] - {"avx512vl"}, "x86-64-v3"),
        (LEVELS["x86-64-v3"] | {"avx512f"}, "x86-64-v3"),
        (LEVELS["x86-64-v3"] - {"fma"}, None),
        (frozenset(), None),
    ],
)
def test_highest_level_that_the_processor_has(
    package: Path, monkeypatch: pytest.MonkeyPatch, has: frozenset[str], level: str | None
) -> None:
    monkeypatch.setattr(shipped_kernels, "get_host_cpu_features", lambda: features(has))
    folder = shipped_folder(package, KEY)
    assert folder == (None if level is None else package / SHIPPED / level / KEY[:32])
    # of other sources
    assert shipped_folder(package, "1" * 64) is None


def test_who_says_what_to_compile_for_gets_it(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shipped_kernels, "get_host_cpu_features", lambda: features(LEVELS["x86-64-v4"]))
    monkeypatch.setattr(shipped_kernels.settings, "CPU_NAME", "generic")
    assert shipped_folder(package, KEY) is None


def run(package: Path, folder: Path, **changes: str) -> tuple[str, str]:
    """How many kernels were loaded by the package's copy, and the hash of what they computed."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "NS_ABSTRACT", "XDG"))}
    environment = kept | {"PYTHONPATH": str(package.parent), "NS_ABSTRACT_CACHE_DIR": str(folder)} | changes
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, cwd="/", check=True, capture_output=True, text=True
    )
    loaded, digest = done.stdout.split()
    return loaded, digest


@pytest.mark.slow
@pytest.mark.skipif(not runs("x86-64-v3"), reason="this processor has no x86-64-v3")
def test_kernels_of_a_level_are_loaded(tmp_path: Path) -> None:
    """They give the same numbers; what is damaged, and sources that have changed, are compiled."""
    package = tmp_path / "ns_abstract"
    ignored = shutil.ignore_patterns("__pycache__", SHIPPED)
    shutil.copytree(Path(next(iter(ns_abstract.__path__))), package, ignore=ignored)
    level = {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""}
    loaded, digest = run(package, tmp_path / "built", **level)
    assert loaded == "0"
    shutil.copytree(tmp_path / "built", package / SHIPPED / "x86-64-v3")
    before = {file: file.read_bytes() for file in (package / SHIPPED).rglob("*") if file.is_file()}
    for again in range(2):
        assert run(package, tmp_path / "empty") == ("1", digest), again
    # nothing of another processor
    assert run(package, tmp_path / "other", NUMBA_CPU_NAME="generic") == ("0", digest)
    blobs = [file for file in before if file.parent.name == "blobs"]
    for blob in blobs:
        blob.write_bytes(b"damaged")
    assert run(package, tmp_path / "damaged") == ("0", digest)
    assert {file.read_bytes() for file in blobs} == {b"damaged"}
    for file, content in before.items():
        file.write_bytes(content)
    assert run(package, tmp_path / "mended") == ("1", digest)
    units = package / "arithmetic" / "rounding.py"
    units.write_text(units.read_text(encoding="utf-8") + "\n# another version\n", encoding="utf-8")
    assert run(package, tmp_path / "changed") == ("0", digest)
