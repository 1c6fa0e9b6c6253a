"""Bounds of Nerfstudio's own samples by bins: attacked at tolerance zero; planted faults are found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from nerfs import UNIFORM, pixels_of, poses, tiny_scene

from ns_abstract.geometry.poses import PoseSet
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf import bounds as bounds_module
from ns_abstract.methods.nerf.bounds import NerfBounds, RayBounds
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.method import NerfMethod
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import nerf_renderer

BINS = dataclasses.replace(UNIFORM, kind="hierarchical", samples=32, importance=40)
SETS = {
    "point": {"rotation": {"yaw": [0.1, 0.1]}},
    "yaw": {"rotation": {"yaw": 0.001}},
    "orbit": {"orbit": {"target": [0, 0, 0], "axis": [0, 0.1, 1], "azimuth": [0.3, 0.302]}},
}


def bounded(scene: NerfScene, pose_set: PoseSet) -> RayBounds:
    pixels = pixels_of(pose_set.camera)[:6]
    return NerfBounds(scene, BINS, pose_set.box.dimensions).rays(pose_set, pose_set.box, pixels, 0.05)


def attack(scene: NerfScene, pose_set: PoseSet, found: RayBounds) -> tuple[int, int]:
    """Comparisons and violations of random poses, corners, gradient ascent and jumps on the first rays."""
    camera = pose_set.camera
    lower, upper = np.zeros((camera.height * camera.width, 3)), np.ones((camera.height * camera.width, 3))
    lower[: len(found.lower)], upper[: len(found.lower)] = found.lower, found.upper
    shape = (camera.height, camera.width, 3)
    render, probe, twin = nerf_renderer(scene, pose_set, BINS)
    result = falsify(
        lower.reshape(shape), upper.reshape(shape), pose_set.box, render, twin, probe=probe, poses=40, seed=1
    )
    return result.comparisons, result.violations


@pytest.mark.parametrize("name", SETS)
def test_every_choice_of_samples_is_enclosed(name: str) -> None:
    for seed, changes in ((3, {}), (1, {"density": 1e3})):
        scene, pose_set = tiny_scene(seed, **changes), poses(SETS[name])
        found = bounded(scene, pose_set)
        assert (found.upper - found.lower).mean() < 0.9, "nothing was bounded"
        compared, violations = attack(scene, pose_set, found)
        assert compared > 0 and violations == 0


def test_a_smooth_field_is_tight() -> None:
    scene, pose_set = tiny_scene(3, density=1.0, color=0.5), poses(SETS["yaw"])
    found = bounded(scene, pose_set)
    assert (found.upper - found.lower).mean() < 0.25


def only_middles(self, values, end, axis=-1):
    """Takes one part of every bin for all of it."""
    inner = self.division.parts[-1]
    axis %= values.ndim
    shape = (*values.shape[:axis], -1, inner, *values.shape[axis + 1 :])
    return np.repeat(values.reshape(shape).take(inner // 2, axis=axis + 1), inner, axis=axis)


def test_planted_faults_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounds_module._Work, "_anywhere", only_middles)
    scene, pose_set = tiny_scene(3, density=30.0), poses(SETS["yaw"])
    assert attack(scene, pose_set, bounded(scene, pose_set))[1] > 0


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
