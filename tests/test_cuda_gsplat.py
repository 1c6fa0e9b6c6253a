"""The comparison with CUDA gsplat, with another renderer in its place: what is prepared, read back, compared, found."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benchmark_scripts import script
from conftest import blob_scene

from ns_abstract.arithmetic.rounding import FLOAT32
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.perturbation.specification import parse_perturbation

SIZE = 12
SHIFT = 0.02


@pytest.fixture(scope="module")
def cuda() -> Any:
    # it is asked for on the way, when the folder is no longer looked in
    script("both_ways")
    return script("cuda_gsplat")


class ByReference:
    """The package's reference in float32, in the place of gsplat."""

    def __init__(self, header: dict[str, Any], arrays: dict[str, np.ndarray], mode: str, device: str) -> None:
        scene = SplatScene(**arrays, **header, rasterize_mode=mode)  # pyright: ignore[reportArgumentType]
        self.reference, self.device = Reference(scene, GSPLAT_1_4_0, torch.float32), device

    def images(self, camera: dict[str, Any], poses: np.ndarray) -> tuple[torch.Tensor, None]:
        seen = PinholeCamera(np.array(camera["camera_to_world"]), *(camera[name] for name in list(camera)[:6]))
        with torch.no_grad():
            return torch.stack([self.reference.image(seen, torch.from_numpy(pose)) for pose in poses]), None


class NotNumbers(ByReference):
    def images(self, camera: dict[str, Any], poses: np.ndarray) -> tuple[torch.Tensor, None]:
        found, _ = super().images(camera, poses)
        found[:, 3, 4, 1] = math.nan
        return found, None


class Layered(ByReference):
    """Nothing is drawn, at a depth of 7."""

    def images(self, camera: dict[str, Any], poses: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        found, _ = super().images(camera, poses)
        layers = torch.zeros(len(poses), SIZE, SIZE, 2)
        layers[..., 1] = 7.0
        return found, layers


class Stopped(ByReference):
    def images(self, camera: dict[str, Any], poses: np.ndarray) -> tuple[torch.Tensor, None]:
        raise RuntimeError("CUDA error: an illegal memory access was encountered")


def prepared(cuda: Any, folder: Path, planted: bool = False, layers: bool = False) -> Path:
    """A file of two cells of a scene with opaque blobs: one pose, and all of the set."""
    scene = blob_scene(12)
    scene = replace(scene, opacity_logits=np.full(12, 9.0, np.float32), name="blobs")
    pose = np.asarray(look_at((1.6, 0.3, 0.4), (0.0, 0.0, 0.0)))[:3]
    camera = PinholeCamera(pose, 12.0, 12.0, SIZE / 2, SIZE / 2, SIZE, SIZE)
    poses = PoseBox.around(camera, parse_perturbation({"translation": {"x": SHIFT}}))
    rules = replace(GSPLAT_1_4_0, alpha_max=0.98) if planted else GSPLAT_1_4_0
    bounds = SplatBounds(activate(scene, rules), rules, FLOAT32)
    found = cuda.start(cuda.save_scene(folder, "blobs", scene), scene, rules, planted, stiff=False)
    number = cuda.add_set(found, "x", poses)
    for cell, width in ((poses.box.replace(0, 0.0, 0.0), 0.0), (poses.box, 1.0)):
        cuda.add_cell(found, bounds, poses, number, cell, width, 4, layers, np.random.default_rng(0))
    found.save(folder / "cells-1.4.0-blobs.npz")
    return folder


@pytest.mark.slow
def test_nothing_is_outside(cuda: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    every = cuda.compare(prepared(cuda, tmp_path), "1.4.0", 1.0, ByReference, "cpu")
    (cells,) = every
    assert not cuda.failed(cells) and cells.tally.error is None
    row = cells.row()
    # of the cell of one pose one render, and four of the other, besides those of the search
    assert row["cells"] == 2 and row["renders"] == 5 + row["searched"] and row["searched"] >= cuda.AT_ONCE
    assert row["comparisons"] == row["renders"] * SIZE * SIZE * 3
    assert row["outside"] == 0 and row["excess"] == 0.0 and 0.0 < row["gap"] < 1e-3
    # a render took part of what one pose is charged for, and more of it would not be sound
    assert 0.0 < row["used"] < 1.0 and 0.0 < row["used elsewhere"] < 1.0
    cuda.report(every, {"GPU": "none", "gsplat": "1.4.0"}, tmp_path / "out")
    assert "| blobs | classic | 2 |" in capsys.readouterr().out
    written = json.loads((tmp_path / "out" / "cuda-1.4.0.json").read_text())
    assert written["files"][0]["file"] == "cells-1.4.0-blobs" and written["about"]["gsplat"] == "1.4.0"


def test_searched_poses_are_those_of_the_cell(cuda: Any, tmp_path: Path) -> None:
    (cells,) = cuda.compare(prepared(cuda, tmp_path), "1.4.0", 0.0, ByReference, "cpu")
    assert cells.tally.searched == 0
    rendered: list[np.ndarray] = []
    images = cells.renderer.images
    cells.renderer.images = lambda camera, poses: (rendered.append(poses), images(camera, poses))[1]
    (poses,) = cuda.sets_of_poses(cells.header)
    for _ in range(3):
        cells.search(1, poses, np.random.default_rng(1))
    start = np.array(cells.header["sets"][0]["camera"]["camera_to_world"])
    moved = np.concatenate(rendered).astype(np.float64) - start
    assert np.abs(moved[..., :3]).max() < 1e-6
    assert 0.9 * SHIFT < np.linalg.norm(moved[..., 3], axis=1).max() <= SHIFT + 1e-6
    used = [share for share, _ in cells.kept[1]]
    assert len(used) == cuda.KEPT and used == sorted(used, reverse=True)


def test_a_planted_fault_is_found(cuda: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (cells,) = cuda.compare(prepared(cuda, tmp_path, planted=True), "1.4.0", 0.0, ByReference, "cpu")
    assert cells.tally.outside > 0 and cells.tally.excess > 1e-3 and not cuda.failed(cells)
    worst = cells.tally.worst
    distance = max(worst["lower"] - worst["value"], worst["value"] - worst["upper"])
    assert distance == pytest.approx(cells.tally.excess) and np.shape(worst["pose"]) == (3, 4)
    # the same numbers without the word that they are wrong are a failure
    cells.header["planted"] = False
    assert cuda.failed(cells)
    cuda.report([cells], {"gsplat": "1.4.0"}, tmp_path / "out")
    assert "FAILED cells-1.4.0-blobs: {" in capsys.readouterr().out
    # and so is a planted fault that is not there
    (sound,) = cuda.compare(prepared(cuda, tmp_path / "sound"), "1.4.0", 0.0, ByReference, "cpu")
    sound.header["planted"] = True
    assert cuda.failed(sound)


def test_what_is_not_a_number_is_outside(cuda: Any, tmp_path: Path) -> None:
    (cells,) = cuda.compare(prepared(cuda, tmp_path), "1.4.0", 0.0, NotNumbers, "cpu")
    assert cells.tally.outside == cells.tally.renders == 5 and cells.tally.excess == math.inf
    assert cells.tally.worst["pixel"] == [3, 4, 1] and cuda.failed(cells)


def test_layers(cuda: Any, tmp_path: Path) -> None:
    folder = prepared(cuda, tmp_path, layers=True)
    (cells,) = cuda.compare(folder, "1.4.0", 0.0, Layered, "cpu")
    # accumulation everywhere, depth nowhere
    assert cells.tally.comparisons == 5 * SIZE * SIZE * (3 + 1) and cells.tally.outside > 0
    assert cells.tally.worst["of"] == "layer" and cells.tally.worst["pixel"][2] == 0
    # the depth of a pixel that no pose draws has no bounds
    assert np.any(cells.layers[0].numpy() > cells.layers[1].numpy()) and 0.0 < cells.tally.used < 1.0


def test_what_stops_a_file_is_said(cuda: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (cells,) = cuda.compare(prepared(cuda, tmp_path), "1.4.0", 1.0, Stopped, "cpu")
    assert cuda.failed(cells) and "illegal memory access" in cells.tally.error
    assert capsys.readouterr().err.count("Traceback") == 1


def test_without_a_gpu(
    cuda: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert cuda.compare_command(argparse.Namespace(cells=tmp_path)) == 2
    assert "no CUDA GPU" in capsys.readouterr().err
