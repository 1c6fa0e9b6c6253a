"""Measure what the omissions of a plan save: each is reverted, and the bounds are compared.

python benchmarks/plan.py [RUN/config.yml ...] [--sets x yaw]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.api.files import PathJob
from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
from ns_abstract.bench.tables import Table
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.frame import SplatFrame, VisibleContext
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.refine.result import FrameResult

#: More than any run of a given number of cells takes.
_LONG = 1e6


class _EveryGaussian(SplatFrame):
    """Looks at every Gaussian in every cell, whatever the cell around it shows."""

    def candidates(
        self, tiles: np.ndarray, within: VisibleContext | None, pixels: np.ndarray | None
    ) -> np.ndarray | None:
        return None


def _refined(frame: SplatFrame, index: int, cells: int, seed: int) -> tuple[FrameResult, float]:
    """The result of a given number of cells, and its processor seconds."""
    frame.warm_up()
    started = time.process_time()
    result = Refinement(frame, index, RefinementGoal(1.0, _LONG, cells), seed=seed).run()
    return result, time.process_time() - started


def cost_of_omissions(job: PathJob, name: str, frame: int, cells: int, scale: float = 1.0) -> list[dict[str, Any]]:
    """One row for the bounds as planned, and one for each omission of the plan that is taken back.

    All are refined to the same number of ``cells``.

    Returns:
        Processor seconds, gaps, and by how much any bound of any pixel is tighter or looser than the plan's.
    """
    poses, splat = pose_set(job, name, frame, scale), splat_of(job)

    def view(kind: type[SplatFrame], every_band: bool) -> Callable[[PoseBox], SplatFrame]:
        splats = activate(splat.scene, splat.rasteriser, every_band)
        return lambda p: kind(splats, splat.rasteriser, splat.arithmetic, p)

    variants: dict[str, Callable[[PoseBox], SplatFrame]] = {
        "as planned": view(SplatFrame, False),
        "every Gaussian in every cell": view(_EveryGaussian, False),
    }
    if activate(splat.scene, splat.rasteriser, True).degree > splat.splats.degree:
        variants["harmonics that are zero"] = view(SplatFrame, True)
    rows: list[dict[str, Any]] = []
    planned: FrameResult | None = None
    first = 0.0
    for variant, make in variants.items():
        result, seconds = _refined(make(poses), frame, cells, job.seed)
        if planned is None:
            planned, first = result, seconds
        raised, lowered = result.lower - planned.lower, planned.upper - result.upper
        rows.append(
            {
                "scene": job.method.name,
                "size": f"{result.lower.shape[1]}x{result.lower.shape[0]}",
                "set": name,
                "taken back": variant,
                "cells": result.cells,
                "CPU s": seconds,
                "time": seconds / first,
                "MPG": result.trace[-1].mpg,
                "tighter by": float(np.maximum(raised, lowered).max().clip(0.0)),
                "looser by": float(np.maximum(-raised, -lowered).max().clip(0.0)),
            }
        )
    return rows


def main(words: Sequence[str] | None = None) -> int:
    """Measure runs, or the demo scene."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("load_config", type=Path, nargs="*")
    parser.add_argument("--camera-path-filename", type=Path)
    parser.add_argument("--output-dir", type=Path, default=Path("bench"))
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--downscale-factor", type=float, default=1.0)
    parser.add_argument("--sets", nargs="+", default=["x", "yaw"])
    parser.add_argument("--scale", type=float, default=1.0, help="multiplies the ranges of translations and rotations")
    parser.add_argument("--cells", type=int, default=24, help="that every scene and set is bounded with")
    options = parser.parse_args(words)
    table = Table(options.output_dir, "plan", "What is left out, taken back")
    for job in open_jobs(tuple(options.load_config), options.camera_path_filename, options.downscale_factor):
        for name in options.sets:
            table.add(*cost_of_omissions(job, name, options.frame, options.cells, options.scale))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
