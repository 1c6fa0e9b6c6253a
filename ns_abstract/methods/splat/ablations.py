"""Ablations of a splat scene: frames without one cause of looseness, whose gain is what the cause costs.

Their bounds hold of another program or scene than the one asked for. They explain bounds and are never results.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ns_abstract.arithmetic.rounding import REAL, Arithmetic
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox, PoseForms
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import Rasteriser
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.stage_data import ProjectedGaussians, ViewingAxes
from ns_abstract.methods.splat.variations import VariedSplats, vary


@dataclass(frozen=True)
class CauseTuning:
    """What stands for the absence of a rule, and how many Gaussians are looked at; no bound of a picture uses them."""

    #: The threshold that stands for none: a jump by this part of it is not seen.
    threshold_part: float = 2.0**-5
    #: Groups of Gaussians that are left out in turn, and of them what is looked at closer.
    groups: int = 12
    closer: int = 3


_TUNING = CauseTuning()
_WITH_TILES = "the alpha threshold and tiles"


class _OrderedBounds(SplatBounds):
    """Bounds that assume the depth order of the cell's middle."""

    def _viewing_axes(
        self, forms: PoseForms, rotation_magnitude: np.ndarray, gaussians: ProjectedGaussians
    ) -> ViewingAxes:
        axes = super()._viewing_axes(forms, rotation_magnitude, gaussians)
        gaussians.depth_error[:] = 0.0
        axes.depth[1:] = 0.0
        return axes


def ablations(
    scene: SplatScene, rasteriser: Rasteriser, arithmetic: Arithmetic, poses: PoseBox, varied: VariedSplats
) -> Iterator[tuple[str, SplatFrame]]:
    """Return the causes of looseness that the scene has, each with the frame without it."""

    def frame(rules: Rasteriser = rasteriser, computed: Arithmetic = arithmetic, fixed: bool = False) -> SplatFrame:
        splats = activate(scene, rules)
        scenes = None
        if varied.varies and not fixed:
            scenes = vary(scene, splats, poses.perturbation.scene)
        return SplatFrame(splats, rules, computed, poses, varied=scenes)

    if arithmetic.name != REAL.name:
        yield "rounding of float32", frame(computed=REAL)
    ordered = frame()
    ordered.bounds = _OrderedBounds(ordered.bounds.splats, rasteriser, arithmetic, ordered.varied)
    yield "the order of depth", ordered
    if rasteriser.transmittance_min > 0.0:
        yield "the stop where little light is left", frame(replace(rasteriser, transmittance_min=-1.0))
    if rasteriser.tile_size and rasteriser.alpha_min > 0.0:
        smaller = replace(
            rasteriser, tile_size=0, axis_sigmas=0.0, alpha_min=_TUNING.threshold_part * rasteriser.alpha_min
        )
        # later versions miss no tile in which alpha reaches the threshold
        names = "the alpha threshold" if rasteriser.axis_sigmas or rasteriser.ellipse_tiles else _WITH_TILES
        yield names, frame(smaller)
    if ordered.bounds.splats.degree > 0:
        yield "colours that depend on the view", frame(replace(rasteriser, view_dependent=False))
    if varied.varies:
        yield "variations of the scene", frame(fixed=True)


def attribution(frame: SplatFrame, box: ParameterBox, tile: int, count: int) -> list[tuple[int, float]]:
    """Return the Gaussians that cost a tile the most mean gap over a cell, and how much each costs.

    Groups are left out in turn, and those that matter are looked at closer, so Gaussians that matter only together
    may be missed.
    """
    forms, tiles = frame.pose_set.enclosure(box, frame.order), np.array([tile])

    def gap(candidates: np.ndarray | None) -> tuple[float, np.ndarray]:
        cell = frame.bounds.cell(frame.camera, forms, tiles, candidates)
        return float((cell.upper - cell.lower).mean()), cell.visible

    whole, visible = gap(None)
    groups = [visible.astype(np.int32)]
    while True:
        pieces = [
            piece for group in groups for piece in np.array_split(group, min(_TUNING.groups, group.size)) if piece.size
        ]
        gains = [whole - gap(np.setdiff1d(visible, piece).astype(np.int32))[0] for piece in pieces]
        best = np.argsort(gains)[::-1][: max(_TUNING.closer, count)]
        groups = [pieces[k] for k in best]
        if all(group.size <= 1 for group in groups):
            return [(int(pieces[k][0]), gains[k]) for k in best[:count] if gains[k] > 0.0]
