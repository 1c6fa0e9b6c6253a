"""A torch version of `PoseBox.pose`: the same poses, differentiable with respect to the parameters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ns_abstract.geometry.poses import SCENE_SHIFTS, SCENE_TURNS, PoseBox, axis_angle, orthonormal
from ns_abstract.perturbation.specification import ROTATIONS, TRANSLATIONS

#: Elementary rotation axes of yaw, pitch and roll in camera axes.
_AXES = {"yaw": (0.0, 1.0, 0.0), "pitch": (1.0, 0.0, 0.0), "roll": (0.0, 0.0, 1.0)}


def _turn(axis: Tensor, angle: Tensor) -> Tensor:
    """[3, 3] right-handed rotation by ``angle`` (radians) about the unit vector ``axis`` [3].

    ``R = c I + s [a]_x + (1 - c) a a^T``.
    """
    x, y, z = axis.unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    cosine = torch.cos(angle)
    return (
        cosine * torch.eye(3, dtype=torch.float64) + torch.sin(angle) * cross + (1.0 - cosine) * torch.outer(axis, axis)
    )


def differentiable_pose(pose_set: PoseBox) -> Callable[[Tensor], Tensor]:
    """The function from parameter values [d] to camera-to-world [3, 4], both float64.

    Values are in physical units and in the order of ``pose_set.box``, as for `PoseBox.pose`; the rules
    are those of the perturbation file: segment, then orbit, then translation, then yaw, pitch and roll; then those of
    `PoseBox.registered`.
    """
    perturbation = pose_set.perturbation
    start = torch.from_numpy(np.array(pose_set.camera.camera_to_world))
    fixed = {name: torch.tensor(value, dtype=torch.float64) for name, value in pose_set.fixed.items()}
    segment: tuple[Tensor, Tensor, float, Tensor] | None = None
    if pose_set.target_camera is not None:
        end = pose_set.target_camera.camera_to_world
        first, last = orthonormal(start[:, :3].numpy()), orthonormal(end[:, :3])
        axis, angle = axis_angle(first.T @ last)
        segment = (torch.from_numpy(first), torch.from_numpy(axis), angle, torch.from_numpy(np.array(end[:, 3])))

    def pose(values: Tensor) -> Tensor:
        p = fixed | dict(zip(pose_set.box.names, values.unbind(), strict=True))
        rotation, position = start[:, :3], start[:, 3]
        if segment is not None:
            first, axis, angle, end = segment
            rotation = first @ _turn(axis, p["segment"] * angle)
            position = position + p["segment"] * (end - position)
        orbit = perturbation.orbit
        if orbit is not None:
            direction = torch.tensor(orbit.axis, dtype=torch.float64)
            turn = _turn(direction / direction.norm(), p["azimuth"])
            target = torch.tensor(orbit.target, dtype=torch.float64)
            rotation, position = turn @ rotation, target + turn @ (position - target)
        shift = torch.stack([p[name] for name in TRANSLATIONS])
        position = position + (rotation @ shift if perturbation.frame == "camera" else shift)
        for name in ROTATIONS:
            rotation = rotation @ _turn(torch.tensor(_AXES[name], dtype=torch.float64), p[name])
        unit = torch.eye(3, dtype=torch.float64)
        for k, name in enumerate(SCENE_TURNS):
            if name in p:
                turn = _turn(unit[k], -p[name])
                rotation, position = turn @ rotation, turn @ position
        for k, name in enumerate(SCENE_SHIFTS):
            if name in p:
                position = position - p[name] * unit[k]
        return torch.cat([rotation, position[:, None]], dim=1)

    return pose
