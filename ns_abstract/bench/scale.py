"""How cost and memory grow with the number of Gaussians and of pixels."""

from __future__ import annotations

import dataclasses
import multiprocessing
import resource
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.bench.cell import PART, measure, small_cell
from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
from ns_abstract.bench.tightness import refine
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.activate import rotation_matrices
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.methods.splat.scene import SplatScene

#: Width of pictures at which the measured cell is `PART` of the set; it moves wider pictures by as many pixels.
_WIDTH = 100.0


def resampled(scene: SplatScene, count: int, seed: int = 0) -> SplatScene:
    """``scene`` with ``count`` Gaussians: several smaller ones drawn from each, or larger ones from a part of them.

    What they cover together stays: standard deviations change by the square root of the numbers' ratio.
    """
    random = np.random.default_rng(seed)
    if count <= scene.count:
        chosen = np.sort(random.permutation(scene.count)[:count])
    else:
        chosen = np.sort(np.concatenate([
            np.tile(np.arange(scene.count), count // scene.count),
            random.permutation(scene.count)[: count % scene.count],
        ]))  # fmt: skip
    shrink = 0.5 * np.log(scene.count / count)
    means, scales, quats = scene.means[chosen], scene.log_scales[chosen], scene.quats[chosen]
    if count > scene.count:
        offsets = np.exp(scales.astype(np.float64)) * random.standard_normal((count, 3))
        turned = np.einsum("nij,nj->ni", rotation_matrices(quats.astype(np.float64)), offsets)
        means = (means + turned).astype(np.float32)
    return dataclasses.replace(
        scene, means=means, log_scales=(scales + np.float32(shrink)), quats=quats,
        opacity_logits=scene.opacity_logits[chosen], sh=scene.sh[chosen], dropped={}, stored=None,
    )  # fmt: skip


def _row(
    config: Path, path: Path | None, frame: int, name: str, count: int, width: int, repeats: int, seconds: float,
    gibibytes: float, version: str | None, overrides: Overrides | None,
) -> dict[str, Any]:  # fmt: skip
    """One row; to be run in a process of its own, whose peak memory is told."""
    (job,) = open_jobs((config,), path, 1.0, overrides=overrides)
    (job,) = open_jobs((config,), path, job.path.cameras[frame].width / width, overrides=overrides)
    job.memory_limit = gibibytes
    job.method = splat = SplatMethod(resampled(splat_of(job).scene, count), None, None, version)
    poses = pose_set(job, name, frame, _WIDTH / width)
    view = SplatFrame(splat.splats, splat.rasteriser, splat.arithmetic, poses)
    cell, tiles = small_cell(poses, PART), np.arange(view.tile_count)
    entries = view.renderer.lists(splat.splats, view.camera, *poses.world_to_camera(cell.middle), tiles).entries
    pairs = entries.size * view.side**2
    times = measure([lambda: view.render(cell.middle), lambda: view.bound(cell, tiles)], repeats).min(axis=0)
    row: dict[str, Any] = {
        "scene": job.method.name,
        "Gaussians": count,
        "size": f"{view.camera.width}x{view.camera.height}",
        "million pairs": pairs / 1e6,
        "render ms": 1e3 * times[0],
        "cell ms": 1e3 * times[1],
        "cell / render": times[1] / times[0],
        "render ns / pair": 1e9 * times[0] / pairs,
        "cell ns / pair": 1e9 * times[1] / pairs,
        "s of refinement": None,
        "ratio": None,
    }
    if seconds > 0.0:
        result = refine(job, poses, frame, seconds, 1.0)
        last = result.trace[-1]
        row |= {"s of refinement": last.seconds, "ratio": last.mpg / last.mpg_witness if last.mpg_witness else None}
    # kibibytes, on macOS bytes
    unit = 1 if sys.platform == "darwin" else 1024
    return {**row, "peak GiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30}


def curve(
    config: Path, path: Path | None, frame: int, name: str, counts: Sequence[int], widths: Sequence[int],
    repeats: int, seconds: float, gibibytes: float, version: str | None = None,
    overrides: Overrides | None = None,
) -> Iterator[dict[str, Any]]:  # fmt: skip
    """Rows for every number of Gaussians and width; the last one, the largest, is refined for ``seconds``.

    A pair is a Gaussian and a pixel of a tile that gsplat lists it for.
    """
    for width in widths:
        for count in counts:
            refine_seconds = seconds if (count, width) == (counts[-1], widths[-1]) else 0.0
            # a process keeps its peak, so each row has its own
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                arguments = (
                    config,
                    path,
                    frame,
                    name,
                    count,
                    width,
                    repeats,
                    refine_seconds,
                    gibibytes,
                    version,
                    overrides,
                )
                yield pool.submit(_row, *arguments).result()
