"""From files to bounded frames: what the command lines share."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.arithmetic.units import arithmetic as arithmetic_named
from ns_abstract.errors import InputError
from ns_abstract.methods.runs import available_memory
from ns_abstract.methods.splat.activate import Splats, activate
from ns_abstract.methods.splat.constants import RASTERISERS, Rasteriser
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.variations import VariedSplats, vary
from ns_abstract.refine.engine import Goal, Refinement
from ns_abstract.refine.result import FrameResult, TracePoint
from ns_abstract.sets.path import CameraPath, load_camera_path
from ns_abstract.sets.perturbation import Perturbation, load_perturbation, parse_perturbation
from ns_abstract.sets.poses import PoseSet, translation_only
from ns_abstract.sets.variations import SceneVariation

#: Bytes that the kernels need by Gaussian, beside the scene itself (record, boxes, colours, buffers).
_BYTES_BY_GAUSSIAN = 1200
#: The same of the ranges of a varied scene and of the member that is rendered.
_BYTES_BY_VARIED = 400


@dataclass(frozen=True)
class Settings:
    """What to bound, as the command line says it.

    Attributes:
        load_config: config.yml of a Splatfacto run, or a standard 3DGS .ply.
        camera_path_filename: Camera path JSON.
        perturbation_filename: Perturbation JSON; None: the camera path holds it.
        downscale_factor: Pictures become this many times smaller.
        renderer: "gsplat" or "paper".
        arithmetic: "float32" or "real".
        seed: Of the random witnesses.
        memory_limit: GiB.
    """

    load_config: Path
    camera_path_filename: Path
    perturbation_filename: Path | None = None
    downscale_factor: float = 1.0
    renderer: str = "gsplat"
    arithmetic: str = "float32"
    seed: int = 0
    memory_limit: float | None = None


class Job:
    """An opened scene, camera path and set of poses.

    Args:
        settings: What to bound.
        perturbation: For every entry of the path, in place of what the files say.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """

    def __init__(self, settings: Settings, perturbation: Perturbation | None = None) -> None:
        self.settings = settings
        self.rasteriser: Rasteriser = RASTERISERS[settings.renderer]
        self.arithmetic = arithmetic_named(settings.arithmetic)
        self.path: CameraPath = load_camera_path(settings.camera_path_filename, settings.downscale_factor)
        self.scene: SplatScene = load_scene(settings.load_config)
        given = (perturbation,) * self.frame_count if perturbation is not None else None
        self.perturbations: tuple[Perturbation, ...] = given or self._perturbations()
        # a set that cannot be made is found before hours of work
        self.pose_sets = tuple(self.pose_set(k, p) for k, p in enumerate(self.perturbations))
        self.splats: Splats = activate(self.scene, self.rasteriser)
        self._varied: dict[tuple[SceneVariation, ...], VariedSplats] = {}
        for p in self.perturbations:
            if p.scene not in self._varied:
                self._varied[p.scene] = self._vary(p)
        self._check_memory()

    @property
    def frame_count(self) -> int:
        """Entries of the camera path."""
        return len(self.path.cameras)

    def _perturbations(self) -> tuple[Perturbation, ...]:
        scale = self.scene.dataparser.scale
        file = self.settings.perturbation_filename
        count = len(self.path.cameras)
        if file is not None:
            return (load_perturbation(file, dataset_scale=scale),) * count
        found, folder = [], Path(self.path.source).parent
        for k in range(count):
            value = self.path.perturbation_of(k)
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

    def _vary(self, perturbation: Perturbation) -> VariedSplats:
        try:
            return vary(self.scene, self.splats, perturbation.scene)
        except InputError as error:
            raise error.within(self.settings.perturbation_filename or self.path.source) from None

    def varied(self, index: int) -> VariedSplats:
        """The scenes that frame ``index`` shows."""
        return self._varied[self.perturbations[index].scene]

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
    def _base_bytes(self) -> int:
        arrays = (self.splats.means, self.splats.axes, self.splats.opacity, self.splats.sh)
        pixels = max(camera.width * camera.height for camera in self.path.cameras)
        ranges = sum(v.varies for v in self._varied.values()) * _BYTES_BY_VARIED
        by_gaussian = self.splats.count * (_BYTES_BY_GAUSSIAN + ranges)
        return 2 * sum(a.nbytes for a in arrays) + by_gaussian + pixels * 400 + (256 << 20)

    def _check_memory(self) -> None:
        limit = self.settings.memory_limit
        if limit is not None and not 0.0 < limit < float("inf"):
            raise InputError(f"found {limit}", field="--memory-limit", fix="give a positive number of GiB")
        if self._base_bytes > self.memory:
            raise InputError(
                f"{self.splats.count:,} Gaussians at this size need {self._base_bytes / 2**30:.1f} GiB, "
                f"{self.memory / 2**30:.1f} GiB may be used",
                field="--memory-limit",
                fix="raise it, or raise --downscale-factor",
            )

    def goal(self, ratio: float, seconds: float, cells: int | None = None) -> Goal:
        """The goal with the memory that is left for leaves."""
        return Goal(ratio, seconds, cells, max(64 << 20, (self.memory - self._base_bytes) // 2))

    def frame(self, index: int) -> SplatFrame:
        """Frame ``index``, ready for refinement."""
        return SplatFrame(
            self.splats, self.rasteriser, self.arithmetic, self.pose_sets[index], varied=self.varied(index)
        )

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
        frame = self.frame(index)
        refinement = Refinement(
            frame, index, goal, seed=self.settings.seed, keep_leaves=keep_leaves, stopped=stopped, progress=progress,
            members=frame.members(self.settings.seed),
        )  # fmt: skip
        result = refinement.run()
        return replace(result, plan=tuple(self._frame_plan(frame, refinement)))

    def _frame_plan(self, frame: SplatFrame, refinement: Refinement) -> list[str]:
        total = self.splats.count
        plan = []
        shown = refinement.shown
        if shown is not None and shown < total:
            plan.append(
                f"{total - shown:,} of {total:,} Gaussians left out: no pose of the set shows them "
                "(behind, beside, hidden by others or below the alpha threshold)"
            )
        varied = frame.varied
        for quantity, name in (("mean", "mean"), ("opacity", "opacity"), ("color", "colour")):
            if count := varied.counts[quantity]:
                plan.append(f"scene variations: the {name} of {count:,} of {total:,} Gaussians varies")
            elif varied.varies:
                plan.append(f"ranges of the {name} left out: none varies")
        if not varied.counts["mean"] and translation_only(frame.pose_set.enclosure(frame.box, 1)):
            plan.append("depth-order rules left out but for near-ties: translations never change the order")
        return plan

    @property
    def plan(self) -> tuple[str, ...]:
        """What is left out for this scene, whatever the frame."""
        scene, splats, plan = self.scene, self.splats, []
        for reason, count in scene.dropped.items():
            plan.append(f"{count:,} stored Gaussians left out: {reason}")
        if scene.color_model == "sigmoid":
            plan.append("view dependence left out: the run stores plain colours (sh_degree 0)")
        elif splats.degree < scene.sh_degree:
            why = "the paper's renderer has RGB colours" if not self.rasteriser.view_dependent else "all zero"
            first, last = splats.degree + 1, scene.sh_degree
            bands = f"band {last}" if first == last else f"bands {first} to {last}"
            plan.append(f"spherical-harmonics {bands} left out: {why}")
        if not splats.antialiased:
            plan.append("opacity compensation left out: rasterize_mode is classic")
        return tuple(plan)

    @cached_property
    def fingerprint(self) -> dict[str, Any]:
        """What a stored result must agree with to be continued."""
        digest = hashlib.sha256()
        for array in (self.scene.means, self.scene.log_scales, self.scene.quats, self.scene.opacity_logits):
            digest.update(np.ascontiguousarray(array).tobytes())
        for array in (self.scene.sh, self.scene.background):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(repr((self.scene.color_model, self.scene.sh_degree, self.scene.rasterize_mode)).encode())
        sets = hashlib.sha256()
        for poses in self.pose_sets:
            camera = poses.camera
            sets.update(np.ascontiguousarray(camera.camera_to_world).tobytes())
            sets.update(repr((camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)).encode())
            sets.update(repr((poses.perturbation, poses.box, sorted(poses.fixed.items()))).encode())
            if poses.perturbation.scene:
                sets.update(repr(poses.perturbation.scene).encode())
        return {
            "scene": digest.hexdigest(),
            "poses": sets.hexdigest(),
            "renderer": self.settings.renderer,
            "arithmetic": self.settings.arithmetic,
        }

    def describe(self) -> dict[str, Any]:
        """The scene for reports."""
        scene = self.scene
        return {
            "name": scene.name,
            "source": str(scene.source),
            "gaussians": scene.count,
            "sh_degree": scene.sh_degree,
            "sh_degree_used": self.splats.degree,
            "rasterize_mode": scene.rasterize_mode,
            "background": [float(v) for v in scene.background],
            "notes": list(scene.notes),
        }


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
