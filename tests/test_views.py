"""Networks trained on renders: what training computes, and what the files in benchmarks/networks are said to be."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import ns_abstract as nsa
from ns_abstract.demo.airfield import airfield
from ns_abstract.demo.paths import airfield_orbit
from ns_abstract.demo.writing import write_demo
from ns_abstract.geometry.poses import PoseSet
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.verify.cover import Cover, Covered
from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import load_network
from ns_abstract.verify.preprocess import Preprocess

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
NETWORKS = BENCHMARKS / "networks"
if not NETWORKS.is_dir():
    pytest.skip("the benchmarks are not beside the tests", allow_module_level=True)


@pytest.fixture(scope="module")
def scripts() -> Any:
    """The modules of the benchmarks, which import each other by their plain names."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import certify_views
        import objects
        import train_views
        import views
    finally:
        sys.path.remove(str(BENCHMARKS))
    return SimpleNamespace(objects=objects, train=train_views, views=views, certify=certify_views)


def judge(name: str) -> NetworkModel:
    return NetworkModel(load_network(NETWORKS / f"{name}.onnx"), Preprocess(), 1 << 28)


def moving(scripts: Any, side: int = 16) -> tuple[SplatMethod, PoseSet]:
    """A car on the lawn, and a set of poses of two parameters."""
    things, seed, far, elevation = scripts.objects.RUNS["car"]
    view = scripts.train.around((0.0, 0.0, 0.1), 25.0, elevation, far)
    camera = nsa.Camera(view.camera_to_world, view.fov, side, side)
    perturbation = Perturbation(translation={"x": (-0.2, 0.2), "z": (-0.1, 0.1)})
    return SplatMethod(scripts.objects.scene(things, seed), None, None), PoseSet.around(camera, perturbation)


def test_ranges_hold_what_the_network_gives(scripts: Any) -> None:
    """Outputs on members of random sets lie in the ranges, also at their ends, and the ranges are no wider than plain
    interval arithmetic makes them."""
    torch.manual_seed(0)
    model = scripts.views.head(16, 3).double()
    middle, radius = torch.rand(4, 3, 16, 16).double(), 0.01 * torch.rand(4, 3, 16, 16).double()
    slopes = 0.02 * torch.randn(4, 2, 3, 16, 16).double()
    with torch.no_grad():
        centre, along, rest = scripts.views.ranges(model, middle, slopes, radius)
        for _ in range(200):
            p, r = (torch.rand(4, n).double() * 2 - 1 for n in (2, 3 * 256))
            p, r = (torch.sign(x) if torch.rand(()) < 0.5 else x for x in (p, r))
            shown = middle + (slopes * p[:, :, None, None, None]).sum(1) + radius * r.reshape(middle.shape)
            linear = centre + (along * p[..., None]).sum(1)
            assert bool(((model(shown) - linear).abs() <= rest + 1e-12).all())
        still = scripts.views.ranges(model, middle, 0 * slopes, radius + slopes.abs().sum(1))
        assert bool((along.abs().sum(1) + rest < 0.8 * still[2]).all())


def test_cells_hold_their_renders(scripts: Any) -> None:
    method, poses = moving(scripts)
    values, half = poses.box.sample(3, np.random.default_rng(0)), np.array([0.004, 0.002])
    sets = scripts.views.cells(method, poses, values, half)
    rng = np.random.default_rng(1)
    for k in range(3):
        for p in (*rng.uniform(-1.0, 1.0, (5, 2)), np.array([1.0, -1.0])):
            shown = scripts.views.pictures(method, poses, (sets.values[k] + p * sets.half[k])[None])[0]
            line = sets.middle[k] + torch.from_numpy(np.tensordot(p, sets.slopes[k].numpy(), 1))
            # single precision, which is enough for training
            assert bool(((shown - line).abs() <= sets.radius[k] + 1e-5).all())
    assert float(sets.radius.mean()) < 0.02


@pytest.mark.parametrize("certified", [0.0, 0.5])
def test_training_learns(scripts: Any, certified: float, tmp_path: Path) -> None:
    """A few steps on pictures of a car, with and without cells; the file gives what the trained network gives."""
    torch.manual_seed(0)
    method, poses = moving(scripts)
    values = poses.box.sample(120, np.random.default_rng(0))
    images, origin = scripts.views.pictures(method, poses, values), [0.0, 0.0, 0.1]
    truth = scripts.train.truths(origin, poses, values)
    model, size = scripts.views.head(16, 3), truth.norm(dim=1)
    with torch.no_grad():
        model[-1].bias.copy_(truth.mean(dim=0))
    sets = scripts.views.cells(method, poses, values[:20], np.array([0.004, 0.002]))
    set_loss = scripts.train.regression_loss(sets, poses, origin, 0.1)
    whole = torch.arange(20)

    def loss(outputs: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        return (((outputs - truth[which]) / size[which, None]) ** 2).sum(dim=1).mean() / 0.01

    def bounded() -> float:
        with torch.no_grad():
            return float(set_loss(scripts.views.ranges(model, sets.middle, sets.slopes, sets.radius), whole, 1.0))

    with torch.no_grad():
        before = scripts.train.within(model(images), truth, 0.05)
    first = bounded()
    more = {"sets": sets, "set_loss": set_loss, "weight": certified} if certified else {}
    assert scripts.views.fit(model, images, loss, steps=150, **more) == 150
    with torch.no_grad():
        outputs = model(images)
    assert scripts.train.within(outputs, truth, 0.05) > before + 0.3
    if certified:
        assert bounded() < 0.5 * first
    file = tmp_path / "net.onnx"
    scripts.views.export(model, 16, file)
    found = NetworkModel(load_network(file), Preprocess(), 1 << 28).outputs(images[:2].permute(0, 2, 3, 1).numpy())
    np.testing.assert_allclose(found, outputs[:2].numpy(), atol=1e-4)


def test_head_of_the_detector(scripts: Any) -> None:
    """What is trained stands where the detection property looks for it; nothing else is ever said."""
    torch.manual_seed(0)
    kinds = scripts.objects.KINDS
    used = nn.Conv2d(8, 1 + len(kinds) + 4, 1)
    features = torch.rand(1, 8, 4, 4)
    with torch.no_grad():
        objectness, classes, boxes = scripts.train.decode(scripts.train.whole_head(used)(features).flatten(1), 8.0)
        given = used(features)[0]
    np.testing.assert_allclose(objectness[0, 0], torch.sigmoid(given[0]), rtol=1e-5)
    assert float(objectness[0, 1:].max()) < 1e-3
    ratio = classes[0, 0, kinds["car"]] / classes[0, 0, kinds["boat"]]
    order = list(kinds)
    rows = given[1 + order.index("car")] - given[1 + order.index("boat")]
    np.testing.assert_allclose(ratio, torch.exp(rows), rtol=1e-4)
    width = boxes[0, 0, 2] - boxes[0, 0, 0]
    anchor = scripts.train.ANCHORS[0][0]
    np.testing.assert_allclose(width, 8.0 * anchor * torch.exp(given[1 + len(kinds) + 2]), rtol=1e-4)


# ---------------------------------------------------------------- the files


def test_networks_are_small_and_described() -> None:
    text = (NETWORKS / "README.md").read_text(encoding="utf-8")
    files = sorted(NETWORKS.glob("*.onnx"))
    assert len(files) >= 5
    for file in files:
        assert file.stat().st_size < 1_000_000 and f"`{file.stem}`" in text, file.name
    assert sum(file.stat().st_size for file in NETWORKS.rglob("*") if file.is_file()) < 2_000_000


def test_classifier_and_detector_of_things(scripts: Any) -> None:
    """On new pictures about as good as the README says."""
    rng, kinds = np.random.default_rng(77), list(scripts.objects.KINDS)
    classifier, right = judge("classifier_things"), 0
    for k in range(40):
        thing = scripts.objects.random_thing(rng, kinds[k % 4], 0.06)
        image, _ = scripts.train.photo([thing], rng, "classifier", 32)
        right += int(classifier.outputs(image.permute(1, 2, 0).numpy()[None])[0].argmax() == k % 4)
    assert right >= 37
    detector, found, there = judge("detector_things"), 0, 0
    options = SimpleNamespace(pictures=25, side=64)
    for image, boxes, numbers in zip(*scripts.train.photos_of_things(options, rng), strict=True):
        outputs = torch.from_numpy(detector.outputs(image.permute(1, 2, 0).numpy()[None]))
        objectness, classes, where = scripts.train.decode(outputs, 8.0)
        score = (objectness[:, :, None] * classes).flatten(3)[0]
        for box, number in zip(boxes, numbers.tolist(), strict=True):
            said = score[:, scripts.objects.KINDS[kinds[number]]].reshape(-1) > scripts.train.CONFIDENCE
            shown = where[0].movedim(1, -1).reshape(-1, 4)[said]
            found += bool((scripts.train.overlaps(box[None], shown) > 0.5).any())
            there += 1
    assert found >= 0.8 * there > 30


def test_estimator_of_the_airfield(scripts: Any) -> None:
    value = airfield_orbit(64)
    camera = nsa.Camera(np.reshape(value["camera_path"][0]["camera_to_world"], (4, 4)), 45.0, 64, 64)
    translation = {"x": (-0.35, 0.35), "y": (-0.1, 0.1), "z": (-0.15, 0.15)}
    poses = PoseSet.around(camera, Perturbation(translation=translation))
    values = poses.box.sample(12, np.random.default_rng(5))
    shown = scripts.views.pictures(SplatMethod(airfield(), None, None), poses, values)
    outputs = judge("estimator_airfield").outputs(shown.permute(0, 2, 3, 1).numpy())
    truth = scripts.train.truths(value["perturbation"]["orbit"]["target"], poses, values)
    assert scripts.train.within(torch.from_numpy(outputs), truth, 0.1) >= 0.9


@pytest.mark.parametrize("name", ["car, orbit", "lawn, car"])
def test_a_part_is_certified(scripts: Any, name: str, tmp_path: Path) -> None:
    """A narrow part of the row's set, and no attack breaks it."""
    row = scripts.certify.ROWS[name]
    narrow = {"orbit": {"azimuth": [0.5, 0.51]}} if "orbit" in row.perturbation else {"translation": {"x": 0.002}}
    part = scripts.certify.Row(row.network, row.scene, narrow, row.property, (4,))
    config, path = scripts.objects.write_run(tmp_path, row.scene)
    file, scene = NETWORKS / f"{row.network}.onnx", nsa.load_scene(config)
    line = scripts.certify.certify(name, part, file, scene, path, tmp_path / "row", 1.0, attacks=10)
    assert "| 100.0% | 100.0% | 1.000 |" in line and "10 / 0" in line


@pytest.mark.parametrize(("name", "shift", "turn"), [("airfield, x", 0.01, 0.01), ("lawn, car", 0.03, 0.02)])
def test_slanted_parts_of_an_estimator_and_a_detector(
    scripts: Any, name: str, shift: float, turn: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cells whose parts make up for a shift by a turn are proved, and no attack breaks them."""
    covered: list[Covered] = []

    def watched(self: Cover, *arguments: Any) -> Covered:
        covered.append(prove(self, *arguments))
        return covered[-1]

    prove = Cover.prove
    monkeypatch.setattr(Cover, "prove", watched)
    row = scripts.certify.ROWS[name]
    if row.scene == "airfield":
        config, files = write_demo(tmp_path)
        path = files["orbit"]
    else:
        config, path = scripts.objects.write_run(tmp_path, row.scene)
    narrow = {"translation": {"x": shift}, "rotation": {"yaw": turn}}
    part = scripts.certify.Row(row.network, row.scene, narrow, row.property, (16, 16))
    file, scene = NETWORKS / f"{row.network}.onnx", nsa.load_scene(config)
    line = scripts.certify.certify(name, part, file, scene, path, tmp_path / "row", 1.0, attacks=40)
    assert "| 100.0% | 100.0% | 1.000 |" in line and "40 / 0" in line
    assert any(found.margin is not None and found.parts > 1 for found in covered)
