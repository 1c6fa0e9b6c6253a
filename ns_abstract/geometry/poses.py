"""Sets of camera poses: concrete poses, and forms that enclose all poses of a box.

Camera-to-world poses follow Nerfstudio (OpenGL axes); enclosures are of the world-to-camera
transform that gsplat receives (OpenCV axes, splatfacto.py:128-143).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.arithmetic.forms import Basis, Float64Array
from ns_abstract.arithmetic.rounding import HALF_UP, POSE_ROUNDING, STILL_ROOM, TURNED_POSITION, TURNED_ROTATION
from ns_abstract.arithmetic.taylor import TaylorArray, TaylorBasis, taylor_cos_sin
from ns_abstract.arithmetic.trigonometry import cos_sin
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import InputTuning
from ns_abstract.perturbation.specification import ROTATIONS, TRANSLATIONS, Perturbation

#: Elementary rotation axes of yaw, pitch and roll in camera axes.
_CAMERA_AXES = {"yaw": (0.0, 1.0, 0.0), "pitch": (1.0, 0.0, 0.0), "roll": (0.0, 0.0, 1.0)}
#: Parameters that shift the colours of a NeRF's points and leave the pose alone.
COLOR_SHIFTS = ("hue", "saturation")
#: Parameters of a rigid motion of the whole scene: shifts along the world axes, or turns (radians) about them.
SCENE_SHIFTS = ("scene_x", "scene_y", "scene_z")
SCENE_TURNS = ("scene_turn_x", "scene_turn_y", "scene_turn_z")
#: OpenGL to OpenCV camera axes.
_FLIP = np.array([1.0, -1.0, -1.0])


def _cross_matrix(axis: Float64Array) -> Float64Array:
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_about(axis: Float64Array, angle: float) -> Float64Array:
    """Return the [3, 3] right-handed rotation by ``angle`` (radians) about the unit vector ``axis`` (Rodrigues)."""
    k = _cross_matrix(np.asarray(axis, np.float64))
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def _check_segment(camera: PinholeCamera, following: PinholeCamera) -> None:
    """Raise InputError unless the segment between two keyframes begins and ends with their own pictures.

    Their intrinsics must be equal, and their rotations orthonormal, since the segment uses the nearest rotations.
    """
    if following.intrinsics != camera.intrinsics:
        raise InputError(
            "neighbouring keyframes have different fields of view or principal points",
            field="camera_path.fov",
            fix="use one fov for a path that is swept in segments",
        )
    for entry in (camera, following):
        rotation = entry.camera_to_world[:, :3]
        distance = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        if not distance <= InputTuning.segment:
            raise InputError(
                f"the rotation part is {distance:.3g} away from orthonormal (segments: {InputTuning.segment:g})",
                field="camera_path.camera_to_world",
                fix='write rotations to seven digits, or leave "sweep": "segments" out',
            )


def orthonormal(matrix: Float64Array) -> Float64Array:
    """Return the rotation nearest to ``matrix`` [3, 3]."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def axis_angle(rotation: Float64Array) -> tuple[Float64Array, float]:
    """Return the unit axis [3] and angle in [0, pi] of a rotation [3, 3].

    By way of the quaternion, from its largest component (Shepperd 1978), which is accurate for every
    angle, a half turn included.
    """
    r = rotation
    squares = np.array(
        [
            1.0 + r[0, 0] + r[1, 1] + r[2, 2],
            1.0 + r[0, 0] - r[1, 1] - r[2, 2],
            1.0 - r[0, 0] + r[1, 1] - r[2, 2],
            1.0 - r[0, 0] - r[1, 1] + r[2, 2],
        ]
    )
    # four times the products of the quaternion's components (w, x, y, z)
    products = np.array(
        [
            [squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], squares[1], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], squares[2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[3]],
        ]
    )
    quaternion = products[int(np.argmax(squares))]
    quaternion = quaternion / np.linalg.norm(quaternion)
    if quaternion[0] < 0.0:
        quaternion = -quaternion
    vector = quaternion[1:]
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        return np.array([0.0, 0.0, 1.0]), 0.0
    return vector / length, 2.0 * float(np.arctan2(length, quaternion[0]))


@dataclass(frozen=True)
class PoseForms:
    """Forms of the world-to-camera transform over one box of parameters.

    ``x_camera = rotation (x_world - origin) + offset``, with forms [3, 3] and [3]; the camera stands at ``position``
    [3], world. ``origin`` [3] is the exact world point that coordinates are taken from.
    """

    rotation: FormArray
    offset: FormArray
    position: FormArray
    origin: Float64Array


@dataclass(frozen=True, eq=False)
class PoseBox:
    """The set of poses of one frame: a camera and a box of pose parameters around it.

    Attributes:
        camera: Intrinsics and image size; the pose of the first keyframe.
        box: Parameters of positive width, in the order x, y, z, yaw, pitch, roll, segment, azimuth, hue, saturation;
            then those of a motion of the scene (`registered`).
        fixed: Values of the parameters of width 0.
        target_camera: End of the segment, if the sweep is over segments.
        shear: [name][other] factors: the rotation ``name`` is the box's value plus the sum of factor * other
            (`sheared`).
    """

    camera: PinholeCamera
    perturbation: Perturbation
    box: ParameterBox
    fixed: dict[str, float]
    target_camera: PinholeCamera | None = None
    shear: dict[str, dict[str, float]] = field(default_factory=dict)

    @classmethod
    def around(
        cls, camera: PinholeCamera, perturbation: Perturbation, following: PinholeCamera | None = None
    ) -> PoseBox:
        """Return the pose set of one keyframe; ``following`` is the next one, used if the sweep is over segments."""
        ranges: dict[str, tuple[str, tuple[float, float]]] = {}
        for name in TRANSLATIONS:
            ranges[name] = ("normalised units", perturbation.translation.get(name, (0.0, 0.0)))
        for name in ROTATIONS:
            ranges[name] = ("rad", perturbation.rotation.get(name, (0.0, 0.0)))
        segment = following if perturbation.sweep == "segments" else None
        if segment is not None:
            _check_segment(camera, segment)
            ranges["segment"] = ("of the way", (0.0, 1.0))
        if perturbation.orbit is not None:
            ranges["azimuth"] = ("rad", perturbation.orbit.azimuth)
        for name, unit in zip(COLOR_SHIFTS, ("turns", "of 1"), strict=True):
            shift: tuple[float, float] | None = getattr(perturbation, name)
            if shift is not None:
                ranges[name] = (unit, shift)
        free = {name: entry for name, entry in ranges.items() if entry[1][0] < entry[1][1]}
        box = ParameterBox(
            tuple(free),
            tuple(unit for unit, _ in free.values()),
            tuple(low for _, (low, _) in free.values()),
            tuple(high for _, (_, high) in free.values()),
        )
        fixed = {name: low for name, (_, (low, high)) in ranges.items() if low == high}
        return cls(camera, perturbation, box, fixed, segment)

    @property
    def geometry(self) -> PoseBox:
        """The same poses without the parameters that shift colours."""
        return replace(self, box=self.box.without(COLOR_SHIFTS))

    def registered(self, names: tuple[str, ...], radius: float) -> PoseBox:
        """Return the same pose set relative to a scene that is shifted or turned as a whole (design.md, P3).

        ``names``: `SCENE_SHIFTS`, normalised units; or `SCENE_TURNS`, radians: the scene is turned about the world axes
        through the origin, z first and x last. These parameters follow the set's own, each from -``radius`` to
        ``radius``, which is above 0.
        """
        box, unit = self.box, "normalised units" if names == SCENE_SHIFTS else "rad"
        count = len(names)
        more = names, (unit,) * count, (-radius,) * count, (radius,) * count
        parts = box.names, box.units, box.lower, box.upper
        return replace(self, box=ParameterBox(*(a + b for a, b in zip(parts, more, strict=True))))  # pyright: ignore[reportArgumentType]

    def sheared(self, shear: dict[str, dict[str, float]]) -> PoseBox:
        """Return the same pose set in sheared parameters: rotation = parameter + sum of factor * other (design.md, P2).

        The box holds parameters of every pose of the set and, near its ends, of none (`feasible`); for the latter,
        `pose` takes the nearest angle of the set.
        """
        box = self.box
        for name, factors in shear.items():
            axis = box.names.index(name)
            low, high = box.lower[axis], box.upper[axis]
            ends = [
                sorted((factor * self.box.lower[i], factor * self.box.upper[i]))
                for i, factor in ((self.box.names.index(other), factor) for other, factor in factors.items())
            ]
            room = POSE_ROUNDING * (abs(low) + abs(high) + sum(abs(end) for pair in ends for end in pair))
            box = box.replace(axis, low - sum(b for _, b in ends) - room, high - sum(a for a, _ in ends) + room)
        return replace(self, box=box, shear=shear)

    def within(self, box: ParameterBox) -> PoseBox:
        """Return the pose set of a ``box`` of the same parameters (design.md, V15); not for sheared parameters."""
        ranges = dict(self.perturbation.rotation)
        for name, low, high in zip(box.names, box.lower, box.upper, strict=True):
            if name in ROTATIONS:
                ranges[name] = (low, high)
        return replace(self, box=box, perturbation=replace(self.perturbation, rotation=ranges))

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        """Return smaller box that holds all parameters of ``box`` of poses of the set; None: there are none (P2)."""
        for name, factors in self.shear.items():
            low, high = self.perturbation.rotation[name]
            terms = {box.names.index(name): 1.0} | {box.names.index(other): f for other, f in factors.items()}
            ends = {i: sorted((f * box.lower[i], f * box.upper[i])) for i, f in terms.items()}
            room = POSE_ROUNDING * (abs(low) + abs(high) + sum(abs(end) for pair in ends.values() for end in pair))
            least, most = sum(a for a, _ in ends.values()), sum(b for _, b in ends.values())
            if least > high + room or most < low - room:
                return None
            for i, factor in terms.items():
                # bounds of this term, from [low, high] minus the other terms
                bottom, top = low - room - (most - ends[i][1]), high + room - (least - ends[i][0])
                first, last = sorted((bottom / factor, top / factor))
                first, last = first - room / abs(factor), last + room / abs(factor)
                first, last = max(first, box.lower[i]), min(last, box.upper[i])
                if first > last:
                    return None
                box = box.replace(i, first, last)
        return box

    @cached_property
    def _base(self) -> tuple[Float64Array, Float64Array, Float64Array, float, Float64Array]:
        """Start rotation, start position, segment axis, segment angle, segment displacement."""
        start = self.camera.camera_to_world
        if self.target_camera is None:
            return start[:, :3], start[:, 3], np.array([0.0, 0.0, 1.0]), 0.0, np.zeros(3)
        end = self.target_camera.camera_to_world
        first, last = orthonormal(start[:, :3]), orthonormal(end[:, :3])
        axis, angle = axis_angle(first.T @ last)
        return first, start[:, 3], axis, angle, end[:, 3] - start[:, 3]

    def pose(self, values: Float64Array, beyond: bool = False) -> Float64Array:
        """Return the camera-to-world [3, 4] at parameter values [d] (physical units, in the order of ``box``).

        Sheared rotations outside of the set are clipped to it, unless ``beyond`` is true.
        """
        p = dict(self.fixed) | dict(zip(self.box.names, np.asarray(values, np.float64).tolist(), strict=True))
        for name, factors in self.shear.items():
            low, high = (-np.inf, np.inf) if beyond else self.perturbation.rotation[name]
            p[name] = min(max(p[name] + sum(factor * p[other] for other, factor in factors.items()), low), high)
        rotation, position, axis, angle, displacement = self._base
        if self.target_camera is not None:
            rotation = rotation @ rotation_about(axis, p["segment"] * angle)
            position = position + p["segment"] * displacement
        orbit = self.perturbation.orbit
        if orbit is not None:
            turn = rotation_about(np.array(orbit.axis) / np.linalg.norm(orbit.axis), p["azimuth"])
            target = np.array(orbit.target)
            rotation, position = turn @ rotation, target + turn @ (position - target)
        shift = np.array([p[name] for name in TRANSLATIONS])
        position = position + (rotation @ shift if self.perturbation.frame == "camera" else shift)
        for name in ROTATIONS:
            if p[name] != 0.0:
                rotation = rotation @ rotation_about(np.array(_CAMERA_AXES[name]), p[name])
        # a motion of the scene is the inverse motion of the camera
        for k, name in enumerate(SCENE_TURNS):
            if name in p:
                turn = rotation_about(np.eye(3)[k], -p[name])
                rotation, position = turn @ rotation, turn @ position
        position = position - np.array([p.get(name, 0.0) for name in SCENE_SHIFTS])
        return np.concatenate([rotation, position[:, None]], axis=1)

    def enclosure(self, box: ParameterBox, order: int = 1) -> PoseForms:
        """Return forms that enclose the transform of every pose of ``box`` (design.md, P1)."""
        rotation, position = self.evaluated(box, Basis(self.box.dimensions, order), FormArray, cos_sin)
        m = rotation.basis.monomials
        rounding, shift = self._rounding
        rotation.data[m] += rounding
        position.data[m] += shift
        world_to_camera = rotation.transpose().flipped(_FLIP[:, None])
        origin = position.center.copy()
        offset = world_to_camera @ (origin - position)
        return PoseForms(world_to_camera, offset, position, origin)

    def taylor(self, box: ParameterBox, degree: int) -> tuple[TaylorArray, TaylorArray]:
        """Return Taylor models of the camera-to-world rotation [3, 3] and position [3] over ``box`` (P1, N1)."""
        basis = TaylorBasis(self.box.dimensions, degree)
        rotation, position = self.evaluated(box, basis, TaylorArray, taylor_cos_sin)
        rounding, shift = self._rounding
        return rotation.widened(rounding), position.widened(shift)

    @cached_property
    def _rounding(self) -> tuple[float, float]:
        """Error bounds of a pose evaluated in float64: of an entry of its rotation, and of one of its position."""
        start, displacement = self._base[1], self._base[4]
        limits = {name: (value, value) for name, value in self.fixed.items()}
        limits |= dict(zip(self.box.names, zip(self.box.lower, self.box.upper, strict=True), strict=True))
        # limits of the box, because a set that was grown exceeds its perturbation's ranges
        farthest = sum(max(map(abs, limits[name])) for name in (*TRANSLATIONS, *SCENE_SHIFTS) if name in limits)
        shift = POSE_ROUNDING * (1.0 + farthest + np.abs(start).max() + np.abs(displacement).max())
        if self.perturbation.orbit is not None:
            shift += POSE_ROUNDING * (1.0 + 2.0 * np.abs(self.perturbation.orbit.target).max())
        if any(name in limits for name in SCENE_TURNS):
            return TURNED_ROTATION * POSE_ROUNDING, TURNED_POSITION * shift
        return POSE_ROUNDING, shift

    def evaluated(
        self,
        box: ParameterBox,
        basis: Any,
        kind: Any,
        trigonometry: Callable[[Any], tuple],
        array: Callable[[Float64Array], Any] = lambda numbers: numbers,
    ) -> tuple[Any, Any]:
        """Return the camera-to-world rotation [3, 3] and position [3] over ``box``, in the arithmetic of ``kind``.

        The rounding errors of `pose` are not charged. ``kind`` has ``constant`` and ``parameter`` with the ``basis``;
        ``trigonometry`` returns cosine and sine; ``array`` converts plain numbers for operations with ``kind``.
        """

        def parameter(name: str) -> Any:
            form = plain(name)
            for other, factor in self.shear.get(name, {}).items():
                form = form + plain(other) * factor
            return form

        def plain(name: str) -> Any:
            if name in self.fixed:
                return kind.constant(basis, self.fixed[name])
            index = box.names.index(name)
            low, high = box.lower[index], box.upper[index]
            middle = 0.5 * (low + high)
            half = max(high - middle, middle - low) * HALF_UP
            return kind.parameter(basis, index, middle, half)

        def turned(axis: Float64Array, angle: Any) -> Any:
            k = _cross_matrix(np.asarray(axis, np.float64))
            cosine, sine = trigonometry(angle)
            return sine * array(k) + (1.0 - cosine) * array(k @ k) + array(np.eye(3))

        first, start, axis, angle, displacement = self._base
        rotation = kind.constant(basis, first)
        position = kind.constant(basis, start)
        if self.target_camera is not None:
            rotation = rotation @ turned(axis, parameter("segment") * angle)
            position = position + parameter("segment") * array(displacement)
        orbit = self.perturbation.orbit
        if orbit is not None:
            turn = turned(np.array(orbit.axis) / np.linalg.norm(orbit.axis), parameter("azimuth"))
            target = array(np.array(orbit.target))
            rotation, position = turn @ rotation, turn @ (position - target) + target
        moving = [name for name in TRANSLATIONS if name in box.names or self.fixed[name] != 0.0]
        for name in moving:
            shift = parameter(name)
            k = TRANSLATIONS.index(name)
            if self.perturbation.frame == "camera":
                position = position + rotation[:, k] * shift
            else:
                position = position + shift * array(np.eye(3)[k])
        for name in ROTATIONS:
            if name in box.names or self.fixed[name] != 0.0:
                rotation = rotation @ turned(np.array(_CAMERA_AXES[name]), parameter(name))
        for k, name in enumerate(SCENE_TURNS):
            if name in box.names:
                turn = turned(np.eye(3)[k], parameter(name) * -1.0)
                rotation, position = turn @ rotation, turn @ position
        for k, name in enumerate(SCENE_SHIFTS):
            if name in box.names:
                position = position - parameter(name) * array(np.eye(3)[k])
        return rotation, position

    def world_to_camera(self, values: Float64Array, beyond: bool = False) -> tuple[Float64Array, Float64Array]:
        """Return the rotation [3, 3] (OpenCV axes) and camera position [3] at parameter values [d]; see `pose`."""
        pose = self.pose(values, beyond)
        return np.ascontiguousarray(pose[:, :3].T * _FLIP[:, None]), pose[:, 3].copy()


def translation_only(forms: PoseForms) -> bool:
    """Whether the camera's viewing direction is the same for every pose, up to rounding: the depth order is fixed."""
    row = forms.rotation[2]
    return bool(np.all(row.linear == 0.0) and np.all(row.radius < STILL_ROOM))
