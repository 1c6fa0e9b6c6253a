"""A location: scene, sets of poses and a photo, and the examination of cells."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.api.calibration import Calibration, calibrate
from ns_abstract.api.files import Settings, open_job
from ns_abstract.api.job import Job, require_sound_platform
from ns_abstract.api.scenes import Scene
from ns_abstract.execution.worker_cache import Recipe
from ns_abstract.geometry.tiles import assemble
from ns_abstract.io.errors import InputError
from ns_abstract.io.photos import read_mask, read_photo
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.location import LocationResult, LocationSearch
from ns_abstract.verify.location_cover import PoseCover, ShearedBoxes, cover
from ns_abstract.verify.photo import Brightness, Photo

#: Of the search's rules: results of different ones are not mixed.
_RULES = 4


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
        """What the camera may do to the picture."""
        return Brightness(self.gain, self.offset)

    def __post_init__(self) -> None:
        for name, ends, least, most in (("gain", self.gain, 0.1, 10.0), ("offset", self.offset, -1.0, 1.0)):
            if not (len(ends) == 2 and least <= ends[0] <= ends[1] <= most):
                fix = f"give two numbers from {least:g} to {most:g}, the smaller one first"
                raise InputError(f"found {list(ends)}", field=f"--brightness-{name}", fix=fix)
        if not 0.0 <= self.noise < 1.0:
            raise InputError(f"found {self.noise}", field="--noise", fix="give a number from 0 to below 1")
        if not 0.0 <= self.outliers < 1.0:
            raise InputError(f"found {self.outliers}", field="--outliers", fix="give a number from 0 to below 1")


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
        """The search of a frame's set; kept at hand."""
        if number not in self._searches:
            self._searches.clear()
            frame, plain = self.job.frame(number, sheared=True), self.job.frame(number)
            self._searches[number] = LocationSearch(frame, plain, self.photo, contract=self.options.contract)
        return self._searches[number]

    def examine(self, number: int, grid: CellGrid, cells: tuple[Cell, ...]) -> LocationResult:
        """What becomes of cells of a frame; see `ns_abstract.api.cell_search.Examiner`."""
        return self.search(number).examine(cells)

    def picture(self, number: int, values: np.ndarray) -> np.ndarray:
        """[H, W, 3] picture at parameters of a frame's set."""
        plain = self.search(number).plain
        return assemble(plain.render(np.asarray(values, np.float64)), plain.camera)[..., :3]

    def cover(self, number: int, cells: list[Cell]) -> PoseCover:
        """Cells of a set's own parameters that hold all poses in ``cells`` of its search."""
        search = self.search(number)
        boxes = [box for cell in cells if (box := search.frame.feasible(search.grid.box_of(cell))) is not None]
        d = search.frame.box.dimensions
        lower, upper = (
            np.array([getattr(box, end) for box in boxes], np.float64).reshape(len(boxes), d)
            for end in ("lower", "upper")
        )
        sheared = ShearedBoxes(lower, upper, search.frame.box.names, search.frame.pose_set.shear)
        return cover(search.plain.box, sheared)

    @property
    def fingerprint(self) -> dict[str, Any]:
        """What a stored search must agree with to be continued."""
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
        """How another process opens it."""
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
    """Open the files of a command line.

    Raises:
        InputError: A file or a field cannot be used.
    """
    levels = read_photo(settings.image)
    mask = None if settings.mask is None else read_mask(settings.mask, levels.shape[:2])
    job = open_job(settings.files, default=Perturbation())
    options, calibration = settings.photo, None
    if settings.calibrate:
        options, calibration = calibrated(job.scene, job, options)
    return Location(job, levels, mask, options, settings.image, calibration)


def calibrated(scene: Scene, job: Job, options: PhotoOptions) -> tuple[PhotoOptions, Calibration]:
    """What explains the run's training photos, but no less than ``options``.

    Raises:
        InputError: There are no photos.
    """
    calibration = calibrate(
        scene,
        job.pose_sets[0].camera.height,
        noise=options.noise,
        outliers=options.outliers,
        arithmetic=job.arithmetic,
    )
    return replace(options, noise=calibration.noise, outliers=calibration.outliers), calibration
