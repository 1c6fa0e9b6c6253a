"""Cameras of other programs' files: the same rays as their own programs make, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import blob_scene

import ns_abstract as nsa
from ns_abstract.api.files import Settings, open_job
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.write import write_splatfacto_run

POSE = np.asarray(look_at((1.6, 0.3, 0.4), (0.0, 0.0, 0.0)))[:3]
RIGHT_DOWN_FORWARD = POSE[:, :3] * [1, -1, -1]


def save(file: Path, value: Any) -> Path:
    file.write_text(json.dumps(value))
    return file


def inria(**changes: Any) -> list[dict[str, Any]]:
    entry = {
        "id": 0, "img_name": "photo", "width": 32, "height": 24, "position": POSE[:, 3].tolist(),
        "rotation": RIGHT_DOWN_FORWARD.tolist(), "fx": 30.0, "fy": 31.0,
    }  # fmt: skip
    return [{**entry, **changes}, entry]


def transforms(**changes: Any) -> dict[str, Any]:
    whole = {
        "camera_model": "OPENCV", "fl_x": 30.0, "fl_y": 31.0, "cx": 15.0, "cy": 12.5, "w": 32, "h": 24, "k1": 0.0,
        "frames": [{"file_path": "a.png", "transform_matrix": [*POSE.tolist(), [0, 0, 0, 1]]}],
    }  # fmt: skip
    return {**whole, **changes}


def test_cameras_of_inria_see_along_their_own_rays(tmp_path: Path) -> None:
    path = load_camera_path(save(tmp_path / "cameras.json", inria()))
    camera = path.cameras[0]
    assert len(path.cameras) == 2
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (30, 31, 16, 12, 32, 24)
    # pixel (u, v) of Inria: camera coordinates ((u - cx) / fx, (v - cy) / fy, 1), world R x + position
    point = RIGHT_DOWN_FORWARD @ [(20 - 16) / 30, (7 - 12) / 31, 1.0] + POSE[:, 3]
    seen = camera.camera_to_world[:, :3].T @ (point - camera.camera_to_world[:, 3])
    found = camera.fx * seen[0] / -seen[2] + camera.cx, -camera.fy * seen[1] / -seen[2] + camera.cy
    np.testing.assert_allclose(found, (20, 7), atol=1e-12)


def test_cameras_of_a_data_set_are_moved_to_the_frame_of_the_run(tmp_path: Path) -> None:
    turn = np.asarray(look_at((0.0, 0.0, 0.0), (1.0, 2.0, 0.5)))[:3, :3]
    matrix, scale = np.column_stack([turn, [0.3, -0.1, 0.2]]), 0.25
    frame = DataparserTransform(matrix, scale)
    file = save(tmp_path / "transforms.json", transforms())
    camera = load_camera_path(file, 1, frame).cameras[0]
    np.testing.assert_allclose(camera.camera_to_world[:, 3], scale * (turn @ POSE[:, 3] + matrix[:, 3]), atol=1e-15)
    np.testing.assert_allclose(camera.camera_to_world[:, :3], turn @ POSE[:, :3], atol=1e-15)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 31, 15, 12.5)
    # what was applied to the poses is part of the run's transform, and undone first (nerfstudio_dataparser.py)
    applied = np.column_stack([np.eye(3)[[0, 2, 1]] * [[1], [1], [-1]], [0.5, 0.0, 0.0]])
    both = matrix @ np.vstack([applied, [0, 0, 0, 1]])
    posed = np.vstack([applied, [0, 0, 0, 1]]) @ np.vstack([POSE, [0, 0, 0, 1]])
    value = transforms(applied_transform=applied.tolist(), applied_scale=2.0)
    value["frames"][0]["transform_matrix"] = posed.tolist()
    moved = load_camera_path(save(file, value), 1, DataparserTransform(both, 2.0 * scale)).cameras[0]
    inner = matrix @ posed
    np.testing.assert_allclose(moved.camera_to_world[:, :3], inner[:, :3], atol=1e-14)
    np.testing.assert_allclose(moved.camera_to_world[:, 3], scale * inner[:, 3], atol=1e-14)


def test_a_command_takes_both(tmp_path: Path) -> None:
    config = write_splatfacto_run(blob_scene(9), tmp_path, timestamp="t", experiment_name="e")
    file = config.parent / "dataparser_transforms.json"
    save(file, {"transform": np.eye(3, 4).tolist(), "scale": 0.5})
    spec = save(tmp_path / "spec.json", {"version": 1, "translation": {"x": [-0.01, 0.01]}})
    for name, value in (("cameras.json", inria()), ("transforms.json", transforms())):
        job = open_job(Settings(config, save(tmp_path / name, value), spec))
        center = job.pose_sets[0].camera.camera_to_world[:, 3]
        np.testing.assert_allclose(center, POSE[:, 3] * (0.5 if name == "transforms.json" else 1.0), atol=1e-15)
    # other data parsers do not undo what the file says was applied
    text = config.read_text()
    assert text.count("nerfstudio_dataparser.Nerfstudio") == 2
    ngp = text.replace("nerfstudio_dataparser.Nerfstudio", "instant_ngp_dataparser.InstantNGP")
    config.write_text(ngp)
    with pytest.raises(InputError, match="with Nerfstudio's or COLMAP's data parser"):
        open_job(Settings(config, tmp_path / "transforms.json", spec))
    # a run of COLMAP's own model: the file has to say how it differs, whatever folder lies beside it
    assert transforms().get("applied_transform") is None
    (tmp_path / "colmap" / "sparse" / "0").mkdir(parents=True)
    config.write_text(text.replace("nerfstudio_dataparser.Nerfstudio", "colmap_dataparser.Colmap"))
    config.write_text(
        config.read_text().replace("colmap_dataparser.Colmap ''", "colmap_dataparser.ColmapDataParser ''")
    )
    with pytest.raises(InputError, match="trained on COLMAP's model") as error:
        open_job(Settings(config, tmp_path / "transforms.json", spec))
    assert error.value.field == "applied_transform"
    applied = save(tmp_path / "applied.json", transforms(applied_transform=np.eye(3, 4).tolist()))
    center = open_job(Settings(config, applied, spec)).pose_sets[0].camera.camera_to_world[:, 3]
    np.testing.assert_allclose(center, 0.5 * POSE[:, 3], atol=1e-15)
    # orienting by pca may turn the transform that is stored, and not the poses
    assert text.count("orientation_method: none") == 1
    config.write_text(text.replace("orientation_method: none", "orientation_method: pca"))
    with pytest.raises(InputError, match="another orientation_method than pca"):
        open_job(Settings(config, tmp_path / "transforms.json", spec))
    open_job(Settings(config, tmp_path / "cameras.json", spec))
    config.write_text(text)
    # without it nothing says where the data set's cameras stand in the run's frame
    file.unlink()
    with pytest.raises(InputError, match=r"beside its dataparser_transforms\.json"):
        open_job(Settings(config, tmp_path / "transforms.json", spec))
    open_job(Settings(config, tmp_path / "cameras.json", spec))


def test_intrinsics_of_a_camera_path(tmp_path: Path) -> None:
    entry = {"camera_to_world": [*POSE.reshape(-1).tolist(), 0, 0, 0, 1], "fx": 40.0, "cy": 11.0}
    value = {"render_height": 24, "render_width": 32, "cx": 15.5, "camera_path": [entry]}
    camera = load_camera_path(save(tmp_path / "path.json", value)).cameras[0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 40, 15.5, 11)


def test_cameras_far_from_the_origin_are_refused(tmp_path: Path) -> None:
    """Nerfstudio computes poses in float32 (nerfstudio_dataparser.py:236): coordinates of a map leave metres open."""
    value = transforms()
    for far, scale, refused in ((0.0, 1.0, False), (5e5, 1e-5, False), (5e5, 0.1, True)):
        place = POSE[:, 3] + far
        value["frames"][0]["transform_matrix"] = [*np.column_stack([POSE[:, :3], place]).tolist(), [0, 0, 0, 1]]
        frame = DataparserTransform(np.column_stack([np.eye(3), np.full(3, -far)]), scale)
        # as Nerfstudio rounds it
        rounded = scale * (place.astype(np.float32) - np.float32(far)) - scale * POSE[:, 3]
        assert (np.abs(rounded).max() > 1e-3) == refused
        file = save(tmp_path / "transforms.json", value)
        if refused:
            with pytest.raises(InputError, match="may move the camera") as error:
                load_camera_path(file, 1, frame)
            assert error.value.field == "frames[0].transform_matrix"
        else:
            camera = load_camera_path(file, 1, frame).cameras[0]
            np.testing.assert_allclose(camera.camera_to_world[:, 3], scale * POSE[:, 3], atol=1e-9)


def test_a_lens_that_nerfstudio_does_not_draw_is_noted(tmp_path: Path) -> None:
    """It reads fov alone (cameras/camera_paths.py:167)."""
    pose = {"camera_to_world": [*POSE.reshape(-1).tolist(), 0, 0, 0, 1]}
    value: dict[str, Any] = {"render_height": 24, "render_width": 32, "camera_path": [pose | {"fov": 50.0}]}
    usual = load_camera_path(save(tmp_path / "path.json", value))
    assert usual.notes == ()
    focal = usual.cameras[0].fx
    same = {"fx": focal, "fy": focal, "cx": 16.0, "cy": 12.0}
    for lens, noted in ((same, False), ({"fx": 40.0}, True), ({"fy": 1.01 * focal}, True), ({"cx": 16.5}, True)):
        for entry, path in ((lens, {}), ({"fx": None}, lens)):
            value["camera_path"] = [pose | {"fov": 50.0} | entry]
            found = load_camera_path(save(tmp_path / "path.json", value | path))
            assert [note.partition(":")[0] for note in found.notes] == ["camera_path[0]"] * noted
            # null states nothing: the path's lens counts
            assert all(getattr(found.cameras[0], key) == number for key, number in lens.items())
    # it draws no entry without fov
    assert load_camera_path(save(tmp_path / "path.json", value | {"camera_path": [pose | same]})).notes == ()


def test_what_all_frames_have_comes_first(tmp_path: Path) -> None:
    """Nerfstudio reads a frame's own intrinsics where the file states none for all frames."""
    value = transforms()
    value["frames"][0] |= {"fl_x": 60.0, "cx": 3.0, "cy": 4.0, "w": 64}
    del value["cy"]
    camera = load_camera_path(save(tmp_path / "t.json", value), 1, DataparserTransform(np.eye(3, 4), 1.0)).cameras[0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width) == (30, 31, 15, 4, 32)


def test_axes_of_colmap_are_applied_where_nothing_is_stated(tmp_path: Path) -> None:
    """Data sets of former versions, which have COLMAP's model beside them (nerfstudio_dataparser.py)."""
    (tmp_path / "colmap" / "sparse" / "0").mkdir(parents=True)
    swapped = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
    matrix = np.column_stack([np.asarray(look_at((0.0, 0.0, 0.0), (1.0, 2.0, 0.5)))[:3, :3], [0.3, -0.1, 0.2]])
    both = DataparserTransform(matrix @ np.vstack([swapped, [0, 0, 0, 1]]), 1.0)
    file = tmp_path / "transforms.json"
    for value, inner in ((transforms(), matrix), (transforms(applied_transform=np.eye(3, 4).tolist()), both.matrix)):
        camera = load_camera_path(save(file, value), 1, both).cameras[0]
        np.testing.assert_allclose(camera.camera_to_world, inner @ np.vstack([POSE, [0, 0, 0, 1]]), atol=1e-14)


BAD: dict[str, tuple[Any, str]] = {
    "distorted": (transforms(k1=0.01), "distorted"),
    "distorted frame": (
        transforms(frames=[{"transform_matrix": [*POSE.tolist(), [0, 0, 0, 1]], "p2": -1e-3}]), "frames[0].p2",
    ),
    "oriented by pca": (transforms(orientation_override="pca"), "orientation_override"),
    "a frame cannot straighten": (
        transforms(k1=0.01, frames=[{"transform_matrix": [*POSE.tolist(), [0, 0, 0, 1]], "k1": 0.0}]), "distorted",
    ),
    "a list of distortions": (transforms(distortion_params=[0.1, 0, 0, 0, 0, 0]), "distortion_params"),
    "a frame's list of distortions": (
        transforms(frames=[{"transform_matrix": [*POSE.tolist(), [0, 0, 0, 1]], "distortion_params": [0, 0.1]}]),
        "frames[0].distortion_params",
    ),
    "a frame cannot hide a fisheye": (
        transforms(
            camera_model="OPENCV_FISHEYE",
            frames=[{"transform_matrix": [*POSE.tolist(), [0, 0, 0, 1]], "camera_model": "OPENCV"}],
        ),
        "camera_model",
    ),
    "fisheye": (transforms(camera_model="OPENCV_FISHEYE"), "camera_model"),
    "no frames": (transforms(frames=[]), "frames"),
    "frame of text": (transforms(frames=["a"]), "frames[0]"),
    "no intrinsics": ({k: v for k, v in transforms().items() if k != "fl_x"}, "fl_x"),
    "no size": ({k: v for k, v in transforms().items() if k != "h"}, "h"),
    "short matrix": (transforms(frames=[{"transform_matrix": [[1, 0, 0, 0]] * 2}]), "transform_matrix"),
    "singular": (transforms(applied_transform=[[0, 0, 0, 0]] * 3), "applied_transform"),
    "scale 0": (transforms(applied_scale=0), "applied_scale"),
    "no rotation": (transforms(frames=[{"transform_matrix": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}]), "frames[0]"),
    "inria: position": (inria(position=[0, 0]), "position"),
    "inria: focal length": (inria(fx=0.0), "focal length"),
    "inria: focal length of text": (inria(fx="30"), "fx"),
    "inria: width": (inria(width=32.5), "width"),
    "inria: mirrored": (inria(rotation=POSE[:, :3].tolist()[::-1]), "[0]"),
    "focal length below 0": (
        {
            "render_height": 4, "render_width": 4,
            "camera_path": [{"camera_to_world": [*POSE.tolist(), [0, 0, 0, 1]], "fx": -1}],
        },
        "fx",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_cameras_end_in_one_line(name: str, tmp_path: Path) -> None:
    value, mention = BAD[name]
    with pytest.raises(InputError) as caught:
        load_camera_path(save(tmp_path / "file.json", value), 1, DataparserTransform(np.eye(3, 4), 1.0))
    assert mention in str(caught.value) and "file.json" in str(caught.value) and caught.value.fix


def test_transforms_without_a_run_are_refused_by_name(tmp_path: Path) -> None:
    file = save(tmp_path / "transforms.json", transforms())
    for load in (lambda: load_camera_path(file), lambda: nsa.load_camera_path(file)):
        with pytest.raises(InputError, match=r"data set's transforms\.json"):
            load()
