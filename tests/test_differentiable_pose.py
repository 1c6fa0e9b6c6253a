"""The differentiable twin of a pose set: same poses, right derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.differentiable_pose import differentiable_pose
from ns_abstract.geometry.poses import PoseBox, rotation_about
from ns_abstract.perturbation.specification import parse_perturbation

torch.set_num_threads(1)
SIX = {
    "translation": {"x": 0.3, "y": [-0.1, 0.4], "z": 0.2},
    "rotation": {"yaw": 0.7, "pitch": [0.1, 0.5], "roll": 1.5},
}
ORBIT = {"target": [0.3, -0.2, 0.1], "axis": [0.2, -0.5, 2.0], "azimuth": [-1.0, 3.0]}
SPECS: dict[str, dict[str, Any]] = {
    "one": {"translation": {"x": 0.02}},
    "six": SIX,
    "world": SIX | {"frame": "world"},
    "fixed": {"translation": {"x": [0.1, 0.1], "y": 0.1}, "rotation": {"roll": [0.2, 0.2]}},
    "segments": {"sweep": "segments"},
    "orbit": {"orbit": ORBIT},
    "everything": SIX | {"sweep": "segments", "orbit": ORBIT},
}


def keyframe(seed: int) -> PinholeCamera:
    """A camera at a random pose."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    rotation = rotation_about(axis / np.linalg.norm(axis), rng.uniform(0, np.pi))
    pose = np.concatenate([rotation, rng.uniform(-3, 3, (3, 1))], axis=1)
    return PinholeCamera(pose, 40.0, 40.0, 16.0, 16.0, 32, 32)


def pose_set(name: str, seed: int) -> PoseBox:
    return PoseBox.around(keyframe(seed), parse_perturbation(SPECS[name]), keyframe(seed + 1000))


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", SPECS)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 999))
def test_same_pose(name: str, seed: int) -> None:
    poses = pose_set(name, seed)
    twin = differentiable_pose(poses)
    for values in [*poses.box.corners()[:4], *poses.box.sample(3, np.random.default_rng(seed))]:
        assert np.abs(twin(torch.from_numpy(values)).numpy() - poses.pose(values)).max() <= 1e-12


@pytest.mark.parametrize("name", SPECS)
def test_derivatives(name: str) -> None:
    poses = pose_set(name, 5)
    values = torch.from_numpy(poses.box.sample(1, np.random.default_rng(1))[0]).requires_grad_(True)
    assert torch.autograd.gradcheck(differentiable_pose(poses), (values,))


def test_order_of_rotations() -> None:
    # yaw and pitch do not commute: a twin with the other order must not pass
    poses = pose_set("six", 7)
    values = torch.from_numpy(poses.box.at(np.full(6, 0.9)))
    swapped = values[[0, 1, 2, 4, 3, 5]]
    twin = differentiable_pose(poses)
    assert (twin(values) - twin(swapped)).abs().max() > 1e-2


def test_wrong_length() -> None:
    with pytest.raises(ValueError):
        differentiable_pose(pose_set("six", 1))(torch.zeros(5, dtype=torch.float64))
