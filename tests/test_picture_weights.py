"""Bounds of blending weights of chosen Gaussians and samples, attacked by renderers and references."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import blob_scene
from nerfs import pixels_of, poses, raw_outputs, tiny_scene

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.method import NerfMethod, NerfWeightFrame
from ns_abstract.methods.nerf.render import Sampling, camera_rays
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatSample
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.methods.splat.reference import Projection, Reference
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.weights import SplatWeightFrame
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.perturbation.variations import Selection
from ns_abstract.refine.protocol import WeightPlane

LEFT = Selection(box=((-9.0, -9.0, -9.0), (0.0, 9.0, 9.0)))
BRIGHT = Selection(color_min=(0.5, 0.0, 0.0))
#: Depth that many of the Gaussians cross.
NEAR = 1.5
PLANES = (WeightPlane(LEFT), WeightPlane(nearer=NEAR), WeightPlane(BRIGHT, 1.4))
SETS: dict[str, dict[str, Any]] = {
    "pose": {},
    "z": {"translation": {"z": [-0.01, 0.03]}},
    "yaw": {"rotation": {"yaw": 0.01}},
    "three": {"translation": {"x": 0.01, "z": [0.0, 0.02]}, "rotation": {"pitch": 0.01}},
    "scenes": {
        "translation": {"z": 0.01},
        "scene": [{"select": {}, "mean": 0.02, "opacity": [-0.3, 0.1], "color": [-0.6, 0.6]}],
    },
}


def frame_of(
    scene: SplatScene, name: str, arithmetic: str = "float32", planes: Sequence[WeightPlane] = PLANES
) -> SplatWeightFrame:
    pose = np.concatenate([np.eye(3), [[0.0], [0.0], [1.5]]], axis=1)
    around = PoseBox.around(PinholeCamera(pose, 20.0, 20.0, 12.0, 12.0, 24, 24), parse_perturbation(SETS[name]))
    return SplatMethod(scene, None, arithmetic).weight_frame(around, planes, np.ones((24, 24), bool))


def slow(
    scene: SplatScene, frame: SplatWeightFrame, values: np.ndarray, dtype: torch.dtype, sample: SplatSample | None
) -> np.ndarray:
    """[H, W, 3] weights by the reference, chosen by what it says of depths and what the scene stores."""
    reference = Reference(scene, GSPLAT_1_4_0, dtype)
    if sample is not None:
        splats = sample.splats
        reference = reference.scene_sample(torch.from_numpy(splats.means), torch.from_numpy(splats.opacity), None)
    red = 0.5 + 0.28209479177387814 * scene.sh[:, 0, 0].astype(np.float64)
    left, bright = torch.from_numpy(scene.means[:, 0] <= 0.0), torch.from_numpy(red >= 0.5)

    def blend(p: Projection, layers: torch.Tensor, centers: torch.Tensor) -> torch.Tensor:
        white = torch.stack([left[p.indices], p.depths < NEAR, bright[p.indices] & (p.depths < 1.4)], dim=1)
        return reference._sums(p, layers, centers, white.to(dtype))[0]

    return reference._picture(frame.camera, torch.from_numpy(frame.pose_set.pose(values)), blend).numpy()


def samples_of(scene: SplatScene, frame: SplatWeightFrame, count: int) -> list[SplatSample | None]:
    """The scene, and others of its set."""
    if not frame.varied.varies:
        return [None] * count
    method = SplatMethod(scene, None, None)
    found = method.frame(frame.pose_set).scene_samples(3)
    return [None, *(next(found) for _ in range(count - 1))]


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("name", SETS)
def test_weights_stay_inside(name: str, mode: str) -> None:
    scene = replace(blob_scene(60, degree=1), rasterize_mode=mode)
    frame = frame_of(scene, name)
    box, view = frame.box, frame.camera
    found = frame.bound(box, np.arange(frame.tile_count), keep_linear=True)
    lower, upper = assemble(found.lower, view), assemble(found.upper, view)
    assert found.linear is not None
    a_low, b_low, a_high, b_high = (assemble(part, view).astype(np.float64) for part in found.linear)
    values = [box.middle, *box.corners()[:4], *box.sample(4, np.random.default_rng(1))]
    for point, sample in zip(values, samples_of(scene, frame, len(values)), strict=False):
        scaled = _scaled(box, point)
        drawn = [assemble(frame.of_sample(point, sample), view)]
        drawn += [slow(scene, frame, point, dtype, sample) for dtype in (torch.float64, torch.float32)]
        for image in drawn:
            assert ((lower <= image) & (image <= upper)).all()
            assert (a_low @ scaled + b_low <= image).all() and (image <= a_high @ scaled + b_high).all()
        np.testing.assert_allclose(drawn[0], drawn[1], atol=1e-6)
    # bounds that say nothing would pass, and so would weights of nothing
    assert (upper - lower).mean() < (0.6 if name == "scenes" else 0.25)
    assert all(0.02 < drawn[0][..., k].mean() < 0.9 for k in range(3))


def _scaled(box: Any, point: np.ndarray) -> np.ndarray:
    low, high = np.array(box.lower), np.array(box.upper)
    return (point - 0.5 * (low + high)) / (0.5 * (high - low))


def test_what_crosses_the_distance_counts_as_both() -> None:
    """One opaque Gaussian that some poses of the set see before the distance and some behind it."""
    scene = blob_scene(1)
    scene = replace(
        scene,
        means=np.zeros((1, 3), np.float32), log_scales=np.full((1, 3), -1.0, np.float32),
        opacity_logits=np.full(1, 4.0, np.float32),
    )  # fmt: skip
    frame = frame_of(scene, "z", planes=[WeightPlane(nearer=NEAR)])
    found = frame.bound(frame.box, np.arange(frame.tile_count))
    middle = np.s_[0, 12, 12, 0]
    assert found.lower[middle] == 0.0 and found.upper[middle] > 0.9
    near, far = frame.render(np.array([-0.01])), frame.render(np.array([0.03]))
    assert near[middle] > 0.9 and far[middle] == 0.0
    # where none crosses it, the bounds say which
    for part, ends in zip(frame.box.split(0, 4), ((0.9, 1.0), (0.0, 1e-4), (0.0, 1e-4), (0.0, 1e-4)), strict=True):
        inner = frame.bound(part.replace(0, part.lower[0] + 1e-4, part.upper[0] - 1e-4), np.arange(frame.tile_count))
        assert ends[0] <= inner.lower[middle] <= inner.upper[middle] <= ends[1]


def test_depths_are_rounded() -> None:
    """A centre whose depth float32 rounds across the distance, far from the origin."""
    scene = blob_scene(1)
    scene = replace(
        scene,
        means=np.full((1, 3), 1000.0, np.float32), log_scales=np.full((1, 3), -1.0, np.float32),
        opacity_logits=np.full(1, 4.0, np.float32),
    )  # fmt: skip
    pose = np.concatenate([np.eye(3), [[1000.0], [1000.0], [1000.0 + NEAR + 1e-6]]], axis=1)
    around = PoseBox.around(PinholeCamera(pose, 20.0, 20.0, 12.0, 12.0, 24, 24), parse_perturbation({}))
    every = np.ones((24, 24), bool)
    ends = {}
    for arithmetic in ("float32", "real"):
        frame = SplatMethod(scene, None, arithmetic).weight_frame(around, [WeightPlane(nearer=NEAR)], every)
        ends[arithmetic] = frame.bound(frame.box, np.arange(frame.tile_count)).upper.max()
    # it lies behind the distance, but not by more than float32 may move it
    assert ends["real"] < 1e-4 and ends["float32"] > 0.9


def test_gradients_are_those_of_weights() -> None:
    scene = blob_scene(30, degree=1)
    frame = frame_of(scene, "three", planes=[WeightPlane(LEFT)])
    values = torch.tensor(frame.box.middle, requires_grad=True)
    total = frame.differentiable(values)[..., 0].sum()
    total.backward()
    assert values.grad is not None
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        high, low = (
            assemble(frame.precise(frame.box.middle + sign * step), frame.camera)[..., 0].sum() for sign in (1.0, -1.0)
        )
        assert float(values.grad[axis]) == pytest.approx((high - low) / 2e-6, rel=1e-2, abs=0.05)


def test_empty_selections_are_refused() -> None:
    with pytest.raises(InputError, match="picks none of 5 Gaussians"):
        frame_of(blob_scene(5), "pose", planes=[WeightPlane(Selection(box=((50.0, 50.0, 50.0), (60.0, 60.0, 60.0))))])
    with pytest.raises(InputError, match="the scene has Gaussians 0 to 4"):
        frame_of(blob_scene(5), "pose", planes=[WeightPlane(Selection(indices=(7,)))])


# ---------------------------------------------------------------- fields


BOX = Selection(box=((-9.0, -9.0, -9.0), (9.0, 0.25, 9.0)))


def weights_by_hand(
    frame: NerfWeightFrame, scene: NerfScene, values: np.ndarray, sampling: Sampling, planes: Sequence[WeightPlane]
) -> np.ndarray:
    """[H, W, planes] sums of the samples' weights, from the densities of `raw_outputs`."""
    pose = torch.from_numpy(frame.pose_set.pose(values))
    rays = torch.from_numpy(camera_rays(frame.camera, pixels_of(frame.camera))) @ pose[:, :3].T
    rays = rays / rays.norm(dim=1, keepdim=True)
    distances, lengths = (torch.from_numpy(v) for v in sampling.bins)
    points = pose[:, 3] + rays[:, None] * distances[:, None]
    density, _ = raw_outputs(scene.fine, points, rays[:, None].expand_as(points))
    depth = torch.nn.functional.softplus(density).reshape(points.shape[:2]) * lengths
    weights = (1.0 - torch.exp(-depth)) * torch.exp(-(torch.cumsum(depth, dim=1) - depth))
    found = []
    for plane in planes:
        chosen = torch.ones_like(weights, dtype=torch.bool)
        if plane.select is not None and plane.select.box is not None:
            low, high = (torch.tensor(corner, dtype=points.dtype) for corner in plane.select.box)
            chosen &= ((points >= low) & (points <= high)).all(dim=2)
        if plane.nearer is not None:
            chosen &= distances < plane.nearer
        found.append((weights * chosen).sum(dim=1))
    return torch.stack(found, dim=1).reshape(frame.camera.height, frame.camera.width, -1).numpy()


@pytest.mark.slow_cases
@pytest.mark.parametrize("spec", [{"translation": {"x": 0.1}}, {"translation": {"y": 2e-3}, "rotation": {"yaw": 2e-3}}])
def test_weights_of_samples_stay_inside(spec: dict[str, Any]) -> None:
    scene, around = tiny_scene(), poses(spec)
    method = NerfMethod(scene, num_samples=12)
    planes = (WeightPlane(BOX), WeightPlane(nearer=0.7), WeightPlane(BOX, 1.1))
    # of two parameters few rays: cells of several parameters take long
    read = np.ones((3, 4), bool) if len(spec) == 1 else np.arange(12).reshape(3, 4) % 5 == 1
    frame = method.weight_frame(around, planes, read)
    whole = frame.box
    for box in (whole, whole.split(0, 8)[2]):
        found = frame.cell_bounds(box)
        assert found.linear is not None
        lower, upper, a_low, b_low, a_high, b_high = (
            assemble(part, frame.camera).astype(np.float64) for part in (
                found.lower, found.upper, found.linear[0], found.linear[1], found.linear[2], found.linear[3],
            )
        )  # fmt: skip
        for point in (box.middle, *box.corners(), *box.sample(6, np.random.default_rng(0))):
            image = assemble(frame.of_sample(point, None), frame.camera)
            by_hand = weights_by_hand(frame, scene, point, method.sampling, planes) * read[..., None]
            np.testing.assert_allclose(image, by_hand, atol=2e-7)
            scaled = _scaled(box, point)
            assert ((lower <= by_hand) & (by_hand <= upper)).all()
            assert (a_low @ scaled + b_low <= by_hand).all() and (by_hand <= a_high @ scaled + b_high).all()
    assert (upper - lower).mean() < 0.4 and (image.max(axis=(0, 1)) > 1e-5).all()


def test_rays_that_are_not_read_are_not_bounded() -> None:
    around = poses({"translation": {"x": 0.02}})
    method, some = NerfMethod(tiny_scene(), num_samples=12), np.zeros((3, 4), bool)
    some[1, 1:3] = True
    frame = method.weight_frame(around, [WeightPlane(nearer=2.0)], some)
    every = method.weight_frame(around, [WeightPlane(nearer=2.0)], np.ones((3, 4), bool))
    found = frame.cell_bounds(frame.box)
    lower, upper = (assemble(part, frame.camera)[..., 0] for part in (found.lower, found.upper))
    assert not upper[~some].any() and (upper[some] > lower[some]).all()
    for point in frame.box.sample(5, np.random.default_rng(0)):
        image = assemble(every.of_sample(point, None), frame.camera)[..., 0]
        assert ((lower <= image) & (image <= upper))[some].all()


def test_the_brightest_rays_are_bounded_first() -> None:
    """Of few rays the others may have any weight; those that are bounded have the bounds that they always have."""
    around = poses({"translation": {"x": 0.02}})
    method = NerfMethod(tiny_scene(), num_samples=12)
    frame = method.weight_frame(around, [WeightPlane(nearer=2.0)], np.ones((3, 4), bool))
    middle = assemble(frame.of_sample(frame.box.middle, None), frame.camera)[..., 0].reshape(-1)
    assert sorted(frame.rays.tolist()) == list(range(12)) and (np.diff(middle[frame.rays]) <= 0.0).all()
    every, some = frame.cell_bounds(frame.box), frame.cell_bounds(frame.box, None, 8)
    first = np.zeros(12, bool)
    first[frame.rays[:8]] = True
    assert every.linear is not None and some.linear is not None
    arrays = [(found.lower, found.upper, *(found.linear or ())) for found in (every, some)]
    for whole, part, rest in zip(*arrays, (0.0, 1.0, 0.0, 0.0, 0.0, 1.0), strict=True):
        np.testing.assert_array_equal(part[first], whole[first])
        assert (part[~first] == rest).all()
    for point in frame.box.sample(5, np.random.default_rng(0)):
        image = frame.of_sample(point, None)
        assert ((every.lower <= image) & (image <= every.upper)).all()
        assert ((some.lower <= image) & (image <= some.upper)).all()


def test_fields_have_no_gaussians_and_no_places_of_their_own() -> None:
    around, every = poses({}), np.ones((3, 4), bool)
    with pytest.raises(InputError, match="a NeRF has no Gaussians"):
        NerfMethod(tiny_scene()).weight_frame(around, [WeightPlane(BRIGHT)], every)
    with pytest.raises(InputError, match="uniform samples"):
        NerfMethod(tiny_scene(), sampling="hierarchical").weight_frame(around, [WeightPlane(nearer=1.0)], every)
