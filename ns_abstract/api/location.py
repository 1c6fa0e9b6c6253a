"""A location: scene, sets of poses and a photo, and the examination of cells."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ns_abstract.api.files import Settings, open_job
from ns_abstract.api.job import Job, require_sound_platform
from ns_abstract.api.scenes import Scene
from ns_abstract.execution.worker_cache import Recipe
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.io.arguments import flag, float64_of
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_beside, load_json, unusable
from ns_abstract.io.photos import read_mask, read_photo
from ns_abstract.methods.runs import Tagged, read_config
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.location import LocationResult, LocationSearch
from ns_abstract.verify.location_cover import PoseCover, ShearedBoxes, cover
from ns_abstract.verify.photo import Brightness, Photo

#: Of the search's rules: results of different ones are not mixed.
_RULES = 8
_OPTION, _DATA = "--calibrate", "transforms.json"


@dataclass(frozen=True)
class PhotoOptions:
    """What a picture may miss of a photo, and how it is searched for.

    Attributes:
        noise: By how much values may differ, of 1.
        outliers: Part of the pixels that may be anything.
        contract: Whether cells are contracted by their pixels' linear bounds before they are cut.
        gain, offset: Ends of what the camera may do to all values of the picture alike: ``gain * value + offset``.

    Raises:
        InputError: A value cannot be used.
    """

    noise: float = 0.02
    outliers: float = 0.05
    contract: bool = True
    gain: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)

    @property
    def brightness(self) -> Brightness:
        """Gain and offset that the camera may apply to the picture."""
        return Brightness(self.gain, self.offset)

    def __post_init__(self) -> None:
        for name, ends, least, most in (("gain", self.gain, 0.1, 10.0), ("offset", self.offset, -1.0, 1.0)):
            numbers = tuple(map(float64_of, ends)) if isinstance(ends, Sequence) else ()
            if not (len(numbers) == 2 and least <= numbers[0] <= numbers[1] <= most):
                fix = f"give two numbers from {least:g} to {most:g}, the smaller one first"
                raise unusable(ends, field=f"--brightness-{name}", fix=fix)
            object.__setattr__(self, name, numbers)
        for name in ("noise", "outliers"):
            value = getattr(self, name)
            if not 0.0 <= float64_of(value) < 1.0:
                raise unusable(value, field=f"--{name}", fix="give a number from 0 to below 1")
            object.__setattr__(self, name, float64_of(value))
        object.__setattr__(self, "contract", flag(self.contract, "contract"))


class Location:
    """Sets of poses, and the photo that one of them may have made.

    Args:
        levels: [H, W, 3] uint8 photo.
        mask: [H, W] which pixels count; None: all.
        calibration: Where noise and outliers come from, if they were calibrated.

    Raises:
        InputError: The photo does not fit the cameras, or the platform's arithmetic is not sound.
    """

    def __init__(
        self,
        job: Job,
        levels: np.ndarray,
        mask: np.ndarray | None,
        options: PhotoOptions,
        file: Path | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        self.job, self.options, self.file, self.calibration = job, options, file, calibration
        camera = job.pose_sets[0].camera
        size = camera.height, camera.width
        if levels.shape[:2] != size:
            height, width = levels.shape[:2]
            raise InputError(
                f"has {width} x {height} pixels, pictures of the camera path {camera.width} x {camera.height}",
                file=file,
                field="--image",
                fix=f"resize it to {camera.width} x {camera.height}, or write render_width {width} and render_height "
                f"{height} into the path",
            )
        counted = np.ones(size, bool) if mask is None else mask
        if not counted.any():
            raise InputError("counts no pixel", field="--mask", fix="write white where pixels count")
        self.photo = Photo(levels, options.noise, options.outliers, counted, options.brightness)
        require_sound_platform()
        self._searches: dict[int, LocationSearch] = {}

    def search(self, number: int) -> LocationSearch:
        """Return the search of a frame's set, which is cached."""
        if number not in self._searches:
            self._searches.clear()
            frame, plain = self.job.frame(number, sheared=True), self.job.frame(number)
            self._searches[number] = LocationSearch(frame, plain, self.photo, contract=self.options.contract)
        return self._searches[number]

    def examine(self, number: int, grid: CellGrid, cells: tuple[Cell, ...]) -> LocationResult:
        return self.search(number).examine(cells)

    def picture(self, number: int, values: np.ndarray) -> np.ndarray:
        """Return [H, W, 3] picture at parameters of a frame's set."""
        plain = self.search(number).plain
        return assemble(plain.render(np.asarray(values, np.float64)), plain.camera)[..., :3]

    def possible_volume(self, number: int, cells: list[Cell]) -> float:
        """Return an upper bound of the fraction of a set's volume in ``cells`` of its search."""
        search = self.search(number)
        plain, boxes = search.plain.box, list(map(search.grid.box_of, cells))
        whole = float(np.prod(np.subtract(plain.upper, plain.lower)))
        return min(1.0, self._sheared(number, boxes).volume_within(plain) / whole)

    def cover(self, number: int, cells: list[Cell], late: Callable[[], bool] = lambda: False) -> PoseCover:
        """Return cells of a set's own parameters that hold all poses in ``cells`` of its search; see `cover`."""
        search = self.search(number)
        boxes = []
        for box in map(search.grid.box_of, cells):
            # poses outside of the set cost nothing but tightness
            feasible = box if late() else search.frame.feasible(box)
            if feasible is not None:
                boxes.append(feasible)
        return cover(search.plain.box, self._sheared(number, boxes), late=late)

    def _sheared(self, number: int, boxes: list[ParameterBox]) -> ShearedBoxes:
        frame = self.search(number).frame
        lower, upper = (
            np.array([getattr(box, end) for box in boxes], np.float64).reshape(len(boxes), frame.box.dimensions)
            for end in ("lower", "upper")
        )
        return ShearedBoxes(lower, upper, frame.box.names, frame.pose_set.shear)

    @property
    def fingerprint(self) -> dict[str, Any]:
        return self._fingerprint

    @cached_property
    def _fingerprint(self) -> dict[str, Any]:
        photo = self.photo
        digest = hashlib.sha256(photo.levels.tobytes() + np.packbits(photo.counted).tobytes()).hexdigest()
        options = {key: list(v) if isinstance(v, tuple) else v for key, v in vars(self.options).items()}
        if self.options.brightness.still:
            del options["gain"], options["offset"]
        return {**self.job.fingerprint, "photo": digest, **options, "rules": _RULES}

    @property
    def recipe(self) -> Recipe[Location]:
        photo = self.photo
        again = partial(_open, self.job.recipe.open, photo.levels, photo.counted, self.options)
        return Recipe(again, self.fingerprint, self.job.source.file)


def _open(open_job: Callable[[], Job], levels: np.ndarray, counted: np.ndarray, options: PhotoOptions) -> Location:
    return Location(open_job(), levels, counted, options)


@dataclass(frozen=True)
class LocateSettings:
    """What to locate, as the command line says it.

    Attributes:
        mask: Which of its pixels count, or None.
        calibrate: Whether the run's training photos may raise that.
    """

    files: Settings
    image: Path
    mask: Path | None = None
    photo: PhotoOptions = field(default_factory=PhotoOptions)
    calibrate: bool = False


def open_location(settings: LocateSettings) -> Location:
    """Open the files of a command line. Raises InputError where a file or a field cannot be used."""
    levels = read_photo(settings.image)
    mask = None if settings.mask is None else read_mask(settings.mask, levels.shape[:2])
    job = open_job(settings.files, default=Perturbation())
    options, calibration = settings.photo, None
    if settings.calibrate:
        options, calibration = calibrated(job.scene, job, options)
    return Location(job, levels, mask, options, settings.image, calibration)


def calibrated(scene: Scene, job: Job, options: PhotoOptions) -> tuple[PhotoOptions, Calibration]:
    """Return options with noise and outliers, at least those given, that explain photos. Raises InputError: none."""
    calibration = calibrate(
        scene, job.pose_sets[0].camera.height, noise=options.noise, outliers=options.outliers, arithmetic=job.arithmetic
    )
    return replace(options, noise=calibration.noise, outliers=calibration.outliers), calibration


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
    """What every looked-at training photo's own pose misses of it at most: ``noise`` and ``outliers`` explain them all.

    ``data`` names the photos, of which so many were looked at; ``size`` is height and width of the pictures that were
    compared, ``psnr`` the mean over the photos, dB; ``noise_by_outliers`` the noise that each weighed part needs.
    """

    noise: float
    outliers: float
    data: str
    photos: int
    size: tuple[int, int]
    psnr: float
    noise_by_outliers: dict[str, float]

    def describe(self) -> dict[str, Any]:
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
    path = load_camera_path(file, run_frame=scene.data_frame)
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
    """Return the noise, rounded up to 1e-4, that all but a fraction ``part`` of the ``residuals`` [n] stay within."""
    allowed = math.floor(part * residuals.size)
    return 0.0 if allowed >= residuals.size else math.ceil(float(residuals[allowed]) * 1e4) / 1e4


def training_data(scene: Scene) -> Path:
    """Return the ``transforms.json`` of the data set that a run was trained on.

    It is looked for where config.yml says, and under the ends of that path beside config.yml and above it. Raises
    InputError where the scene is no run, or nothing is there.
    """
    file = scene.source.file
    if scene.data_frame is None:
        problem = "the scene is no run with photos whose frame could be told from that of their transforms.json"
        raise InputError(problem, file=file, field=_OPTION, fix="give --noise and --outliers")
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
    return read_photo(file_beside(file.parent, name), _OPTION, as_stored=True)
