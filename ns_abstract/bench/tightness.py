"""Error against run time: how the ratio of outer to inner gap falls."""

from __future__ import annotations

from dataclasses import replace

from ns_abstract.api.files import PathJob
from ns_abstract.bench.sets import pose_set, splat_of
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.refine.engine import Refinement
from ns_abstract.refine.result import FrameResult, max_pixel_gap
from ns_abstract.report.figures import seconds_to
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import compiled_renderer, reference_renderer

#: Ratios whose time is reported.
MARKS = (1.5, 1.25, 1.1, 1.05, 1.02, 1.01)


def refine(job: PathJob, poses: PoseBox, frame: int, seconds: float, ratio: float) -> FrameResult:
    """Return the abstract image of ``poses`` about entry ``frame``; kernels are compiled before the clock begins."""
    view, seed = job.method.frame(poses, sheared=True), job.seed
    view.warm_up()
    result = Refinement(view, frame, job.goal(ratio, seconds), seed=seed, scene_samples=view.scene_samples(seed)).run()
    return replace(result, box=poses.box)


def summary(job: PathJob, name: str, result: FrameResult) -> dict[str, object]:
    """Return one row of the table: final figures, and the seconds after which each of `MARKS` was reached."""
    last = result.trace[-1]
    row: dict[str, object] = {
        "scene": job.method.name,
        "size": f"{result.lower.shape[1]}x{result.lower.shape[0]}",
        "program": "{name} {version}".format_map(job.method.program),
        "set": name,
        "Rt s": last.seconds,
        "cells": last.cells,
        "MPG": last.mpg,
        "XPG": max_pixel_gap(result.lower, result.upper),
        "witness MPG": last.mpg_witness,
        "ratio": last.mpg / last.mpg_witness if last.mpg_witness else float("nan"),
    }
    return row | {f"s to {mark:g}": seconds for mark, seconds in seconds_to(result.trace, MARKS).items()}


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
