"""``ns-abstract-certify``: what a network does on every image of a set of poses."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ns_abstract.cli.common import DONE, INTERRUPTED, Stop, run
from ns_abstract.cli.options import EngineOptions, Overrides, Program, ProgramOptions, SceneOverrides, Where
from ns_abstract.cli.sets import GivenSet, given_set
from ns_abstract.io.errors import InputError

if TYPE_CHECKING:
    from ns_abstract.api.certification import CertifySettings


@dataclass
class Certify(GivenSet):
    """Prove, or break, a property of a network on every image that a scene shows over a set of poses.

    Splits the set into cells until each is certified, falsified or too small. Writes cells.sqlite,
    report.json, report.html and the images of counterexamples. Exit codes: 0 done, whatever the verdict;
    2 bad input; 3 interrupted, or the time budget ended before every frame had a result.

    --model NET --explain alone prints the network's layers, and memory and time of a cell, and does nothing else.
    """

    load_config: Path
    """config.yml of a Splatfacto or vanilla-nerf run, or a standard 3DGS .ply."""
    camera_path_filename: Path
    """Camera path as Nerfstudio's viewer writes it."""
    model: Path
    """Network: .onnx."""
    property: Path
    """What is to hold (JSON): classification, regression, detection or vnnlib, with the preprocessing."""
    output_dir: Path
    """Folder for the results; made if missing."""
    perturbation_filename: Path | None = field(default=None, kw_only=True)
    """Set of poses (JSON). Default: the key "perturbation" of the camera path, or its poses alone."""
    time_budget: float | None = None
    """Seconds for all frames together. Default: 1800."""
    frames: tuple[int, ...] | None = None
    """Entries of the camera path, counted from 0. Default: all."""
    arithmetic: Literal["float32", "real"] | None = None
    """float32: images of every float32 evaluation (splats, the default for them). real: the real-number renderer and
    its float64 evaluation."""
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
    memory_limit: float | None = None
    """GiB that may be used. Default: 80 % of what is free."""
    program: Program = field(default_factory=ProgramOptions)
    where: Where = field(default_factory=EngineOptions)
    overrides: SceneOverrides = field(default_factory=Overrides)

    @cached_property
    def settings(self) -> CertifySettings:
        """The files, and what is certified.

        Raises:
            InputError: Options do not go together.
        """
        from ns_abstract.api.certification import CertifySettings

        return CertifySettings(
            self.load_config,
            self.camera_path_filename,
            self.model,
            self.property,
            self.perturbation_filename,
            arithmetic=self.arithmetic,
            network_arithmetic=self.network_arithmetic,
            picture=self.picture,
            workers=self.where.ray_processes,
            given_set=given_set(self),
            program=self.program,
            overrides=self.overrides,
        )


def certify(options: Certify) -> int:
    """Run the command; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    if options.time_budget is not None and not 0.0 < options.time_budget < float("inf"):
        raise InputError(f"found {options.time_budget}", field="--time-budget", fix="give a positive number")
    options.where.check()
    given_set(options)
    stop = Stop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.cli.certifying import certify_path
        complete = certify_path(options, stop)
    return DONE if complete and not stop() else INTERRUPTED


@dataclass
class Explain:
    """Print a network's layers, and what a cell of it will take; nothing is bounded."""

    model: Path
    """Network: .onnx."""
    explain: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Only this."""
    parameters: int = 2
    """How many parameters the poses will have."""
    output: str | None = None
    """Name of the network's output. Default: the only one."""


def explain(options: Explain) -> int:
    """Print what a network consists of; returns the exit code.

    Raises:
        InputError: The file cannot be used.
    """
    from ns_abstract.verify.network.explain import explain as explained
    from ns_abstract.verify.network.load import load_network

    if not 0 <= options.parameters <= 64:
        raise InputError(f"found {options.parameters}", field="--parameters", fix="give a number from 0 to 64")
    print("\n".join(explained(load_network(options.model, output=options.output), options.parameters)))
    return DONE


def main() -> None:
    """Entry point of the console script."""
    if "--explain" in sys.argv[1:]:
        run(explain, lambda: tyro.cli(Explain, prog="ns-abstract-certify"))
    run(certify, lambda: tyro.cli(Certify, prog="ns-abstract-certify"), "give fewer --workers or free memory")


if __name__ == "__main__":
    main()
