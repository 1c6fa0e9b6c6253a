"""``ns-abstract-render``: abstract images of a camera path."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ns_abstract.cli.common import DONE, INTERRUPTED, Stop, run
from ns_abstract.cli.scenes import GivenScene, overrides
from ns_abstract.cli.sets import GivenSet, given_set
from ns_abstract.io.errors import InputError

if TYPE_CHECKING:
    from ns_abstract.api.files import PathJob
    from ns_abstract.perturbation.specification import Perturbation

#: Seconds by frame where --explain is given none.
_EXPLAINED_S = 30.0


@dataclass
class Render(GivenSet, GivenScene):
    """Bound every image that Nerfstudio would show, for every pose in a set around each keyframe.

    Writes frame_00000.npz and .png by keyframe, report.json and report.html. Exit codes: 0 done;
    2 bad input; 3 interrupted, or the time budget ended before every frame had a result.
    """

    load_config: Path
    """config.yml of a Splatfacto or vanilla-nerf run, or a standard 3DGS .ply."""
    camera_path_filename: Path
    """Camera path as Nerfstudio's viewer writes it."""
    output_dir: Path
    """Folder for the results; made if missing."""
    time_budget: float | None = None
    """Seconds for all frames together. Default: 60 per frame."""
    target_ratio: float = 1.05
    """A frame is done when its mean pixel gap is at most this many times the one of real renders."""
    frames: tuple[int, ...] | None = None
    """Entries of the camera path, counted from 0. Default: all."""
    downscale_factor: float = 1.0
    """Images become this many times smaller."""
    renderer: Literal["gsplat", "paper"] | None = None
    """gsplat: what Nerfstudio shows of splats (the default for them). paper: Algorithm 1 (splats: no thresholds,
    RGB) or 2 (NeRF: black behind the last sample) of "Abstract Rendering"."""
    gsplat_version: Literal["1.4.0", "1.5.3", "1.6.0"] | None = None
    """Splats: whose rules are bounded. Default: 1.4.0, which nerfstudio 1.1.5 asks for."""
    arithmetic: Literal["float32", "real"] | None = None
    """float32: enclose every float32 evaluation (splats, the default for them). real: the real-number renderer and
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
    That makes it another scene, for which the bounds hold."""
    device: Literal["cpu", "cuda"] | None = None
    """NeRF. cuda: bound the field on a GPU, in float64. Default: cpu."""
    outputs: tuple[Literal["rgb", "depth", "accumulation"], ...] = ("rgb",)
    """What is bounded. rgb is always; depth: gsplat's expected depth, normalised units (splats). accumulation: the part
    of the light that the scene takes."""
    seed: int = 0
    """Seed of the random witnesses."""
    engine: Literal["local", "dask"] = "local"
    """dask: spread the frames, and tiles where frames are few, over a Dask cluster (needs the extra "cluster")."""
    scheduler_address: str | None = None
    """HOST:PORT of a running Dask scheduler. Default: a cluster on this machine."""
    tls_ca_file: Path | None = None
    """Certificate of who signs the scheduler's (PEM), as for `dask scheduler`; with --tls-cert and --tls-key."""
    tls_cert: Path | None = None
    """This command's certificate (PEM)."""
    tls_key: Path | None = None
    """The certificate's key (PEM)."""
    workers: int | None = None
    """NeRF: processes that bound rays. Default: one for every core."""
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


@dataclass
class Describe(Render):
    """Tell what cameras, units and set mean, in pixels and distances, and do nothing else."""

    output_dir: Path = Path()
    """Not used."""


@dataclass
class Explain(Render):
    """Bound the frames, tell why their bounds are wider than renders, and write nothing."""

    output_dir: Path = Path()
    """Not used."""


def opened(options: Render, default: Perturbation | None = None) -> PathJob:
    """The job of a command that runs in this process alone; ``default``: see `open_job`."""
    from ns_abstract.api.files import Settings, open_job

    names = {entry.name for entry in fields(Settings)}
    given = {name: value for name, value in vars(options).items() if name in names}
    return open_job(
        Settings(**given | {"workers": 1, "given_set": given_set(options), "overrides": overrides(options)}),
        default=default,
    )


def explain(options: Explain) -> int:
    """Bound and explain frame by frame; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    from ns_abstract.api.bounding import bound_frames
    from ns_abstract.api.explaining import check_explained
    from ns_abstract.api.explaining import explain as explained
    from ns_abstract.api.job import check_frames
    from ns_abstract.execution.engines import Here

    job = opened(options)
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


def describe(options: Describe) -> int:
    """Print what is about to be bounded; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    from ns_abstract.api.describe import describe as described
    from ns_abstract.api.job import check_frames
    from ns_abstract.io.errors import visible
    from ns_abstract.perturbation.specification import Perturbation

    # a path that says nothing of a set is looked at all the same
    job = opened(options, Perturbation())
    for line in described(job, check_frames(options.frames, job.frame_count)):
        print(visible(line))
    return DONE


def render(options: Render) -> int:
    """Run the command; returns the exit code.

    Raises:
        InputError: A file, a field or an option cannot be used.
    """
    for name, value in (("--target-ratio", options.target_ratio), ("--time-budget", options.time_budget)):
        if value is not None and not 0.0 < value < float("inf"):
            raise InputError(f"found {value}", field=name, fix="give a positive number")
    if options.target_ratio < 1.0:
        raise InputError(f"found {options.target_ratio}", field="--target-ratio", fix="give a number of at least 1")
    if options.workers is not None and options.workers < 1:
        raise InputError(f"found {options.workers}", field="--workers", fix="give at least 1")
    if options.seed < 0:
        raise InputError(f"found {options.seed}", field="--seed", fix="give a number of at least 0")
    if options.engine == "local" and options.scheduler_address is not None:
        raise InputError("given without --engine dask", field="--scheduler-address", fix="add --engine dask")
    stop = Stop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.api.files import Settings
            from ns_abstract.cli.rendering import Order, render_path
            from ns_abstract.execution.engines import Tls

        names = {entry.name for entry in fields(Settings)}
        given = {name: value for name, value in vars(options).items() if name in names}
        if options.workers is None:
            given["workers"] = 1 if options.engine == "dask" else len(os.sched_getaffinity(0))
        given |= {"given_set": given_set(options), "overrides": overrides(options)}
        tls = Tls.of(options.tls_ca_file, options.tls_cert, options.tls_key, options.scheduler_address)
        order = Order(
            Settings(**given), options.frames, options.output_dir, options.time_budget, options.target_ratio,
            options.engine, options.scheduler_address, tls, options.resume, options.save_cells, options.explain,
            vars(options),
        )  # fmt: skip
        complete = render_path(order, stop)
    return DONE if complete and not stop() else INTERRUPTED


def main() -> None:
    """Entry point of the console script."""
    if "--describe" in sys.argv[1:]:
        run(describe, lambda: tyro.cli(Describe, prog="ns-abstract-render"))
    elif "--explain" in sys.argv[1:] and not any(w.replace("_", "-").startswith("--output-dir") for w in sys.argv[1:]):
        run(explain, lambda: tyro.cli(Explain, prog="ns-abstract-render"))
    run(render, lambda: tyro.cli(Render, prog="ns-abstract-render"))


if __name__ == "__main__":
    main()
