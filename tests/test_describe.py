"""``ns-abstract-render --describe``, and sets given by --translation and --rotation."""

from __future__ import annotations

import json
import math
import re
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import TIMESTAMP, InProcess, Inputs, blob_scene
from nerfs import tiny_scene

import ns_abstract as nsa
from ns_abstract.api.files import Settings, open_job
from ns_abstract.cli import render as render_command
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.write import write_nerf_run

Call = Callable[[list[str]], tuple[int, str, str]]


@pytest.fixture
def call(in_process: InProcess) -> Call:
    """Runs the command in this process: exit code, stdout and stderr."""
    return partial(in_process, render_command.main)


def numbers(text: str, pattern: str) -> list[float]:
    found = re.search(pattern, text)
    assert found, text
    return [float(part) for part in found.groups()]


@pytest.mark.slow
def test_describe_tells_units_distances_and_pixels(blobs: Inputs, call: Call, tmp_path: Path) -> None:
    options = [
        "--load-config", str(blobs.config), "--camera-path-filename", str(blobs.path), "--describe",
        "--translation", "0.03", "0", "0", "--rotation", "0", "1", "0", "--angle-units", "degrees",
        "--units", "dataset",
    ]  # fmt: skip
    code, text, _ = call(options)
    assert code == 0 and "\nset        of every frame:" in text
    scale = open_job(Settings(blobs.config, blobs.path, blobs.spec)).method.dataset_scale
    (told,) = numbers(text, r"1 unit of the data set \(transforms.json\) = ([\d.e-]+) normalised")
    assert told == pytest.approx(scale, rel=1e-3)
    assert numbers(text, r"1 cm = ([\d.e-]+)")[0] == pytest.approx(0.01 * scale, rel=1e-3)
    original, radius = numbers(text, r"x ± ([\d.e-]+) units of the data set \(± ([\d.e-]+) normalised units\)")
    assert (radius, original) == (pytest.approx(0.03 * scale, rel=1e-3), pytest.approx(0.03, rel=1e-3))
    degrees, angle = numbers(text, r"pitch ± ([\d.e-]+) degrees \(± ([\d.e-]+) rad\)")
    assert "is this what you mean" not in text
    assert (angle, degrees) == (pytest.approx(math.radians(1.0), rel=1e-3), 1.0)

    # by hand: the first camera's picture of all means
    camera = load_camera_path(blobs.path).cameras[0]
    pose = camera.camera_to_world
    x, y, z = np.diag([1.0, -1.0, -1.0]) @ pose[:, :3].T @ (blob_scene().means.astype(np.float64) - pose[:, 3]).T
    inside = (abs(camera.fx * x / z) < camera.cx) & (abs(camera.fy * y / z) < camera.cy) & (z > 0.01)
    wanted = np.quantile(z[inside], [0.05, 0.5, 0.95])
    pattern = r"frame 0: .*\n.*: near ([\d.]+) \([\d.]+\), middle ([\d.]+) \([\d.]+\), far ([\d.]+)"
    np.testing.assert_allclose(numbers(text, pattern), wanted, rtol=1e-3)
    shift, yaw = numbers(text, r"units moves the picture by ([\d.]+) pixels; 1 degree of yaw by ([\d.]+)")
    assert shift == pytest.approx(0.01 * camera.fx / wanted[1], rel=1e-2)
    assert yaw == pytest.approx(camera.fx * math.radians(1.0), rel=1e-2)
    (moved,) = numbers(text, r"  x moves what frame 0 shows by ([\d.]+) pixels over its range")
    assert camera.fx * 2 * radius / wanted[2] < moved < camera.fx * 2 * radius / wanted[0]
    assert numbers(text, r"pitch moves what frame 0 shows by ([\d.]+)")[0] == pytest.approx(2 * yaw, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("rotation", "asks"), [((0.49,), False), ((0.0, 0.51, 0.0), True), ((60.0, 0.0, 0.0), False)])
def test_wide_rotations_in_radians_ask_back(
    blobs: Inputs, call: Call, tmp_path: Path, rotation: tuple[float, ...], asks: bool
) -> None:
    """Above 0.5 rad, --describe asks back and the commands warn; in degrees, the user has said what was meant."""
    degrees = ["--angle-units", "degrees"] if rotation[0] > 1.0 else []
    options = ["--load-config", str(blobs.config), "--camera-path-filename", str(blobs.path), "--frames", "0"]
    options += ["--rotation", *map(str, rotation), *degrees]
    code, text, _ = call([*options, "--describe"])
    assert code == 0 and ("is this what you mean" in text) == asks
    code, _, text = call([*options, "--time-budget", "0.1", "--output-dir", str(tmp_path / "out")])
    assert code in (0, 3) and ("warning: the set turns by up to 29.22 degrees (0.51 rad) in pitch" in text) == asks
    page = (tmp_path / "out" / "report.html").read_text()
    assert ("if degrees were meant" in page) == asks
    first = "yaw ± 60 degrees (± 1.047 rad)" if degrees else "± 28.07 degrees" if not asks else "pitch ± 0.51 rad"
    assert first in page


def test_results_have_the_units_that_were_asked(blobs: Inputs, tmp_path: Path) -> None:
    """In files and in Python: what was asked comes first, the other unit beside it; the file's parameters stay."""
    scale = 0.5
    run = shutil.copytree(blobs.config.parent, tmp_path / "run")
    transform = json.loads((run / "dataparser_transforms.json").read_text())
    write_json(run / "dataparser_transforms.json", {**transform, "scale": scale})
    scene, camera = nsa.load_scene(run / "config.yml"), load_camera_path(blobs.path).cameras[0]
    texts = {}
    for asked in ({}, {"units": "dataset", "angle_units": "degrees"}):
        poses = nsa.PoseSet(camera, {"x": 0.01}, {"yaw": (0.0, 0.01)}, **asked)
        result = nsa.bound(scene, poses, time_budget=0.1)
        texts["dataset" if asked else "normalised"] = str(result)
        result.save(tmp_path / "frame.npz")
        low, high = (0.01 * scale, np.radians(0.01)) if asked else (0.01, 0.01)
        stored = np.load(tmp_path / "frame.npz")["parameters"]
        assert list(stored["unit"]) == ["normalised units", "rad"] and stored["upper"].tolist() == [low, high]
    assert "x ± 0.01 units of the data set (± " in texts["dataset"]
    assert "yaw ∈ [0, 0.01] degrees ([0, 0.000174533] rad)" in texts["dataset"]
    assert "x ± 0.01 normalised units (± " in texts["normalised"]
    assert "yaw ∈ [0, 0.01] rad ([0, 0.572958] degrees)" in texts["normalised"]


def test_describe_needs_no_set_and_writes_nothing(
    make_blobs: Callable[..., Inputs], call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = make_blobs()
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    options = ["--load-config", str(inputs.config), "--camera-path-filename", str(inputs.path), "--describe"]
    code, text, _ = call([*options, "--frames", "2"])
    assert code == 0 and "one camera pose" in text and "1 of 3" in text and "frame 2: at" in text
    assert "frame 0" not in text and sorted(tmp_path.rglob("*")) == before
    code, _, problem = call([*options, "--frames", "7"])
    assert code == 2 and "--frames" in problem and problem.count("\n") == 1


def test_describe_of_a_field(tmp_path: Path, blobs: Inputs, call: Call) -> None:
    config = write_nerf_run(tiny_scene(0), tmp_path / "run", timestamp=TIMESTAMP, experiment_name="tiny")
    code, text, _ = call(
        ["--load-config", str(config), "--camera-path-filename", str(blobs.path), "--describe", "--rotation", "0.01"]
    )
    assert code == 0 and "no distance of its own" in text and "roll moves what frame 0 shows" in text


def test_given_set_is_that_of_a_file(blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    orders: list[Any] = []
    monkeypatch.setattr("ns_abstract.cli.rendering.render_path", lambda order, stop: orders.append(order) or True)
    base = blobs.options(tmp_path / "out", perturbation_filename=None)
    for more, content in (
        (["--translation", "0.05", "--rotation", "0.02"],
         {"translation": dict.fromkeys("xyz", 0.05), "rotation": dict.fromkeys(("yaw", "pitch", "roll"), 0.02)}),
        (["--translation", "0.1", "0", "0.2", "--units", "dataset"],
         {"units": "dataset", "translation": {"x": 0.1, "z": 0.2}}),
        (["--rotation", "2", "1", "0", "--angle-units", "degrees"],
         {"angle_units": "degrees", "rotation": {"yaw": 2, "pitch": 1}}),
    ):  # fmt: skip
        monkeypatch.setattr(sys, "argv", ["command", *base, *more])
        with pytest.raises(SystemExit) as leave:
            render_command.main()
        assert leave.value.code == 0
        spec = write_json(tmp_path / "spec.json", {"version": 1, **content})
        given, file = open_job(orders[-1].settings), open_job(Settings(blobs.config, blobs.path, spec))
        assert [poses.box for poses in given.pose_sets] == [poses.box for poses in file.pose_sets]
        # resumed, it is the same set
        assert given.fingerprint["scene"] == file.fingerprint["scene"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--translation", "0.1", "0.2"], ("--translation", "found 2 numbers", "three")),
        (["--rotation", "-0.1"], ("--rotation.yaw", "not negative")),
        (["--translation", "nan"], ("--translation.x",)),
    ],
)
def test_given_set_that_cannot_be_used(
    blobs: Inputs, call: Call, tmp_path: Path, more: list[str], words: tuple[str, ...]
) -> None:
    code, _, problem = call([*blobs.options(tmp_path / "out", perturbation_filename=None), *more])
    assert code == 2 and problem.count("\n") == 1 and all(word in problem for word in words), problem
    code, _, problem = call([*blobs.options(tmp_path / "out"), *more])
    assert code == 2 and "beside --perturbation-filename" in problem
    with pytest.raises(InputError, match="perturbation for entry 0; give --translation or --rotation"):
        open_job(Settings(blobs.config, blobs.path))
