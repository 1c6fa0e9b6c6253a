"""Stiff cases: tiny scenes at the limits of what can be loaded, each bounded and then attacked.

Every scene could be in a run (finite parameters; scales and quaternion lengths that are normal float32), and every set
in a perturbation file. A case passes if no image of three renderers leaves its abstract image and every computed number
is finite.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ns_abstract.arithmetic.rounding import Arithmetic
from ns_abstract.arithmetic.rounding import arithmetic as arithmetic_of
from ns_abstract.bench.stiff_cases import Case
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import Splats, activate
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0, Rasteriser
from ns_abstract.methods.splat.frame import SplatFrame, TileBounds, VisibleContext
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.refine.result import mean_pixel_gap
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import compiled_renderer, reference_renderer
from ns_abstract.verify.attack.violations import Violation, merge

ARITHMETICS = ("float32", "real")


@dataclass(frozen=True)
class Outcome:
    """The outcome of a case that was bounded and attacked."""

    row: dict[str, Any]
    worst: tuple[Violation, ...]

    @property
    def failed(self) -> bool:
        """Whether a bound was broken or a number was not finite."""
        return bool(self.row["violations"] or self.row["NaN/inf"])


class WatchedFrame(SplatFrame):
    """A `SplatFrame` that counts faulty numbers: NaN, infinities, and lower bounds above upper ones.

    Refinement replaces such bounds by [0, 1], which is sound but hides them.

    Attributes:
        not_finite: Bounds, slopes and pixels that were returned and are NaN or infinite.
        crossed: Pixel channels whose lower bound exceeds the upper one.
    """

    def __init__(self, splats: Splats, rasteriser: Rasteriser, arithmetic: Arithmetic, pose_set: PoseBox) -> None:
        super().__init__(splats, rasteriser, arithmetic, pose_set)
        self.not_finite = self.crossed = 0

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Return `SplatFrame.render`, recorded."""
        picture = super().render(values, tiles)
        self.not_finite += _not_finite(picture)
        return picture

    def bound(
        self, box: ParameterBox, tiles: np.ndarray, within: VisibleContext | None = None, keep_linear: bool = False,
        pixels: np.ndarray | None = None,
    ) -> TileBounds:  # fmt: skip
        """Return `SplatFrame.bound`, recorded."""
        tile_bounds = super().bound(box, tiles, within, keep_linear, pixels)
        self.not_finite += _not_finite(
            tile_bounds.lower, tile_bounds.upper, tile_bounds.slopes, *(tile_bounds.linear or ())
        )
        self.crossed += int((tile_bounds.lower > tile_bounds.upper).sum())
        return tile_bounds

    def bound_parts(
        self,
        boxes: Sequence[ParameterBox],
        tiles: np.ndarray,
        within: VisibleContext | None,
        keep_linear: bool,
        pixels: np.ndarray | None,
    ) -> list[TileBounds]:
        """Return `SplatFrame.bound_parts`, one box at a time, since they are counted."""
        return [self.bound(box, tiles, within, keep_linear, pixels) for box in boxes]


def _not_finite(*arrays: np.ndarray) -> int:
    return sum(int(a.size - np.isfinite(a).sum()) for a in arrays)


def run_case(
    case: Case,
    arithmetic: str,
    *,
    cells: int = 16,
    seconds: float = 20.0,
    poses: int = 60,
    reference_poses: int = 16,
    seed: int = 0,
    frame: Callable[..., WatchedFrame] = WatchedFrame,
) -> Outcome:
    """Return the outcome of one case, refined for a fixed number of cells, then attacked through all renderers.

    The compiled renderer and the float64 reference attack both arithmetics, the float32 reference attacks "float32".
    The work ends after ``cells`` unless the bounds are as tight as the witnesses; ``seconds`` limit the refinement and
    each attack, and reaching that makes the outcome depend on the machine. ``poses`` are rendered by the compiled
    renderer, ``reference_poses`` by each reference. ``frame``: bounds and renders, called like `SplatFrame`.
    """
    began = time.perf_counter()
    pose_set = case.pose_set()
    view = frame(activate(case.scene, GSPLAT_1_4_0), GSPLAT_1_4_0, arithmetic_of(arithmetic), pose_set)
    result = Refinement(view, 0, RefinementGoal(ratio=1.0, seconds=seconds, cells=cells), seed=seed).run()
    render, probe = compiled_renderer(case.scene, pose_set, GSPLAT_1_4_0)
    other, other_probe, twin = reference_renderer(case.scene, pose_set, GSPLAT_1_4_0)
    programs = [(render, probe, poses), (other, other_probe, reference_poses)]
    if arithmetic == "float32":
        single, single_probe, _ = reference_renderer(case.scene, pose_set, GSPLAT_1_4_0, torch.float32)
        programs.append((single, single_probe, reference_poses))
    attacks = []
    for number, (program, pixel, budget) in enumerate(programs):
        # where the first renderer came closest, the others look first
        starts = attacks[0].closest[: budget // 2] if attacks else None
        attacks.append(
            falsify(
                result.lower, result.upper, pose_set.box, program, twin,
                probe=pixel, poses=budget, seconds=seconds, seed=seed + number, starts=starts,
            )
        )  # fmt: skip
    attack = merge(attacks)
    # refinement's own renders must lie inside as well
    outside = (result.witness_lower < result.lower) | (result.witness_upper > result.upper)
    mpg = mean_pixel_gap(result.lower, result.upper)
    witness = mean_pixel_gap(
        np.fmin(attack.witness_lower, result.witness_lower), np.fmax(attack.witness_upper, result.witness_upper)
    )
    row = {
        "case": case.name,
        "Gaussians": case.scene.count,
        "size": f"{case.camera.width}x{case.camera.height}",
        "parameters": " ".join(pose_set.box.names) or None,
        "arithmetic": arithmetic,
        "cells": result.cells,
        "comparisons": attack.comparisons + 2 * outside.size,
        "violations": attack.violations + int(outside.sum()) + view.crossed,
        "worst": attack.amount,
        "NaN/inf": attack.not_finite + view.not_finite,
        "MPG": mpg,
        "witness MPG": witness,
        "ratio": mpg / witness if witness > 0.0 else None,
        "seconds": time.perf_counter() - began,
    }
    return Outcome(row, attack.worst)


def compare(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return what float32 costs against real arithmetic in gap and time, for every case that ran in both."""
    by_case = {(row["case"], row["arithmetic"]): row for row in rows}
    pairs = [(row, by_case[name, "real"]) for (name, kind), row in by_case.items() if (name, "real") in by_case]
    return [
        {
            "case": single["case"],
            "MPG float32": single["MPG"],
            "MPG real": exact["MPG"],
            "float32 - real": single["MPG"] - exact["MPG"],
            "seconds float32 / real": single["seconds"] / exact["seconds"],
        }
        for single, exact in pairs
        if single is not exact
    ]


# --- what the cases are made of ------------------------------------------------------------------
