"""A path that closes: the leg from its last entry to its first, wherever sets of poses come from."""

from __future__ import annotations

import dataclasses
import json
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from certifying import classifier
from conftest import InProcess, Inputs, blob_scene, ring
from test_poses import escapes, thin_escapes

import ns_abstract as nsa
from ns_abstract.api.files import Settings, open_job
from ns_abstract.api.job import Job
from ns_abstract.cli import certify as certify_command
from ns_abstract.cli import export as export_command
from ns_abstract.cli import render as render_command
from ns_abstract.geometry.camera_path import PinholeCamera, load_camera_path
from ns_abstract.geometry.keyframe_cameras import path_json
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.report.files import load_frame

SEGMENTS = {"version": 1, "sweep": "segments"}
SIZE = 12


def closed(is_cycle: Any = True, count: int = 3, **more: Any) -> dict[str, Any]:
    """A camera path of views on a quarter of a circle."""
    return path_json(ring(count, SIZE)) | {"is_cycle": is_cycle} | more


def read(folder: Path, data: dict[str, Any]) -> nsa.CameraPath:
    (folder / "path.json").write_text(json.dumps(data))
    return load_camera_path(folder / "path.json")


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation, as the eigenvector of Bar-Itzhack's matrix."""
    r = rotation
    matrix = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    return np.linalg.eigh(matrix)[1][:, -1]


def slerp(ends: list[np.ndarray], s: np.ndarray) -> np.ndarray:
    """[n, 3, 3] rotations between two, by Shoemake's formula for quaternions."""
    a, b = quaternion(ends[0]), quaternion(ends[1])
    b = b if a @ b >= 0 else -b
    angle = np.arccos(min(1.0, a @ b))
    w, x, y, z = (np.outer(np.sin((1 - s) * angle), a) + np.outer(np.sin(s * angle), b)).T / np.sin(angle)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def leg(path: nsa.CameraPath, s: np.ndarray) -> list[PinholeCamera]:
    """Cameras on the way from the last entry to the first; quaternions, unlike the package's axis and angle."""
    last, first = path.cameras[-1], path.cameras[0]
    ends = [camera.camera_to_world for camera in (last, first)]
    turns = slerp([end[:, :3] for end in ends], s)
    places = (1.0 - s)[:, None] * ends[0][:, 3] + s[:, None] * ends[1][:, 3]
    poses = np.concatenate([turns, places[:, :, None]], axis=2)
    return [dataclasses.replace(last, camera_to_world=pose) for pose in poses]


@pytest.fixture
def inputs(make_blobs: Any) -> Inputs:
    found = make_blobs(scene=blob_scene(20), views=ring(3, SIZE), spec=SEGMENTS)
    found.path.write_text(json.dumps(closed()))
    return found


# ---------------------------------------------------------------- what follows what


@pytest.mark.parametrize(
    ("is_cycle", "count", "expected"),
    [(True, 3, [1, 2, 0]), (False, 3, [1, 2, None]), (None, 3, [1, 2, None]), (True, 2, [1, 0]), (True, 1, [None])],
)
def test_following(tmp_path: Path, is_cycle: Any, count: int, expected: list[int | None]) -> None:
    path = read(tmp_path, closed(is_cycle, count))
    found = [path.following(k) for k in range(count)]
    assert found == [None if k is None else path.cameras[k] for k in expected]


def test_every_entry_of_a_closed_path_sweeps_its_leg(tmp_path: Path, inputs: Inputs) -> None:
    for is_cycle, expected in ((True, [("segment",)] * 3), (False, [("segment",)] * 2 + [()])):
        inputs.path.write_text(json.dumps(closed(is_cycle)))
        job = open_job(Settings(inputs.config, inputs.path, inputs.spec))
        assert [poses.box.names for poses in job.pose_sets] == expected


def test_keyframes_do_not_move_on_a_closed_path(tmp_path: Path, inputs: Inputs) -> None:
    inputs.spec.write_text(json.dumps({"version": 1, "translation": {"x": 0.1}}))
    job = open_job(Settings(inputs.config, inputs.path, inputs.spec))
    assert [poses.box.names for poses in job.pose_sets] == [("x",)] * 3


def test_an_entry_has_its_own_sweep(tmp_path: Path, inputs: Inputs) -> None:
    data = closed(perturbation={"version": 1})
    data["camera_path"][2]["perturbation"] = SEGMENTS
    inputs.path.write_text(json.dumps(data))
    job = open_job(Settings(inputs.config, inputs.path))
    assert [poses.box.names for poses in job.pose_sets] == [(), (), ("segment",)]
    assert job.pose_sets[2].target_camera is job.path.cameras[0]


def test_the_closing_leg_has_one_field_of_view(tmp_path: Path, inputs: Inputs) -> None:
    data = closed()
    data["camera_path"][0]["fov"] = data["camera_path"][1]["fov"] = 30.0
    data["camera_path"][1]["perturbation"] = {"version": 1}
    inputs.path.write_text(json.dumps(data))
    with pytest.raises(InputError, match="fields of view") as caught:
        open_job(Settings(inputs.config, inputs.path, inputs.spec))
    assert caught.value.file == str(inputs.path)


def test_ends_of_a_leg_have_one_principal_point(tmp_path: Path, inputs: Inputs) -> None:
    """Else the last picture of the leg would be another one than that of its keyframe."""
    data = closed()
    data["camera_path"][1]["cx"] = 3.0
    inputs.path.write_text(json.dumps(data))
    with pytest.raises(InputError, match="principal points"):
        open_job(Settings(inputs.config, inputs.path, inputs.spec))


@pytest.mark.parametrize("noise", [2e-7, 1e-5, 4e-4])
@pytest.mark.parametrize("entry", [0, 1])
def test_ends_of_a_leg_are_the_keyframes(noise: float, entry: int, tmp_path: Path, inputs: Inputs) -> None:
    """A leg leads from one rotation to another, so keyframes that are none are refused, not replaced."""
    data = closed()
    matrix = np.array(data["camera_path"][entry]["camera_to_world"]).reshape(4, 4)
    matrix[:3, :3] += noise * np.random.default_rng(entry).uniform(-1.0, 1.0, (3, 3))
    data["camera_path"][entry]["camera_to_world"] = matrix.ravel().tolist()
    inputs.path.write_text(json.dumps(data))
    if noise > 1e-6:
        with pytest.raises(InputError, match="away from orthonormal"):
            open_job(Settings(inputs.config, inputs.path, inputs.spec))
        # alone it is taken as it is
        assert PoseBox.around(read(tmp_path, data).cameras[entry], Perturbation()).box.names == ()
    else:
        swept = open_job(Settings(inputs.config, inputs.path, inputs.spec)).pose_sets[0]
        assert np.abs(swept.pose(np.array([float(entry)])) - matrix[:3]).max() < 2e-6


# ---------------------------------------------------------------- poses and bounds


@pytest.mark.slow_cases
@pytest.mark.parametrize("count", [2, 3])
def test_poses_of_the_closing_leg(tmp_path: Path, count: int) -> None:
    """Against a slerp of quaternions, and enclosed exactly."""
    path = read(tmp_path, closed(count=count))
    swept = PoseBox.around(path.cameras[-1], Perturbation(sweep="segments"), path.following(count - 1))
    assert swept.box.names == ("segment",)
    s = np.linspace(0.0, 1.0, 41)
    for value, camera in zip(s, leg(path, s), strict=True):
        assert np.abs(swept.pose(np.array([value])) - camera.camera_to_world).max() < 1e-13
    for order in (1, 2):
        assert escapes(swept, swept.box, order) == [] and thin_escapes(swept, order) == []


def outside(lower: np.ndarray, upper: np.ndarray, scene: nsa.Scene, cameras: list[PinholeCamera]) -> int:
    """Numbers of the cameras' pictures that lie outside the bounds."""
    pictures = [nsa.render(scene, camera) for camera in cameras]
    return sum(int(((picture < lower) | (picture > upper)).sum()) for picture in pictures)


def test_bounds_hold_on_the_closing_leg(inputs: Inputs) -> None:
    path, scene = load_camera_path(inputs.path), nsa.load_scene(inputs.config)
    poses = nsa.PoseSet.from_json(path.cameras[2], SEGMENTS, following=path.following(2))
    result = nsa.bound(scene, poses, target_ratio=3.0, time_budget=4.0)
    cameras = leg(path, np.random.default_rng(0).uniform(0.0, 1.0, 60))
    assert outside(result.lower, result.upper, scene, cameras) == 0
    # the bounds of the last entry alone do not hold there, so that the test can fail
    still = nsa.bound(scene, nsa.PoseSet.from_json(path.cameras[2], SEGMENTS, following=None))
    assert outside(still.lower, still.upper, scene, cameras) > 1000


def test_segments_without_the_next_keyframe_are_refused(tmp_path: Path) -> None:
    path = read(tmp_path, closed())
    with pytest.raises(InputError, match="following") as caught:
        nsa.PoseSet.from_json(path.cameras[2], SEGMENTS)
    assert caught.value.field == "sweep"
    assert nsa.PoseSet.from_json(path.cameras[2], SEGMENTS, following=None).parameters == ()
    assert nsa.PoseSet.from_json(path.cameras[2], {"version": 1}).parameters == ()


# ---------------------------------------------------------------- commands


def test_render_bounds_the_closing_leg(inputs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    out = tmp_path / "out"
    options = inputs.options(out, time_budget=4, frames=2, target_ratio=3.0)
    assert in_process(render_command.main, options)[0] == 0
    frame = load_frame(out / "frame_00002.npz").result
    assert frame.box.names == ("segment",) and (frame.box.lower, frame.box.upper) == ((0.0,), (1.0,))
    scene, path = nsa.load_scene(inputs.config), load_camera_path(inputs.path)
    assert outside(frame.lower, frame.upper, scene, leg(path, np.linspace(0.0, 1.0, 23))) == 0


@pytest.mark.slow
@pytest.mark.parametrize("before", [False, True])
def test_results_of_another_leg_are_not_continued(
    inputs: Inputs, tmp_path: Path, in_process: InProcess, before: bool
) -> None:
    inputs.path.write_text(json.dumps(closed(before)))
    options = inputs.options(tmp_path / "out", time_budget=2, frames=2, target_ratio=5.0)
    assert in_process(render_command.main, options)[0] == 0
    assert in_process(render_command.main, [*options, "--resume"])[0] == 0
    inputs.path.write_text(json.dumps(closed(not before)))
    code, _, said = in_process(render_command.main, [*options, "--resume"])
    assert code == 2 and "report.json" in said


def test_fingerprints_know_where_a_leg_ends(inputs: Inputs, tmp_path: Path) -> None:
    path, scene = load_camera_path(inputs.path), nsa.load_scene(inputs.config)
    found = set()
    for target in (path.cameras[0], path.cameras[1], None):
        poses = nsa.PoseSet.from_json(path.cameras[2], SEGMENTS, following=target).of(scene)
        found.add(str(Job(scene, [poses]).fingerprint))
    assert len(found) == 3


@pytest.fixture
def question(tmp_path: Path) -> list[str]:
    net = classifier(tmp_path / "net.onnx", size=8)
    (tmp_path / "prop.json").write_text(
        json.dumps({"type": "classification", "label": 0, "preprocess": {"resize": [8, 8]}})
    )
    return ["--model", str(net), "--property", str(tmp_path / "prop.json")]


@pytest.mark.slow
def test_certify_covers_the_closing_leg(
    inputs: Inputs, question: list[str], tmp_path: Path, in_process: InProcess
) -> None:
    out = tmp_path / "out"
    options = [*inputs.options(out, time_budget=4), *question, "--workers", "1"]
    assert in_process(certify_command.main, options)[0] in (0, 3)
    with sqlite3.connect(out / "cells.sqlite") as base:
        rows = base.execute("SELECT frame, lower, upper FROM cells").fetchall()
    covered = dict.fromkeys(range(3), 0.0)
    for frame, lower, upper in rows:
        covered[frame] += json.loads(upper)[0] - json.loads(lower)[0]
    assert covered == {0: pytest.approx(1.0), 1: pytest.approx(1.0), 2: pytest.approx(1.0)}


def test_exported_boxes_cover_the_closing_leg(
    inputs: Inputs, question: list[str], tmp_path: Path, in_process: InProcess
) -> None:
    out = tmp_path / "boxes"
    options = [*inputs.options(out, frames=2, parts=2), *question]
    assert in_process(export_command.main, ["vnnlib", *options])[0] == 0
    boxes = json.loads((out / "boxes.json").read_text())
    sides = sorted((box[0]["name"], box[0]["lower"], box[0]["upper"]) for box in boxes.values())
    assert sides == [("segment", 0.0, 0.5), ("segment", 0.5, 1.0)]


@pytest.mark.slow_cases
@pytest.mark.parametrize("how", ["render", "certify", "export"])
def test_one_keyframe_serves_every_command(
    inputs: Inputs, question: list[str], tmp_path: Path, in_process: InProcess, how: str
) -> None:
    """The viewer's file of one keyframe gives what a path of this one entry gives."""
    whole = closed(count=1)
    inputs.spec.write_text(json.dumps({"version": 1, "translation": {"x": 0.001}}))
    found = []
    for name, data in (("entry", whole), ("keyframe", {**whole, "camera_path": []})):
        inputs.path.write_text(json.dumps(data))
        out = tmp_path / name
        if how == "render":
            options = inputs.options(out, target_ratio=5.0, time_budget=20)
            assert in_process(render_command.main, options)[0] == 0
            frame = load_frame(out / "frame_00000.npz").result
            found.append((frame.lower.tolist(), frame.upper.tolist()))
        elif how == "certify":
            options = [*inputs.options(out, time_budget=3), *question, "--workers", "1"]
            assert in_process(certify_command.main, options)[0] in (0, 3)
            found.append(json.loads((out / "report.json").read_text())["frames"][0]["index"])
        else:
            assert in_process(export_command.main, ["vnnlib", *inputs.options(out), *question])[0] == 0
            found.append((out / "frame_00000_box_00000.vnnlib").read_text())
    assert found[0] == found[1]
