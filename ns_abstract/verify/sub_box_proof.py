"""Proves a cell by proving sub-boxes that cover it (docs/dev/design.md, V15).

A cell of several parameters is mostly too wide for its own linear sets: these lose more by linearisation than by what
the pictures do. So sub-boxes of it are bounded, sheared ones where that helps (P2). A few neighbours are joined to one
wider set, over which the network is bounded once; its coefficients then serve for each of them (N15).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch

from ns_abstract.arithmetic.rounding import NONZERO
from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.model import ModelSharedBounds, NetworkModel
from ns_abstract.verify.network import ImageSets, OutputBounds
from ns_abstract.verify.picture_sets import PictureSets, hull_of_sets
from ns_abstract.verify.properties import Claim, Query
from ns_abstract.verify.protocol import FrameImages, Model
from ns_abstract.verify.search_results import FAILURES

#: The power of the width that sets cost.
_POWER = 1.6


@dataclass(frozen=True)
class CoverTuning:
    """Preferences of the search for sub-boxes around the middle of a set; soundness does not depend on them."""

    #: What the mean width of pixels costs at most, however little the margin's gradient says: signs of units become
    #: open by it. Networks that bear more are told by boxes about the set's middle, of which the least is so small a
    #: part of it.
    opening: float = 42.0
    least_share: float = 2.0**-9


_TUNING = CoverTuning()
#: What a box may cost is foreseen by so small a part of it: wide ones show nothing.
_PROBE = 4
#: Looks at a part about the middle of the set before two ways to cover it are compared, and most parts that are told
#: apart there.
_TRIALS, _MANY = 4, 1 << 40
#: Most parts that are bounded together, where coefficients serve for neighbours and where they do not.
_GROUP, _JOINED = 64, 8
#: Times what parts are cut for from which on the network is not asked.
_ALONE = 1.8
#: How often parts are cut again, and how many times more parts there may be than a cell should take.
_DEEP, _MORE = 3, 2.0
#: Most halvings of a cell that is too wide to be covered at once.
_CUTS = 6
#: Part of the margin that own coefficients have to leave of a part before they serve its neighbours; and how strongly
#: a margin above or below that raises or lowers the cost that parts may have.
_SPARE, _STEP = 0.35, 0.6
#: How many margins a part may miss a proof by for coefficients of its own before the last activation to help.
_NEAR = 0.5


@dataclass(frozen=True)
class PixelWeights:
    """Pixel weights: the margin's gradient [H, W, 3] at a pose of the cell, relative to the ``margin`` there."""

    slopes: np.ndarray
    margin: float

    def cost(self, sets: PictureSets) -> float:
        """Return the loss of the margin by the sets' widths, to first order (V6)."""
        return 0.5 * float(np.abs(self.slopes * sets.widths).sum()) + float(np.abs(self._moved(sets)).sum())

    def loss(self, sets: PictureSets, opening: float) -> float:
        """Return that loss, or the one by the sets' mean width, times ``opening``, if that is larger."""
        return max(self.cost(sets), opening * float(sets.widths.mean()))

    def _moved(self, sets: PictureSets) -> np.ndarray:
        middle = 0.5 * (sets.linear[0].astype(np.float64) + sets.linear[2])
        return np.tensordot(self.slopes, middle, 3)

    def effects(self, sets: PictureSets) -> np.ndarray:
        """Return the motion [d] of the pixels that matter by each parameter."""
        middle = 0.5 * (sets.linear[0].astype(np.float64) + sets.linear[2])
        return np.tensordot(np.abs(self.slopes), np.abs(middle), 3)


def margin_weights(model: Model, claim: Claim, image: np.ndarray, values: np.ndarray) -> PixelWeights | None:
    """Return the gradient at a picture [H, W, C] of parameters ``values`` [d]; None: not finite, or margin <= 0."""
    try:
        picture = torch.from_numpy(image.astype(np.float64)).requires_grad_(True)
        margin = claim.margin(model.differentiable(picture[None]), torch.from_numpy(values)[None])[0]
        if not margin.requires_grad:
            return None
        (gradient,) = torch.autograd.grad(margin, picture)
    except FAILURES:
        return None
    here = float(margin.detach())
    return PixelWeights(gradient.numpy() / here, here) if here > 0.0 else None


def pixel_costs(scene: FrameImages, model: Model, claim: Claim, box: ParameterBox) -> np.ndarray | None:
    """Return the estimated fraction of the margin that a unit of each pixel's width costs; None: unknown."""
    weights = margin_weights(model, claim, scene.image(box.middle), box.middle)
    return None if weights is None or not np.isfinite(weights.slopes).all() else np.abs(weights.slopes)


@dataclass(frozen=True)
class SubBoxOutcome:
    """The result of a cell.

    Attributes:
        margin: Proved lower bound of the margin over all of it; None: there is none.
        cuts: [d] number of parts to cut it into along each parameter if there is none.
    """

    margin: float | None
    cuts: tuple[int, ...]
    parts: int


#: The poses of a cell as a box of other parameters, and what parts of that box leave of it (P2).
Parametrisation = Callable[[ParameterBox], tuple[ParameterBox, Callable[[ParameterBox], ParameterBox | None]]]


def own_parameters(box: ParameterBox) -> tuple[ParameterBox, Callable[[ParameterBox], ParameterBox | None]]:
    """Return a cell as it is, and the identity as the change of parameters."""
    return box, lambda part: part


class _StoppedError(Exception):
    """Raised to give up the proof of a cell."""


@dataclass
class _CellWork:
    """The state of the proof of one cell.

    Attributes:
        aim: Largest cost of sub-boxes, from what was found so far.
        asked: Number of sub-boxes that the network was bounded over.
        done: Fraction of the box that is proved, or holds no pose.
        margins: Lower bounds of the margin over what is proved.
        shared: Coefficients of the latest sub-box that has its own, if they can be reused.
    """

    feasible: Callable[[ParameterBox], ParameterBox | None]
    weights: PixelWeights
    query: Query
    aim: float
    parts: int = 0
    asked: int = 0
    done: float = 0.0
    margins: list[float] = field(default_factory=list)
    shared: ModelSharedBounds | None = None

    def learn(self, cost: float, margin: float) -> None:
        """Record the margin that own coefficients prove for a sub-box of this cost."""
        left = max(margin / self.weights.margin, -1.0) - _SPARE
        self.aim = cost * (1.0 + _STEP * left)


@dataclass(frozen=True)
class _PendingBox:
    """A sub-box to prove, its expected cost, and its fraction of the cell's box."""

    box: ParameterBox
    effects: np.ndarray
    cost: float
    share: float
    depth: int

    def parts(self, axis: int, count: int) -> Iterator[_PendingBox]:
        """Yield equal parts along a parameter; neighbours share their ends."""
        effects = self.effects.copy()
        effects[axis] /= count
        whole = float(self.effects.sum())
        cost = self.cost * (float(effects.sum()) / whole) ** _POWER if whole > 0.0 else self.cost
        for part in self.box.split(axis, count):
            yield _PendingBox(part, effects, cost, self.share / count, self.depth)


@dataclass(frozen=True)
class SubBoxProof:
    """Proves cells of several parameters sub-box by sub-box.

    Args:
        sharing: The network, with coefficients that can be reused for neighbours.
        frame: Maps cells to boxes of these parameters.
        most_parts: Approximate largest number of sub-boxes of a cell; one that would take more is cut first.
        block: Largest number of cells that are examined together.
        aim: Initial aim for the cost of sub-boxes' sets, as a fraction of the margin (`PixelWeights.loss`).
        other: Another way to cover the same cells, taken where it needs fewer sub-boxes.
    """

    scene: FrameImages
    model: Model
    sharing: NetworkModel
    claim: Claim
    frame: Parametrisation = own_parameters
    most_parts: int = 64
    block: int = 2
    aim: float = 0.26
    other: SubBoxProof | None = None

    def prove(self, cell: ParameterBox, outputs: np.ndarray, weights: PixelWeights) -> SubBoxOutcome:
        """Try to prove a cell, if it takes few enough sub-boxes. ``outputs``: [n] of a sample in it."""
        return self._chosen._prove(cell, outputs, weights)

    @cached_property
    def _chosen(self) -> SubBoxProof:
        """This way or the other one: the same wherever it is evaluated (V15)."""
        return self if self.other is None or self.parts <= self.other.parts else self.other

    def _prove(self, cell: ParameterBox, outputs: np.ndarray, weights: PixelWeights) -> SubBoxOutcome:
        root, feasible = self.frame(cell)
        probe_sets = self._sets(_about_middle(root, 1.0 / _PROBE))
        if probe_sets is None:
            return SubBoxOutcome(None, self._cuts(cell, root, None, 1.0), 0)
        cost, effects = weights.loss(probe_sets, self.opening) * _PROBE**_POWER, weights.effects(probe_sets) * _PROBE
        if math.prod(divisions(effects, cost, self.aim, self.most_parts)) > self.most_parts:
            return SubBoxOutcome(None, self._cuts(cell, root, effects, cost), 0)
        work = _CellWork(feasible, weights, self.claim.query(outputs[None]), self.aim)
        try:
            self._prove_box(work, _PendingBox(root, effects, cost, 1.0, 0))
        except _StoppedError:
            return SubBoxOutcome(None, self._cuts(cell, root, effects, cost, always=True), work.parts)
        # without a part there is no pose, which cannot be
        margin = min(work.margins, default=-math.inf)
        if not margin > 0.0:
            return SubBoxOutcome(None, self._cuts(cell, root, effects, cost, always=True), work.parts)
        return SubBoxOutcome(margin, (), work.parts)

    @cached_property
    def opening(self) -> float:
        """The cost of pixels' mean width, in margins: the same wherever it is evaluated (V15).

        Boxes around the set's middle grow until own coefficients leave a smaller fraction of its margin than they
        should.
        """
        whole, most = self.scene.box, _TUNING.opening
        outputs = self.model.outputs(self.scene.image(np.array(whole.middle))[None])
        query, first, share = self.claim.query(outputs), math.nan, _TUNING.least_share
        while share <= 1.0:
            sets = self._sets(_about_middle(whole, share))
            if sets is None:
                break
            shared = self.sharing.shared_bounds(self._images([sets]))
            margin = float(self._proved(query, shared.first(query), [sets])[0])
            first = margin if share == _TUNING.least_share else first
            if not (first > 0.0 and margin > _SPARE * first):
                break
            most = min(most, self.aim / max(float(sets.widths.mean()), NONZERO))
            share *= 2.0
        return most

    @cached_property
    def parts(self) -> float:
        """Estimated number of sub-boxes of the whole set, if all were as wide as those around its middle may be."""
        whole = self.scene.box
        counts = np.full(whole.dimensions, float(_PROBE))
        for _ in range(_TRIALS):
            part_sets = self._sets(_about_middle(whole, 1.0 / counts))
            if part_sets is None:
                return math.inf
            cost = self.opening * float(part_sets.widths.mean())
            effects = PixelWeights(np.ones_like(part_sets.widths), 1.0).effects(part_sets) * counts + NONZERO
            cost *= float(effects.sum() / (effects / counts).sum()) ** _POWER
            counts = np.array(divisions(effects, cost, self.aim, _MANY), np.float64)
        return float(counts.prod())

    def _sets(self, box: ParameterBox) -> PictureSets | None:
        check_cancelled()
        linear, lower, upper, _ = self.scene.linear_sets(box)
        picture_sets = PictureSets(box, linear, lower, upper)
        return picture_sets if picture_sets.sane else None

    def _prove_box(self, work: _CellWork, node: _PendingBox) -> None:
        """Prove a box, in groups of sub-boxes."""
        counts = divisions(node.effects, node.cost, work.aim, self.most_parts)
        if math.prod(counts) > (_GROUP if self.sharing.reusable_anywhere else _JOINED):
            for half in node.parts(int(np.argmax(counts)), 2):
                self._prove_box(work, half)
            return
        parts = [node]
        for axis, count in enumerate(counts):
            parts = [part for whole in parts for part in whole.parts(axis, count)]
        self._prove_group(work, parts)

    def _feasible(self, work: _CellWork, nodes: Iterable[_PendingBox]) -> list[_PendingBox]:
        """Return the sub-boxes, each reduced to the poses of the cell in it; those without poses are done."""
        feasible_boxes: list[_PendingBox] = []
        for node in nodes:
            box = work.feasible(node.box)
            if box is None:
                work.done += node.share
            else:
                feasible_boxes.append(replace(node, box=box))
        return feasible_boxes

    def _prove_group(self, work: _CellWork, nodes: Sequence[_PendingBox]) -> None:
        """Prove neighbouring sub-boxes."""
        nodes = self._feasible(work, nodes)
        if not nodes:
            return
        parts = self._picture_sets(work, nodes)
        costs = np.array([work.weights.loss(sets, self.opening) for sets in parts])
        margins = np.full(len(parts), -np.inf)
        affordable = np.flatnonzero(costs < _ALONE * work.aim).tolist()
        if affordable:
            work.asked += len(affordable)
            margins[affordable] = self._together(work, [parts[k] for k in affordable], costs[affordable])
        halves: list[_PendingBox] = []
        for k, part in self._unproved(work, nodes, margins):
            # at least as expensive as a part that fails
            cost = max(float(costs[k]), work.aim)
            rest = _PendingBox(part.box, work.weights.effects(parts[k]), cost, part.share, part.depth + 1)
            halves += rest.parts(int(np.argmax(rest.effects)), 2)
        for first in range(0, len(halves), _GROUP):
            self._prove_group(work, halves[first : first + _GROUP])

    def _together(self, work: _CellWork, parts: Sequence[PictureSets], costs: np.ndarray) -> np.ndarray:
        """Return margins [m] of sub-boxes, with as few backward passes as possible."""
        if not self.sharing.reusable_anywhere:
            return self._prove_by_hull(work, parts, costs)
        margins = np.full(len(parts), -np.inf)
        if work.shared is not None:
            self._prove_by_shared(work, work.shared, parts, margins)
        middles = np.array([sets.box.middle for sets in parts])
        size = np.maximum(np.array(parts[0].box.upper) - np.array(parts[0].box.lower), NONZERO)
        while len(left := np.flatnonzero(~(margins > 0.0))):
            # the middle one serves most
            at = middles[left] / size
            chosen = int(left[np.abs(at - at.mean(axis=0)).sum(axis=1).argmin()])
            shared = self.sharing.shared_bounds(self._images([parts[chosen]]))
            margins[chosen] = self._proved(work.query, shared.first(work.query), [parts[chosen]])[0]
            work.learn(float(costs[chosen]), float(margins[chosen]))
            if not margins[chosen] > 0.0:
                break
            work.shared = shared
            self._prove_by_shared(work, shared, parts, margins)
        return margins

    def _prove_by_shared(
        self, work: _CellWork, shared: ModelSharedBounds, parts: Sequence[PictureSets], margins: np.ndarray
    ) -> None:
        """Fill in ``margins`` of sub-boxes without one, by another sub-box's coefficients."""
        for fresh in (False, True):
            # before, nothing is known of some
            near = margins >= -_NEAR * work.weights.margin if fresh else True
            left = np.flatnonzero(~(margins > 0.0) & near).tolist()
            if left:
                chosen = [parts[k] for k in left]
                margins[left] = self._proved(
                    work.query, shared.others(self._images(chosen), work.query, fresh=fresh), chosen
                )

    def _prove_by_hull(self, work: _CellWork, parts: Sequence[PictureSets], costs: np.ndarray) -> np.ndarray:
        """Return margins [m] of sub-boxes, by coefficients of sets that contain all of them."""
        whole = hull_of_sets(parts)
        shared = self.sharing.shared_bounds(self._images([whole]))
        margins = np.full(len(parts), self._proved(work.query, shared.first(work.query), [whole])[0])
        work.learn(float(costs.mean()), float(margins[0]))
        self._prove_by_shared(work, shared, parts, margins)
        return margins

    def _picture_sets(self, work: _CellWork, nodes: Sequence[_PendingBox]) -> list[PictureSets]:
        """Return sets of sub-boxes. Raises _StoppedError: there are too many, or one has none."""
        work.parts += len(nodes)
        late = work.asked > self.most_parts // 2 and work.asked > _MORE * self.most_parts * work.done
        if late or work.parts > 2.0 * _MORE * self.most_parts:
            raise _StoppedError
        parts: list[PictureSets] = []
        for node in nodes:
            sets = self._sets(node.box)
            if sets is None:
                raise _StoppedError
            parts.append(sets)
        return parts

    def _unproved(
        self, work: _CellWork, nodes: Sequence[_PendingBox], margins: np.ndarray
    ) -> list[tuple[int, _PendingBox]]:
        """Return the ``nodes`` without proof, with their numbers; the others are done."""
        work.margins += [float(margin) for margin in margins if margin > 0.0]
        work.done += sum(node.share for node, margin in zip(nodes, margins, strict=True) if margin > 0.0)
        left = [(k, node) for k, node in enumerate(nodes) if not margins[k] > 0.0]
        if any(node.depth >= _DEEP for _, node in left):
            raise _StoppedError
        return left

    def _images(self, parts: Sequence[PictureSets]) -> ImageSets:
        linear = [np.stack([sets.linear[k] for sets in parts]) for k in range(4)]
        lower, upper = (np.stack([getattr(sets, name) for sets in parts]) for name in ("lower", "upper"))
        return self.model.input_sets(tuple(linear), lower, upper)

    def _proved(self, query: Query, bounds: OutputBounds, parts: Sequence[PictureSets]) -> np.ndarray:
        """Return margins [m]; NaN and infinities prove nothing."""
        margins = np.asarray(self.claim.proved(query, bounds, [sets.box for sets in parts]), np.float64)
        return np.where(np.isfinite(margins), margins, -np.inf)

    def _cuts(
        self, cell: ParameterBox, root: ParameterBox, effects: np.ndarray | None, cost: float, always: bool = False
    ) -> tuple[int, ...]:
        """Return the numbers [d] of parts into which to cut a cell, so that each part needs few enough sub-boxes.

        A cut of the cell's own parameters also narrows other parameters of the sheared box: the cut is chosen after
        which the fewest sub-boxes are needed in all.
        """
        d = cell.dimensions
        width = np.array(root.upper) - np.array(root.lower)
        effects = width if effects is None or not effects.any() else effects
        goal = (self.aim / max(cost, self.aim)) ** (1.0 / _POWER) * float(effects.sum()) / d
        cuts = [1] * d
        for _ in range(_CUTS):
            if not always and self._parts(cell, width, effects, goal) <= math.log2(self.most_parts) and max(cuts) > 1:
                break
            candidates = []
            for axis in range(d):
                half = cell.replace(axis, cell.lower[axis], 0.5 * (cell.lower[axis] + cell.upper[axis]))
                candidates.append((self._parts(half, width, effects, goal), axis, half))
            _, axis, cell = min(candidates, key=lambda found: found[:2])
            cuts[axis] *= 2
            if always:
                break
        return tuple(cuts)

    def _parts(self, cell: ParameterBox, width: np.ndarray, effects: np.ndarray, goal: float) -> float:
        """Return the estimated number of halvings that a cell needs."""
        root = self.frame(cell)[0]
        part = (np.array(root.upper) - np.array(root.lower)) / width
        return float(np.log2(np.maximum(effects * part / goal, 1.0)).sum())


def _about_middle(box: ParameterBox, share: float | np.ndarray) -> ParameterBox:
    """Return the concentric box whose widths are a ``share`` (or [d] shares) of those of ``box``."""
    inner, shares = box, np.broadcast_to(share, (box.dimensions,)).tolist()
    for axis, (middle, part) in enumerate(zip(box.middle.tolist(), shares, strict=True)):
        half = 0.5 * part * (box.upper[axis] - box.lower[axis])
        inner = inner.replace(axis, max(middle - half, box.lower[axis]), min(middle + half, box.upper[axis]))
    return inner


def divisions(effects: np.ndarray, cost: float, aim: float, most_parts: int) -> list[int]:
    """Return the numbers of equal parts along each parameter such that their sets cost ``aim`` of the margin.

    There are not many more parts than ``most_parts``, which would be of no use.
    """
    gains = np.where(np.isfinite(effects), effects, 0.0) + NONZERO
    goal = (aim / cost) ** (1.0 / _POWER) * float(gains.sum()) if cost > aim else math.inf
    counts = np.ones(len(gains), np.int64)
    while (gains / counts).sum() > goal and counts.prod() <= most_parts:
        # what a further part gains, by what it costs
        counts[np.argmax(gains / (counts * (counts + 1) * np.log1p(1.0 / counts)))] += 1
    return counts.tolist()
