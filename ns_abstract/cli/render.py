"""``ns-abstract-render``: abstract images of a camera path."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ns_abstract.cli.common import DONE, INTERRUPTED, Stop, run
from ns_abstract.cli.options import EngineOptions, Overrides, Program, ProgramOptions, SceneOverrides, Where
from ns_abstract.cli.sets import GivenSet, given_set
from ns_abstract.io.errors import InputError

if TYPE_CHECKING:
    from ns_abstract.api.files import Settings

#: Seconds by frame where --explain is given none.
_EXPLAINED_S = 30.0


@dataclass
class Render(GivenSet):
    """Bound every image that Nerfstudio would show, for every pose in a set around each keyframe.

    Writes frame_00000.npz and .png by keyframe, report.json and report.html. Exit codes: 0 done;
    2 bad input; 3 interrupted, or the time budget ended before every frame had a result.
    """

    load_config: Path
    """config.yml of a Splatfacto or vanilla-nerf run, or a standard 3DGS .ply."""
    camera_path_filename: Path
    """Camera path as Nerfstudio's viewer writes it."""
    output_dir: Path | None = None
    """Folder for the results; made if missing. Required, but for --describe and --explain."""
    time_budget: float | None = None
    """Seconds for all frames together. Default: 60 per frame."""
    target_ratio: float = 1.05
    """A frame is done when its mean pixel gap is at most this many times the one of real renders."""
    frames: tuple[int, ...] | None = None
    """Entries of the camera path, counted from 0. Default: all."""
    downscale_factor: float = 1.0
    """Images become this many times smaller."""
    arithmetic: Literal["float32", "real"] | None = None
    """float32: enclose every float32 evaluation (splats, the default for them). real: the real-number renderer and
    its float64 evaluation."""
    outputs: tuple[Literal["rgb", "depth", "accumulation"], ...] = ("rgb",)
    """What is bounded. rgb is always; depth: gsplat's expected depth, normalised units (splats). accumulation: the part
    of the light that the scene takes."""
    seed: int = 0
    """Seed of the random witnesses."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep the frames that an interrupted run with the same inputs has finished."""
    save_cells: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Store every leaf cell's box and linear sets in the npz files."""
    memory_limit: float | None = None
    """GiB that may be used. Default: 80 % of what is free."""
    describe: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Only tell what cameras, units and set mean, in pixels and distances, and do nothing else; needs no
    --output-dir."""
    explain: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Splats: also tell why bounds are wider than renders, where, and what would help, in words and in the report.
    Without --output-dir nothing is written."""
    program: Program = field(default_factory=ProgramOptions)
    where: Where = field(default_factory=EngineOptions)
    overrides: SceneOverrides = field(default_factory=Overrides)

    @property
    def settings(self) -> Settings:
        """The files, and what is bounded.

        Raises:
            InputError: Options do not go together.
        """
        from ns_abstract.api.files import Settings

        return Settings(
            self.load_config,
            self.camera_path_filename,
            self.perturbation_filename,
            downscale_factor=self.downscale_factor,
            arithmetic=self.arithmetic,
            seed=self.seed,
            memory_limit=self.memory_limit,
            workers=self.where.ray_processes,
            given_set=given_set(self),
            outputs=self.outputs,
            program=self.program,
            overrides=self.overrides,
        )


def explain(options: Render) -> int:
    """Bound and explain frame by frame; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    from ns_abstract.api.bounding import bound_frames
    from ns_abstract.api.explaining import check_explained
    from ns_abstract.api.explaining import explain as explained
    from ns_abstract.api.files import open_job
    from ns_abstract.api.job import check_frames
    from ns_abstract.execution.engines import Here

    job = open_job(replace(options.settings, workers=1))
    check_explained(job)
    frames = check_frames(options.frames, job.frame_count)
    stop = Stop()
    with stop.installed():
        results = bound_frames(
            job, frames, engine=Here(), budget=options.time_budget or _EXPLAINED_S * len(frames),
            target_ratio=options.target_ratio, keep_leaves=True, stop=stop,
        )  # fmt: skip
        for result in results:
            for line in explained(job, result.index, result, options.seed).lines():
                print(line, flush=True)
    return INTERRUPTED if stop() else DONE


def describe(options: Render) -> int:
    """Print what is about to be bounded; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    from ns_abstract.api.describe import describe as described
    from ns_abstract.api.files import open_job
    from ns_abstract.api.job import check_frames
    from ns_abstract.io.errors import visible
    from ns_abstract.perturbation.specification import Perturbation

    # a path that says nothing of a set is looked at all the same
    job = open_job(replace(options.settings, workers=1), default=Perturbation())
    for line in described(job, check_frames(options.frames, job.frame_count)):
        print(visible(line))
    return DONE


def render(options: Render) -> int:
    """Run the command; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    if options.describe:
        return describe(options)
    if options.output_dir is None:
        if options.explain:
            return explain(options)
        raise InputError("missing --output-dir", fix="--help lists the options")
    for name, value in (("--target-ratio", options.target_ratio), ("--time-budget", options.time_budget)):
        if value is not None and not 0.0 < value < float("inf"):
            raise InputError(f"found {value}", field=name, fix="give a positive number")
    if options.target_ratio < 1.0:
        raise InputError(f"found {options.target_ratio}", field="--target-ratio", fix="give a number of at least 1")
    if options.seed < 0:
        raise InputError(f"found {options.seed}", field="--seed", fix="give a number of at least 0")
    options.where.check()
    given_set(options)
    stop = Stop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.cli.rendering import render_path
        complete = render_path(options, stop)
    return DONE if complete and not stop() else INTERRUPTED


def main() -> None:
    """Entry point of the console script."""
    run(render, lambda: tyro.cli(Render, prog="ns-abstract-render"))


if __name__ == "__main__":
    main()
