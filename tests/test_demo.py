"""The demonstration scene and the run folder written from it."""

from __future__ import annotations

import dataclasses
import importlib.util
import io
import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from benchmark_scripts import script
from nerfstudio_runs import START
from PIL import Image

from ns_abstract.demo.paths import (
    TARGET,
    airfield_orbit,
    airfield_path,
    airfield_views,
    dataset_views,
    write_airfield_paths,
)
from ns_abstract.demo.scenes import DATA, splat_scene
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.scene import DataparserTransform, SplatScene
from ns_abstract.methods.splat.write import write_splatfacto_run

airfield_module = script("airfield")
GROUND, PLANE_LENGTH = airfield_module.GROUND, airfield_module.PLANE_LENGTH
ARRAYS = ("means", "log_scales", "quats", "opacity_logits", "sh", "background")
TIMESTAMP = "2026-11-21_000000"


@pytest.fixture(scope="module")
def scene() -> SplatScene:
    return splat_scene("airfield")


@pytest.fixture(scope="module")
def run(scene: SplatScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_splatfacto_run(scene, tmp_path_factory.mktemp("demo"), timestamp=TIMESTAMP, experiment_name="airfield")


def small_scene(**changes: object) -> SplatScene:
    rng = np.random.default_rng(3)
    values = {
        "means": rng.normal(size=(7, 3)),
        "log_scales": rng.normal(size=(7, 3)) - 3,
        "quats": rng.normal(size=(7, 4)),
        "opacity_logits": rng.normal(size=7),
        "sh": rng.normal(size=(7, 1, 3)),
    }
    arrays = {name: value.astype(np.float32) for name, value in values.items()}
    return SplatScene(**(arrays | changes))  # type: ignore[arg-type]


def load_checkpoint(config: Path) -> dict:
    torch = pytest.importorskip("torch")
    file = config.parent / "nerfstudio_models" / "step-000029999.ckpt"
    return torch.load(file, map_location="cpu", weights_only=True)


def read_png(data: bytes) -> np.ndarray:
    """[H, W, 3] of an 8-bit RGB PNG."""
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        assert image.mode == "RGB"
        return np.asarray(image)


# ---------------------------------------------------------------- scene


def test_scene_is_finite_and_sized(scene: SplatScene) -> None:
    assert 12_000 <= scene.count <= 20_000
    for name in ARRAYS:
        assert np.isfinite(getattr(scene, name)).all(), name
    np.testing.assert_allclose(np.linalg.norm(scene.quats, axis=1), 1.0, atol=1e-5)
    assert np.exp(scene.log_scales).min() > 1e-4
    opacity = 1.0 / (1.0 + np.exp(-scene.opacity_logits))
    assert opacity.min() > 0.2
    assert opacity.max() < 0.99


@pytest.mark.parametrize("name", ["airfield", "gate"])
def test_the_script_makes_what_ships(name: str) -> None:
    """But for the last digit, which libraries of linear algebra and elementary functions may give otherwise."""
    shipped, made = splat_scene(name), getattr(script(name), name)(0)
    for array in ARRAYS:
        np.testing.assert_allclose(getattr(shipped, array), getattr(made, array), rtol=1e-5, atol=1e-6, err_msg=array)
    for given in ("color_model", "sh_degree", "rasterize_mode", "name"):
        assert getattr(shipped, given) == getattr(made, given)


def test_what_ships_is_small() -> None:
    assert sum(file.stat().st_size for file in DATA.iterdir() if file.suffix in (".npz", ".onnx", ".json")) < 2_000_000


def test_gloss_uses_every_band_up_to_degree_two(scene: SplatScene) -> None:
    assert (scene.color_model, scene.sh_degree) == ("sh", 2)
    glossy = np.abs(scene.sh[:, 1:]).max(axis=(1, 2)) > 0
    assert 0.2 < glossy.mean() < 0.8
    assert (np.abs(scene.sh[glossy, 1:]).mean(axis=(0, 2)) > 1e-3).all()


def test_colours_stay_near_the_displayable_range(scene: SplatScene) -> None:
    for view in airfield_views():
        direction = scene.means - view.camera_to_world[:3, 3]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        basis = airfield_module._sh_basis(direction)
        colour = 0.5 + np.einsum("nk,nkc->nc", basis, scene.sh.astype(np.float64))
        assert colour.min() > -0.2
        assert colour.max() < 1.3


def test_quaternions_rebuild_their_frames() -> None:
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(500, 3))
    normals[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    tangents = np.cross(normals, rng.normal(size=(500, 3)))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    w, x, y, z = airfield_module._quaternions(tangents, normals).T
    first = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    np.testing.assert_allclose(first, tangents, atol=1e-12)
    np.testing.assert_allclose(third, normals, atol=1e-12)


def test_aircraft_flies_above_the_runway(scene: SplatScene) -> None:
    above = scene.means[:, 2] > GROUND + 0.15
    near = np.all(np.abs(scene.means - TARGET) < 0.55 * PLANE_LENGTH, axis=1)
    aircraft = scene.means[near & above]
    assert len(aircraft) > 4000
    assert 0.9 * PLANE_LENGTH < np.ptp(aircraft[:, 0]) < 1.1 * PLANE_LENGTH
    assert abs(aircraft[:, 1].mean()) < 0.01  # left-right symmetry
    low = scene.means[~near & (np.abs(scene.means) < 1).all(axis=1)]
    assert (low[:, 2] >= GROUND - 0.01).all()


def test_surfaces_face_outwards() -> None:
    aircraft = airfield_module._aircraft(0.02, gear=False)
    wing = aircraft.keep((np.abs(aircraft.points[:, 1]) > 0.2) & (np.abs(aircraft.points[:, 1]) < 0.4))
    upper = wing.normals[:, 2] > 0.3
    lower = wing.normals[:, 2] < -0.3
    for side in (-1, 1):
        at = np.sign(wing.points[:, 1]) == side
        assert wing.points[at & upper, 2].mean() > wing.points[at & lower, 2].mean()


# ---------------------------------------------------------------- paths


def test_path_has_the_keys_of_the_viewer() -> None:
    path = airfield_path()
    assert set(path) == {
        "default_fov", "default_transition_sec", "keyframes", "camera_type", "render_height", "render_width",
        "fps", "seconds", "is_cycle", "smoothness_value", "camera_path",
    }  # fmt: skip
    assert (path["camera_type"], path["render_height"], path["render_width"]) == ("perspective", 200, 200)
    assert len(path["camera_path"]) == 5
    for frame in path["camera_path"]:
        assert set(frame) == {"camera_to_world", "fov", "aspect"}
        pose = np.array(frame["camera_to_world"]).reshape(4, 4)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) > 0
        np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])


def test_views_frame_the_aircraft(scene: SplatScene) -> None:
    near = np.all(np.abs(scene.means - TARGET) < 0.5 * PLANE_LENGTH, axis=1)
    aircraft = scene.means[near & (scene.means[:, 2] > GROUND + 0.1)]
    for view in airfield_views():
        local = (aircraft - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]
        screen = local[:, :2] / -local[:, 2:] / np.tan(0.5 * np.deg2rad(view.fov))
        assert (local[:, 2] < 0).all()
        assert np.abs(screen).max() < 1.0
        assert np.ptp(screen[:, 0]) > 1.2  # more than 60 % of the width


def test_path_files(tmp_path: Path) -> None:
    files = write_airfield_paths(tmp_path)
    assert sorted(f.name for f in tmp_path.iterdir()) == [
        "SPEC.json", "camera_path.json", "camera_path_orbit.json",
    ]  # fmt: skip
    spec = json.loads(files["spec"].read_text())
    assert spec == {
        "version": 1,
        "frame": "camera",
        "translation": {"x": 0.02},
        "sweep": "keyframes",
    }
    orbit = json.loads(files["orbit"].read_text())
    assert orbit == airfield_orbit()
    assert orbit["perturbation"]["orbit"]["axis"] == [0, 0, 1]
    assert json.loads(files["path"].read_text()) == airfield_path()


# ---------------------------------------------------------------- run folder


def test_file_layout(run: Path) -> None:
    folder = run.parents[3]
    found = sorted(str(f.relative_to(folder)) for f in folder.rglob("*") if f.is_file())
    base = f"airfield/splatfacto/{TIMESTAMP}"
    assert found == sorted(
        [f"{base}/config.yml", f"{base}/dataparser_transforms.json",
         f"{base}/nerfstudio_models/step-000029999.ckpt", "data/transforms.json"]
        + [f"data/images/{k:03d}.png" for k in range(10)]
    )  # fmt: skip
    assert run == folder / base / "config.yml"


def test_checkpoint_holds_the_scene(run: Path, scene: SplatScene) -> None:
    checkpoint = load_checkpoint(run)
    assert list(checkpoint) == ["step", "pipeline", "optimizers", "schedulers", "scalers"]
    assert checkpoint["step"] == 29999
    pipeline = {k: v.numpy() for k, v in checkpoint["pipeline"].items()}
    gaussians = {k.rsplit(".", 1)[1]: v for k, v in pipeline.items() if ".gauss_params." in k}
    n = scene.count
    assert {k: v.shape for k, v in gaussians.items()} == {
        "features_dc": (n, 3), "features_rest": (n, 15, 3), "means": (n, 3),
        "opacities": (n, 1), "quats": (n, 4), "scales": (n, 3),
    }  # fmt: skip
    assert all(v.dtype == np.float32 for v in pipeline.values())
    np.testing.assert_array_equal(gaussians["means"], scene.means)
    np.testing.assert_array_equal(gaussians["scales"], scene.log_scales)
    np.testing.assert_array_equal(gaussians["quats"], scene.quats)
    np.testing.assert_array_equal(gaussians["opacities"][:, 0], scene.opacity_logits)
    np.testing.assert_array_equal(gaussians["features_dc"], scene.sh[:, 0])
    np.testing.assert_array_equal(gaussians["features_rest"][:, :8], scene.sh[:, 1:])
    assert not gaussians["features_rest"][:, 8:].any()
    assert pipeline["_model.device_indicator_param"].shape == (0,)
    assert sum(".lpips." in k for k in pipeline) == 20
    assert set(checkpoint["optimizers"]) == set(gaussians)


def test_equal_scenes_give_equal_checkpoints(tmp_path: Path, run: Path) -> None:
    again = write_splatfacto_run(splat_scene("airfield"), tmp_path, timestamp=TIMESTAMP, experiment_name="airfield")
    name = "nerfstudio_models/step-000029999.ckpt"
    assert (run.parent / name).read_bytes() == (again.parent / name).read_bytes()
    assert run.read_bytes() == again.read_bytes()


def tolerant_yaml(text: str) -> dict:
    """Read a config without building any object: every tag becomes plain data."""
    yaml = pytest.importorskip("yaml")

    class Loader(yaml.SafeLoader):
        pass

    def plain(loader: yaml.SafeLoader, suffix: str, node: yaml.Node) -> object:
        if isinstance(node, yaml.MappingNode):
            return loader.construct_mapping(node, deep=True)
        if isinstance(node, yaml.SequenceNode):
            return loader.construct_sequence(node, deep=True)
        return loader.construct_scalar(node)  # type: ignore[arg-type]

    Loader.add_multi_constructor("tag:yaml.org,2002:python/", plain)
    return yaml.load(text, Loader=Loader)


def test_config_reads_without_building_objects(run: Path, scene: SplatScene) -> None:
    config = tolerant_yaml(run.read_text())
    assert config["method_name"] == "splatfacto"
    assert (config["experiment_name"], config["timestamp"]) == ("airfield", TIMESTAMP)
    assert config["data"] == ["data"]
    assert config["output_dir"] == []
    model = config["pipeline"]["model"]
    assert (model["sh_degree"], model["background_color"], model["rasterize_mode"]) == (3, "white", "classic")
    assert (model["random_init"], model["num_random"]) == (True, scene.count)
    parser = config["pipeline"]["datamanager"]["dataparser"]
    assert (parser["load_3D_points"], parser["orientation_method"]) == (False, "none")
    assert json.loads((run.parent / "dataparser_transforms.json").read_text()) == {
        "transform": np.eye(3, 4).tolist(),
        "scale": 1.0,
    }


@pytest.mark.parametrize(
    ("background", "expected"),
    [
        ([0, 0, 0], "black"),
        ([0.1490, 0.1647, 0.2157], "random"),
        ([0.5, 0.25, 1.0], [0.5, 0.25, 1.0]),
    ],
)
def test_other_scenes_keep_their_settings(tmp_path: Path, background: list[float], expected: object) -> None:
    matrix = np.array([[0, -1, 0, 0.5], [1, 0, 0, -0.25], [0, 0, 1, 2.0]])
    scene = small_scene(
        color_model="sigmoid",
        rasterize_mode="antialiased",
        background=np.array(background, np.float32),
        dataparser=DataparserTransform(matrix, 0.5),
    )
    config = write_splatfacto_run(scene, tmp_path, timestamp="2026", experiment_name="x: 'y' \"z\"")
    read = tolerant_yaml(config.read_text())
    assert (read["timestamp"], read["experiment_name"]) == ("2026", "x: 'y' \"z\"")
    model = read["pipeline"]["model"]
    assert (model["sh_degree"], model["rasterize_mode"]) == (0, "antialiased")
    assert model["background_color"] == expected
    assert load_checkpoint(config)["pipeline"]["_model.gauss_params.features_rest"].shape == (7, 0, 3)
    transform = json.loads((config.parent / "dataparser_transforms.json").read_text())
    assert transform == {"transform": matrix.tolist(), "scale": 0.5}


def test_dataset_images_come_from_the_renderer(tmp_path: Path) -> None:
    views = [dataclasses.replace(v, height=4, width=6) for v in dataset_views(3)]
    ramp = np.linspace(-0.5, 1.5, 4 * 6 * 3).reshape(4, 6, 3)
    seen: list[KeyframeCamera] = []

    def render(view: KeyframeCamera) -> np.ndarray:
        seen.append(view)
        return ramp

    write_splatfacto_run(small_scene(), tmp_path, timestamp="t", experiment_name="e", views=views, render=render)
    assert seen == views
    meta = json.loads((tmp_path / "data" / "transforms.json").read_text())
    assert (meta["h"], meta["w"], len(meta["frames"])) == (4, 6, 3)
    np.testing.assert_allclose(meta["fl_y"], 2.0 / np.tan(np.deg2rad(22.5)))
    image = read_png((tmp_path / "data" / meta["frames"][0]["file_path"]).read_bytes())
    np.testing.assert_array_equal(image, np.rint(np.clip(ramp, 0, 1) * 255))


@pytest.mark.parametrize("name", ["", "..", "a/b", "a\\b", "a\nb"])
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="timestamp"):
        write_splatfacto_run(small_scene(), tmp_path, timestamp=name, experiment_name="e")
    assert not list(tmp_path.iterdir())


# Runs in its own process: Nerfstudio changes global state, and takes paths from the working directory.
NERFSTUDIO = START + textwrap.dedent(
    """
    import sys
    from pathlib import Path

    import numpy as np
    import torch

    try:
        from nerfstudio.utils.eval_utils import eval_setup
    except Exception as error:
        print(f"nerfstudio does not import: {error!r}", file=sys.stderr)
        raise SystemExit(77)

    config, pipeline, checkpoint, step = eval_setup(Path(sys.argv[1]))
    model = pipeline.model
    np.savez(sys.argv[2], step=step, background=model.background_color.numpy(),
             **{name: value.detach().numpy() for name, value in model.gauss_params.items()})
    outputs = pipeline.datamanager.train_dataparser_outputs
    outputs.save_dataparser_transform(Path(sys.argv[3]))
    image = pipeline.datamanager.train_dataset.get_data(0)["image"]
    assert tuple(image.shape) == (200, 200, 3), image.shape
    """
)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("nerfstudio") is None, reason="nerfstudio is not installed")
@pytest.mark.parametrize("moved", [False, True])
def test_nerfstudio_itself_loads_the_run(run: Path, scene: SplatScene, tmp_path: Path, moved: bool) -> None:
    folder = run.parents[3]
    written = scene
    if moved:
        folder = tmp_path / "elsewhere"
        written = small_scene(
            rasterize_mode="antialiased",
            background=np.array([0.5, 0.25, 1.0], np.float32),
            dataparser=DataparserTransform(np.array([[0, -1, 0, 0.5], [1, 0, 0, 0.0], [0, 0, 1, 2.0]]), 0.5),
        )
        config = write_splatfacto_run(written, tmp_path / "first", timestamp="t", experiment_name="e")
        (tmp_path / "first").rename(folder)
        run = folder / config.relative_to(tmp_path / "first")
    arrays, transform = tmp_path / "arrays.npz", tmp_path / "transforms.json"
    result = subprocess.run(
        [sys.executable, "-c", NERFSTUDIO, str(run.relative_to(folder)), str(arrays), str(transform)],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    if result.returncode == 77:
        pytest.skip(result.stderr.strip().splitlines()[-1])
    assert result.returncode == 0, result.stderr[-3000:]
    found = np.load(arrays)
    assert found["step"] == 29999
    np.testing.assert_array_equal(found["background"], written.background)
    np.testing.assert_array_equal(found["means"], written.means)
    np.testing.assert_array_equal(found["scales"], written.log_scales)
    np.testing.assert_array_equal(found["quats"], written.quats)
    np.testing.assert_array_equal(found["opacities"][:, 0], written.opacity_logits)
    np.testing.assert_array_equal(found["features_dc"], written.sh[:, 0])
    np.testing.assert_array_equal(found["features_rest"][:, : written.sh.shape[1] - 1], written.sh[:, 1:])
    assert json.loads(transform.read_text()) == json.loads((run.parent / "dataparser_transforms.json").read_text())
