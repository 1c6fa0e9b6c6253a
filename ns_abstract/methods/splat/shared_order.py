"""Bounds of two scenes in the same depth order, where their Gaussians have the same means (design.md, Y5)."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ns_abstract.arithmetic.rounding import ORDER_ROUNDING, UP
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseForms
from ns_abstract.methods.splat.stage_data import ProjectedGaussians, ViewingAxes
from ns_abstract.methods.splat.sub_box_bounds import SubBoxBounds
from ns_abstract.refine.protocol import Bounds


@dataclass(frozen=True)
class SharedOrderTuning:
    """How many orders are bounded; soundness does not depend on it."""

    #: Gaussians of uncertain order that are permuted, and orders in all.
    most_permuted: int = 4
    most_orders: int = 8


_TUNING = SharedOrderTuning()


class BoundedFrame(Protocol):
    """The interface of a splat frame that is needed here; see `ns_abstract.methods.splat.frame.SplatFrame`."""

    bounds: SubBoxBounds
    order: int

    def bound(
        self, box: ParameterBox, tiles: np.ndarray, within: Any = None, keep_linear: bool = False,
        pixels: np.ndarray | None = None,
    ) -> Bounds:  # fmt: skip
        """Return bounds of some pixels over a cell."""
        ...


class _SharedOrderBounds(SubBoxBounds):
    """Bounds in one given depth order; without one, in all orders, recording the quantities that decide them.

    Attributes:
        ranks: [N] positions of the scene's Gaussians in the order; None: no order is given.
        numbers, delta, depth, error: Of the Gaussians that the last cell may show: numbers in the scene [k], means
            minus the cell's origin [k, 3], depths at its middle [k] and their float errors [k].
        slope: [m + 1, 3] the form of the viewing axis, its radius last.
    """

    def __init__(self, bounds: SubBoxBounds) -> None:
        super().__init__(bounds.splats, bounds.rasteriser, bounds.arithmetic, bounds.varied, bounds._sums)
        self.ranks: np.ndarray | None = None

    def _listed(self, alive: np.ndarray, candidates: np.ndarray, gaussians: ProjectedGaussians) -> np.ndarray:
        if self.ranks is not None:
            gaussians.depth[alive] = self.ranks[candidates[alive]]
        else:
            self.numbers = candidates[alive]
            self.delta, self.depth, self.error = (
                part[alive] for part in (gaussians.delta, gaussians.depth, gaussians.depth_error)
            )
        return super()._listed(alive, candidates, gaussians)

    def _viewing_axes(
        self, forms: PoseForms, rotation_magnitude: np.ndarray, gaussians: ProjectedGaussians
    ) -> ViewingAxes:
        axes = super()._viewing_axes(forms, rotation_magnitude, gaussians)
        if self.ranks is None:
            self.slope = axes.depth.copy()
        else:
            # the order is as given
            gaussians.depth_error[:] = 0.0
            axes.depth[1:] = 0.0
        return axes


def shared_order(first: BoundedFrame, second: BoundedFrame) -> SplatOrder | None:
    """Return the order that two frames of the same poses share; None where no means are equal, or programs differ."""
    a, b = first.bounds, second.bounds
    same = a.rasteriser == b.rasteriser and a.arithmetic == b.arithmetic and a.rasteriser.name == "gsplat"
    if not same or a.varied.varies or b.varied.varies or first.order != second.order:
        return None
    names = matched(a.splats.means, b.splats.means)
    return None if names is None else SplatOrder(first, second, names)


def matched(first: np.ndarray, second: np.ndarray) -> np.ndarray | None:
    """Return [M] for each of the means ``second`` [M, 3] the number of an equal one of ``first`` [N, 3], or N and more.

    Numbers of equal means ascend, so that equal depths are drawn in the same order in both. None: no means are equal.
    """
    count = len(first)
    if first.shape == second.shape and np.array_equal(first, second):
        return np.arange(count)
    places: dict[bytes, list[int]] = {}
    for i, mean in enumerate(np.ascontiguousarray(first)):
        places.setdefault(mean.tobytes(), []).append(i)
    numbers, least = count + np.arange(len(second)), 0
    for j, mean in enumerate(np.ascontiguousarray(second)):
        place = next((i for i in places.get(mean.tobytes(), ()) if i >= least), None)
        if place is not None:
            numbers[j], least = place, place + 1
    return numbers if (numbers < count).any() else None


class SplatOrder:
    """The order that two scenes share; see `ns_abstract.refine.protocol.SharedOrder` (docs/dev/design.md, Y5).

    Args:
        names: [M] names of the second scene's Gaussians; those of the first one's are their numbers, see `matched`.
    """

    def __init__(self, first: BoundedFrame, second: BoundedFrame, names: np.ndarray) -> None:
        self.frames = copy.copy(first), copy.copy(second)
        self._bounds = _SharedOrderBounds(first.bounds), _SharedOrderBounds(second.bounds)
        for frame, bounds in zip(self.frames, self._bounds, strict=True):
            frame.bounds = bounds
        self.names = np.arange(first.bounds.splats.count), names
        self.count = first.bounds.splats.count + second.bounds.splats.count

    def bounds(
        self, box: ParameterBox, tile: int, pixels: np.ndarray, contexts: tuple[Any, Any]
    ) -> list[tuple[Bounds, Bounds]] | None:
        """Return linear bounds of both scenes by depth order that a pose of ``box`` may have; None: too many orders."""
        visible = []
        for frame, bounds, context in zip(self.frames, self._bounds, contexts, strict=True):
            bounds.ranks = None
            visible.append(frame.bound(box, np.array([tile]), context, True, pixels[None]).context)
        orders = self._orders(visible)
        if orders is None:
            return None
        by_order = []
        for ranks in orders:
            pair = []
            for frame, bounds, names, context in zip(self.frames, self._bounds, self.names, visible, strict=True):
                bounds.ranks = ranks[names]
                pair.append(frame.bound(box, np.array([tile]), context, True, pixels[None]))
            by_order.append((pair[0], pair[1]))
        return by_order

    def _orders(self, visible: list[Any]) -> list[np.ndarray] | None:
        """Return ranks [names] of the Gaussians that either scene may show, for every order; None: too many."""
        names, parts = [], []
        for bounds, scene_names, context in zip(self._bounds, self.names, visible, strict=True):
            some = np.isin(bounds.numbers, context.visible)
            names.append(scene_names[bounds.numbers[some]])
            parts.append((bounds.delta[some], bounds.depth[some], bounds.error[some]))
        union, places = np.unique(np.concatenate(names), return_index=True)
        delta, depth, error = (np.concatenate([part[k] for part in parts])[places] for k in range(3))
        order = np.argsort(depth, kind="stable")
        union, open_pairs = union[order], uncertain(delta[order], error[order], self._bounds[0].slope)
        choices = []
        for begin, end in groups(open_pairs):
            if end - begin > _TUNING.most_permuted:
                return None
            choices.append(list(extensions(open_pairs[begin:end, begin:end], begin)))
        total = int(np.prod([len(c) for c in choices], dtype=np.float64)) if choices else 1
        if not 1 < total <= _TUNING.most_orders:
            return None
        orders = []
        for chosen in itertools.product(*choices):
            ranks = np.zeros(self.count)
            ranks[union[list(itertools.chain(*chosen))]] = np.arange(union.size)
            orders.append(ranks)
        return orders


def uncertain(delta: np.ndarray, error: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return [k, k] whether two Gaussians may have either depth order in the cell (design.md, O1, Y5).

    Args:
        delta: [k, 3] means minus the cell's origin.
        error: [k] float errors of their depths.
        slope: [m + 1, 3] the form of the viewing axis, its radius last.
    """
    apart = delta[:, None] - delta[None]
    along = np.abs(apart @ slope[:-1].T)
    sizes = np.abs(delta).sum(axis=-1)
    radius = np.abs(apart) @ slope[-1]
    # twice the rounding: sums are in another order here
    rounding = 2.0 * (ORDER_ROUNDING * (sizes[:, None] + sizes[None]))
    far = along[..., 0] > (along[..., 1:].sum(axis=-1) + radius) * UP + rounding + error[:, None] + error[None]
    open_pairs = ~far
    np.fill_diagonal(open_pairs, False)
    return open_pairs


def groups(open_pairs: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield ranges of list positions such that no open pair spans two of them, in order (design.md, O4)."""
    begin, reach = 0, 0
    for k, row in enumerate(open_pairs):
        reach = max(reach, k, int(np.flatnonzero(row).max(initial=0)))
        if reach == k:
            yield begin, k + 1
            begin = k + 1


def extensions(open_pairs: np.ndarray, begin: int) -> Iterator[list[int]]:
    """Yield the orders of the list positions from ``begin`` on in which every decided pair keeps its order."""
    count = len(open_pairs)
    for order in itertools.permutations(range(count)):
        if all(i < j or open_pairs[i, j] for i, j in itertools.combinations(order, 2)):
            yield [begin + k for k in order]
