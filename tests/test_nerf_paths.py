"""Samples that are followed: bounds attacked at tolerance zero, tight on narrow cells; planted faults are found."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from nerfs import BINS, attack_first_rays, pixels_of, poses, tiny_scene

from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.nerf.bounds import NerfBounds
from ns_abstract.methods.nerf.division import ENDS, Division, RayCells, regroup_parts
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.occupancy import OccupancyGrid
from ns_abstract.methods.nerf.ray_bundle import RayBundle
from ns_abstract.methods.nerf.ray_field import RayBounds
from ns_abstract.methods.nerf.render import NerfRenderer, _filled, camera_rays, interval_weights
from ns_abstract.methods.nerf.sample_paths import BundleBounds, FollowedSamples, SampleLines, SamplePaths
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.refine.engine import Refinement, RefinementGoal

SETS = {
    "point": {"rotation": {"yaw": [0.1, 0.1]}},
    "narrow": {"rotation": {"yaw": 1e-5}},
    "yaw": {"rotation": {"yaw": 1e-3}},
    "orbit": {"orbit": {"target": [0, 0, 0], "axis": [0, 0.1, 1], "azimuth": [0.3, 0.302]}},
    "shift and yaw": {"rotation": {"yaw": 1e-4}, "translation": {"x": 1e-4}},
    "three": {"rotation": {"yaw": 1e-5}, "translation": {"x": 1e-5, "y": 1e-5}},
}
FIELDS = {
    "soft": (3, {}),
    "opaque": (1, {"density": 1e3}),
    "stiff": (0, {"density": 1e4}),
    "rough": (2, {"rough": 20.0}),
}
#: Rays of a picture that are bounded; each takes seconds.
RAYS = 3
#: How far a set's bounds may be from what renders reach: mean gap over theirs, and what may be added.
TIGHT = {
    ("soft", "point"): (0.0, 1e-4), ("soft", "narrow"): (2.5, 0.0), ("soft", "yaw"): (1.2, 0.0),
    ("soft", "orbit"): (1.15, 0.0), ("rough", "yaw"): (1.1, 0.0), ("opaque", "point"): (0.0, 1e-6),
    ("opaque", "narrow"): (1.05, 0.0), ("opaque", "yaw"): (1.02, 0.0), ("opaque", "orbit"): (1.02, 0.0),
    ("opaque", "shift and yaw"): (1.2, 0.0), ("opaque", "three"): (2.5, 0.0),
}  # fmt: skip
#: Fields and sets whose bounds are attacked alone.
ATTACKED = [
    ("soft", "shift and yaw"), ("soft", "three"), ("stiff", "narrow"), ("stiff", "yaw"), ("stiff", "orbit"),
    ("rough", "narrow"), ("rough", "orbit"), ("rough", "shift and yaw"),
]  # fmt: skip


def bounded(scene: NerfScene, pose_set: PoseBox, tolerance: float) -> RayBounds:
    pixels = pixels_of(pose_set.camera)[:RAYS]
    return NerfBounds(scene, BINS, pose_set.box.dimensions).rays(pose_set, pose_set.box, pixels, tolerance)


def reached(scene: NerfScene, pose_set: PoseBox) -> float:
    """Mean gap of renders of the same rays."""
    box, renderer = pose_set.box, NerfRenderer(scene, BINS)
    values = [box.middle]
    if box.dimensions:
        values += [*box.corners(), *box.sample(40, np.random.default_rng(0))]
    pixels = pixels_of(pose_set.camera)[:RAYS]
    shown = np.stack([renderer.pixels(pose_set.camera, pose_set.pose(np.asarray(v)), pixels) for v in values])
    return float((shown.max(axis=0) - shown.min(axis=0)).mean())


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [(name, kind) for kind, name in [*TIGHT, *ATTACKED]])
def test_rays_are_enclosed_and_tight(name: str, kind: str) -> None:
    seed, changes = FIELDS[kind]
    scene, pose_set = tiny_scene(seed, **changes), poses(SETS[name])
    tolerances = (0.05, 5e-4) if (kind, name) in TIGHT else (0.05,)
    found = [bounded(scene, pose_set, tolerance) for tolerance in tolerances]
    # what breaks one of them breaks what they have in common
    lower, upper = np.max([one.lower for one in found], axis=0), np.min([one.upper for one in found], axis=0)
    compared, violations = attack_first_rays(scene, pose_set, dataclasses.replace(found[-1], lower=lower, upper=upper))
    assert compared > 0 and violations == 0
    if (kind, name) in TIGHT:
        share, more = TIGHT[kind, name]
        assert (found[-1].upper - found[-1].lower).mean() < share * reached(scene, pose_set) + more


def checkered(side: int = 12) -> OccupancyGrid:
    """Three of four voxels of a cube of 2.4 about the origin."""
    occupied = np.random.default_rng(3).random((side,) * 3) < 0.75
    return OccupancyGrid.of_box(np.full(3, -1.2), np.full(3, 1.2), occupied)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["soft", "opaque"])
def test_declared_voxels_are_heeded(kind: str) -> None:
    seed, changes = FIELDS[kind]
    scene, pose_set = dataclasses.replace(tiny_scene(seed, **changes), occupancy=checkered()), poses(SETS["narrow"])
    found = bounded(scene, pose_set, 5e-4)
    assert attack_first_rays(scene, pose_set, found)[1] == 0
    assert (found.upper - found.lower).mean() < 0.02


@pytest.mark.slow
def test_shifted_colours_are_enclosed() -> None:
    spec = {"rotation": {"yaw": 1e-4}, "hue": [0.0, 0.2], "saturation": 0.1}
    pose_set = poses(spec)
    frame = NerfFrame(tiny_scene(3), BINS, pose_set)
    box = pose_set.box.split(0, 2)[1]
    found = frame.bound(box, np.arange(6))
    assert (found.upper - found.lower).mean() < 0.6
    for values in [*box.corners(), *box.sample(20, np.random.default_rng(2))]:
        picture = frame.render(np.asarray(values), np.arange(6))
        assert (found.lower <= picture).all() and (picture <= found.upper).all()


@pytest.mark.slow
def test_refinement_reaches_the_renders() -> None:
    """On a set of which bounds by bins leave 0.2 of the whole range open, and renders reach 0.005."""
    frame = NerfFrame(tiny_scene(3), BINS, poses({"rotation": {"yaw": 5e-4}}))
    result = Refinement(frame, 0, RefinementGoal(ratio=1.2, seconds=200.0, cells=400)).run()
    assert result.trace[-1].mpg <= 1.2 * result.trace[-1].mpg_witness
    for values in frame.box.sample(40, np.random.default_rng(5)):
        picture = frame.render(values)
        assert (result.lower <= picture[:, 0, 0].reshape(result.lower.shape)).all()
        assert (picture[:, 0, 0].reshape(result.upper.shape) <= result.upper).all()


@pytest.mark.parametrize("counts", [(), (1,), (16,), (4, 3), (2, 2, 2)])
@pytest.mark.parametrize("straight", [False, True])
def test_lines_hold_the_places_of_every_part(counts: tuple[int, ...], straight: bool) -> None:
    rng, d = np.random.default_rng(0), len(counts)
    parts = math.prod(counts)
    slope, middle = rng.normal(size=(7, 5, d)), rng.uniform(0.0, 4.0, (7, 5))
    grid = np.array(list(np.ndindex(*counts)), np.float64).reshape(parts, d)
    ends = 2.0 * grid / np.array(counts) - 1.0, 2.0 * (grid + 1.0) / np.array(counts) - 1.0
    # what a bent place reaches over each part
    center = 0.5 * (ends[0] + ends[1])
    bent = middle[:, None] + np.einsum("pj,ksj->kps", center, slope) + 0.1 * rng.normal(size=(7, parts, 5))
    half = np.einsum("pj,ksj->kps", 0.5 * (ends[1] - ends[0]), np.abs(slope)) + 0.01
    low, high = bent - half, bent + half
    lines = SampleLines.around(low, high, counts, straight, 4.0)
    assert not straight or not lines.slope.any()
    for part in range(parts):
        for _ in range(20):
            p = rng.uniform(ends[0][part], ends[1][part])
            p = np.where(rng.random(d) < 0.3, ends[rng.integers(0, 2)][part], p)
            for place in (low[:, part], high[:, part]):
                assert (np.abs(place - lines.middle - lines.slope @ p) <= lines.rest).all()
    if counts == (16,) and not straight:
        # followed: the rest is what bends and a part's own motion, not what the whole cell moves by
        assert (lines.rest < 0.5 + 0.2 * np.abs(slope[..., 0])).all()


def test_parts_are_regrouped_outward() -> None:
    rng = np.random.default_rng(1)
    for before, after in (((4,), (6,)), ((6,), (4,)), ((1, 5), (3, 2)), ((), ())):
        values = rng.random((2, 3, *before, 3))
        low, high = (regroup_parts(values, end, after) for end in ENDS)
        assert low.shape == high.shape == (2, 3, *after, 3)
        for place in rng.random((50, len(before))):
            a = tuple(int(x * n) for x, n in zip(place, before, strict=True))
            b = tuple(int(x * n) for x, n in zip(place, after, strict=True))
            inside = values[(slice(None), slice(None), *a)]
            assert (low[(slice(None), slice(None), *b)] <= inside).all()
            assert (inside <= high[(slice(None), slice(None), *b)]).all()


def sampled(renderer: NerfRenderer, pose_set: PoseBox, values: np.ndarray, pixels: np.ndarray) -> list[np.ndarray]:
    """Edges [n, S + 1], densities [n, S], colours [n, S, 3] and weights [n, S] of a render (`NerfRenderer.rays`)."""
    pose = torch.from_numpy(pose_set.pose(values))
    world = torch.from_numpy(camera_rays(pose_set.camera, pixels)) @ pose[:, :3].T
    world = world / torch.linalg.vector_norm(world, dim=-1, keepdim=True)
    bins = torch.linspace(0.0, 1.0, BINS.samples + 1, dtype=torch.float64).expand(len(pixels), -1)
    with torch.inference_mode():
        density, _, _ = renderer._densities(renderer.coarse, pose[:, 3], world, bins)
        bins = renderer._refined(bins, interval_weights(density, renderer._lengths(bins)))
        density, base, inside = renderer._densities(renderer.fine, pose[:, 3], world, bins)
        color = renderer.fine.color(base, world[:, None].expand(-1, density.shape[1], -1)[inside])
        weights = interval_weights(density, renderer._lengths(bins))
        found = renderer._distances(bins), density, _filled(color, inside), weights
    return [part.numpy() for part in found]


@pytest.mark.parametrize("grid", [False, True])
@pytest.mark.parametrize("kind", ["soft", "rough"])
def test_samples_are_where_and_what_they_are_said_to_be(kind: str, grid: bool) -> None:
    """Edges, densities, colours and the price of what is negligible, part by part, at tolerance zero."""
    seed, changes = FIELDS[kind]
    scene, pose_set = tiny_scene(seed, **changes), poses({"rotation": {"yaw": 2e-4}})
    scene = dataclasses.replace(scene, occupancy=checkered() if grid else None)
    paths, pixels = NerfBounds(scene, BINS, 1).paths, pixels_of(pose_set.camera)[:6]
    assert paths is not None
    work = BundleBounds(
        paths, RayBundle(pose_set, pose_set.box, pixels, paths.degree), Division((), 1, 2), np.zeros(6, np.int64), 1.0,
        None, [],
    )  # fmt: skip
    samples = work.samples(0, RayCells(np.arange(6), np.zeros(6, np.int64)))
    parts, renderer, rng = samples.low.shape[1], NerfRenderer(scene, BINS), np.random.default_rng(0)
    dim = samples.color[0, ..., 0] > samples.color[1, ..., 0]
    assert dim.any() and not dim.all() and samples.price.any()
    for place in [*rng.uniform(-1.0, 1.0, 60), -1.0, 1.0]:
        part = min(int(0.5 * (place + 1.0) * parts), parts - 1)
        edges, density, color, weights = sampled(renderer, pose_set, pose_set.box.at(np.array([place])), pixels)
        assert (samples.low[:, part] <= edges).all() and (edges <= samples.high[:, part]).all()
        low, high = samples.density[:, :, part]
        assert (low <= density).all() and (density <= high).all()
        low, high = samples.color[:, :, part]
        shown = ~dim[:, part] & (density > 0.0)
        assert (low <= color)[shown].all() and (color <= high)[shown].all()
        assert ((weights * dim[:, part]).sum(axis=1) <= samples.price[:, part]).all()


def test_what_is_negligible_is_charged() -> None:
    """Samples that may lie over one another, some of whose colours do not count."""
    rng, rows, count = np.random.default_rng(0), 30, 8
    samples = FollowedSamples.__new__(FollowedSamples)
    samples.owner = NerfBounds(tiny_scene(0), BINS, 0).paths  # type: ignore[assignment]
    near, far = BINS.near, BINS.far
    middle = np.sort(rng.uniform(near, far, (rows, 1, count + 1)), axis=2)
    samples.low, samples.high = np.maximum(middle - 0.3, near), np.minimum(middle + 0.3, far)
    samples.low[..., 0] = samples.high[..., 0] = near
    samples.low[..., -1] = samples.high[..., -1] = far
    density = rng.uniform(0.0, 0.2, (rows, 1, count)) * (rng.random((rows, 1, count)) < 0.5)
    density[:, :, 3] = 4.0
    color = np.where(density[..., None] > 1.0, 0.5, rng.integers(0, 2, (rows, 1, count, 1))) * np.ones(3)
    dim = density < 1.0
    length = np.maximum(samples.high[..., 1:] - samples.low[..., :-1], 0.0)
    samples.density = np.stack([density, density])
    samples.color = np.stack([np.where(dim[..., None], end, color) for end in (np.inf, -np.inf)])
    samples.price = (dim * -np.expm1(-length * density)).sum(axis=2)
    lower, upper = samples.composite(None)
    assert (upper - lower).mean() < 0.9
    for _ in range(200):
        edges = np.sort(rng.uniform(samples.low, samples.high), axis=2)
        shown = np.tile(np.array(BINS.background), (rows, 1, 1))
        for k in range(count - 1, -1, -1):
            opacity = -np.expm1(-(edges[..., k + 1] - edges[..., k]) * density[..., k])[..., None]
            shown = shown + opacity * (color[:, :, k] - shown)
        assert (lower <= shown).all() and (shown <= upper).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["yaw", "shift and yaw"])
def test_parts_hold_their_renders(name: str) -> None:
    scene, pose_set = tiny_scene(3), poses(SETS[name])
    d = pose_set.box.dimensions
    division, pixels = Division((0,) * 4 if d == 1 else (0, 1, 0, 1), d, 1), pixels_of(pose_set.camera)[:4]
    found = NerfBounds(scene, BINS, d).rays(pose_set, pose_set.box, pixels, 0.01, division=division)
    assert found.parts is not None and found.parts.shape == (2, 4, 1, *division.parts, 3)
    renderer, rng, sizes = NerfRenderer(scene, BINS), np.random.default_rng(0), np.array(division.parts)
    for place in rng.uniform(-1.0, 1.0, (60, d)):
        values = pose_set.box.at(place)
        shown = renderer.pixels(pose_set.camera, pose_set.pose(values), pixels)
        part = np.clip((0.5 * (place + 1.0) * sizes).astype(int), 0, sizes - 1)
        low, high = (side[(slice(None), 0, *part)] for side in found.parts)
        assert (low <= shown).all() and (shown <= high).all()
    wide = (found.upper - found.lower).mean()
    assert d > 1 or (found.parts[1] - found.parts[0]).mean() < 0.7 * wide


def fixed(self: SamplePaths, *arguments: Any) -> tuple[np.ndarray, np.ndarray]:
    """`SamplePaths.edges` as if samples stayed where they are in the middle of a cell."""
    low, high = EDGES(self, *arguments)
    middle = 0.5 * (low + high).mean(axis=1, keepdims=True)
    return np.broadcast_to(middle, low.shape).copy(), np.broadcast_to(middle, low.shape).copy()


EDGES = SamplePaths.edges


@pytest.mark.slow
def test_planted_faults_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SamplePaths, "edges", fixed)
    scene, pose_set = tiny_scene(2, rough=20.0), poses({"rotation": {"yaw": 1e-3}})
    assert attack_first_rays(scene, pose_set, bounded(scene, pose_set, 0.05))[1] > 0
