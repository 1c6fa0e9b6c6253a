"""Scenes of which Gaussians vary: selections, scene samples, and bounds attacked over poses and scenes."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import SHIFT, Inputs, blob_scene
from scene_attacks import VariedAttack, attack_varied, check_varied, show_compiled, show_reference

from ns_abstract.api.files import Settings, open_job
from ns_abstract.arithmetic.rounding import FLOAT32, REAL, Arithmetic
from ns_abstract.bench.sets import splat_of
from ns_abstract.cli import render as render_command
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat import bounds as bounds_module
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.bounds import CellBounds, SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import outward
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.variations import VariedSplats, selected, vary
from ns_abstract.perturbation.specification import load_perturbation, parse_perturbation

NONE = np.empty((0, 3))


def logit(p: float) -> float:
    return float(np.log(p / (1.0 - p)))


def layers(*gaussians: dict, background=(0.2, 0.3, 0.4), degree: int = 0, **options) -> SplatScene:
    """A scene from ``mean``, ``scale``, ``opacity`` and ``color`` (or ``sh`` [K, 3])."""
    sh = [g.get("sh", [(np.array(g.get("color", (1.0, 1.0, 1.0))) - 0.5) / 0.28209479177387814]) for g in gaussians]
    values = {
        "means": [g["mean"] for g in gaussians],
        "log_scales": [np.broadcast_to(np.log(g["scale"]), 3) for g in gaussians],
        "quats": [(1.0, 0.0, 0.0, 0.0)] * len(gaussians),
        "opacity_logits": [logit(g["opacity"]) for g in gaussians],
        "sh": sh,
    }
    arrays = {name: np.array(value, np.float32) for name, value in values.items()}
    return SplatScene(**arrays, sh_degree=degree, background=np.array(background, np.float32), **options)  # type: ignore[arg-type]


class Case:
    """A scene, a camera that looks along -z from ``height``, and what varies."""

    def __init__(self, scene: SplatScene, spec: dict, height: float = 0.0, size: int = 16, focal: float = 16.0) -> None:
        pose = np.concatenate([np.eye(3), [[0.0], [0.0], [height]]], axis=1)
        self.camera = PinholeCamera(pose, focal, focal, size / 2, size / 2, size, size)
        perturbation = parse_perturbation(spec)
        self.scene, self.splats = scene, activate(scene, GSPLAT_1_4_0)
        self.poses = PoseBox.around(self.camera, perturbation)
        self.varied = vary(scene, self.splats, perturbation.scene)

    def cell(self, bounds: SplatBounds, box: ParameterBox | None = None, candidates=None) -> CellBounds:
        box = self.poses.box if box is None else box
        order = 2 if box.dimensions == 1 else 1
        return bounds.cell(self.camera, self.poses.enclosure(box, order), candidates=candidates)

    def attack(
        self, bounds: SplatBounds | None = None, box: ParameterBox | None = None, candidates=None,
        arithmetic: Arithmetic = REAL, scene_samples: int = 22, targets: int = 6,
    ) -> tuple[VariedAttack, np.ndarray, CellBounds]:  # fmt: skip
        """Bound and attack a box; the attack, the width of the bounds, and the bounds."""
        bounds = bounds or SplatBounds(self.splats, GSPLAT_1_4_0, arithmetic, self.varied)
        cell = self.cell(bounds, box, candidates)
        assert cell.statistics[4] == 0
        lower, upper = outward(assemble(cell.lower, self.camera), assemble(cell.upper, self.camera))
        shows = [show_compiled(Renderer(self.splats, GSPLAT_1_4_0), self.poses)]
        for dtype in (torch.float64, torch.float32) if arithmetic is FLOAT32 else (torch.float64,):
            shows.append(show_reference(Reference(self.scene, GSPLAT_1_4_0, dtype), self.poses))
        found = attack_varied(
            lower, upper, self.poses.box if box is None else box, self.varied, shows, self.scene, self.poses,
            GSPLAT_1_4_0, scene_samples=scene_samples, targets=targets,
        )  # fmt: skip
        return found, upper - lower, cell


def scene_of(**ranges) -> list[dict]:
    return [{"select": {}, **ranges}]


POSES = {
    0: {},
    1: {"translation": {"x": 0.01}},
    3: {"translation": {"y": 0.004, "z": [0, 0.01]}, "rotation": {"yaw": 0.004}},
}
EVERYTHING = {"mean": 0.02, "opacity": [-0.3, 0.1], "color": [-0.4, 0.2]}


@pytest.mark.slow_cases
@pytest.mark.parametrize("dimensions", [0, 1, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_blobs(degree: int, dimensions: int) -> None:
    """Everything varies, of some Gaussians, seen through view-dependent colours."""
    scene = blob_scene(24, seed=degree, degree=degree)
    spec = POSES[dimensions] | {"scene": [{"select": {"box": [[-1, -1, -1], [1, 1, 0.2]]}, **EVERYTHING}]}
    found, _, _ = Case(scene, spec, height=1.5).attack()
    assert found.violations == 0 and found.pictures["gradient"] == 2 * 4 * 6


@pytest.mark.slow
@pytest.mark.parametrize("dimensions", [0, 3])
def test_float32_blobs(dimensions: int) -> None:
    """Float32 evaluations of scene samples, whose values are rounded to float32, lie inside as well."""
    scene = replace(blob_scene(24, degree=1), rasterize_mode="antialiased")
    found, _, _ = Case(scene, POSES[dimensions] | {"scene": scene_of(**EVERYTHING)}, height=1.5).attack(
        arithmetic=FLOAT32
    )
    assert found.violations == 0 and found.comparisons >= 3 * 46 * 16 * 16 * 3


def test_sigmoid_colors_stay_below_one() -> None:
    scene = replace(blob_scene(24, degree=0), color_model="sigmoid")
    case = Case(scene, {"scene": scene_of(color=0.5)}, height=1.5)
    found, width, _ = case.attack()
    assert found.violations == 0
    assert width.sum() < 1.01 * (found.most - found.least).sum()


def test_one_mean_that_varies() -> None:
    """Two layers of one mean have no certain order where their means vary apart."""
    near = {"mean": (0.0, 0.0, -5.0), "scale": 0.8, "opacity": 0.9}
    case = Case(
        layers({**near, "color": (1.0, 0.1, 0.0)}, {**near, "color": (0.0, 0.9, 1.0)}), {"scene": scene_of(mean=0.015)}
    )
    found, _, _ = case.attack()
    assert found.violations == 0 and (found.most - found.least).max() > 0.1


def swap() -> Case:
    """Two layers at nearly one depth, whose order the ranges of their means decide."""
    return Case(
        layers(
            {"mean": (-0.2, 0.0, -5.0), "scale": 0.8, "opacity": 0.9, "color": (1.0, 0.1, 0.0)},
            {"mean": (0.2, 0.1, -5.02), "scale": 0.8, "opacity": 0.8, "color": (0.0, 0.9, 1.0)},
        ),
        {"scene": scene_of(mean=0.015)},
    )


def test_depth_order() -> None:
    case = swap()
    found, _, cell = case.attack()
    assert found.violations == 0 and cell.statistics[2] > 0
    # both orders were really rendered: the colours in front differ by far more than the motion
    assert (found.most - found.least).max() > 0.5
    # ranges that leave the order certain
    apart = replace(case.varied, mean_low=case.splats.means - 0.009, mean_high=case.splats.means + 0.009)
    cell = case.cell(SplatBounds(case.splats, GSPLAT_1_4_0, REAL, apart))
    assert cell.statistics[2] == 0


@pytest.mark.parametrize("dimensions", [0, 1])
def test_alpha_threshold(dimensions: int) -> None:
    """Opacities about 1/255, and pixels where moving means cross the threshold."""
    scene = layers(
        {"mean": (0.0, 0.0, -3.0), "scale": 0.4, "opacity": 0.004},
        {"mean": (0.1, 0.0, -2.0), "scale": 0.1, "opacity": 0.5},
        {"mean": (5.0, 0.0, -3.0), "scale": 0.1, "opacity": 0.9},
    )
    spec = POSES[dimensions] | {"scene": scene_of(opacity=0.001, mean=0.05)}
    found, _, _ = Case(scene, spec).attack()
    assert found.violations == 0


@pytest.mark.parametrize("dimensions", [0, 1])
def test_near_plane(dimensions: int) -> None:
    """The near plane, and the camera itself, inside a Gaussian's range."""
    scene = layers(
        {"mean": (0.0, 0.0, -0.012), "scale": 0.01, "opacity": 0.7},
        {"mean": (0.2, 0.1, -0.02), "scale": 0.3, "opacity": 0.4, "color": (0.1, 0.9, 0.1)},
        {"mean": (0.0, 0.0, -2.0), "scale": 0.3, "opacity": 0.9, "color": (0.9, 0.2, 0.1)},
    )
    spec = POSES[dimensions] | {"scene": scene_of(mean=0.03)}
    found, _, _ = Case(scene, spec).attack()
    assert found.violations == 0 and (found.most - found.least).max() > 0.3


def test_inner_cells() -> None:
    """What a cell's context leaves out is invisible in every scene of the set."""
    scene = blob_scene(40, degree=0)
    spec = {"translation": {"x": 0.2}, "scene": scene_of(mean=0.02, opacity=0.2)}
    case = Case(scene, spec, height=1.5, focal=50.0)
    bounds = SplatBounds(case.splats, GSPLAT_1_4_0, REAL, case.varied)
    around = case.cell(bounds, case.poses.box.split(0, 4)[0])
    assert around.visible.size < scene.count
    found, _, _ = case.attack(bounds, case.poses.box.split(0, 16)[1], around.visible)
    assert found.violations == 0


@pytest.mark.parametrize("quantity", ["mean", "opacity", "color"])
def test_planted(quantity: str) -> None:
    """Bounds that ignore a range do not survive the attack."""
    case = Case(blob_scene(24, degree=1), {"scene": scene_of(mean=0.02, opacity=0.1, color=0.1)}, height=1.5)
    varied = case.varied
    if quantity == "mean":
        mutant = replace(varied, mean_low=NONE, mean_high=NONE)
    elif quantity == "opacity":
        mutant = replace(varied, opacity_low=case.splats.opacity, opacity_high=case.splats.opacity)
    else:
        mutant = replace(varied, shift_low=NONE, shift_high=NONE)
    found, _, _ = case.attack(SplatBounds(case.splats, GSPLAT_1_4_0, REAL, mutant))
    assert found.violations > 0 and found.amount > 1e-3


def direction_case(dimensions: int) -> Case:
    """One huge Gaussian near the camera, whose colour depends on the direction to its mean."""
    sh = np.zeros((4, 3))
    sh[1:] = 1.0
    scene = layers({"mean": (0.0, 0.0, -0.5), "scale": 20.0, "opacity": 0.9, "sh": sh}, degree=1)
    return Case(scene, POSES[dimensions] | {"scene": scene_of(mean=0.1)})


@pytest.mark.slow_cases
@pytest.mark.parametrize("dimensions", [0, 1])
def test_directions(dimensions: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mean that moves changes the direction it is seen from; colours that ignore it are found."""
    case = direction_case(dimensions)
    assert case.attack()[0].violations == 0
    fixed, stages = bounds_module.fixed_colors, SplatBounds.stages
    monkeypatch.setattr(
        bounds_module, "fixed_colors", lambda scene, *rest: fixed(scene._replace(mean_radius=NONE), *rest)
    )

    def moving(indices, scene, *rest):
        stages.moving_colors(indices, scene._replace(mean_radius=NONE), *rest)

    monkeypatch.setattr(SplatBounds, "stages", stages._replace(moving_colors=moving))
    assert case.attack()[0].violations > 0


def test_planted_depth_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Depth orders taken for certain though means move."""
    case = swap()
    stages = SplatBounds.stages

    def certain(*arguments):
        lists, pixels, inputs, bounds = arguments
        gaussians = inputs.gaussians._replace(depth_error=np.zeros_like(inputs.gaussians.depth_error))
        stages.pixel_stage(lists, pixels, inputs._replace(gaussians=gaussians), bounds)

    monkeypatch.setattr(SplatBounds, "stages", stages._replace(pixel_stage=certain))
    assert case.attack()[0].violations > 0


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("dimensions", [0, 1, 3])
def test_nothing_varies(degree: int, dimensions: int) -> None:
    """Ranges of width 0 give the bounds of the scene alone, bit by bit, and its pictures."""
    case = Case(blob_scene(24, degree=degree), POSES[dimensions] | {"scene": scene_of(mean=0, opacity=0, color=0)}, 1.5)
    alone = case.cell(SplatBounds(case.splats, GSPLAT_1_4_0, FLOAT32))
    with_ranges = case.cell(SplatBounds(case.splats, GSPLAT_1_4_0, FLOAT32, case.varied))
    assert not case.varied.varies
    assert alone.lower.tobytes() == with_ranges.lower.tobytes() and alone.upper.tobytes() == with_ranges.upper.tobytes()
    # without the key no array is made for ranges
    fixed = VariedSplats.fixed(case.splats)
    assert fixed.mean_radius.size == fixed.shift_low.size == 0 and fixed.nearest is case.splats
    view = case.poses.world_to_camera(case.poses.box.middle)
    renderer = Renderer(case.splats, GSPLAT_1_4_0)
    assert np.array_equal(
        renderer.image(case.camera, *view), renderer.image(case.camera, *view, scene_sample=case.varied.nearest)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "ranges, most", [({"color": 0.1}, 1.001), ({"opacity": 0.1}, 1.06), ({"mean": 0.005}, 2.4), (EVERYTHING, 2.4)]
)
def test_tightness(ranges: dict, most: float) -> None:
    """Mean width of the bounds against the width that scene samples show."""
    case = Case(blob_scene(24, degree=0), {"scene": scene_of(**ranges)}, height=1.5)
    found, width, _ = case.attack(scene_samples=40, targets=40)
    assert found.violations == 0
    ratio = width.mean() / (found.most - found.least).mean()
    assert 1.0 <= ratio < most


# --- selections --------------------------------------------------------------------------------


def picked(scene: SplatScene, folder: Path | None = None, **select) -> list[int]:
    entry = parse_perturbation({"scene": [{"select": select, "mean": 0.1}]}, folder=folder).scene[0]
    return np.flatnonzero(selected(scene, activate(scene, GSPLAT_1_4_0).opacity, entry.select)).tolist()


def test_selections(tmp_path: Path) -> None:
    scene = layers(
        {"mean": (0, 0, 0), "scale": 1, "opacity": 0.1, "color": (1, 0, 0)},
        {"mean": (1, 0, 0), "scale": 1, "opacity": 0.5, "color": (0, 1, 0)},
        {"mean": (0, 1, 0), "scale": 1, "opacity": 0.9, "color": (0, 0, 1)},
        {"mean": (2, 2, 2), "scale": 1, "opacity": 0.9, "color": (1, 1, 1)},
    )
    np.save(tmp_path / "some.npy", np.array([3, 1, 1], np.uint16))
    (tmp_path / "some.txt").write_text("3\n1 ")
    write_json(tmp_path / "some.json", [1, 3])
    assert picked(scene) == [0, 1, 2, 3]
    assert picked(scene, box=[[0, 0, 0], [1, 1, 1]]) == [0, 1, 2]
    assert picked(scene, opacity=[0.4, 0.6]) == [1]
    assert picked(scene, color={"min": [0.5, 0, 0]}) == [0, 3]
    assert picked(scene, color={"min": [0.5, -1, -1], "max": [2, 0.5, 0.5]}) == [0]
    for indices in ([3, 1, 1], "some.npy", "some.txt", "some.json"):
        assert picked(scene, tmp_path, indices=indices) == [1, 3]
    assert picked(scene, tmp_path, indices="some.txt", box=[[0, 0, 0], [1, 1, 1]], opacity=[0.4, 1]) == [1]
    # numbers are those of the source, where it holds Gaussians that are never drawn
    thinned = replace(scene, dropped={"zero quaternion": 2}, stored=np.array([0, 2, 4, 5]))
    assert picked(thinned, indices=[1, 2, 5]) == [1, 3]


def test_overlapping_ranges() -> None:
    """Quantity by quantity, the smallest range that holds those of all entries that pick the Gaussian."""
    scene = layers(*({"mean": (k, 0, 0), "scale": 1, "opacity": 0.95} for k in range(3)))
    entries = [
        {"select": {"indices": [0, 1]}, "mean": [0.1, 0.2], "opacity": 0.1},
        {"select": {"indices": [1, 2]}, "mean": 0.05},
    ]
    varied = vary(scene, activate(scene, GSPLAT_1_4_0), parse_perturbation({"scene": entries}).scene)
    assert np.allclose(varied.mean_low - scene.means, np.array([0.1, -0.05, -0.05])[:, None])
    assert np.allclose(varied.mean_high - scene.means, np.array([0.2, 0.2, 0.05])[:, None])
    assert np.allclose(varied.opacity_low, [0.85, 0.85, 0.95]) and np.allclose(varied.opacity_high, [1, 1, 0.95])
    assert varied.counts == {"mean": 3, "opacity": 2, "color": 0}
    # the scene sample nearest to the stored scene is in the set
    assert (varied.nearest.means >= varied.mean_low).all() and (varied.nearest.means <= varied.mean_high).all()
    assert np.allclose(varied.nearest.means[0, 0], 0.1)


def test_members_lie_in_the_set() -> None:
    case = Case(blob_scene(24, degree=1), {"scene": scene_of(**EVERYTHING)})
    varied, generator = case.varied, np.random.default_rng(0)
    for scene_sample, _ in zip(varied.scene_samples(generator), range(40), strict=False):
        assert ((varied.mean_low <= scene_sample.means) & (scene_sample.means <= varied.mean_high)).all()
        assert ((varied.opacity_low <= scene_sample.opacity) & (scene_sample.opacity <= varied.opacity_high)).all()
        assert ((varied.shift_low <= scene_sample.color_shift) & (scene_sample.color_shift <= varied.shift_high)).all()


@pytest.mark.parametrize(
    "select, field",
    [
        ({"box": [[5, 5, 5], [6, 6, 6]]}, "scene[0].select"),
        ({"opacity": [1.5, 2]}, "scene[0].select"),
        ({"color": {"min": [9, 9, 9]}}, "scene[0].select"),
        ({"indices": [0, 24]}, "scene[0].select.indices"),
        ({"indices": [0], "opacity": [0.0, 0.0]}, "scene[0].select"),
    ],
)
def test_nothing_picked(select: dict, field: str) -> None:
    scene = blob_scene(24)
    perturbation = parse_perturbation({"scene": [{"select": select, "mean": 0.1}]}, field_prefix="")
    with pytest.raises(InputError) as caught:
        vary(scene, activate(scene, GSPLAT_1_4_0), perturbation.scene)
    assert caught.value.field == field


@pytest.mark.parametrize(
    "name, content",
    [
        ("a.npy", b"\x93NUMPY"),
        ("a.npy", b"not numpy"),
        ("a.txt", b"1 -2"),
        ("a.txt", b"1.5"),
        ("a.txt", b""),
        ("a.txt", b"9" * 30),
        ("a.json", b'{"a": 1}'),
        ("a.json", b"[1, true]"),
        ("a.json", b"[1"),
        ("a.json", b"[]"),
        ("a.csv", b"1"),
    ],
)
def test_index_files_refused(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    write_json(tmp_path / "spec.json", {"scene": [{"select": {"indices": name}, "mean": 0.1}]})
    with pytest.raises(InputError) as caught:
        load_perturbation(tmp_path / "spec.json")
    assert caught.value.field == "scene[0].select.indices" and caught.value.file == str(tmp_path / "spec.json")


@pytest.mark.parametrize(
    "array", [np.array([0.0]), np.array([[1]]), np.array(["a"]), np.array(1), np.array([2**63], np.uint64)]
)
def test_index_arrays_refused(array: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InputError):
        parse_perturbation({"scene": [{"select": {"indices": "a.npy"}, "mean": 0.1}]}, folder=tmp_path)


# --- end to end --------------------------------------------------------------------------------


def render(options: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["ns-abstract-render", *options])
    with pytest.raises(SystemExit) as leave:
        render_command.main()
    assert isinstance(leave.value.code, int)
    return leave.value.code


@pytest.mark.slow
@pytest.mark.parametrize("poses", [{}, SHIFT])
def test_command(poses: dict, make_blobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Alone and with poses: the command's result contains scene samples of the set, and the report counts them."""
    entry = {"select": {"box": [[-1, -1, -1], [0, 1, 1]], "indices": "some.json"}, **EVERYTHING}
    inputs: Inputs = make_blobs(spec=poses | {"scene": [entry]})
    write_json(inputs.spec.parent / "some.json", list(range(40)))
    assert render(inputs.options(tmp_path / "out", frames=[0], time_budget=10, target_ratio=3), monkeypatch) == 0
    with np.load(tmp_path / "out" / "frame_00000.npz") as result:
        lower, upper = result["lower"], result["upper"]
        assert (lower <= result["witness_lower"]).all() and (result["witness_upper"] <= upper).all()
        assert (result["witness_upper"] - result["witness_lower"]).max() > 0.1
    job = open_job(Settings(inputs.config, inputs.path, inputs.spec))
    pose_set, splat = job.pose_sets[0], splat_of(job)
    varied = splat.varied(pose_set.perturbation.scene)
    text = f"the opacity of {varied.counts['opacity']} of 50 Gaussians varies"
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert 0 < varied.counts["opacity"] < 40 and text in " ".join(report["frames"][0]["plan"])
    shows = [show_compiled(Renderer(splat.splats, splat.rasteriser), pose_set)]
    found = attack_varied(
        lower, upper, pose_set.box, varied, shows, splat.scene, pose_set, splat.rasteriser, scene_samples=30, targets=6
    )
    assert found.violations == 0


def test_command_refuses(make_blobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    inputs: Inputs = make_blobs(spec={"scene": [{"select": {"box": [[5, 5, 5], [6, 6, 6]]}, "mean": 0.1}]})
    assert render(inputs.options(tmp_path / "out"), monkeypatch) == 2
    error = capsys.readouterr().err
    assert "spec.json" in error and "scene[0].select" in error and "picks none" in error


def test_fingerprint(make_blobs, tmp_path: Path) -> None:
    """Results are mixed only where what varies is the same."""
    inputs: Inputs = make_blobs()
    found = []
    for index, radius in ((0, 0.1), (1, 0.1), (0, 0.2), (0, 0.1)):
        write_json(inputs.spec, SHIFT | {"scene": [{"select": {"indices": [index]}, "mean": radius}]})
        found.append(open_job(Settings(inputs.config, inputs.path, inputs.spec)).fingerprint["poses"])
    assert found[0] == found[3] and len(set(found)) == 3


def test_check(blobs: Inputs) -> None:
    spec = SHIFT | {"scene": [{"select": {"opacity": [0.5, 1]}, "opacity": 0.1}]}
    found = check_varied(blobs.config, blobs.path, spec, 0, 2, scene_samples=6, targets=2, downscale_factor=2)
    assert found["violations"] == 0 and found["pictures"] == 2 * 2 * (7 + 2 * 4)
    assert 0.0 < found["mpg_witness"] < found["mpg"] < found["xpg"]
