"""From files to bounded frames: what the command lines share."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from ns_abstract.arithmetic.units import Arithmetic
from ns_abstract.errors import InputError
from ns_abstract.methods.load import load_any
from ns_abstract.methods.nerf.method import NerfMethod
from ns_abstract.methods.nerf.occupancy import load_grid
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.runs import available_memory
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.constants import Rasteriser
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.refine.engine import Goal, Refinement
from ns_abstract.refine.result import FrameResult, PartResult, TracePoint, joined
from ns_abstract.sets.path import CameraPath, load_camera_path
from ns_abstract.sets.perturbation import Perturbation, load_perturbation, parse_perturbation
from ns_abstract.sets.poses import PoseSet

#: Shortest time that a frame is given once it is begun.
LEAST_SECONDS = 0.01
#: Bytes for leaves below which nothing can be done.
_LEAST_LEAF_BYTES = 64 << 20


@dataclass(frozen=True)
class Settings:
    """What to bound, as the command line says it.

    Attributes:
        load_config: config.yml of a Splatfacto run, or a standard 3DGS .ply.
        camera_path_filename: Camera path JSON.
        perturbation_filename: Perturbation JSON; None: the camera path holds it.
        downscale_factor: Pictures become this many times smaller.
        renderer: "gsplat" or "paper"; None: what the method's own renderer is.
        arithmetic: "float32" or "real"; None: the strongest that the method has.
        seed: Of the random witnesses.
        memory_limit: GiB.
        resize: Height and width in pixels that pictures are rendered with, in place of the path's.
        workers: Processes that bound the rays of a NeRF.
        occupancy_grid: File of a grid that is declared as part of a NeRF.
        sampling, num_samples, near_plane: Of the rays of a NeRF; None: the method's own.
    """

    load_config: Path
    camera_path_filename: Path
    perturbation_filename: Path | None = None
    downscale_factor: float = 1.0
    renderer: str | None = None
    arithmetic: str | None = None
    seed: int = 0
    memory_limit: float | None = None
    resize: tuple[int, int] | None = None
    sampling: str | None = None
    num_samples: int | None = None
    near_plane: float | None = None
    occupancy_grid: Path | None = None
    workers: int = 1


SomeSettings = TypeVar("SomeSettings")


def with_whole_paths(settings: SomeSettings) -> SomeSettings:
    """The same dataclass for a process with another working directory."""
    record: Any = settings
    given = {field.name: getattr(record, field.name) for field in fields(record)}
    return replace(record, **{name: value.absolute() for name, value in given.items() if isinstance(value, Path)})


def check_content(found: dict[str, Any], expected: dict[str, Any], file: Path) -> None:
    """Refuse to work on other content than the command that asks for it.

    Raises:
        InputError: A worker reads other files under the same names.
    """
    if found != expected:
        raise InputError(
            "the worker finds other content than this machine",
            file=file,
            fix="give the workers the same files under the same paths",
        )


class Method(Protocol):
    """What the command lines need to know about a way to represent scenes: its scene and the bounded program."""

    scene: Any

    @property
    def program(self) -> dict[str, Any]:
        """``name`` and ``version`` of the bounded program, and what else tells it from others."""
        ...

    @property
    def guarantee(self) -> str:
        """What bounds of this program are called: "float32-sound" or "real-sound"."""
        ...

    @property
    def content(self) -> str:
        """The scene in a few words."""
        ...

    @property
    def plan(self) -> tuple[str, ...]:
        """What is left out for this scene, whatever the frame."""
        ...

    @property
    def fingerprint(self) -> dict[str, Any]:
        """Scene and program, for results that are continued."""
        ...

    def describe(self) -> dict[str, Any]:
        """The scene for reports; ``name`` is among the keys."""
        ...

    def prepare(self, perturbations: Sequence[Perturbation]) -> None:
        """Find out what the scene itself may do.

        Raises:
            InputError: Not with this scene.
        """
        ...

    def memory(self, pixels: int) -> int:
        """Bytes that bounding pictures of ``pixels`` needs beside the leaves."""
        ...

    def frame(self, poses: PoseSet, slanted: bool = False) -> Any:
        """One frame, ready for refinement (`ns_abstract.refine.engine.Frame`), with ``warm_up()``.

        ``slanted``: its box may count parameters otherwise than the set does, where that is tighter.
        """
        ...

    def frame_plan(self, frame: Any, shown: int | None, lower: np.ndarray, upper: np.ndarray) -> list[str]:
        """What was left out for one frame, given what refinement found."""
        ...


class Job:
    """An opened scene, camera path and set of poses.

    Args:
        settings: What to bound.
        perturbation: For every entry of the path, in place of what the files say.
        default: For entries of which the files say nothing; without it they are an error.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """

    def __init__(
        self, settings: Settings, perturbation: Perturbation | None = None, default: Perturbation | None = None
    ) -> None:
        self.settings = settings
        self.path: CameraPath = load_camera_path(settings.camera_path_filename, settings.downscale_factor)
        if settings.resize is not None:
            self.path = replace(self.path, cameras=tuple(c.resized(*settings.resize) for c in self.path.cameras))
        self.method = open_method(settings)
        self.scene = self.method.scene
        given = (perturbation,) * self.frame_count if perturbation is not None else None
        self.perturbations: tuple[Perturbation, ...] = given or self._perturbations(default)
        # a set that cannot be made is found before hours of work
        self.pose_sets = tuple(self.pose_set(k, p) for k, p in enumerate(self.perturbations))
        try:
            self.method.prepare(self.perturbations)
        except InputError as error:
            raise error.within(settings.perturbation_filename or self.path.source) from None
        self._check_memory()

    @property
    def splat(self) -> SplatMethod:
        """The method of a splat scene.

        Raises:
            InputError: The run is of another method.
        """
        if not isinstance(self.method, SplatMethod):
            raise InputError("not a splat scene", file=self.settings.load_config, fix="give a run of splatfacto")
        return self.method

    @property
    def splats(self) -> Splats:
        """The activated scene of a splat."""
        return self.splat.splats

    @property
    def rasteriser(self) -> Rasteriser:
        """The rules that a splat is drawn by."""
        return self.splat.rasteriser

    @property
    def arithmetic(self) -> Arithmetic:
        """What a splat's bounded program computes with."""
        return self.splat.arithmetic

    @property
    def frame_count(self) -> int:
        """Entries of the camera path."""
        return len(self.path.cameras)

    def _perturbations(self, default: Perturbation | None) -> tuple[Perturbation, ...]:
        scale = self.scene.dataparser.scale
        file = self.settings.perturbation_filename
        count = len(self.path.cameras)
        if file is not None:
            return (load_perturbation(file, dataset_scale=scale),) * count
        found, folder = [], Path(self.path.source).parent
        for k in range(count):
            value = self.path.perturbation_of(k)
            if value is None and default is not None:
                found.append(default)
                continue
            if value is None:
                raise InputError(
                    f"no perturbation for entry {k}",
                    file=self.path.source,
                    field="perturbation",
                    fix='add the key "perturbation" or give --perturbation-filename',
                )
            prefix = "perturbation." if self.path.overrides[k] is None else f"camera_path[{k}].perturbation."
            try:
                found.append(parse_perturbation(value, dataset_scale=scale, field_prefix=prefix, folder=folder))
            except InputError as error:
                raise error.within(self.path.source) from None
        return tuple(found)

    def pose_set(self, index: int, perturbation: Perturbation) -> PoseSet:
        """The poses of ``perturbation`` around entry ``index`` of the path.

        Raises:
            InputError: The path cannot be swept as asked.
        """
        try:
            return PoseSet.around(self.path.cameras[index], perturbation, self.path.following(index))
        except InputError as error:
            raise error.within(self.path.source) from None

    @property
    def memory(self) -> int:
        """Bytes this job may use."""
        limit = self.settings.memory_limit
        if limit is not None:
            return int(limit * 2**30)
        free = available_memory()
        return int(0.8 * free) if free is not None else 8 << 30

    @property
    def base_memory(self) -> int:
        """Bytes that a process needs beside the leaves."""
        return self.method.memory(max(camera.width * camera.height for camera in self.path.cameras))

    def _check_memory(self) -> None:
        limit = self.settings.memory_limit
        if limit is not None and not 0.0 < limit < float("inf"):
            raise InputError(f"found {limit}", field="--memory-limit", fix="give a positive number of GiB")
        if self.base_memory > self.memory:
            raise InputError(
                f"{self.method.content} at this size needs {self.base_memory / 2**30:.1f} GiB, "
                f"{self.memory / 2**30:.1f} GiB may be used",
                field="--memory-limit",
                fix="raise it, or raise --downscale-factor",
            )

    def goal(self, ratio: float, seconds: float, cells: int | None = None) -> Goal:
        """The goal with the memory that is left for leaves."""
        return Goal(ratio, seconds, cells, self.leaf_bytes(1))

    def leaf_bytes(self, processes: int) -> int:
        """Bytes for the leaves that ``processes`` on one machine may have together."""
        return max(processes * _LEAST_LEAF_BYTES, (self.memory - processes * self.base_memory) // 2)

    def frame(self, index: int, slanted: bool = False) -> Any:
        """Frame ``index``, ready for refinement; see `Method.frame`."""
        return self.method.frame(self.pose_sets[index], slanted)

    def warm_up(self, index: int | None) -> None:
        """Compile the kernels that frame ``index`` needs, so that its clock measures bounding alone."""
        if index is None:
            return
        self.frame(index).warm_up()

    def bound(
        self,
        index: int,
        goal: Goal,
        *,
        keep_leaves: bool = False,
        stopped: Callable[[], bool] = lambda: False,
        progress: Callable[[TracePoint, float], None] = lambda point, share: None,
    ) -> FrameResult:
        """Refine frame ``index``."""
        return self.joined([self.bound_part(index, goal, keep_leaves=keep_leaves, stopped=stopped, progress=progress)])

    def bound_part(
        self,
        index: int,
        goal: Goal,
        tiles: np.ndarray | None = None,
        *,
        keep_leaves: bool = False,
        stopped: Callable[[], bool] = lambda: False,
        progress: Callable[[TracePoint, float], None] = lambda point, share: None,
    ) -> PartResult:
        """Refine some tiles of frame ``index``, or all of them."""
        # kept leaves are boxes of the set's parameters
        frame = self.frame(index, slanted=not keep_leaves)
        refinement = Refinement(
            frame, index, goal, seed=self.settings.seed, keep_leaves=keep_leaves, stopped=stopped, progress=progress,
            members=frame.members(self.settings.seed), tiles=tiles,
        )  # fmt: skip
        return refinement.run_part()

    def joined(self, parts: Sequence[PartResult]) -> FrameResult:
        """The frame that parts make up, with what was left out for it.

        Raises:
            ValueError: Tiles are missing or there twice.
        """
        frame = self.frame(parts[0].index)
        result = replace(joined(parts, frame.camera), box=self.pose_sets[parts[0].index].box)
        shown = [part.shown for part in parts]
        known = [numbers for numbers in shown if numbers is not None]
        count = int(np.unique(np.concatenate(known)).size) if len(known) == len(shown) else None
        plan = self.method.frame_plan(frame, count, result.lower, result.upper)
        floor = max(part.floor for part in parts)
        if floor > 0.0:
            plan.append(
                f"dim light: layers that at most {floor:.2%} of the light comes to are left out of the first cells, "
                "and bounded by the range of their colours"
            )
        if len(parts) > 1:
            plan.append(
                f"bounded in {len(parts)} groups of tiles side by side: cells are the sum of theirs, seconds those of "
                "the slowest"
            )
        return replace(result, plan=tuple(plan))

    @property
    def plan(self) -> tuple[str, ...]:
        """What is left out for this scene, whatever the frame."""
        return self.method.plan

    @cached_property
    def fingerprint(self) -> dict[str, Any]:
        """What a stored result must agree with to be continued."""
        sets = hashlib.sha256()
        for poses in self.pose_sets:
            camera = poses.camera
            sets.update(np.ascontiguousarray(camera.camera_to_world).tobytes())
            sets.update(repr((camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)).encode())
            sets.update(repr((poses.perturbation, poses.box, sorted(poses.fixed.items()))).encode())
            if poses.perturbation.scene:
                sets.update(repr(poses.perturbation.scene).encode())
        return {**self.method.fingerprint, "poses": sets.hexdigest()}

    def describe(self) -> dict[str, Any]:
        """The scene for reports."""
        return self.method.describe()


def open_method(settings: Settings) -> Method:
    """The scene of a run with the program that is bounded, by the method that the run's config.yml names.

    Raises:
        InputError: A file or an option cannot be used.
    """
    scene = load_any(settings.load_config)
    if isinstance(scene, NerfScene):
        return NerfMethod(
            scene,
            settings.renderer,
            settings.arithmetic,
            settings.sampling,
            settings.num_samples,
            settings.near_plane,
            None if settings.occupancy_grid is None else load_grid(settings.occupancy_grid),
            settings.workers,
        )
    for name in ("sampling", "num_samples", "near_plane", "occupancy_grid"):
        if getattr(settings, name) is not None:
            field = "--" + name.replace("_", "-")
            raise InputError("is for runs of vanilla-nerf, this run is a splat", field=field, fix="leave it out")
    return SplatMethod(scene, settings.renderer, settings.arithmetic)


def check_frames(frames: tuple[int, ...] | None, count: int) -> tuple[int, ...]:
    """The frames asked for, each once, in order.

    Raises:
        InputError: A number is not an entry of the path.
    """
    if not frames:
        return tuple(range(count))
    for frame in frames:
        if not 0 <= frame < count:
            raise InputError(f"found {frame}", field="--frames", fix=f"the camera path has entries 0 to {count - 1}")
    return tuple(sorted(set(frames)))
