"""Abstract images: `bound`, its result, and the frames of a path one after the other or side by side."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ns_abstract.api.abstract_image import BoundResult
from ns_abstract.api.job import Job
from ns_abstract.api.poses import PoseSet, pose_set
from ns_abstract.api.scenes import Scene, checked_scene
from ns_abstract.arithmetic.kernel_cache import store as kernels
from ns_abstract.execution.cancellation import Deadline, WorkCancelledError
from ns_abstract.execution.engines import Engine, SerialEngine
from ns_abstract.execution.scheduler import Task, work
from ns_abstract.execution.stopping import StopRequest, interruptible
from ns_abstract.execution.threads import use_threads
from ns_abstract.execution.worker_cache import Recipe, load
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.io.arguments import at_least, callback, flag, positive, whole, workers_of
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import unusable
from ns_abstract.refine.engine import RefinementGoal, groups, shared_goal
from ns_abstract.refine.result import FrameResult, PartResult, TracePoint
from ns_abstract.report.figures import short_guarantee

#: Shortest time that a frame is given once it is begun.
LEAST_SECONDS = 0.01
#: Groups of tiles by thread of an engine: their costs differ.
_GROUPS_BY_THREAD = 2


@dataclass(frozen=True)
class Progress:
    """The progress of the work on a frame.

    Attributes:
        frame: Number of the frame.
        frames_done: Frames finished before it.
        seconds: Time spent on it.
        budget: Time that it may take.
        cells: Cells bounded.
        covered: Part of the first cover that is done; nothing but [0, 1] is known below 1.
        mpg, mpg_witness: Mean pixel gap of the bounds and of what was really rendered.
        frames: Frames of the whole work.
        target_ratio: Where a frame is done.
        elapsed, total_budget: Seconds spent on all frames, and seconds that they may take together.
    """

    frame: int
    frames_done: int
    seconds: float
    budget: float
    cells: int
    covered: float
    mpg: float
    mpg_witness: float
    frames: int = 1
    target_ratio: float = 1.05
    elapsed: float = 0.0
    total_budget: float = math.inf

    @property
    def ratio(self) -> float:
        """How loose the bounds can be at most."""
        return self.mpg / self.mpg_witness if self.mpg_witness > 0.0 else float("inf")

    @property
    def done(self) -> float:
        """Part of the work that is done: frames, and of the current one the part of its time to target or budget."""
        left = max(0.0, self.budget - self.seconds)
        goal = self.target_ratio - 1.0
        if self.covered >= 1.0 and goal > 0.0:
            # ratio - 1 falls about in proportion to 1 / time
            left = min(left, self.seconds * max(0.0, (self.ratio - 1.0) / goal - 1.0))
        part = self.seconds / (self.seconds + left) if self.seconds > 0.0 else 0.0
        return min(1.0, (self.frames_done + part) / max(1, self.frames))

    @property
    def sentence(self) -> str:
        """What is known of the current frame."""
        if self.covered < 1.0:
            return f"frame {self.frame}: covering the set, {self.covered:.0%}"
        return f"frame {self.frame}: ratio to real renders {self.ratio:.3f}, target {self.target_ratio:g}"


#: Told where the work stands; returning False ends it with what is known.
OnProgress = Callable[[Progress], object]


class TileTask(NamedTuple):
    """One task; ``tiles``: numbers of its tiles; None: all."""

    index: int
    tiles: np.ndarray | None


def bound_part(
    recipe: Recipe[Job],
    part: TileTask,
    goal: RefinementGoal,
    keep_leaves: bool,
    neighbours: int = 1,
    earlier: FrameResult | None = None,
) -> PartResult | None:
    """Bound one part of a frame on a worker, which keeps the scene open; None if the time ended before any result.

    ``neighbours``: tasks that share this machine's cores. ``earlier``: what was found of the frame before, where that
    saves work. Raises InputError where the worker reads other files under the same names than the command did.
    """
    use_threads(len(os.sched_getaffinity(0)) // neighbours)
    job = load(recipe)
    job.warm_up(part.index)
    try:
        return job.bound_part(part.index, goal, part.tiles, keep_leaves=keep_leaves, earlier=earlier)
    except WorkCancelledError:
        return None


def local_workers(job: Job) -> int:
    """Return the number of cluster processes for this machine: as many as there are cores and fit into its memory."""
    cores = len(os.sched_getaffinity(0))
    return next((n for n in range(cores, 1, -1) if 2 * n * job.base_memory(n) <= job.memory), 1)


def bound_frames(
    job: Job,
    frames: Sequence[int],
    *,
    engine: Engine,
    budget: float,
    target_ratio: float = 1.05,
    keep_leaves: bool = False,
    stop: StopRequest | None = None,
    on_progress: Callable[[Progress], object] = lambda progress: None,
    found_before: Callable[[int], FrameResult | None] = lambda index: None,
) -> Iterator[FrameResult]:
    """Yield the results of frames as they are finished, each once, whatever workers come and go.

    Where the engine has more threads than there are frames, each frame is divided into groups of tiles, and is there
    when all its groups are. What a task leaves of the time budget is shared by those that are still to be begun; the
    first frame is always begun, and a frame that is begun is finished.

    Args:
        budget: Seconds for all of them, compiling at first use not counted.
        stop: Asked between cells in this process, and twice a second while others work.
        found_before: Gives what an earlier command found of a frame. Rays go on from there, those first of which least
            is known.

    Raises:
        InputError: The scene does not fit into the memory as often as there are workers on a machine, or the time does
            not do for one picture.
    """
    if not frames:
        engine.close()
        return
    request = StopRequest() if stop is None else stop
    schedule = _FrameSchedule(job, frames, engine, target_ratio, keep_leaves, request, on_progress, found_before)
    schedule.begin(budget)
    for results in work(engine, schedule.offer, request):
        for (_, index), result in results:
            if result is None:
                return
            frame = schedule.take(index, result)
            if frame is not None:
                yield frame


@dataclass
class _FrameSchedule:
    """The parts of frames that are still to be bounded, and the results of frames of which parts are missing.

    Attributes:
        job, engine, target_ratio, keep_leaves, on_progress, found_before: As `bound_frames` has them.
    """

    job: Job
    frames: Sequence[int]
    engine: Engine
    target_ratio: float
    keep_leaves: bool
    request: StopRequest
    on_progress: Callable[[Progress], object]
    found_before: Callable[[int], FrameResult | None]
    budget: float = math.inf
    deadline: Deadline = field(default_factory=Deadline)
    goals: dict[int, RefinementGoal] = field(default_factory=dict)

    def __post_init__(self) -> None:
        threads, machine = self.engine.threads, self.engine.machine()
        self._neighbours = machine.threads
        self._leaf_bytes = _leaf_bytes(self.job, machine.processes) // machine.threads
        count = -(-_GROUPS_BY_THREAD * threads // len(self.frames)) if threads > len(self.frames) else 1
        self._queue = [
            TileTask(index, tiles)
            for index in self.frames
            for tiles in ([None] if count == 1 else groups(self.job.frame(index), count))
        ]
        self._expected = Counter(part.index for part in self._queue)
        self._parts: dict[int, list[PartResult]] = {}
        self._flying = self._done = self._number = 0

    def begin(self, budget: float) -> None:
        """Start the clock: ``budget`` seconds, in which this process has no kernel to compile."""
        self.budget, self.deadline = budget, Deadline(budget)
        if self.engine.shares:
            with self.request.at_once():
                compiled = kernels().compiled
                self.job.warm_up(self.frames[0])
                if kernels().compiled > compiled:
                    self.deadline = Deadline(budget)
                # a look at costly rays is part of the work
                self.job.check_time(self.frames[0], budget)

    def offer(self, room: int) -> Iterator[Task]:
        """Yield up to ``room`` tasks, no more than can be worked on, so that later ones know how much time is left."""
        threads = self.engine.threads
        while self._queue and self._flying < threads:
            left = self.deadline.left
            if left <= 0.0 and self.goals and self._queue[0].index not in self.goals:
                self._queue.clear()
                return
            part = self._queue.pop(0)
            if part.index not in self.goals:
                self.goals[part.index] = _goal(self.job, part, self.target_ratio, self._leaf_bytes)
            share = max(LEAST_SECONDS, left / -(-(len(self._queue) + 1) // threads))
            goal = replace(self.goals[part.index], seconds=share)
            self._flying, self._number = self._flying + 1, self._number + 1
            key = (self._number, part.index)
            if self.engine.shares:
                yield Task(key, self._bound_here, (part, goal))
            else:
                before = self._known(part.index)
                arguments = (self.job.recipe, part, goal, self.keep_leaves, self._neighbours, before)
                yield Task(key, bound_part, arguments)

    def take(self, index: int, result: PartResult) -> FrameResult | None:
        """Return the result of a frame if this was the last of its parts."""
        self._flying -= 1
        parts = self._parts.setdefault(index, [])
        parts.append(result)
        if len(parts) < self._expected[index]:
            return None
        frame = self.job.joined(self._parts.pop(index))
        if not self.engine.shares and frame.trace:
            self._report(index, frame.seconds, frame.seconds, frame.trace[-1], frame.trace[-1].covered)
        self._done += 1
        return frame

    def _report(self, index: int, seconds: float, budget: float, point: TracePoint, covered: float) -> None:
        elapsed = self.budget - self.deadline.left
        self.on_progress(
            Progress(
                index, self._done, seconds, budget, point.cells, covered, point.mpg, point.mpg_witness,
                len(self.frames), self.target_ratio, elapsed, self.budget,
            )
        )  # fmt: skip

    def _known(self, index: int) -> FrameResult | None:
        # kept leaves are to be as tight as the result
        before = self.found_before(index) if self.job.continues and not self.keep_leaves else None
        return before if before is not None and before.bounded else None

    def _bound_here(self, part: TileTask, goal: RefinementGoal) -> PartResult | None:
        def report(point: TracePoint, covered: float) -> None:
            self._report(part.index, point.seconds, goal.seconds, point, covered)

        try:
            return self.job.bound_part(
                part.index, goal, part.tiles, keep_leaves=self.keep_leaves, stopped=self.request, progress=report,
                earlier=self._known(part.index),
            )  # fmt: skip
        except WorkCancelledError:
            # over before there was anything to keep
            return None


def _goal(job: Job, part: TileTask, target_ratio: float, leaf_bytes: int) -> RefinementGoal:
    goal = replace(job.goal(target_ratio, 0.0), leaf_bytes=leaf_bytes)
    return goal if part.tiles is None else shared_goal(job.frame(part.index), part.index, goal, job.seed)


def _leaf_bytes(job: Job, processes: int) -> int:
    """Return bytes for the leaves of all processes on one machine together."""
    needed = processes * job.base_memory(processes)
    if job.memory_limit is not None and needed > job.memory:
        raise InputError(
            f"{processes} workers on one machine need {needed / 2**30:.1f} GiB, "
            f"{job.memory / 2**30:.1f} GiB may be used",
            field="--memory-limit",
            fix="raise it, or start fewer workers",
        )
    return job.leaf_bytes(processes)


def bound(
    scene: Scene,
    poses: PoseSet | PinholeCamera,
    *,
    target_ratio: float = 1.05,
    time_budget: float = 60.0,
    arithmetic: str | None = None,
    keep_cells: bool = False,
    on_progress: OnProgress | None = None,
    seed: int = 0,
    memory_limit: float | None = None,
    workers: int = 1,
    outputs: Sequence[str] = ("rgb",),
) -> BoundResult:
    """Bound every picture that a scene shows over a set of poses; sound whenever it ends.

    Ctrl-C and ``on_progress`` returning False end the work between two cells, with what is known.

    Args:
        scene: The scene.
        poses: The set; a camera is the set of its one pose.
        target_ratio: The work is done when the mean gap is at most this many times the one of real renders.
        time_budget: Seconds, compiling at first use not counted.
        arithmetic: "float32": enclose every float32 evaluation of the renderer; "real": the real-number renderer and
            its float64 evaluation; None: float32 for splats, real for NeRFs.
        keep_cells: Whether to keep the linear sets of every cell.
        on_progress: Told after every cell of the first cover and after every round.
        seed: Of the random pictures that are rendered.
        memory_limit: GiB; None: 80 % of what is free.
        workers: NeRF: processes that bound rays. With more than one, a script needs ``if __name__ == "__main__":``.
        outputs: "rgb", which is always bounded, "depth" and "accumulation" (splats).

    Raises:
        InputError: An argument cannot be used.
        KeyboardInterrupt: Ctrl-C came before the first render, or twice.
    """
    positive(time_budget, "time_budget")
    at_least(target_ratio, 1.0, "target_ratio")
    workers_of(workers)
    whole(seed, 0, "seed")
    try:
        names = [outputs] if isinstance(outputs, str) else list(outputs)
    except TypeError:
        fix = 'give a list of "rgb", "depth" and "accumulation"'
        raise unusable(outputs, field="outputs", fix=fix) from None
    pose_box = pose_set(poses).of(checked_scene(scene))
    job = Job(
        scene, [pose_box], arithmetic=arithmetic, seed=seed, memory_limit=memory_limit, workers=workers,
        layers=[name for name in names if name != "rgb"],
    )  # fmt: skip
    result, guarantee, interrupted = bound_alone(
        job, time_budget, on_progress, target_ratio, flag(keep_cells, "keep_cells")
    )
    about = {
        "guarantee": guarantee,
        "renderer": job.method.program,
        "scene": job.describe(),
        "fingerprint": job.fingerprint,
    }
    told = short_guarantee(guarantee, about["scene"].get("bounded"))
    return BoundResult.of(
        result, guarantee=told, interrupted=interrupted, target_ratio=target_ratio, about=about,
        assumptions=job.assumptions,
    )  # fmt: skip


def bound_alone(
    job: Job, budget: float, on_progress: OnProgress | None, target_ratio: float, keep_leaves: bool = False
) -> tuple[FrameResult, str, bool]:
    """Return the result of a job's only frame, its guarantee, and whether Ctrl-C or ``on_progress`` ended the work.

    Raises:
        InputError: The time is over before the first render.
        KeyboardInterrupt: Ctrl-C came before it, or twice.
    """
    with interruptible() as stop:
        results = bound_frames(
            job, [0], engine=SerialEngine(), budget=budget, target_ratio=target_ratio, keep_leaves=keep_leaves,
            stop=stop, on_progress=listener(stop, on_progress),
        )  # fmt: skip
        frames = list(results)
    if not frames:
        if stop():
            raise KeyboardInterrupt
        raise InputError("over before one picture was rendered", field="time_budget", fix="give more")
    return frames[0], "sampled" if frames[0].problems else job.method.guarantee, stop()


def listener(stop: StopRequest, on_progress: Callable[[Any], object] | None) -> Callable[[Any], None]:
    """Return a function that calls ``on_progress``, and requests a stop if it returns False or is interrupted.

    Raises:
        InputError: It cannot be called.
    """
    callback(on_progress)

    def report(progress: Any) -> None:
        if on_progress is None:
            return
        try:
            if on_progress(progress) is False:
                stop.ask()
        except KeyboardInterrupt:
            stop.ask()

    return report
