"""Pinhole cameras, and camera paths as Nerfstudio's viewer writes them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.camera_files import FileCamera, inria_cameras, is_inria, transforms_cameras
from ns_abstract.geometry.path_keys import ENTRY, KEYFRAME, PATH
from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.arguments import file_path, whole
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import InputTuning, is_moderate, is_number, load_json, parse_json, show, unusable
from ns_abstract.io.keys import sentence

SIDE_LIMIT = 16384
_FIX_FILE = "give the camera path that Nerfstudio's viewer saved"


class Intrinsics(NamedTuple):
    """Camera intrinsics for kernels: focal lengths, principal point and picture size, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: float
    height: float


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """A pinhole camera.

    Attributes:
        camera_to_world: [3, 4] float64, read-only, OpenGL axes (x right, y up, z back), in the normalised frame of the
            run. The rotation is kept as written: it is orthonormal within 1e-3.
        fx, fy: Focal lengths, pixels.
        cx, cy: Principal point from the left and the top edge, pixels.
        width, height: Image size, pixels.
    """

    camera_to_world: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera without its pose."""
        return Intrinsics(self.fx, self.fy, self.cx, self.cy, float(self.width), float(self.height))

    def rescaled(self, downscale_factor: float) -> PinholeCamera:
        """Return the camera of an image ``downscale_factor`` times smaller; sides are rounded down.

        Uses the arithmetic of nerfstudio's ``Cameras.rescale_output_resolution``, which holds the factor and the
        principal point in float32, so that sizes agree with ns-render. Raises InputError where the factor is not a
        positive finite number, or a side leaves 1..16384.
        """
        field = "--downscale-factor"
        if not is_number(downscale_factor) or not downscale_factor > 0:
            raise unusable(downscale_factor, field=field, fix="give a number above 0")
        if downscale_factor == 1:
            return self
        with np.errstate(over="ignore", under="ignore"):
            scale = np.float32(1.0 / float(downscale_factor))
            sides = [float(np.float32(side) * scale) for side in (self.width, self.height)]
        if not all(1 <= side < SIDE_LIMIT + 1 for side in sides):
            raise InputError(
                f"factor {show(downscale_factor)} turns {self.width}x{self.height} pixels into an image"
                f" outside 1..{SIDE_LIMIT}",
                field=field,
                fix=f"give a factor from {max(self.width, self.height) / SIDE_LIMIT:.3g}"
                f" to {min(self.width, self.height)}",
            )
        return replace(
            self,
            fx=self.fx * float(scale),
            fy=self.fy * float(scale),
            cx=float(np.float32(self.cx) * scale),
            cy=float(np.float32(self.cy) * scale),
            width=int(sides[0]),
            height=int(sides[1]),
        )

    def resized(self, height: int, width: int) -> PinholeCamera:
        """Return the camera that shows the same picture with other pixels, as if it had been resized.

        Each direction has its own factor, so another aspect ratio squeezes the picture.
        """
        down, across = height / self.height, width / self.width
        stretched = self.fx * across, self.fy * down, self.cx * across, self.cy * down
        return PinholeCamera(self.camera_to_world, *stretched, width, height)


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The cameras of a path and the perturbations written beside them.

    Attributes:
        perturbation: Top-level ``perturbation`` object as parsed from JSON, or None.
        overrides: Per camera, the entry's own ``perturbation`` object, or None.
        fps: Frames per second, or None if the file does not say.
        is_cycle: Whether the path closes.
        source: The file.
        notes: Sentences on unknown keys and on cameras that ns-render draws otherwise.
    """

    cameras: tuple[PinholeCamera, ...]
    perturbation: Mapping[str, Any] | None
    overrides: tuple[Mapping[str, Any] | None, ...]
    fps: float | None
    is_cycle: bool
    source: str
    notes: tuple[str, ...] = ()

    def perturbation_of(self, index: int) -> Mapping[str, Any] | None:
        """Return the perturbation object that holds for camera ``index``: its own, else the path's."""
        own = self.overrides[self._place(index)]
        return self.perturbation if own is None else own

    def _place(self, index: int) -> int:
        """Return ``index`` as a number from 0; a negative one counts from the end. Raises InputError: out of range."""
        count = len(self.cameras)
        number = whole(index, -count, "index", count - 1)
        return number + count if number < 0 else number

    @property
    def perturbations(self) -> tuple[Mapping[str, Any] | None, ...]:
        """The perturbation object of every camera, for `ns_abstract.PoseSet.from_json`."""
        return tuple(self.perturbation_of(k) for k in range(len(self.cameras)))

    def following(self, index: int) -> PinholeCamera | None:
        """Return the camera after ``index``; after the last one the first if the path closes, else None."""
        index = self._place(index)
        if index + 1 < len(self.cameras):
            return self.cameras[index + 1]
        return self.cameras[0] if self.is_cycle and len(self.cameras) > 1 else None


def load_camera_path(
    path: str | os.PathLike[str], downscale_factor: float = 1, run_frame: DataparserTransform | None = None
) -> CameraPath:
    """Read the JSON that Nerfstudio's viewer writes, Inria's ``cameras.json`` or a data set's ``transforms.json``.

    In the viewer's paths, focal lengths are ``(height / 2) / tan(fov / 2)`` in both directions (fov is vertical) and
    the principal point is the image centre, as in ``nerfstudio.cameras.camera_paths``, unless an entry has fx, fy, cx
    or cy.

    Args:
        path: The file.
        downscale_factor: Images become this many times smaller.
        run_frame: From the data set's frame to the run's; without it a ``transforms.json`` is refused.
    """
    path = file_path(path, "path")
    root = load_json(path, "camera path")
    try:
        if is_inria(root):
            return _photo_path(inria_cameras(root), str(path), downscale_factor)
        if isinstance(root, dict) and "camera_path" not in root and "frames" in root:
            return _photo_path(transforms_cameras(root, run_frame, path.parent), str(path), downscale_factor)
        _refuse_others(root)
        return _parse(root, str(path), downscale_factor)
    except InputError as error:
        raise error.within(path) from None


def _photo_path(file_cameras: Iterable[FileCamera], source: str, downscale_factor: float) -> CameraPath:
    """Return the path of the cameras of photos, without perturbations; ``source``: the file. Raises InputError."""
    cameras = []
    for entry in file_cameras:
        camera = PinholeCamera(
            camera_to_world=checked_pose([*entry.camera_to_world, [0, 0, 0, 1]], entry.field),
            fx=focal_pixels(entry.fx, f"{entry.field}: focal length"),
            fy=focal_pixels(entry.fy, f"{entry.field}: focal length"),
            cx=entry.cx,
            cy=entry.cy,
            width=checked_side(entry.width, f"{entry.field}: width"),
            height=checked_side(entry.height, f"{entry.field}: height"),
        )
        cameras.append(camera.rescaled(downscale_factor))
    return CameraPath(tuple(cameras), None, (None,) * len(cameras), None, False, source)


def focal_pixels(value: Any, field: str) -> float:
    """Return ``value`` as a focal length in pixels. Raises InputError where it is no moderate number above 0."""
    if not is_moderate(value) or not value > 0:
        raise unusable(value, field=field, fix="write a number of pixels above 0")
    return float(value)


def principal_place(value: Any, side: int, field: str) -> float:
    """Return ``value`` as a coordinate of the principal point, pixels; half of ``side`` if None. Raises InputError."""
    if value is not None and not is_moderate(value):
        raise unusable(value, field=field, fix="write a number of pixels")
    return side / 2 if value is None else float(value)


def stated_intrinsics(
    own: Mapping[str, Any], focal: Callable[[], float], height: int, width: int, prefix: str = ""
) -> Intrinsics:
    """Return intrinsics in pixels as a file or a caller states them.

    Raises InputError: one of them is no moderate number, or a focal length is not above 0.

    Args:
        own: ``fx``, ``fy``, ``cx``, ``cy``. None or missing: ``focal()`` for fx, fx for fy, the middle for cx and cy.
        focal: The focal length where ``fx`` is not stated.
        height, width: Size of the pictures, pixels.
    """
    fx, fy = own.get("fx"), own.get("fy")
    across = focal() if fx is None else focal_pixels(fx, f"{prefix}fx")
    return Intrinsics(
        across,
        across if fy is None else focal_pixels(fy, f"{prefix}fy"),
        principal_place(own.get("cx"), width, f"{prefix}cx"),
        principal_place(own.get("cy"), height, f"{prefix}cy"),
        width,
        height,
    )


def _parse(root: dict[str, Any], source: str, downscale_factor: float) -> CameraPath:
    unknown = PATH.unknown(root)
    height = checked_side(root.get("render_height"), "render_height")
    width = checked_side(root.get("render_width"), "render_width")
    cameras = []
    overrides = []
    others: list[str] = []
    for field, entry in _entries(root, unknown):
        own = {key: root.get(key) if entry.get(key) is None else entry[key] for key in ("fx", "fy", "cx", "cy")}
        focal = partial(_focal, entry, root, field, height)
        lens = stated_intrinsics(own, focal, height, width, f"{field}.")
        if not np.allclose(lens, _lens_of_fov(entry, lens), rtol=InputTuning.lens, atol=0.0):
            others.append(field)
        pose = checked_pose(entry.get("camera_to_world"), f"{field}.camera_to_world")
        camera = PinholeCamera(pose, *lens[:4], width=width, height=height)
        cameras.append(camera.rescaled(downscale_factor))
        overrides.append(_perturbation(entry, f"{field}.perturbation"))
    fps = root.get("fps")
    if fps is not None and (not is_number(fps) or not fps > 0):
        raise unusable(fps, field="fps", fix="write a number above 0")
    is_cycle = root.get("is_cycle")
    if is_cycle is not None and not isinstance(is_cycle, bool):
        raise unusable(is_cycle, field="is_cycle", fix="write true or false")
    return CameraPath(
        cameras=tuple(cameras),
        perturbation=_perturbation(root, "perturbation"),
        overrides=tuple(overrides),
        fps=None if fps is None else float(fps),
        is_cycle=bool(is_cycle),
        source=source,
        notes=(*sentence(unknown, Path(source).name), *_other_lenses(others)),
    )


def _lens_of_fov(entry: Mapping[str, Any], lens: Intrinsics) -> Intrinsics:
    """Return intrinsics with which ns-render draws an ``entry``, from ``fov`` alone; ``lens`` without a usable one."""
    fov = entry.get("fov")
    if not is_number(fov) or not 0 < fov < 180:
        return lens
    focal, (width, height) = focal_length(fov, int(lens.height), "fov"), lens[4:]
    return Intrinsics(focal, focal, width / 2, height / 2, width, height)


def _other_lenses(fields: Sequence[str]) -> tuple[str, ...]:
    """Return the note that ns-render draws the entries ``fields`` with other intrinsics; no note without entries."""
    if not fields:
        return ()
    count = f" and {len(fields) - 1} more" if len(fields) > 1 else ""
    return (f"{fields[0]}{count}: fx, fy, cx and cy are taken; ns-render takes fov and the middle, another picture",)


#: Other kinds of files of Nerfstudio and of this program, by a key that camera paths lack: kind and advice.
_OTHERS: dict[str, tuple[str, str]] = {
    "transform": ("a run's dataparser_transforms.json, not a camera path", _FIX_FILE),
    "dynamics": ("a loop, not a camera path", "give it to ns-abstract-reach as --loop"),
    **dict.fromkeys(
        ("translation", "rotation", "sweep", "orbit"),
        ("a perturbation file, not a camera path", "give it as --perturbation-filename, beside a camera path"),
    ),
}


def _refuse_others(root: Any) -> None:
    """Raise InputError that names the kind of a parsed file which is no camera path."""
    if isinstance(root, list) and root and all(isinstance(e, dict) and "transform" in e for e in root):
        raise InputError("poses of photos as ns-export cameras writes them, not a camera path", fix=_FIX_FILE)
    if not isinstance(root, dict):
        raise InputError(f"the top level is {show(root)}, not an object", fix=_FIX_FILE)
    if "camera_path" not in root:
        for key, (kind, fix) in _OTHERS.items():
            if key in root:
                raise InputError(f"is {kind}", fix=fix)


def _entries(root: dict[str, Any], unknown: list[str]) -> list[tuple[str, dict[str, Any]]]:
    """Return the field names and entries of a path's cameras; appends names of unknown keys to ``unknown``.

    If "camera_path" is empty and there is one keyframe, this is the camera: the viewer writes none then.
    """
    fields_by_name: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for name, table in (("camera_path", ENTRY), ("keyframes", KEYFRAME)):
        entries = root.get(name)
        if entries is None and name == "keyframes":
            entries = []
        if not isinstance(entries, list):
            problem = "missing" if entries is None else f"found {show(entries)}"
            raise InputError(problem, field=name, fix="write a list of cameras")
        fields_by_name[name] = []
        for i, entry in enumerate(entries):
            field = f"{name}[{i}]"
            if not isinstance(entry, dict):
                raise unusable(entry, field=field, fix="write an object")
            unknown += [f"{name}[].{key}" for key in table.unknown(entry, f"{field}.")]
            fields_by_name[name].append((field, entry))
    if fields_by_name["camera_path"]:
        return fields_by_name["camera_path"]
    if len(fields_by_name["keyframes"]) != 1:
        count = len(fields_by_name["keyframes"])
        raise InputError(
            f"the list is empty, and there are {count} keyframes: the viewer wrote no camera" if count else "empty",
            field="camera_path",
            fix="save the path again with a duration and a frame rate above 0"
            if count
            else "write a list of at least one camera",
        )
    field, keyframe = fields_by_name["keyframes"][0]
    matrix = _keyframe_matrix(keyframe.get("matrix"), f"{field}.matrix")
    return [(field, {**keyframe, "camera_to_world": matrix})]


def _keyframe_matrix(value: Any, field: str) -> Any:
    """Return the numbers of a keyframe's matrix, row by row.

    Nerfstudio's viewer writes a list of rows; the one before 1.0 and the Blender add-on write a text with the list of
    three.js, which is column by column.
    """
    if not isinstance(value, str):
        return value
    try:
        numbers = parse_json(value)
    except InputError as error:
        raise InputError(error.problem, field=field, fix="write 16 numbers, row by row") from None
    if not isinstance(numbers, list) or len(numbers) != 16:
        return numbers
    rows = numbers[12:] == [0, 0, 0, 1] and numbers[3::4] != [0, 0, 0, 1]
    return numbers if rows else [numbers[4 * i + k] for k in range(4) for i in range(4)]


def checked_side(value: Any, name: str) -> int:
    """Return a number of pixels from field ``name``. Raises InputError outside of 1 to `SIDE_LIMIT`."""
    # The viewer may write 1080.0.
    if not is_number(value) or value != math.floor(value) or not 1 <= value <= SIDE_LIMIT:
        problem = "missing" if value is None else f"found {show(value)}"
        raise InputError(problem, field=name, fix=f"write an integer from 1 to {SIDE_LIMIT}")
    return int(value)


def _focal(entry: dict[str, Any], root: dict[str, Any], field: str, height: int) -> float:
    """Return the focal length in pixels from the entry's vertical field of view, or from the path's default."""
    field = f"{field}.fov"
    fov = entry.get("fov")
    if "fov" in entry and fov is None and field.startswith("camera_path"):
        # Nerfstudio takes a focal length of 50 pixels for null, whatever default_fov says
        raise unusable(None, field=field, fix="write degrees, or fx in pixels: Nerfstudio draws null with fx = 50")
    if fov is None:
        fov = root.get("default_fov")
        if fov is None:
            raise InputError("missing, and there is no default_fov", field=field, fix="write degrees")
        field = "default_fov"
    return focal_length(fov, height, field)


def focal_length(fov: Any, height: int, field: str) -> float:
    """Return the focal length in pixels of a vertical field of view in degrees, from the field ``field``.

    Raises InputError: it is no angle above 0 and below 180 degrees with a float32 focal length.
    """
    if not is_number(fov) or not 0 < fov < 180:
        raise unusable(fov, field=field, fix="write degrees above 0 and below 180")
    # The expression of nerfstudio's three_js_perspective_camera_focal_length, for equal bits.
    with np.errstate(all="ignore"):
        focal = float((height / 2.0) / np.tan(float(fov) * (np.pi / 180.0) / 2.0))
        usable = 0 < np.float32(focal) < np.inf
    if not usable:
        problem = f"found {show(fov)}: no float32 focal length"
        raise InputError(problem, field=field, fix="write a larger angle")
    return focal


def checked_pose(value: Any, field: str) -> NDArray[np.float64]:
    """Return a camera-to-world pose [3, 4] float64 from 16 numbers in rows, flat or nested, from the field ``field``.

    Raises InputError: it is no rigid, right-handed pose of numbers that float32 can hold.
    """
    if isinstance(value, list) and len(value) == 4 and all(isinstance(row, list) for row in value):
        for i, row in enumerate(value):
            if len(row) != 4:
                raise InputError(f"{len(row)} numbers", field=f"{field}[{i}]", fix="write four numbers")
        value = [number for row in value for number in row]
    if not isinstance(value, list) or len(value) != 16:
        description = "missing" if value is None else f"found {show(value)}"
        raise InputError(description, field=field, fix="write 16 numbers, row by row")
    limit = float(np.finfo(np.float32).max)
    for i, number in enumerate(value):
        if not is_number(number) or abs(number) > limit:
            raise unusable(number, field=f"{field}[{i}]", fix="write a number that float32 can hold")
    matrix = np.array(value, np.float64).reshape(4, 4)
    rotation = matrix[:3, :3]
    _refuse_scaled(matrix, field)
    with np.errstate(over="ignore", invalid="ignore"):
        distance = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if not distance <= InputTuning.rotation:
        with np.errstate(all="ignore"):
            scale = float(np.cbrt(np.linalg.det(rotation)))
            whole = scale > 0 and np.abs(rotation.T @ rotation / scale**2 - np.eye(3)).max() <= InputTuning.rotation
        fix = f"divide its nine numbers by {scale:.6g}" if whole else "remove scale and shear from the matrix"
        problem = f"the rotation part is {distance:.3g} away from orthonormal (limit {InputTuning.rotation:g})"
        raise InputError(problem, field=field, fix=fix)
    if np.linalg.det(rotation) < 0:
        raise InputError(
            "the rotation part mirrors (determinant -1)", field=field, fix="use a right-handed OpenGL frame"
        )
    pose = matrix[:3].copy()
    pose.flags.writeable = False
    return pose


def _refuse_scaled(matrix: NDArray[np.float64], field: str) -> None:
    """Refuse a matrix [4, 4] whose last row is not (0, 0, 0, 1); Nerfstudio does not read that row."""
    row = matrix[3]
    if np.abs(row - (0, 0, 0, 1)).max() <= InputTuning.last_row:
        return
    problem = f"the last row is ({', '.join(f'{x:.6g}' for x in row)}), not (0, 0, 0, 1)"
    scale = float(row[3])
    if not row[:3].any() and scale != 0.0:
        with np.errstate(all="ignore"):
            square = matrix[:3, :3].T @ matrix[:3, :3]
            whole = np.abs(square / scale**2 - np.eye(3)).max() <= InputTuning.rotation
        fix = (
            f"divide all 16 numbers by {scale:.6g}" if whole else "write 1 at its end; the rotation is not scaled by it"
        )
        raise InputError(f"a scaled matrix: {problem}", field=field, fix=fix)
    raise InputError(problem, field=field, fix="write the matrix row by row, the position in the fourth column")


def _perturbation(holder: dict[str, Any], field: str) -> Mapping[str, Any] | None:
    value = holder.get("perturbation")
    if value is not None and not isinstance(value, dict):
        raise unusable(value, field=field, fix="write an object")
    return value
