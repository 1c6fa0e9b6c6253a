"""Describe a set of poses on a scene in units, distances and pixels, before any work is done."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ns_abstract.api.files import PathJob
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.report.figures import ShownUnits, frames_listed, number

#: Parts of the visible scene elements that are nearer than the depths that are told.
_QUANTILES = {"near": 0.05, "middle": 0.5, "far": 0.95}
#: Frames told one by one.
_MOST_FRAMES = 10
_METRES = "if a unit of the data set is a metre"


def describe(job: PathJob, frames: Sequence[int]) -> list[str]:
    """Return lines of text about the scene, its units, and the cameras and sets of some frames."""
    return [*_scene(job), "", *_cameras(job, frames), "", *_sets(job, frames)]


def _scene(job: PathJob) -> Iterator[str]:
    method, scale = job.method, job.method.dataset_scale
    program = method.program
    yield f"scene      {method.name}: {method.content}, {program['name']} {program['version']}"
    yield "frame      the run's normalised frame; cameras look along -z, x is right, y is up (OpenGL)"
    if scale is None:
        yield "scale      the scene does not say the units of a data set"
    else:
        unit = "normalised unit" if scale == 1.0 else "normalised units"
        yield f"scale      1 unit of the data set (transforms.json) = {number(scale)} {unit}"
        yield f"           1 cm = {number(0.01 * scale)} normalised units, {_METRES}"
    yield f"           1 degree = {number(math.radians(1.0), 6)} rad"


def _cameras(job: PathJob, frames: Sequence[int]) -> Iterator[str]:
    camera = job.pose_sets[frames[0]].camera
    size = f"{camera.width} x {camera.height} pixels"
    across, down = (2.0 * math.degrees(math.atan2(0.5 * n, f)) for n, f in (
        (camera.width, camera.fx), (camera.height, camera.fy)))  # fmt: skip
    yield f"cameras    {len(frames)} of {job.frame_count}, {size}, {number(across)} x {number(down)} degrees"
    for index in frames[:_MOST_FRAMES]:
        poses = job.pose_sets[index]
        pose = poses.pose(poses.box.middle)
        yield f"  frame {index}: at {_vector(pose[:, 3])}, looking along {_vector(-pose[:, 2])}"
        depths = job.frame(index).depths()
        if depths is None or not depths.size:
            yield "    what it shows has no distance of its own" if depths is None else "    nothing is in the picture"
            continue
        depth_quantiles = {name: float(np.quantile(depths, part)) for name, part in _QUANTILES.items()}
        scale = job.method.dataset_scale
        text = ", ".join(
            f"{name} {number(z)}" + ("" if scale is None else f" ({number(z / scale)})")
            for name, z in depth_quantiles.items()
        )
        yield f"    depth in normalised units{'' if scale is None else ' (of the data set)'}: {text}"
        yield (
            f"    at the middle depth, a shift by 0.01 normalised units moves the picture by "
            f"{number(0.01 * poses.camera.fx / depth_quantiles['middle'], 3)} pixels; 1 degree of yaw by "
            f"{number(poses.camera.fx * math.tan(math.radians(1.0)), 3)}"
        )
    if len(frames) > _MOST_FRAMES:
        yield f"  and {len(frames) - _MOST_FRAMES} more"


def _sets(job: PathJob, frames: Sequence[int]) -> Iterator[str]:
    """Return ranges of the frames' sets, the image motion of each parameter, and doubts about the units."""
    units = ShownUnits.of(job.describe())
    frames_by_text: dict[tuple[str, ...], list[int]] = {}
    for index in frames:
        frames_by_text.setdefault(tuple(_ranges(job.pose_sets[index], units)), []).append(index)
    for lines, indices in frames_by_text.items():
        yield f"set        of {'every frame' if len(indices) == len(frames) > 1 else frames_listed(indices)}:"
        if not lines:
            yield "  one camera pose"
        yield from (f"  {line}" for line in lines)
        index = indices[0]
        box, moved = job.pose_sets[index].box, job.frame(index).motion(job.pose_sets[index].box)
        for name, pixels in zip(box.names, moved, strict=True):
            yield f"  {name} moves what frame {index} shows by {number(float(pixels), 3)} pixels over its range"
    yield from (f"  is this what you mean? {note}" for note in job.warnings)


def _ranges(poses: PoseBox, units: ShownUnits) -> Iterator[str]:
    box = poses.box
    for side in zip(box.names, box.units, box.lower, box.upper, strict=True):
        yield units.interval(*side)
    for name, value in poses.fixed.items():
        if value:
            yield f"{name} = {number(value)}, fixed"
    if count := len(poses.perturbation.scene):
        yield f"{count} variation{'s' if count > 1 else ''} of the scene"


def _vector(values: np.ndarray) -> str:
    return f"({', '.join(number(float(v), 3) for v in values)})"
