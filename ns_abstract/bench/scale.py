"""Measures how cost and memory grow with the number of Gaussians and of pixels."""

from __future__ import annotations

import dataclasses
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.api.files import PathJob
from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
from ns_abstract.bench.tightness import refine
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.activate import rotation_matrices
from ns_abstract.methods.splat.frame import SplatFrame, TileBounds, VisibleContext
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.refine.engine import RefinementGoal, sampled_gap

#: Width of pictures at which the measured cell is `PART` of the set; it moves wider pictures by as many pixels.
_WIDTH = 100.0
#: Width of the measured cell as a part of the set's: about what refinement ends with.
PART = 1.0 / 32.0


def resampled(scene: SplatScene, count: int, seed: int = 0) -> SplatScene:
    """Return ``scene`` with ``count`` Gaussians: several smaller ones drawn from each, or a sample of them enlarged.

    The covered area stays: standard deviations change by the square root of the numbers' ratio.
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
    """Return one row; call it in a process of its own, whose peak memory it reports."""
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
    """Yield rows for every number of Gaussians and width; the last one, the largest, is refined for ``seconds``.

    A pair is a Gaussian and a pixel of a tile that gsplat lists it for.
    """
    for width in widths:
        for count in counts:
            refine_seconds = seconds if (count, width) == (counts[-1], widths[-1]) else 0.0
            # a process keeps its peak, so each row has its own
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                yield pool.submit(
                    _row, config, path, frame, name, count, width, repeats, refine_seconds, gibibytes, version,
                    overrides,
                ).result()  # fmt: skip


def measure(functions: Sequence[Callable[[], object]], repeats: int) -> np.ndarray:
    """Return seconds [repeats, k] of ``functions``, called in turn so that all meet the same speed of the machine."""
    for function in functions:
        function()
    seconds = np.empty((repeats, len(functions)))
    for r in range(repeats):
        for k, function in enumerate(functions):
            start = time.perf_counter()
            function()
            seconds[r, k] = time.perf_counter() - start
    return seconds


def small_cell(poses: PoseBox, part: float) -> ParameterBox:
    """Return the middle ``part`` of a set's range in every parameter."""
    cell = poses.box
    for axis in range(cell.dimensions):
        middle, half = float(cell.middle[axis]), 0.5 * part * (cell.upper[axis] - cell.lower[axis])
        cell = cell.replace(axis, middle - half, middle + half)
    return cell


def cell_cost(job: PathJob, name: str, frame: int, repeats: int) -> dict[str, object]:
    """Return times of a render, of an initial cell, and of a cell inside a bounded one, and their ratios.

    The initial cell is bounded with the omissions of a run to the usual target, the other one without, as in
    refinement. Times are medians in milliseconds; ratios to the render are medians of ``repeats`` triples that were
    timed one after another, so that they meet the machine at the same speed.
    """
    poses = pose_set(job, name, frame)
    splat = splat_of(job)
    view = SplatFrame(splat.splats, splat.rasteriser, splat.arithmetic, poses)
    excess = (RefinementGoal().ratio - 1.0) * sampled_gap(view, frame, job.seed) if poses.box.dimensions == 1 else 0.0
    cell = small_cell(poses, PART)
    tiles = np.arange(view.tile_count)
    around = view.bound(cell, tiles).context

    def bounded(allowed: float, within: VisibleContext | None) -> TileBounds:
        view.set_tolerance(allowed)
        return view.bound(cell, tiles, within)

    seconds = measure(
        [lambda: view.render(cell.middle), lambda: bounded(excess, None), lambda: bounded(0.0, around)], repeats
    )
    median, ratios = np.median(seconds, axis=0), np.median(seconds[:, 1:] / seconds[:, :1], axis=0)
    return {
        "scene": job.method.name,
        "Gaussians": splat.splats.count,
        "size": f"{view.camera.width}x{view.camera.height}",
        "set": name,
        "parameters": cell.dimensions,
        "render ms": 1e3 * median[0],
        "cell ms": 1e3 * median[1],
        "inner cell ms": 1e3 * median[2],
        "cell / render": ratios[0],
        "inner cell / render": ratios[1],
    }
