"""Cameras of other programs' files: Inria's ``cameras.json`` and a data set's ``transforms.json``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.arithmetic.rounding import UNIT32
from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import InputTuning, is_number, show, unusable

#: OpenCV axes (x right, y down, z forward) as OpenGL axes (x right, y up, z back).
_OPENGL = np.diag([1.0, -1.0, -1.0])
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
#: Nerfstudio's applied_transform of a data set that states none and has this folder beside it.
_COLMAP_FOLDER, _COLMAP_APPLIED = "colmap/sparse/0", [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
#: Number of float32 roundings of a camera's position in Nerfstudio.
_FLOAT32_ROUNDINGS = 12
_INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")


@dataclass(frozen=True)
class FileCamera:
    """A camera as read from a file: ``camera_to_world`` 3x4 numbers, OpenGL axes, and intrinsics in pixels.

    They are finite numbers; ``width`` and ``height`` of transforms.json are not checked. ``field``: for messages.
    """

    field: str
    camera_to_world: list[list[float]]
    fx: float
    fy: float
    cx: float
    cy: float
    width: Any
    height: Any


def is_inria(root: Any) -> bool:
    """Whether a parsed file is Inria's ``cameras.json``."""
    return isinstance(root, list) and bool(root) and all(isinstance(e, dict) and "rotation" in e for e in root)


def inria_cameras(root: list[dict[str, Any]]) -> Iterator[FileCamera]:
    """Return the cameras of Inria's ``cameras.json``, in the frame of its .ply."""
    for i, entry in enumerate(root):
        field = f"[{i}]"
        rotation = _matrix(entry.get("rotation"), 3, 3, f"{field}.rotation")
        position = _matrix([entry.get("position")], 1, 3, f"{field}.position")[0]
        width, height = entry.get("width"), entry.get("height")
        focal = [_number(entry.get(key), f"{field}.{key}") for key in ("fx", "fy")]
        sides = [_number(side, f"{field}.{key}") for key, side in (("width", width), ("height", height))]
        pose = np.column_stack([rotation @ _OPENGL, position])
        yield FileCamera(field, pose.tolist(), focal[0], focal[1], sides[0] / 2, sides[1] / 2, width, height)


def transforms_cameras(
    root: Mapping[str, Any], frame: DataparserTransform | None, folder: Path
) -> Iterator[FileCamera]:
    """Return the cameras of a data set's ``transforms.json``, in the frame of a run that was trained on it.

    As in Nerfstudio (nerfstudio_dataparser.py), values at the top level come before those of a frame. Raises
    InputError: there is no run, a camera is not a plain perspective one, or a field is missing.

    Args:
        root: The content of the file.
        frame: Transform from the data set's frame to the run's; None: the scene is no run.
        folder: The file's folder.
    """
    if frame is None:
        problem = "is a data set's transforms.json, and the scene is no run whose frame could be told from it"
        fix = (
            "give the config.yml of a run trained on it, beside its dataparser_transforms.json and with Nerfstudio's "
            "or COLMAP's data parser and another orientation_method than pca, or make a camera path"
        )
        raise InputError(problem, fix=fix)
    frames = root.get("frames")
    if not isinstance(frames, list) or not frames:
        raise unusable(frames, field="frames", fix="write a list of at least one camera")
    if root.get("orientation_override") == "pca":
        problem = "Nerfstudio may turn the transform that it stores of such a run, and not the cameras"
        raise InputError(problem, field="orientation_override", fix="make a camera path in Nerfstudio's viewer")
    if frame.original and root.get("applied_transform") is None:
        problem = "missing: the run was trained on COLMAP's model, and nothing says how these poses differ from it"
        raise InputError(
            problem, field="applied_transform", fix="give a file of ns-process-data, or make a camera path"
        )
    # the run's frame is that of the poses here after what was applied to them is undone
    applied, stated = np.eye(4), root.get("applied_transform")
    if "applied_transform" not in root and (folder / _COLMAP_FOLDER).exists():
        stated = _COLMAP_APPLIED
    if "applied_transform" in root or stated is not None:
        applied[:3] = _matrix(stated, 3, 4, "applied_transform")
    if not abs(np.linalg.det(applied)) > InputTuning.nothing:
        raise InputError("a matrix that cannot be inverted", field="applied_transform", fix="write a rotation")
    applied_scale = _number(root.get("applied_scale", 1.0), "applied_scale")
    if not applied_scale > 0:
        raise unusable(applied_scale, field="applied_scale", fix="write a number above 0")
    undone = DataparserTransform(frame.matrix @ np.linalg.inv(applied), frame.scale / applied_scale)
    _refuse_distorted(root, "")
    for i, entry in enumerate(frames):
        field = f"frames[{i}]"
        if not isinstance(entry, dict):
            raise unusable(entry, field=field, fix="write an object")
        _refuse_distorted(entry, f"{field}.")
        values = {**entry, **root}
        numbers = {key: _number(values.get(key), f"{field}.{key}") for key in _INTRINSICS if key not in ("fl_y",)}
        numbers["fl_y"] = _number(values.get("fl_y", numbers["fl_x"]), f"{field}.fl_y")
        pose = _matrix(entry.get("transform_matrix"), None, 4, f"{field}.transform_matrix")
        whole = np.vstack([pose[:3], [0.0, 0.0, 0.0, 1.0]])
        _refuse_far(undone, whole, f"{field}.transform_matrix")
        yield FileCamera(
            field, undone.pose(whole).tolist(), numbers["fl_x"], numbers["fl_y"], numbers["cx"], numbers["cy"],
            values.get("w"), values.get("h"),
        )  # fmt: skip


def _refuse_far(frame: DataparserTransform, pose: NDArray[np.float64], field: str) -> None:
    """Raise InputError for a ``pose`` [4, 4] so far from the run's origin that Nerfstudio's float32 moves it."""
    reach = frame.scale * float((np.abs(frame.matrix) @ np.abs(pose[:, 3])).max())
    # a rounding of the pose, of each product and sum, of the scale, and as many of a transform that holds another
    moved = _FLOAT32_ROUNDINGS * UNIT32 * reach
    if not moved <= InputTuning.placed:
        problem = f"so far from the run's origin that Nerfstudio, in float32, may move the camera by {moved:.2g} units"
        raise InputError(problem, field=field, fix="make a camera path in Nerfstudio's viewer")


def _refuse_distorted(section: Mapping[str, Any], prefix: str) -> None:
    """Raise InputError if ``section``, the file's top level or a frame, states a distorted or another lens."""
    model = section.get("camera_model", "PERSPECTIVE")
    if model not in _MODELS:
        problem = f"found {show(model)}: only perspective cameras are bounded"
        raise InputError(problem, field=f"{prefix}camera_model", fix="undistort the pictures and train on them")
    listed: Any = section.get("distortion_params", 0.0)
    for key, value in (*((key, section.get(key, 0.0)) for key in _DISTORTION), ("distortion_params", listed)):
        if any(part != 0 for part in (value if isinstance(value, list) else [value])):
            problem = (
                "the lens is distorted; Nerfstudio trains on an undistorted, cropped picture, whose camera differs"
            )
            raise InputError(problem, field=f"{prefix}{key}", fix="make a camera path in Nerfstudio's viewer")


def _matrix(value: Any, rows: int | None, columns: int, field: str) -> NDArray[np.float64]:
    good = isinstance(value, list) and (len(value) == rows if rows else len(value) in (3, 4))
    good = good and all(isinstance(row, list) and len(row) == columns and all(map(is_number, row)) for row in value)
    if not good:
        raise unusable(value, field=field, fix=f"write rows of {columns} finite numbers")
    return np.array(value, np.float64)


def _number(value: Any, field: str) -> float:
    if not is_number(value):
        problem = "missing" if value is None else f"found {show(value)}"
        raise InputError(problem, field=field, fix="write a finite number")
    return float(value)
