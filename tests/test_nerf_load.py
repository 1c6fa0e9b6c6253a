"""Vanilla-NeRF runs from files: what is read, what is refused, and the picture that Nerfstudio itself shows."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfs import UNIFORM, NerfNetwork, other_view, tiny_scene, view
from nerfstudio_runs import START
from scene_files import change, checkpoint_of
from test_cli import one_line

from ns_abstract.api.files import Settings, open_job
from ns_abstract.cli import render as render_command
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, path_json
from ns_abstract.io.errors import InputError
from ns_abstract.methods import runs
from ns_abstract.methods.load import load_any
from ns_abstract.methods.nerf.load import load_nerf
from ns_abstract.methods.nerf.render import NerfRenderer, Sampling
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.methods.program_options import ProgramOptions


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_nerf_run(tiny_scene(1), tmp_path / "runs", timestamp="t", experiment_name="tiny")


def test_a_run_is_read_as_it_was_written(run: Path) -> None:
    scene, written = load_any(run), tiny_scene(1)
    assert isinstance(scene, NerfScene)
    for found, expected in ((scene.fine, written.fine), (scene.coarse, written.coarse)):
        assert [layer.skip for layer in found.base] == [layer.skip for layer in expected.base] == [False, True, False]
        for a, b in zip(found.arrays(), expected.arrays(), strict=True):
            np.testing.assert_array_equal(a, b)
    assert (scene.near, scene.far, scene.coarse_samples, scene.importance_samples) == (0.0, 4.0, 64, 128)
    np.testing.assert_array_equal(scene.background, np.ones(3))


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize(
    ("edit", "fragments"),
    [
        (lambda s: s.pop("_model.field_fine.mlp_base.layers.0.weight"), ("field_fine.mlp_base.layers.0", "missing")),
        (lambda s: s.pop("_model.field_fine.mlp_head.layers.1.bias"), ("mlp_head.layers.1.bias", "missing")),
        (lambda s: s.update({"_model.field_fine.mlp_base.layers.1.weight": torch.zeros(16, 20)}), ("takes 20 inputs",)),
        (lambda s: s.update({"_model.field_fine.mlp_base.layers.0.weight": torch.zeros(16, 62)}), ("62 encoded",)),
        (lambda s: s.update({"_model.field_fine.field_heads.0.net.weight": torch.zeros(4, 8)}), ("not those of",)),
        (lambda s: s["_model.field_coarse.mlp_base.layers.0.bias"].fill_(float("nan")), ("not finite",)),
        (lambda s: [s.pop(k) for k in list(s) if "field_fine" in k], ("no NeRF fields",)),
        (lambda s: s.update({"_model.field_fine.mlp_base.layers.0.bias": "text"}), ("not a tensor",)),
    ],
)
def test_damaged_checkpoints(run: Path, edit: Callable[[dict], None], fragments: tuple[str, ...]) -> None:
    change(run, edit)
    with pytest.raises(InputError) as error:
        load_any(run)
    for fragment in (str(checkpoint_of(run)), *fragments):
        assert fragment in str(error.value)


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize(
    ("old", "new", "fragment"),
    [
        ("enable_temporal_distortion: false", "enable_temporal_distortion: true", "scenes that move"),
        ("enable_collider: true", "enable_collider: false", "enable_collider"),
        ("far_plane: 4.0", "far_plane: -1.0", "far_plane"),
        ("      far_plane: 4.0\n", "", "far_plane"),
        ("far_plane: 4.0", "far_plane: .nan", "far_plane"),
        ("background_color: white", "background_color: last_sample", "background_color"),
        ("background_color: white", "background_color: White", "random, white, black, red, green, blue"),
        ("background_color: white", "background_color: purple", "random, white, black, red, green, blue"),
        ("num_coarse_samples: 64", "num_coarse_samples: 0", "num_coarse_samples"),
    ],
)
def test_configurations_that_cannot_be_bounded(run: Path, old: str, new: str, fragment: str) -> None:
    text = run.read_text()
    assert old in text
    run.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=fragment):
        load_any(run)


@pytest.mark.parametrize(("name", "color"), [("random", [0, 0, 0]), ("green", [0, 1, 0])])
def test_backgrounds_are_those_that_nerfstudio_shows(run: Path, name: str, color: list[float]) -> None:
    run.write_text(run.read_text().replace("background_color: white", f"background_color: {name}"))
    assert load_any(run).background.tolist() == color


# ---------------------------------------------------------------- command line


@pytest.fixture
def inputs(run: Path, tmp_path: Path) -> dict[str, Path]:
    pose = np.eye(4)
    pose[:3] = view().camera_to_world
    path, spec = tmp_path / "path.json", tmp_path / "spec.json"
    path.write_text(json.dumps(path_json([KeyframeCamera(pose, 40.0, 3, 4)])))
    spec.write_text(json.dumps({"version": 1, "rotation": {"yaw": 0.002}}))
    return {"load_config": run, "camera_path_filename": path, "perturbation_filename": spec}


def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: list[Any]) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["command", *map(str, options)])
    with pytest.raises(SystemExit) as leave:
        render_command.main()
    assert isinstance(leave.value.code, int)
    return leave.value.code, capsys.readouterr().err


def flags(inputs: dict[str, Path], output: Path, *more: Any) -> list[Any]:
    found: list[Any] = ["--output-dir", output]
    for name, value in inputs.items():
        found += ["--" + name.replace("_", "-"), value]
    return [*found, *more]


@pytest.mark.slow
def test_end_to_end_and_resume(inputs: dict[str, Path], tmp_path: Path, monkeypatch, capsys) -> None:
    out = tmp_path / "out"
    options = flags(inputs, out, "--num-samples", 16, "--time-budget", 60, "--target-ratio", 2, "--save-cells")
    assert call(monkeypatch, capsys, options)[0] == 0
    report = json.loads((out / "report.json").read_text())
    assert report["guarantee"] == "real-sound"
    assert report["renderer"]["samples"] == 16 and report["renderer"]["name"] == "nerf-uniform"
    assert any("Algorithm 2" in line for line in report["plan"])
    with np.load(out / "frame_00000.npz", allow_pickle=False) as stored:
        lower, upper = stored["lower"], stored["upper"]
    job = open_job(Settings(**inputs, program=ProgramOptions(num_samples=16)))
    frame = job.frame(0)
    for values in frame.box.sample(40, np.random.default_rng(1)):
        picture = frame.renderer.image(frame.camera, frame.pose_set.pose(values))
        assert (lower <= picture).all() and (picture <= upper).all()
    code, text = call(monkeypatch, capsys, [*options, "--resume"])
    assert code == 0 and "kept from before" in text
    # other samples are another program: nothing of the old one is kept
    changed = [17 if option == 16 else option for option in options]
    assert "kept from before" not in call(monkeypatch, capsys, [*changed, "--resume"])[1]


@pytest.mark.parametrize(
    ("more", "fragment"),
    [
        (("--renderer", "gsplat"), "--renderer"),
        (("--arithmetic", "float32"), "--arithmetic"),
        (("--num-samples", 0), "--num-samples"),
        (("--near-plane", 9.0), "--near-plane"),
        (("--near-plane", "nan"), "--near-plane"),
    ],
)
def test_options_that_do_not_fit(inputs, tmp_path: Path, monkeypatch, capsys, more: tuple, fragment: str) -> None:
    one_line(*call(monkeypatch, capsys, flags(inputs, tmp_path / "out", *more)), fragment)


def test_damaged_runs_are_one_line(inputs, tmp_path: Path, monkeypatch, capsys) -> None:
    checkpoint = checkpoint_of(inputs["load_config"])
    checkpoint.write_bytes(checkpoint.read_bytes()[:5000])
    one_line(*call(monkeypatch, capsys, flags(inputs, tmp_path / "out")), str(checkpoint))


@pytest.mark.parametrize(("option", "value"), [("num_samples", 8), ("device", "cpu")])
def test_options_of_nerfs_alone(blobs, tmp_path: Path, monkeypatch, capsys, option: str, value: object) -> None:
    options = blobs.options(tmp_path / "out", **{option: value})
    one_line(*call(monkeypatch, capsys, options), "--" + option.replace("_", "-"))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there_is_one_line(inputs, tmp_path: Path, monkeypatch, capsys) -> None:
    one_line(*call(monkeypatch, capsys, flags(inputs, tmp_path / "out", "--device", "cuda")), "--device")


def test_the_papers_renderer_is_black_behind(inputs: dict[str, Path]) -> None:
    assert open_job(Settings(**inputs, program=ProgramOptions("paper"))).method.program["name"] == "paper-nerf"
    frame = open_job(Settings(**inputs, program=ProgramOptions("paper"))).frame(0)
    assert frame.renderer.sampling.background == (0.0, 0.0, 0.0)
    assert open_job(Settings(**inputs)).frame(0).renderer.sampling.background == (1.0, 1.0, 1.0)


# ---------------------------------------------------------------- the concrete renderer


def test_pictures_do_not_depend_on_how_they_are_cut() -> None:
    scene, camera = tiny_scene(2), view(5, 4)
    renderer = NerfRenderer(scene, UNIFORM)
    whole = renderer.image(camera, camera.camera_to_world)
    single = renderer.pixels(camera, camera.camera_to_world, np.array([[3, 1]]))
    np.testing.assert_allclose(whole[3, 1], single[0], atol=1e-13)


# Runs in its own process: Nerfstudio changes global state, and takes paths from the working directory.
NERFSTUDIO = START + textwrap.dedent(
    """
    import json
    import sys
    from pathlib import Path

    import numpy as np
    import torch

    try:
        from nerfstudio.cameras.camera_paths import get_path_from_json
        from nerfstudio.utils.eval_utils import eval_setup
    except Exception as error:
        print(f"nerfstudio does not import: {error!r}", file=sys.stderr)
        raise SystemExit(77)

    pipeline = eval_setup(Path(sys.argv[1]))[1]
    cameras = get_path_from_json(json.loads(Path(sys.argv[2]).read_text()))
    with torch.no_grad():
        images = [pipeline.model.get_outputs_for_camera(cameras[k : k + 1])["rgb_fine"].numpy() for k in range(2)]
    np.save(sys.argv[3], np.stack(images))
    """
)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("nerfstudio") is None, reason="nerfstudio is not installed")
def test_nerfstudio_shows_the_same_picture(tmp_path: Path) -> None:
    """Full-size fields with different weights, opaque enough for the importance samples to matter."""

    def weights(seed: int):
        torch.manual_seed(seed)
        found = NerfNetwork().weights()
        density = dataclasses.replace(
            found.density, weight=60.0 * found.density.weight, bias=np.full(1, 2.0, np.float32)
        )
        color = dataclasses.replace(found.color, weight=8.0 * found.color.weight)
        return dataclasses.replace(found, density=density, color=color)

    scene = NerfScene(weights(0), weights(1), background=np.array([1.0, 1.0, 1.0], np.float32))
    config = write_nerf_run(scene, tmp_path, timestamp="t", experiment_name="e")
    views = []
    for camera in (view(), other_view()):
        pose = np.eye(4)
        pose[:3] = camera.camera_to_world
        views.append(KeyframeCamera(pose, 50.0, 12, 16))
    path, images = tmp_path / "path.json", tmp_path / "images.npy"
    path.write_text(json.dumps(path_json(views)))
    result = subprocess.run(
        [sys.executable, "-c", NERFSTUDIO, str(config.relative_to(tmp_path)), str(path), str(images)],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    if result.returncode == 77:
        pytest.skip(result.stderr.strip().splitlines()[-1])
    assert result.returncode == 0, result.stderr[-3000:]
    expected = np.load(images)
    assert expected.std() > 0.03
    loaded = load_nerf(runs.read_config(config))
    sampling = Sampling("hierarchical", loaded.near, loaded.far, 64, 128, (1.0, 1.0, 1.0))
    renderer = NerfRenderer(loaded, sampling, torch.float32)
    focal = 0.5 * 12 / np.tan(np.radians(50.0) / 2.0)
    for k, camera in enumerate((view(16, 12), other_view(16, 12))):
        camera = dataclasses.replace(camera, fx=focal, fy=focal)
        found = renderer.image(camera, camera.camera_to_world)
        assert np.abs(found - expected[k]).max() <= 1e-5
        # what the importance samples do is visible
        plain = NerfRenderer(loaded, dataclasses.replace(sampling, kind="uniform"), torch.float32)
        assert np.abs(plain.image(camera, camera.camera_to_world) - expected[k]).max() > 1e-3
