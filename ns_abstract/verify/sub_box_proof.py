"""Prove a cell by proving sub-boxes that cover it (docs/dev/design.md, V15).

A cell of several parameters is mostly too wide for its own linear sets, which lose by what they leave out and not by
what the pictures do. So parts of it are bounded, slanted ones where that helps (P2); a few neighbours are joined to one
wider set, over which the network is bounded once, and its rows serve for each of them (N15).
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
    """Looks about the middle of a set. None of them decides whether a bound holds."""

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
#: Most parts that are bounded together, where rows serve for neighbours and where they do not.
_GROUP, _JOINED = 64, 8
#: Times what parts are cut for from which on the network is not asked.
_ALONE = 1.8
#: How often parts are cut again, and how many times more parts there may be than a cell should take.
_DEEP, _MORE = 3, 2.0
#: Most halvings of a cell that is too wide to be covered at once.
_CUTS = 6
#: Part of the margin that is to be left over of a part by its own rows, for them to serve its neighbours; and how much
#: of what is left more, or less, parts are made dearer for.
_SPARE, _STEP = 0.35, 0.6
#: How many margins a part may miss a proof by for rows of its own before the last activation to help.
_NEAR = 0.5


@dataclass(frozen=True)
class PixelWeights:
    """Pixel weights: the margin's gradient [H, W, 3] at a pose of the cell, relative to the ``margin`` there."""

    slopes: np.ndarray
    margin: float

    def cost(self, sets: PictureSets) -> float:
        """What the sets may take from the margin, by it, to first order (V6)."""
        return 0.5 * float(np.abs(self.slopes * sets.widths).sum()) + float(np.abs(self._moved(sets)).sum())

    def loss(self, sets: PictureSets, opening: float) -> float:
        """The same, or what their mean width alone says, which costs ``opening`` times as much."""
        return max(self.cost(sets), opening * float(sets.widths.mean()))

    def _moved(self, sets: PictureSets) -> np.ndarray:
        middle = 0.5 * (sets.linear[0].astype(np.float64) + sets.linear[2])
        return np.tensordot(self.slopes, middle, 3)

    def effects(self, sets: PictureSets) -> np.ndarray:
        """[d] how much the pixels that matter move with each parameter."""
        middle = 0.5 * (sets.linear[0].astype(np.float64) + sets.linear[2])
        return np.tensordot(np.abs(self.slopes), np.abs(middle), 3)


def margin_weights(model: Model, claim: Claim, image: np.ndarray, values: np.ndarray) -> PixelWeights | None:
    """Return the margin's gradient at a picture [H, W, C] of parameters ``values`` [d]; None where it is no number."""
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
    """What part of the margin in the middle of a cell a unit of each pixel may cost (an estimate); None: unknown."""
    weights = margin_weights(model, claim, scene.image(box.middle), box.middle)
    return None if weights is None or not np.isfinite(weights.slopes).all() else np.abs(weights.slopes)


@dataclass(frozen=True)
class SubBoxOutcome:
    """The result of a cell.

    Attributes:
        margin: Proven lower bound of the margin on all of it; None: there is none.
        cuts: [d] into how many parts it should be cut along each parameter if there is none.
    """

    margin: float | None
    cuts: tuple[int, ...]
    parts: int


#: The poses of a cell as a box of other parameters, and what parts of that box leave of it (P2).
Parametrisation = Callable[[ParameterBox], tuple[ParameterBox, Callable[[ParameterBox], ParameterBox | None]]]


def own_parameters(box: ParameterBox) -> tuple[ParameterBox, Callable[[ParameterBox], ParameterBox | None]]:
    """Return a cell in its own parameters (no change of parameters)."""
    return box, lambda part: part


class _StoppedError(Exception):
    """Raised when the proof of a cell is given up."""


@dataclass
class _CellWork:
    """The state of the proof of one cell.

    Attributes:
        aim: What parts may cost, by what was found so far.
        asked: Those of which the network was asked.
        done: What part of the box is proved, or holds no pose.
        margins: Lower bounds of the margin over what is proved.
        rows: Of the latest part with rows of its own, if they serve for others.
    """

    feasible: Callable[[ParameterBox], ParameterBox | None]
    weights: PixelWeights
    query: Query
    aim: float
    parts: int = 0
    asked: int = 0
    done: float = 0.0
    margins: list[float] = field(default_factory=list)
    rows: ModelSharedBounds | None = None

    def learn(self, cost: float, margin: float) -> None:
        """Take notice of the margin that own rows prove for a part that costs so much."""
        left = max(margin / self.weights.margin, -1.0) - _SPARE
        self.aim = cost * (1.0 + _STEP * left)


@dataclass(frozen=True)
class _PendingBox:
    """A sub-box to prove, its expected cost, and its share of the cell's box."""

    box: ParameterBox
    effects: np.ndarray
    cost: float
    share: float
    depth: int

    def parts(self, axis: int, count: int) -> Iterator[_PendingBox]:
        """Equal parts along a parameter; neighbours share their ends."""
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
        sharing: The network, as it bounds neighbours together.
        frame: From cells to boxes of these parameters.
        most_parts: About, of a cell; one that would take more is cut first.
        block: Most cells that are examined together.
        aim: What the sets of parts may cost of the margin (`PixelWeights.loss`), at first.
        other: Another way to cover the same cells, taken where it needs fewer parts.
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
        """Try to prove a cell, if it takes few enough parts. ``outputs``: [n] outputs seen in it."""
        return self._chosen._prove(cell, outputs, weights)

    @cached_property
    def _chosen(self) -> SubBoxProof:
        """This way, or the other: the same wherever it is asked for (V15)."""
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
            self._all(work, _PendingBox(root, effects, cost, 1.0, 0))
        except _StoppedError:
            return SubBoxOutcome(None, self._cuts(cell, root, effects, cost, always=True), work.parts)
        # without a part there is no pose, which cannot be
        margin = min(work.margins, default=-math.inf)
        if not margin > 0.0:
            return SubBoxOutcome(None, self._cuts(cell, root, effects, cost, always=True), work.parts)
        return SubBoxOutcome(margin, (), work.parts)

    @cached_property
    def opening(self) -> float:
        """What the mean width of pixels costs, in margins: the same wherever it is asked for (V15).

        Boxes about the set's middle grow until own rows leave a smaller part of its margin than they should.
        """
        whole, most = self.scene.box, _TUNING.opening
        outputs = self.model.outputs(self.scene.image(np.array(whole.middle))[None])
        query, first, share = self.claim.query(outputs), math.nan, _TUNING.least_share
        while share <= 1.0:
            sets = self._sets(_about_middle(whole, share))
            if sets is None:
                break
            rows = self.sharing.shared_bounds(self._images([sets]))
            margin = float(self._proved(query, rows.first(query), [sets])[0])
            first = margin if share == _TUNING.least_share else first
            if not (first > 0.0 and margin > _SPARE * first):
                break
            most = min(most, self.aim / max(float(sets.widths.mean()), NONZERO))
            share *= 2.0
        return most

    @cached_property
    def parts(self) -> float:
        """Parts of the whole set, about, if all were as those about its middle whose mean width costs what it may."""
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

    def _all(self, work: _CellWork, node: _PendingBox) -> None:
        """Prove a box, in groups of parts."""
        counts = divisions(node.effects, node.cost, work.aim, self.most_parts)
        if math.prod(counts) > (_GROUP if self.sharing.reusable_anywhere else _JOINED):
            for half in node.parts(int(np.argmax(counts)), 2):
                self._all(work, half)
            return
        parts = [node]
        for axis, count in enumerate(counts):
            parts = [part for whole in parts for part in whole.parts(axis, count)]
        self._group(work, parts)

    def _feasible(self, work: _CellWork, nodes: Iterable[_PendingBox]) -> list[_PendingBox]:
        """What the poses of the cell leave of them; what holds none is done with."""
        feasible_boxes: list[_PendingBox] = []
        for node in nodes:
            box = work.feasible(node.box)
            if box is None:
                work.done += node.share
            else:
                feasible_boxes.append(replace(node, box=box))
        return feasible_boxes

    def _group(self, work: _CellWork, nodes: Sequence[_PendingBox]) -> None:
        """Prove neighbouring parts."""
        nodes = self._feasible(work, nodes)
        if not nodes:
            return
        parts = self._bounded(work, nodes)
        costs = np.array([work.weights.loss(sets, self.opening) for sets in parts])
        margins = np.full(len(parts), -np.inf)
        expensive = np.flatnonzero(costs < _ALONE * work.aim).tolist()
        if expensive:
            work.asked += len(expensive)
            margins[expensive] = self._together(work, [parts[k] for k in expensive], costs[expensive])
        halves: list[_PendingBox] = []
        for k, part in self._left(work, nodes, margins):
            # as expensive as what fails
            cost = max(float(costs[k]), work.aim)
            rest = _PendingBox(part.box, work.weights.effects(parts[k]), cost, part.share, part.depth + 1)
            halves += rest.parts(int(np.argmax(rest.effects)), 2)
        for first in range(0, len(halves), _GROUP):
            self._group(work, halves[first : first + _GROUP])

    def _together(self, work: _CellWork, parts: Sequence[PictureSets], costs: np.ndarray) -> np.ndarray:
        """[m] margins of parts, by as few rows as possible."""
        if not self.sharing.reusable_anywhere:
            return self._joined(work, parts, costs)
        margins = np.full(len(parts), -np.inf)
        if work.rows is not None:
            self._lent(work, work.rows, parts, margins)
        middles = np.array([sets.box.middle for sets in parts])
        size = np.maximum(np.array(parts[0].box.upper) - np.array(parts[0].box.lower), NONZERO)
        while len(left := np.flatnonzero(~(margins > 0.0))):
            # the middle one serves most
            at = middles[left] / size
            chosen = int(left[np.abs(at - at.mean(axis=0)).sum(axis=1).argmin()])
            rows = self.sharing.shared_bounds(self._images([parts[chosen]]))
            margins[chosen] = self._proved(work.query, rows.first(work.query), [parts[chosen]])[0]
            work.learn(float(costs[chosen]), float(margins[chosen]))
            if not margins[chosen] > 0.0:
                break
            work.rows = rows
            self._lent(work, rows, parts, margins)
        return margins

    def _lent(
        self, work: _CellWork, rows: ModelSharedBounds, parts: Sequence[PictureSets], margins: np.ndarray
    ) -> None:
        """Prove those of ``parts`` without a margin by rows of another, in place."""
        for fresh in (False, True):
            # before, nothing is known of some
            near = margins >= -_NEAR * work.weights.margin if fresh else True
            left = np.flatnonzero(~(margins > 0.0) & near).tolist()
            if left:
                chosen = [parts[k] for k in left]
                margins[left] = self._proved(
                    work.query, rows.others(self._images(chosen), work.query, fresh=fresh), chosen
                )

    def _joined(self, work: _CellWork, parts: Sequence[PictureSets], costs: np.ndarray) -> np.ndarray:
        """[m] margins of parts, by rows of sets that hold all of them."""
        whole = hull_of_sets(parts)
        rows = self.sharing.shared_bounds(self._images([whole]))
        margins = np.full(len(parts), self._proved(work.query, rows.first(work.query), [whole])[0])
        work.learn(float(costs.mean()), float(margins[0]))
        self._lent(work, rows, parts, margins)
        return margins

    def _bounded(self, work: _CellWork, nodes: Sequence[_PendingBox]) -> list[PictureSets]:
        """Sets of parts. Raises _StoppedError: there are too many, or one has none."""
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

    def _left(
        self, work: _CellWork, nodes: Sequence[_PendingBox], margins: np.ndarray
    ) -> list[tuple[int, _PendingBox]]:
        """Those of ``nodes`` that have no proof, by number; the others are done with."""
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
        """[m] margins; what is no finite number proves nothing."""
        margins = np.asarray(self.claim.proved(query, bounds, [sets.box for sets in parts]), np.float64)
        return np.where(np.isfinite(margins), margins, -np.inf)

    def _cuts(
        self, cell: ParameterBox, root: ParameterBox, effects: np.ndarray | None, cost: float, always: bool = False
    ) -> tuple[int, ...]:
        """[d] parts of a cell, such that each takes few enough; two at least.

        A cut of the cell's own parameters narrows others of the slanted box, too: the cut is taken after which the
        fewest parts are needed in all.
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
        """Halvings that a cell needs, about."""
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
    """Return into how many equal parts to divide each parameter so that their sets cost ``aim`` of the margin.

    There is no use in many more parts than ``most_parts``.
    """
    gains = np.where(np.isfinite(effects), effects, 0.0) + NONZERO
    goal = (aim / cost) ** (1.0 / _POWER) * float(gains.sum()) if cost > aim else math.inf
    counts = np.ones(len(gains), np.int64)
    while (gains / counts).sum() > goal and counts.prod() <= most_parts:
        # what a further part gains, by what it costs
        counts[np.argmax(gains / (counts * (counts + 1) * np.log1p(1.0 / counts)))] += 1
    return counts.tolist()
