"""The Python interface: `import ns_abstract as nsa`, on splats, a NeRF and a third representation."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import sqlite3
import subprocess
import sys
import threading
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from certifying import classifier, linear
from conftest import Inputs
from nerfs import tiny_scene
from wall import WALL, write_wall

import ns_abstract as nsa
from ns_abstract.api import cell_search
from ns_abstract.api.comparing import check_comparison
from ns_abstract.api.locating import photo_levels
from ns_abstract.api.location import PhotoOptions
from ns_abstract.api.search_options import SearchOptions
from ns_abstract.cli import render as render_command
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.methods import load
from ns_abstract.methods.nerf.method import NerfMethod
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.methods.splat import bounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.report.files import load_frame

OPACITY = {"select": {"indices": [0]}, "opacity": 0.1}
PICTURES = ("lower", "upper", "witness_lower", "witness_upper", "image")


@pytest.fixture
def wall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> nsa.Scene:
    """A scene of a representation that the package does not know."""
    monkeypatch.setattr(load, "REPRESENTATIONS", [WALL, *load.REPRESENTATIONS])
    return nsa.load_scene(write_wall(tmp_path / "painted.wall"))


def straight(size: int = 10) -> nsa.Camera:
    return nsa.Camera(np.eye(4), width=size, height=size)


def outside(result: nsa.BoundResult, scene: nsa.Scene, poses: nsa.PoseSet, count: int = 200) -> int:
    """Pixel channels of random pictures of the set that lie outside the bounds."""
    frame = scene.method().frame(poses.of(scene))
    values = [*frame.box.sample(count, np.random.default_rng(3)), *frame.box.corners()]
    found = 0
    for v in values:
        pose = frame.pose_set.pose(v)
        camera = dataclasses.replace(PinholeCamera(**_fields(poses.camera)), camera_to_world=pose)
        image = nsa.render(scene, camera)
        assert image.dtype == np.float64 and image.shape == result.lower.shape
        found += int((~((result.lower <= image) & (image <= result.upper))).sum())
    return found


def _fields(camera: PinholeCamera) -> dict[str, Any]:
    return {field.name: getattr(camera, field.name) for field in dataclasses.fields(PinholeCamera)}


def test_cameras_have_intrinsics() -> None:
    camera = nsa.Camera(np.eye(4), width=30, height=20, fx=25.0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (25.0, 25.0, 15.0, 10.0)
    camera = nsa.Camera(np.eye(4), width=30, height=20, fx=25.0, fy=24.0, cx=14.5, cy=0.0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (25.0, 24.0, 14.5, 0.0)
    for name, value in (("fx", 0.0), ("fy", float("nan")), ("cx", "middle"), ("cy", float("inf"))):
        with pytest.raises(nsa.InputError, match=name):
            nsa.Camera(np.eye(4), **{name: value})  # pyright: ignore[reportArgumentType]


def test_pictures_are_not_rounded_and_need_no_sums_of_bounds(blobs: Inputs, monkeypatch: pytest.MonkeyPatch) -> None:
    """The renderer's own float64 numbers; what bounds alone need is made by the first of them, once for a scene."""
    made: list[int] = []

    def counted(axes: np.ndarray, charges: Any) -> np.ndarray:
        made.append(len(axes))
        return covariance_noise(axes, charges)

    covariance_noise = bounds.covariance_noise
    monkeypatch.setattr(bounds, "covariance_noise", counted)
    scene = nsa.load_scene(blobs.config)
    camera = nsa.load_camera_path(blobs.path).cameras[0]
    image = nsa.render(scene, camera)
    first, second = (scene.method().frame(nsa.PoseSet(camera, translation={"x": x}).of(scene)) for x in (0.001, 0.002))
    assert isinstance(first, SplatFrame) and isinstance(second, SplatFrame) and made == []
    view = first.renderer.image(first.camera, *first.pose_set.world_to_camera(first.box.middle))
    assert image.dtype == np.float64 and np.array_equal(image, view)
    assert np.any(image != image.astype(np.float32))
    cells = [frame.bound(frame.box, np.arange(2)) for frame in (first, second)]
    assert len(made) == 1
    # another set of scenes has sums of its own
    varied = nsa.PoseSet.from_json(camera, {"version": 1, "translation": {"x": 0.001}, "scene": [OPACITY]})
    third = scene.method().frame(varied.of(scene))
    third.bound(third.box, np.arange(2))
    assert len(made) == 2
    alone = SplatFrame(first.bounds.splats, GSPLAT_1_4_0, first.bounds.arithmetic, second.pose_set)
    np.testing.assert_array_equal(cells[1].lower, alone.bound(alone.box, np.arange(2)).lower)


# ---------------------------------------------------------------- a third representation


def test_third_representation_is_bounded(wall: nsa.Scene, tmp_path: Path) -> None:
    poses = nsa.PoseSet(straight(), translation={"x": 0.1, "y": (-0.05, 0.1)}, frame="world")
    result = nsa.bound(wall, poses, target_ratio=1.1, time_budget=60.0, keep_cells=True)
    assert result.ratio is not None and 1.0 <= result.ratio <= 1.1 and result.status == "done"
    assert result.guarantee == "real-sound" and result.parameters.names == ("x", "y") == poses.parameters
    assert outside(result, wall, poses) == 0
    assert result.mpg < 0.5 and result.mpg <= result.xpg and not result.interrupted
    assert result.trace[-1].mpg == pytest.approx(result.mpg)
    assert result.cells is not None and result.cells.A_lower.shape[-1] == 2
    result.save(tmp_path / "frame.npz")
    stored = load_frame(tmp_path / "frame.npz")
    for name in PICTURES:
        np.testing.assert_array_equal(getattr(stored.result, name), getattr(result, name))
    assert stored.status == "done" and stored.has_leaves


def test_unsound_bounds_of_a_representation_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "REPRESENTATIONS", [WALL])
    scene = nsa.load_scene(write_wall(tmp_path / "painted.wall", fault=0.2))
    poses = nsa.PoseSet(straight(), translation={"x": 0.1}, frame="world")
    assert outside(nsa.bound(scene, poses, target_ratio=10.0), scene, poses) > 0


def test_third_representation_is_certified(wall: nsa.Scene, tmp_path: Path) -> None:
    size = 8
    net = classifier(tmp_path / "net.onnx", size)
    poses = nsa.PoseSet(straight(size), translation={"x": 0.02}, frame="world")
    session = onnxruntime.InferenceSession(str(net), providers=["CPUExecutionProvider"])
    frame = wall.method().frame(poses.of(wall))

    def says(x: float) -> int:
        pose = frame.pose_set.pose(np.array([x]))
        image = nsa.render(wall, dataclasses.replace(PinholeCamera(**_fields(poses.camera)), camera_to_world=pose))
        return int(session.run(None, {"image": image.transpose(2, 0, 1)[None].astype(np.float32)})[0].argmax())

    label = says(0.0)
    cert = nsa.certify(wall, poses, net, {"type": "classification", "label": label}, time_budget=60.0)
    assert cert.certified > 0.5 and cert.certified + cert.falsified + cert.unknown == pytest.approx(1.0)
    assert cert.parameters == (("x", "normalised units"),) and cert.state == "done"
    rng = np.random.default_rng(0)
    for cell in cert.cells:
        if cell.verdict == "certified":
            assert cell.margin is not None and cell.margin > 0.0
            assert {says(x) for x in rng.uniform(cell.lower[0], cell.upper[0], 5)} == {label}
        if cell.verdict == "falsified":
            assert cell.counterexample is not None and says(float(cell.counterexample[0])) != label
    # the wrong label is falsified, not certified
    wrong = nsa.certify(wall, poses, net, {"type": "classification", "label": (label + 1) % 3}, time_budget=20.0)
    assert wrong.certified < 0.5 and wrong.falsified > 0.5 and wrong.verdict == "falsified"


def test_third_representation_from_the_command_line(wall: nsa.Scene, tmp_path: Path, blobs: Inputs) -> None:
    spec = tmp_path / "spec.json"
    # a unit of its data set is two normalised ones
    value = {"version": 1, "frame": "world", "units": "dataset", "translation": {"y": 0.03}}
    spec.write_text(json.dumps(value))
    options = render_command.Render(
        load_config=wall.source.file, camera_path_filename=blobs.path, output_dir=tmp_path / "out",
        perturbation_filename=spec, frames=(1,), time_budget=20.0,
    )  # fmt: skip
    assert render_command.render(options) == 0
    document = json.loads((tmp_path / "out" / "report.json").read_text())
    assert document["renderer"]["name"] == "wall" and document["guarantee"] == "real-sound"
    (entry,) = document["frames"]
    assert entry["parameters"][0]["upper"] == 0.06 and entry["ratio"] <= 1.05
    assert "perspective left out" in entry["plan"][0] and "lighting left out" in document["plan"][0]
    # the command line and the interface say the same
    path = nsa.load_camera_path(blobs.path)
    result = nsa.bound(wall, nsa.PoseSet.from_json(path.cameras[1], value), time_budget=20.0)
    stored = load_frame(tmp_path / "out" / "frame_00001.npz").result
    for name in ("lower", "upper"):
        np.testing.assert_array_equal(getattr(result, name), getattr(stored, name))
    with pytest.raises(nsa.InputError, match="straight on"):
        nsa.bound(wall, nsa.PoseSet(path.cameras[0], rotation={"yaw": 0.1}))


# ---------------------------------------------------------------- ending early


def test_on_progress_ends_the_work(wall: nsa.Scene) -> None:
    poses = nsa.PoseSet(straight(), translation={"x": 0.3, "y": 0.3}, frame="world")
    seen: list[nsa.Progress] = []

    def enough(progress: nsa.Progress) -> bool:
        seen.append(progress)
        return not (progress.covered == 1.0 and progress.cells > 30)

    result = nsa.bound(wall, poses, target_ratio=1.0, time_budget=600.0, on_progress=enough)
    assert result.interrupted and result.bounded and outside(result, wall, poses, 50) == 0
    assert [p.cells for p in seen] == sorted(p.cells for p in seen) and seen[-1].cells > 30
    assert all(p.frame == 0 and p.budget <= 600.0 and p.mpg >= p.mpg_witness for p in seen)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["signal", "raised"])
def test_interrupt_keeps_what_is_known(how: str, wall: nsa.Scene, request: pytest.FixtureRequest) -> None:
    if how == "signal":
        if threading.current_thread() is not threading.main_thread():
            pytest.skip("signals reach the main thread alone")
        # commands in the background are started with the signal ignored
        found = signal.signal(signal.SIGINT, signal.default_int_handler)
        request.addfinalizer(lambda: signal.signal(signal.SIGINT, found))
    poses = nsa.PoseSet(straight(), translation={"x": 0.3, "y": 0.3}, frame="world")

    told: list[int] = []

    def interrupt(progress: nsa.Progress) -> None:
        if progress.covered == 1.0 and not told:
            told.append(progress.cells)
            if how == "raised":
                raise KeyboardInterrupt
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    result = nsa.bound(wall, poses, target_ratio=1.0, time_budget=600.0, on_progress=interrupt)
    assert signal.getsignal(signal.SIGINT) is before
    assert result.interrupted and result.bounded and outside(result, wall, poses, 50) == 0
    # nothing lingers
    assert not nsa.bound(wall, poses, target_ratio=100.0).interrupted


@pytest.mark.slow
def test_certificate_ends_early_and_goes_on(wall: nsa.Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    monkeypatch.setattr(cell_search, "_TRACE", 0.0)
    rows = np.stack([np.ones(3 * 64), np.zeros(3 * 64)]) / 192
    net = linear(tmp_path / "net.onnx", rows, np.array([0.0, 0.6]), 8)
    poses = nsa.PoseSet(straight(8), translation={"x": 0.6}, frame="world")
    prop = {"type": "classification", "label": 0}
    out = tmp_path / "out"
    seen: list[nsa.CertifyProgress] = []

    def stop(progress: nsa.CertifyProgress) -> bool:
        seen.append(progress)
        return False

    early = nsa.certify(wall, poses, net, prop, output_dir=out, on_progress=stop)
    assert early.interrupted and early.unknown > 0.0 and len(seen) == 1 and seen[0].open > 0.0
    late = nsa.certify(wall, poses, net, prop, output_dir=out, resume=True)
    whole = nsa.certify(wall, poses, net, prop)
    assert late.state == whole.state == "done"
    for name in ("certified", "falsified", "unknown", "verdict"):
        assert getattr(late, name) == getattr(whole, name)
    with sqlite3.connect(out / "cells.sqlite") as base:
        assert base.execute("SELECT count(*) FROM cells").fetchone()[0] == len(whole.cells)
    assert (out / "report.html").exists() and late.report["coverage"]["certified"] == late.certified


# ---------------------------------------------------------------- splats and NeRFs


def test_splats(blobs: Inputs, tmp_path: Path) -> None:
    """The same bits as the command line writes."""
    scene, path = nsa.load_scene(blobs.config), nsa.load_camera_path(blobs.path)
    spec = json.loads(blobs.spec.read_text())
    # the command keeps cells where they are small
    result = nsa.bound(scene, nsa.PoseSet.from_json(path.cameras[0], spec), target_ratio=1.5, keep_cells=True)
    options = render_command.Render(
        load_config=blobs.config, camera_path_filename=blobs.path, output_dir=tmp_path,
        perturbation_filename=blobs.spec, frames=(0,), target_ratio=1.5,
    )  # fmt: skip
    assert render_command.render(options) == 0
    stored = load_frame(tmp_path / "frame_00000.npz").result
    for name in PICTURES:
        np.testing.assert_array_equal(getattr(stored, name), getattr(result, name))
    assert result.guarantee == "float32-sound" and result.cells is not None
    real = nsa.bound(scene, nsa.PoseSet(path.cameras[0], translation={"x": 0.01}), arithmetic="real", target_ratio=2.0)
    assert real.guarantee == "real-sound"
    assert "blobs" in repr(scene) and "Gaussians" in repr(scene)
    varied = {"scene": [{"select": {}, "opacity": 0.05}]}
    wider = nsa.bound(scene, nsa.PoseSet.from_json(path.cameras[0], varied), target_ratio=5.0, time_budget=5.0)
    assert wider.mpg > 0.0 and any("opacity" in sentence for sentence in wider.plan)


@pytest.mark.slow
def test_nerf(tmp_path: Path) -> None:
    config = write_nerf_run(tiny_scene(0), tmp_path, timestamp="2026-01-01_000000", experiment_name="tiny")
    scene = nsa.load_scene(config, num_samples=8)
    camera = nsa.Camera(look_at((1.5, 0.0, 0.5), (0.0, 0.0, 0.0)), width=3, height=3)
    poses = nsa.PoseSet(camera, rotation={"yaw": 1e-3})
    result = nsa.bound(scene, poses, target_ratio=3.0, time_budget=60.0)
    assert result.guarantee == "real-sound" and outside(result, scene, poses, 20) == 0
    with pytest.raises(nsa.InputError) as caught:
        nsa.bound(scene, poses, arithmetic="float32")
    assert caught.value.field == "--arithmetic"


# ---------------------------------------------------------------- arguments


def test_places_of_a_path_count_from_its_end_too(tmp_path: Path) -> None:
    entries = [
        {"camera_to_world": np.eye(4).tolist(), "fov": 30.0 + k, "perturbation": {"hue": k / 8}} for k in range(3)
    ]
    file = tmp_path / "path.json"
    for cycle in (False, True):
        file.write_text(json.dumps({"render_height": 4, "render_width": 4, "camera_path": entries, "is_cycle": cycle}))
        path = nsa.load_camera_path(file)
        # behind the last entry nothing follows, unless the path closes
        assert path.following(-1) is path.following(2) is (path.cameras[0] if cycle else None)
        assert path.following(-3) is path.cameras[1] and path.perturbation_of(-1) == {"hue": 0.25}
        for index in (3, -4, 0.5, True, None):
            for ask in (path.following, path.perturbation_of):
                with pytest.raises(nsa.InputError, match="index"):
                    ask(index)  # type: ignore[arg-type]


def test_camera_is_that_of_the_path(blobs: Inputs) -> None:
    theirs = nsa.load_camera_path(blobs.path).cameras[0]
    ours = nsa.Camera(theirs.camera_to_world, fov=45.0, width=theirs.width, height=theirs.height)
    for name, value in _fields(theirs).items():
        np.testing.assert_array_equal(_fields(ours)[name], value)
    whole = nsa.Camera(np.concatenate([theirs.camera_to_world, [[0, 0, 0, 1]]]), 45.0, theirs.width, theirs.height)
    np.testing.assert_array_equal(whole.camera_to_world, ours.camera_to_world)


def test_perturbations_of_a_path(blobs: Inputs, tmp_path: Path) -> None:
    path = json.loads(blobs.path.read_text())
    path["perturbation"] = {"translation": {"x": 0.1}}
    path["camera_path"][1]["perturbation"] = {"translation": {"y": 0.2}}
    (tmp_path / "path.json").write_text(json.dumps(path))
    found = nsa.load_camera_path(tmp_path / "path.json")
    assert [p and p["translation"] for p in found.perturbations] == [{"x": 0.1}, {"y": 0.2}, {"x": 0.1}]
    sets = [nsa.PoseSet.from_json(c, p) for c, p in zip(found.cameras, found.perturbations, strict=True)]
    assert [s.parameters for s in sets] == [("x",), ("y",), ("x",)]
    swept = nsa.PoseSet(found.cameras[0], translation={"x": 0.1}, following=found.following(0))
    assert swept.parameters == ("x", "segment")
    assert nsa.PoseSet.from_json(found.cameras[0], None).parameters == ()
    turning = nsa.PoseSet(found.cameras[0], orbit={"target": np.zeros(3), "axis": (0, 0, 1), "azimuth": (0.0, 1.0)})
    assert turning.parameters == ("azimuth",)


MISTAKES = {
    "reversed": (lambda: nsa.PoseSet(straight(), translation={"x": (0.1, -0.1)}), "translation.x"),
    "unknown axis": (lambda: nsa.PoseSet(straight(), translation={"w": 0.1}), "translation.w"),
    "not a number": (lambda: nsa.PoseSet(straight(), rotation={"yaw": float("nan")}), "rotation.yaw"),
    "frame": (lambda: nsa.PoseSet(straight(), frame="sideways"), "frame"),
    "unknown key": (lambda: nsa.PoseSet.from_json(straight(), {"shake": 1}), "shake"),
    "no camera": (lambda: nsa.PoseSet(np.eye(4), translation={"x": 0.1}), "camera"),  # type: ignore[arg-type]
    "fov": (lambda: nsa.Camera(np.eye(4), fov=200.0), "fov"),
    "width": (lambda: nsa.Camera(np.eye(4), width=0), "width"),
    "pose": (lambda: nsa.Camera(2.0 * np.eye(4)), "camera_to_world"),
    "3x3": (lambda: nsa.Camera(np.eye(3)), "camera_to_world"),
    "matrix of words": (lambda: nsa.Camera("front"), "camera_to_world"),
    "one number for three axes": (lambda: nsa.PoseSet(straight(), translation=0.02), "translation"),  # type: ignore[arg-type]
    "a list for three axes": (lambda: nsa.PoseSet(straight(), rotation=[0.02, 0, 0]), "rotation"),  # type: ignore[arg-type]
    "a word for a number": (lambda: nsa.PoseSet(straight(), rotation={"yaw": "much"}), "rotation.yaw"),  # type: ignore[dict-item]
    "orbit": (lambda: nsa.PoseSet(straight(), orbit=1.0), "orbit"),  # type: ignore[arg-type]
    "axis": (lambda: nsa.PoseSet(straight(), orbit={"target": "a", "axis": 1, "azimuth": 2}), "orbit.axis"),
    "angle units": (lambda: nsa.PoseSet(straight(), angle_units="turns"), "angle_units"),
    "scene": (lambda: nsa.bound("scene.yml", straight()), "scene"),  # type: ignore[arg-type]
    "render a set": (lambda: nsa.render("scene.yml", nsa.PoseSet(straight())), "camera"),  # type: ignore[arg-type]
    "no path": (lambda: nsa.load_scene(None), "path"),  # type: ignore[arg-type]
    "no camera path": (lambda: nsa.load_camera_path(3), "path"),  # type: ignore[arg-type]
    "no folder": (lambda: nsa.check(3), "output_dir"),  # type: ignore[arg-type]
    "half a sample": (lambda: NerfMethod(tiny_scene(0), num_samples=2.5), "--num-samples"),  # type: ignore[arg-type]
    "true samples": (lambda: NerfMethod(tiny_scene(0), num_samples=True), "--num-samples"),
    "a word for a plane": (lambda: NerfMethod(tiny_scene(0), near_plane="x"), "--near-plane"),  # type: ignore[arg-type]
    "a number for a colour": (lambda: nsa.load_scene("none.yml", background=0.5), "--background"),  # type: ignore[arg-type]
    "a tensor with gradients": (lambda: nsa.Camera(torch.eye(4, requires_grad=True)), "camera_to_world"),
    "an array for a word": (lambda: nsa.PoseSet(straight(), frame=np.zeros(2)), "frame"),  # type: ignore[arg-type]
    "a number for a camera": (lambda: nsa.PoseSet(straight(), following=3), "following"),  # type: ignore[arg-type]
    "a number for a folder": (lambda: nsa.PoseSet.from_json(straight(), {}, folder=3), "folder"),  # type: ignore[arg-type]
    "a negative scale": (
        lambda: nsa.PoseSet(straight(), {"x": 1}, units="dataset").perturbation(-1.0),
        "dataset_scale",
    ),
    "a set of no scene": (lambda: nsa.PoseSet(straight()).of(None), "scene"),  # type: ignore[arg-type]
    "another renderer": (lambda: nsa.load_scene("none.yml", renderer=3), "--renderer"),  # type: ignore[arg-type]
    "an array for a mode": (lambda: nsa.load_scene("none.yml", rasterize_mode=np.zeros(2)), "--rasterize-mode"),  # type: ignore[arg-type]
    "a word for a choice": (lambda: nsa.load_scene("none.yml", drop_nan_gaussians="no"), "--drop-nan-gaussians"),  # type: ignore[arg-type]
    "another engine": (lambda: SearchOptions(engine="fast"), "engine"),  # type: ignore[arg-type]
    "a number for an output folder": (lambda: SearchOptions(output_dir=3), "output_dir"),  # type: ignore[arg-type]
    "a word for a tolerance": (lambda: check_comparison("wide", 1.05, None, ""), "tolerance"),  # type: ignore[arg-type]
    "a word for resume": (lambda: SearchOptions(resume="no", output_dir="x"), "resume"),  # type: ignore[arg-type]
    "a word for noise": (lambda: PhotoOptions(noise="some"), "--noise"),  # type: ignore[arg-type]
    "a list for outliers": (lambda: PhotoOptions(outliers=[0.1]), "--outliers"),  # type: ignore[arg-type]
    "words for a gain": (lambda: PhotoOptions(gain=("a", "b")), "--brightness-gain"),  # type: ignore[arg-type]
    "a word for contract": (lambda: PhotoOptions(contract="no"), "contract"),  # type: ignore[arg-type]
    "a photo of words": (lambda: photo_levels(torch.zeros(2, 2, 3, requires_grad=True)), "photo"),
    "longer than numbers": (lambda: SearchOptions(time_budget=10**400), "time_budget"),
}
#: What `ns_abstract.bound` gets, by the name of the argument that its error names.
BAD_ARGUMENTS: dict[str, Any] = {
    "poses": None, "time_budget": "long", "target_ratio": None, "workers": 0.5, "seed": -1, "--memory-limit": "x",
    "keep_cells": "no", "outputs": 3, "on_progress": "x",
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_name_the_field(name: str) -> None:
    make, field = MISTAKES[name]
    with pytest.raises(nsa.InputError) as caught:
        make()
    assert caught.value.field == field and caught.value.fix and "\n" not in str(caught.value)


def test_samples_may_be_of_any_whole_number() -> None:
    method = NerfMethod(tiny_scene(0), num_samples=np.int64(3), near_plane=np.float32(0.25))  # type: ignore[arg-type]
    sampling = method.sampling
    assert (type(sampling.samples), sampling.samples, type(sampling.near), sampling.near) == (int, 3, float, 0.25)


def test_numbers_of_other_libraries_can_stand_in_reports(tmp_path: Path) -> None:
    options = SearchOptions(time_budget=Fraction(1, 2), workers=np.int64(2), resume=np.bool_(True), output_dir=tmp_path)  # type: ignore[arg-type]
    assert json.loads(json.dumps(options.settings))["time_budget"] == 0.5 and options.resume is True
    photo = PhotoOptions(np.float32(0.25), Fraction(1, 8), np.bool_(False), (1, np.float32(1.5)))  # type: ignore[arg-type]
    assert json.loads(json.dumps(vars(photo)))["gain"] == [1.0, 1.5] and photo.contract is False


@pytest.mark.parametrize("name", BAD_ARGUMENTS)
def test_bad_arguments_are_named(name: str, wall: nsa.Scene) -> None:
    arguments = {"poses": straight(), name.strip("-").replace("-", "_"): BAD_ARGUMENTS[name]}
    with pytest.raises(nsa.InputError) as caught:
        nsa.bound(wall, **arguments)
    assert caught.value.field == name and caught.value.fix


def test_methods_of_scenes_and_results_name_the_field(wall: nsa.Scene, blobs: Inputs, tmp_path: Path) -> None:
    splats, held = nsa.load_scene(blobs.config), []
    held.append(held)
    result = nsa.bound(wall, straight(8))
    report = tmp_path / "none"
    for field, call in (
        ("--arithmetic", lambda: splats.method(np.arange(3))),  # type: ignore[arg-type]
        ("--arithmetic", lambda: splats.method("x" * 10_000)),
        ("--background", lambda: splats.on_background(3, "here")),  # type: ignore[arg-type]
        ("--background", lambda: splats.on_background((0.0, 0.0, 2.0), "here")),
        ("path", lambda: result.save(None)),  # type: ignore[arg-type]
        ("path", lambda: result.save("a\0b")),
        ("on_progress", lambda: nsa.check(report, on_progress=3)),  # type: ignore[arg-type]
        ("time_budget", lambda: nsa.compare(wall, wall, straight(8), time_budget=None)),  # type: ignore[arg-type]
        ("workers", lambda: nsa.compare(wall, wall, straight(8), workers=0)),
        ("seed", lambda: nsa.compare(wall, wall, straight(8), seed=-1)),
        ("on_progress", lambda: nsa.compare(wall, wall, straight(8), on_progress="x")),  # type: ignore[arg-type]
        (None, lambda: nsa.PoseSet(straight(8), translation={"x": held})),
        ("network_arithmetic", lambda: nsa.reach(splats, report, network_arithmetic="Float32")),  # type: ignore[arg-type]
        ("network_arithmetic", lambda: nsa.certify(wall, straight(8), None, {}, network_arithmetic=np.eye(2))),  # type: ignore[arg-type]
        ("picture", lambda: nsa.certify(wall, straight(8), None, {}, picture=np.eye(2))),  # type: ignore[arg-type]
        ("engine", lambda: nsa.certify(wall, straight(8), None, {}, engine=np.eye(2))),  # type: ignore[arg-type]
        ("workers", lambda: nsa.certify(wall, straight(8), None, {}, workers=10**400)),
    ):
        with pytest.raises(nsa.InputError) as caught:
            call()
        assert caught.value.field == field and caught.value.fix and len(str(caught.value)) < 300
    color = splats.on_background((0.5, 0.25, 1.0), "here").background
    assert color == (0.5, 0.25, 1.0) and splats.background != color


def test_a_camera_is_the_set_of_its_pose(wall: nsa.Scene, tmp_path: Path) -> None:
    result = nsa.bound(wall, straight(8))
    image = nsa.render(wall, straight(8))
    assert result.parameters.names == () and ((result.lower <= image) & (image <= result.upper)).all()
    net = classifier(tmp_path / "net.onnx", 8)
    for poses in (straight(8), [straight(8), nsa.PoseSet(straight(8))]):
        found = nsa.certify(wall, poses, net, {"type": "classification", "label": 0}, time_budget=5.0)
        assert found.certified + found.falsified + found.unknown == pytest.approx(1.0)
    for poses, field in ((3, "poses"), ([3], "poses[0]"), ([], "poses")):
        with pytest.raises(nsa.InputError) as caught:
            nsa.certify(wall, poses, net, {"type": "classification", "label": 0})  # type: ignore[arg-type]
        assert caught.value.field == field


def test_degrees_are_radians() -> None:
    orbit = {"target": np.zeros(3), "axis": (0, 0, 1), "azimuth": (0.0, 90.0)}
    turned = nsa.PoseSet(straight(), rotation={"yaw": np.float32(2.0)}, orbit=orbit, angle_units="degrees")
    found = turned.perturbation()
    assert found.rotation["yaw"] == pytest.approx((-np.deg2rad(2.0), np.deg2rad(2.0)))
    assert found.orbit is not None and found.orbit.azimuth == pytest.approx((0.0, np.pi / 2.0))


def test_files_that_are_not_there(tmp_path: Path, wall: nsa.Scene) -> None:
    with pytest.raises(nsa.InputError) as caught:
        nsa.load_scene(tmp_path / "none.yml")
    assert caught.value.file is not None and caught.value.file.endswith("none.yml")
    poses = nsa.PoseSet(straight(), translation={"x": 0.1})
    with pytest.raises(nsa.InputError, match=r"none\.onnx"):
        nsa.certify(wall, poses, tmp_path / "none.onnx", {"type": "classification", "label": 0})
    for more in ({"target_ratio": 0.5}, {"time_budget": 0.0}):
        with pytest.raises(nsa.InputError) as caught:
            nsa.bound(wall, poses, **more)
        assert caught.value.field == next(iter(more))


# ---------------------------------------------------------------- notebooks, imports


def test_results_show_themselves(wall: nsa.Scene, tmp_path: Path) -> None:
    poses = nsa.PoseSet(straight(8), translation={"x": 0.1}, frame="world")
    shown = nsa.bound(wall, poses)._repr_html_()
    assert shown.count("data:image/png;base64,") == 4
    result = nsa.bound(wall, poses, keep_cells=True, outputs="rgb")
    for thing in (result, result.frame, result.cells, result.layers):
        for printed in (str(thing), repr(thing)):
            assert len(printed) < 1500 and len(printed.splitlines()) < 24, printed
    assert "mean gap" in str(result) and "ratio to real renders" in repr(result)
    for text in ("lower bound", "upper bound", "gap", "one render", "real-sound", "ratio"):
        assert text in shown
    net = classifier(tmp_path / "net.onnx", 8)
    text = nsa.certify(wall, poses, net, {"type": "classification", "label": 0}, time_budget=5.0)._repr_html_()
    assert "certified" in text and "every image" in text


@pytest.mark.slow
def test_import_is_light() -> None:
    code = (
        "import sys, ns_abstract as nsa; assert not {'numpy', 'torch', 'numba', 'onnx'} & set(sys.modules); "
        "assert set(nsa.__all__) <= set(dir(nsa)); nsa.InputError; assert 'numpy' not in sys.modules; "
        "[getattr(nsa, name) for name in nsa.__all__]; assert 'nerfstudio' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        nsa.nothing  # noqa: B018


@pytest.mark.slow
def test_a_function_is_not_hidden_by_the_folder_of_its_name() -> None:
    lines = (
        "from ns_abstract import ReachResult; from ns_abstract import reach; reach.__call__",
        "import ns_abstract.reach.loop, ns_abstract as nsa; nsa.reach.__call__",
        "import ns_abstract.check.audit, ns_abstract as nsa; nsa.check.__call__",
    )
    for code in lines:
        subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_version_is_that_of_the_package() -> None:
    import importlib.metadata

    assert importlib.metadata.version("ns-abstract") == nsa.__version__
    assert (Path(nsa.__file__).parent / "py.typed").exists()
