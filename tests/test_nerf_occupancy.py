"""Declared occupancy grids: voxels of boxes, attacked bounds, planted faults, work that is left out, files."""

from __future__ import annotations

import dataclasses
import json
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfs import UNIFORM, images, pixels_of, poses, tiny_scene, view

from ns_abstract.cli import export as export_command
from ns_abstract.cli import render as render_command
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, path_json
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.bounds import NerfBounds
from ns_abstract.methods.nerf.occupancy import OccupancyGrid, load_grid
from ns_abstract.methods.nerf.ray_bundle import RayBundle
from ns_abstract.methods.nerf.ray_field import RayBounds
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import nerf_renderer

SETS = {
    "yaw": {"rotation": {"yaw": 0.005}},
    "shift": {"translation": {"x": 0.005}},
    "orbit": {"orbit": {"target": [0, 0, 0], "axis": [0, 0.1, 1], "azimuth": [0.3, 0.31]}},
    "two": {"rotation": {"yaw": 0.0005}, "translation": {"x": 0.0005}},
}


def checkered(share: float = 0.4, resolution: int = 7, seed: int = 0) -> OccupancyGrid:
    """Random voxels of a box about the origin whose sizes are no binary fractions."""
    occupied = np.random.default_rng(seed).random((resolution, resolution + 1, resolution + 2)) < share
    return OccupancyGrid.of_box(np.array([-0.83, -0.9, -0.71]), np.array([0.79, 0.88, 0.93]), occupied)


def declared(scene: NerfScene, grid: OccupancyGrid | None) -> NerfScene:
    return dataclasses.replace(scene, occupancy=grid)


def exactly(grid: OccupancyGrid, point: np.ndarray) -> bool:
    """Whether a point lies in an occupied voxel, in rational arithmetic."""
    index = [
        (Fraction(float(x)) - Fraction(float(low))) * Fraction(float(scale))
        for x, low, scale in zip(point, grid.lower, grid.scale, strict=True)
    ]
    voxel = [number.numerator // number.denominator for number in index]
    inside = all(0 <= v < n for v, n in zip(voxel, grid.occupied.shape, strict=True))
    return inside and bool(grid.occupied[tuple(voxel)])


def test_boxes_of_points_are_enclosed() -> None:
    random = np.random.default_rng(1)
    told = [0, 0]
    for seed, share in ((0, 0.05), (1, 0.9), (2, 0.5)):
        grid = checkered(share, 5, seed)
        middle = random.uniform(-1.2, 1.2, (400, 3))
        # ends on borders of voxels, as far as they are numbers
        border = grid.lower + np.round((middle - grid.lower) * grid.scale) / grid.scale
        half = 10.0 ** random.uniform(-17, -0.5, (400, 3)) * (random.random((400, 3)) < 0.9)
        low, high = np.where(random.random((400, 3)) < 0.5, border, middle - half), middle + half
        low, high = np.minimum(low, high), np.maximum(low, high)
        empty, sure = grid.look(low, high)
        assert not (empty & sure).any()
        told[0] += int(empty.sum())
        told[1] += int(sure.sum())
        for k in range(400):
            at = np.concatenate([[low[k], high[k]], random.uniform(low[k], high[k], (6, 3))])
            float64 = grid.at(torch.from_numpy(at)).numpy()
            real = np.array([exactly(grid, point) for point in at])
            for found in (float64, real):
                assert not (empty[k] and found.any()) and not (sure[k] and not found.all())
    assert min(told) > 50, "nothing was told"


def test_extreme_boxes_tell_nothing_wrong() -> None:
    grid = checkered()
    bad = [np.nan, np.inf, -np.inf, 1e300, -1e300]
    for value in bad:
        low, high = np.full((1, 3), -np.inf), np.full((1, 3), value)
        if not value < grid.lower[0]:
            empty, sure = grid.look(low, high)
            assert not empty[0] and not sure[0]
        assert not grid.at(torch.full((1, 3), value, dtype=torch.float64))[0]
    empty, sure = grid.look(np.full((1, 3), 50.0), np.full((1, 3), 51.0))
    assert empty[0] and not sure[0]


def test_ranges_of_points_are_enclosed_and_tight() -> None:
    pose_set = poses(SETS["two"])
    bundle = RayBundle(pose_set, pose_set.box, pixels_of(pose_set.camera), 4)
    ray, distance = np.repeat(np.arange(12), 3), np.tile([0.3, 1.5, 3.9], 12)
    lines, radius = bundle.points(ray, distance, 0.0 * distance)
    low, high = np.array([[-0.5, 0.25]]).repeat(36, 0), np.array([[0.0, 1.0]]).repeat(36, 0)
    bottom, top = bundle.ranges(lines, radius, low, high)
    assert (top - bottom).max() < 0.02
    directions = np.stack([[(x + 0.5 - 2.0) / 5.0, -(y + 0.5 - 1.5) / 5.0, -1.0] for y in range(3) for x in range(4)])
    for values in np.random.default_rng(0).uniform(low[0], high[0], (200, 2)):
        pose = pose_set.pose(pose_set.box.at(values))
        world = directions @ pose[:, :3].T
        points = pose[:, 3] + distance[:, None] * (world / np.linalg.norm(world, axis=1, keepdims=True))[ray]
        assert ((bottom <= points) & (points <= top)).all()


def bounded(scene: NerfScene, pose_set: PoseBox) -> RayBounds:
    return NerfBounds(scene, UNIFORM, pose_set.box.dimensions).rays(
        pose_set, pose_set.box, pixels_of(pose_set.camera), 0.02
    )


def violations(scene: NerfScene, pose_set: PoseBox, found: RayBounds) -> int:
    shape = (pose_set.camera.height, pose_set.camera.width, 3)
    render, probe, twin = nerf_renderer(scene, pose_set, UNIFORM)
    result = falsify(
        found.lower.reshape(shape), found.upper.reshape(shape), pose_set.box, render, twin, probe=probe, poses=80,
        seed=1,
    )  # fmt: skip
    assert result.comparisons > 0
    return result.violations


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_sets_of_poses_are_enclosed(name: str) -> None:
    pose_set = poses(SETS[name])
    seed, density = (1, 1e3) if name == "shift" else (3, 8.0)
    scene = declared(tiny_scene(seed, density=density), checkered(seed=seed))
    found = bounded(scene, pose_set)
    assert (found.upper - found.lower).mean() < 0.6, "nothing was bounded"
    assert violations(scene, pose_set, found) == 0


@pytest.mark.slow
def test_planted_faults_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    pose_set = poses(SETS["shift"])
    # on an edge-on border of voxels that the rays cross while the camera moves
    scene = declared(tiny_scene(1, density=1e3), checkered(0.5, 24, seed=1))
    look = OccupancyGrid.look

    def at_the_middle(grid: OccupancyGrid, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        middle = 0.5 * (low + high)
        return look(grid, middle, middle)

    monkeypatch.setattr(OccupancyGrid, "look", at_the_middle)
    assert violations(scene, pose_set, bounded(scene, pose_set)) > 0
    monkeypatch.undo()
    assert violations(scene, pose_set, bounded(scene, pose_set)) == 0
    # the grid is not the scene without it
    assert violations(declared(scene, None), pose_set, bounded(scene, pose_set)) > 0


def test_what_is_declared_empty_costs_nothing() -> None:
    pose_set = poses(SETS["yaw"])
    scene = tiny_scene(3)
    nothing = declared(scene, checkered(0.0))
    found = bounded(nothing, pose_set)
    assert found.cells == 0
    assert np.allclose(found.lower, UNIFORM.background, atol=1e-9)
    assert np.allclose(found.upper, UNIFORM.background, atol=1e-9)
    assert (images(nothing, pose_set, np.zeros((1, 1)))[0] == np.array(UNIFORM.background)).all()
    everything = OccupancyGrid.of_box(np.full(3, -9.0), np.full(3, 9.0), np.ones((2, 2, 2), bool))
    plain, same = bounded(scene, pose_set), bounded(declared(scene, everything), pose_set)
    assert (plain.lower == same.lower).all() and (plain.upper == same.upper).all() and plain.cells == same.cells
    assert bounded(declared(scene, checkered(0.1)), pose_set).cells < 0.5 * plain.cells


# ---------------------------------------------------------------- files and command lines


def written(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


GOOD = {"occupied": np.ones((2, 3, 4), bool), "aabb": np.array([[-1.0, -1.0, -1.0], [1.0, 2.0, 3.0]])}


def test_a_grid_is_written_and_read(tmp_path: Path) -> None:
    grid = checkered()
    grid.write(tmp_path / "grid.npz")
    read = load_grid(tmp_path / "grid.npz")
    assert (read.occupied == grid.occupied).all() and np.allclose(read.scale, grid.scale, rtol=1e-15)
    assert load_grid(written(tmp_path / "good.npz", **GOOD)).digest != read.digest


@pytest.mark.parametrize(
    ("changes", "fragment"),
    [
        ({"occupied": None}, "occupied"),
        ({"aabb": None}, "aabb"),
        ({"occupied": np.ones((2, 3), bool)}, "occupied"),
        ({"occupied": np.ones((2, 3, 4))}, "occupied"),
        ({"occupied": np.ones((0, 3, 4), bool)}, "occupied"),
        ({"occupied": np.array([[[object()]]])}, "Python objects"),
        ({"aabb": np.zeros((2, 3))}, "aabb"),
        ({"aabb": GOOD["aabb"][::-1]}, "aabb"),
        ({"aabb": np.full((2, 3), np.nan)}, "aabb"),
        ({"aabb": np.array([[-np.inf] * 3, [1.0] * 3])}, "aabb"),
        ({"aabb": np.array([[0.0] * 3, [5e-324] * 3])}, "aabb"),
        ({"aabb": np.array([["a"] * 3, ["b"] * 3])}, "aabb"),
    ],
)
def test_bad_grids_are_one_line(tmp_path: Path, changes: dict[str, Any], fragment: str) -> None:
    arrays = {key: value for key, value in {**GOOD, **changes}.items() if value is not None}
    with pytest.raises(InputError, match=fragment):
        load_grid(written(tmp_path / "grid.npz", **arrays))


def test_files_that_are_no_grids(tmp_path: Path) -> None:
    file = tmp_path / "grid.npz"
    with pytest.raises(InputError, match="no such occupancy grid"):
        load_grid(file)
    file.write_bytes(b"PK\x03\x04 not a zip")
    with pytest.raises(InputError, match="cannot be read"):
        load_grid(file)
    written(file, **GOOD)
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(InputError, match="cannot be read"):
        load_grid(file)


def call(monkeypatch: pytest.MonkeyPatch, main: Any, options: list[Any]) -> int:
    monkeypatch.setattr(sys, "argv", ["command", *map(str, options)])
    with pytest.raises(SystemExit) as leave:
        main()
    assert isinstance(leave.value.code, int)
    return leave.value.code


@pytest.mark.slow
def test_from_the_field_to_the_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    run = write_nerf_run(tiny_scene(3), tmp_path / "runs", timestamp="t", experiment_name="tiny")
    pose = np.eye(4)
    pose[:3] = view().camera_to_world
    path, spec, grid = tmp_path / "path.json", tmp_path / "spec.json", tmp_path / "grid.npz"
    path.write_text(json.dumps(path_json([KeyframeCamera(pose, 40.0, 3, 4)])))
    spec.write_text(json.dumps({"version": 1, "rotation": {"yaw": 0.002}}))
    made = ["occupancy", "--load-config", run, "--output-filename", grid, "--resolution", 16, "--threshold", 1.0]
    assert call(monkeypatch, export_command.main, made) == 0
    found = load_grid(grid)
    assert 0.01 < found.occupied.mean() < 0.99
    options = [
        "--load-config", run, "--camera-path-filename", path, "--perturbation-filename", spec, "--output-dir",
        tmp_path / "out", "--num-samples", 16, "--time-budget", 30, "--target-ratio", 2,
    ]  # fmt: skip
    assert call(monkeypatch, render_command.main, [*options, "--occupancy-grid", grid]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert "16x16x16 voxels" in report["renderer"]["occupancy"]
    assert any("declared 0" in line for line in report["plan"])
    capsys.readouterr()
    # without the grid, or with another, it is another scene
    for more in ([], ["--occupancy-grid", written(tmp_path / "other.npz", **GOOD)]):
        call(monkeypatch, render_command.main, [*options, *more, "--resume"])
        assert "kept from before" not in capsys.readouterr().err
    assert call(monkeypatch, render_command.main, [*options, "--occupancy-grid", path]) == 2
    assert call(monkeypatch, export_command.main, [*made[:-1], 1e9]) == 2


def test_a_grid_is_for_nerfs_alone(blobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    options = blobs.options(tmp_path / "out", occupancy_grid=written(tmp_path / "grid.npz", **GOOD))
    assert call(monkeypatch, render_command.main, options) == 2
    assert "--occupancy-grid" in capsys.readouterr().err
    made = ["occupancy", "--load-config", blobs.config, "--output-filename", tmp_path / "made.npz"]
    assert call(monkeypatch, export_command.main, made) == 2
