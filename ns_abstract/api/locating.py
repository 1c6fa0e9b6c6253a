"""Where a photo was taken: `locate`, its result, and the question that the command line asks, too."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike

from ns_abstract.api.cell_search import CellQuestion, CellSearch, Request, Row, SearchProgress, result_cells
from ns_abstract.api.job import Job, warm_up_sub_boxes
from ns_abstract.api.location import Location, PhotoOptions, calibrated
from ns_abstract.api.poses import PoseSet, pose_sets
from ns_abstract.api.scenes import Scene, checked_scene
from ns_abstract.api.search_options import SearchKeywords, SearchOptions, SearchResult
from ns_abstract.execution.cancellation import Deadline
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.io.arguments import array_of, flag
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import unusable
from ns_abstract.report.certificate import search_figures
from ns_abstract.report.figures import percent, short_guarantee
from ns_abstract.report.location import location_document, location_page, location_pictures
from ns_abstract.report.notebook import verdicts_html
from ns_abstract.report.run import CommandRun
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.location_cover import PoseCover
from ns_abstract.verify.location_store import LocationStore
from ns_abstract.verify.store import Store

if TYPE_CHECKING:
    from typing import Unpack  # pyright: ignore[reportAttributeAccessIssue]  # of Python 3.11

#: How far 255 times a float may be from a whole number: float32 rounds numbers up to 1 by 2^-25, here at most 2^-17.
_LEVEL_ERROR = 1e-3
#: Seconds that boxes around what is left are looked for once the time is over; the part of the time, and the seconds,
#: that are kept for them at most.
_GRACE, _SHARE_FOR_COVER, _MOST_FOR_COVER = 2.0, 0.05, 20.0


@dataclass(frozen=True)
class LocateProgress(SearchProgress):
    """Where a search stands.

    Attributes:
        left: Part of the sets that is not excluded, at most.
        outliers: Pixels that the best pose so far does not explain, or None.
        seconds: Time spent.
        done: Part of what is searched that is excluded; slanted cells reach beyond the sets.
    """

    left: float
    outliers: int | None
    seconds: float
    done: float

    @property
    def sentence(self) -> str:
        """Return a sentence: possible volume, and how well the best pose explains the photo."""
        best = "" if self.outliers is None else f", best pose misses {self.outliers:,} pixels"
        return f"at most {percent(self.left)} of the set left{best}"


class LocationQuestion(CellQuestion[LocateProgress]):
    """Which poses of some frames' sets can have made a photo, and the report on it."""

    store = LocationStore

    def __init__(
        self, job: Location, frames: Sequence[int], settings: Mapping[str, Any], command: tuple[str, ...]
    ) -> None:
        self.job = job
        super().__init__(job, job.job.parameters, {k: job.search(k).frame.box for k in frames}, job.job.fixed)
        program = dict(job.job.method.program)
        self.about = CommandRun.of(job.job, settings, command, fingerprint=job.fingerprint, renderer=program)

    def grid(self, number: int) -> CellGrid:
        return self.job.search(number).grid

    def first_blocks(self, number: int, grid: CellGrid) -> list[list[Cell]]:
        return [[cell] for cell in self.job.search(number).first_cells()]

    def stored_set(self, number: int) -> Any:
        return self.job.search(number).frame.box

    def opened(self, search: CellSearch[LocateProgress]) -> None:
        store = cast(LocationStore, search.store)
        store.allowed = self.job.photo.allowed
        uncovered = dict.fromkeys(tally.frame for tally in store.tallies())

        def cover(frame: int) -> PoseCover:
            if search.stop():
                end = Deadline(_GRACE / len(self.sets))
            else:
                seconds = max(_GRACE, search.whole.left) / max(1, len(uncovered))
                end = Deadline(seconds, search.stop)
            uncovered.pop(frame, None)
            return self.job.cover(frame, store.left(frame), end)

        store.cover = cover

    def prepare(self, search: CellSearch[LocateProgress], request: Request) -> None:
        request.on_open(search.store)
        first = next(iter(self.sets))
        self.job.job.warm_up(first)
        if (frame := self.job.search(first).sub_box_frame) is not None:
            warm_up_sub_boxes(frame)

    def reserved(self, seconds: float) -> float:
        return min(_MOST_FOR_COVER, _SHARE_FOR_COVER * seconds)

    def progress(self, store: Store) -> LocateProgress:
        assert isinstance(store, LocationStore)
        tallies = store.tallies()
        open_parts = {tally.frame: 1.0 - tally.certified / tally.units for tally in tallies}
        left = sum(min(1.0, part * self._excess(frame)) for frame, part in open_parts.items()) / max(1, len(tallies))
        best = [pose.outliers for tally in tallies for pose in store.poses(tally.frame)[:1]]
        done = 1.0 - sum(open_parts.values()) / max(1, len(tallies))
        return LocateProgress(left, min(best, default=None), store.seconds, done)

    def _excess(self, frame: int) -> float:
        """Return the volume of the searched box of pose set ``frame``, divided by that of the set's own box."""
        searched, own = self.sets[frame], self.job.job.pose_sets[frame].box
        return float(np.prod(np.subtract(searched.upper, searched.lower) / np.subtract(own.upper, own.lower)))

    def report(self, search: CellSearch[LocateProgress], state: str) -> dict[str, Any]:
        store = cast(LocationStore, search.store)
        if state == "running":
            return {}
        rows = {tally.frame: store.leaves(tally.frame) for tally in store.tallies()}
        left = {frame: self.job.possible_volume(frame, store.left(frame)) for frame in rows}
        sets = {frame: self.job.job.pose_sets[frame] for frame in rows}
        poses = {frame: store.poses(frame) for frame in rows}
        photo = self.job.photo
        about = {
            "file": self.job.file,
            "noise": photo.noise,
            "outliers": photo.outliers,
            "counted": int(photo.counted.sum()),
            "allowed": photo.allowed,
            **_more(self.job),
        }
        document = location_document(
            self.about, about, self.parameters, sets, rows, left, poses, search_figures(store), state=state
        )
        if search.request.report:
            picture, missed = None, None
            if document["best"] is not None and state != "interrupted":
                values = poses[document["best"]["frame"]][0].values
                picture = self.job.picture(document["best"]["frame"], np.array(values))
                missed = photo.outside(picture)
            pictures = location_pictures(photo.levels, picture, missed)
            page = partial(location_page, document, rows, sets, pictures, self.job.job.method.elements())
            search.last.write(document, page)
        return document


def _more(job: Location) -> dict[str, Any]:
    """Return entries of report.json: `brightness` unless it is fixed, and `calibration` if there was one."""
    brightness = job.photo.brightness
    more: dict[str, Any] = {} if brightness.still else {"brightness": vars(brightness)}
    return more if job.calibration is None else {**more, "calibration": job.calibration.describe()}


@dataclass(frozen=True)
class LocatedCell:
    """A cell of a set.

    Attributes:
        frame: Number of its set of poses.
        lower, upper: Ends of its box, in the order of `Located.parameters`.
        verdict: "excluded" (no pose of it made the photo), "possible" (``pose`` explains the photo) or "unknown".
        pose: Parameters of a rendered pose that explains the photo, or None.
    """

    frame: int
    lower: np.ndarray
    upper: np.ndarray
    verdict: Literal["excluded", "possible", "unknown"]
    pose: np.ndarray | None


@dataclass(frozen=True)
class Located(SearchResult):
    """The poses of some sets that can have made a photo.

    Attributes:
        possible_volume: Part of the parameter volume that is not excluded, mean over the sets.
        boxes_volume: Part of it that ``cells`` around this take: cells of the search are slanted, these are boxes.
        hull: Ends [d], [d] of the smallest box around all that is not excluded; None: no pose made the photo.
        best: Parameters ``pose`` of the rendered pose that explains most, and the number of ``outliers``; or None.
        answer: "none" (no pose of the sets made the photo), "possible" (a rendered pose explains it) or "unknown".
        cells: What the sets are made of.
        guarantee: Of the pictures, as in `ns_abstract.BoundResult`.
    """

    possible_volume: float
    boxes_volume: float
    hull: tuple[np.ndarray, np.ndarray] | None
    best: Mapping[str, Any] | None
    answer: str
    cells: tuple[LocatedCell, ...] = field(repr=False)
    guarantee: str

    def _repr_html_(self) -> str:
        shares = {"certified": 1.0 - self.possible_volume, "falsified": 0.0, "unknown": self.possible_volume}
        lines = [
            f"{self.answer}: {percent(self.possible_volume)} of the set is left",
            f"{self.guarantee}; {len(self.cells)} cells, {self.seconds:.1f} s; {self.state}",
        ]
        return verdicts_html(shares, lines)


def locate(
    scene: Scene,
    poses: PoseSet | PinholeCamera | Sequence[PoseSet | PinholeCamera],
    photo: ArrayLike,
    *,
    noise: float = 0.02,
    outliers: float = 0.05,
    mask: ArrayLike | None = None,
    calibrate: bool = False,
    brightness: Mapping[str, Sequence[float]] | None = None,
    contract: bool = True,
    on_progress: Callable[[LocateProgress], object] | None = None,
    memory_limit: float | None = None,
    **search: Unpack[SearchKeywords],
) -> Located:
    """Find which poses of sets can have made a photo; what is excluded is proved.

    Ctrl-C and ``on_progress`` returning False end the work between two cells, with what is known.

    Args:
        scene: The scene.
        poses: One set, or several; a camera is the set of its one pose.
        photo: [H, W, 3] of the cameras' size: uint8, or numbers in [0, 1] that are multiples of 1/255.
        noise: By how much a value of the photo may differ from the picture's before it is rounded to 8 bits.
        outliers: Part of the pixels that may show anything.
        mask: [H, W] which pixels count; None: all.
        calibrate: Whether noise and outliers are raised to what explains the run's training photos.
        brightness: ``{"gain": [low, high], "offset": [low, high]}``: the camera may show gain * picture + offset.
        contract: Whether cells are contracted by their pixels' linear bounds before they are cut.
        on_progress: Told about once a second.
        memory_limit: GiB; None: 80 % of what is free.
        **search: Fields of `SearchOptions`: ``time_budget``, ``output_dir``, ``arithmetic``, ``resume``, ``workers``,
            ``engine``, ``scheduler_address``.

    Raises:
        InputError: An argument cannot be used.
    """
    search_options = SearchOptions(**search)
    sets = pose_sets(poses)
    ends = {} if brightness is None else brightness
    if not isinstance(ends, Mapping) or not {"gain", "offset"}.issuperset(ends):
        raise unusable(ends, field="brightness", fix='give {"gain": [low, high]}, "offset", or both')
    options = PhotoOptions(noise, outliers, contract, **{k: _ends(v) for k, v in ends.items()})
    job = Job(
        checked_scene(scene),
        [entry.of(scene) for entry in sets],
        arithmetic=search_options.arithmetic,
        workers=search_options.workers,
        memory_limit=memory_limit,
    )
    options, calibration = calibrated(scene, job, options) if flag(calibrate, "calibrate") else (options, None)
    counted = None if mask is None else _checked_mask(mask, job)
    location = Location(job, photo_levels(photo), counted, options, calibration=calibration)
    settings = {**search_options.settings, **vars(options)}
    rows, document = search_options.search(
        LocationQuestion(location, range(len(sets)), settings, ("ns_abstract.locate",)),
        on_progress,
        workers=1 if scene.rays else search_options.workers,
        report=search_options.output_dir is not None,
    )
    return located(location, rows, document)


def _ends(value: Any) -> Any:
    """Return ``value`` as (nested) lists if it is an array, for JSON; any other value unchanged."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def photo_levels(photo: ArrayLike) -> np.ndarray:
    """Return the [H, W, 3] uint8 levels of a photo. Raises InputError where a number is not k/255."""
    values = array_of(photo)
    if values is None:
        raise unusable(photo, field="photo", fix="give [H, W, 3] uint8, or numbers in [0, 1]")
    if values.ndim != 3 or values.shape[2] != 3 or values.dtype.kind not in "fu":
        raise InputError(
            f"found {values.dtype} of shape {list(values.shape)}", field="photo",
            fix="give [H, W, 3] uint8, or numbers in [0, 1]",
        )  # fmt: skip
    if values.dtype == np.uint8:
        return np.ascontiguousarray(values)
    with np.errstate(invalid="ignore"):
        exact = values.astype(np.float64) * 255.0
        levels = np.rint(exact)
        fits = (levels >= 0.0) & (levels <= 255.0) & (np.abs(levels - exact) <= _LEVEL_ERROR)
    if values.dtype.kind == "u" or not fits.all():
        raise InputError(
            "has values that are no multiples of 1/255 in [0, 1]", field="photo",
            fix="round it to 8 bits: np.rint(255 * photo).astype(np.uint8)",
        )  # fmt: skip
    return levels.astype(np.uint8)


def _checked_mask(mask: ArrayLike, job: Job) -> np.ndarray:
    values, camera = array_of(mask), job.pose_sets[0].camera
    if values is None:
        raise unusable(mask, field="mask", fix=f"give [{camera.height}, {camera.width}] bool")
    if values.dtype != bool or values.shape != (camera.height, camera.width):
        raise InputError(
            f"found {values.dtype} of shape {list(values.shape)}", field="mask",
            fix=f"give [{camera.height}, {camera.width}] bool",
        )  # fmt: skip
    return values


def located(job: Location, rows: Mapping[int, list[Row]], document: Mapping[str, Any]) -> Located:
    """Return the result of a search that has ended with these rows of cells by frame."""
    hull = document["hull"]
    return Located.of(
        job.job.parameters,
        document,
        possible_volume=document["possible_volume"],
        boxes_volume=document["boxes_volume"],
        hull=None if hull is None else (np.array(hull["lower"]), np.array(hull["upper"])),
        best=document["best"],
        answer=document["answer"],
        cells=result_cells(rows, LocatedCell),
        guarantee=short_guarantee(job.job.method.guarantee, document["scene"].get("bounded")),
    )
