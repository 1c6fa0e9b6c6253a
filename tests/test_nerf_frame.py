"""Abstract images of a NeRF: attacked at tolerance zero, refined, degenerate sets, skipped work."""

from __future__ import annotations

import dataclasses
import os
import signal

import numpy as np
import pytest
import torch
from nerfs import BINS, UNIFORM, images, pixels_of, poses, tiny_scene

from ns_abstract.arithmetic.rounding import UNIT32
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.nerf import frame as frame_module
from ns_abstract.methods.nerf import sample_cells
from ns_abstract.methods.nerf.bounds import NerfBounds
from ns_abstract.methods.nerf.division import Division
from ns_abstract.methods.nerf.field import Field
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.ray_field import RayBounds
from ns_abstract.methods.nerf.render import NerfRenderer, Sampling
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.refine.engine import Refinement, RefinementGoal, groups
from ns_abstract.refine.result import FrameResult, joined
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import nerf_renderer

SETS = {
    "point": {"rotation": {"yaw": [0.1, 0.1]}},
    "yaw": {"rotation": {"yaw": 0.004}},
    "roll": {"rotation": {"roll": [0.1, 0.11]}},
    "shift": {"translation": {"x": 0.004}},
    "world": {"frame": "world", "translation": {"z": 0.003}, "rotation": {"pitch": [0.02, 0.02]}},
    "orbit": {"orbit": {"target": [0, 0, 0], "axis": [0, 0.1, 1], "azimuth": [0.3, 0.306]}},
    "yaw and shift": {"rotation": {"yaw": 0.0005}, "translation": {"x": 0.0005}},
    "three": {"rotation": {"yaw": 0.0001, "roll": 0.0001}, "translation": {"y": 0.0001}},
    "six": {
        "rotation": {"yaw": 2e-7, "roll": 2e-7, "pitch": 2e-7},
        "translation": {"x": 2e-7, "y": 2e-7, "z": 2e-7},
    },
}
FIELDS = {
    "plain": {},
    "spikes": {"density": 1e4},
    "saturated": {"color": 1e4},
    "rough": {"rough": 20.0},
}


def attack(scene: NerfScene, pose_set: PoseBox, found: RayBounds, poses_tried: int = 60) -> tuple[int, int]:
    """Comparisons and violations of random poses, corners, gradient ascent and jumps."""
    camera = pose_set.camera
    shape = (camera.height, camera.width, 3)
    render, probe, twin = nerf_renderer(scene, pose_set, UNIFORM)
    result = falsify(
        found.lower.reshape(shape), found.upper.reshape(shape), pose_set.box, render, twin,
        probe=probe, poses=poses_tried, seed=1,
    )  # fmt: skip
    return result.comparisons, result.violations


def bounded(scene: NerfScene, pose_set: PoseBox, tolerance: float = 0.02) -> RayBounds:
    return NerfBounds(scene, UNIFORM, pose_set.box.dimensions).rays(
        pose_set, pose_set.box, pixels_of(pose_set.camera), tolerance
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_sets_of_poses_are_enclosed(name: str) -> None:
    scene, pose_set = tiny_scene(3), poses(SETS[name])
    found = bounded(scene, pose_set)
    assert (found.upper - found.lower).mean() < 0.5, "nothing was bounded"
    compared, violations = attack(scene, pose_set, found)
    assert compared > 0 and violations == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", FIELDS)
def test_stiff_fields_are_enclosed(name: str) -> None:
    for seed, spec in enumerate(({"rotation": {"yaw": 0.002}}, {"translation": {"x": 2e-4}})):
        scene, pose_set = tiny_scene(seed, **FIELDS[name]), poses(spec)
        assert attack(scene, pose_set, bounded(scene, pose_set, 0.05))[1] == 0


def test_a_single_pose_is_one_colour() -> None:
    scene, pose_set = tiny_scene(0), poses(SETS["point"])
    found = NerfFrame(scene, UNIFORM, pose_set).bound(pose_set.box, np.arange(12))
    assert (found.upper - found.lower).max() < 2e-3
    picture = images(scene, pose_set, np.zeros((1, 0)))[0]
    assert (found.lower[:, 0, 0] <= picture).all() and (picture <= found.upper[:, 0, 0]).all()


def test_far_too_wide_boxes_say_nothing() -> None:
    scene, pose_set = tiny_scene(0), poses({"rotation": {"yaw": 3.0}, "translation": {"x": 5.0}})
    found = bounded(scene, pose_set)
    assert (found.lower == 0.0).all() and (found.upper == 1.0).all() and found.cells == 0


@pytest.mark.slow
@pytest.mark.parametrize("spec", [SETS["yaw"], SETS["yaw and shift"]], ids=["one", "two"])
def test_refinement_approaches_the_truth(spec: dict) -> None:
    scene, pose_set = tiny_scene(2, density=30.0), poses(spec)
    frame = NerfFrame(scene, UNIFORM, pose_set)
    result = Refinement(frame, 0, RefinementGoal(ratio=1.2, seconds=120.0, cells=400)).run()
    gaps = [point.mpg for point in result.trace]
    assert gaps == sorted(gaps, reverse=True)
    assert result.trace[-1].mpg <= 1.25 * result.trace[-1].mpg_witness
    many = images(scene, pose_set, pose_set.box.sample(200, np.random.default_rng(0)))
    for picture in many:
        assert (result.lower.reshape(-1, 3) <= picture).all() and (picture <= result.upper.reshape(-1, 3)).all()


@pytest.mark.slow
@pytest.mark.parametrize("sampling", [UNIFORM, BINS], ids=["uniform", "hierarchical"])
@pytest.mark.parametrize("yaw", [1e-5, 1e-6])
def test_bounds_of_narrow_sets_are_as_tight_as_their_renders_vary(yaw: float, sampling: Sampling) -> None:
    scene, pose_set = tiny_scene(0), poses({"rotation": {"yaw": yaw}})
    result = Refinement(
        NerfFrame(scene, sampling, pose_set), 0, RefinementGoal(ratio=1.45, seconds=300.0, cells=128)
    ).run()
    assert 0.0 < result.trace[-1].mpg < 1.5 * result.trace[-1].mpg_witness
    for picture in images(scene, pose_set, pose_set.box.sample(40, np.random.default_rng(0)), sampling):
        assert (result.lower.reshape(-1, 3) <= picture).all() and (picture <= result.upper.reshape(-1, 3)).all()


def test_a_tolerance_is_not_finer_than_bounds_are_kept() -> None:
    for yaw, least, most in ((1e-12, UNIT32, UNIT32), (1e-6, UNIT32, 1e-6), (0.1, 5e-4, 5e-4)):
        frame = NerfFrame(tiny_scene(0), UNIFORM, poses({"rotation": {"yaw": yaw}}))
        part = frame.box.split(0, 1 << 12)[0]
        assert least <= frame._tolerance(part) <= most


@pytest.mark.slow
def test_the_whole_set_costs_nothing_and_rays_come_in_batches() -> None:
    scene, pose_set = tiny_scene(0), poses(SETS["yaw"])
    frame = NerfFrame(scene, UNIFORM, pose_set)
    whole = frame.bound(pose_set.box, np.arange(12))
    assert (whole.lower == 0.0).all() and (whole.upper == 1.0).all()
    sizes = []
    bound = frame.bound_parts
    frame.tiles_at_once = 5
    frame.bound_parts = lambda boxes, tiles, *rest: sizes.append(len(tiles)) or bound(boxes, tiles, *rest)  # type: ignore[method-assign]
    Refinement(frame, 0, RefinementGoal(ratio=1.0, seconds=60.0, cells=9)).run()
    assert sizes[0] == 12 and max(sizes[1:]) <= 5


@pytest.mark.slow
@pytest.mark.parametrize("density", [8.0, 1e4])
def test_colours_of_samples_that_add_nothing_are_not_needed(density: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same pictures as where slopes are asked for and every colour is, but for the order of sums of fewer rows."""
    scene, pose_set = tiny_scene(2, density=density), poses(SETS["point"])
    renderer, points = NerfRenderer(scene, UNIFORM), []
    color = Field.color
    monkeypatch.setattr(
        Field, "color", lambda field, base, *rest: points.append(base[..., 0].numel()) or color(field, base, *rest)
    )
    pose = torch.from_numpy(pose_set.pose(pose_set.box.middle))
    whole = renderer.picture(pose_set.camera, pose.clone().requires_grad_()).detach().reshape(-1, 3)
    picture = renderer.pixels(pose_set.camera, pose.numpy(), pixels_of(pose_set.camera))
    # on some processors matrix libraries choose the order of a sum by the number of rows: a unit of float64
    assert np.abs(picture - whole.numpy()).max() <= 2.0**-52
    assert (points[1] < 0.9 * points[0]) == (density > 1e3)


def unreached(result: FrameResult) -> int:
    return int(((result.lower == 0.0) & (result.upper == 1.0)).all(axis=-1).sum())


@pytest.mark.slow
@pytest.mark.parametrize("parts", [1, 2])
def test_what_is_known_is_not_begun_anew(parts: int) -> None:
    """Rays that an earlier command has not reached come first, and nothing gets looser."""
    scene, pose_set = tiny_scene(2, density=30.0), poses(SETS["yaw"])
    frame = NerfFrame(scene, UNIFORM, pose_set)
    frame.tiles_at_once = 2

    def found(known: FrameResult | None) -> FrameResult:
        goal = RefinementGoal(ratio=1.0, seconds=120.0, cells=12 // parts)
        some = [Refinement(frame, 0, goal, tiles=tiles, earlier=known).run_part() for tiles in groups(frame, parts)]
        return joined(some, frame.camera)

    results = [found(None)]
    assert 2 < unreached(results[0]) < 12
    while unreached(results[-1]):
        results.append(found(results[-1]))
        before, now = results[-2:]
        assert unreached(now) < unreached(before)
        assert (before.lower <= now.lower).all() and (now.upper <= before.upper).all()
        assert (now.witness_lower <= before.witness_lower).all() and (before.witness_upper <= now.witness_upper).all()
        assert parts > 1 or now.trace[0].mpg <= before.trace[-1].mpg
    for picture in images(scene, pose_set, pose_set.box.sample(50, np.random.default_rng(0))).reshape(-1, 3, 4, 3):
        assert (results[-1].lower <= picture).all() and (picture <= results[-1].upper).all()


@pytest.mark.slow
def test_what_is_known_holds_of_a_frame_that_is_stopped_at_once() -> None:
    frame = NerfFrame(tiny_scene(2), UNIFORM, poses(SETS["yaw"]))
    before = Refinement(frame, 0, RefinementGoal(ratio=1.0, seconds=120.0, cells=12)).run()
    now = Refinement(frame, 0, RefinementGoal(ratio=1.0, seconds=0.0), earlier=before).run()
    assert now.bounded and np.array_equal(now.lower, before.lower) and np.array_equal(now.upper, before.upper)


@pytest.mark.slow
def test_children_skip_what_is_empty_and_stay_sound() -> None:
    scene, pose_set = tiny_scene(5, density=20.0), poses(SETS["yaw"])
    rays = NerfBounds(scene, UNIFORM, 1)
    pixels = pixels_of(pose_set.camera)
    parent = rays.rays(pose_set, pose_set.box, pixels, 0.05)
    child = pose_set.box.split(0, 4)[2]
    again = rays.rays(pose_set, child, pixels, 0.05)
    skipping = rays.rays(pose_set, child, pixels, 0.05, parent.alpha)
    assert (parent.alpha < 1e-4).any() and skipping.cells < again.cells
    inside = dataclasses.replace(pose_set, box=child)
    assert attack(scene, inside, skipping)[1] == 0


def test_linear_sets_contain_the_bounds() -> None:
    frame = NerfFrame(tiny_scene(0), UNIFORM, poses(SETS["yaw"]))
    found = frame.bound(frame.box.split(0, 4)[1], np.arange(3), None, True)
    assert found.linear is not None
    for array, shape in zip(found.linear, ((3, 1, 1, 3, 1), (3, 1, 1, 3)) * 2, strict=True):
        assert array.shape == shape and array.dtype == np.float32


@pytest.mark.parametrize("finer", [0, 1])
@pytest.mark.parametrize("axes", [(), (0,), (0, 0, 0), (1, 0, 1, 2)])
def test_divisions_are_nested_covers(axes: tuple[int, ...], finer: int) -> None:
    d = 3 if 2 in axes else max(axes, default=0) + 1
    division = Division(axes, d, finer)
    total = int(np.prod(division.parts))
    assert division.below[-1] == -1 and len(division.below) == division.levels + 1
    for level in range(division.levels + 1):
        members, (low, high) = division.members(level), division.boxes(level)
        assert sorted(members.ravel()) == list(range(total))
        # the parts of a cell in their own order, which bounds of parts are in
        assert (np.diff(members, axis=1) > 0).all()
        assert np.prod(high - low, axis=1).sum() == pytest.approx(2.0**d)
        below = division.below[level]
        if below < 0:
            continue
        cells = np.arange(len(low))
        children, finer_members = division.children(level, cells), division.members(below)
        assert below > level and len(children) == 2 * len(cells)
        for k, cell in enumerate(np.tile(cells, 2)):
            assert set(finer_members[children[k]]) <= set(members[cell])


# ---------------------------------------------------------------- planted faults


def composite_without_ends(self) -> tuple[np.ndarray, np.ndarray]:
    """Takes the lower opacity for both ends."""
    self.alpha_high = self.alpha_low
    return original_composite(self)


original_composite = sample_cells.SampleCellBounds._composite


def stop_too_early(self) -> float:
    return 0.9


def wrong_parts(value, bernstein):
    low, high, error = original_parts(value, bernstein)
    return low[:, :1].expand_as(low), high[:, :1].expand_as(high), error


original_parts = sample_cells.bounds_by_part


def narrow_pencil(self, *arguments) -> None:
    original_pencil(self, *arguments)
    self.direction = self.direction.copy()
    self.direction[:, 1:] *= 0.9


original_pencil = sample_cells.RayBundle.__init__


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "name", "fault"),
    [
        (sample_cells.SampleCellBounds, "_composite", composite_without_ends),
        (sample_cells, "bounds_by_part", wrong_parts),
        (sample_cells.RayBundle, "__init__", narrow_pencil),
    ],
)
def test_planted_faults_are_found(monkeypatch: pytest.MonkeyPatch, target, name: str, fault) -> None:
    scene, pose_set = tiny_scene(3, density=30.0), poses(SETS["yaw"])
    assert attack(scene, pose_set, bounded(scene, pose_set))[1] == 0
    monkeypatch.setattr(target, name, fault)
    assert attack(scene, pose_set, bounded(scene, pose_set))[1] > 0


@pytest.mark.slow
def test_bounds_that_are_no_numbers_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(value, bernstein):
        low, high, error = original_parts(value, bernstein)
        return low * float("nan"), high, error * float("nan")

    scene, pose_set = tiny_scene(3), poses(SETS["yaw"])
    monkeypatch.setattr(sample_cells, "bounds_by_part", broken)
    found = bounded(scene, pose_set)
    assert np.isfinite(found.lower).all() and np.isfinite(found.upper).all()
    assert attack(scene, pose_set, found)[1] == 0
    assert torch.isfinite(torch.from_numpy(found.alpha)).all()


def test_what_is_known_is_only_replaced_by_bounds() -> None:
    """A NaN or an infinity at either end, crossed ends, and ends beside what is known change nothing."""
    low = np.array([0.3, np.nan, 0.3, -np.inf, 0.6, 0.3, 0.9])
    high = np.array([0.7, 0.7, np.nan, 0.7, 0.4, np.inf, 0.95])
    lower, upper = np.full(7, 0.2), np.full(7, 0.8)
    sample_cells.SampleCellBounds._keep(lower, upper, (np.arange(7),), low, high)
    assert lower.tolist() == [0.3] + 6 * [0.2] and upper.tolist() == [0.7] + 6 * [0.8]


@pytest.mark.slow
def test_pieces_that_are_given_up_say_nothing() -> None:
    scene, pose_set = tiny_scene(3), poses(SETS["yaw"])
    bounds = NerfBounds(scene, UNIFORM, 1)
    bounds.field.limit = 0
    found = bounds.rays(pose_set, pose_set.box, pixels_of(pose_set.camera), 0.02)
    assert (found.upper - found.lower).max() == 1.0, "nothing was given up"
    assert attack(scene, pose_set, found)[1] == 0


def test_rays_of_wide_sets_lie_in_their_polynomials() -> None:
    """The Taylor models' own error counts where sets are wide and the degree is 1."""
    pose_set = poses({"rotation": {"yaw": 0.2, "roll": 0.1}, "translation": {"x": 0.1}})
    bundle = sample_cells.RayBundle(pose_set, pose_set.box, pixels_of(pose_set.camera), 1)
    ray, distance = np.repeat(np.arange(12), 2), np.tile([0.3, 3.9], 12)
    lines, radius = bundle.points(ray, distance, 0.0 * distance)
    directions = np.array([[(x + 0.5 - 2.0) / 5.0, -(y + 0.5 - 1.5) / 5.0, -1.0] for y in range(3) for x in range(4)])
    worst = np.zeros_like(radius)
    for values in np.random.default_rng(0).uniform(-1.0, 1.0, (300, 3)):
        pose = pose_set.pose(pose_set.box.at(values))
        world = directions @ pose[:, :3].T
        points = pose[:, 3] + distance[:, None] * (world / np.linalg.norm(world, axis=1, keepdims=True))[ray]
        monomials = np.prod(values**bundle.exponents, axis=1)
        worst = np.maximum(worst, np.abs(points - np.einsum("m,kmc->kc", monomials, lines)))
    assert (worst <= radius).all()
    assert worst.max() > 0.1 * radius.max(), "far too wide"


@pytest.mark.slow
def test_processes_find_what_this_process_finds_and_survive_a_kill() -> None:
    scene, pose_set = tiny_scene(2, density=30.0), poses(SETS["yaw"])
    box = pose_set.box.split(0, 2)[0]
    tiles = np.arange(12)
    shared, alone = NerfFrame(scene, UNIFORM, pose_set, workers=2), NerfFrame(scene, UNIFORM, pose_set)
    assert shared.tiles_at_once == 8 * alone.tiles_at_once
    engine = frame_module._processes(2)
    try:
        together = shared.bound(box, tiles)
        displacement = alone.bounds.displacement
        halves = []
        for part in (tiles[:6], tiles[6:]):
            alone.bounds.displacement = displacement
            halves.append(alone.bound(box, part))
        for name in ("lower", "upper"):
            assert (getattr(together, name) == np.concatenate([getattr(half, name) for half in halves])).all()
        for pid in engine.pids:
            os.kill(pid, signal.SIGKILL)
        shared.bounds.displacement = displacement
        again = shared.bound(box, tiles)
        assert (again.lower == together.lower).all() and (again.upper == together.upper).all()
    finally:
        frame_module._processes.cache_clear()
        engine.close()
