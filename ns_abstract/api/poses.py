"""Cameras and sets of poses, as the Python interface takes them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ns_abstract.api.scenes import Scene, checked_scene, not_a_camera
from ns_abstract.geometry import poses
from ns_abstract.geometry.camera_path import PinholeCamera, checked_pose, checked_side, focal_length, stated_intrinsics
from ns_abstract.io.arguments import array_of, file_path, plain, positive
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import unusable
from ns_abstract.perturbation.specification import Perturbation, parse_perturbation

Limit = float | Sequence[float]
#: Nothing is said of the next keyframe.
_UNSAID: Any = object()


class Camera(PinholeCamera):
    """A camera; by default one with square pixels that looks at the middle of its picture.

    Args:
        camera_to_world: [4, 4] or [3, 4], OpenGL axes (x right, y up, z back), in the normalised frame of the run.
        fov: Vertical field of view, degrees.
        width: Pixels.
        height: Pixels.
        fx: Focal length, pixels, in place of ``fov``.
        fy: The same along the other axis; None: ``fx``.
        cx: Principal point from the left edge, pixels; None: the middle.
        cy: Principal point from the top edge, pixels; None: the middle.

    Raises:
        InputError: A value cannot be used.
    """

    def __init__(
        self,
        camera_to_world: ArrayLike,
        fov: float = 45.0,
        width: int = 100,
        height: int = 100,
        *,
        fx: float | None = None,
        fy: float | None = None,
        cx: float | None = None,
        cy: float | None = None,
    ) -> None:
        matrix = array_of(camera_to_world, np.float64)
        if matrix is None:
            raise unusable(camera_to_world, field="camera_to_world", fix="give a 4x4 or 3x4 matrix of numbers")
        if matrix.shape == (3, 4):
            matrix = np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])
        if matrix.shape != (4, 4):
            problem = f"found an array of shape {matrix.shape}"
            raise InputError(problem, field="camera_to_world", fix="give a 4x4 or 3x4 matrix of numbers")
        pose = checked_pose(matrix.tolist(), "camera_to_world")
        across, down = checked_side(width, "width"), checked_side(height, "height")
        own = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
        lens = stated_intrinsics(own, lambda: focal_length(fov, down, "fov"), down, across)
        super().__init__(pose, *lens[:4], across, down)


@dataclass(frozen=True, init=False, eq=False)
class PoseSet:
    """A camera and what may vary around it.

    Args:
        camera: The camera; the first keyframe of a segment.
        translation: Ranges of x, y and z by name: a number r for [-r, r], or (low, high).
        rotation: Ranges of yaw, pitch and roll, likewise.
        frame: Axes of the translation: "camera" (x right, y up, z back) or "world".
        units: Of the translation: "normalised" (the run's frame) or "dataset" (those of transforms.json).
        angle_units: Of the rotation and the orbit's azimuth: "radians" or "degrees".
        orbit: ``{"target": [x, y, z], "axis": [x, y, z], "azimuth": (low, high)}``.
        following: The next keyframe: the pose also moves continuously from ``camera`` to it.

    Attributes:
        camera: The camera.
        specification: All of it as the object of a perturbation file.
        following: The next keyframe, or None.
        folder: Where the specification's index files lie, or None.

    Raises:
        InputError: A key is unknown, an interval is reversed or a number is not finite.
    """

    camera: PinholeCamera
    specification: Mapping[str, Any]
    following: PinholeCamera | None
    folder: Path | None

    def __init__(
        self,
        camera: PinholeCamera,
        translation: Mapping[str, Limit] | None = None,
        rotation: Mapping[str, Limit] | None = None,
        frame: str = "camera",
        *,
        units: str = "normalised",
        angle_units: str = "radians",
        orbit: Mapping[str, Any] | None = None,
        following: PinholeCamera | None = None,
    ) -> None:
        value: dict[str, Any] = {
            "version": 1,
            "frame": plain(frame),
            "units": plain(units),
            "angle_units": plain(angle_units),
            "translation": {} if translation is None else plain(translation),
            "rotation": {} if rotation is None else plain(rotation),
        }
        if orbit is not None:
            value["orbit"] = plain(orbit)
        if following is not None:
            value["sweep"] = "segments"
        self._fill(camera, value, following, None)

    @classmethod
    def from_json(
        cls,
        camera: PinholeCamera,
        specification: Mapping[str, Any] | None,
        *,
        following: PinholeCamera | None = _UNSAID,
        folder: str | os.PathLike[str] | None = None,
    ) -> PoseSet:
        """Return the set of an object as it stands in a perturbation file; all that the file can say.

        Args:
            specification: The object; None: the camera's pose alone.
            following: The next keyframe, which ``"sweep": "segments"`` needs: ``path.following(k)`` of
                `load_camera_path`; None after the last entry of an open path.
            folder: Where index files of a selection lie; None: the working directory.

        Raises:
            InputError: The object cannot be used.
        """
        self = cls.__new__(cls)
        unsaid = following is _UNSAID
        self._fill(camera, {} if specification is None else specification, None if unsaid else following, folder)
        if unsaid and self.perturbation().sweep == "segments":
            raise InputError(
                "segments without the next keyframe",
                field="sweep",
                fix="give following=path.following(k), which is None after the last entry of an open path",
            )
        return self

    def _fill(
        self,
        camera: PinholeCamera,
        value: Mapping[str, Any],
        following: PinholeCamera | None,
        folder: str | os.PathLike[str] | None,
    ) -> None:
        if not isinstance(camera, PinholeCamera):
            raise not_a_camera(camera)
        if following is not None and not isinstance(following, PinholeCamera):
            raise not_a_camera(following, "following")
        specification = {
            "camera": camera,
            "specification": dict(value) if isinstance(value, Mapping) else value,
            "following": following,
            "folder": None if folder is None else file_path(folder, "folder"),
        }
        for name, entry in specification.items():
            object.__setattr__(self, name, entry)
        # what is wrong is told where it is written
        self.perturbation()

    def perturbation(self, dataset_scale: float | None = 1.0) -> Perturbation:
        """Return the perturbation that this set states, in normalised units.

        Args:
            dataset_scale: Normalised units per unit of the data set; None: not known.

        Raises:
            InputError: The set is stated in units of the data set, and the scale is not known or no positive number.
        """
        scale = None if dataset_scale is None else positive(dataset_scale, "dataset_scale")
        return parse_perturbation(self.specification, dataset_scale=scale, field_prefix="", folder=self.folder)

    def of(self, scene: Scene) -> poses.PoseBox:
        """Return this set as a `PoseBox` of a scene, in whose units it may be stated.

        Raises:
            InputError: The set cannot be made.
        """
        return poses.PoseBox.around(
            self.camera, self.perturbation(checked_scene(scene).method().dataset_scale), self.following
        )

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of what varies, in the order of cells; scene variations are not among them."""
        return poses.PoseBox.around(self.camera, self.perturbation(), self.following).box.names


def pose_set(value: PoseSet | PinholeCamera, field: str = "poses") -> PoseSet:
    """Return ``value`` as a set of poses; a camera is the set of its one pose. Raises InputError for other objects."""
    if isinstance(value, PinholeCamera):
        return PoseSet(value)
    if not isinstance(value, PoseSet):
        fix = "give an ns_abstract.PoseSet, or a camera for its one pose"
        raise InputError(f"found {type(value).__name__}", field=field, fix=fix)
    return value


def pose_sets(value: PoseSet | PinholeCamera | Sequence[PoseSet | PinholeCamera]) -> list[PoseSet]:
    """Return ``value`` as at least one set of poses; see `pose_set`.

    Raises:
        InputError: It is no set and no list of sets.
    """
    if isinstance(value, PoseSet | PinholeCamera) or not isinstance(value, Sequence):
        return [pose_set(value)]
    if not value:
        raise InputError("found no set", field="poses", fix="give at least one PoseSet")
    return [pose_set(entry, f"poses[{k}]") for k, entry in enumerate(value)]
