"""``ns-abstract-certify``: what a network does on every image of a set of poses."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ns_abstract.cli.common import DONE, INTERRUPTED, Stop, run
from ns_abstract.cli.scenes import GivenScene, overrides
from ns_abstract.cli.sets import GivenSet, given_set
from ns_abstract.io.errors import InputError

#: Seconds where no time budget is given.
_SECONDS = 1800.0


@dataclass
class Certify(GivenSet, GivenScene):
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
    renderer: Literal["gsplat", "paper"] | None = None
    """gsplat: what Nerfstudio shows of splats (the default for them). paper: Algorithm 1 (splats: no thresholds,
    RGB) or 2 (NeRF: black behind the last sample) of "Abstract Rendering"."""
    gsplat_version: Literal["1.4.0", "1.5.3", "1.6.0"] | None = None
    """Splats: whose rules are bounded. Default: 1.4.0, which nerfstudio 1.1.5 asks for."""
    arithmetic: Literal["float32", "real"] | None = None
    """float32: images of every float32 evaluation (splats, the default for them). real: the real-number renderer and
    its float64 evaluation."""
    sampling: Literal["uniform", "hierarchical"] | None = None
    """NeRF. uniform (default): the fine field in the middles of equal bins. hierarchical: Nerfstudio's own picture,
    its samples followed where the coarse pass puts them."""
    num_samples: int | None = None
    """NeRF: bins of every ray. Default: 64."""
    near_plane: float | None = None
    """NeRF: distance at which rays start. Default: 0, as in Nerfstudio's evaluation."""
    occupancy_grid: Path | None = None
    """NeRF: declare the field empty outside of this grid's occupied voxels (.npz, see ns-abstract-export occupancy).
    That makes it another scene, for which the certificate holds."""
    device: Literal["cpu", "cuda"] | None = None
    """NeRF. cuda: bound the field on a GPU, in float64. Default: cpu."""
    network_arithmetic: Literal["float32", "real"] = "float32"
    """float32: every float32 evaluation of the network (the default). real: the exact function of its weights alone."""
    picture: Literal["float", "8-bit"] = "float"
    """float: the renderer's floats (the default). 8-bit: these rounded to multiples of 1/255, as files and cameras
    have them."""
    engine: Literal["local", "dask"] = "local"
    """dask: spread the cells over a Dask cluster (needs the extra "cluster")."""
    scheduler_address: str | None = None
    """HOST:PORT of a running Dask scheduler. Default: a cluster on this machine."""
    tls_ca_file: Path | None = None
    """Certificate of who signs the scheduler's (PEM), as for `dask scheduler`; with --tls-cert and --tls-key."""
    tls_cert: Path | None = None
    """This command's certificate (PEM)."""
    tls_key: Path | None = None
    """The certificate's key (PEM)."""
    workers: int | None = None
    """Processes on this machine; 1 works in this process. They bound cells of splats, rays of a NeRF. Default: one by
    core."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the cells that an interrupted run with the same inputs has stored."""
    scene_margin: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Splats: in half of the time, look for the largest variation of all Gaussians' means, opacities and colours, of
    the camera's response and of the place of the whole scene for which everything that is certified holds."""
    memory_limit: float | None = None
    """GiB that may be used. Default: 80 % of what is free."""


def certify(options: Certify) -> int:
    """Run the command; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    if options.time_budget is not None and not 0.0 < options.time_budget < float("inf"):
        raise InputError(f"found {options.time_budget}", field="--time-budget", fix="give a positive number")
    if options.workers is not None and options.workers < 1:
        raise InputError(f"found {options.workers}", field="--workers", fix="give a number of at least 1")
    if options.engine == "local" and options.scheduler_address is not None:
        raise InputError("given without --engine dask", field="--scheduler-address", fix="add --engine dask")
    stop = Stop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.api.certification import CertifySettings
            from ns_abstract.cli.certifying import Order, certify_path
            from ns_abstract.execution.engines import Tls

        names = {entry.name for entry in fields(CertifySettings)}
        given = {name: value for name, value in vars(options).items() if name in names}
        if options.workers is None:
            given["workers"] = 1 if options.engine == "dask" else len(os.sched_getaffinity(0))
        given |= {"given_set": given_set(options), "overrides": overrides(options)}
        tls = Tls.of(options.tls_ca_file, options.tls_cert, options.tls_key, options.scheduler_address)
        order = Order(
            CertifySettings(**given), options.frames, options.output_dir, options.time_budget or _SECONDS,
            options.engine, options.scheduler_address, tls, options.workers, options.resume, options.memory_limit,
            options.scene_margin, vars(options),
        )  # fmt: skip
        complete = certify_path(order, stop)
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
