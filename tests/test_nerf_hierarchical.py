"""Bounds of Nerfstudio's own samples by bins: attacked at tolerance zero; planted faults are found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from nerfs import BINS, attack_first_rays, pixels_of, poses, tiny_scene

from ns_abstract.arithmetic.rounding import COMPOSITE_ROUNDING
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf import sample_cells
from ns_abstract.methods.nerf.bounds import NerfBounds
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.method import NerfMethod
from ns_abstract.methods.nerf.ray_field import RAY_TUNING, RayBounds, RayRequest
from ns_abstract.methods.nerf.render import NerfRenderer
from ns_abstract.methods.nerf.samples import composite, edge_bounds, field_hulls
from ns_abstract.methods.nerf.scene import NerfScene

SETS = {
    "point": {"rotation": {"yaw": [0.1, 0.1]}},
    "yaw": {"rotation": {"yaw": 0.001}},
    "orbit": {"orbit": {"target": [0, 0, 0], "axis": [0, 0.1, 1], "azimuth": [0.3, 0.302]}},
}


def by_bins(scene: NerfScene, pose_set: PoseBox) -> RayBounds:
    """Without samples that are followed."""
    bounds, tolerance = NerfBounds(scene, BINS, pose_set.box.dimensions), 0.05 / sample_cells._SWEPT
    asked = RayRequest(pose_set, pose_set.box, pixels_of(pose_set.camera)[:6], tolerance, None, None, [])
    return bounds._apart(asked, None, False, RAY_TUNING.displacement)


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_every_choice_of_samples_is_enclosed(name: str) -> None:
    for seed, changes in ((3, {}), (1, {"density": 1e3})):
        scene, pose_set = tiny_scene(seed, **changes), poses(SETS[name])
        found = by_bins(scene, pose_set)
        assert (found.upper - found.lower).mean() < 0.9, "nothing was bounded"
        compared, violations = attack_first_rays(scene, pose_set, found)
        assert compared > 0 and violations == 0


@pytest.mark.slow
def test_a_smooth_field_is_tight() -> None:
    scene, pose_set = tiny_scene(3, density=1.0, color=0.5), poses(SETS["yaw"])
    found = by_bins(scene, pose_set)
    assert (found.upper - found.lower).mean() < 0.25


@pytest.mark.slow
def test_where_samples_lie_makes_opaque_fields_tight(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, pose_set = tiny_scene(1, density=1e3), poses({"rotation": {"yaw": 1e-4}})
    found = by_bins(scene, pose_set)
    monkeypatch.setattr(sample_cells.SampleCellBounds, "_sampled", lambda self, low, high: (np.zeros(1), np.ones(1)))
    wide = by_bins(scene, pose_set)
    assert (wide.lower <= found.lower).all() and (found.upper <= wide.upper).all()
    assert (found.upper - found.lower).mean() < 0.3 * (wide.upper - wide.lower).mean()


@pytest.mark.parametrize("kind", ["any", "empty", "opaque", "known"])
def test_edges_of_samples_are_enclosed(kind: str) -> None:
    rng = np.random.default_rng(0)
    ends = np.sort(rng.uniform(0.0, 1.0, (2, 60, BINS.samples)) ** 4, axis=0)
    if kind == "empty":
        ends *= 1e-9
    elif kind == "opaque":
        ends[:, :, 7] = 1.0
    elif kind == "known":
        ends[1] = ends[0]
    low, high = edge_bounds(ends[0], ends[1], BINS)
    renderer = NerfRenderer(tiny_scene(0), BINS)
    bins = torch.linspace(0.0, 1.0, BINS.samples + 1, dtype=torch.float64).expand(60, -1)
    for mix in (0.0, 1.0, None, None, "turns"):
        share = rng.uniform(0.0, 1.0, ends[0].shape) if mix is None else mix
        if mix == "turns":
            # more light than ever before a place and less than ever behind it
            share = (np.arange(BINS.samples) >= rng.integers(0, BINS.samples, (60, 1))).astype(np.float64)
        alpha = torch.from_numpy(np.clip(ends[0] + share * (ends[1] - ends[0]), *ends))
        light = torch.cumprod(torch.cat([torch.ones(60, 1), 1.0 - alpha[:, :-1]], dim=1), dim=1)
        edges = renderer._distances(renderer._refined(bins, alpha * light)).numpy()
        assert (low <= edges).all() and (edges <= high).all()
    if kind == "known":
        assert (high - low).max() < 1e-9


def in_samples(low: np.ndarray, high: np.ndarray, step: float, density: np.ndarray, color: np.ndarray):
    """`field_hulls` of parts of length ``step``: densities and colours by sample."""
    count = low.shape[1] - 1
    found = np.empty((2, len(low), count)), np.empty((2, len(low), count, 3))
    field_hulls(low, high, 0.0, step, density, color, *found)
    return found


@pytest.mark.parametrize("spread", [0.0, 0.003, 0.3])
def test_sampled_parts_are_enclosed(spread: float) -> None:
    rng = np.random.default_rng(1)
    rows, count, parts = 12, 24, 40
    edges = np.sort(rng.uniform(0.0, 1.0, (rows, count + 1)), axis=1)
    edges[:, 0], edges[:, -1] = 0.0, 1.0
    width = spread * rng.uniform(0.0, 1.0, edges.shape)
    low, high = np.sort(np.maximum(edges - width, 0.0), axis=1), np.sort(np.minimum(edges + width, 1.0), axis=1)
    low[:, -1], high[:, 0] = 1.0, 0.0
    density = rng.uniform(0.0, 12.0, (rows, parts)) * np.array([1.0, 1.2])[:, None, None]
    color = rng.uniform(0.0, 0.8, (rows, parts, 3)) + np.array([0.0, 0.2])[:, None, None, None]
    lower, upper = np.full((rows, 3), 0.5), np.full((rows, 3), 0.5)
    composite(low, high, *in_samples(low, high, 1.0 / parts, density, color), lower, upper)
    slack = 4.0 * COMPOSITE_ROUNDING * (2 * count + 7)
    for mix in (0, 1, None, None, None):
        at = np.sort(np.clip(edges + (0 if mix is None else 2 * mix - 1) * width, low, high), axis=1)
        if mix is None:
            at = np.sort(rng.uniform(low, high), axis=1)
        place = np.minimum((0.5 * (at[:, 1:] + at[:, :-1]) * parts).astype(int), parts - 1)
        share = rng.integers(0, 2, (rows, count))
        there = np.take_along_axis(density[0], place, 1), np.take_along_axis(density[1], place, 1)
        alpha = 1.0 - np.exp(-np.diff(at, axis=1) * np.where(share, *there))
        shown = np.full((rows, 3), 0.5)
        for k in range(count - 1, -1, -1):
            seen = color[rng.integers(0, 2), np.arange(rows), place[:, k]]
            shown += alpha[:, k, None] * (seen - shown)
        assert (lower - slack <= shown).all() and (shown <= upper + slack).all()
    assert spread > 0.0 or (upper - lower).mean() < 0.5


def only_middles(self, values, end, axis=-1):
    """Takes one part of every bin for all of it."""
    inner = self.division.parts[-1]
    axis %= values.ndim
    shape = (*values.shape[:axis], -1, inner, *values.shape[axis + 1 :])
    return np.repeat(values.reshape(shape).take(inner // 2, axis=axis + 1), inner, axis=axis)


@pytest.mark.slow
def test_planted_faults_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample_cells.SampleCellBounds, "_anywhere", only_middles)
    scene, pose_set = tiny_scene(3, density=30.0), poses(SETS["yaw"])
    assert attack_first_rays(scene, pose_set, by_bins(scene, pose_set))[1] > 0


def test_options() -> None:
    scene = tiny_scene(0)
    method = NerfMethod(scene, sampling="hierarchical")
    assert method.program["name"] == "nerf-hierarchical" and method.sampling.importance == 128
    assert "own 193 samples" in method.plan[0]
    other = NerfMethod(dataclasses.replace(scene, coarse=tiny_scene(9).coarse), sampling="hierarchical")
    assert method.fingerprint["scene"] != other.fingerprint["scene"]
    assert isinstance(method.frame(poses(SETS["yaw"])), NerfFrame)
    for options in ({"num_samples": 64}, {"renderer": "paper"}):
        with pytest.raises(InputError):
            NerfMethod(scene, sampling="hierarchical", **options)  # type: ignore[arg-type]


def test_segments_take_every_interval_that_may_lie_over_them() -> None:
    """Fields that are constant on parts, sampled between any edges that the bounds allow."""
    rng = np.random.default_rng(4)
    parts, count, span = 24, 5, 2.0
    for _ in range(60):
        middle = np.sort(rng.uniform(0.0, span, count + 1))
        wide = rng.choice([0.0, 0.05, 0.4])
        low, high = (np.clip(middle + side * wide * span, 0.0, span)[None] for side in (-0.5, 0.5))
        low[0, 0] = high[0, 0] = 0.0
        low[0, -1] = high[0, -1] = span
        density, color = 4.0 * rng.random((1, parts)) ** 2, rng.random((1, parts, 3))
        density, color = (np.stack([values, values]) for values in (density, color))
        lower, upper = np.full((1, 3), 0.3), np.full((1, 3), 0.3)
        composite(low, high, *in_samples(low, high, span / parts, density, color), lower, upper)
        for _ in range(40):
            share = rng.choice([0.0, 1.0], count + 1) if rng.random() < 0.5 else rng.random(count + 1)
            edges = np.sort(low[0] + share * (high[0] - low[0]))
            at = np.minimum((0.5 * (edges[1:] + edges[:-1]) / span * parts).astype(int), parts - 1)
            shown = np.full(3, 0.3)
            for k in range(count - 1, -1, -1):
                opacity = -np.expm1(-(edges[k + 1] - edges[k]) * density[0, 0, at[k]])
                shown += opacity * (color[0, 0, at[k]] - shown)
            # what the caller charges for rounding
            room = 4.0 * COMPOSITE_ROUNDING * (count + 5)
            assert (lower[0] - room <= shown).all() and (shown <= upper[0] + room).all()
