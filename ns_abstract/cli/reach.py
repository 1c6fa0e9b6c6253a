"""``ns-abstract-reach``: what a network in the loop does from every state of a box."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ns_abstract.cli.common import DONE, INTERRUPTED, SignalStop, command, run
from ns_abstract.cli.sets import EngineOptions, Overrides, Program, ProgramOptions, SceneOverrides, Where, stated
from ns_abstract.io.arguments import positive


@dataclass
class Reach:
    """Prove of a network in the loop that no run from a box of initial states goes wrong, or find one that does.

    A camera is carried by a state, its picture goes through the network, and the network's output moves the state.
    Splits the initial box into cells until each is certified, falsified or too small. Writes cells.sqlite,
    report.json, report.html and the runs that go wrong. Exit codes: 0 done, whatever the verdict; 2 bad input;
    3 interrupted.
    """

    load_config: Path
    """config.yml of a Splatfacto run, or a scene file (.ply, .sog, .spz, .splat, .glb, .pt)."""
    loop: Path
    """Initial box, dynamics, camera, network, control, unsafe sets and goal (JSON)."""
    output_dir: Path
    """Folder for the results; made if missing."""
    time_budget: float = 1800.0
    """Seconds."""
    arithmetic: Literal["float32", "real"] | None = None
    """float32: images of every float32 evaluation (the default). real: the real-number renderer and its float64
    evaluation."""
    network_arithmetic: Literal["float32", "real"] = "float32"
    """float32: every float32 evaluation of the network (the default). real: the exact function of its weights alone."""
    scene_margin: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """In half of the time, look for the largest variation of all Gaussians' means, opacities and colours, of the
    camera's response and of the place of the whole scene for which everything that is certified holds."""
    film: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """In a tenth of the time, write film.mp4 (film.gif without the extra "video"): bounds, gap and a render at every
    step of the tube of the widest certified cell."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the cells that an interrupted run with the same inputs has stored."""
    program: Program = field(default_factory=ProgramOptions)
    where: Where = field(default_factory=lambda: EngineOptions(workers=1))
    overrides: SceneOverrides = field(default_factory=Overrides)


def reach(options: Reach) -> int:
    positive(options.time_budget, "--time-budget")
    options.where.check()
    stop = SignalStop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.api.cell_search import Request
            from ns_abstract.api.reaching import LoopQuestion, open_loop
            from ns_abstract.api.scenes import SceneSource
            from ns_abstract.cli.searching import kept_cells, say_if_late, searched
            from ns_abstract.reach.page import runs_text
            from ns_abstract.report.figures import percent
            from ns_abstract.report.progress import plain_console

            scene = SceneSource(options.load_config, options.program, options.overrides).open()
            workers = options.where.processes
            job = open_loop(scene, options.loop, options.arithmetic, options.network_arithmetic, workers)
            command = ("ns-abstract-reach", *sys.argv[1:])
            question = LoopQuestion(job, stated(options), command, film=options.film)
        console = plain_console()
        document = searched(
            question, options.output_dir, options.where, stop, console, job.job, 0,
            Request(options.time_budget, options.resume, rows=False, scene_margin=options.scene_margin),
            kept_cells,
        )  # fmt: skip
        for name, entry in document["questions"].items():
            console.print(
                f"{name}: certified {percent(entry['certified'])}, falsified {percent(entry['falsified'])}, "
                f"unknown {percent(entry['unknown'])}; {runs_text(name, entry['simulated'])}"
            )
        say_if_late(console, document)
        console.print(f"{document['verdict']}; report: {options.output_dir / 'report.html'}")
    return INTERRUPTED if stop() else DONE


def main() -> None:
    run(reach, command("ns-abstract-reach", Reach), "give fewer --workers or free memory")


if __name__ == "__main__":
    main()
