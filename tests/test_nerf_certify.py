"""Certificates of NeRFs: linear bounds of rays at tolerance zero, cells by strips, whole searches, time."""

from __future__ import annotations

import itertools
import json
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from certifying import linear
from nerfs import UNIFORM, poses, tiny_scene, view

import ns_abstract as nsa
from ns_abstract.cli import certify as command
from ns_abstract.execution.cancellation import WorkCancelledError, cancel_when
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, look_at, path_json
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf import planes as planes_module
from ns_abstract.methods.nerf import strips as strips_module
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.method import NerfMethod
from ns_abstract.methods.nerf.planes import MOST_PARTS, fit_planes
from ns_abstract.methods.nerf.render import Sampling
from ns_abstract.methods.nerf.write import write_nerf_run

SETS = {
    "orbit": {"orbit": {"target": [0, 0, 0], "axis": [0, 0.1, 1], "azimuth": [0.3, 0.4]}},
    "yaw": {"rotation": {"yaw": 0.01}},
    "segment": {"sweep": "segments"},
    "two": {"rotation": {"yaw": 0.001}, "translation": {"x": 0.001}},
    "hue": {"rotation": {"yaw": 0.001}, "hue": [0.0, 0.2]},
    "saturation": {"hue": [0.1, 0.1], "saturation": 0.2},
    "point": {"rotation": {"yaw": [0.1, 0.1]}},
}
COSTLY = np.full((3, 4, 3), 1.0)


def outside(frame: NerfFrame, box: ParameterBox, found: Any, count: int = 40) -> int:
    """Comparisons of renders in a cell with its planes and intervals that fail, at tolerance zero."""
    a_lower, b_lower, a_upper, b_upper = (np.asarray(part, np.float64) for part in found.linear)
    low, high = np.array(box.lower), np.array(box.upper)
    inside = [box.middle]
    if box.dimensions:
        inside = [box.middle, *box.corners(), *box.sample(count, np.random.default_rng(1))]
    failed = 0
    for values in inside:
        picture = frame.render(values).astype(np.float64)
        p = np.clip((values - 0.5 * (low + high)) / (0.5 * (high - low)), -1.0, 1.0) if len(low) else low
        bottom, top = b_lower + a_lower @ p, b_upper + a_upper @ p
        failed += int((~((bottom <= picture) & (picture <= top))).sum())
        failed += int((~((found.lower <= picture) & (picture <= found.upper))).sum())
    return failed


def cells(box: ParameterBox) -> list[ParameterBox]:
    """The whole set, one of many parts, and one that lies across strips."""
    found = [box]
    for parts in (5, 64):
        part = box
        for axis in range(box.dimensions):
            part = part.split(axis, parts)[parts // 2]
        found.append(part)
    return found if box.dimensions else found[:1]


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_renders_lie_between_the_planes(name: str) -> None:
    frame = NerfFrame(tiny_scene(3), UNIFORM, poses(SETS[name]))
    for box in cells(frame.box):
        for weigh in (None, lambda: COSTLY):
            found = frame.cell_bounds(box, weigh)
            assert (found.upper - found.lower).mean() < 0.5, "nothing was bounded"
            assert outside(frame, box, found) == 0


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", [0, 1])
def test_stiff_fields_lie_between_the_planes(seed: int) -> None:
    for changes in ({"density": 1e4}, {"color": 1e4}, {"rough": 20.0}):
        frame = NerfFrame(tiny_scene(seed, **changes), UNIFORM, poses({"rotation": {"yaw": 0.002}}))
        for box in cells(frame.box):
            assert outside(frame, box, frame.cell_bounds(box, lambda: COSTLY)) == 0


@pytest.mark.slow
def test_any_choice_of_samples_lies_between_the_planes() -> None:
    sampling = Sampling("hierarchical", 0.0, 4.0, 24, 8, (0.2, 0.6, 1.0))
    camera = PinholeCamera(view().camera_to_world, 5.0, 5.0, 1.0, 0.5, 2, 1)
    frame = NerfFrame(tiny_scene(3), sampling, poses({"rotation": {"yaw": 1e-4}}, camera))
    for box in cells(frame.box):
        found = frame.cell_bounds(box)
        assert (found.upper - found.lower).mean() < 0.9, "nothing was bounded"
        assert outside(frame, box, found, 10) == 0


@pytest.mark.slow
def test_planes_follow_the_pixels() -> None:
    """Most of how far pixels move over a cell goes into the slopes."""
    frame = NerfFrame(tiny_scene(3), UNIFORM, poses(SETS["orbit"]))
    box = frame.box.split(0, 8)[3]
    found = frame.cell_bounds(box, lambda: COSTLY)
    pictures = np.stack([frame.render(v) for v in np.linspace(box.lower, box.upper, 9)])
    moved = (pictures.max(axis=0) - pictures.min(axis=0)).mean()
    assert found.linear is not None
    assert (found.linear[3] - found.linear[1]).mean() < 0.7 * (found.upper - found.lower).mean()
    assert (found.linear[3] - found.linear[1]).mean() < 1.5 * moved
    assert found.slopes.shape == (1,) and found.slopes[0] > 0.0


@pytest.mark.parametrize("counts", [(7,), (3, 4), (2, 2, 3), (2 * MOST_PARTS + 5,), ()])
def test_planes_lie_beyond_every_part_exactly(counts: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    for size in (1.0, 1e-7):
        low = (0.5 + size * (rng.random((2, *counts, 3)) - 0.5)).astype(np.float32)
        high = np.minimum(low + (size * rng.random(low.shape)).astype(np.float32), np.float32(1.0))
        ends = [np.concatenate([[-1.0], np.sort(rng.uniform(-1.0, 1.0, n - 1)), [1.0]]) for n in counts]
        a_lower, b_lower, a_upper, b_upper = fit_planes(low, high, ends)
        assert (b_upper - b_lower <= (high.max() - low.min()) * 1.01 + 1e-6).all()
        for part in itertools.product(*(range(n) for n in counts)):
            corners = [[Fraction(float(e[k])), Fraction(float(e[k + 1]))] for e, k in zip(ends, part, strict=True)]
            for corner in itertools.product(*corners):
                for ray, channel in itertools.product(range(2), range(3)):
                    slopes = [[Fraction(float(v)) for v in a[ray, channel]] for a in (a_lower, a_upper)]
                    bottom, top = (sum(map(Fraction.__mul__, s, corner), Fraction(0)) for s in slopes)
                    bottom += Fraction(float(b_lower[ray, channel]))
                    top += Fraction(float(b_upper[ray, channel]))
                    assert bottom <= Fraction(float(low[(ray, *part, channel)]))
                    assert top >= Fraction(float(high[(ray, *part, channel)]))


@pytest.mark.slow
def test_what_a_cell_gets_does_not_depend_on_what_was_asked_before() -> None:
    scene, pose_set = tiny_scene(2), poses(SETS["orbit"])
    parts = pose_set.box.split(0, 16)
    fresh = NerfFrame(scene, UNIFORM, pose_set).cell_bounds(parts[5], lambda: COSTLY)
    used = NerfFrame(scene, UNIFORM, pose_set)
    for box in (parts[4], parts[6], pose_set.box):
        used.cell_bounds(box, lambda: 3.0 * COSTLY)
    again = used.cell_bounds(parts[5], lambda: COSTLY)
    assert fresh.linear is not None and again.linear is not None
    for one, other in zip(
        (*fresh.linear, fresh.lower, fresh.upper), (*again.linear, again.lower, again.upper), strict=True
    ):
        assert (one == other).all()


@pytest.mark.slow
def test_rays_that_cost_more_get_tighter_and_nothing_is_bounded_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = NerfFrame(tiny_scene(3), UNIFORM, poses(SETS["orbit"]))
    box = frame.box.split(0, 64)[20]
    loose = frame.cell_bounds(box)
    costs = np.zeros((3, 4, 3))
    costs[0] = 30.0
    tight = frame.cell_bounds(box, lambda: costs)
    assert loose.linear is not None and tight.linear is not None
    before, after = (s[3] - s[1] for s in (loose.linear, tight.linear))
    # the first group of rays holds the first two rows of the picture
    assert after[:4].mean() < 0.7 * before[:4].mean()
    assert (after[8:] == before[8:]).all()
    monkeypatch.setattr(NerfFrame, "_run", None)
    for child in box.split(0, 2):
        frame.cell_bounds(child)


# ---------------------------------------------------------------- planted faults


def half_a_part(low: Any, high: Any, ends: Any) -> Any:
    return original_united(low, high, [0.5 * e for e in ends])


original_united = planes_module.unite_parts


def other_offset(rows: Any, slope: Any, centre: Any, half: Any) -> Any:
    return (rows - slope @ centre.T).mean(axis=1)


def a_quarter_strip_on(self: Any, axis: int, count: int, first: int, past: int, parts: int) -> Any:
    lines = original_ends(self, axis, count, first, past, parts)
    return lines - 0.25 * (lines[-1] - lines[0])


original_ends = strips_module.PoseStrips._part_ends


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("target", "name", "fault"),
    [
        (planes_module, "unite_parts", half_a_part),
        (planes_module, "_offset", other_offset),
        (strips_module.PoseStrips, "_part_ends", a_quarter_strip_on),
    ],
)
def test_planted_faults_are_found(monkeypatch: pytest.MonkeyPatch, target: Any, name: str, fault: Any) -> None:
    def failed() -> int:
        frame = NerfFrame(tiny_scene(3, density=30.0), UNIFORM, poses({"rotation": {"yaw": 0.2}}))
        return sum(outside(frame, box, frame.cell_bounds(box), 10) for box in frame.box.split(0, 64)[10:50:8])

    assert failed() == 0
    monkeypatch.setattr(target, name, fault)
    assert failed() > 0


# ---------------------------------------------------------------- searches

SIDE = 6
EYE = look_at((1.6, 0.4, 0.5), (0.0, 0.0, 0.0))
ARC: dict[str, Any] = {"target": [0, 0, 0], "axis": [0, 0.1, 1], "azimuth": [0.3, 0.33]}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    return write_nerf_run(tiny_scene(3), folder, timestamp="2026-01-01_000000", experiment_name="tiny")


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network of two outputs: 20 times the mean red of the picture's left half, and 20 times that of its right."""
    rows = np.zeros((2, 3, SIDE, SIDE))
    rows[0, 0, :, : SIDE // 2] = rows[1, 0, :, SIDE // 2 :] = 20.0 / (SIDE * SIDE // 2)
    return linear(tmp_path_factory.mktemp("nets") / "halves.onnx", rows.reshape(2, -1), np.zeros(2), SIDE)


def opened(run: Path, **options: Any) -> nsa.Scene:
    return nsa.load_scene(run, num_samples=24, **options)


def small_set(orbit: dict[str, Any] | None = None, **ranges: Any) -> nsa.PoseSet:
    camera = nsa.Camera(EYE, width=SIDE, height=SIDE)
    return nsa.PoseSet(camera, orbit=orbit or ARC, **ranges)


def differences(scene: nsa.Scene, poses: nsa.PoseSet, angles: np.ndarray) -> np.ndarray:
    """What the left half of the picture has more than the right, at some angles."""
    frame = scene.method().frame(poses.of(scene))
    found = []
    for angle in angles:
        red = frame.render(np.array([angle])).reshape(SIDE, SIDE, 3)[..., 0].astype(np.float64)
        found.append(20.0 * (red[:, : SIDE // 2].mean() - red[:, SIDE // 2 :].mean()))
    return np.array(found)


def claim_above(level: float, folder: Path) -> Path:
    """A property that holds where the difference of the two outputs is above ``level``."""
    (folder / "unsafe.vnnlib").write_text(
        f"(declare-const Y_0 Real)\n(declare-const Y_1 Real)\n(assert (<= (- Y_0 Y_1) {level:.6f}))\n"
    )
    file = folder / "prop.json"
    file.write_text(json.dumps({"type": "vnnlib", "file": "unsafe.vnnlib"}))
    return file


@pytest.mark.slow
def test_an_orbit_is_certified_and_attacked(run: Path, net: Path, tmp_path: Path) -> None:
    scene, poses = opened(run), small_set()
    truth = differences(scene, poses, np.linspace(0.3, 0.33, 200))
    level = float(truth.min() - 0.2 * np.ptp(truth) - 0.02)
    found = nsa.certify(scene, poses, net, claim_above(level, tmp_path), time_budget=600.0)
    assert found.certified == 1.0 and found.guarantee == "real-sound" and found.state == "done"
    for cell in found.cells:
        angles = np.linspace(cell.lower[0], cell.upper[0], 5)
        assert cell.margin is not None and (differences(scene, poses, angles) - level > cell.margin - 1e-4).all()


@pytest.mark.slow
def test_where_it_fails_is_falsified(run: Path, net: Path, tmp_path: Path) -> None:
    scene, poses = opened(run), small_set()
    angles = np.linspace(0.3, 0.33, 400)
    truth = differences(scene, poses, angles)
    level = float(np.quantile(truth, 0.4))
    prop = claim_above(level, tmp_path)
    found = nsa.certify(scene, poses, net, prop, time_budget=600.0, output_dir=tmp_path / "out")
    assert 0.5 < found.certified < 0.61 and 0.35 < found.falsified < 0.41
    for cell in found.cells:
        inside = (angles >= cell.lower[0]) & (angles <= cell.upper[0])
        if cell.verdict == "certified":
            assert (truth[inside] > level).all()
        if cell.verdict == "falsified":
            assert cell.counterexample is not None
            assert differences(scene, poses, cell.counterexample)[0] <= level + 1e-5
    assert list((tmp_path / "out").glob("*/frame_00000_*.npz")), "no counterexample was kept"


@pytest.mark.slow
def test_colours_and_several_parameters_are_certified(run: Path, net: Path, tmp_path: Path) -> None:
    scene = opened(run)
    camera = nsa.Camera(EYE, width=SIDE, height=SIDE)
    spec = {"rotation": {"yaw": 2e-4, "roll": 2e-4}, "hue": [0.0, 0.02]}
    prop = claim_above(-15.0, tmp_path)
    found = nsa.certify(scene, nsa.PoseSet.from_json(camera, spec), net, prop, time_budget=600.0)
    assert found.certified == 1.0 and len(found.parameters) == 3


@pytest.mark.slow
def test_the_picture_is_differentiable() -> None:
    pose_set = poses({"rotation": {"yaw": 0.1}, "hue": 0.1})
    method = NerfMethod(tiny_scene(3), num_samples=24)
    shown, frame = method.differentiable(pose_set), method.frame(pose_set)
    values = torch.tensor([0.03, 0.02], dtype=torch.float64, requires_grad=True)
    picture = shown(values)
    assert np.abs(picture.detach().numpy().reshape(-1, 3) - frame.render(values.detach().numpy())[:, 0, 0]).max() < 1e-6
    (slope,) = torch.autograd.grad(picture.sum(), values)
    for axis in range(2):
        step = 1e-5 * np.eye(2)[axis]
        ends = [shown(values.detach() + torch.from_numpy(sign * step)).sum().item() for sign in (-1.0, 1.0)]
        assert float(slope[axis]) == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-3, abs=1e-4)


# ---------------------------------------------------------------- time


@pytest.mark.slow
def test_too_large_a_scene_says_what_it_would_take(run: Path, net: Path, tmp_path: Path) -> None:
    prop = claim_above(-15.0, tmp_path)
    camera = nsa.Camera(EYE, width=SIDE, height=SIDE)
    wide = nsa.PoseSet(camera, orbit={**ARC, "azimuth": [0.0, 6.0]})
    for budget in (0.01, 0.6):
        with pytest.raises(InputError) as caught:
            nsa.certify(nsa.load_scene(run, num_samples=512), wide, net, prop, time_budget=budget)
        assert caught.value.field == "--time-budget" and "36 rays" in str(caught.value)
        assert "s a ray" in str(caught.value) and "; give more" in str(caught.value)


def test_work_is_given_up_inside_a_ray() -> None:
    frame = NerfFrame(tiny_scene(3), Sampling("uniform", 0.0, 4.0, 512, 0, (0.0, 0.0, 0.0)), poses(SETS["orbit"]))
    frame.warm_up()
    asked: list[None] = []

    def over() -> bool:
        asked.append(None)
        return len(asked) > 12

    with pytest.raises(WorkCancelledError), cancel_when(over):
        frame.cell_bounds(frame.box)
    assert len(asked) == 13
    assert not frame._strips._known, "a ray that was given up is kept"


def test_command_line(
    run: Path, net: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, prop, out = tmp_path / "path.json", claim_above(-15.0, tmp_path), tmp_path / "out"
    spec = {"version": 1, "orbit": {**ARC, "azimuth": [0.3, 0.31]}}
    path.write_text(json.dumps(path_json([KeyframeCamera(EYE, 45.0, SIDE, SIDE)], perturbation=spec)))

    def call(*options: str) -> tuple[int, str]:
        given = ["--load-config", run, "--camera-path-filename", path, "--model", net, "--property", prop]
        more = ["--output-dir", out, "--num-samples", "16", "--near-plane", "0.1", "--workers", "1", *options]
        monkeypatch.setattr(sys, "argv", ["command", *map(str, given), *map(str, more)])
        with pytest.raises(SystemExit) as leave:
            command.main()
        return int(leave.value.code or 0), capsys.readouterr().err

    code, said = call("--time-budget", "600")
    assert code == 0, said
    report = json.loads((out / "report.json").read_text())
    assert report["frames"][0]["coverage"]["certified"] == 1.0 and report["guarantee"] == "real-sound"
    assert report["scene"]["samples"] == 16 and report["scene"]["near"] == 0.1
    for option, value in (("--gsplat-version", "1.5.3"), ("--arithmetic", "float32"), ("--num-samples", "0")):
        code, said = call(option, value)
        assert code == 2 and said.count("\n") == 1 and option in said
