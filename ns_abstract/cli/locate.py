"""``ns-abstract-locate``: which poses of a set can have made a photo."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ns_abstract.cli.common import DONE, INTERRUPTED, SignalStop, run
from ns_abstract.cli.options import EngineOptions, Overrides, Program, ProgramOptions, SceneOverrides, Where
from ns_abstract.cli.sets import GivenSet, given_set
from ns_abstract.io.errors import InputError

if TYPE_CHECKING:
    from ns_abstract.api.location import LocateSettings


@dataclass
class Locate(GivenSet):
    """Find which poses of a set can have made a photo; what is excluded is proved.

    Writes cells.sqlite (excluded, possible and unknown boxes of poses), report.json and report.html. Exit codes: 0
    done, also where no pose explains the photo; 2 bad input; 3 interrupted.
    """

    load_config: Path
    """config.yml of a Splatfacto or vanilla-nerf run, or a standard 3DGS .ply."""
    image: Path
    """The photo: RGB of 8 bits, of the size of the camera path's pictures."""
    camera_path_filename: Path
    """Camera path as Nerfstudio's viewer writes it; the set is around its entries."""
    output_dir: Path
    """Folder for the results; made if missing."""
    noise: float = 0.02
    """By how much a value of the photo, from 0 to 1, may differ from the scene's picture before it is rounded."""
    outliers: float = 0.05
    """Part of the pixels that may show anything: people, reflections."""
    mask: Path | None = None
    """Black and white picture of the photo's size: white pixels count. Default: all."""
    no_contraction: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Only halve cells; for comparisons."""
    time_budget: float | None = None
    """Seconds for all frames together. Default: 600."""
    frames: tuple[int, ...] | None = None
    """Entries of the camera path, counted from 0. Default: all."""
    downscale_factor: float = 1.0
    """Pictures of the path become this many times smaller."""
    arithmetic: Literal["float32", "real"] | None = None
    """float32: pictures of every float32 evaluation (splats, the default for them). real: the real-number renderer and
    its float64 evaluation."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the cells that an interrupted run with the same inputs has stored."""
    memory_limit: float | None = None
    """GiB that may be used. Default: 80 % of what is free."""
    program: Program = field(default_factory=ProgramOptions)
    where: Where = field(default_factory=EngineOptions)
    overrides: SceneOverrides = field(default_factory=Overrides)

    @property
    def settings(self) -> LocateSettings:
        """The files, and what a picture may miss.

        Raises:
            InputError: Options do not go together.
        """
        from ns_abstract.api.files import Settings
        from ns_abstract.api.location import LocateSettings, PhotoOptions

        files = Settings(
            self.load_config,
            self.camera_path_filename,
            self.perturbation_filename,
            downscale_factor=self.downscale_factor,
            arithmetic=self.arithmetic,
            memory_limit=self.memory_limit,
            workers=self.where.ray_processes,
            given_set=given_set(self),
            program=self.program,
            overrides=self.overrides,
        )
        photo = PhotoOptions(self.noise, self.outliers, not self.no_contraction)
        return LocateSettings(files, self.image, self.mask, photo)


def locate(options: Locate) -> int:
    """Run the command; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    if options.time_budget is not None and not 0.0 < options.time_budget < float("inf"):
        raise InputError(f"found {options.time_budget}", field="--time-budget", fix="give a positive number")
    options.where.check()
    given_set(options)
    stop = SignalStop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.cli.locating import locate_photo
        locate_photo(options, stop)
    return INTERRUPTED if stop() else DONE


def main() -> None:
    """Entry point of the console script."""
    run(locate, lambda: tyro.cli(Locate, prog="ns-abstract-locate"), "give fewer --workers or free memory")


if __name__ == "__main__":
    main()
