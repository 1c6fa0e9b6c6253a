"""How far apart pictures of two scenes are over sets of poses: `compare`, its result, and the job of a command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ns_abstract.api.assumptions import DEFAULT
from ns_abstract.api.bounding import OnProgress, bound_alone
from ns_abstract.api.files import Settings, path_sets
from ns_abstract.api.job import Job
from ns_abstract.api.poses import PoseSet, pose_set
from ns_abstract.api.scenes import Scene, SceneSource, checked_scene
from ns_abstract.arithmetic.selfcheck import platform_problems
from ns_abstract.execution.worker_cache import Recipe, built
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import CameraPath, PinholeCamera, load_camera_path
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.arguments import at_least, float64_of, positive, whole, workers_of
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import unusable
from ns_abstract.refine.difference import DifferenceFrame
from ns_abstract.refine.goal import RefinementGoal
from ns_abstract.refine.largest import LargestDifference
from ns_abstract.refine.result import ArrayRecord, FrameResult, PartResult, TracePoint
from ns_abstract.report.comparison import difference_figures, verdict
from ns_abstract.report.figures import short_guarantee


@dataclass(frozen=True)
class ComparisonTuning:
    """What counts as the same.

    Attributes:
        same_frame: By which the maps of two runs to their frames may differ, in the entries of rotation and scale
            together and, relative to its length, in the shift: rounding of their files.
    """

    same_frame: float = 1e-6


_TUNING = ComparisonTuning()
#: What bounds of two splats with equal means rest on (design.md, Y5).
_ORDER = Assumption(
    "order of Gaussians with equal means", "the same in both pictures", "one program renders both scenes"
)


#: Origin of B's background where its file states none.
_BACKGROUND_OF_A = f"{DEFAULT}: A's, the file of B states none"


class ComparisonJob(Job):
    """Two scenes with one set of poses by frame; what is bounded is the absolute difference of their pictures.

    Args:
        scene: A, in whose frame cameras are given.
        other: B.
        tolerance: Difference of which is asked whether any picture exceeds it; None: nothing is asked.
        options: Those of `Job`.

    Raises:
        InputError: The scenes cannot be compared, vary, or the memory does not do for both.
    """

    def __init__(
        self,
        scene: Scene,
        other: Scene,
        pose_sets: Sequence[PoseBox],
        *,
        tolerance: float | None = None,
        path: CameraPath | None = None,
        **options: Any,
    ) -> None:
        _check_comparable(scene, other, pose_sets)
        self.tolerance, self.path = tolerance, path
        shared = {name: value for name, value in options.items() if name not in ("notes", "set_choices")}
        with _named(other):
            self.other = Job(other, pose_sets, **shared)
        super().__init__(scene, pose_sets, **options)
        self.frame_choice, self.order_choice = _frame_choice(scene, other), ()
        if pose_sets:
            frame = self.frame(0)
            first, second = frame.both
            if frame.shares_order:
                self.order_choice = (_ORDER,)
            if (first.side, first.tilewise) != (second.side, second.tilewise):
                raise InputError(
                    "pictures are made in tiles of another size than A's",
                    file=other.source.file,
                    field="--other-renderer",
                    fix="compare scenes that one program draws",
                )

    @property
    def recipe(self) -> Recipe[Any]:
        sources = self.source.absolute, self.other.source.absolute
        again = partial(
            built, ComparisonJob, [source.open for source in sources], self.pose_sets, tolerance=self.tolerance,
            arithmetic=self.arithmetic, seed=self.seed, memory_limit=self.memory_limit,
        )  # fmt: skip
        return Recipe(again, self.fingerprint, sources[0].file)

    @property
    def continues(self) -> bool:
        return True

    def base_memory(self, processes: int = 1) -> int:
        return super().base_memory(processes) + self.other.base_memory(processes)

    def frame(self, index: int, sheared: bool = False) -> DifferenceFrame:
        first = super().frame(index, sheared)
        # B's parameters mean what A's do, also where these make up for one another
        return DifferenceFrame(first, self.other.method.frame(first.pose_set))

    def bound_part(
        self,
        index: int,
        goal: RefinementGoal,
        tiles: np.ndarray | None = None,
        *,
        keep_leaves: bool = False,
        stopped: Callable[[], bool] = lambda: False,
        progress: Callable[[TracePoint, float], None] = lambda point, share: None,
        earlier: FrameResult | None = None,
    ) -> PartResult:
        whole = self.frame(index)
        sheared = self.frame(index, sheared=True)
        work = LargestDifference(
            whole, sheared if sheared.pose_set.shear else whole, index, goal, seed=self.seed,
            tolerance=self.tolerance, stopped=stopped, progress=progress, tiles=tiles, earlier=earlier,
        )  # fmt: skip
        return replace(work.run(), problems=platform_problems())

    def pictures(self, index: int, pose: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Return [H, W, 3] pictures of A and B at parameter values [d] of a frame's set."""
        frame = self.frame(index)
        first, second = (assemble(f.render(np.array(pose)), frame.camera)[..., :3] for f in frame.both)
        return first, second

    @property
    def plan(self) -> tuple[str, ...]:
        return (*(f"A: {line}" for line in self.method.plan), *(f"B: {line}" for line in self.other.method.plan))

    @property
    def background_choice(self) -> Assumption | None:
        """Assumption that B has A's background, if B's file states none; else None."""
        return next((entry for entry in self.other._scene_choices if entry.origin == _BACKGROUND_OF_A), None)

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        others = (replace(entry, name=f"other {entry.name}") for entry in self.other._scene_choices)
        return (*self._scene_choices, *others, self.frame_choice, *self.order_choice, *self.set_choices)

    @property
    def fingerprint(self) -> dict[str, Any]:
        return {**super().fingerprint, "other": self.other.method.fingerprint}

    def describe(self) -> dict[str, Any]:
        first, second = super().describe(), self.other.method.describe()
        alone = [about["bounded"] for about in (first, second) if "bounded" in about]
        return {**first, "other": second, **({"bounded": alone[0]} if alone else {})}


@contextmanager
def _named(other: Scene) -> Iterator[None]:
    """Return a context that adds B's file to any InputError raised inside."""
    try:
        yield
    except InputError as error:
        raise error.within(other.source.file) from None


def _check_comparable(scene: Scene, other: Scene, pose_sets: Sequence[PoseBox]) -> None:
    """Raise InputError, with the fix, if the two scenes or the sets cannot be compared."""
    if scene.rays != other.rays:
        raise InputError(
            "a NeRF and a splat scene have no common bounds",
            file=other.source.file,
            field="--other",
            fix="compare two runs of one method",
        )
    if any(poses.perturbation.scene for poses in pose_sets):
        raise InputError(
            "varies the scene, and two scenes are compared", field="scene", fix="remove the key; poses may vary"
        )
    first, second = scene.run_frame, other.run_frame
    if first is None or second is None:
        return
    if not _same_frame(first, second):
        raise InputError(
            f"its dataparser_transforms.json is not that of {scene.source.file}, so one camera would not look at the "
            "same place",
            file=other.source.file,
            field="--other",
            fix="train it with the same data and the dataparser's same options, or export it in A's frame",
        )


def _same_frame(first: DataparserTransform, second: DataparserTransform) -> bool:
    """Return whether two runs scale, turn and shift the data set equally, up to `_TUNING.same_frame`."""
    turns, shifts = zip(*((f.matrix[:, :3] * f.scale, f.matrix[:, 3] * f.scale) for f in (first, second)), strict=True)
    # of a data set far from its origin the shift is long beside rotation and scale, which have a tolerance of their own
    sizes = first.scale, float(np.abs(turns[0]).max()), max(first.scale, float(np.abs(shifts[0]).max()))
    changes = abs(first.scale - second.scale), np.abs(turns[0] - turns[1]).max(), np.abs(shifts[0] - shifts[1]).max()
    return all(change <= _TUNING.same_frame * size for change, size in zip(changes, sizes, strict=True))


def _frame_choice(scene: Scene, other: Scene) -> Assumption:
    """Return the assumption that scenes A and B share one world frame: equal transforms, or the default."""
    if scene.run_frame is not None and other.run_frame is not None:
        return Assumption("frame of the other scene", "A's", "equal dataparser_transforms.json")
    without = [name for name, s in (("A", scene), ("B", other)) if s.run_frame is None]
    return Assumption("frame of the other scene", "A's", f"{DEFAULT}: the file of {' and '.join(without)} states none")


def open_comparison(settings: Settings, other: SceneSource, tolerance: float | None = None) -> ComparisonJob:
    """Open the files of a command line.

    ``other``: B. ``tolerance``: see `ComparisonJob`. Raises InputError where a file, a field or an option cannot be
    used.
    """
    scene, second = settings.scene.open(), other.open()
    # a run of a NeRF always says what is behind it
    if not second.rays and second.background is None and scene.background is not None:
        second = second.on_background(scene.background, _BACKGROUND_OF_A)
    data_frame = second.data_frame if scene.data_frame is None else scene.data_frame
    path = load_camera_path(settings.camera_path_filename, settings.downscale_factor, data_frame)
    pose_sets = path_sets(settings, scene, path)
    options = settings.job_options(pose_sets, path)
    return ComparisonJob(scene, second, pose_sets, tolerance=tolerance, path=path, **options)


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(ArrayRecord):
    """Bounds of the absolute difference of two scenes' pictures over a set of poses.

    Attributes:
        difference_upper: [H, W, 3] float32: no pose of the set has a larger difference at this pixel and channel.
        difference_lower: [H, W, 3] float32: some rendered pose has a difference as large.
        largest_upper, largest_lower: The largest of each over pixels and channels.
        mean_upper, mean_lower: The mean of each.
        worst_pose: [d] parameter values of the largest rendered difference.
        worst_difference: That difference.
        verdict: With a tolerance: "certified" (no picture differs by more), "falsified" (one does: ``worst_pose``) or
            "unknown".
        parameters: Names, units and ranges of what varies.
        guarantee: As in `ns_abstract.BoundResult`, of each scene's pictures.
        seconds, cell_count: Time spent, and cells bounded.
        bounded: False while no bound but 1 is known.
        interrupted: Whether the work was ended by Ctrl-C or by ``on_progress``.
    """

    difference_upper: np.ndarray
    difference_lower: np.ndarray
    largest_upper: float
    largest_lower: float
    mean_upper: float
    mean_lower: float
    worst_pose: np.ndarray
    worst_difference: float
    verdict: str | None
    parameters: ParameterBox
    guarantee: str
    seconds: float
    cell_count: int
    bounded: bool
    interrupted: bool
    assumptions: tuple[Assumption, ...] = field(default=(), repr=False)


def compare(
    scene: Scene,
    other_scene: Scene,
    poses: PoseSet | PinholeCamera,
    *,
    tolerance: float | None = None,
    target_ratio: float = 1.05,
    time_budget: float = 60.0,
    arithmetic: str | None = None,
    on_progress: OnProgress | None = None,
    seed: int = 0,
    memory_limit: float | None = None,
    workers: int = 1,
) -> Comparison:
    """Bound how far apart pictures of two scenes are at one pose, for every pose of a set; sound whenever it ends.

    Args:
        scene: A, in whose frame the camera is given.
        other_scene: B, in the same frame.
        poses: The set; a camera is the set of its one pose.
        tolerance: Difference of which is asked whether any picture exceeds it; the work ends once that is decided.
        target_ratio: The work is done when largest and mean bounds are at most this many times those of renders.
        time_budget: Seconds, compiling at first use not counted.
        arithmetic: As in `ns_abstract.bound`.
        on_progress: Told between cells; ``mpg`` and ``mpg_witness`` of what it is told are the largest bound and the
            largest difference rendered.
        seed: Of the random pictures that are rendered.
        memory_limit: GiB; None: 80 % of what is free.
        workers: NeRF: processes that bound rays.

    Raises:
        InputError: An argument cannot be used, or the scenes are in different frames.
        KeyboardInterrupt: Ctrl-C came before the first render, or twice.
    """
    check_comparison(tolerance, target_ratio, positive(time_budget, "time_budget"), prefix="")
    workers_of(workers)
    whole(seed, 0, "seed")
    job = ComparisonJob(
        checked_scene(scene), checked_scene(other_scene), [pose_set(poses).of(scene)], tolerance=tolerance,
        arithmetic=arithmetic, seed=seed,
        memory_limit=memory_limit, workers=workers,
    )  # fmt: skip
    result, guarantee, interrupted = bound_alone(job, time_budget, on_progress, target_ratio)
    assert result.largest is not None
    return Comparison(
        result.upper,
        result.witness_upper,
        **difference_figures(result),
        worst_pose=np.array(result.largest.pose),
        worst_difference=result.largest.value,
        verdict=None if tolerance is None else verdict(result, tolerance, guarantee),
        parameters=result.box,
        guarantee=short_guarantee(guarantee, job.describe().get("bounded")),
        seconds=result.seconds,
        cell_count=result.cells,
        bounded=result.bounded,
        interrupted=interrupted,
        assumptions=job.assumptions,
    )


def check_comparison(tolerance: float | None, target_ratio: float, budget: float | None, prefix: str = "--") -> None:
    """Raise InputError if a number is out of range; options are named with ``prefix``."""

    def name(word: str) -> str:
        return f"--{word}".replace("_", "-") if prefix else word

    if tolerance is not None and not 0.0 <= float64_of(tolerance) <= 1.0:
        raise unusable(tolerance, field=name("tolerance"), fix="give a number from 0 to 1")
    if budget is not None:
        positive(budget, name("time_budget"))
    at_least(target_ratio, 1.0, name("target_ratio"))
