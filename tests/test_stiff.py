"""Stiff and extreme cases at their smallest, and proof that a wrong bound does not pass them."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ns_abstract.arithmetic.rounding import Arithmetic
from ns_abstract.bench import stiff
from ns_abstract.bench.stiff import ARITHMETICS, WatchedFrame, run_case
from ns_abstract.bench.stiff_cases import Case, all_cases
from ns_abstract.cli.bench import bench
from ns_abstract.cli.bench_options import Stiff
from ns_abstract.cli.common import DONE
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.bounds import CellBounds, SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0, Rasteriser
from ns_abstract.verify.attack.soundness import compiled_renderer

torch.set_num_threads(1)
CASES = all_cases()
SMALL: dict[str, Any] = {"cells": 2, "seconds": 10.0, "poses": 5, "reference_poses": 2}


def case_of(name: str) -> Case:
    return next(case for case in CASES if case.name == name)


@pytest.mark.slow_cases(every=60)
@pytest.mark.parametrize("arithmetic", ARITHMETICS)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name.replace(" ", "-"))
def test_case(case: Case, arithmetic: str) -> None:
    outcome = run_case(case, arithmetic, **SMALL)
    assert outcome.row["comparisons"] > 0 and outcome.row["cells"] > 0
    assert (outcome.row["violations"], outcome.row["NaN/inf"]) == (0, 0), outcome.worst[:2]
    assert outcome.row["MPG"] >= outcome.row["witness MPG"] >= 0.0


def test_cases_are_what_they_say() -> None:
    assert len({case.name for case in CASES}) == len(CASES) >= 30
    normal = np.finfo(np.float32)
    for case in CASES:
        scene = case.scene
        assert 1 <= scene.count <= 1000 and max(case.camera.width, case.camera.height) <= 48
        for name in ("means", "log_scales", "quats", "opacity_logits", "sh"):
            assert np.isfinite(getattr(scene, name)).all(), case.name
        # what a run or ply may hold
        scales, quats = np.exp(scene.log_scales.astype(np.float64)), scene.quats.astype(np.float64)
        for size in (scales, np.sum(quats * quats, axis=1)):
            assert (size > normal.tiny).all() and (size < normal.max).all(), case.name


def poses_of(case: Case, count: int = 5) -> tuple[Callable[[np.ndarray], np.ndarray], list[np.ndarray]]:
    pose_set = case.pose_set()
    render, _ = compiled_renderer(case.scene, pose_set, GSPLAT_1_4_0)
    return render, [pose_set.box.middle, *pose_set.box.sample(count, np.random.default_rng(0))]


def test_pictures_are_not_blank() -> None:
    for case in CASES:
        render, poses = poses_of(case)
        shown = max(float(np.abs(render(values) - case.scene.background).max()) for values in poses)
        assert (shown == 0.0) == case.blank, case.name


@pytest.mark.parametrize(
    ("name", "step"),
    [("tile border inside the set", 1e-9), ("near plane", 1e-9), ("near plane antialiased", 1e-9), ("far plane", 1e3)],
)
def test_jumps(name: str, step: float) -> None:
    """The picture jumps where the case says, in the middle of its set."""
    render, (middle, *_) = poses_of(case_of(name))
    assert np.abs(render(middle + step) - render(middle - step)).max() > 0.01


class Low(WatchedFrame):
    """One pixel's bounds of every cell are too low by 1e-3."""

    def __init__(self, splats: Splats, rasteriser: Rasteriser, arithmetic: Arithmetic, pose_set: PoseBox) -> None:
        super().__init__(splats, rasteriser, arithmetic, pose_set)
        honest = self.bounds.cell

        def cell(*arguments: Any, **named: Any) -> CellBounds:
            found = honest(*arguments, **named)
            self.alter(found)
            return found

        self.bounds.cell = cell  # type: ignore[method-assign]

    def alter(self, found: CellBounds) -> None:
        found.lower[0, 9, 10] -= 1e-3
        found.upper[0, 9, 10] -= 1e-3


class Crossed(Low):
    """One pixel's bounds contradict each other; refinement takes them as [0, 1], which no image leaves."""

    def alter(self, found: CellBounds) -> None:
        found.lower[0, 9, 10] = found.upper[0, 9, 10] + 1e-6


class Undefined(Low):
    """One bound is not a number; refinement takes it as [0, 1] as well."""

    def alter(self, found: CellBounds) -> None:
        found.lower[0, 2, 3, 1] = np.nan


class Forgetful(WatchedFrame):
    """The bounds do not know of the last Gaussian; renders do."""

    def __init__(self, splats: Splats, rasteriser: Rasteriser, arithmetic: Arithmetic, pose_set: PoseBox) -> None:
        super().__init__(splats, rasteriser, arithmetic, pose_set)
        rest = {name: getattr(splats, name)[:-1] for name in ("means", "axes", "opacity", "sh")}
        self.bounds = SplatBounds(replace(splats, **rest), rasteriser, arithmetic)


@pytest.mark.slow_cases
@pytest.mark.parametrize("arithmetic", ARITHMETICS)
@pytest.mark.parametrize("name", ["one pose", "one ulp", "width 1e-9"])
def test_low_bounds_fail(name: str, arithmetic: str) -> None:
    assert not run_case(case_of(name), arithmetic, **SMALL).failed
    outcome = run_case(case_of(name), arithmetic, **SMALL, frame=Low)
    assert outcome.failed
    assert {(v.row, v.column) for v in outcome.worst} == {(9, 10)}
    assert 0.8e-3 < outcome.row["worst"] < 1.01e-3


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize("arithmetic", ARITHMETICS)
@pytest.mark.parametrize("name", ["depth ties", "six parameters", "needles", "harmonics 1e3", "screen-filling"])
def test_forgotten_gaussian_fails(name: str, arithmetic: str) -> None:
    outcome = run_case(case_of(name), arithmetic, **SMALL, frame=Forgetful)
    assert outcome.row["violations"] > 0 and outcome.failed


def test_hidden_bounds_fail() -> None:
    outcome = run_case(case_of("one pose"), "real", **SMALL, frame=Undefined)
    assert outcome.failed and (outcome.row["NaN/inf"], outcome.row["violations"]) == (1, 0)
    outcome = run_case(case_of("one pose"), "real", **SMALL, frame=Crossed)
    assert outcome.failed and (outcome.row["NaN/inf"], outcome.row["violations"]) == (0, 3)


def options(folder: Path, *cases: str, **changes: Any) -> Stiff:
    return Stiff(output_dir=folder, cases=cases, **(SMALL | changes))


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench(options(tmp_path, "one pose", "opacity 0", compare=True)) == DONE
    shown = capsys.readouterr().out
    assert "0 violations" in shown and "one pose, moved" in shown
    with open(tmp_path / "stiff.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    names = [case.name for case in CASES if "one pose" in case.name or "opacity 0" in case.name]
    assert [(row["case"], row["arithmetic"]) for row in rows] == [(n, a) for n in names for a in ARITHMETICS]
    assert len(names) >= 3 and all(row["violations"] == row["NaN/inf"] == "0" for row in rows)
    assert "| opacity 0 |" in (tmp_path / "stiff.md").read_text()
    with open(tmp_path / "stiff-compare.csv", newline="") as stream:
        pairs = list(csv.DictReader(stream))
    # float32's rounding is charged on top of float64's
    assert len(pairs) == len(names) and all(float(pair["float32 - real"]) > 0.0 for pair in pairs)


@pytest.mark.parametrize("frame", [Low, Undefined])
def test_command_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], frame: type[WatchedFrame]
) -> None:
    monkeypatch.setattr(stiff, "run_case", partial(run_case, frame=frame))
    assert bench(options(tmp_path, "one pose", arithmetics=("real",))) == 1
    assert " failed" in capsys.readouterr().out and "one pose" in (tmp_path / "stiff.csv").read_text()


def test_unknown_case(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no case"):
        bench(options(tmp_path, "no such thing"))
    assert not list(tmp_path.iterdir())
