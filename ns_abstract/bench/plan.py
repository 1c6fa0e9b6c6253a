"""Measures what each omission of a plan saves: it is reverted, and time and bounds are compared."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ns_abstract.api.files import PathJob
from ns_abstract.bench.sets import pose_set, splat_of
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.frame import SplatFrame, VisibleContext
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.refine.result import FrameResult

#: More than any run of a given number of cells takes.
_LONG = 1e6


class _EveryGaussian(SplatFrame):
    """A frame that considers every Gaussian in every cell, not only those visible in the enclosing cell."""

    def candidates(
        self, tiles: np.ndarray, within: VisibleContext | None, pixels: np.ndarray | None
    ) -> np.ndarray | None:
        return None


def _refined(frame: SplatFrame, index: int, cells: int, seed: int) -> tuple[FrameResult, float]:
    """Return the result after a number of cells, and its processor seconds."""
    frame.warm_up()
    started = time.process_time()
    result = Refinement(frame, index, RefinementGoal(1.0, _LONG, cells), seed=seed).run()
    return result, time.process_time() - started


def cost_of_omissions(job: PathJob, name: str, frame: int, cells: int, scale: float = 1.0) -> list[dict[str, Any]]:
    """Return a row for the bounds as planned, and one for each omission of the plan that is reverted.

    All are refined to the same number of ``cells``.

    Returns:
        Processor seconds, gaps, and the largest change of any pixel's bound against the plan's, tighter and looser.
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
