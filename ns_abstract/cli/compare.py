"""``ns-abstract-compare``: how far apart pictures of two scenes can be over sets of poses."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ns_abstract.cli.common import DONE, INTERRUPTED, SignalStop, command, run
from ns_abstract.cli.options import EngineOptions, Overrides, Program, ProgramOptions, SceneOverrides, Where
from ns_abstract.cli.sets import GivenSet, given_set
from ns_abstract.io.errors import InputError

if TYPE_CHECKING:
    from ns_abstract.api.files import Settings
    from ns_abstract.api.scenes import SceneSource


@dataclass
class Compare(GivenSet):
    """Bound how far apart pictures of two scenes are at one pose, for every pose in a set around each keyframe.

    Writes frame_00000.npz and .png by keyframe, report.json and report.html. Exit codes: 0 done, whatever the verdict;
    2 bad input; 3 interrupted, or the time budget ended before every frame had a result.
    """

    load_config: Path
    """Scene A: config.yml of a Splatfacto or vanilla-nerf run, or a standard 3DGS .ply."""
    other: Path
    """Scene B, in the same frame: a compressed, pruned or retrained version of A, or its export."""
    camera_path_filename: Path
    """Camera path as Nerfstudio's viewer writes it."""
    output_dir: Path
    """Folder for the results; made if missing."""
    tolerance: float | None = None
    """Difference from 0 to 1 of which is asked whether any picture exceeds it, at any pixel and channel. The work on a
    frame ends once that is decided."""
    time_budget: float | None = None
    """Seconds for all frames together. Default: 60 per frame."""
    target_ratio: float = 1.05
    """Without --tolerance, a frame is done when its largest bound is at most this many times the largest difference
    rendered."""
    frames: tuple[int, ...] | None = None
    """Entries of the camera path, counted from 0. Default: all."""
    downscale_factor: float = 1.0
    """Images become this many times smaller."""
    arithmetic: Literal["float32", "real"] | None = None
    """float32: enclose every float32 evaluation (splats, the default for them). real: the real-number renderer and
    its float64 evaluation."""
    seed: int = 0
    """Seed of the random poses that are rendered."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep what an interrupted run with the same inputs has found."""
    memory_limit: float | None = None
    """GiB that may be used. Default: 80 % of what is free."""
    other_rasterize_mode: Literal["classic", "antialiased"] | None = None
    """Of B. Default: as --rasterize-mode."""
    other_background: tuple[float, float, float] | None = None
    """Of B. Default: as --background."""
    other_gsplat_version: Literal["1.4.0", "1.5.3", "1.6.0"] | None = None
    """Of B. Default: as --gsplat-version."""
    other_load_step: int | None = None
    """Of B; --load-step is of A alone."""
    program: Program = field(default_factory=ProgramOptions)
    where: Where = field(default_factory=EngineOptions)
    overrides: SceneOverrides = field(default_factory=Overrides)

    @property
    def settings(self) -> Settings:
        """Scene A and the sets of poses.

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
            program=self.program,
            overrides=self.overrides,
        )

    @property
    def other_source(self) -> SceneSource:
        """Scene B: what is said of A holds for it, too, unless an option of its own says otherwise.

        Raises:
            InputError: A value cannot be used.
        """
        from ns_abstract.api.scenes import SceneSource

        program, overrides = self.program, replace(self.overrides, load_step=self.other_load_step)
        if self.other_gsplat_version is not None:
            program = replace(program, gsplat_version=self.other_gsplat_version)
        try:
            if self.other_rasterize_mode is not None:
                overrides = replace(overrides, rasterize_mode=self.other_rasterize_mode)
            if self.other_background is not None:
                overrides = replace(overrides, background=self.other_background)
        except InputError as error:
            named = f"--other-{(error.field or '').removeprefix('--')}"
            raise InputError(error.problem, field=named, fix=error.fix) from None
        return SceneSource(self.other, program, overrides)


def compare(options: Compare) -> int:
    """Run the command; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    if options.seed < 0:
        raise InputError(f"found {options.seed}", field="--seed", fix="give a number of at least 0")
    options.where.check()
    given_set(options)
    stop = SignalStop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.cli.comparing import compare_path
        complete = compare_path(options, stop)
    return DONE if complete and not stop() else INTERRUPTED


def main() -> None:
    """Entry point of the console script."""
    run(compare, command("ns-abstract-compare", Compare))


if __name__ == "__main__":
    main()
