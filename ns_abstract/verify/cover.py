"""Cells that are proved part by part (docs/design.md, V15).

A cell of several parameters is mostly too wide for its own linear sets, which lose by what they leave out and not by
what the pictures do. So parts of it are bounded, slanted ones where that helps (P2); a few neighbours are joined to one
wider set, over which the network is bounded once, and its rows serve for each of them (N15).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ns_abstract.execution.ending import checkpoint
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.properties import Claim

if TYPE_CHECKING:
    from ns_abstract.verify.network import Fresh, ImageSets, OutputBounds
    from ns_abstract.verify.properties import Query
    from ns_abstract.verify.search import Model, Scene

#: Times what parts are cut for, the network is asked about one by itself, and about neighbours together; and the power
#: of the width that sets cost.
_ALONE, _TOGETHER, _POWER = 1.8, 2.5, 1.6
#: What the mean width of pixels costs, however little the margin's gradient says: signs of units become open by it.
_OPENING = 42.0
#: What a box may cost is foreseen by so small a part of it: wide ones show nothing.
_PROBE = 4
#: Halvings that make the parts of a family.
_FAMILY = 3
#: How often parts are cut again, and how many times more parts there may be than a cell should take.
_DEEP, _MORE = 3, 2.0
#: Most halvings of a cell that is too wide to be covered at once.
_CUTS = 6
#: The aim is at least what parts cost that are proved together and so much of the margin left more, and at most so much
#: of what they cost where neighbours are far from a proof.
_EASY, _HARD = 0.6, 0.75
#: Room for rounding of the joined sets: a few operations on each term.
_ROOM = 2.0**-44


class SharedBounds(Protocol):
    """Bounds of a cell and its parts; see `ns_abstract.verify.network.family.Family`."""

    def whole(self, query: Query) -> OutputBounds:
        """Bounds of the query's rows over the cell."""
        ...

    def parts(self, images: ImageSets, query: Query, *, fresh: Fresh = "last") -> OutputBounds:
        """The same over its parts."""
        ...


class SharingModel(Protocol):
    """A network whose rows can be shared."""

    def family(self, images: ImageSets) -> SharedBounds:
        """Bounds of one cell, to be shared with its parts."""
        ...


@dataclass(frozen=True)
class PictureSets:
    """Linear sets of a box: what `ns_abstract.verify.search.Scene.sets` gives."""

    box: ParameterBox
    linear: tuple[np.ndarray, ...]
    lower: np.ndarray
    upper: np.ndarray

    @property
    def sane(self) -> bool:
        """Whether all is finite, and the bounds do not cross."""
        finite = all(np.isfinite(v).all() for v in (*self.linear, self.lower, self.upper))
        return finite and bool((self.lower <= self.upper).all())

    @property
    def widths(self) -> np.ndarray:
        """[H, W, 3] widths of the sets at a p."""
        a_lower, b_lower, a_upper, b_upper = (np.asarray(v, np.float64) for v in self.linear)
        wide = b_upper - b_lower + np.abs(a_upper - a_lower).sum(axis=-1)
        return np.minimum(wide, np.asarray(self.upper, np.float64) - self.lower)


@dataclass(frozen=True)
class Weights:
    """What pixels are worth: the margin's gradient [H, W, 3] somewhere in a cell, in parts of the ``margin`` there."""

    slopes: np.ndarray
    margin: float

    def cost(self, sets: PictureSets) -> float:
        """What the sets may take from the margin, by it, to first order (V6)."""
        return 0.5 * float(np.abs(self.slopes * sets.widths).sum()) + float(np.abs(self._moved(sets)).sum())

    def loss(self, sets: PictureSets) -> float:
        """The same, or what their width alone says."""
        return max(self.cost(sets), _OPENING * float(sets.widths.mean()))

    def _moved(self, sets: PictureSets) -> np.ndarray:
        middle = 0.5 * (sets.linear[0].astype(np.float64) + sets.linear[2])
        return np.tensordot(self.slopes, middle, 3)

    def effects(self, sets: PictureSets) -> np.ndarray:
        """[d] how much the pixels that matter move with each parameter."""
        middle = 0.5 * (sets.linear[0].astype(np.float64) + sets.linear[2])
        return np.tensordot(np.abs(self.slopes), np.abs(middle), 3)


@dataclass(frozen=True)
class Covered:
    """What came of a cell.

    Attributes:
        margin: Proven lower bound of the margin on all of it; None: there is none.
        cuts: [d] into how many parts it should be cut along each parameter if there is none.
        parts: Parts that were bounded.
    """

    margin: float | None
    cuts: tuple[int, ...]
    parts: int


#: The poses of a cell as a box of other parameters, and what parts of that box leave of it (P2).
Frame = Callable[[ParameterBox], tuple[ParameterBox, Callable[[ParameterBox], ParameterBox | None]]]


def straight(box: ParameterBox) -> tuple[ParameterBox, Callable[[ParameterBox], ParameterBox | None]]:
    """A cell in its own parameters."""
    return box, lambda part: part


class _StoppedError(Exception):
    """A cell is given up."""


@dataclass
class _Work:
    """One cell under way.

    Attributes:
        feasible: See `Frame`.
        weights: Of the cell's middle.
        query: What the network is asked.
        aim: What parts may cost, by what was found so far.
        parts: Parts that were bounded.
        asked: Those of which the network was asked.
        done: What part of the box is proved, or holds no pose.
        margins: Lower bounds of the margin over what is proved.
        dear: The least that parts cost of neighbours that were far from a proof.
    """

    feasible: Callable[[ParameterBox], ParameterBox | None]
    weights: Weights
    query: Query
    aim: float
    parts: int = 0
    asked: int = 0
    done: float = 0.0
    margins: list[float] = field(default_factory=list)
    dear: float = math.inf

    def learn(self, cost: float, margin: float, far: float) -> None:
        """Take notice of what came of neighbours whose parts cost so much: a multiple of the margin."""
        if margin < -far:
            self.dear = min(self.dear, cost)
            self.aim = min(self.aim, _HARD * cost)
        elif margin > 0.0:
            self.aim = min(max(self.aim, (1.0 + _EASY * margin) * cost), _HARD * self.dear)


@dataclass(frozen=True)
class _Node:
    """A box under way, what it is expected to cost, and what part of the cell's box it is."""

    box: ParameterBox
    effects: np.ndarray
    cost: float
    share: float
    depth: int

    def halves(self, axis: int) -> Iterator[_Node]:
        effects = self.effects.copy()
        effects[axis] *= 0.5
        whole = float(self.effects.sum())
        cost = self.cost * (float(effects.sum()) / whole) ** _POWER if whole > 0.0 else self.cost
        for half in self.box.split(axis):
            yield _Node(half, effects, cost, 0.5 * self.share, self.depth)


@dataclass(frozen=True)
class Cover:
    """Proves cells of several parameters part by part.

    Args:
        scene: Pictures, in the parameters of ``frame``.
        model: The network.
        sharing: The network, as it bounds neighbours together.
        claim: What is to hold, in these parameters.
        frame: From cells to boxes of these parameters.
        most: Most parts of a cell, about; one that would take more is cut first.
        block: Most cells that are examined together.
        aim: What the sets of parts may cost of the margin (`Weights.loss`), at first.
        far: Multiple of the margin by which neighbours may miss a proof for their rows to prove parts; where they miss
            it by more there are smaller neighbours. What a cut gains is the less the more parameters there are.
    """

    scene: Scene
    model: Model
    sharing: SharingModel
    claim: Claim
    frame: Frame = straight
    most: int = 32
    block: int = 4
    aim: float = 0.2
    far: float = 1.3

    def prove(self, cell: ParameterBox, outputs: np.ndarray, weights: Weights) -> Covered:
        """Try to prove a cell, if it takes few enough parts.

        Args:
            cell: The cell.
            outputs: [n] outputs seen in it.
            weights: Of its middle.
        """
        root, feasible = self.frame(cell)
        inner = root
        for axis, middle in enumerate(root.middle.tolist()):
            half = 0.5 * (root.upper[axis] - root.lower[axis]) / _PROBE
            inner = inner.replace(axis, max(middle - half, root.lower[axis]), min(middle + half, root.upper[axis]))
        found = self._sets(inner)
        if found is None:
            return Covered(None, self._cuts(cell, root, None, 1.0), 0)
        cost, effects = weights.loss(found) * _PROBE**_POWER, weights.effects(found) * _PROBE
        if 2 ** len(halvings(effects, cost, _FAMILY, self.aim, self.most)) > self.most:
            return Covered(None, self._cuts(cell, root, effects, cost), 0)
        work = _Work(feasible, weights, self.claim.query(outputs[None]), self.aim)
        try:
            self._all(work, _Node(root, effects, cost, 1.0, 0))
        except _StoppedError:
            return Covered(None, self._cuts(cell, root, effects, cost, always=True), work.parts)
        # without a part there is no pose, which cannot be
        margin = min(work.margins, default=-math.inf)
        if not margin > 0.0:
            return Covered(None, self._cuts(cell, root, effects, cost, always=True), work.parts)
        return Covered(margin, (), work.parts)

    def _sets(self, box: ParameterBox) -> PictureSets | None:
        checkpoint()
        linear, lower, upper, _ = self.scene.sets(box)
        found = PictureSets(box, linear, lower, upper)
        return found if found.sane else None

    def _all(self, work: _Work, node: _Node) -> None:
        """Prove a box, in families of parts.

        Raises:
            _StoppedError: It takes too many, or one cannot be proved.
        """
        plan = halvings(node.effects, node.cost, _FAMILY, work.aim, self.most)
        if len(plan) > _FAMILY:
            for half in node.halves(plan[0]):
                self._all(work, half)
            return
        parts = [node]
        for axis in plan:
            parts = [half for part in parts for half in part.halves(axis)]
        kept = self._feasible(work, parts)
        if kept:
            self._family(work, node, kept)

    def _feasible(self, work: _Work, nodes: Iterable[_Node]) -> list[_Node]:
        """What the poses of the cell leave of them; what holds none is done with."""
        kept: list[_Node] = []
        for node in nodes:
            box = work.feasible(node.box)
            if box is None:
                work.done += node.share
            else:
                kept.append(replace(node, box=box))
        return kept

    def _family(self, work: _Work, node: _Node, nodes: list[_Node]) -> None:
        """Prove the parts ``nodes`` of a box.

        Raises:
            _StoppedError: It takes too many parts, or one cannot be proved.
        """
        parts = self._bounded(work, nodes)
        costs = [work.weights.loss(sets) for sets in parts]
        margins = np.full(len(parts), -np.inf)
        whole, rows = joined(parts), None
        if len(parts) > 1 and work.weights.loss(whole) < _TOGETHER * work.aim:
            work.asked += len(parts)
            rows = self.sharing.family(self._images([whole]))
            margins[:] = self._proved(work, rows.whole(work.query), [whole])[0]
            work.learn(float(np.mean(costs)), float(margins[0]) / work.weights.margin, self.far)
            if margins[0] < -self.far * work.weights.margin:
                # rows of what is so far from a proof prove little: smaller neighbours
                self._apart(work, node)
                return
            if not margins[0] > 0.0:
                margins = self._by_rows(work, rows, parts)
        else:
            left = [k for k, cost in enumerate(costs) if cost < _ALONE * work.aim]
            if left:
                chosen = [parts[k] for k in left]
                margins[left] = self._proved(work, self.model.bound(self._images(chosen), work.query), chosen)
        for k, part in self._left(work, nodes, margins):
            effects = work.weights.effects(parts[k])
            # as expensive as what fails
            rest = _Node(part.box, effects, max(costs[k], work.aim), part.share, part.depth + 1)
            if rows is None:
                self._all(work, rest)
            else:
                self._halved(work, rows, rest)

    def _apart(self, work: _Work, node: _Node) -> None:
        """Prove the halves of a box whose parts are too different.

        Raises:
            _StoppedError: It takes too many parts, or one cannot be proved.
        """
        if node.depth >= _DEEP:
            raise _StoppedError
        for half in self._feasible(work, node.halves(int(np.argmax(node.effects)))):
            self._all(work, replace(half, depth=node.depth + 1))

    def _halved(self, work: _Work, rows: SharedBounds, node: _Node) -> None:
        """Prove a part that nearly was, by the rows that it nearly was proved by.

        Raises:
            _StoppedError: It takes too many parts, or one cannot be proved.
        """
        halves = self._feasible(work, node.halves(int(np.argmax(node.effects))))
        parts = self._bounded(work, halves)
        for _, half in self._left(work, halves, self._by_rows(work, rows, parts)):
            self._all(work, replace(half, depth=node.depth + 1))

    def _bounded(self, work: _Work, nodes: Sequence[_Node]) -> list[PictureSets]:
        """Sets of parts.

        Raises:
            _StoppedError: There are too many, or one has none.
        """
        work.parts += len(nodes)
        late = work.asked > self.most // 2 and work.asked > _MORE * self.most * work.done
        if late or work.parts > 2.0 * _MORE * self.most:
            raise _StoppedError
        parts: list[PictureSets] = []
        for node in nodes:
            sets = self._sets(node.box)
            if sets is None:
                raise _StoppedError
            parts.append(sets)
        return parts

    def _left(self, work: _Work, nodes: Sequence[_Node], margins: np.ndarray) -> list[tuple[int, _Node]]:
        """Those of ``nodes`` that have no proof, by number; the others are done with.

        Raises:
            _StoppedError: One cannot be cut any further.
        """
        work.margins += [float(margin) for margin in margins if margin > 0.0]
        work.done += sum(node.share for node, margin in zip(nodes, margins, strict=True) if margin > 0.0)
        left = [(k, node) for k, node in enumerate(nodes) if not margins[k] > 0.0]
        if any(node.depth >= _DEEP for _, node in left):
            raise _StoppedError
        return left

    def _by_rows(self, work: _Work, rows: SharedBounds, parts: Sequence[PictureSets]) -> np.ndarray:
        """[m] margins of parts of a whole that is not proved, by its rows and by some of their own."""
        margins = np.full(len(parts), -np.inf)
        for fresh in ("last", "all"):
            left = np.flatnonzero(~(margins > 0.0)).tolist()
            if left:
                chosen = [parts[k] for k in left]
                bounds = rows.parts(self._images(chosen), work.query, fresh=fresh)
                margins[left] = self._proved(work, bounds, chosen)
        return margins

    def _images(self, parts: Sequence[PictureSets]) -> ImageSets:
        linear = [np.stack([sets.linear[k] for sets in parts]) for k in range(4)]
        lower, upper = (np.stack([getattr(sets, name) for sets in parts]) for name in ("lower", "upper"))
        return self.model.input_sets(tuple(linear), lower, upper)

    def _proved(self, work: _Work, bounds: OutputBounds, parts: Sequence[PictureSets]) -> np.ndarray:
        """[m] margins; what is no finite number proves nothing."""
        found = np.asarray(self.claim.proved(work.query, bounds, [sets.box for sets in parts]), np.float64)
        return np.where(np.isfinite(found), found, -np.inf)

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
            if not always and self._parts(cell, width, effects, goal) <= math.log2(self.most) and max(cuts) > 1:
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


def halvings(effects: np.ndarray, cost: float, least: int, aim: float, most: int) -> list[int]:
    """Axes along which to halve, in turn, until the sets cost ``aim`` of the margin; ``least`` at least.

    There is no use in many more parts than ``most``.
    """
    gains = np.where(np.isfinite(effects), effects, 0.0) + 1e-300
    goal = (aim / cost) ** (1.0 / _POWER) * float(gains.sum()) if cost > aim else math.inf
    axes: list[int] = []
    while len(axes) < least or (gains.sum() > goal and 2 ** len(axes) <= most):
        axis = int(np.argmax(gains))
        gains[axis] *= 0.5
        axes.append(axis)
    return axes


def joined(parts: Sequence[PictureSets]) -> PictureSets:
    """Sets, over a box around those of ``parts``, that hold every picture of each (V15)."""
    boxes = [sets.box for sets in parts]
    lower, upper = (np.array([getattr(box, name) for box in boxes]) for name in ("lower", "upper"))
    first = boxes[0]
    around = ParameterBox(
        first.names, first.units, tuple(lower.min(axis=0).tolist()), tuple(upper.max(axis=0).tolist())
    )
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    center, reach = around.middle, 0.5 * (np.array(around.upper) - np.array(around.lower))
    # p of the wider box is ``place + share q`` for q of a part
    place, share = (middle - center) / reach, half / reach
    a_low, b_low, a_high, b_high = (np.array([sets.linear[k] for sets in parts], np.float64) for k in range(4))
    # any slopes will do: these are the least squares' of the parts' middles, each taken by its volume
    weight = np.maximum(share, 1e-12).prod(axis=1)
    weight /= weight.sum()
    d, ones = first.dimensions, (1,) * (b_low.ndim - 1)
    slope, value = 0.5 * (a_low + a_high), 0.5 * (b_low + b_high)
    # float32's place is enough for what is arbitrary
    at, by = place.reshape(-1, *ones, d), share.reshape(-1, *ones, d)
    value = value - np.tensordot(weight, value, 1)
    moment = (place**2 + share**2 / 3.0) * weight[:, None]
    common = np.tensordot(weight, value[..., None] * at + slope * by / 3.0, 1) / np.maximum(moment.sum(axis=0), 1e-12)
    moved = (at * common).sum(axis=-1)
    low = b_low - moved - np.abs(a_low - by * common).sum(axis=-1)
    high = b_high - moved + np.abs(a_high - by * common).sum(axis=-1)
    # rounding of places, shares and the sums above; ends of boxes are rounded relative to themselves, not to widths
    ends = (np.abs(lower) + np.abs(upper)).max(axis=0) / reach
    sizes = np.abs(b_low) + np.abs(b_high) + np.abs(a_low).sum(axis=-1) + np.abs(a_high).sum(axis=-1)
    room = _ROOM * (sizes + (np.abs(common) * (2.0 + ends)).sum(axis=-1))
    return PictureSets(
        around,
        (common, (low - room).min(axis=0), common, (high + room).max(axis=0)),
        np.min([sets.lower for sets in parts], axis=0),
        np.max([sets.upper for sets in parts], axis=0),
    )
