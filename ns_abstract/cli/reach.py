"""``ns-abstract-reach``: what a network in the loop does from every state of a box."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ns_abstract.cli.common import DONE, INTERRUPTED, Stop, plain_console, run
from ns_abstract.cli.scenes import GivenScene, overrides
from ns_abstract.io.errors import InputError

#: Seconds between lines of progress.
_EVERY = 10.0


@dataclass
class Reach(GivenScene):
    """Prove of a network in the loop that no run from a box of initial states goes wrong, or find one that does.

    A camera is carried by a state, its picture goes through the network, and the network's output moves the state.
    Splits the initial box into cells until each is certified, falsified or too small. Writes cells.sqlite,
    report.json, report.html and the runs that go wrong. Exit codes: 0 done, whatever the verdict; 2 bad input;
    3 interrupted.
    """

    load_config: Path
    """config.yml of a Splatfacto run, or a standard 3DGS .ply."""
    loop: Path
    """Initial box, dynamics, camera, network, control, unsafe sets and goal (JSON)."""
    output_dir: Path
    """Folder for the results; made if missing."""
    time_budget: float = 1800.0
    """Seconds."""
    renderer: Literal["gsplat", "paper"] | None = None
    """gsplat: what Nerfstudio shows (the default). paper: Algorithm 1 of "Abstract Rendering"."""
    gsplat_version: Literal["1.4.0", "1.5.3", "1.6.0"] | None = None
    """Splats: whose rules are bounded. Default: 1.4.0, which nerfstudio 1.1.5 asks for."""
    arithmetic: Literal["float32", "real"] | None = None
    """float32: images of every float32 evaluation (the default). real: the real-number renderer and its float64
    evaluation."""
    network_arithmetic: Literal["float32", "real"] = "float32"
    """float32: every float32 evaluation of the network (the default). real: the exact function of its weights alone."""
    engine: Literal["local", "dask"] = "local"
    """dask: spread the cells over a Dask cluster (needs the extra "cluster")."""
    scheduler_address: str | None = None
    """HOST:PORT of a running Dask scheduler. Default: a cluster on this machine."""
    workers: int = 1
    """Processes on this machine; 1 works in this process."""
    scene_margin: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """In half of the time, look for the largest variation of all Gaussians' means, opacities and colours, of the
    camera's response and of the place of the whole scene for which everything that is certified holds."""
    film: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """In a tenth of the time, write film.mp4 (film.gif without the extra "video"): bounds, gap and a render at every
    step of the tube of the widest certified cell."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the cells that an interrupted run with the same inputs has stored."""


def reach(options: Reach) -> int:
    """Run the command; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    if not 0.0 < options.time_budget < float("inf"):
        raise InputError(f"found {options.time_budget}", field="--time-budget", fix="give a positive number")
    if options.workers < 1:
        raise InputError(f"found {options.workers}", field="--workers", fix="give a number of at least 1")
    if options.engine == "local" and options.scheduler_address is not None:
        raise InputError("given without --engine dask", field="--scheduler-address", fix="add --engine dask")
    stop = Stop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.api.compiling import compile_beside
            from ns_abstract.api.reaching import ReachProgress, ReachRun, open_loop
            from ns_abstract.api.scenes import SceneSource
            from ns_abstract.execution.engines import started
            from ns_abstract.methods.representation import ProgramOptions
            from ns_abstract.report.figures import percent

            program = ProgramOptions(renderer=options.renderer, gsplat_version=options.gsplat_version)
            scene = SceneSource(options.load_config, program, overrides(options)).open()
            job = open_loop(scene, options.loop, options.arithmetic, options.network_arithmetic, options.workers)
            found = ReachRun(job, options.output_dir, vars(options), ("ns-abstract-reach", *sys.argv[1:]))
        console = plain_console()
        said = 0.0

        def told(point: ReachProgress) -> None:
            nonlocal said
            if point.seconds - said < _EVERY and point.open > 0.0:
                return
            said = point.seconds
            shares = {"safe": point.safe, "reaches": point.reaches, "falsified": point.falsified, "open": point.open}
            text = ", ".join(f"{name} {percent(share)}" for name, share in shares.items() if share is not None)
            console.print(f"{point.seconds:7.0f} s: {text}", markup=False)

        document = found.run(
            lambda stack: stack.enter_context(started(options.engine, options.scheduler_address, options.workers)),
            options.time_budget,
            stop,
            resume=options.resume,
            on_open=lambda: compile_beside(job.job, 0) if options.engine == "local" else None,
            on_progress=told,
            scene_margin=options.scene_margin,
            film=options.film,
            on_margin=lambda found: console.print(f"scene margin: {found.sentence}", markup=False, soft_wrap=True),
        )
        for question, entry in document["questions"].items():
            console.print(
                f"{question}: certified {percent(entry['certified'])}, falsified {percent(entry['falsified'])}, "
                f"unknown {percent(entry['unknown'])}; {percent(entry['simulated']['went_well'])} of "
                f"{entry['simulated']['runs']} random runs went well",
                markup=False,
            )
        console.print(
            f"{document['verdict']}; report: {options.output_dir / 'report.html'}", markup=False, soft_wrap=True
        )
    return INTERRUPTED if stop() else DONE


def main() -> None:
    """Entry point of the console script."""
    run(reach, lambda: tyro.cli(Reach, prog="ns-abstract-reach"), "give fewer --workers or free memory")


if __name__ == "__main__":
    main()
