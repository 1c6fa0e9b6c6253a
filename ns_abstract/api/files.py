"""Open the files that a command line names as a job."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ns_abstract.api.assumptions import choice, set_choices
from ns_abstract.api.job import Job
from ns_abstract.api.scenes import Scene, SceneSource
from ns_abstract.geometry.camera_path import CameraPath, load_camera_path
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.program_options import ProgramOptions
from ns_abstract.perturbation.specification import Perturbation, load_perturbation, parse_perturbation


@dataclass(frozen=True)
class Settings:
    """The options of a command line that select the scene, the cameras and the sets to bound.

    Attributes:
        perturbation_filename: Perturbation JSON; None: the camera path holds it.
        given_set: The content of a perturbation file, in place of one; errors name its keys as options.
        arithmetic: "float32" or "real"; None: the strongest that the method has.
        memory_limit: GiB.
        outputs: "rgb", and what is bounded beside it: "depth", "accumulation".
    """

    load_config: Path
    camera_path_filename: Path
    perturbation_filename: Path | None = None
    downscale_factor: float = 1.0
    arithmetic: str | None = None
    seed: int = 0
    memory_limit: float | None = None
    workers: int = 1
    given_set: Mapping[str, Any] | None = None
    outputs: tuple[str, ...] = ("rgb",)
    program: ProgramOptions = field(default_factory=ProgramOptions)
    overrides: Overrides = field(default_factory=Overrides)

    @property
    def scene(self) -> SceneSource:
        """The scene and the program that draws it."""
        return SceneSource(self.load_config, self.program, self.overrides)

    def job_options(self, pose_sets: Sequence[PoseBox], path: CameraPath) -> dict[str, Any]:
        """Return options of `Job` for the sets of a path."""
        return {
            "arithmetic": self.arithmetic,
            "seed": self.seed,
            "memory_limit": self.memory_limit,
            "workers": self.workers,
            "notes": path.notes,
            "set_choices": self._set_choices(pose_sets, path),
        }

    def _set_choices(self, pose_sets: Sequence[PoseBox], path: CameraPath) -> tuple[Assumption, ...]:
        """Return the assumptions on the pictures' size and the sets, with their origins."""
        file, factor, name = self.perturbation_filename, self.downscale_factor, Path(path.source).name
        if self.given_set is not None:
            varied = "options"
        elif file is not None:
            varied = file.name
        else:
            inside = any(entry is not None for entry in path.perturbations)
            varied = f"{name}: perturbation" if inside else "default: single poses"
        size = f"{name}: render_width, render_height"
        return (
            *set_choices(pose_sets, size if factor == 1 else f"{size}, by --downscale-factor", varied),
            choice("downscale_factor", f"{factor:.9g}", None if factor == 1 else factor, "--downscale-factor"),
        )


class PathJob(Job):
    """The job of a camera path."""

    def __init__(self, settings: Settings, scene: Scene, path: CameraPath, pose_sets: tuple[PoseBox, ...]) -> None:
        self.settings, self.scene, self.path = settings, scene, path
        try:
            layers = [name for name in settings.outputs if name != "rgb"]
            super().__init__(scene, pose_sets, layers=layers, **settings.job_options(pose_sets, path))
        except InputError as error:
            # options have no file
            named = error.field is not None and not error.field.startswith("--")
            raise error.within(settings.perturbation_filename or path.source) if named else error from None


def pose_set(path: CameraPath, index: int, perturbation: Perturbation) -> PoseBox:
    """Return the poses of ``perturbation`` around entry ``index`` of a path.

    Raises:
        InputError: The path cannot be swept as asked.
    """
    try:
        return PoseBox.around(path.cameras[index], perturbation, path.following(index))
    except InputError as error:
        raise error.within(path.source) from None


def open_job(
    settings: Settings,
    perturbation: Perturbation | None = None,
    default: Perturbation | None = None,
    drawn: Callable[[PoseBox], PoseBox] | None = None,
) -> PathJob:
    """Open the files of a command line.

    Args:
        perturbation: For every entry of the path, in place of what the files say.
        default: For entries of which the files say nothing; without it they are an error.
        drawn: Gives each set the size of picture that is asked about; None: the path's.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    scene = settings.scene.open()
    path = load_camera_path(settings.camera_path_filename, settings.downscale_factor, scene.data_frame)
    # a set that cannot be made is found before hours of work
    sets = path_sets(settings, scene, path, perturbation, default)
    return PathJob(settings, scene, path, sets if drawn is None else tuple(map(drawn, sets)))


def path_sets(
    settings: Settings,
    scene: Scene,
    path: CameraPath,
    perturbation: Perturbation | None = None,
    default: Perturbation | None = None,
) -> tuple[PoseBox, ...]:
    """Return the sets of poses of a path's entries; arguments and errors as for `open_job`."""
    perturbations = (perturbation,) * len(path.cameras)
    if perturbation is None:
        perturbations = _perturbations(settings, scene.method(settings.arithmetic).dataset_scale, path, default)
    return tuple(pose_set(path, k, entry) for k, entry in enumerate(perturbations) if entry is not None)


def _perturbations(
    settings: Settings, scale: float | None, path: CameraPath, default: Perturbation | None
) -> tuple[Perturbation, ...]:
    file = settings.perturbation_filename
    if settings.given_set is not None:
        option_set = parse_perturbation(settings.given_set, dataset_scale=scale, field_prefix="--")
        return (option_set,) * len(path.cameras)
    if file is not None:
        return (load_perturbation(file, dataset_scale=scale),) * len(path.cameras)
    perturbations, folder = [], Path(path.source).parent
    for k, value in enumerate(path.perturbations):
        if value is None and default is not None:
            perturbations.append(default)
            continue
        if value is None:
            raise InputError(
                f"no perturbation for entry {k}",
                file=path.source,
                field="perturbation",
                fix='give --translation or --rotation, --perturbation-filename, or the key "perturbation" in the path',
            )
        prefix = "perturbation." if path.overrides[k] is None else f"camera_path[{k}].perturbation."
        try:
            perturbations.append(parse_perturbation(value, dataset_scale=scale, field_prefix=prefix, folder=folder))
        except InputError as error:
            raise error.within(path.source) from None
    return tuple(perturbations)


def resized(poses: PoseBox, height: int, width: int) -> PoseBox:
    """Return the same poses with pictures of another size; see `PinholeCamera.resized`."""
    target = poses.target_camera
    return replace(
        poses,
        camera=poses.camera.resized(height, width),
        target_camera=None if target is None else target.resized(height, width),
    )
