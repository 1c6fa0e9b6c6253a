"""Camera poses of a frame over boxes of parameters, as forms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ns_abstract.check.forms import Form, U, fixed, parameters, product, rotation

Array = Any

SHIFTS, TURNS = ("x", "y", "z"), {"yaw": (0.0, 1.0, 0.0), "pitch": (1.0, 0.0, 0.0), "roll": (0.0, 0.0, 1.0)}
#: Rounding of what is computed once from keyframes and axes, by entry.
_BASE = 256.0 * U


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: [3, 4] camera-to-world, OpenGL axes; focal lengths, centre and size in pixels."""

    pose: Array
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


@dataclass(frozen=True)
class Poses:
    """The poses of a frame, by the rules of the perturbation file.

    Attributes:
        camera: The keyframe's camera.
        names: Parameters in the order of a result's boxes.
        values: Those of zero width.
        world: Whether shifts are along world axes.
        orbit: Target [3] and axis [3], or None.
        following: Pose [3, 4] at the end of the segment, or None.
    """

    camera: Camera
    names: tuple[str, ...]
    values: dict[str, float] = field(default_factory=dict)
    world: bool = False
    orbit: tuple[Array, Array] | None = None
    following: Array | None = None

    def _posed(self, low: Array, high: Array) -> tuple[list[list[Form]], list[Form]]:
        """Camera-to-world rotation and position over every box [B, d]."""
        middle = 0.5 * (low + high)
        half = np.maximum(high - middle, middle - low) * (1.0 + 4.0 * U)
        # a set of one pose has no parameters; one that nothing depends on stands in
        given = (
            parameters(middle, half)
            if low.shape[1]
            else [Form(np.zeros(len(low)), np.zeros((0, len(low))), np.zeros(len(low)))]
        )
        like = given[0]
        p = dict(zip(self.names, given, strict=False))
        p |= {name: Form.constant(v, like) for name, v in self.values.items()}
        zero = Form.constant(0.0, like)
        pose = self.camera.pose
        if self.following is None:
            turn, place = fixed(pose[:, :3], like), [Form.constant(v, like) for v in pose[:, 3]]
        else:
            first, last = _nearest_rotation(pose[:, :3]), _nearest_rotation(self.following[:, :3])
            axis, angle = _axis_angle(first.T @ last)
            way = p["segment"]
            turn = product(fixed(first, like, _BASE), rotation(axis, way * angle))
            place = [way * float(b - a) + float(a) for a, b in zip(pose[:, 3], self.following[:, 3], strict=True)]
            for entry in (*place, *(e for row in turn for e in row)):
                entry.r = entry.r + _BASE * (1.0 + np.abs(entry.c))
        if self.orbit is not None:
            target, axis = self.orbit
            swing = rotation(axis / np.linalg.norm(axis), p.get("azimuth", zero))
            for row in swing:
                for entry in row:
                    entry.r = entry.r + _BASE
            turn = product(swing, turn)
            arm = [[place[k] - float(target[k])] for k in range(3)]
            place = [row[0] + float(target[k]) for k, row in enumerate(product(swing, arm))]
        shift = [[p.get(name, zero)] for name in SHIFTS]
        moved = shift if self.world else product(turn, shift)
        place = [a + b[0] for a, b in zip(place, moved, strict=True)]
        for name, axis in TURNS.items():
            if name in p:
                turn = product(turn, rotation(np.array(axis), p[name]))
        return turn, place

    def view(self, low: Array, high: Array) -> tuple[list[list[Form]], list[Form], Array]:
        """World-to-camera rotation, shift and origin: x_camera = rotation (x_world - origin) + shift, OpenCV axes."""
        turn, place = self._posed(low, high)
        # OpenGL to OpenCV: y and z change their sign
        signs = (1.0, -1.0, -1.0)
        back = [[turn[s][r] * signs[r] for s in range(3)] for r in range(3)]
        origin = np.stack([e.c for e in place], axis=1)
        rest = [[-(e - e.c)] for e in place]
        return back, [row[0] for row in product(back, rest)], origin

    def position(self, low: Array, high: Array) -> list[Form]:
        """The camera's position relative to the origin of `view`, for all versions of gsplat.

        Version 1.6.0 takes -R^T t with the view matrix, which differs where a keyframe's rotation R is not orthonormal.
        """
        place, r = self._posed(low, high)[1], self.camera.pose[:, :3]
        stretch = float(np.linalg.norm(r @ r.T - np.eye(3))) + _BASE
        far = sum(np.abs(e.c) + e.width for e in place)
        found = [e - e.c for e in place]
        for entry in found:
            entry.r = entry.r + stretch * far
        return found


def _nearest_rotation(matrix: Array) -> Array:
    u, _, v = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v


def _axis_angle(turn: Array) -> tuple[Array, float]:
    """Axis and angle of a rotation, by way of the quaternion's largest component."""
    k = np.array(
        [
            [
                turn[0, 0] - turn[1, 1] - turn[2, 2],
                turn[1, 0] + turn[0, 1],
                turn[2, 0] + turn[0, 2],
                turn[2, 1] - turn[1, 2],
            ],
            [0.0, turn[1, 1] - turn[0, 0] - turn[2, 2], turn[2, 1] + turn[1, 2], turn[0, 2] - turn[2, 0]],
            [0.0, 0.0, turn[2, 2] - turn[0, 0] - turn[1, 1], turn[1, 0] - turn[0, 1]],
            [0.0, 0.0, 0.0, np.trace(turn)],
        ]
    )
    # the quaternion is the eigenvector of the largest eigenvalue
    x, y, z, w = np.linalg.eigh(k, UPLO="U")[1][:, -1]
    vector = np.array([x, y, z]) * (1.0 if w >= 0.0 else -1.0)
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        return np.array([0.0, 0.0, 1.0]), 0.0
    return vector / length, 2.0 * float(np.arctan2(length, abs(w)))
