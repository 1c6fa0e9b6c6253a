"""The commands of several modules: their options, which tyro reads from the command line."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ns_abstract.cli.sets import (
    EngineOptions,
    GivenSet,
    Overrides,
    Program,
    ProgramOptions,
    SceneOverrides,
    Where,
    given_set,
)
from ns_abstract.io.errors import InputError

if TYPE_CHECKING:
    from ns_abstract.api.certification import CertifySettings
    from ns_abstract.api.files import Settings
    from ns_abstract.api.location import LocateSettings
    from ns_abstract.api.scenes import SceneSource


@dataclass(kw_only=True)
class _PathCommand(GivenSet):
    """Options of commands that look at the poses of a camera path."""

    load_config: Path
    """config.yml of a Splatfacto, vanilla-nerf or nerfacto run, or a file (.ply, .sog, .spz, .splat, .glb, .pt)."""
    camera_path_filename: Path
    """Camera path as Nerfstudio's viewer writes it; the set is around its entries."""
    frames: tuple[int, ...] | None = None
    """Entries of the camera path, counted from 0. Default: all."""
    arithmetic: Literal["float32", "real"] | None = None
    """float32: pictures of every float32 evaluation (splats, the default for them). real: the real-number renderer and
    its float64 evaluation."""
    memory_limit: float | None = None
    """GiB that may be used. Default: 80 % of what is free."""
    program: Program = field(default_factory=ProgramOptions)
    where: Where = field(default_factory=EngineOptions)
    overrides: SceneOverrides = field(default_factory=Overrides)


@dataclass(kw_only=True)
class Render(_PathCommand):
    """Bound every image that Nerfstudio would show, for every pose in a set around each keyframe.

    Writes frame_00000.npz and .png by keyframe, report.json and report.html. Exit codes: 0 done;
    2 bad input; 3 interrupted, or the time budget ended before every frame had a result.
    """

    output_dir: Path | None = None
    """Folder for the results; made if missing. Required, but for --describe and --explain."""
    time_budget: float | None = None
    """Seconds for all frames together. Default: 60 per frame."""
    target_ratio: float = 1.05
    """A frame is done when its mean pixel gap is at most this many times the one of real renders."""
    downscale_factor: float = 1.0
    """Images become this many times smaller."""
    outputs: tuple[Literal["rgb", "depth", "accumulation"], ...] = ("rgb",)
    """What is bounded. rgb is always; depth: gsplat's expected depth, normalised units (splats). accumulation: the part
    of the light that the scene takes."""
    seed: int = 0
    """Seed of the random witnesses."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep the frames that an interrupted run with the same inputs has finished."""
    save_cells: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Store every leaf cell's box and linear sets in the npz files."""
    describe: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Only tell what cameras, units and set mean, in pixels and distances, and do nothing else; needs no
    --output-dir."""
    explain: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Splats: also tell why bounds are wider than renders, where, and what would help, in words and in the report.
    Without --output-dir nothing is written."""

    @property
    def settings(self) -> Settings:
        """The files, and what is bounded. Raises InputError: options do not go together."""
        return _files(self, downscale_factor=self.downscale_factor, seed=self.seed, outputs=self.outputs)


@dataclass(kw_only=True)
class Certify(_PathCommand):
    """Prove or break a property of a network, or of the picture, on every image of a set of poses.

    Splits the set into cells until each is certified, falsified or too small. Writes cells.sqlite,
    report.json, report.html and the images of counterexamples. Exit codes: 0 done, whatever the verdict;
    2 bad input; 3 interrupted, or the time budget ended before every frame had a result.

    --model NET --explain alone prints the network's layers, memory of a cell and times that it measures, and ends.
    """

    property: Path
    """What is to hold (JSON): of a network classification, regression, detection or vnnlib, with the preprocessing; of
    the picture itself visible, clear, picture, or several as all or any."""
    output_dir: Path
    """Folder for the results; made if missing."""
    model: Path | None = None
    """Network: .onnx. Left out for a property of the picture."""
    perturbation_filename: Path | None = None
    """Set of poses (JSON). Default: the key "perturbation" of the camera path, or its poses alone."""
    time_budget: float | None = None
    """Seconds for all frames together. Default: 1800."""
    network_arithmetic: Literal["float32", "real"] = "float32"
    """float32: every float32 evaluation of the network (the default). real: the exact function of its weights alone."""
    picture: Literal["float", "8-bit"] = "float"
    """float: the renderer's floats (the default). 8-bit: these rounded to multiples of 1/255, as files and cameras
    have them."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the cells that an interrupted run with the same inputs has stored."""
    scene_margin: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Splats: in half of the time, look for the largest variation of all Gaussians' means, opacities and colours, of
    the camera's response and of the place of the whole scene for which everything that is certified holds."""

    @cached_property
    def settings(self) -> CertifySettings:
        """The files, and what is certified. Raises InputError: options do not go together."""
        from ns_abstract.api.certification import CertifySettings

        return CertifySettings(_files(self), self.model, self.property, self.network_arithmetic, self.picture)


@dataclass(kw_only=True)
class Compare(_PathCommand):
    """Bound how far apart pictures of two scenes are at one pose, for every pose in a set around each keyframe.

    Writes frame_00000.npz and .png by keyframe, report.json and report.html. Exit codes: 0 done, whatever the verdict;
    2 bad input; 3 interrupted, or the time budget ended before every frame had a result.
    """

    load_config: Path
    """Scene A: config.yml of a run, or a scene file (.ply, .sog, .spz, .splat, .glb, .pt)."""
    other: Path
    """Scene B, in the same frame: a compressed, pruned or retrained version of A, or its export."""
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
    downscale_factor: float = 1.0
    """Images become this many times smaller."""
    seed: int = 0
    """Seed of the random poses that are rendered."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep what an interrupted run with the same inputs has found."""
    other_rasterize_mode: Literal["classic", "antialiased"] | None = None
    """Of B. Default: as --rasterize-mode."""
    other_background: tuple[float, float, float] | None = None
    """Of B. Default: as --background, else what its file states, else A's."""
    other_gsplat_version: Literal["1.4.0", "1.5.3", "1.6.0"] | None = None
    """Of B. Default: as --gsplat-version."""
    other_load_step: int | None = None
    """Of B; --load-step is of A alone."""

    @property
    def settings(self) -> Settings:
        """Scene A and the sets of poses. Raises InputError: options do not go together."""
        return _files(self, downscale_factor=self.downscale_factor, seed=self.seed)

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


@dataclass(kw_only=True)
class Locate(_PathCommand):
    """Find which poses of a set can have made a photo; what is excluded is proved.

    Writes cells.sqlite (excluded, possible and unknown boxes of poses), report.json and report.html. Exit codes: 0
    done, also where no pose explains the photo; 2 bad input; 3 interrupted.
    """

    output_dir: Path
    """Folder for the results; made if missing."""
    image: Path | None = None
    """The photo: RGB of 8 bits, of the size of the camera path's pictures."""
    image_sequence: Path | None = None
    """In place of --image: folder of photos, followed in the order of their names. Needs --motion."""
    motion: Path | None = None
    """Perturbation file: by how much the set's parameters may change from one photo to the next."""
    noise: float = 0.02
    """By how much a value of the photo, from 0 to 1, may differ from the scene's picture before it is rounded."""
    outliers: float = 0.05
    """Part of the pixels that may show anything: people, reflections."""
    mask: Path | None = None
    """Black and white picture of the photo's size: white pixels count. Default: all."""
    calibrate: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Raise --noise and --outliers to what explains the run's own training photos."""
    brightness_gain: tuple[float, float] = (1.0, 1.0)
    """The camera may show gain * picture + offset, the same for all pixels: ends of the gain."""
    brightness_offset: tuple[float, float] = (0.0, 0.0)
    """Ends of the offset."""
    no_contraction: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Only halve cells; for comparisons."""
    time_budget: float | None = None
    """Seconds for all frames together, of every photo. Default: 600."""
    downscale_factor: float = 1.0
    """Pictures of the path become this many times smaller."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the cells that an interrupted run with the same inputs has stored."""

    @property
    def settings(self) -> LocateSettings:
        """The files, and what a picture may miss. Raises InputError: options do not go together."""
        from ns_abstract.api.location import LocateSettings, PhotoOptions

        if (self.image is None) == (self.image_sequence is None):
            raise InputError("found both or neither", field="--image", fix="give it, or --image-sequence")
        if (self.image_sequence is None) != (self.motion is None):
            raise InputError("given without the other", field="--motion", fix="give it beside --image-sequence")
        photo = PhotoOptions(
            self.noise, self.outliers, not self.no_contraction, self.brightness_gain, self.brightness_offset
        )
        # the photos of a sequence are read one by one
        image = self.image or Path()
        return LocateSettings(
            _files(self, downscale_factor=self.downscale_factor), image, self.mask, photo, self.calibrate
        )


def _files(options: _PathCommand, **more: Any) -> Settings:
    """Return the settings that a command's files and options give. Raises InputError: options do not go together."""
    from ns_abstract.api.files import Settings

    return Settings(
        options.load_config,
        options.camera_path_filename,
        options.perturbation_filename,
        arithmetic=options.arithmetic,
        memory_limit=options.memory_limit,
        workers=options.where.ray_processes,
        given_set=given_set(options),
        program=options.program,
        overrides=options.overrides,
        **more,
    )
