"""Networks trained on renders: what training computes, and what the files in benchmarks/networks are said to be."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from benchmark_scripts import BENCHMARKS, script
from torch import nn

import ns_abstract as nsa
from ns_abstract.demo.paths import airfield_orbit
from ns_abstract.demo.scenes import splat_scene
from ns_abstract.demo.writing import write_demo
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import load_network
from ns_abstract.verify.preprocess import Preprocess
from ns_abstract.verify.sub_box_proof import SubBoxOutcome, SubBoxProof

NETWORKS = BENCHMARKS / "networks"


@pytest.fixture(scope="module")
def scripts() -> Any:
    return SimpleNamespace(
        objects=script("objects"), train=script("train_views"), views=script("views"), certify=script("certify_views")
    )


def judge(name: str) -> NetworkModel:
    return judge_of(NETWORKS / f"{name}.onnx")


def judge_of(file: Path) -> NetworkModel:
    return NetworkModel(load_network(file), Preprocess(), 1 << 28)


def moving(scripts: Any, side: int = 16) -> tuple[SplatMethod, PoseBox]:
    """A car on the lawn, and a set of poses of two parameters."""
    things, seed, far, elevation = scripts.objects.RUNS["car"]
    view = scripts.train.around((0.0, 0.0, 0.1), 25.0, elevation, far)
    camera = nsa.Camera(view.camera_to_world, view.fov, side, side)
    perturbation = Perturbation(translation={"x": (-0.2, 0.2), "z": (-0.1, 0.1)})
    return SplatMethod(scripts.objects.scene(things, seed), None, None), PoseBox.around(camera, perturbation)


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_rows_of_outputs_are_tighter_than_their_parts(scripts: Any) -> None:
    """Differences of outputs over random sets hold what the network gives, and depend on weights once."""
    torch.manual_seed(0)
    model, count = scripts.views.head(16, 3).double(), 3
    middle, radius = torch.rand(4, 3, 16, 16).double(), 0.02 * torch.rand(4, 3, 16, 16).double()
    slopes = 0.02 * torch.randn(4, 2, 3, 16, 16).double()
    rows, _ = scripts.train.class_loss(torch.zeros(4, dtype=torch.long), count)
    with torch.no_grad():
        centre, along, rest = scripts.views.ranges(model, middle, slopes, radius, rows.double())
        parts = scripts.views.ranges(model, middle, slopes, radius)
        for _ in range(200):
            p, r = (torch.sign(torch.randn(4, n).double()) for n in (2, 3 * 256))
            outputs = model(middle + (slopes * p[:, :, None, None, None]).sum(1) + radius * r.reshape(middle.shape))
            found = (outputs[:, :, None] - outputs[:, None]).flatten(1)
            assert bool(((found - centre - (along * p[..., None]).sum(1)).abs() <= rest + 1e-12).all())
    combined = (parts[2][:, :, None] + parts[2][:, None]).flatten(1)
    off = [1, 2, 3, 5, 6, 7]
    assert bool((rest <= combined + 1e-12).all())
    assert float((rest / combined)[:, off].mean()) < 0.95 and float(rest[:, [0, 4, 8]].max()) == 0.0


def test_loss_of_classes_is_the_cross_entropy_of_the_worst(scripts: Any) -> None:
    """Over points it is the cross-entropy of the outputs; over intervals, of every other class at its best."""
    torch.manual_seed(0)
    outputs, right, which = torch.randn(6, 4), torch.randint(4, (9,)), torch.tensor([0, 3, 8, 1, 1, 5])
    rows, loss = scripts.train.class_loss(right, 4)
    zero = torch.zeros(6, 1, 16)
    found = loss((outputs @ rows.T, zero, zero[:, 0]), which, 1.0)
    torch.testing.assert_close(found, nn.functional.cross_entropy(outputs, right[which]))
    wide = loss((outputs @ rows.T, zero + 0.1, zero[:, 0] + 0.2), which, 1.0)
    worst = outputs + 0.3 * (1.0 - nn.functional.one_hot(right[which], 4))
    # the class itself is as far ahead of itself as 0 less the same
    ahead = outputs.gather(1, right[which][:, None]) - worst
    ahead[torch.arange(6), right[which]] -= 0.3
    torch.testing.assert_close(wide, nn.functional.cross_entropy(-ahead, right[which]))


def test_signed_members_are_members_and_worse(scripts: Any) -> None:
    torch.manual_seed(0)
    model = scripts.views.head(16, 4)
    middle, radius = torch.rand(8, 3, 16, 16), 0.03 * torch.rand(8, 3, 16, 16)
    slopes, right = 0.02 * torch.randn(8, 1, 3, 16, 16), torch.arange(8) % 4

    def loss(outputs: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        return nn.functional.cross_entropy(outputs, right[which])

    which = torch.arange(8)
    found = scripts.views.signed(model, (middle, slopes, radius), loss, which)
    assert bool(((found - middle).abs() <= radius + slopes.abs().sum(1) + 1e-6).all())
    noise = middle + radius * torch.sign(torch.randn_like(middle))
    with torch.no_grad():
        assert loss(model(found), which) > loss(model(noise), which) > 0.0
        assert loss(model(found), which) > loss(model(middle), which)


@pytest.mark.slow
@pytest.mark.parametrize("training", ["signs", "certified"])
def test_classifiers_learn_scenes_that_vary(scripts: Any, training: str, tmp_path: Path) -> None:
    """Of a run that shows one kind, and of things before its background; all trainings write what they trained."""
    config, path = scripts.objects.write_run(tmp_path, "car")
    file = tmp_path / "net.onnx"
    words = ["classifier", str(file), "--run", str(config), "--path", str(path), "--kind-of-run", "car", "--side", "16"]
    words += ["--color", "0.05", "--opacity", "0.05", "--training", training, "--pictures", "80", "--cells", "16"]
    options = scripts.train.parser().parse_args([*words, "--steps", "120"])
    torch.manual_seed(0)
    scripts.train.classifier(options)
    more = {"scene": [{"select": {}, "color": 0.05, "opacity": 0.05}]}
    run = scripts.train.Turning(config, path, 16, more)
    values = run.whole.box.sample(12, np.random.default_rng(3))
    rng = np.random.default_rng(4)
    shown = torch.stack([scripts.train.shown_member(run.method, run.whole, v, rng) for v in values])
    outputs = judge_of(file).outputs(shown.permute(0, 2, 3, 1).numpy())
    assert (outputs.argmax(axis=1) == list(scripts.objects.KINDS).index("car")).sum() >= 10


def test_things_before_a_background(scripts: Any) -> None:
    """No lawn, and nothing but the background where no thing is."""
    thing = scripts.objects.RUNS["boat"][0][0]
    white = scripts.objects.scene([thing], 0, np.ones(3))
    assert white.count == len(thing.blobs()[0])
    method, poses = scripts.train.photographed(
        [thing], np.random.default_rng(0), scripts.train.Stand((1.2, 1.3)), 16, None, np.ones(3)
    )
    image = scripts.views.pictures(method, poses, np.zeros((1, 0)))[0]
    assert 0.3 < float((image == 1.0).all(dim=0).float().mean()) < 0.95 and float(image.min()) < 0.6


def test_boxes_of_things_of_a_run_hold_what_they_change(scripts: Any, tmp_path: Path) -> None:
    config, path = scripts.objects.write_run(tmp_path, "lawn")
    words = ["detector", "NET", "--run", str(config), "--path", str(path), "--things", "lawn", "--x", "0.2"]
    options = scripts.train.parser().parse_args([*words, "--pictures", "6"])
    images, boxes, kinds = scripts.train.photos_of_run(options, np.random.default_rng(0))
    things, seed, _, _ = scripts.objects.RUNS["lawn"]
    names = list(scripts.objects.KINDS)
    poses = nsa.PoseSet(
        scripts.train.load_camera_path(path).cameras[0], translation={"x": 0.2, "y": 0.2, "z": 0.2},
        rotation={"yaw": 0.7, "pitch": 0.05, "roll": 0.05},
    )  # fmt: skip
    drawn = scripts.train.resized(poses.of(nsa.load_scene(config)), 64, 64)
    values = drawn.box.sample(6, np.random.default_rng(0))
    values[::2, 3:] *= 0.05
    seen = 0
    for image, found, numbers, v in zip(images, boxes, kinds, values, strict=True):
        for box, number in zip(found.tolist(), numbers.tolist(), strict=True):
            rest = [thing for thing in things if thing.kind != names[number]]
            without = SplatMethod(scripts.objects.scene(rest, seed), None, None)
            changed = (scripts.views.pictures(without, drawn, v[None])[0] - image).abs().amax(0) > 0.1
            down, across = (changed.nonzero().float().mean(0) + 0.5).tolist()
            assert box[0] < across < box[2] and box[1] < down < box[3]
            seen += 1
    assert seen >= 9


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
    poses = PoseBox.around(camera, Perturbation(translation=translation))
    values = poses.box.sample(12, np.random.default_rng(5))
    shown = scripts.views.pictures(SplatMethod(splat_scene("airfield"), None, None), poses, values)
    outputs = judge("estimator_airfield").outputs(shown.permute(0, 2, 3, 1).numpy())
    truth = scripts.train.truths(value["perturbation"]["orbit"]["target"], poses, values)
    assert scripts.train.within(torch.from_numpy(outputs), truth, 0.1) >= 0.9


@pytest.mark.slow
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


@pytest.mark.slow
def test_parts_are_proved_for_all_colours(scripts: Any, tmp_path: Path) -> None:
    """What certified training is for: the plainly trained network is right, but not proved, on the same parts."""
    row = scripts.certify.ROWS["car, orbit, certified, color 0.05"]
    config, path = scripts.objects.write_run(tmp_path, row.scene)
    scene, camera = nsa.load_scene(config), scripts.train.load_camera_path(path).cameras[0]
    orbit = {**scripts.train.orbit_of(path), "azimuth": [0.0, 2.0 * np.pi]}
    value = {"version": 1, "orbit": orbit, "scene": row.perturbation["scene"]}
    poses, found = nsa.PoseSet.from_json(camera, value).of(scene), {}
    for name in (row.network, "classifier_things"):
        source = scripts.certify.PropertySource.of(row.property)
        question = scripts.certify.Question(NETWORKS / f"{name}.onnx", source)
        pictures = scripts.certify.FramePictures(scene.method(), scripts.train.resized(poses, 32, 32))
        proved, shown = scripts.certify.margins(pictures, question, 1000, 100)
        assert (proved <= shown).all() and len(proved) == 10
        found[name] = float((proved > 0.0).mean()), float((shown > 0.0).mean())
    assert found[row.network] == (1.0, 1.0)
    assert found["classifier_things"][0] < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("name", "shift", "turn"), [("airfield, x", 0.01, 0.01), ("lawn, car", 0.03, 0.02)])
def test_slanted_parts_of_an_estimator_and_a_detector(
    scripts: Any, name: str, shift: float, turn: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cells whose parts make up for a shift by a turn are proved, and no attack breaks them."""
    covered: list[SubBoxOutcome] = []

    def watched(self: SubBoxProof, *arguments: Any) -> SubBoxOutcome:
        covered.append(prove(self, *arguments))
        return covered[-1]

    prove = SubBoxProof.prove
    monkeypatch.setattr(SubBoxProof, "prove", watched)
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
