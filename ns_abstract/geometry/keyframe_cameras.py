"""Keyframe cameras that look at a target, and camera paths as the Nerfstudio viewer writes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FOV = 45.0  # vertical, degrees


@dataclass(frozen=True)
class KeyframeCamera:
    """A keyframe's camera: square pixels, principal point in the middle.

    Attributes:
        camera_to_world: [4, 4] float64, OpenGL axes (x right, y up, z back), normalised frame.
        fov: Vertical field of view in degrees.
    """

    camera_to_world: NDArray[np.float64]
    fov: float = FOV
    height: int = 200
    width: int = 200


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> NDArray[np.float64]:
    """Return the camera-to-world matrix [4, 4] of a camera at ``eye`` that looks at ``target`` (OpenGL axes)."""
    back = np.asarray(eye, np.float64) - np.asarray(target, np.float64)
    back /= np.linalg.norm(back)
    right = np.cross(np.asarray(up, np.float64), back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = eye
    return pose


def around(
    target: ArrayLike, azimuth: float, elevation: float, distance: float, *, height: int = 200, width: int = 200
) -> KeyframeCamera:
    """Return a view of ``target`` from ``distance``; angles in degrees, azimuth from +x towards +y, z up."""
    a, e = np.deg2rad([azimuth, elevation])
    eye = np.asarray(target) + distance * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return KeyframeCamera(look_at(eye, target), height=height, width=width)


def path_json(
    views: Sequence[KeyframeCamera], *, seconds: float = 2.0, fps: int = 24, perturbation: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return a camera path with one frame and one keyframe per view; all ``views`` are of the first one's size.

    ``seconds`` is the duration that ns-render gives the video, ``fps`` the frame rate that the viewer shows;
    ``perturbation`` is stored under "perturbation" when given.
    """
    first = views[0]
    if any((v.height, v.width) != (first.height, first.width) for v in views):
        raise ValueError("views: all views of a path have one size")
    aspect = first.width / first.height
    matrices = [view.camera_to_world.flatten().tolist() for view in views]
    path: dict[str, Any] = {
        "default_fov": first.fov,
        "default_transition_sec": seconds / max(1, len(views) - 1),
        "keyframes": [
            {
                "matrix": matrix,
                "fov": view.fov,
                "aspect": aspect,
                "override_transition_enabled": False,
                "override_transition_sec": None,
            }
            for matrix, view in zip(matrices, views, strict=True)
        ],
        "camera_type": "perspective",
        "render_height": first.height,
        "render_width": first.width,
        "fps": fps,
        "seconds": seconds,
        "is_cycle": False,
        "smoothness_value": 0.5,
        "camera_path": [
            {"camera_to_world": matrix, "fov": view.fov, "aspect": aspect}
            for matrix, view in zip(matrices, views, strict=True)
        ],
    }
    if perturbation is not None:
        path["perturbation"] = perturbation
    return path


def ring(target: ArrayLike, distance: float, count: int = 10, size: int = 200) -> list[KeyframeCamera]:
    """Return ``count`` views of ``target`` on a circle around it, alternately 15 and 30 degrees above."""
    turns = [360.0 * k / count for k in range(count)]
    return [around(target, a, 15.0 + 15.0 * (k % 2), distance, height=size, width=size) for k, a in enumerate(turns)]
