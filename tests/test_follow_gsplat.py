"""The script that follows gsplat notices what pictures depend on, and nothing else."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from benchmark_scripts import script
from gsplat_kernels import Unavailable, sources


@pytest.fixture
def trees(tmp_path: Path) -> tuple[Path, Path]:
    """Sources of gsplat 1.4.0 and a copy."""
    try:
        old = sources("1.4.0")
    except Unavailable as reason:
        pytest.skip(str(reason))
    new = tmp_path / "gsplat"
    for folder in ("cuda/csrc", "cuda/include"):
        if (old / folder).is_dir():
            shutil.copytree(old / folder, new / folder, ignore=shutil.ignore_patterns("third_party"))
    for file in ("rendering.py", "cuda/_wrapper.py"):
        shutil.copy(old / file, new / file)
    return old, new


def edit(file: Path, change: Callable[[str], str]) -> None:
    text = file.read_text()
    assert change(text) != text
    file.write_text(change(text))


RASTER, RENDERING = "cuda/csrc/rasterize_to_pixels_fwd.cu", "rendering.py"
CHANGES: dict[str, tuple[str, Callable[[str], str], int]] = {
    "a comment": (RASTER, lambda t: t.replace("{", "{ // a remark\n", 20), 0),
    "line breaks": (RASTER, lambda t: t.replace(";\n", ";\n\n    "), 0),
    "another kernel": (RASTER, lambda t: t + "\nint other(int a) { return a; }\n", 0),
    "the largest alpha": (RASTER, lambda t: t.replace("0.999f", "0.99f"), 1),
    "a kernel is gone": (RASTER, lambda t: t.replace("rasterize_to_pixels_fwd_kernel", "another_kernel"), 1),
    "a default": (RENDERING, lambda t: t.replace("near_plane: float = 0.01", "near_plane: float = 0.02"), 1),
    "a docstring": (RENDERING, lambda t: t.replace('"""Rasterize', '"""Now rasterize', 1), 0),
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", CHANGES)
def test_changes_are_noticed(name: str, trees: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    follow = script("follow_gsplat")
    file, change, expected = CHANGES[name]
    edit(trees[1] / file, change)
    assert follow.report(*trees, "1.4.0") == expected
    said = capsys.readouterr().out
    assert "absent" not in said and said.count("same ") == 16 - expected
    assert ("gone" in said) == ("gone" in name) and ("0.99f" in said) == ("alpha" in name)
