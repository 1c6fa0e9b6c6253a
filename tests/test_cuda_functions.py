"""``benchmarks/cuda_functions.py``: functions of the CPU stand in for a GPU's, and charges are the package's."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from benchmark_scripts import BENCHMARKS, script

from ns_abstract.arithmetic.rounding import FLOAT32, UNIT32, charges
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.load import scene_from_parameters

compiled = pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed: the host's build needs it")


@pytest.fixture(scope="module")
def program() -> ModuleType:
    return script("cuda_functions")


@pytest.fixture(scope="module")
def binary(program: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return program.build("cpu", tmp_path_factory.mktemp("cuda_functions"))


def run(program: ModuleType, binary: Path, folder: Path, *more: str) -> tuple[int, list[dict[str, Any]]]:
    status = program.main(
        ["--device", "cpu", "--binary", str(binary), "--sample", "100000", "--output-dir", str(folder), *more]
    )
    return status, json.loads((folder / "cuda_functions.json").read_text(encoding="utf-8"))["rows"]


def test_charges_are_those_of_the_package(program: ModuleType) -> None:
    charged, c = program.CHARGES, charges(FLOAT32)
    assert charged["exp"] == FLOAT32.fast_exp and charged["exp_slope"] == FLOAT32.fast_exp_per_unit_argument
    assert charged["torch_exp"] == FLOAT32.exp and charged["division"] == FLOAT32.division
    assert charged["sqrt"] == FLOAT32.sqrt and charged["rsqrt"] == FLOAT32.rsqrt
    assert charged["flush"] * program.TINY <= FLOAT32.flush and program.UNIT == UNIT32
    assert charged["rotation"] * UNIT32 == c.rotation_entry and charged["sigmoid"] * UNIT32 == c.opacity
    assert charged["sigmoid_color"] * UNIT32 == c.plain_color and charged["position"] * UNIT32 == c.camera_position
    assert charged["direction"] * UNIT32 <= c.direction and charged["translation"] * UNIT32 <= c.camera_coordinate


@pytest.mark.parametrize("factor", [0.999, 1.001])
def test_the_least_quaternion_is_the_loaders(program: ModuleType, factor: float) -> None:
    one = np.zeros((1, 3), np.float32)
    quats = np.array([[(factor * program.LEAST_SQUARED) ** 0.5, 0.0, 0.0, 0.0]], np.float32)
    parameters = {
        "means": one, "scales": one, "quats": quats, "features_dc": one,
        "features_rest": np.zeros((1, 0, 3), np.float32), "opacities": one[:, :1],
    }  # fmt: skip

    def load() -> None:
        scene_from_parameters(
            parameters, source="here", name="one", color_model="sh", sh_degree=0, rasterize_mode="classic",
            background=one[0],
        )  # fmt: skip

    if factor > 1.0:
        load()
    else:
        with pytest.raises(InputError):
            load()


@pytest.mark.slow
@compiled
def test_exact_functions_are_within_their_charges(program: ModuleType, binary: Path, tmp_path: Path) -> None:
    status, rows = run(program, binary, tmp_path)
    assert status == 0 and not [row for row in rows if row["verdict"] == "EXCEEDED"]
    functions = {row["function"] for row in rows}
    assert len(functions) == 15 and all(row["inputs"] > 0 for row in rows)
    # what is rounded once errs by at most a unit, and nearly does
    for row in rows:
        if row["function"] in ("sqrtf(x)", "rsqrtf(x)") and row["range"] == "x normal":
            assert 0.9 < row["error"] <= 1.0 and 0.45 < row["ulps"] <= 0.5
    assert "| sqrtf(x) |" in (tmp_path / "cuda_functions.md").read_text(encoding="utf-8")


@pytest.mark.slow
@compiled
def test_planted_charges_are_exceeded(program: ModuleType, binary: Path, tmp_path: Path) -> None:
    status, rows = run(program, binary, tmp_path, "--planted", "256")
    assert status == 1
    within = [(row["function"], row["range"]) for row in rows if row["verdict"] == "within"]
    # PyTorch does not flush, and what it rounds is far below 2^-126
    assert within == [("torch.exp", "result below 2^-126")]
    assert sum(row["verdict"] == "EXCEEDED" for row in rows) > 25


@pytest.mark.slow
@compiled
def test_one_wrong_result_is_found(program: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One input in some hundred thousand: no number in one build, off by eight ulps in the other."""
    text = (BENCHMARKS / "cuda_functions.cu").read_text(encoding="utf-8")
    right = "{ return static_cast<float>(std::exp(static_cast<double>(x))); }"
    for wrong in ("NAN", "std::exp(x) * (1.f + 0x1p-20f)"):
        changed = tmp_path / "changed.cu"
        planted = f"{{ return x > -1.00001f && x < -0.9999f ? {wrong} : std::exp(x); }}"
        assert right in text
        changed.write_text(text.replace(right, planted), encoding="utf-8")
        monkeypatch.setattr(program, "SOURCE", changed)
        rows = list(program.kernel_rows(program.build("cpu", tmp_path), program.CHARGES, 400_000, 0.0, False))
        row = next(row for row in rows if row.get("function") == "__expf(x)")
        assert program.verdict(row) == "EXCEEDED"
        assert -1.00001 < float(row["error_at"]) < -0.9999 and row["inputs"] > 90_000


def test_what_is_no_number_is_the_largest_error(program: ModuleType) -> None:
    found = program.Range("f", "all", "2^-24", 4.0)
    found.add(program.torch.tensor([0.5, float("nan"), 0.25]), str)
    found.add(program.torch.tensor([1.5]), str)
    row = found.row()
    assert program.verdict(row) == "EXCEEDED" and row["inputs"] == 4


def test_without_a_device_one_line_says_so(
    program: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program.torch.cuda, "is_available", lambda: False)
    assert program.main(["--output-dir", str(tmp_path)]) == 2
    captured = capsys.readouterr()
    assert captured.err == "error: no CUDA GPU is available; nothing was measured\n" and not captured.out


def test_a_missing_compiler_is_said(program: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(program.Unavailable, match="nvcc cannot be run"):
        program.build("cuda", tmp_path)
