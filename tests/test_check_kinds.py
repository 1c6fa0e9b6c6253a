"""What the program that checks results knows beside splats in real numbers: float32, networks, loops, NeRFs, files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from certifying import classifier, write_onnx
from conftest import InProcess, Inputs, blob_scene, ring
from nerfs import UNIFORM, tiny_weights, view
from onnx import helper, numpy_helper
from scene_files import ply
from splat_files import (
    glb_parts,
    sog_parts,
    write_checkpoints,
    write_compressed,
    write_glb,
    write_inria,
    write_sog,
    write_splat,
    write_spz,
)
from test_check import splats_of

import ns_abstract as nsa
from ns_abstract.api.checking import check
from ns_abstract.check import inputs
from ns_abstract.check.audit import _overall
from ns_abstract.check.fields import CheckedField
from ns_abstract.check.forms import Affine, parameters
from ns_abstract.check.inputs import BadInput, check_keys, read_poses, read_scene
from ns_abstract.check.loops import LoopRuns, _with_symbols
from ns_abstract.check.networks import read_network
from ns_abstract.check.poses import CheckedCamera, Poses
from ns_abstract.check.results import StoredCells, read_verdicts, structural_faults
from ns_abstract.check.splats import (
    FLOAT,
    ActivatedScene,
    _fragments,
    _surely_in_tile,
    gaussians_at,
    pictures,
    pixel_extents,
    pixels,
    projected,
)
from ns_abstract.check.statements import parse_statement
from ns_abstract.cli import certify as certify_command
from ns_abstract.cli import check as check_command
from ns_abstract.demo.writing import write_loop_demo
from ns_abstract.geometry.camera_path import PinholeCamera as PathCamera
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.atomic import write_json
from ns_abstract.methods.nerf.render import NerfRenderer
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.splat.constants import VERSIONS
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.write import write_ply
from ns_abstract.verify.picture_properties import parse_picture_property

# ---------------------------------------------------------------- float32


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_float32_pictures_are_enclosed_and_need_their_charges(mode: str, version: str) -> None:
    scene = dataclasses.replace(blob_scene(60, degree=2), rasterize_mode=mode)
    pose = np.asarray(ring()[1].camera_to_world, np.float64)[:3]
    focal = 8.0 / np.tan(np.radians(45.0) / 2.0)
    values = (pose, focal, focal, 8.0, 8.0, 16, 16)
    reference = Reference(scene, VERSIONS[version], torch.float32)
    image = reference.image(PathCamera(*values), torch.from_numpy(pose)).double().numpy()
    splats = splats_of(scene, version)
    cam, none = CheckedCamera(*values), np.zeros((1, 0))
    seen = Poses(cam, ()).view(none, none)
    for unit, holds in ((FLOAT, True), (0.0, False)):
        form = pictures(splats, cam, seen, unit).reshaped(16, 16, 3)
        low, high = form.range()
        outside = (np.clip(low, 0.0, 1.0) > image) | (np.clip(high, 0.0, 1.0) < image)
        assert outside.any() != holds
        if unit:
            assert form.r.max() < 5e-3
    # pictures are those of their pixels
    ends = pixel_extents(splats, cam, seen, 0.0)[0]
    one, _, _ = pixels(splats, cam, seen, gaussians_at(ends, 7, 9)[None], (np.array([7]), np.array([9])))
    assert np.abs(one.clamped(0.0, 1.0).c[0] - form.c[7, 9]).max() < 1e-12


def test_needles_may_miss_their_tiles_in_float32() -> None:
    """gsplat 1.6.0 loses tiles of needles, and neither version is trusted far outside of the picture."""
    scene = dataclasses.replace(
        blob_scene(3, degree=0),
        means=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [4e4, 0.0, 0.0]], np.float32),
        log_scales=np.array([[-2.0] * 3, [3.0, -8.0, -8.0], [-2.0] * 3], np.float32),
        quats=np.array([[1.0, 0, 0, 0], [0.9, 0.1, 0.2, 0.4], [1.0, 0, 0, 0]], np.float32),
    )
    cam = CheckedCamera(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0]]), 40.0, 40.0, 8, 8, 16, 16)
    none = np.zeros((1, 0))
    with np.errstate(all="ignore"):
        found = projected(splats_of(scene, "1.6.0"), cam, Poses(cam, ()).view(none, none), np.arange(3)[None], FLOAT)
        kept, level = _surely_in_tile(found, True)
        assert kept.tolist() == [[True, False, False]] and 1.0 + 2.0**-6 < level[0, 0] < 1.1
        assert _surely_in_tile(found, False)[1][0, 0] < level[0, 0] and not _surely_in_tile(found, False)[0][0, 2]


@pytest.mark.parametrize("version", ["1.4.0", "1.5.3"])
def test_a_float32_cap_is_a_float32(version: str) -> None:
    """0.999 is rounded upwards, by more than float64 sees: behind it a hundred-thousandth less light is left."""
    scene = dataclasses.replace(blob_scene(1, degree=0), means=np.array([[0.025, -0.025, 0.0]], np.float32))
    scene = dataclasses.replace(scene, log_scales=-np.ones((1, 3), np.float32))
    scene = dataclasses.replace(scene, opacity_logits=np.full(1, 12.0, np.float32))
    cam = CheckedCamera(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0]]), 40.0, 40.0, 16, 16, 32, 32)
    view, pixel = Poses(cam, ()).view(none := np.zeros((1, 0)), none), (np.array([16]), np.array([16]))
    splats = splats_of(scene, version)
    with np.errstate(all="ignore"):
        seen = projected(splats, cam, view, np.zeros((1, 1), int), FLOAT)
        low, high = _fragments(splats, cam, seen, np.zeros((1, 1), int), pixel, FLOAT)[0].range()
    assert low[0, 0] <= 0.999 < float(np.float32(0.999)) <= high[0, 0] < 0.9991


def test_covariances_that_may_overflow_are_unknown() -> None:
    """Seen from so far that it is small in the picture, a Gaussian of 1e16 has a square that float32 holds not."""
    sizes = np.log([[1e14] * 3, [1e16, 1.0, 1.0]]).astype(np.float32)
    scene = dataclasses.replace(blob_scene(2, degree=0), means=np.full((2, 3), [0.0, 0.0, -1e9], np.float32))
    scene = dataclasses.replace(scene, log_scales=sizes, quats=np.eye(4, dtype=np.float32)[[0, 0]])
    cam = CheckedCamera(np.eye(4)[:3], 1e-5, 1e-5, 8, 8, 16, 16)
    none = np.zeros((1, 0))
    with np.errstate(all="ignore"):
        found = projected(splats_of(scene), cam, Poses(cam, ()).view(none, none), np.arange(2)[None], FLOAT)
    assert found.kappa[0, 0] < 0.01 and np.isinf(found.kappa[0, 1])


@pytest.mark.parametrize("name", ["quaternions of 1e-20", "quaternions of 1e20", "scales of 1e-39"])
def test_scenes_that_float32_does_not_hold_are_refused(name: str) -> None:
    """Their squares, or they themselves, are flushed or infinite there, and other Gaussians are drawn."""
    scene = blob_scene(2, degree=0)
    stored = [scene.means, scene.log_scales, scene.quats, scene.opacity_logits, scene.sh]
    assert len(inputs._drawn(stored, Path("f"), {})[0]) == 2
    size, column = float(name.rsplit(maxsplit=1)[-1]), 2 if name.startswith("q") else 1
    values = stored[2] * size if column == 2 else np.full((2, 3), np.log(size))
    changed = [*stored[:column], values.astype(np.float32), *stored[column + 1 :]]
    for settings in ({}, {"drop_nan_gaussians": True}):
        with pytest.raises(BadInput, match="not normal"):
            inputs._drawn(changed, Path("f"), settings)


# ---------------------------------------------------------------- networks


def pooled(file: Path) -> Path:
    """Convolutions with a sum of branches, padding, average pooling and two products."""
    rng = np.random.default_rng(4)
    weights = {
        "k": 0.4 * rng.normal(size=(4, 3, 3, 3)), "c": 0.1 * rng.normal(size=4),
        "l": 0.3 * rng.normal(size=(4, 4, 3, 3)), "w": rng.normal(size=(6, 4 * 16)), "b": rng.normal(size=6),
        "v": rng.normal(size=(6, 3)),
    }  # fmt: skip
    nodes = [
        helper.make_node("Conv", ["image", "k", "c"], ["a"], pads=[1, 1, 1, 1]),
        helper.make_node("Relu", ["a"], ["p"]),
        helper.make_node("Conv", ["p", "l"], ["q"], pads=[1, 1, 1, 1]),
        helper.make_node("Add", ["p", "q"], ["s"]),
        helper.make_node("Relu", ["s"], ["t"]),
        helper.make_node("AveragePool", ["t"], ["m"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Flatten", ["m"], ["f"]),
        helper.make_node("Gemm", ["f", "w", "b"], ["g"], transB=1),
        helper.make_node("Relu", ["g"], ["h"]),
        helper.make_node("MatMul", ["h", "v"], ["y"]),
    ]
    return write_onnx(file, (3, 8, 8), nodes, weights, 3)


@pytest.mark.parametrize("radius", [0.0, 1e-3, 0.1])
def test_networks_are_enclosed(radius: float, tmp_path: Path) -> None:
    file, rng = pooled(tmp_path / "net.onnx"), np.random.default_rng(2)
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    c, g = rng.random((1, 3, 8, 8), np.float32).astype(np.float64), radius * rng.normal(size=(2, 1, 3, 8, 8))
    # what rounding the input to float32 moves it by is part of the set
    form = Affine(c, g, np.full(c.shape, 0.1 * radius + 4e-7))
    network, exact = read_network(file, None, FLOAT), read_network(file, None, 0.0)
    rows = np.array([[1.0, -1.0, 0.0], [0.0, 0.5, 2.0]])
    outputs = network.outputs(form)
    (least, most), (inner, _) = (n.outputs(form, rows).range() for n in (network, exact))
    found = []
    for _ in range(50):
        s, e = rng.uniform(-1.0, 1.0, 2), 0.1 * radius * rng.uniform(-1.0, 1.0, c.shape)
        x = (c + s[0] * g[0] + s[1] * g[1] + e).astype(np.float32)
        y = np.asarray(session.run(None, {"image": x})[0], np.float64)[0]
        assert (np.abs(y - outputs.c[0] - s @ outputs.g[:, 0]) <= outputs.r[0]).all()
        value = rows @ y
        assert (least[0] <= value).all() and (value <= most[0]).all()
        found.append(value)
    # rows that go back keep what the picture's slopes cancel
    assert (most - least).max() < 16.0 * max(np.ptp(found, axis=0).max(), 2e-3)
    assert (inner >= least).all() and (inner > least).any()


def test_branches_of_networks_have_symbols_of_their_own(tmp_path: Path) -> None:
    """A difference of two branches, each behind ReLU of its own, over corners of a set of pictures."""
    rng = np.random.default_rng(6)
    weights = {"u": rng.normal(size=(4, 12)), "v": rng.normal(size=(4, 12)), "minus": -np.eye(4)}
    nodes = [
        helper.make_node("Flatten", ["image"], ["f"]),
        helper.make_node("Gemm", ["f", "u"], ["a"], transB=1),
        helper.make_node("Gemm", ["f", "v"], ["b"], transB=1),
        helper.make_node("Relu", ["a"], ["p"]),
        helper.make_node("Relu", ["b"], ["q"]),
        helper.make_node("MatMul", ["q", "minus"], ["n"]),
        helper.make_node("Add", ["p", "n"], ["y"]),
    ]
    network = read_network(write_onnx(tmp_path / "net.onnx", (3, 2, 2), nodes, weights, 4), None, 0.0)
    u, v = (weights[name].astype(np.float32).astype(np.float64) for name in "uv")
    for scale in (0.1, 0.5):
        c, r = scale * rng.normal(size=(1, 3, 2, 2)), np.full((1, 3, 2, 2), 0.3)
        found = network.outputs(Affine(c, np.zeros((0, 1, 3, 2, 2)), r))
        low, high = found.range()
        for corner in rng.choice([-1.0, 1.0], (500, 12)):
            x = c.ravel() + r.ravel() * corner
            y = np.maximum(u @ x, 0.0) - np.maximum(v @ x, 0.0)
            assert (low[0] <= y).all() and (y <= high[0]).all()


def test_a_float32_network_leaves_the_exact_one(tmp_path: Path) -> None:
    """At one picture the exact network's bounds are narrower than float32's error, and float32's hold it."""
    file, c = pooled(tmp_path / "net.onnx"), np.random.default_rng(3).random((64, 3, 8, 8)).astype(np.float32)
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    y = np.asarray(session.run(None, {"image": c})[0], np.float64)
    form = Affine(c.astype(np.float64), np.zeros((0, *c.shape)), np.zeros(c.shape))
    for unit, holds in ((FLOAT, True), (0.0, False)):
        low, high = read_network(file, None, unit).outputs(form).range()
        assert bool(((low <= y) & (y <= high)).all()) == holds


def chain(file: Path, factors: list[float], weight: np.ndarray, side: int = 1) -> Path:
    """Products with ``factors``, one behind the other, then with ``weight``, and a sum with (0, 0.1)."""
    weights = {f"w{k}": v * np.eye(3 * side * side) for k, v in enumerate(factors)}
    nodes = [helper.make_node("Flatten", ["image"], ["f0"])]
    nodes += [helper.make_node("MatMul", [f"f{k}", f"w{k}"], [f"f{k + 1}"]) for k in range(len(factors))]
    nodes += [helper.make_node("MatMul", [f"f{len(factors)}", "w"], ["m"]), helper.make_node("Add", ["m", "b"], ["y"])]
    return write_onnx(file, (3, side, side), nodes, weights | {"w": weight, "b": np.array([0.0, 0.1])}, 2)


@pytest.mark.parametrize("factors", [[1e-25, 1e-20, 1e36, 1e9], [1e20, 1e19, 1e-30, 1e-9], [1e-44, 1e38, 1e6]])
def test_what_float32_cannot_hold_is_not_proved(factors: list[float], tmp_path: Path) -> None:
    """A product on the way is flushed, or infinite, and runtimes find another class than real numbers."""
    file, x = chain(tmp_path / "net.onnx", factors, np.eye(3, 2) * [1.0, 0.0]), np.full((1, 3, 1, 1), 0.6)
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    y = np.asarray(session.run(None, {"image": x.astype(np.float32)})[0], np.float64)[0]
    form, row = Affine(x, np.zeros((0, *x.shape)), np.full(x.shape, 1e-6)), np.array([[1.0, -1.0]])
    exact, (least, _) = (read_network(file, None, unit).outputs(form, row).range() for unit in (0.0, FLOAT))
    assert exact[0][0, 0] > 0.4 and not least[0, 0] > 0.0
    assert not y[0] > 0.5999


def test_sums_may_begin_with_what_is_added_behind_them(tmp_path: Path) -> None:
    """Runtimes make one operator of a product and a sum; each of many terms is then lost beside a large one."""
    file = chain(tmp_path / "net.onnx", [], np.full((3 * 64 * 64, 2), 0.9 / 256.0 * FLOAT), 64)
    model = onnx.load(str(file))
    model.graph.initializer[-1].CopyFrom(numpy_helper.from_array(np.ones(2, np.float32), "b"))
    onnx.save(model, str(file))
    x = np.ones((1, 3, 64, 64))
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    y = np.asarray(session.run(None, {"image": x.astype(np.float32)})[0], np.float64)
    low, high = read_network(file, None, FLOAT).outputs(Affine(x, np.zeros((0, *x.shape)), np.zeros(x.shape))).range()
    assert ((low <= y) & (y <= high)).all() and np.abs(y - 1.0 - 43.2 * FLOAT).max() > 30.0 * FLOAT


def test_tensors_of_other_dimensions_are_not_added(tmp_path: Path) -> None:
    """As many channels as symbols would pass for symbols."""
    nodes = [
        helper.make_node("Flatten", ["image"], ["f"]),
        helper.make_node("Gemm", ["f", "w"], ["g"]),
        helper.make_node("Conv", ["image", "k"], ["c"]),
        helper.make_node("Add", ["g", "c"], ["y"]),
    ]
    weights = {"w": np.eye(12, 2), "k": np.ones((3, 3, 1, 1))}
    network = read_network(write_onnx(tmp_path / "net.onnx", (3, 2, 2), nodes, weights, 12), None, 0.0)
    with pytest.raises(ValueError, match="dimensions"):
        network.outputs(Affine(np.zeros((1, 3, 2, 2)), np.ones((3, 1, 3, 2, 2)), np.zeros((1, 3, 2, 2))))


# ---------------------------------------------------------------- certificates


def certified(
    folder: Path, blobs: Inputs, prop: dict[str, Any], spec: dict[str, Any] | None = None, frames: int = 1, **more: Any
) -> Path:
    """What `ns-abstract-certify` finds out about 8 x 8 pictures of first frames, of x within 0.002 or ``spec``."""
    path = json.loads(blobs.path.read_text())
    small = {"render_width": 8, "render_height": 8, "camera_path": path["camera_path"][:frames]}
    write_json(folder / "path.json", path | small)
    write_json(folder / "prop.json", prop)
    write_json(folder / "spec.json", spec or {"version": 1, "translation": {"x": 0.002}})
    more |= {
        "load-config": blobs.config, "camera-path-filename": folder / "path.json", "property": folder / "prop.json",
        "output-dir": folder / "out", "time-budget": 300,
    }  # fmt: skip
    more |= {"translation": [0.002, 0, 0]} if spec is None else {"perturbation-filename": folder / "spec.json"}
    arguments = [str(v) for k, o in more.items() for v in (f"--{k}", *(o if isinstance(o, list) else [o]))]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["certify", *arguments])
        with pytest.raises(SystemExit) as ended:
            certify_command.main()
    assert ended.value.code in (0, None)
    return folder / "out"


def first_picture(blobs: Inputs) -> np.ndarray:
    camera = nsa.load_camera_path(blobs.path).cameras[0]
    scene = nsa.load_scene(blobs.config)
    return nsa.render(scene, nsa.Camera(camera.camera_to_world, fov=45.0, width=8, height=8))


@pytest.fixture(scope="module")
def certificate(blobs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certified")
    net = classifier(folder / "net.onnx", size=8)
    session = onnxruntime.InferenceSession(net, providers=["CPUExecutionProvider"])
    image = np.moveaxis(first_picture(blobs), -1, 0)[None].astype(np.float32)
    label = int(np.asarray(session.run(None, {"image": image})[0])[0].argmax())
    return certified(folder, blobs, {"type": "classification", "label": label}, model=net)


@pytest.fixture
def copy(certificate: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(certificate, tmp_path / "copy"))


def rewrite(folder: Path, change: str) -> None:
    """Change the table of cells and seal it anew, as who forges a certificate would."""
    with sqlite3.connect(folder / "cells.sqlite") as base:
        base.execute(change)
        rows = list(base.execute("SELECT frame, lower, upper, verdict, margin, seconds, counterexample FROM cells"))
    digests = (hashlib.sha256(json.dumps(list(row)).encode()).digest() for row in rows)
    seal = {"rows": len(rows), "sum": f"{sum(int.from_bytes(d, 'big') for d in digests) % (1 << 256):064x}"}
    file = folder / "report.json"
    document = json.loads(file.read_text()) | {"cells_seal": seal}
    for frame in document.get("frames", []):
        margins = [row[4] for row in rows if row[0] == frame["index"] and row[3] == "certified"]
        frame["least_margin"] = min(margins, default=None)
    file.write_text(json.dumps(document))


@pytest.mark.slow
def test_frames_that_the_report_leaves_out_are_named(copy: Path, certificate: Path) -> None:
    """Who drops a frame in which the property fails claims a verdict of all."""
    path = json.loads((certificate.parent / "path.json").read_text())
    two = write_json(copy / "two.json", path | {"camera_path": 2 * path["camera_path"]})
    found = check(copy, claims=1, seconds=60, camera_path=two)
    assert found.unclaimed == [1] and found.exit_code == 1
    assert found.structure == ["the verdict is unknown, the report says certified"]


@pytest.mark.slow
def test_sets_in_units_of_another_data_set_are_refused(copy: Path) -> None:
    spec = write_json(copy / "spec.json", {"version": 1, "units": "dataset", "translation": {"x": 0.002}})
    file = copy / "report.json"
    document = json.loads(file.read_text())
    document["settings"]["translation"] = None
    file.write_text(json.dumps(document))
    assert check(copy, claims=1, seconds=60, perturbation=spec).proved == 1
    document["scene"]["units"]["dataset_scale"] = 2.0
    file.write_text(json.dumps(document))
    with pytest.raises(nsa.InputError, match="another set of poses"):
        check(copy, claims=1, perturbation=spec)


def test_units_of_a_data_set_are_the_packages(tmp_path: Path) -> None:
    """Bit for bit: sets are compared so."""
    rng = np.random.default_rng(0)
    for size in (0.3, 1.0, 1.0 + 1e-7, 7.1):
        matrix = np.hstack([size * np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=(3, 1))])
        write_json(tmp_path / "dataparser_transforms.json", {"transform": matrix.tolist(), "scale": 0.07})
        assert inputs.dataset_scale(tmp_path / "config.yml") == DataparserTransform(matrix, 0.07).stated_scale


@pytest.mark.slow
def test_frames_may_vary_less_than_others(blobs: Inputs, tmp_path: Path) -> None:
    """No segment begins at the last entry of an open path; cells have all parameters that vary in any frame."""
    spec = {"version": 1, "translation": {"x": 0.002}, "sweep": "segments"}
    prop = {"type": "picture", "statistic": "mean", "max": 1.0}
    folder = certified(tmp_path, blobs, prop, spec, 2)
    found = check(folder, claims=4, seconds=120)
    assert (found.proved, found.refuted, found.structure, found.exit_code) == (4, 0, [], 0)
    # what is fixed has to be where the set has it, and the table's parameters are the report's
    file, document = folder / "report.json", json.loads((folder / "report.json").read_text())
    assert [p["upper"] for p in document["frames"][1]["parameters"]] == [0.002, 0.0]
    rewrite(folder, "UPDATE cells SET upper = '[0.002, 0.5]', lower = '[-0.002, 0.5]' WHERE frame = 1")
    assert "overlap, or leave the set" in check(folder, claims=1, seconds=60).structure[0]
    document = json.loads(file.read_text())
    document["frames"][1]["parameters"][1] |= {"lower": 0.5, "upper": 0.5}
    file.write_text(json.dumps(document))
    with pytest.raises(nsa.InputError, match="another set of poses"):
        check(folder, claims=1)
    rewrite(folder, "UPDATE parameters SET name = 'y' WHERE position = 0")
    with pytest.raises(nsa.InputError, match="cannot be read as the cells"):
        check(folder, claims=1)


@pytest.mark.slow
def test_a_report_that_cannot_be_followed_is_one_line(copy: Path, in_process: InProcess) -> None:
    file = copy / "report.json"
    document = json.loads(file.read_text())
    document["model"]["output"] = [4]
    file.write_text(json.dumps(document))
    code, _, err = in_process(check_command.main, [str(copy), "--claims", "1"])
    assert code == 2 and "cannot follow" in err and len(err.splitlines()) == 1


def test_operators_are_those_of_the_format(tmp_path: Path) -> None:
    """A local function may be called Relu, and a node may state an attribute twice."""
    file = classifier(tmp_path / "net.onnx", size=8)
    assert len(read_network(file, None, 0.0).layers) == 6
    model, plain = onnx.load(str(file)), file.read_bytes()
    negated = [helper.make_node("Neg", ["x"], ["y"])]
    for domain in ("mine", ""):
        model.ParseFromString(plain)
        model.graph.node[1].domain = domain
        if not domain:
            opset = helper.make_opsetid("", 17)
            model.functions.append(helper.make_function("", "Relu", ["x"], ["y"], negated, [opset]))
        onnx.save(model, str(file))
        with pytest.raises(ValueError, match="domain"):
            read_network(file, None, 0.0)
    model.ParseFromString(plain)
    model.graph.node[0].attribute.append(helper.make_attribute("strides", [1, 1]))
    onnx.save(model, str(file))
    with pytest.raises(ValueError, match="strides"):
        read_network(file, None, 0.0)
    # a runtime would compute in halves
    model.ParseFromString(plain)
    for tensor in model.graph.initializer:
        tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float16), tensor.name))
    onnx.save(model, str(file))
    with pytest.raises(ValueError, match="inputs"):
        read_network(file, None, 0.0)


@pytest.mark.slow
def test_a_certificate_is_proved_again(copy: Path) -> None:
    found = check(copy, claims=3, seconds=120)
    assert (found.claims, found.proved, found.float32, found.exit_code) == (3, 3, 3, 0)
    assert found.uniform["claims"] == 2 and found.uniform["float32_at_least"] > 0.2


@pytest.mark.slow
def test_a_margin_that_is_too_large_is_refuted(copy: Path, in_process: InProcess) -> None:
    rewrite(copy, "UPDATE cells SET margin = margin + 10")
    code, out, _ = in_process(check_command.main, [str(copy), "--claims", "1", "--seconds", "60"])
    assert code == 1 and "the margin is" in out


@pytest.mark.slow
def test_another_class_is_refuted(copy: Path) -> None:
    file = copy / "report.json"
    document = json.loads(file.read_text())
    stated = document["settings"]["property"]
    document["property"]["label"] = (document["property"]["label"] + 1) % 3
    file.write_text(json.dumps(document))
    with pytest.raises(nsa.InputError, match="is not the property of the result"):
        check(copy, claims=1)
    # as who forges a certificate would
    document["settings"]["property"] = None
    file.write_text(json.dumps(document))
    with pytest.raises(nsa.InputError, match="is not the property of the result"):
        check(copy, claims=1, property=stated)
    found = check(copy, claims=1, seconds=60)
    assert found.refuted == 1 and found.refutations[0]["margin"] < 0.0


BAD: dict[str, tuple[str, int, str]] = {
    "another cell": (
        "UPDATE cells SET upper = '[0.0015]' WHERE rowid = (SELECT max(rowid) FROM cells)",
        1,
        "partition",
    ),
    "a verdict": (
        "UPDATE cells SET verdict = 'unknown' WHERE rowid = (SELECT min(rowid) FROM cells)",
        1,
        "report counts",
    ),
    "no counterexample": ("UPDATE cells SET verdict = 'falsified'", 2, "a counterexample that is none"),
    "a margin of letters": ("UPDATE cells SET margin = 'much'", 2, "a margin or"),
    "no list": ("UPDATE cells SET lower = '7'", 2, "cannot be read as the cells"),
    "no number": ("UPDATE cells SET lower = '[NaN]'", 2, "cannot be read as the cells"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD)
def test_a_forged_table_is_found(name: str, copy: Path, in_process: InProcess) -> None:
    change, expected, words = BAD[name]
    rewrite(copy, change)
    code, out, err = in_process(check_command.main, [str(copy), "--claims", "1"])
    assert code == expected and words in out + err and len(err.splitlines()) == (expected == 2)


#: What of a certificate's report has no part in its claims (docs/check.md, "What is not checked").
UNCHECKED = {
    "assumptions", "cameras", "certified_of_sampled_right", "command", "effort", "guarantee_text", "limits", "metrics",
    "network_guarantee", "packages", "partitions", "plan", "property_text", "sampled", "scene_margin", "seconds",
    "started", "state", "trace", "unknown_because", "updated",
    "frames.intrinsics", "frames.parameters.unit", "frames.partition", "frames.sampled", "frames.counterexamples",
    "model.name", "model.bytes", "model.input", "scene.name", "scene.source", "scene.sh_degree", "scene.sh_degree_used",
    "scene.units",
}  # fmt: skip
#: Its settings and fingerprint that have one: the inputs, and the scene's digest.
CHECKED = {
    "settings.translation", "settings.units", "settings.angle_units", "settings.load_config",
    "settings.camera_path_filename", "settings.model", "fingerprint.scene",
}  # fmt: skip


def numbers_and_words(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield the places and values of all numbers and words of a document; of lists the first element's."""
    if isinstance(value, (dict, list)):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value[:1]):
            yield from numbers_and_words(part, (*place, key))
    elif value is not None:
        yield place, value


@pytest.mark.slow
def test_every_number_and_word_that_a_claim_rests_on_is_checked(copy: Path) -> None:
    """A field that a later version adds has to be checked, or to be listed as unchecked."""
    file = copy / "report.json"
    document, accepted = json.loads(file.read_text()), []
    for place, value in numbers_and_words(document):
        name = ".".join(key for key in place if isinstance(key, str))
        parts = {name.rsplit(".", k)[0] for k in range(name.count(".") + 1)}
        if parts & UNCHECKED or (place[0] in ("settings", "fingerprint") and not parts & CHECKED):
            continue
        other = not value if isinstance(value, bool) else f"{value}x" if isinstance(value, str) else value + 1
        file.write_text(json.dumps(changed(document, place, other)))
        try:
            found = check(copy, claims=2, seconds=20)
        except nsa.InputError:
            continue
        if not found.exit_code:
            accepted.append(name)
    assert accepted == []


def headlines(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Changes of what a report says of all its frames, by what is wrong then."""
    (frame,) = document["frames"]
    second = frame | {"index": 1}
    some = {"certified": 0.5, "falsified": 0.0, "unknown": 0.5, "not_examined": 0.0}
    return {
        "the verdict is certified, the report says falsified": {"verdict": "falsified"},
        "the report says 0.5 of all sets are certified, its frames do not": {"coverage": some},
        "frame 1: no cells": {"frames": [frame, second]},
        # a frame that stands twice may say anything once
        "the verdict is unknown, the report says certified": {"frames": [frame, frame]},
    }


def test_headlines_are_those_of_the_cells() -> None:
    low, high = np.zeros((2, 1))
    frame = {"index": 0, "cells": {}, "coverage": {"certified": 1.0, "falsified": 0.0, "unknown": 0.0}}
    parts = [StoredCells(0, ("x",), low, high, {}, [("certified", 1.0, None)])]
    report = {"frames": [frame], "verdict": "certified", "coverage": frame["coverage"]}
    assert _overall(report, parts) == []
    assert _overall(report | {"verdict": "falsified"}, parts) == ["the verdict is certified, the report says falsified"]
    assert _overall(report | {"coverage": {"certified": 0.5}}, parts) == [
        "the report says 0.5 of all sets are certified, its frames do not"
    ]
    assert _overall(report, parts, {0, 1}) == ["the verdict is unknown, the report says certified"]
    twice = report | {"frames": [frame, frame | {"index": 1}], "verdict": "unknown"}
    assert _overall(twice, parts) == ["frame 1: no cells"]
    # a question of a loop that is answered for all of its cells
    loop = {"kind": "loop", "questions": dict.fromkeys(("safe", "reaches"), frame["coverage"]), "verdict": "safe"}
    assert _overall(loop, parts) == ["frame 1: no cells"]
    # parts that are not shares of the set, and add up to 0
    loop["questions"]["reaches"] = {"certified": 1.0, "falsified": -1.0, "unknown": 0.0}
    assert _overall(loop, parts) == ["frame 1: no cells"]
    loop["questions"]["reaches"] = frame["coverage"]
    both = [*parts, dataclasses.replace(parts[0], index=1)]
    assert _overall(loop | {"verdict": "reaches"}, both) == []
    broken = [parts[0], dataclasses.replace(parts[0], index=1, verdicts=[("falsified", None, [0.0])])]
    assert _overall(loop | {"verdict": "falsified"}, broken) == []


@pytest.mark.slow
@pytest.mark.parametrize("number", range(4))
def test_a_forged_headline_is_found(number: int, copy: Path, in_process: InProcess) -> None:
    file = copy / "report.json"
    document = json.loads(file.read_text())
    wrong, change = list(headlines(document).items())[number]
    file.write_text(json.dumps(document | change))
    code, out, _ = in_process(check_command.main, [str(copy), "--claims", "1"])
    assert code == 1 and wrong in out


def test_parts_and_margins_of_a_report_are_those_of_the_cells() -> None:
    box = {"box_lower": np.array([[0.0], [0.25], [0.5]]), "box_upper": np.array([[0.25], [0.5], [1.0]])}
    verdicts: list[Any] = [("certified", 0.25, None), ("certified", 0.125, None), ("open", None, None)]
    cells = StoredCells(0, ("x",), np.zeros(1), np.ones(1), box, verdicts)
    counts = {"certified": 2, "falsified": 0, "unknown": 0, "open": 1}
    frame = {
        "index": 0,
        "cells": counts,
        "coverage": {"certified": 0.5, "falsified": 0.0, "unknown": 0.5},
        "least_margin": 0.125,
    }
    assert structural_faults(cells, {"frames": [frame]}) == []
    parts = frame | {"coverage": {"certified": 0.5, "falsified": 0.0, "unknown": 0.0}}
    assert structural_faults(cells, {"frames": [parts]}) == ["unknown cells are 0.5 of the set, the report says 0"]
    assert structural_faults(cells, {"frames": [frame | {"least_margin": 0.25}]}) == [
        "the least margin is 0.125, not 0.25"
    ]
    none = frame | {"cells": counts | {"open": 0}}
    assert structural_faults(cells, {"frames": [none]}) == ["the report counts 0 cells to be examined, the table 1"]
    twice = [frame | {"coverage": {"certified": 1.0}}, frame]
    assert structural_faults(cells, {"frames": twice}) == ["the report has more than one entry of it"]


@pytest.mark.slow
def test_an_edited_table_is_refused(copy: Path, in_process: InProcess) -> None:
    with sqlite3.connect(copy / "cells.sqlite") as base:
        base.execute("UPDATE cells SET margin = 100")
    code, _, err = in_process(check_command.main, [str(copy)])
    assert code == 2 and "cells_seal" in err and len(err.splitlines()) == 1


def test_a_network_that_was_moved_is_asked_for(copy: Path, certificate: Path, in_process: InProcess) -> None:
    net, file = certificate.parent / "net.onnx", copy / "report.json"
    document = json.loads(file.read_text())
    document["settings"]["model"] = "/nowhere.onnx"
    file.write_text(json.dumps(document))
    code, _, err = in_process(check_command.main, [str(copy)])
    assert code == 2 and "--model" in err
    assert check(copy, claims=1, seconds=60, model=net).proved == 1
    other = copy / "other.onnx"
    other.write_bytes(net.read_bytes() + b"\0")
    code, _, err = in_process(check_command.main, [str(copy), "--model", str(other)])
    assert code == 2 and "sha256" in err


# ---------------------------------------------------------------- statements about the picture


@pytest.fixture(scope="module")
def statement(blobs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    mean = float(first_picture(blobs)[2:6, 2:6, 1].mean())
    box = {"box": [[-9.0, -9.0, -9.0], [9.0, 9.0, 9.0]]}
    parts = [
        {"type": "picture", "channel": "g", "region": [2, 2, 6, 6], "min": mean - 0.02, "max": mean + 0.02},
        {"any": [{"type": "clear", "distance": 0.1}, {"type": "visible", "select": box, "weight": 0.99}]},
    ]
    return certified(tmp_path_factory.mktemp("stated"), blobs, {"all": parts})


def test_statements_say_nothing_that_is_passed_over() -> None:
    dark = {"type": "picture", "max": 0.5}
    assert parse_statement({"all": [dark], "preprocess": {"resize": [4, 4]}}, (4, 4), 1.0)
    for root in (
        {"any": [dark], "type": "picture", "min": 0.9},
        {"any": [dark], "all": [dark]},
        dark | {"weight": 0.5},
        dark | {"preprocess": {"mean": [0.5, 0.5, 0.5]}},
        {"type": "mask"},
        {"type": "classification"},
        {"all": [dark | {"preprocess": {"resize": [2, 2]}}]},
        dark | {"max": True},
        dark | {"min": "-0.5"},
        dark | {"region": [-3, -3, -1, -1]},
        {"type": "clear", "distance": 0.1, "measure": "median"},
        {"type": "clear", "distance": 0.1, "units": "metres"},
        {"type": "visible", "select": {"box": [[0, 0, 0], [1, 1, 1]]}, "pixels": 1.5},
        {"type": "visible", "select": {"box": [[0, 0, 0], [1, 1, 1]], "list": "some.npy"}},
    ):
        with pytest.raises(BadInput, match="which is not checked"):
            parse_statement(root, (4, 4), 1.0)
    with pytest.raises(BadInput, match="outside of the picture"):
        parse_statement(dark | {"region": [2, 2, 5, 4]}, (4, 4), 1.0)
    many = {"type": "visible", "select": {"box": [[0, 0, 0], [1, 1, 1]]}, "pixels": 12, "fraction": 0.1}
    assert parse_statement(many, (4, 4), 1.0).rank == 12


def changed(document: Any, place: tuple[Any, ...], value: Any) -> Any:
    """A copy of a JSON document with another value at a place."""
    if not place:
        return value
    copied: Any = list(document) if isinstance(document, list) else {place[0]: None, **document}
    copied[place[0]] = changed(copied[place[0]], place[1:], value)
    return copied


#: A property or loop, and what it may not say because this program would pass over it or read something else.
PASSED_OVER = {
    "class": (
        {"label": -1}, {"label": 0.9}, {"label": False}, {"label": "0"}, {"confidence": 0.9}, {"type": "detection"},
    ),
    "input": (
        {"channels": "GRAY"}, {"layout": "NHWC"}, {"crop": [1, 1]}, {"resize": [8.5, 8]}, {"mean": ["0.5", 0, 0]},
    ),
    "loop": (
        {"wind": 1.0}, {"steps": 2.5}, {"disturbance": {"across": [0.5, -0.5]}}, {"disturbance": {"across": -0.5}},
        {"disturbance": {"acros": 0.5}}, {"initial": {"along": [1, 0]}}, {"control": {"delay": 3}},
        {"control": {"clip": [[-1, 1], [1, -1]]}}, {"dynamics": {"type": "affine", "drag": 1.0}},
        {"dynamics": {"type": "unicycle"}}, {"camera": {"orbit": 1.0}}, {"goal": {"half_space": {}}},
        {"unsafe": [{"type": "clear"}]}, {"unsafe": [{"box": {"along": [1.0, 0.0]}}]},
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", PASSED_OVER)
def test_nothing_of_a_property_or_loop_is_passed_over(kind: str) -> None:
    for value in PASSED_OVER[kind]:
        with pytest.raises(BadInput, match="which is not checked"):
            check_keys(value, kind, ("along", "across"))
    check_keys({"type": "classification", "label": 3}, "class")
    check_keys({"resize": [8, 8], "mean": [0.5, 0.4, 0.3], "channels": "BGR", "range": [1, 0]}, "input")
    loop = {
        "initial": {"along": -1.0, "across": [-0.2, 0.1]}, "disturbance": {"along": [-0.2, -0.1], "across": 0.1},
        "control": {"clip": [[-1, 1], [-2, 2]], "gain": [[1, -1]], "goal": [1, -1]},
        "unsafe": [{"half_space": {"normal": [1, -1], "at_least": -0.5}}, {"box": {"along": [None, -1]}}],
        "goal": {"box": {"across": [0.1, None]}, "when": "any"},
    }  # fmt: skip
    check_keys(loop, "loop", ("along", "across"))


def test_loops_that_say_two_things_are_not_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A goal that is a half-space would be taken for reached where it may be; a camera has one position."""
    loop = {
        "state": ["x", "y"], "steps": 2, "initial": {"x": [0, 1], "y": 0}, "dynamics": {"type": "affine"},
        "camera": {"camera_to_world": np.eye(4).tolist(), "position": {"matrix": [[1, 0], [0, 1], [0, 0]]}},
        "unsafe": [{"half_space": {"normal": [1, 0], "at_least": 5}}], "goal": {"box": {"x": [0, 9]}},
    }  # fmt: skip
    seeing = type("", (), {"shape": {"resize": [8, 8]}})
    monkeypatch.setattr(sys.modules[LoopRuns.__module__], "NetworkOnPictures", lambda *_: seeing)
    cells = StoredCells(1, ("x",), np.zeros(1), np.ones(1), {})
    assert LoopRuns(cells, None, {"loop": loop}, tmp_path).seen == [0, 1]
    half = {"half_space": {"normal": [1, 0], "at_least": 0.1}}
    for place, value in (
        (("goal",), half),
        (("goal",), {"when": "any"}),
        (("goal", "half_space"), half["half_space"]),
        (("unsafe", 0, "box"), {"y": [5.0, None]}),
        (("camera", "camera_to_world", 0, 3), 5.0),
    ):
        with pytest.raises(BadInput, match=r"not checked|does not follow"):
            LoopRuns(cells, None, {"loop": changed(loop, place, value)}, tmp_path)


@pytest.mark.slow
def test_a_statement_is_proved_again_and_others_are_not(statement: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(statement, tmp_path / "copy"))
    found = check(folder, claims=2, seconds=60)
    assert (found.proved, found.float32, found.refuted, found.structure) == (2, 2, 0, [])
    file = folder / "report.json"
    document = json.loads(file.read_text())
    document["property"]["all"][0]["max"] -= 0.03
    document["settings"]["property"] = None
    file.write_text(json.dumps(document))
    assert check(folder, claims=1, seconds=60).refuted == 1
    document["property"]["all"][0]["mask"] = "mask.png"
    file.write_text(json.dumps(document))
    with pytest.raises(nsa.InputError, match="mask"):
        check(folder, claims=1)
    file.write_text((statement / "report.json").read_text())
    rewrite(folder, "UPDATE cells SET margin = margin + 0.05")
    assert check(folder, claims=1, seconds=60).refuted == 1


LEAVES = (
    {
        "type": "picture",
        "statistic": "mean",
        "channel": "r",
        "region": [0, 0, 9, 16],
        "minus": [9, 0, 16, 16],
        "min": -1,
    },
    {"type": "picture", "statistic": "least", "min": -1.0},
    {"type": "picture", "statistic": "greatest", "channel": "b", "region": [4, 5, 12, 11], "max": 1.0},
    {"type": "visible", "select": {"box": [[-9, -9, -9], [0, 9, 9]]}, "weight": 0.3, "fraction": 0.2},
    {"type": "clear", "distance": 2.0, "weight": 0.4},
)


@pytest.mark.parametrize("half", [0.0, 1e-3])
@pytest.mark.parametrize("leaf", LEAVES, ids=lambda e: f"{e['type']}-{e.get('statistic', '')}")
def test_measures_are_those_of_another_program(leaf: dict[str, Any], half: float, tmp_path: Path) -> None:
    """Margins enclose those of pictures, and of weights, that another renderer makes of poses in the box."""
    scene, pose = blob_scene(60, degree=2), np.asarray(ring()[1].camera_to_world, np.float64)[:3]
    focal = 8.0 / np.tan(np.radians(45.0) / 2.0)
    values = (pose, focal, focal, 8.0, 8.0, 16, 16)
    splats, poses = splats_of(scene), Poses(CheckedCamera(*values), ("x",))
    box = np.full((1, 1), half)
    form = lambda paint: pictures(splats.painted(paint), poses.camera, poses.view(-box, box), 0.0)  # noqa: E731
    least, most = (float(e[0]) for e in parse_statement(leaf, (16, 16), 1.0).margin(form))
    assert np.isfinite(least) and most - least < (0.3 if half else 1e-9)
    prop = parse_picture_property(leaf, tmp_path)
    white = {"sh": np.full((scene.count, 1, 3), 0.5 / 0.28209479177387814, np.float32), "sh_degree": 0}
    for x in (-half, 0.3 * half, half):
        moved = pose.copy()
        moved[:, 3] += pose[:, 0] * x
        shown = scene
        if leaf["type"] != "picture":
            # white where it counts
            depth = (scene.means - moved[:, 3]) @ -moved[:, 2]
            counts = depth < 2.0 if leaf["type"] == "clear" else scene.means[:, 0] <= 0.0
            colors = white["sh"] * np.where(counts, 1.0, -1.0).astype(np.float32)[:, None, None]
            shown = dataclasses.replace(scene, sh=colors, sh_degree=0, background=np.zeros(3, np.float32))
        image = Reference(shown, VERSIONS["1.4.0"]).image(PathCamera(*values), torch.from_numpy(moved))
        (measure,) = prop.measures(16, 16)
        channels = image[None] if leaf["type"] == "picture" else image[None, ..., :1]
        value, (bound,) = float(measure.value(channels.double(), 0)), prop.bind(None, None).limits  # pyright: ignore
        margin = min(value - bound[0], bound[1] - value)
        # colours of white are so in float32
        assert least - 1e-6 <= margin <= most + 1e-6


# ---------------------------------------------------------------- loops


@pytest.mark.slow
def test_a_loop_is_proved_again_and_other_sets_are_not(tmp_path: Path) -> None:
    config, loop = write_loop_demo(tmp_path / "course")
    about = json.loads(loop.read_text()) | {"steps": 3}
    about["initial"] |= {"along": 0.0, "across": [0.1, 0.104], "up": 0.0}
    # keys that may be left out
    del about["goal"], about["camera"]["position"]["offset"]
    about["camera"] |= {"yaw": {"row": [0.0, 0.01, 0.0, 0.0, 0.0]}, "pitch": {"offset": 0.001}}
    loop.write_text(json.dumps(about))
    out = tmp_path / "out"
    nsa.reach(nsa.load_scene(config), loop, time_budget=60.0, output_dir=out)
    file = out / "report.json"
    document = json.loads(file.read_text())
    document["settings"] |= {"load_config": str(config), "loop": str(loop)}
    file.write_text(json.dumps(document))
    found = check(out, claims=1, seconds=120)
    assert (found.proved, found.refuted, found.structure) == (1, 0, [])
    # cells of a part of what the loop begins in
    initial = document["loop"]["initial"]
    document["loop"]["initial"] = initial | {"across": [-0.5, 0.104]}
    file.write_text(json.dumps(document))
    with pytest.raises(nsa.InputError, match="other initial states than the loop"):
        check(out, claims=1)
    document["loop"]["initial"] = initial
    # a half-space that runs do enter
    document["loop"]["unsafe"] = [{"half_space": {"normal": [0.0, 1.0, 0.0, 0.0, 0.0], "at_least": 0.05}}]
    for stated in (loop, loop.with_name("gone.json")):
        document["settings"]["loop"] = str(stated)
        file.write_text(json.dumps(document))
        with pytest.raises(nsa.InputError, match="is not the loop of the result"):
            check(out, claims=1, loop=loop)
    assert check(out, claims=1, seconds=5).proved == 0


def test_controls_without_a_gain_are_the_outputs_less_the_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = LoopRuns.__new__(LoopRuns)
    runs.names = ["place"]
    runs.loop = {"dynamics": {"A": [[1.0]], "B": [[1.0]]}, "disturbance": {"place": None}}
    monkeypatch.setattr(runs, "_outputs", lambda x, unit: [x[0] * 0.0 + 1.0])
    for control, expected in (({"goal": [0.25]}, 2.75), ({"goal": [0.25], "gain": [[2.0]]}, 3.5), ({}, 3.0)):
        runs.loop["control"] = control
        (after,) = runs._next(parameters(np.full((1, 1), 2.0), np.zeros((1, 1))), 0.0)
        assert abs(after.c[0] - expected) < 1e-9 and after.width[0] < 1e-9


def test_cells_of_a_loop_are_of_all_its_initial_states(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "cells.sqlite") as base:
        columns = "lower, upper, verdict, margin, seconds, counterexample"
        base.execute(f"CREATE TABLE cells(frame, {columns})")
        base.execute("CREATE TABLE parameters(position, name, unit)")
        base.execute("INSERT INTO parameters VALUES (0, 'x', '')")
        base.execute("CREATE TABLE search_state(key, value)")
        base.execute("INSERT INTO cells VALUES (0, '[0.0]', '[1.0]', 'certified', 1.0, 1.0, NULL)")
    loop = {"state": ["x", "y"], "initial": {"y": 0.5, "x": [0, 1]}}
    parameters = [{"name": "x", "unit": "", "lower": 0.0, "upper": 1.0}]
    write_json(tmp_path / "report.json", {"kind": "loop", "loop": loop, "parameters": parameters})
    rewrite(tmp_path, "UPDATE cells SET margin = 2.0")
    report = json.loads((tmp_path / "report.json").read_text())
    (cells,) = read_verdicts(tmp_path, report)
    assert cells.names == ("x",) and cells.verdicts == [("certified", 2.0, None)]
    for wider in ({"x": [-1, 1], "y": 0.5}, {"x": [0, 1], "y": [0.5, 0.6]}):
        with pytest.raises(BadInput, match="other initial states"):
            read_verdicts(tmp_path, report | {"loop": loop | {"initial": wider}})


def test_errors_of_states_become_symbols() -> None:
    errors = np.array([[0.3, 0.1], [0.0, 0.2]])
    x = [Affine(np.array([1.0, 2.0]), np.array([[0.5, 0.25]]), r) for r in errors]
    for e, found in zip(x, _with_symbols(x), strict=True):
        assert not found.r.any() and np.abs(np.array(e.range()) - found.range()).max() < 1e-12
    # what two states share is none of these errors
    difference = _with_symbols(x)[0] - _with_symbols(x)[1]
    assert (difference.width >= errors.sum(axis=0)).all()


# ---------------------------------------------------------------- NeRFs


def nerf(seed: int = 0) -> tuple[NerfScene, CheckedField]:
    scene = NerfScene(tiny_weights(seed), tiny_weights(seed + 1), 0.0, 4.0)
    fine, found = scene.fine, {}
    parts = {f"mlp_base.layers.{k}": layer for k, layer in enumerate(fine.base)}
    parts |= {f"mlp_head.layers.{k}": layer for k, layer in enumerate(fine.head)}
    parts |= {"field_output_density.net": fine.density, "field_heads.0.net": fine.color}
    for name, layer in parts.items():
        found |= {f"field_fine.{name}.weight": layer.weight, f"field_fine.{name}.bias": layer.bias}
    field = CheckedField(found, 0.0, UNIFORM.far, UNIFORM.samples, UNIFORM.background)
    return scene, field


@pytest.mark.parametrize("half", [0.0, 1e-5, 1e-3])
def test_rays_contain_pictures_of_another_renderer(half: float) -> None:
    scene, field = nerf()
    theirs = view()
    ours = CheckedCamera(*(getattr(theirs, n) for n in ("camera_to_world", "fx", "fy", "cx", "cy", "width", "height")))
    renderer, poses = NerfRenderer(scene, UNIFORM), Poses(ours, ("x", "yaw"))
    low, high = np.full((1, 2), -half), np.full((1, 2), half)
    rng, widths = np.random.default_rng(0), []
    for pixel in ((0, 1), (1, 2), (2, 3), (1, 0)):
        form = field.pixels(ours, poses.view(low, high), (np.array(pixel[:1]), np.array(pixel[1:])))
        widths.append(form.r.max())
        for s in rng.uniform(-1.0, 1.0, (6, 2)):
            turn, place = poses.posed(poses.given(half * s[None], half * s[None]))
            pose = np.array([[e.c[0] for e in (*row, o)] for row, o in zip(turn, place, strict=True)])
            color = renderer.pixels(theirs, pose, np.array([pixel]))[0]
            value = form.c[0] + (s @ form.g[:, 0] if half else 0.0)
            room = form.r[0] + 1e-10
            assert (np.clip(value - room, 0, 1) <= color + 1e-12).all()
            assert (np.clip(value + room, 0, 1) >= color - 1e-12).all()
    assert max(widths) < {0.0: 1e-9, 1e-5: 1e-4, 1e-3: np.inf}[half]


@pytest.mark.parametrize("most", [0, 2, 6])
def test_neurons_that_bend_are_enclosed(most: int) -> None:
    rng = np.random.default_rng(0)
    form = Affine(rng.normal(size=(1, 2, 5)), 0.3 * rng.normal(size=(2, 1, 2, 5)), 0.1 * rng.random((1, 2, 5)))
    weight, bias = rng.normal(size=(6, 5)), rng.normal(size=6)
    found = form.with_symbols(5).dense(weight, bias).relu(most).dense(weight.T, bias[:5]).keep_symbols(2)
    for _ in range(200):
        s, e = rng.uniform(-1.0, 1.0, 2), rng.choice([-1.0, 1.0], form.c.shape)
        x = form.c + s[0] * form.g[0] + s[1] * form.g[1] + e * form.r
        y = np.maximum(x @ weight.T + bias, 0.0) @ weight + bias[:5]
        assert (np.abs(y - found.c - s[0] * found.g[0] - s[1] * found.g[1]) <= found.r + 1e-12).all()


# ---------------------------------------------------------------- files


@pytest.mark.parametrize(
    ("comments", "mode"),
    [
        (("Antialiased: 1",), "antialiased"),
        (("Antialiased 0", "SplatRenderMode: mip"), "antialiased"),
        (("SplatRenderMode: mip", "antialiased = false"), "classic"),
        ((), "classic"),
    ],
)
def test_comments_of_ply_files_choose_the_mode(comments: tuple[str, ...], mode: str, tmp_path: Path) -> None:
    file = ply(tmp_path / "scene.ply", blob_scene(5, degree=0), comments)
    report: dict[str, Any] = {
        "settings": {}, "scene": {"rasterize_mode": mode, "background": [0.0, 0.0, 0.0]},
        "renderer": {"name": "gsplat", "version": "1.4.0"}, "fingerprint": {},
    }  # fmt: skip
    with pytest.raises(BadInput, match="digest differs"):
        read_scene(file, report)
    report["scene"]["rasterize_mode"] = "classic" if mode == "antialiased" else "antialiased"
    with pytest.raises(BadInput, match="another mode"):
        read_scene(file, report)


@pytest.mark.parametrize("name", ["splat", "glb", "spz", "sog", "inria", "compressed.ply", "pt"])
def test_decoded_formats_are_checked_as_ply_files(name: str, tmp_path: Path) -> None:
    """The digest of the exported .ply is that of the bounds' scene; the file itself is refused in one line."""
    scene, file = blob_scene(20, degree=0), tmp_path / f"scene.{name}"
    if name == "pt":
        file = write_checkpoints(scene, tmp_path)
    elif name == "glb":
        write_glb(file, *glb_parts(scene))
    elif name == "sog":
        write_sog(file, *sog_parts(scene))
    elif name == "inria":
        file = write_inria(scene, tmp_path, "Namespace(sh_degree=0, white_background=False)")
    else:
        {"splat": write_splat, "spz": write_spz, "compressed.ply": write_compressed}[name](scene, file)
    method = nsa.load_scene(file).method()
    report = {
        "settings": {}, "renderer": {"name": "gsplat", "version": "1.4.0"}, "fingerprint": method.fingerprint,
        "scene": {"rasterize_mode": "classic", "background": [0.0, 0.0, 0.0]},
    }  # fmt: skip
    with pytest.raises(BadInput) as error:
        read_scene(file, report)
    assert "ns-abstract-export ply" in (error.value.fix or "")
    write_ply(method.scene, tmp_path / "exported.ply")  # pyright: ignore[reportAttributeAccessIssue]
    assert isinstance(read_scene(tmp_path / "exported.ply", report), ActivatedScene)
    write_ply(dataclasses.replace(scene, means=scene.means + np.float32(1e-3)), tmp_path / "other.ply")
    with pytest.raises(BadInput, match="digest differs"):
        read_scene(tmp_path / "other.ply", report)


def test_a_filter_is_refused(tmp_path: Path) -> None:
    scene = blob_scene(5, degree=0)
    file = ply(tmp_path / "scene.ply", scene, filter_3D=np.full(5, 0.1, np.float32))
    report = {"settings": {}, "scene": {}, "renderer": {"name": "gsplat"}, "fingerprint": {}}
    with pytest.raises(BadInput, match="filter"):
        read_scene(file, report)


@pytest.mark.parametrize("place", ["scene", "renderer"])
def test_rays_are_those_that_the_report_states(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rays = {"near": 0.0, "far": 6.0, "samples": 8, "background": [1.0, 0.5, 1.0]}
    field, digest = SimpleNamespace(**rays), hashlib.sha256()
    monkeypatch.setattr(inputs, "_read_field", lambda *_: (field, digest))
    file = write_json(tmp_path / "config.yml", {})
    report: dict[str, Any] = {"settings": {}, "fingerprint": {"scene": digest.hexdigest()}}
    report |= {"scene": {**rays, "name": "a"}, "renderer": {**rays, "name": "nerf-uniform"}}
    assert read_scene(file, report) is field
    for name, value in (("near", 1.0), ("far", 5.0), ("samples", 9), ("background", [1.0, 0.5, 0.9])):
        with pytest.raises(BadInput, match="other samples or another background"):
            read_scene(file, report | {place: {**report[place], name: value}})


def test_bands_that_are_not_drawn_are_refused(tmp_path: Path) -> None:
    """This program draws the bands up to 3; others would be left out."""
    scene = blob_scene(2, degree=3)
    more = {f"f_rest_{k}": np.full(2, 0.1, np.float32) for k in range(45, 72)}
    file = ply(tmp_path / "scene.ply", scene, **more)
    report = {"settings": {}, "scene": {}, "renderer": {"name": "gsplat"}, "fingerprint": {}}
    with pytest.raises(BadInput, match="degree 4"):
        read_scene(file, report)


@pytest.mark.parametrize(
    "given",
    [
        {"version": 2}, {"frame": "World"}, {"sweep": "segment"}, {"translation": {"X": 1.0}}, {"hue": 0.1},
        {"scene": [{"select": {}, "mean": 0.1}]}, {"translation": {"x": -1.0}}, {"translation": {"x": [0.2, -0.2]}},
        {"rotation": {"yaw": -1.0}}, {"orbit": {"target": [0, 0, 0], "axis": [0, 0, 1], "azimuth": -1.0}},
    ],
)  # fmt: skip
def test_sets_of_poses_say_nothing_that_is_passed_over(given: dict[str, Any], blobs: Inputs) -> None:
    """What is misspelt, or varies something else, would be a set without it."""
    good = {"version": 1, "$schema": "perturbation.schema.json", "translation": {"x": [-0.2, 0.2]}}
    assert [name for name, _, _ in read_poses(blobs.path, good, 0, {}, 1.0)[1]] == ["x"]
    with pytest.raises(BadInput, match="which is not checked"):
        read_poses(blobs.path, {"version": 1} | given, 0, {}, 1.0)


@pytest.mark.parametrize("change", [{"camera_type": "fisheye"}, {"crop": {"crop_scale": [1, 1, 1]}}, {"fov": 200.0}])
@pytest.mark.parametrize("inside", [False, True])
def test_pictures_of_other_cameras_are_refused(
    change: dict[str, Any], inside: bool, blobs: Inputs, tmp_path: Path
) -> None:
    path = json.loads(blobs.path.read_text())
    assert read_poses(blobs.path, {}, 0, {}, 1.0)[1] == []
    (path["camera_path"][0] if inside or "fov" in change else path).update(change)
    with pytest.raises(BadInput, match=r"not perspective|cannot be read"):
        read_poses(write_json(tmp_path / "path.json", path), {}, 0, {}, 1.0)


@pytest.mark.parametrize("cycle", [True, False])
def test_the_last_leg_of_a_cycle_is_swept(cycle: bool, blobs: Inputs, tmp_path: Path) -> None:
    path = json.loads(blobs.path.read_text()) | {"is_cycle": cycle}
    file = write_json(tmp_path / "path.json", path)
    poses, free = read_poses(file, {"version": 1, "sweep": "segments", "translation": {"x": 0.01}}, 2, {}, 1.0)
    assert [name for name, _, _ in free] == (["x", "segment"] if cycle else ["x"])
    if cycle:
        end = np.array([[0.0, 1.0]])
        first = np.array(path["camera_path"][0]["camera_to_world"]).reshape(4, 4)[:3, 3]
        assert np.abs(poses.view(end, end).origin[0] - first).max() < 1e-12


@pytest.mark.parametrize("down", [1.0, 1.7])
def test_stated_intrinsics_are_those_of_the_picture(tmp_path: Path, down: float) -> None:
    entry = {"camera_to_world": np.eye(4).reshape(-1).tolist(), "fx": 40.0, "cy": 11.25}
    root = {"render_height": 24, "render_width": 32, "fy": 41.0, "cx": 15.5, "camera_path": [entry]}
    path = tmp_path / "path.json"
    path.write_text(json.dumps(root))
    ours = load_camera_path(path, down).cameras[0].intrinsics
    checked = inputs._camera(root, entry, down)
    assert (checked.fx, checked.fy, checked.cx, checked.cy, checked.width, checked.height) == ours
    assert inputs.intrinsics({}, 90.0, 32, 24)[:2] == pytest.approx((12.0, 12.0))
