"""Explain why bounds are loose: by causes, regions of the picture, and scene elements."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ns_abstract.api.job import Job
from ns_abstract.arithmetic.rounding import NONZERO
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError
from ns_abstract.refine.protocol import Frame
from ns_abstract.refine.result import FrameResult, Leaves

#: Leaves looked at, poses rendered in each, regions and scene elements told.
_LEAVES, _POSES, _REGIONS, _ELEMENTS = 24, 12, 3, 5
#: What to do about a cause, by its name.
_ADVICE = {
    "rounding of float32": "--arithmetic real bounds the real-number picture, where that is what is asked for",
    "the order of depth": "time, a smaller set of rotations, or fewer Gaussians at nearly the same depth",
    "the stop where little light is left": "time, or fewer nearly opaque Gaussians behind one another",
    "the alpha threshold": "time",
    "the alpha threshold and tiles": "time; --gsplat-version 1.5.3 and later have no tiles to miss",
    "colours that depend on the view": "a smaller set, or a run with a lower sh_degree",
    "variations of the scene": "smaller ranges in the perturbation file",
}
_REST = "motion over a cell, and what is loose only together"


@dataclass(frozen=True)
class Explanation:
    """The explanation of a frame's gap: its causes, regions and scene elements.

    ``gap`` is the mean over pixels and channels of the bounds' width, ``excess`` what of it no render reached;
    ``leaves`` leaf cells (one tile each) were bounded again. ``causes`` are the part of these leaves' excess that goes
    away without each, taken one at a time; ``regions`` the share of the excess, first and past row, first and past
    column, of the tiles that hold most; ``elements`` the number of a scene element, and the part of the widest leaf's
    gap that goes away without it.
    """

    index: int
    gap: float
    excess: float
    leaves: int
    causes: dict[str, float]
    regions: tuple[tuple[float, int, int, int, int], ...]
    elements: tuple[tuple[int, float], ...]

    @property
    def rest(self) -> float:
        """What no single cause explains."""
        return max(0.0, 1.0 - sum(self.causes.values()))

    def lines(self) -> Iterator[str]:
        gap = f"mean gap of a channel {self.gap:.4f}"
        yield f"frame {self.index}: {gap}; {self.excess:.4f} of it was reached by no render"
        if not self.leaves:
            yield "  nothing to explain"
            return
        yield f"  what it goes back to, one cause at a time, in {self.leaves} cells that were bounded again:"
        for name, share in sorted(self.causes.items(), key=lambda item: -item[1]):
            advice = f" ({_ADVICE[name]})" if share >= 0.1 and name in _ADVICE else ""
            yield f"  {share:6.1%}  {name}{advice}"
        yield f"  {self.rest:6.1%}  {_REST} (time, or a smaller set)"
        for share, top, bottom, left, right in self.regions:
            yield f"  {share:6.1%}  lies in rows {top} to {bottom - 1}, columns {left} to {right - 1}"
        for number, share in self.elements:
            yield f"  Gaussian {number} alone causes {share:.1%} of the widest cell's gap"


def check_explained(job: Job) -> None:
    """Raise InputError where explanations are not supported: the scene is a field."""
    if job.rays:
        raise InputError("is for splats, this run is a NeRF", field="--explain", fix="leave it out")


def explain(job: Job, index: int, result: FrameResult, seed: int = 0) -> Explanation:
    """Return the explanation of a frame: bounds some leaf cells again without each cause of looseness in turn."""
    # of colours alone: other layers have units of their own
    leaves, frame = result.leaves, job.method.frame(job.pose_sets[index])
    over = np.asarray(result.upper, np.float64) - result.lower
    over -= np.asarray(result.witness_upper, np.float64) - result.witness_lower
    tiles = [_tile_sum(frame, over, tile) for tile in range(frame.tile_count)]
    excess, gap = float(over.mean()), float((result.upper.astype(np.float64) - result.lower).mean())
    total = sum(tiles)
    if leaves is None or not leaves.tile.size or not total > 0.0:
        return Explanation(index, gap, excess, 0, {}, (), ())
    chosen = _chosen(frame, leaves, np.array(tiles), np.random.default_rng(seed))
    now = [_excess(frame, box, tile, seed) for box, tile in chosen]
    causes = {}
    for name, other in job.method.ablations(frame.pose_set):
        left = sum(_excess(other, box, tile, seed) for box, tile in chosen)
        causes[name] = float(min(1.0, max(0.0, 1.0 - left / max(sum(now), NONZERO))))
    most = np.argsort(tiles)[::-1][:_REGIONS]
    regions = tuple((tiles[k] / total, *_extent(frame, int(k))) for k in most if tiles[k] > 0.0)
    box, tile = chosen[int(np.argmax(now))]
    bounds = frame.bound(box, np.array([tile]))
    width = float((bounds.upper - bounds.lower).mean())
    elements = tuple(
        (number, gain / width) for number, gain in job.method.attribution(frame, box, tile, _ELEMENTS) if width > 0.0
    )
    return Explanation(index, gap, excess, len(chosen), causes, regions, elements)


def _extent(frame: Frame, tile: int) -> tuple[int, int, int, int]:
    """Return the pixels of a tile: first row, row after the last, first column, column after the last; clipped."""
    row, column = (frame.side * n for n in divmod(tile, frame.across))
    return row, min(row + frame.side, frame.camera.height), column, min(column + frame.side, frame.camera.width)


def _tile_sum(frame: Frame, values: np.ndarray, tile: int) -> float:
    """Return the sum (not the mean) of ``values`` [H, W, ...] over the pixels of a tile."""
    top, bottom, left, right = _extent(frame, tile)
    return float(values[top:bottom, left:right].sum())


def _chosen(
    frame: Frame, leaves: Leaves, excess: np.ndarray, rng: np.random.Generator
) -> list[tuple[ParameterBox, int]]:
    """Return leaves drawn at random by the ``excess`` of their tiles, or all of them where there are few."""
    numbers = leaves.tile[:, 0] // frame.side * frame.across + leaves.tile[:, 1] // frame.side
    weights = np.maximum(excess[numbers], 0.0)
    weights = weights / np.bincount(numbers, minlength=excess.size)[numbers]
    count = min(_LEAVES, int((weights > 0.0).sum()))
    names, units = frame.box.names, frame.box.units
    return [
        (ParameterBox(names, units, tuple(leaves.box_lower[k]), tuple(leaves.box_upper[k])), int(numbers[k]))
        for k in rng.choice(weights.size, count, replace=False, p=weights / weights.sum())
    ]


def _excess(frame: Frame, box: ParameterBox, tile: int, seed: int) -> float:
    """Return the mean gap of a tile over a cell in excess of the gap between renders of some poses."""
    tiles = np.array([tile])
    bounds = frame.bound(box, tiles)
    poses = [box.middle, *box.corners()[:_POSES], *box.sample(_POSES, np.random.default_rng(seed))]
    renders = np.stack([frame.render(values, tiles) for values in poses])
    return float((bounds.upper - bounds.lower).mean() - (renders.max(axis=0) - renders.min(axis=0)).mean())
