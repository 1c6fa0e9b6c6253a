"""Recordings for 3-D viewers: bounds along a path, its cameras and the scene, for Rerun and viser."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError
from ns_abstract.report.export import Results, picture
from ns_abstract.report.figures import metrics
from ns_abstract.report.files import IMAGES, LEAVES, frame_name, load_frame

#: Gaussians in a recording at most: those that are largest and most opaque.
_GAUSSIANS = 200_000
#: From OpenGL camera axes (x right, y up, z back) to those of Rerun and viser (y down, z forward).
_FLIP = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class RecordedScene:
    """The Gaussians of a scene, to be drawn.

    Attributes:
        means: [N, 3], normalised frame.
        axes: [N, 3, 3], columns are principal axes in standard deviations.
        colors: [N, 3] of band 0, in [0, 1].
        opacities: [N].
    """

    means: NDArray[np.float64]
    axes: NDArray[np.float64]
    colors: NDArray[np.float64]
    opacities: NDArray[np.float64]

    def drawn(self) -> RecordedScene:
        """Return the Gaussians to draw, at most `_GAUSSIANS`."""
        size = self.opacities * np.square(self.axes).sum(axis=(1, 2))
        best = np.sort(np.argsort(-size, kind="stable")[:_GAUSSIANS])
        return RecordedScene(self.means[best], self.axes[best], self.colors[best], self.opacities[best])


def write_rerun(results: Results, cameras: Sequence[PinholeCamera], scene: RecordedScene | None, file: Path) -> None:
    """Write a Rerun recording (.rrd).

    Its timeline "frame" shows the bounds, their gap and a render of every frame, and the figures of the report. With
    ``cameras``, those of the path by frame, pictures stand in the scene at their cameras. Raises InputError where the
    package rerun-sdk is missing.
    """
    rerun: Any = optional_package("rerun", "rerun", "rrd")
    recording = rerun.RecordingStream("ns-abstract")
    scratch = file.with_name(f".{file.name}.part")
    try:
        recording.save(str(scratch))
        recording.log("scene", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if scene is not None:
            scene = scene.drawn()
            radii = np.sqrt(np.square(scene.axes).sum(axis=1)).max(axis=1)
            colors = np.concatenate([scene.colors, scene.opacities[:, None]], axis=1)
            points = rerun.Points3D(scene.means, radii=radii, colors=np.round(255.0 * colors).astype(np.uint8))
            recording.log("scene/gaussians", points, static=True)
        for result in results:
            recording.set_time("frame", sequence=result.index)
            if cameras:
                camera = cameras[result.index]
                pose, scale = camera.camera_to_world, results.size[0] / camera.height
                recording.log(
                    "scene/camera",
                    rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3] @ _FLIP),
                    rerun.Pinhole(
                        focal_length=(scale * camera.fx, scale * camera.fy),
                        principal_point=(scale * camera.cx, scale * camera.cy),
                        width=results.size[1], height=results.size[0],
                    ),
                )  # fmt: skip
                recording.log("scene/camera/image", rerun.Image(picture(result, "image", results.largest)))
            for name in ("lower", "upper", "image"):
                recording.log(f"bounds/{name}", rerun.Image(getattr(result, name)))
            recording.log("bounds/gap", rerun.Image(picture(result, "gap", results.largest)))
            for name, value in metrics(result).items():
                if isinstance(value, (int, float)):
                    recording.log(f"figures/{name}", rerun.Scalars(float(value)))
        recording.flush()
        recording.disconnect()
        scratch.replace(file)
    finally:
        scratch.unlink(missing_ok=True)


def write_viser(
    results: Results, cameras: Sequence[PinholeCamera], scene: RecordedScene | None, file: Path, seconds: float
) -> None:
    """Write a recording of viser's (.viser) that shows every frame's gap at its camera, ``seconds`` long each.

    Raises:
        InputError: The package viser is missing.
    """
    viser: Any = optional_package("viser", "viser", "viser")
    with _server(viser) as server:
        record = _recorder(server)
        if scene is not None:
            scene = scene.drawn()
            covariances = scene.axes @ scene.axes.transpose(0, 2, 1)
            add = getattr(server.scene, "add_gaussian_splats", None) or server.scene._add_gaussian_splats
            add(
                "/scene", centers=scene.means.astype(np.float32), covariances=covariances.astype(np.float32),
                rgbs=scene.colors.astype(np.float32), opacities=scene.opacities[:, None].astype(np.float32),
            )  # fmt: skip
        frustum: Any = None
        for result in results:
            camera = cameras[result.index]
            former, rotation = frustum, camera.camera_to_world[:3, :3] @ _FLIP
            frustum = server.scene.add_camera_frustum(
                f"/frames/{result.index:05d}", fov=2.0 * float(np.arctan2(0.5 * camera.height, camera.fy)),
                aspect=camera.width / camera.height, scale=0.15, image=picture(result, "gap", results.largest),
                wxyz=viser.transforms.SO3.from_matrix(rotation).wxyz, position=camera.camera_to_world[:3, 3],
            )  # fmt: skip
            if former is not None:
                former.visible = False
            record.insert_sleep(seconds)
        content = record.serialize() if hasattr(record, "serialize") else record.end_and_serialize()
    write_atomic(file, lambda stream: stream.write(content))


def _recorder(server: Any) -> Any:
    """Return the recorder of either version of viser: public in 1.x, with an underscore in 0.2.7."""
    return server.get_scene_serializer() if hasattr(server, "get_scene_serializer") else server._start_scene_recording()


@contextmanager
def _server(viser: Any) -> Iterator[Any]:
    """Yield a viser server that listens on this machine alone; viser needs one for a recording."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        server.stop()


def optional_package(module: str, extra: str, command: str) -> ModuleType:
    """Return the imported ``module``, which the extra ``extra`` installs.

    Raises:
        InputError: It is missing; the error names the line for pip.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        fix = f"pip install 'ns-abstract[{extra}]'"
        raise InputError(f"needs the package {module.partition('.')[0]}", field=command, fix=fix) from None


def write_exr(results: Results, folder: Path) -> list[Path]:
    """Write ``frame_00000.exr`` for every frame, and return the files.

    Its parts ``lower``, ``upper``, ``witness_lower``, ``witness_upper`` and ``image`` hold RGB as float32, bit for bit
    those of the npz: display-referred values in [0, 1], not linear light. Raises InputError where the package OpenEXR
    is missing.
    """
    exr: Any = optional_package("OpenEXR", "exr", "exr")
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for result in results:
        header = {
            "compression": exr.ZIP_COMPRESSION,
            "type": exr.scanlineimage,
            "comments": "display-referred values in [0, 1] as the renderer returns them, not linear light",
        }
        parts = [exr.Part(dict(header), {"RGB": np.ascontiguousarray(getattr(result, n))}, n) for n in IMAGES]
        file = folder / frame_name(result.index, "exr")
        # the library writes to a name, not to a stream
        scratch = folder / f".{file.name}.part.exr"
        try:
            exr.File(parts).write(str(scratch))
            scratch.replace(file)
        finally:
            scratch.unlink(missing_ok=True)
        files.append(file)
    return files


def write_safetensors(results: Results, folder: Path) -> list[Path]:
    """Write ``frame_00000.safetensors`` for every frame, and return the files.

    They hold the arrays of the npz by the same names: the bounds, and of leaf cells ``box_lower``, ``box_upper``,
    ``tile``, ``A_lower``, ``b_lower``, ``A_upper`` and ``b_upper``. The metadata are texts: ``format``, ``guarantee``,
    and ``parameters`` as JSON. Raises InputError where the package safetensors is missing, or a frame keeps no linear
    sets.
    """
    safetensors: Any = optional_package("safetensors.numpy", "safetensors", "safetensors")
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for place, (index, source) in enumerate(results.files.items()):
        stored = load_frame(source)
        leaves = stored.result.leaves
        if leaves is None:
            raise InputError("keeps no linear sets", file=source, fix="run ns-abstract-render with --save-cells")
        arrays = {name: np.ascontiguousarray(getattr(stored.result, name)) for name in IMAGES}
        arrays |= {name: np.ascontiguousarray(getattr(leaves, name)) for name in LEAVES}
        about = {
            "format": "ns-abstract frame 1",
            "guarantee": str(stored.about.get("guarantee", "unknown")),
            "parameters": json.dumps(results.parameters[place]),
        }
        content = safetensors.save(arrays, about)
        file = folder / frame_name(index, "safetensors")
        write_atomic(file, lambda stream, content=content: stream.write(content))
        files.append(file)
    return files
