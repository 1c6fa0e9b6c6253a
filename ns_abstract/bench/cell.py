"""What one bounded cell costs, in units of the concrete render of the same view."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from ns_abstract.api.files import PathJob
from ns_abstract.bench.sets import pose_set, splat_of
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.frame import SplatFrame, TileBounds, VisibleContext
from ns_abstract.refine.engine import RefinementGoal, sampled_gap

#: Width of the measured cell as a part of the set's: about what refinement ends with.
PART = 1.0 / 32.0


def measure(functions: Sequence[Callable[[], object]], repeats: int) -> np.ndarray:
    """Seconds [repeats, k] of ``functions``, called in turn so that all see the same machine."""
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
    """The middle ``part`` of a set's range in every parameter."""
    cell = poses.box
    for axis in range(cell.dimensions):
        middle, half = float(cell.middle[axis]), 0.5 * part * (cell.upper[axis] - cell.lower[axis])
        cell = cell.replace(axis, middle - half, middle + half)
    return cell


def cell_cost(job: PathJob, name: str, frame: int, repeats: int) -> dict[str, object]:
    """Times of the render, of a cell of a first cover and of a cell inside a bounded one, and their ratios.

    The first leaves out what a run to the usual goal leaves out of its cover, the second nothing, as in refinement.

    Returns:
        Milliseconds (medians), and medians of the ratios to the render: each of ``repeats`` times the three follow one
        another, so that they see the machine at the same speed.
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
