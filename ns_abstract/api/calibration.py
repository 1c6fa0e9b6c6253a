"""What a photo may miss of a scene's picture, from the run's own training photos."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ns_abstract.api.scenes import Scene
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_beside, load_json
from ns_abstract.io.photos import read_photo
from ns_abstract.methods.runs import Tagged, read_config
from ns_abstract.perturbation.specification import Perturbation

_OPTION, _DATA = "--calibrate", "transforms.json"


@dataclass(frozen=True)
class CalibrationTuning:
    """Preferences of a calibration."""

    #: Most photos that are looked at, evenly spaced.
    photos: int = 16
    #: Parts of the pixels that may be called outliers, and how many times the noise counts for all of them: the part
    #: with the least product of noise and ``1 + price * part`` is chosen.
    parts: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1, 0.2)
    price: float = 5.0
    #: Mean square of the residuals from which on the reported dB say no more.
    least_error: float = 1e-12


@dataclass(frozen=True)
class Calibration:
    """What every looked-at training photo's own pose misses of it at most.

    Attributes:
        noise, outliers: What explains them all.
        data: File that names the photos.
        photos: How many were looked at.
        size: Height and width of the pictures that were compared.
        psnr: Mean over the photos, dB.
        noise_by_outliers: Of each part that was weighed, the noise that it needs.
    """

    noise: float
    outliers: float
    data: str
    photos: int
    size: tuple[int, int]
    psnr: float
    noise_by_outliers: dict[str, float]

    def describe(self) -> dict[str, Any]:
        """For report.json."""
        return asdict(self)


def calibrate(
    scene: Scene,
    height: int,
    *,
    noise: float,
    outliers: float,
    arithmetic: str | None = None,
    tuning: CalibrationTuning | None = None,
) -> Calibration:
    """Choose noise and outliers by which all training photos are explained by the poses that took them.

    Args:
        scene: A run of Nerfstudio whose data set lies where it was, or near it.
        height: Of the pictures that will be compared; photos that are higher are reduced to it.
        noise, outliers: The least that are chosen.

    Raises:
        InputError: The scene has no such photos, or they cannot be used.
    """
    tuning = tuning or CalibrationTuning()
    file = training_data(scene)
    frames = load_json(file, "data set").get("frames", [])
    path = load_camera_path(file, run_frame=scene.run_frame)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), tuning.photos)).round().astype(int))
    method, residuals, errors, size = scene.method(arithmetic), [], [], (0, 0)
    for k in chosen:
        levels = _photo(file, frames[k], k)
        camera = path.cameras[k]
        if levels.shape[:2] != (camera.height, camera.width):
            problem = (
                f"frames[{k}] has {levels.shape[1]} x {levels.shape[0]} pixels, not {camera.width} x {camera.height}"
            )
            raise InputError(problem, file=file, field=_OPTION, fix="give the photos that w and h tell")
        if camera.height > height:
            camera = camera.resized(height, max(1, round(camera.width * height / camera.height)))
            levels = np.array(Image.fromarray(levels).resize((camera.width, camera.height), Image.Resampling.BOX))
        frame = method.frame(PoseBox.around(camera, Perturbation()))
        picture = assemble(frame.render(frame.box.middle), frame.camera)[..., :3].astype(np.float64)
        gaps = np.abs(levels / 255.0 - picture)
        if not np.isfinite(gaps).all():
            raise InputError(f"the picture of frames[{k}] is not finite", file=file, field=_OPTION, fix="leave it out")
        errors.append(float((gaps**2).mean()))
        residuals.append(np.sort(np.maximum(gaps.max(axis=-1).ravel() - 0.5 / 255.0, 0.0))[::-1])
        size = camera.height, camera.width
    parts = sorted({outliers, *(part for part in tuning.parts if part > outliers)})
    needed = {part: max(noise, *(_noise(residual, part) for residual in residuals)) for part in parts}
    best = min(parts, key=lambda part: needed[part] * (1.0 + tuning.price * part))
    psnr = -10.0 * math.log10(max(float(np.mean(errors)), tuning.least_error))
    by_part = {f"{part:g}": value for part, value in needed.items()}
    return Calibration(needed[best], best, str(file), len(chosen), size, psnr, by_part)


def _noise(residuals: np.ndarray, part: float) -> float:
    """The least noise, in steps of 1e-4, at which ``residuals`` [n], falling, are explained but for a part of them."""
    allowed = math.floor(part * residuals.size)
    return 0.0 if allowed >= residuals.size else math.ceil(float(residuals[allowed]) * 1e4) / 1e4


def training_data(scene: Scene) -> Path:
    """The ``transforms.json`` of the data set that a run was trained on.

    It is looked for where config.yml says, and under the ends of that path beside config.yml and above it.

    Raises:
        InputError: The scene is no run, or nothing is there.
    """
    file = scene.source.file
    if scene.run_frame is None:
        raise InputError("the scene is no run with photos", file=file, field=_OPTION, fix="give --noise and --outliers")
    run = read_config(file)
    value = run.root.get("data")
    stated = value.value if isinstance(value, Tagged) else [value]
    parts = [part for part in stated if isinstance(part, str) and part] if isinstance(stated, list) else []
    if not parts or len(parts) != len(stated):
        raise InputError("names no data set", file=run.file, field="data", fix="give --noise and --outliers")
    recorded = Path(*parts)
    places = [recorded, *(
        folder / Path(*recorded.parts[-n:])
        for folder in run.file.absolute().parents[:6]
        for n in range(min(3, len(recorded.parts)), 0, -1)
    )]  # fmt: skip
    for place in places:
        data = place if place.name == _DATA else place / _DATA
        if data.is_file():
            return data
    raise InputError(
        f"no {_DATA} in {recorded}, nor near the run", file=run.file, field=_OPTION,
        fix="put the data set's folder beside the run, or give --noise and --outliers",
    )  # fmt: skip


def _photo(file: Path, entry: Any, k: int) -> np.ndarray:
    name = entry.get("file_path") if isinstance(entry, dict) else None
    if not isinstance(name, str) or not name:
        raise InputError("names no photo", file=file, field=f"frames[{k}].file_path", fix="write the photo's name")
    return read_photo(file_beside(file.parent, name), _OPTION)
