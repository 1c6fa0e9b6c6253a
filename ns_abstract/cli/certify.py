"""``ns-abstract-certify``: what a network does on every image of a set of poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ns_abstract.cli.common import DONE, INTERRUPTED, Stop, run
from ns_abstract.errors import InputError

#: Seconds where no time budget is given.
_SECONDS = 1800.0


@dataclass
class Certify:
    """Prove, or break, a property of a network on every image that a scene shows over a set of poses.

    Splits the set into cells until each is certified, falsified or too small. Writes cells.sqlite,
    report.json, report.html and the images of counterexamples. Exit codes: 0 done, whatever the verdict;
    2 bad input; 3 interrupted, or the time budget ended before every frame had a result.
    """

    load_config: Path
    """config.yml of a Splatfacto run, or a standard 3DGS .ply."""
    camera_path_filename: Path
    """Camera path as Nerfstudio's viewer writes it."""
    model: Path
    """Network: .onnx, or .pt2 of torch.export."""
    property: Path
    """What is to hold (JSON): classification, regression, detection or vnnlib, with the preprocessing."""
    output_dir: Path
    """Folder for the results; made if missing."""
    perturbation_filename: Path | None = None
    """Set of poses (JSON). Default: the key "perturbation" of the camera path, or its poses alone."""
    time_budget: float | None = None
    """Seconds for all frames together. Default: 1800."""
    frames: tuple[int, ...] | None = None
    """Entries of the camera path, counted from 0. Default: all."""
    renderer: Literal["gsplat", "paper"] | None = None
    """gsplat: what Nerfstudio shows (the default). paper: Algorithm 1 of "Abstract Rendering" (no thresholds, RGB)."""
    arithmetic: Literal["float32", "real"] | None = None
    """float32: images of every float32 evaluation (the default). real: the real-number renderer and its float64
    evaluation."""
    engine: Literal["local", "dask"] = "local"
    """dask: spread the cells over a Dask cluster (needs the extra "cluster")."""
    scheduler_address: str | None = None
    """HOST:PORT of a running Dask scheduler. Default: a cluster on this machine."""
    workers: int | None = None
    """Processes on this machine; 1 works in this process. Default: one by core."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the cells that an interrupted run with the same inputs has stored."""
    memory_limit: float | None = None
    """GiB that may be used. Default: 80 % of what is free."""


def certify(options: Certify) -> int:
    """Run the command; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    from ns_abstract.cli.certifying import certify_path

    if options.time_budget is not None and not 0.0 < options.time_budget < float("inf"):
        raise InputError(f"found {options.time_budget}", field="--time-budget", fix="give a positive number")
    if options.memory_limit is not None and not 0.0 < options.memory_limit < float("inf"):
        raise InputError(f"found {options.memory_limit}", field="--memory-limit", fix="give a positive number of GiB")
    if options.workers is not None and options.workers < 1:
        raise InputError(f"found {options.workers}", field="--workers", fix="give a number of at least 1")
    if options.engine == "local" and options.scheduler_address is not None:
        raise InputError("given without --engine dask", field="--scheduler-address", fix="add --engine dask")
    stop = Stop()
    with stop.installed():
        complete = certify_path(options, stop, options.time_budget or _SECONDS)
    return DONE if complete and not stop() else INTERRUPTED


def main() -> None:
    """Entry point of the console script."""
    run(certify, lambda: tyro.cli(Certify, prog="ns-abstract-certify"))


if __name__ == "__main__":
    main()
