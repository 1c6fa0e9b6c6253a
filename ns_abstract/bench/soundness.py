"""Attacks on the abstract images that refinement ends with."""

from __future__ import annotations

import numpy as np

from ns_abstract.api.files import PathJob
from ns_abstract.arithmetic.outward import outward
from ns_abstract.bench.sets import pose_set, splat_of
from ns_abstract.bench.tightness import refine
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat.bounds import CellBounds, SplatBounds
from ns_abstract.methods.splat.stage_data import shared_out
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import compiled_renderer, reference_renderer

#: Parts of a cell that is bounded over them, too.
_PARTS = 16


def bounded_both_ways(
    bounds: SplatBounds, poses: PoseBox, cell: ParameterBox, layers: bool
) -> tuple[CellBounds, np.ndarray, np.ndarray]:
    """A cell's bounds by forms, and [H, W, 3] float32 bounds of its picture: theirs or those over parts, the tighter.

    To attack them is to attack both.
    """
    forms = poses.enclosure(cell, 1)
    cell_bounds = bounds.cell(poses.camera, forms, layers=layers)
    lower, upper = cell_bounds.lower, cell_bounds.upper
    if cell.dimensions:
        over_parts = bounds.cell(poses.camera, forms, parts=shared_out(np.ones(cell.dimensions), _PARTS))
        lower, upper = np.maximum(lower, over_parts.lower), np.minimum(upper, over_parts.upper)
    return cell_bounds, *outward(assemble(lower, poses.camera), assemble(upper, poses.camera))


def attack(
    job: PathJob, name: str, frame: int, seconds: float, poses: int, reference_poses: int, seed: int,
    scale: float = 1.0, ratio: float = 1.0,
) -> dict[str, object]:  # fmt: skip
    """Refine one frame to ``ratio``, then attack it: random poses, corners, gradient ascent and jumps.

    Gradient ascent goes through the differentiable reference; what it finds is rendered by the compiled renderer.
    The poses that came closest, random ones and corners are then rendered by the reference as well.
    """
    poses_set, splat = pose_set(job, name, frame, scale), splat_of(job)
    result = refine(job, poses_set, frame, seconds, ratio)
    render, probe = compiled_renderer(splat.scene, poses_set, splat.rasteriser)
    other, other_probe, twin = reference_renderer(splat.scene, poses_set, splat.rasteriser)
    first = falsify(result.lower, result.upper, poses_set.box, render, twin, probe=probe, poses=poses, seed=seed)
    second = falsify(
        result.lower, result.upper, poses_set.box, other, twin, probe=other_probe, poses=reference_poses,
        seed=seed + 1, starts=first.closest, strategies=("given", "corners", "random"),
    )  # fmt: skip
    last = result.trace[-1]
    return {
        "scene": job.method.name,
        "size": f"{result.lower.shape[1]}x{result.lower.shape[0]}",
        "program": "{name} {version}".format_map(job.method.program),
        "set": name,
        "ratio": last.mpg / last.mpg_witness if last.mpg_witness else float("nan"),
        "poses": first.poses,
        "reference poses": second.poses,
        "ascent steps": first.steps + second.steps,
        "comparisons": first.comparisons + second.comparisons,
        "violations": first.violations + second.violations,
        "not finite": first.not_finite + second.not_finite,
        "worst": max(first.amount, second.amount),
    }
