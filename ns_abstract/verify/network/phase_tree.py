"""Branch and bound on activation phases over fixed intermediate bounds, many branches at a time (design.md, N16)."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.verify.network.bounds import NetworkBounds
from ns_abstract.verify.network.coefficients import Coefficients, Float64, Floats, Int64, grid
from ns_abstract.verify.network.output_bounds import ShiftedRows
from ns_abstract.verify.network.slope_choices import LineChoice, ReluSlopes, ascending
from ns_abstract.verify.network.slope_optimisation import DualAscent, OptimisedSlopes, SplitNeurons
from ns_abstract.verify.network.stopping import BackwardBounds

Phases = Mapping[int, NDArray[np.int8]]


@dataclass(frozen=True)
class TreeTuning:
    """Preferences of branch and bound; they change its time, and soundness does not depend on them.

    Attributes:
        together: Rows that are bounded at a time.
        root_steps, steps, last_steps: Optimisation steps of slopes and multipliers, for the whole cell, a branch, and a
            branch without unstable neurons.
        first: Size of the first step.
        multipliers: Size of the first step of multipliers, in magnitudes of coefficients: with the former they would
            hardly move in few steps.
        tried: Costliest neurons of a row, of which one is split.
        bounded: Of the neurons that were split often before, the number of best ones whose halves are bounded again.
        often: How often.
        better_half: Weight of the better half's gain beside the worse one's.
        waiting: Fraction of the branches' memory that waiting branches may take; beyond it the strongest are next.
    """

    together: int = 128
    root_steps: int = 20
    steps: int = 3
    last_steps: int = 60
    first: float = 0.2
    multipliers: float = 2.0
    tried: int = 20
    bounded: int = 5
    often: int = 4
    better_half: float = 1.0
    waiting: float = 0.5


_TUNING = TreeTuning()
#: Bytes of a branch beside its arrays' contents, about; and of a row's work, in those of the lines that it chooses.
_OBJECTS, _BESIDE = 4096, 4.0


class TreeResult(NamedTuple):
    """Whether all branches were proved, the number bounded, and the weakest bound, of open branches or of all."""

    proved: bool
    branches: int
    least: float


@dataclass(frozen=True)
class _Branch:
    """A branch.

    Attributes:
        phases: By activation: the assumed phases of its unstable neurons [U].
        lower: [g] bounds of the group's rows.
        parameters: By activation: [g, U] optimised slopes of its rows.
        multipliers: By activation [g, U].
        splits: Neurons to split next, as (activation, number); empty: none is unstable.
    """

    phases: Phases
    lower: Float64
    parameters: Mapping[int, Sequence[NDArray[np.float32]]] = field(default_factory=dict)
    multipliers: Mapping[int, NDArray[np.float32]] = field(default_factory=dict)
    splits: Sequence[tuple[int, int]] = ()

    @property
    def bytes(self) -> int:
        """The estimated bytes that it takes."""
        chosen = [parameter for own in self.parameters.values() for parameter in own]
        return _OBJECTS + sum(v.nbytes for v in (*self.phases.values(), *self.multipliers.values(), *chosen))

    def halves(self, split: tuple[int, int]) -> list[_Branch]:
        """Return the two branches with either phase of a further neuron assumed."""
        node, at = split
        children = []
        for side in (1, -1):
            own = self.phases[node].copy()
            own[at] = side
            children.append(replace(self, phases={**self.phases, node: own}))
        return children


class _Half(NamedTuple):
    """A branch's number, and a neuron (activation and number) whose phase, 1 or -1, is assumed in addition."""

    branch: int
    split: tuple[int, int]
    side: int


class SplitGains:
    """Records the gains of splitting a neuron, from branches in which both of its halves were bounded.

    Args:
        bounded, often: See `TreeTuning`.
    """

    def __init__(self, bounded: int, often: int) -> None:
        self.bounded, self.often = bounded, often
        self._noted: dict[tuple[int, int], tuple[float, int]] = {}

    def note(self, split: tuple[int, int], gain: float) -> None:
        """Record the gain of ``split``, as a fraction of the branch's missing margin."""
        total, count = self._noted.get(split, (0.0, 0))
        self._noted[split] = total + gain, count + 1

    def hopeful(self, splits: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
        """Return the ``splits`` with few records, and the best of the others by their mean gain."""
        means = {}
        for split in splits:
            total, count = self._noted.get(split, (0.0, 0))
            if count >= self.often:
                means[split] = total / count
        best = set(sorted(means, key=lambda split: -means[split])[: self.bounded])
        return [split for split in splits if split not in means or split in best]


class PhaseTree:
    """Proves that some row of a group is positive, by branching on phases of unstable ReLUs.

    Every branch uses the cell's intermediate bounds, which hold in it, too.

    Args:
        cells: Bounds of one cell, with slopes to be optimised.
        rows, offset: Of the outputs, as in `ns_abstract.verify.network.bound_outputs`.
        tuning: Preferences.
    """

    def __init__(self, cells: NetworkBounds, rows: Any, offset: Float64, tuning: TreeTuning = _TUNING) -> None:
        self.intermediate, self.network = cells.intermediate, cells.intermediate.network
        self.ascent, self.tuning = cells.output_rows.ascent, tuning
        self.choices: dict[int, Sequence[LineChoice]] = ascending(self.intermediate.unstable, 0)
        self.relus = {k: own[0] for k, own in self.choices.items() if isinstance(own[0], ReluSlopes)}
        self.index = len(self.network.nodes)
        self.shifted = cells.output_rows.shifted(cells.last, rows, offset)
        self.room = int(tuning.waiting * cells.output_rows.backward.memory)
        self.gains = SplitGains(tuning.bounded, tuning.often)
        # lines of a row's own, and what is worked out beside them
        lines = [self.intermediate.relaxations[-1].lines[k][:, 0].nbytes for k in self.choices]
        self.together = min(tuning.together, int(cells.output_rows.backward.memory / (_BESIDE * sum(lines) + 1.0)))
        self._least = np.inf

    def prove(self, group: Sequence[int], most: int) -> TreeResult:
        """Try to prove that, for every image of the cell, a row of ``group`` is positive.

        Args:
            group: Numbers of rows.
            most: Number of branches after which it gives up.
        """
        if not self.intermediate.usable[0] or not group:
            return TreeResult(False, 0, -np.inf)
        self._least = np.inf
        rows = _GroupRows.of(self.shifted, list(group), grid(self.network.shape(self.index)))
        none = {k: np.zeros(len(own.units.flat), np.int8) for k, own in self.relus.items()}
        number, count = itertools.count(), 1
        opened = self._climbed(rows, [_Branch(none, np.full(len(group), -np.inf))], self.tuning.root_steps)
        waiting = [(float(branch.lower.max()), next(number), branch) for branch in opened]
        size = max(1, self.together // (2 * len(group)))
        while waiting:
            check_cancelled()
            worst = waiting[0][0]
            if count >= most:
                return TreeResult(False, count, worst)
            taken = self._taken(waiting, size)
            ended = [branch for branch in taken if not branch.splits]
            if ended and self._climbed(rows, ended, self.tuning.last_steps):
                return TreeResult(False, count, worst)
            taken = [branch for branch in taken if branch.splits]
            if not taken:
                continue
            halves = self._halves(rows, taken)
            count += len(halves)
            for branch in self._climbed(rows, halves, self.tuning.steps):
                heapq.heappush(waiting, (float(branch.lower.max()), next(number), branch))
        return TreeResult(True, count, self._least)

    def _taken(self, waiting: list[tuple[float, int, _Branch]], size: int) -> list[_Branch]:
        """Take up to ``size`` branches off the heap: the weakest, or the strongest if there is no memory for more."""
        if len(waiting) * waiting[0][2].bytes <= self.room:
            return [heapq.heappop(waiting)[2] for _ in range(min(size, len(waiting)))]
        # what is sorted is a heap, and so is its beginning
        waiting.sort()
        taken = [entry[2] for entry in waiting[-size:]]
        del waiting[-size:]
        return taken

    def _ascent(
        self, rows: _GroupRows, branches: Sequence[_Branch], halves: Sequence[_Half] = ()
    ) -> tuple[DualAscent, dict[int, tuple[int, Int64]]]:
        """Return an ascent over the rows of all branches, or of ``halves`` of them, from the branches' slopes.

        The second result is that of `_held`.
        """
        g = len(rows.offset)
        owner = np.array([half.branch for half in halves]) if halves else np.arange(len(branches))
        number = (owner[:, None] * g + np.arange(g)).reshape(-1)
        phases = {k: np.stack([b.phases[k] for b in branches])[np.repeat(owner, g)] for k in self.relus}
        for place, (_, (node, at), side) in enumerate(halves):
            phases[node][place * g : (place + 1) * g, at] = side
        held, places = self._held(phases)
        lines = {k: self.intermediate.relaxations[-1].lines[k][:, 0] for k in self.choices}
        steps = self.tuning.first, self.tuning.multipliers
        ascent = DualAscent(self.choices, lines, len(number), held, phases, *steps)
        if branches[0].parameters:
            for k, own in ascent.parameters.items():
                for choice in range(len(own)):
                    stored = np.concatenate([b.parameters[k][choice] for b in branches])
                    own[choice] = stored[number].astype(np.float64)
            for source, (k, used) in places.items():
                ascent.multipliers[source] = np.concatenate([b.multipliers[k][:, used] for b in branches])[number]
        return ascent, places

    def _held(self, phases: Phases) -> tuple[dict[int, SplitNeurons], dict[int, tuple[int, Int64]]]:
        """Return by source the neurons with assumed phases [R, U], and their activation and numbers there."""
        held: dict[int, SplitNeurons] = {}
        places: dict[int, tuple[int, Int64]] = {}
        noise = self.intermediate.relaxations[-1].noise
        for k, sides in phases.items():
            source, units = self.network.nodes[k - 1].inputs[0], self.relus[k].units
            used = np.flatnonzero(sides.any(0))
            if not len(used) or source in held:
                continue
            flat = units.flat[used]
            # rounding of rows and of the node, whether or not it rides on the lines
            shake = units.loose[used] + (noise[source].flatten(1).numpy()[0, flat] if source in noise else 0.0)
            held[source] = SplitNeurons(flat, sides[:, used].astype(np.float64), units.reference[used], shake)
            places[source] = k, used
        return held, places

    def _climbed(self, rows: _GroupRows, branches: Sequence[_Branch], steps: int) -> list[_Branch]:
        """Return the branches that are not proved, with optimised bounds and with neurons to split next."""
        g, left = len(rows.offset), np.arange(len(branches))
        ascent, places = self._ascent(rows, branches)
        best = np.stack([b.lower for b in branches])
        for number in range(steps + 1):
            check_cancelled()
            chosen, bounds = self.ascent.evaluate(self.index, rows.start(len(left)), 0, ascent)
            best = np.fmax(best, rows.lower(bounds).reshape(-1, g))
            if number < steps:
                self.ascent.move(self.index, 0, chosen, bounds, ascent)
            open_ = ~(best > 0.0).any(1)
            if not open_.all():
                self._least = min(self._least, float(best[~open_].max(1).min()))
                unsettled = np.repeat(open_, g)
                left, best = left[open_], best[open_]
                ascent.keep(unsettled)
                chosen.trace = {k: v[unsettled] for k, v in chosen.trace.items()}
                if not len(left):
                    return []
        at = np.arange(len(left)) * g + best.argmax(1)
        splits = self._candidates(chosen, at, [branches[int(k)].phases for k in left])
        multipliers = {k: np.zeros((len(left) * g, len(own.units.flat)), np.float32) for k, own in self.relus.items()}
        for source, (k, used) in places.items():
            multipliers[k][:, used] = ascent.multipliers[source]
        climbed = []
        for place, number in enumerate(left.tolist()):
            own = slice(place * g, (place + 1) * g)
            parameters = {k: [v[own].astype(np.float32) for v in vs] for k, vs in ascent.parameters.items()}
            paid = {k: v[own] for k, v in multipliers.items()}
            climbed.append(_Branch(branches[number].phases, best[place], parameters, paid, splits[place]))
        return climbed

    def _candidates(self, chosen: OptimisedSlopes, at: Int64, phases: Sequence[Phases]) -> list[list[tuple[int, int]]]:
        """Return by branch the unstable neurons whose relaxations cost row ``at`` most, given its optimised slopes."""
        scores, nodes, places = [], [], []
        for k, own in self.relus.items():
            count = len(own.units.flat)
            flat = chosen.trace[k].reshape(len(chosen.trace[k]), -1) if k in chosen.trace else None
            score = np.zeros((len(at), count)) if flat is None else own.losses(flat[at][:, own.units.flat])
            scores.append(np.where(np.stack([p[k] for p in phases]) == 0, score, -1.0))
            nodes.append(np.full(count, k))
            places.append(np.arange(count))
        if not scores:
            return [[] for _ in at]
        score, node, place = np.concatenate(scores, 1), np.concatenate(nodes), np.concatenate(places)
        order = np.argsort(-score, axis=1, kind="stable")[:, : self.tuning.tried]
        return [[(int(node[j]), int(place[j])) for j in row if score[i, j] >= 0.0] for i, row in enumerate(order)]

    def _halves(self, rows: _GroupRows, branches: Sequence[_Branch]) -> list[_Branch]:
        """Return both halves of each branch, split at the candidate whose worse half is bounded best."""
        g = len(rows.offset)
        hopeful = [self.gains.hopeful(branch.splits) for branch in branches]
        splits = [(number, split) for number, own in enumerate(hopeful) for split in own]
        bounds = []
        step = max(1, self.together // (2 * g))
        for first in range(0, len(splits), step):
            check_cancelled()
            part = splits[first : first + step]
            parents = branches[part[0][0] : part[-1][0] + 1]
            halves = [_Half(number - part[0][0], split, side) for number, split in part for side in (1, -1)]
            ascent, _ = self._ascent(rows, parents, halves)
            _, passed = self.ascent.evaluate(self.index, rows.start(len(halves)), 0, ascent)
            bounds.append(rows.lower(passed).reshape(-1, 2, g).max(2))
        # what is proved cannot become better
        ends = np.minimum(np.concatenate(bounds), 0.0)
        score = ends.min(1) + self.tuning.better_half * ends.max(1)
        chosen: dict[int, int] = {}
        for k, (number, split) in enumerate(splits):
            miss = -(1.0 + self.tuning.better_half) * float(branches[number].lower.max())
            if 0.0 < miss < np.inf and np.isfinite(score[k]):
                self.gains.note(split, 1.0 + float(score[k]) / miss)
            if number not in chosen or score[k] > score[chosen[number]]:
                chosen[number] = k
        return [half for number, k in chosen.items() for half in branches[number].halves(splits[k][1])]


@dataclass(frozen=True)
class _GroupRows:
    """The rows of a group on the outputs, in the window that holds them."""

    value: Floats
    top: int
    left: int
    offset: Float64
    missing: Float64

    @staticmethod
    def of(shifted: ShiftedRows, group: list[int], shape: tuple[int, int, int]) -> _GroupRows:
        value = shifted.stored[group].reshape(len(group), *shape)
        used = [np.flatnonzero((value != 0.0).any((0, 1, axis))) for axis in (3, 2)]
        (top, bottom), (left, right) = ((int(v[0]), int(v[-1]) + 1) if len(v) else (0, 1) for v in used)
        part = np.ascontiguousarray(value[:, :, top:bottom, left:right])
        return _GroupRows(part, top, left, shifted.offset[0, group], shifted.missing[0, group])

    def start(self, count: int) -> Coefficients:
        """Return the rows of ``count`` branches."""
        value = np.tile(self.value, (count, 1, 1, 1))
        return Coefficients(value, np.full(len(value), self.top), np.full(len(value), self.left))

    def lower(self, bounds: BackwardBounds) -> Float64:
        """Return bounds [R] of the rows; minus infinity where none is known."""
        count = len(bounds.lower) // len(self.offset)
        offset, missing = np.tile(self.offset, count), np.tile(self.missing, count)
        room = ShiftedRows(self.value, missing, offset).room(bounds.plane[:, 0])
        lower = bounds.lower + offset - room
        return np.where(np.isfinite(lower), lower, -np.inf)
