"""Error against run time: how the ratio of outer to inner gap falls."""

from __future__ import annotations

from dataclasses import replace

from ns_abstract.api.files import PathJob
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.refine.engine import Refinement
from ns_abstract.refine.result import FrameResult, max_pixel_gap
from ns_abstract.report.figures import seconds_to

#: Ratios whose time is reported.
MARKS = (1.5, 1.25, 1.1, 1.05, 1.02, 1.01)


def refine(job: PathJob, poses: PoseBox, frame: int, seconds: float, ratio: float) -> FrameResult:
    """The abstract image of ``poses`` about entry ``frame``; kernels are compiled before the clock starts."""
    view, seed = job.method.frame(poses, sheared=True), job.seed
    view.warm_up()
    result = Refinement(view, frame, job.goal(ratio, seconds), seed=seed, members=view.scene_samples(seed)).run()
    return replace(result, box=poses.box)


def summary(job: PathJob, name: str, result: FrameResult) -> dict[str, object]:
    """One row: final figures, and the seconds after which each of `MARKS` was reached."""
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
