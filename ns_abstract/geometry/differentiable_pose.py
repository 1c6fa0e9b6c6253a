"""A torch version of `PoseBox.pose`: the same poses, differentiable with respect to the parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ns_abstract.geometry.poses import PoseBox


class _Tensors:
    """Arithmetic for `PoseBox.evaluated` whose numbers are tensors at the parameter ``values`` [d]."""

    def __init__(self, values: Tensor, dimensions: int) -> None:
        if values.shape != (dimensions,):
            raise ValueError(f"{tuple(values.shape)} values for {dimensions} parameters")
        self.values = values

    def constant(self, _basis: Any, value: Any) -> Tensor:
        return torch.tensor(np.array(value, np.float64))

    def parameter(self, _basis: Any, index: int, _middle: float, _half: float) -> Tensor:
        return self.values[index]


def differentiable_pose(pose_set: PoseBox) -> Callable[[Tensor], Tensor]:
    """Return `PoseBox.pose` as a differentiable function from values [d] to camera-to-world [3, 4], float64."""

    def pose(values: Tensor) -> Tensor:
        tensors = _Tensors(values, pose_set.box.dimensions)
        rotation, position = pose_set.evaluated(
            pose_set.box, None, tensors, lambda angle: (torch.cos(angle), torch.sin(angle)), torch.from_numpy
        )
        return torch.cat([rotation, position[:, None]], dim=1)

    return pose
