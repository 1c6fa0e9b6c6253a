"""The common parts of the methods of both kinds of field."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.hsv import color_shift
from ns_abstract.methods.nerf.scene import FieldScene
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.refine.protocol import Method

if TYPE_CHECKING:
    import torch


class FieldMethod(Method):
    """The base of methods of fields, which have no scene elements."""

    guarantee = "real-sound"

    def __init__(self, scene: FieldScene) -> None:
        self._named = scene

    @property
    def name(self) -> str:
        return self._named.name

    @property
    def notes(self) -> tuple[str, ...]:
        return self._named.notes

    @property
    def dataset_scale(self) -> float | None:
        return self._named.dataparser.stated_scale

    def prepare(self, perturbations: Sequence[Perturbation]) -> None:
        """Raise InputError where a set varies the scene, which needs Gaussians."""
        if any(perturbation.scene for perturbation in perturbations):
            raise InputError("a NeRF has no Gaussians", field="scene", fix="leave the key out")


def check_arithmetic(arithmetic: str | None) -> None:
    """Raise InputError where bounds of float32 are requested."""
    if arithmetic not in (None, "real"):
        raise InputError(
            "float32 evaluations of a NeRF's networks cannot be enclosed tightly", field="--arithmetic", fix="use real"
        )


def refuse_layers(layers: bool) -> None:
    """Raise InputError where depth or accumulation are requested: a NeRF's depth is a median."""
    if layers:
        raise InputError("depth and accumulation of a NeRF are not bounded", field="--outputs", fix="leave it out")


def arrays_digest(arrays: Iterable[np.ndarray]) -> hashlib._Hash:
    """Return the SHA-256 digest of the arrays' shapes and contents, one after another."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(repr(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest


def picture_of_parameters(
    poses: PoseBox, picture: Callable[[PinholeCamera, torch.Tensor, Any], torch.Tensor]
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return a function from parameter values [d] to the picture [H, W, 3].

    ``picture`` renders for a camera, a pose and a colour shift.
    """
    from ns_abstract.geometry.differentiable_pose import differentiable_pose

    pose, camera = differentiable_pose(poses.geometry), poses.camera
    count = poses.geometry.box.dimensions
    return lambda values: picture(camera, pose(values[:count]), color_shift(poses, values.unbind()))
