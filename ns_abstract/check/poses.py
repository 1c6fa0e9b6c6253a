"""Cameras of a frame over boxes of parameters, as forms."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ns_abstract.check.forms import Affine, Array, U, fixed, parameters, product, rotation

SHIFTS, TURNS = ("x", "y", "z"), {"yaw": (0.0, 1.0, 0.0), "pitch": (1.0, 0.0, 0.0), "roll": (0.0, 0.0, 1.0)}
#: Rounding of what is computed once from keyframes and axes, by entry.
_BASE = 256.0 * U


@dataclass(frozen=True)
class CheckedCamera:
    """A pinhole camera: camera-to-world [3, 4] (OpenGL axes), and focal lengths, principal point and size in pixels."""

    pose: Array
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


@dataclass(frozen=True)
class Poses:
    """The set of a frame's poses, as the perturbation file defines it."""

    #: The keyframe's camera.
    camera: CheckedCamera
    #: Parameters in the order of a result's boxes.
    names: tuple[str, ...]
    #: Those of zero width.
    values: dict[str, float] = field(default_factory=dict)
    #: Whether shifts are along world axes.
    world: bool = False
    #: Target [3] and axis [3], or None.
    orbit: tuple[Array, Array] | None = None
    #: Pose [3, 4] at the end of the segment, or None.
    following: Array | None = None

    def given(self, low: Array, high: Array) -> dict[str, Affine]:
        """Return the form of each parameter, by name, over boxes [B, d]; the name "" is the constant 0."""
        middle = 0.5 * (low + high)
        free = parameters(middle, np.maximum(high - middle, middle - low) * (1.0 + 4.0 * U))
        coordinates = {"": Affine.constant(0.0, free[0])} | dict(zip(self.names, free, strict=False))
        return coordinates | {name: Affine.constant(v, free[0]) for name, v in self.values.items()}

    def view(self, low: Array, high: Array) -> CameraForms:
        """Return the cameras over boxes [B, d]."""
        return CameraForms(*self.posed(self.given(low, high)), self.camera.pose)

    def posed(self, p: dict[str, Affine]) -> tuple[list[list[Affine]], list[Affine]]:
        """Return the camera-to-world rotation [3][3] and the camera's position at the parameters."""
        zero, pose = p[""], self.camera.pose
        if self.following is None:
            turn, place = fixed(pose[:, :3], zero), [Affine.constant(v, zero) for v in pose[:, 3]]
        else:
            first, last = _nearest_rotation(pose[:, :3]), _nearest_rotation(self.following[:, :3])
            axis, angle = _axis_angle(first.T @ last)
            turn = product(fixed(first, zero, _BASE), rotation(axis, p["segment"] * angle, _BASE))
            ends = zip(pose[:, 3], self.following[:, 3], strict=True)
            place = [p["segment"] * float(b - a) + float(a) for a, b in ends]
            turn = [[e.wider(_BASE * (1.0 + np.abs(e.c))) for e in row] for row in turn]
            place = [e.wider(_BASE * (1.0 + np.abs(e.c))) for e in place]
        if self.orbit is not None:
            target, axis = self.orbit
            swing = rotation(axis / np.linalg.norm(axis), p.get("azimuth", zero), _BASE)
            turn, arm = product(swing, turn), [[place[k] - float(target[k])] for k in range(3)]
            place = [row[0] + float(target[k]) for k, row in enumerate(product(swing, arm))]
        shift = [[p.get(name, zero)] for name in SHIFTS]
        place = [a + b[0] for a, b in zip(place, shift if self.world else product(turn, shift), strict=True)]
        for name, axis in TURNS.items():
            if name in p:
                turn = product(turn, rotation(np.array(axis), p[name]))
        return turn, place


class CameraForms:
    """Cameras over boxes of parameters, all forms [B].

    x_camera = ``rotation`` (x_world - ``origin``) + ``shift``, OpenCV axes; ``origin`` [B, 3] are numbers.
    """

    def __init__(self, turn: list[list[Affine]], place: list[Affine], keyframe: Array) -> None:
        square = keyframe[:, :3] @ keyframe[:, :3].T
        # by how much the keyframe's matrix is no rotation
        self.stretch = np.full(len(place[0].c), float(np.linalg.norm(square - np.eye(3))) + _BASE)
        # camera-to-world rotation, OpenGL axes, and the camera's place less the origin
        self.turn, self.position = turn, [e - e.c for e in place]
        # OpenGL to OpenCV: y and z change their sign
        self.rotation = [[turn[s][r] * (1.0, -1.0, -1.0)[r] for s in range(3)] for r in range(3)]
        self.shift = [row[0] for row in product(self.rotation, [[-e] for e in self.position])]
        self.origin = np.stack([e.c for e in place], axis=-1)


def _nearest_rotation(matrix: Array) -> Array:
    u, _, v = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v


def _axis_angle(turn: Array) -> tuple[Array, float]:
    """Return the axis and angle of a rotation, from its quaternion: an eigenvector of a symmetric matrix."""
    a, t = turn, np.trace(turn)
    rest = np.array([a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]])
    k = np.block([[a + a.T - t * np.eye(3), rest[:, None]], [rest[None], np.full((1, 1), t)]])
    *vector, w = np.linalg.eigh(k)[1][:, -1]
    vector = np.array(vector) * (1.0 if w >= 0.0 else -1.0)
    length = float(np.linalg.norm(vector))
    # without a turn there is no axis, and none is needed
    return vector / (length or 1.0), 2.0 * float(np.arctan2(length, abs(w)))
