"""The attack: honest bounds survive it, planted violations do not."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scene_attacks import bound_cells, equal_cells

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import (
    compiled_renderer,
    reference_renderer,
)
from ns_abstract.verify.attack.violations import Attack, merge

torch.set_num_threads(1)
RUNS = Path(__file__).resolve().parents[2] / "shared" / "runs"
SIDE = 20
SIX = {
    "translation": {"x": 0.1, "y": 0.1, "z": 0.1},
    "rotation": {"yaw": 0.05, "pitch": 0.05, "roll": 0.1},
}


def ball(x: float, y: float, *, deviation: float, opacity: float, color: float, depth: float = 2.0) -> dict[str, Any]:
    """A grey ball on the view axis of `camera`: pixels from the centre, standard deviation in pixels."""
    scale = depth / 30.0
    return {
        "mean": (x * scale, -y * scale, -depth),
        "log_scale": math.log(deviation * scale),
        "logit": math.log(opacity / (1.0 - opacity)),
        "sh": (color - 0.5) / 0.28209479177387814,
    }


def scene_of(*balls: dict[str, Any], background: float = 0.0) -> SplatScene:
    n = len(balls)
    return SplatScene(
        means=np.array([b["mean"] for b in balls], np.float32),
        log_scales=np.repeat(np.array([[b["log_scale"]] for b in balls], np.float32), 3, axis=1),
        quats=np.tile(np.array([[1.0, 0.0, 0.0, 0.0]], np.float32), (n, 1)),
        opacity_logits=np.array([b["logit"] for b in balls], np.float32),
        sh=np.repeat(np.array([[[b["sh"]]] for b in balls], np.float32), 3, axis=2),
        background=np.full(3, background, np.float32),
    )


def camera() -> PinholeCamera:
    return PinholeCamera(np.eye(3, 4), 30.0, 30.0, SIDE / 2, SIDE / 2, SIDE, SIDE)


def poses(spec: dict[str, Any]) -> PoseBox:
    return PoseBox.around(camera(), parse_perturbation(spec))


def crowd(seed: int = 0) -> SplatScene:
    rng = np.random.default_rng(seed)

    def one() -> dict[str, Any]:
        x, y = rng.uniform(-10, 10, 2)
        opacity, color = rng.uniform(0.2, 0.95), rng.uniform(0, 1)
        return ball(x, y, deviation=rng.uniform(0.5, 4), opacity=opacity, color=color, depth=rng.uniform(1, 4))

    return scene_of(*(one() for _ in range(25)), background=0.4)


def free_bounds() -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((SIDE, SIDE, 3), np.float32), np.ones((SIDE, SIDE, 3), np.float32)


def box_of(*limits: tuple[float, float]) -> ParameterBox:
    d = len(limits)
    low, high = zip(*limits, strict=True)
    return ParameterBox(tuple(f"p{k}" for k in range(d)), ("1",) * d, low, high)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("spec", "cells"),
    [
        ({"translation": {"x": 0.03}}, 2),
        ({"rotation": {"yaw": 0.02}}, 2),
        ({"translation": {"x": 0.02}, "rotation": {"roll": 0.02}}, (2, 1)),
    ],
)
def test_honest_bounds(spec: dict[str, Any], cells: Any) -> None:
    scene, pose_set = crowd(), poses(spec)
    render, probe = compiled_renderer(scene, pose_set, GSPLAT_1_4_0)
    other, other_probe, twin = reference_renderer(scene, pose_set, GSPLAT_1_4_0)
    boxes = equal_cells(pose_set.box, cells)
    bounds, _ = bound_cells(scene, pose_set, boxes)
    attacks = []
    for box, (lower, upper) in zip(boxes, bounds, strict=True):
        attacks.append(falsify(lower, upper, box, render, twin, probe=probe, poses=12))
        attacks.append(falsify(lower, upper, box, other, twin, probe=other_probe, poses=4, seed=1))
    total = merge(attacks)
    assert total.violations == 0 and total.worst == () and total.amount == 0.0
    assert total.poses == len(boxes) * 16
    assert total.comparisons == 3 * (total.poses * SIDE * SIDE + total.probes)
    assert total.tried["corners"] > 0 and total.tried["random"] > 0 and total.steps > 0 and total.probes > 0
    # the witnesses are inside, and not by much
    lower, upper = np.min([low for low, _ in bounds], axis=0), np.max([high for _, high in bounds], axis=0)
    assert (total.witness_lower >= lower).all() and (total.witness_upper <= upper).all()
    assert (total.witness_upper - total.witness_lower).max() > 0.5 * (upper - lower).max()


def grid_bounds(scene: SplatScene, pose_set: PoseBox, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[count, H, W, 3] images along one parameter, and their range widened by four times the largest step."""
    render, _ = compiled_renderer(scene, pose_set, GSPLAT_1_4_0)
    images = np.array([render(pose_set.box.at(np.array([s]))) for s in np.linspace(-1, 1, count)])
    step = np.abs(np.diff(images, axis=0)).max(axis=0)
    return images, images.min(axis=0) - 4.0 * step, images.max(axis=0) + 4.0 * step


@pytest.mark.slow
def test_narrow_range() -> None:
    scene, pose_set = crowd(1), poses({"translation": {"x": 0.3}})
    images, lower, upper = grid_bounds(scene, pose_set, 301)
    render, _ = compiled_renderer(scene, pose_set, GSPLAT_1_4_0)
    *_, twin = reference_renderer(scene, pose_set, GSPLAT_1_4_0)
    arguments: dict[str, Any] = {"poses": 16, "strategies": ("corners", "random", "ascent")}
    assert falsify(lower, upper, pose_set.box, render, twin, **arguments).violations == 0
    # the pixel with the highest peak inside the range
    height = images[25:-25].max(axis=0) - np.maximum(images[0], images[-1])
    place = np.unravel_index(np.argmax(height), height.shape)
    values = images[(slice(None), *place)]
    upper[place] = np.sort(values)[-3]
    share = float((values > upper[place]).mean())
    assert 0.0 < share < 0.01
    attack = falsify(lower, upper, pose_set.box, render, twin, **arguments)
    assert attack.violations > 0
    worst = attack.worst[0]
    assert (worst.row, worst.column, worst.channel) == place
    # the pose that is named does it
    assert render(np.array(worst.values))[place] == worst.value > worst.bound == upper[place]
    assert attack.amount == worst.amount == worst.value - worst.bound


@pytest.mark.slow
def test_needs_ascent() -> None:
    # the ball's centre meets the pixel's centre on a thin tube in six dimensions
    scene = scene_of(ball(0.5, 0.5, deviation=2.0, opacity=0.8, color=1.0))
    pose_set = poses(SIX)
    lower, upper = free_bounds()
    row, column = 10, 11
    upper[row, column] = 0.8 * (1.0 - 1e-4)
    render, probe = compiled_renderer(scene, pose_set, GSPLAT_1_4_0)
    *_, twin = reference_renderer(scene, pose_set, GSPLAT_1_4_0)
    attack = falsify(
        lower, upper, pose_set.box, render, twin, probe=probe, poses=60, strategies=("corners", "random", "ascent")
    )
    assert attack.violations > 0 and attack.steps > 0
    assert {(v.row, v.column) for v in attack.worst} == {(row, column)}
    # as many random poses as the ascent had poses and gradients together do not
    for seed in range(3):
        blind = falsify(lower, upper, pose_set.box, render, poses=60 + attack.steps, strategies=("random",), seed=seed)
        assert blind.poses == 60 + attack.steps
        assert blind.violations == 0


def jumping(values: np.ndarray) -> np.ndarray:
    """0.5 + 0.1 p, falling by 0.2 at p = 0.37; one pixel of four."""
    image = np.full((2, 2, 3), 0.25)
    image[1, 0] += 0.1 * values[0]
    image[0, 1, 1] = 0.5 + 0.1 * values[0] - (0.2 if values[0] >= 0.37 else 0.0)
    return image


@pytest.mark.parametrize("with_probe", [True, False])
def test_jump(with_probe: bool) -> None:
    lower, upper = np.zeros((2, 2, 3)), np.ones((2, 2, 3))
    upper[0, 1, 1] = 0.537 - 1e-9
    box = box_of((0.0, 1.0))

    def probe(values: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        return jumping(values)[pixels[:, 0], pixels[:, 1]]

    attack = falsify(lower, upper, box, jumping, probe=probe if with_probe else None, poses=150)
    assert attack.violations > 0
    worst = attack.worst[0]
    assert (worst.row, worst.column, worst.channel) == (0, 1, 1)
    # the very last value before the jump
    assert worst.values[0] < 0.37 <= np.nextafter(np.nextafter(worst.values[0], 1.0), 1.0)
    assert falsify(lower, upper, box, jumping, poses=150, strategies=("corners", "random")).violations == 0


@pytest.mark.slow
def test_threshold_of_scene() -> None:
    # moving right, a white ball leaves the pixel (alpha falls to 1/255 and then to 0) while a bright haze
    # comes in: the pixel is brightest just before the jump
    scene = scene_of(
        ball(-5.0, 0.5, deviation=1.5, opacity=0.9, color=1.0, depth=2.0),
        ball(25.0, 0.5, deviation=15.0, opacity=0.9, color=1.0, depth=2.5),
    )
    pose_set = poses({"translation": {"x": [-0.1, 0.1]}})
    row, column = 10, 10
    render, probe = compiled_renderer(scene, pose_set, GSPLAT_1_4_0)
    *_, twin = reference_renderer(scene, pose_set, GSPLAT_1_4_0)
    grid = np.linspace(-0.1, 0.1, 401)
    values = np.array([render(np.array([x]))[row, column, 0] for x in grid])
    k = int(np.argmin(np.diff(values)))
    assert values[k] - values[k + 1] > 1e-3
    low, high = grid[k], grid[k + 1]
    for _ in range(60):
        middle = 0.5 * (low + high)
        if render(np.array([middle]))[row, column, 0] < values[k]:
            high = middle
        else:
            low = middle
    top = float(render(np.array([low]))[row, column, 0])
    # the box ends before the haze makes up for it
    box = pose_set.box.replace(0, low - 0.01, low + 1e-3)
    assert max(render(v)[row, column, 0] for v in (*box.corners(), *box.sample(300, np.random.default_rng(0)))) < top
    lower, upper = free_bounds()
    upper[row, column] = top - 1e-7
    attack = falsify(lower, upper, box, render, twin, probe=probe, poses=80)
    assert attack.violations > 0
    assert 0.0 <= low - attack.worst[0].values[0] < 1e-9
    blind = falsify(lower, upper, box, render, poses=200, strategies=("corners", "random"))
    assert blind.violations == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bounds_not_finite(bad: float) -> None:
    lower, upper = free_bounds()
    upper[3, 4, 1] = bad
    lower[5, 6, 2] = bad
    attack = falsify(lower, upper, box_of((0.0, 1.0)), lambda _: np.full((SIDE, SIDE, 3), 0.5), poses=5)
    assert attack.violations == attack.not_finite == 2
    assert attack.amount == math.inf
    assert {(v.row, v.column, v.channel) for v in attack.worst} == {(3, 4, 1), (5, 6, 2)}


def test_image_not_finite() -> None:
    def render(values: np.ndarray) -> np.ndarray:
        image = np.full((SIDE, SIDE, 3), 0.5)
        if values[0] > 0.0:
            image[7, 8, 0] = np.nan
        image[0, 0, 0] = 2.0
        return image

    attack = falsify(*free_bounds(), box_of((-1.0, 1.0)), render, poses=20, strategies=("corners", "random"))
    assert 0 < attack.not_finite < 20
    assert attack.violations == attack.not_finite + 20
    assert math.isnan(attack.worst[0].amount) and (attack.worst[0].row, attack.worst[0].column) == (7, 8)
    assert attack.worst[1].amount == 1.0
    # images that were numbers still count as witnesses
    assert attack.witness_lower[7, 8, 0] == 0.5
    always = falsify(*free_bounds(), box_of((-1.0, 1.0)), lambda _: np.full((SIDE, SIDE, 3), np.nan), poses=3)
    assert always.violations == 3 * SIDE * SIDE * 3
    assert np.isnan(always.witness_lower).all() and len(always.worst) == 16


def test_touching_is_inside() -> None:
    image = np.full((SIDE, SIDE, 3), np.float64(np.float32(0.3)))
    touching = image.astype(np.float32)
    box = box_of((0.0, 1.0))
    assert falsify(touching, touching, box, lambda _: image, poses=3).violations == 0
    assert falsify(touching, touching, box, lambda _: np.nextafter(image, 1.0), poses=3).violations == 3 * image.size
    assert falsify(touching, touching, box, lambda _: np.nextafter(image, 0.0), poses=3).violations == 3 * image.size


def test_crossed_bounds() -> None:
    lower, upper = free_bounds()
    lower[2, 2, 2], upper[2, 2, 2] = 0.6, 0.4
    attack = falsify(lower, upper, box_of((0.0, 1.0)), lambda _: np.full((SIDE, SIDE, 3), 0.5), poses=4)
    assert attack.violations == 4


def same(a: Attack, b: Attack) -> bool:
    return (
        (a.poses, a.probes, a.steps, a.violations, a.tried) == (b.poses, b.probes, b.steps, b.violations, b.tried)
        and np.array_equal(a.witness_lower, b.witness_lower)
        and np.array_equal(a.witness_upper, b.witness_upper)
        and np.array_equal(a.closest, b.closest)
    )


def test_deterministic() -> None:
    scene, pose_set = crowd(2), poses(SIX)
    render, probe = compiled_renderer(scene, pose_set, GSPLAT_1_4_0)
    *_, twin = reference_renderer(scene, pose_set, GSPLAT_1_4_0)
    runs = [falsify(*free_bounds(), pose_set.box, render, twin, probe=probe, poses=24, seed=seed) for seed in (3, 3, 4)]
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


@pytest.mark.parametrize("dimensions", [1, 3, 6, 8])
def test_corners_and_budget(dimensions: int) -> None:
    seen: list[np.ndarray] = []

    def render(values: np.ndarray) -> np.ndarray:
        seen.append(values)
        return np.full((2, 2, 3), 0.5)

    box = box_of(*[(-1.0, float(k + 1)) for k in range(dimensions)])
    bounds = np.zeros((2, 2, 3)), np.ones((2, 2, 3))
    attack = falsify(*bounds, box, render, poses=400, starts=[box.upper], strategies=("given", "corners", "random"))
    assert attack.poses == len(seen) == 400
    assert np.array_equal(seen[0], box.upper) and np.array_equal(seen[1], box.middle)
    at_corner = [v for v in seen[2:] if all(x in (a, b) for x, a, b in zip(v, box.lower, box.upper, strict=True))]
    assert len({tuple(v) for v in at_corner}) == min(2**dimensions, 64)
    assert all(box.contains(v) for v in seen)
    assert attack.tried["given"] == 1 and attack.tried["random"] == 400 - 2 - min(2**dimensions, 64)


def test_single_pose_and_no_time() -> None:
    scene, pose_set = crowd(3), poses({})
    assert pose_set.box.dimensions == 0
    render, _ = compiled_renderer(scene, pose_set, GSPLAT_1_4_0)
    attack = falsify(*free_bounds(), pose_set.box, render, poses=50)
    assert attack.poses == 1 and np.array_equal(attack.witness_lower, attack.witness_upper)
    idle = falsify(*free_bounds(), box_of((0.0, 1.0)), render, seconds=0.0)
    assert idle.poses == idle.comparisons == 0 and np.isnan(idle.witness_lower).all()


def test_refused() -> None:
    lower, upper = free_bounds()
    box = box_of((0.0, 1.0))
    with pytest.raises(ValueError, match="bounds"):
        falsify(lower[..., 0], upper[..., 0], box, lambda _: lower)
    with pytest.raises(ValueError, match="image"):
        falsify(lower, upper, box, lambda _: lower[:5])
    with pytest.raises(ValueError, match="strategies"):
        falsify(lower, upper, box, lambda _: lower, strategies=("luck",))


def test_twin_is_the_renderer() -> None:
    scene, pose_set = crowd(4), poses(SIX)
    render, probe = compiled_renderer(scene, pose_set, GSPLAT_1_4_0)
    other, other_probe, twin = reference_renderer(scene, pose_set, GSPLAT_1_4_0)
    pixels = np.array([[0, 0], [3, 17], [19, 19], [16, 2]])
    for values in pose_set.box.sample(4, np.random.default_rng(0)):
        image = render(values)
        assert np.abs(other(values) - image).max() <= 1e-9
        picked = image[pixels[:, 0], pixels[:, 1]]
        assert np.array_equal(probe(values, pixels), picked)
        assert np.abs(other_probe(values, pixels) - picked).max() <= 1e-9
        assert np.abs(twin(torch.from_numpy(values), torch.from_numpy(pixels)).numpy() - picked).max() <= 1e-9


def run_files() -> tuple[Path, Path]:
    folder = RUNS / "playbot_lod4"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    return next(iter(sorted(folder.glob("splatfacto/*/config.yml")))), folder / "camera_path.json"


def test_equal_cells() -> None:
    box = box_of((0.0, 1.0), (2.0, 4.0))
    assert [cell.upper[0] for cell in equal_cells(box, 2)] == [0.5, 1.0]
    cells = equal_cells(box, (2, 3))
    assert len(cells) == 6
    assert math.isclose(sum(np.prod(np.array(c.upper) - c.lower) for c in cells), 2.0)


def test_merge() -> None:
    lower, upper = free_bounds()
    box = box_of((0.0, 1.0))
    upper[1, 1, 1] = 0.75
    parts = [falsify(lower, upper, box, lambda _, v=v: np.full((SIDE, SIDE, 3), v), poses=3) for v in (0.5, 1.0)]
    total = merge(parts)
    assert total.poses == 6 and total.violations == 3
    assert total.worst == parts[1].worst and replace(total.worst[0], amount=0.25) == total.worst[0]
    assert (total.witness_lower == 0.5).all() and (total.witness_upper == 1.0).all()
