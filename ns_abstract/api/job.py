"""A scene with its sets of poses, ready to be bounded frame by frame."""

from __future__ import annotations

import hashlib
import math
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from ns_abstract.api.assumptions import scene_choices
from ns_abstract.api.assumptions import set_choices as object_choices
from ns_abstract.api.scenes import Scene
from ns_abstract.arithmetic.kernel_cache import store as kernels
from ns_abstract.arithmetic.selfcheck import platform_problems
from ns_abstract.execution.cancellation import WorkCancelledError, cancel_when
from ns_abstract.execution.threads import most_threads
from ns_abstract.execution.worker_cache import Recipe, built
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.io.memory import allowed_memory
from ns_abstract.io.version import computed_by
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.perturbation.variations import SceneVariation
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.refine.protocol import CountedFrame, Frame, Method, SubBoxFrame
from ns_abstract.refine.result import EXTRA_OUTPUTS, FrameResult, PartResult, TracePoint, joined
from ns_abstract.report.figures import ShownUnits, number

#: Radians of a rotation beyond which a set asks whether degrees were meant.
_WIDE_TURN = 0.5
#: Bytes for leaves below which nothing can be done.
_LEAST_LEAF_BYTES = 64 << 20
#: Seconds that the ray with which kernels are compiled may take from one kernel to the next.
_WARM_RAY = 2.0
#: Functions of the kernels of bounds over sub-boxes, about, and the seconds that one core compiles.
_SUB_BOX_KERNELS = 114, 17.0
#: Rays that are rendered to see what a picture takes.
_LOOK_RAYS = 128


class Job:
    """A scene and its frames' sets of poses.

    Args:
        arithmetic: "float32" or "real"; None: the strongest that the scene has.
        memory_limit: GiB; None: 80 % of what is free.
        workers: Processes that one frame may use, where pictures are made ray by ray.
        layers: What is bounded beside the colours, of `ns_abstract.refine.result.EXTRA_OUTPUTS`.
        notes: What reports say of the files of the sets, one sentence each.
        set_choices: Where the size of the pictures and their sets come from; None: from the caller's objects.

    Raises:
        InputError: The scene has no such layers, does not vary as asked, or the memory does not do.
    """

    def __init__(
        self,
        scene: Scene,
        pose_sets: Sequence[PoseBox],
        *,
        arithmetic: str | None = None,
        seed: int = 0,
        memory_limit: float | None = None,
        workers: int = 1,
        layers: Sequence[str] = (),
        notes: Sequence[str] = (),
        set_choices: Sequence[Assumption] | None = None,
    ) -> None:
        self.layers = tuple(name for name in EXTRA_OUTPUTS if name in layers)
        if unknown := [name for name in layers if name not in EXTRA_OUTPUTS]:
            raise InputError(f"found {unknown[0]}", field="--outputs", fix=f"use rgb, {', '.join(EXTRA_OUTPUTS)}")
        self.source, self.rays = scene.source, scene.rays
        #: what was asked for; None: the strongest that the scene has
        self.arithmetic = arithmetic
        self.method: Method = scene.method(arithmetic, workers)
        self.pose_sets, self.seed, self.memory_limit = tuple(pose_sets), seed, memory_limit
        self.workers = workers if scene.rays else 1
        #: what is legal and hardly meant, one sentence each
        self.warnings = (
            *_wide_turns([poses.perturbation for poses in self.pose_sets]),
            *_tiny_pictures([poses.camera for poses in self.pose_sets]),
        )
        self.notes = (*notes, *self.warnings)
        self._scene_choices = scene_choices(scene, self.method, arithmetic)
        if set_choices is None:
            set_choices = object_choices(self.pose_sets, "the camera", "the set of poses")
        self.set_choices = tuple(set_choices)
        self._warm: set[int] = set()
        self.method.prepare([poses.perturbation for poses in self.pose_sets])
        if self.layers:
            # refused before hours of work
            self.frame(0)
        self._check_memory()

    @property
    def frame_count(self) -> int:
        return len(self.pose_sets)

    @property
    def recipe(self) -> Recipe[Job]:
        """Recipe by which another process opens this job, from files under the same paths."""
        again = partial(
            built, Job, (self.source.absolute.open,), self.pose_sets, arithmetic=self.arithmetic, seed=self.seed,
            memory_limit=self.memory_limit, layers=self.layers,
        )  # fmt: skip
        return Recipe(again, self.fingerprint, self.source.file)

    @property
    def continues(self) -> bool:
        """Whether stored bounds of a frame are continued; otherwise its whole set is bounded anew."""
        return self.rays

    @property
    def parameters(self) -> list[tuple[str, str]]:
        """Names and units of all frames' parameters, in the order of boxes."""
        units: dict[str, str] = {}
        for poses in sorted(self.pose_sets, key=lambda p: -p.box.dimensions):
            units |= {n: u for n, u in zip(poses.box.names, poses.box.units, strict=True) if n not in units}
        return list(units.items())

    @property
    def fixed(self) -> dict[int, dict[str, float]]:
        """Values of parameters that do not vary, by frame."""
        return {k: dict(poses.fixed) for k, poses in enumerate(self.pose_sets)}

    # ---------------------------------------------------------------- memory

    @property
    def memory(self) -> int:
        """Bytes this job may use."""
        return allowed_memory(self.memory_limit)

    def base_memory(self, processes: int = 1) -> int:
        """Return bytes that each of ``processes`` on one machine, which share its threads, needs beside the leaves."""
        pixels = max(poses.camera.width * poses.camera.height for poses in self.pose_sets)
        return self.method.memory(pixels, max(1, most_threads() // processes))

    def varied(self, index: int, extra: SceneVariation) -> PoseBox:
        """Return the set of frame ``index`` with the variation ``extra`` of the scene added."""
        poses = self.pose_sets[index]
        return replace(poses, perturbation=replace(poses.perturbation, scene=(*poses.perturbation.scene, extra)))

    def _check_memory(self) -> None:
        needed = self.base_memory()
        if needed > self.memory:
            raise InputError(
                f"{self.method.content} at this size needs {needed / 2**30:.2g} GiB, "
                f"{self.memory / 2**30:.2g} GiB may be used",
                field="--memory-limit",
                fix="raise it, or ask for smaller pictures",
            )

    def leaf_bytes(self, processes: int) -> int:
        """Return bytes for the leaves that ``processes`` on one machine may have together."""
        return max(processes * _LEAST_LEAF_BYTES, (self.memory - processes * self.base_memory(processes)) // 2)

    # ---------------------------------------------------------------- frames

    def goal(self, ratio: float, seconds: float, cells: int | None = None) -> RefinementGoal:
        """Return a goal of refinement whose leaves may take the remaining memory."""
        return RefinementGoal(ratio, seconds, cells, self.leaf_bytes(1))

    def frame(self, index: int, sheared: bool = False) -> Frame:
        """Return the frame ``index``, ready for refinement; see `Method.frame`."""
        return self.method.frame(self.pose_sets[index], sheared, bool(self.layers))

    def warm_up(self, index: int) -> None:
        """Compile the kernels that frame ``index`` needs, so that its clock measures bounding alone."""
        if index not in self._warm:
            warm_up(self.frame(index))
            self._warm.add(index)

    def check_time(self, index: int, seconds: float) -> None:
        """Refuse a frame of which not even one picture can be rendered in ``seconds``, where rays are costly.

        Raises:
            InputError: What it would take.
        """
        if not self.rays:
            return
        frame = self.frame(index)
        some = np.unique(np.linspace(0, frame.tile_count - 1, _LOOK_RAYS).astype(np.int64))
        begin = time.perf_counter()
        with suppress(WorkCancelledError), cancel_when(lambda: time.perf_counter() - begin > seconds):
            frame.render(frame.box.middle, some)
        least = (time.perf_counter() - begin) / some.size * frame.tile_count
        if least > seconds:
            camera = frame.camera
            raise InputError(
                f"{self.method.content}: one picture of {camera.width} x {camera.height} pixels takes about "
                f"{least:,.1f} s to render, {seconds:,.1f} s given",
                file=self.source.file,
                field="--time-budget",
                fix="give more, raise --downscale-factor, or take fewer samples",
            )

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
        """Refine some tiles of frame ``index``, or all of them; ``earlier`` is what was found of it before.

        Raises:
            WorkCancelledError: ``stopped`` was true, or the time was over, before a first picture was there.
        """
        # kept leaves are boxes of the set's parameters
        frame = self.frame(index, sheared=not keep_leaves)
        begin = time.perf_counter()

        def over() -> bool:
            # what is rendered first does not count for the goal, and may take long where every ray is costly
            return stopped() or (self.rays and time.perf_counter() - begin >= goal.seconds)

        refinement = Refinement(
            frame, index, replace(goal, keep_leaves=keep_leaves), seed=self.seed, stopped=over, progress=progress,
            scene_samples=frame.scene_samples(self.seed), tiles=tiles, earlier=earlier,
        )  # fmt: skip
        return replace(refinement.run_part(), problems=platform_problems())

    def joined(self, parts: Sequence[PartResult]) -> FrameResult:
        """Return the frame that parts make up, with the sentences on what was left out for it.

        Raises:
            ValueError: Tiles are missing or there twice.
        """
        frame = self.frame(parts[0].index)
        result = replace(joined(parts, frame.camera), box=self.pose_sets[parts[0].index].box)
        visible_sets = [part.shown for part in parts]
        visible_numbers = [numbers for numbers in visible_sets if numbers is not None]
        count = (
            int(np.unique(np.concatenate(visible_numbers)).size) if len(visible_numbers) == len(visible_sets) else None
        )
        plan = frame.plan(count, result.lower, result.upper)
        floor = max(part.floor for part in parts)
        if floor > 0.0:
            plan.append(
                f"faint Gaussians: those that contribute at most {floor:.2%} of a pixel are left out of the first "
                "cells, and the range of their colours is added to the bounds"
            )
        if len(parts) > 1:
            plan.append(
                f"bounded in {len(parts)} groups of tiles side by side: cells are the sum of theirs, seconds those of "
                "the slowest"
            )
        layers = {name: result.layers[name] for name in self.layers}
        return replace(result, plan=tuple(plan), layers=layers)

    # ---------------------------------------------------------------- reports

    @property
    def plan(self) -> tuple[str, ...]:
        """Sentences on computations that are left out for this scene, in every frame."""
        return self.method.plan

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """What the bounds rest on, and where each choice came from."""
        return (*self._scene_choices, *self.set_choices)

    @property
    def fingerprint(self) -> dict[str, Any]:
        """Identity of scene, program and sets; a stored result with another one is not continued."""
        return self._fingerprint

    @cached_property
    def _fingerprint(self) -> dict[str, Any]:
        sets = hashlib.sha256()
        for poses in self.pose_sets:
            camera = poses.camera
            sets.update(np.ascontiguousarray(camera.camera_to_world).tobytes())
            sets.update(repr((camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)).encode())
            sets.update(repr((poses.perturbation, poses.box, sorted(poses.fixed.items()))).encode())
            if poses.target_camera is not None:
                sets.update(np.ascontiguousarray(poses.target_camera.camera_to_world).tobytes())
            if poses.perturbation.scene:
                sets.update(repr(poses.perturbation.scene).encode())
        more = {"outputs": list(self.layers)} if self.layers else {}
        return {**computed_by(), **self.method.fingerprint, **more, "poses": sets.hexdigest()}

    def describe(self) -> dict[str, Any]:
        """Return a record of the scene for reports, with the units that its sets were stated in."""
        about, first = self.method.describe(), self.pose_sets[0].perturbation
        units = ShownUnits(first.units, first.angle_units, self.method.dataset_scale or 1.0)
        notes = [*about.get("notes", ()), *self.notes]
        return {**about, "units": asdict(units), **({"notes": notes} if self.notes else {})}


def _wide_turns(sets: Sequence[Perturbation]) -> Iterator[str]:
    """Return a sentence on rotations stated in radians that are wide enough to have been meant in degrees, or none."""
    widest: dict[str, float] = {}
    for entry in sets:
        for name, ends in entry.rotation.items() if entry.angle_units == "radians" else ():
            widest[name] = max(widest.get(name, 0.0), *map(abs, ends))
    wide = {name: most for name, most in widest.items() if most > _WIDE_TURN}
    if wide:
        most = max(wide.values())
        yield (
            f"the set turns by up to {number(math.degrees(most))} degrees ({number(most)} rad) in {', '.join(wide)}; "
            'if degrees were meant: --angle-units degrees, in a file "angle_units": "degrees"'
        )


def _tiny_pictures(cameras: Sequence[PinholeCamera]) -> Iterator[str]:
    """Return a sentence on pictures of one pixel, or none."""
    count = sum(camera.width * camera.height == 1 for camera in cameras)
    if count:
        frames = f"the picture of {count} of {len(cameras)} frames"
        yield f"{frames} is 1 x 1 pixel; check the path's size and --downscale-factor"


def require_sound_platform() -> None:
    """Refuse to certify in a process whose elementary functions err by more than bounds are charged.

    Raises:
        InputError: What the self-check found, and on which machine.
    """
    if problems := platform_problems():
        raise InputError(
            f"the platform's arithmetic failed the self-check on {socket.gethostname()} ({problems[0]})",
            fix="nothing can be certified there; use another machine",
        )


def warm_up(frame: Frame) -> None:
    """Compile the kernels that a frame needs; where one ray takes long, it is given up once they are compiled."""
    begin, compiled = time.perf_counter(), frame.compiled if isinstance(frame, CountedFrame) else (0, 0.0)
    with (
        kernels().expecting(*compiled),
        suppress(WorkCancelledError),
        cancel_when(lambda: frame.tilewise and time.perf_counter() - max(begin, kernels().latest) > _WARM_RAY),
    ):
        frame.warm_up()


def warm_up_sub_boxes(frame: SubBoxFrame) -> None:
    """Compile the kernels that bounds over sub-boxes need besides those of `warm_up`."""
    from ns_abstract.verify import motion_boxes

    with kernels().expecting(*_SUB_BOX_KERNELS):
        frame.warm_up_sub_boxes()
        motion_boxes.warm_up()


def check_frames(frames: Sequence[int] | None, count: int) -> tuple[int, ...]:
    """Return frames asked for, each once, in order. Raises InputError where a number is not an entry of the path."""
    if not frames:
        return tuple(range(count))
    for frame in frames:
        if not 0 <= frame < count:
            raise InputError(f"found {frame}", field="--frames", fix=f"the camera path has entries 0 to {count - 1}")
    return tuple(sorted(set(frames)))
