"""Decides whether a network has an unsafe output in a box of inputs: bounds, attacks, bisection, branch and bound.

See docs/dev/design.md, V11.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from ns_abstract.execution.cancellation import Deadline, WorkCancelledError, check_cancelled
from ns_abstract.verify.network import ImageSets, Network, NetworkArithmetic, OutputBounds, bound_outputs
from ns_abstract.verify.network.bounds import NetworkBounds
from ns_abstract.verify.network.dependence import input_shares
from ns_abstract.verify.network.neuron_bounds import farther_steps
from ns_abstract.verify.network.phase_tree import PhaseTree
from ns_abstract.verify.network.subnormals import subnormals_kept
from ns_abstract.verify.network.weighted_means import centred
from ns_abstract.verify.vnnlib_sets import InputRegion, UnsafeSet

#: The competitions' words: an unsafe output was found; there is none; not decided; not decided in time.
Verdict = Literal["sat", "unsat", "unknown", "timeout"]

#: Inputs that vary up to which each is a parameter of its own.
_PARAMETERS = 16
#: Boxes bounded together: as many as have so many numbers of layers between them, and no more than the second number;
#: and the most that wait beside those of the question.
_TOGETHER, _MOST, _WAITING = 1 << 21, 256, 1 << 14
#: Numbers of layers of the inputs that are attacked at a time.
_ATTACKED = 1 << 23
#: Steps towards the best lines for intermediate bounds of a box that is not cut.
_STEPS = 12
#: Branches of a box of many inputs, whose halves would hardly be easier.
_BRANCHES = 1 << 20


@dataclass(frozen=True)
class BoxTuning:
    """Preferences of the search over boxes; a verdict needs a proof or an execution of the network."""

    #: Starts and steps of the first attack on a region, and of the one on groups that resist a proof; what is no
    #: further from unsafe, relative to one, is run. After that part of the time the first attack descends no more.
    first_attack: tuple[int, int] = (12, 25)
    first_share: float = 0.1
    later_attack: tuple[int, int] = (64, 60)
    nearly_unsafe: float = 1e-5
    #: Part of the time that is left for the later attack; it never has less starts and steps than these.
    later_share: float = 0.1
    least_attack: tuple[int, int] = (12, 20)
    #: Most inputs that are attacked at a time.
    most_attacked: int = 1024
    #: Inputs that vary up to which a box is cut; phases are assumed in boxes of more. Of up to so many inputs a box is
    #: cut across one besides, if this has so large a part in what moves the neurons.
    most_to_cut: int = 6
    most_to_rank: int = 64
    dominant_share: float = 0.25
    #: What the width of an input counts beside its slope.
    width_share: float = 1e-9
    #: Part of the time that is left for lines of intermediate bounds. What a step towards these takes beside bounds
    #: with plain ones, and how many steps their first evaluation and those plain bounds amount to.
    lines_share: float = 0.6
    step_cost: float = 0.75
    steps_before: int = 3
    #: What a step, or the evaluation of an input, is taken to need at least.
    least_seconds: float = 1e-6


_TUNING = BoxTuning()


@dataclass(frozen=True)
class Decision:
    """The answer to an instance; with "sat", an input x [n] inside a region and its float32 outputs y [k]."""

    word: Verdict
    x: np.ndarray | None = None
    y: np.ndarray | None = None
    boxes: int = 0


@subnormals_kept()
def decide(
    network: Network,
    run: Callable[[np.ndarray], np.ndarray],
    regions: Sequence[InputRegion],
    deadline: Deadline,
    *,
    memory: int = 1 << 30,
    arithmetic: NetworkArithmetic = "float32",
) -> Decision:
    """Return a decision after searching the regions for unsafe outputs and for a proof that there are none (V11).

    ``run`` executes the network in its runtime: outputs [k] for one image [1, *input_shape] float32; only its outputs
    make a counterexample. Bounds may take ``memory`` bytes; ``arithmetic`` is the one that a proof covers.
    """
    search = _BoxSearch(network, run, deadline, memory, arithmetic)
    try:
        with deadline.enforced():
            for shared in _by_property(regions):
                if search.decide(shared):
                    return Decision("sat", *search.counterexample, search.boxes)
    except WorkCancelledError:
        return Decision("timeout", boxes=search.boxes)
    return Decision("unknown" if search.undecided else "unsat", boxes=search.boxes)


@dataclass(frozen=True)
class _SharedProperty:
    """Regions with ends [m, n] that share the same functions of the outputs, with offsets [m, k]."""

    regions: Sequence[InputRegion]
    lower: np.ndarray
    upper: np.ndarray
    offset: np.ndarray

    @property
    def unsafe(self) -> UnsafeSet:
        """The functions (rows) and their groups, with the first region's offsets."""
        return self.regions[0].unsafe

    def value(self, y: torch.Tensor, which: np.ndarray, group: Sequence[int] | None) -> torch.Tensor:
        """Return a value [B] for outputs [B, ...] of inputs in regions ``which``: unsafe where it is <= 0.

        ``group``: the rows that count; None: all groups.
        """
        rows = y.flatten(1) @ torch.from_numpy(self.unsafe.rows).T + torch.from_numpy(self.offset[which])
        wanted = self.unsafe.groups if group is None else [group]
        groups = [rows[:, list(one)].amax(1) for one in wanted if one]
        return torch.stack(groups).amin(0) if groups else torch.zeros(len(rows), dtype=rows.dtype)


def _by_property(regions: Sequence[InputRegion]) -> Iterator[_SharedProperty]:
    """Yield the regions that are not empty, grouped by their functions of the outputs."""
    kinds: dict[tuple[bytes, Any], list[InputRegion]] = {}
    for region in regions:
        if not bool((region.lower > region.upper).any()):
            kinds.setdefault((region.unsafe.rows.tobytes(), region.unsafe.groups), []).append(region)
    for kind in kinds.values():
        lower, upper = (np.stack([getattr(region, name) for region in kind]) for name in ("lower", "upper"))
        yield _SharedProperty(kind, lower, upper, np.stack([region.unsafe.offset for region in kind]))


#: A box and the region that it is part of.
_Box = tuple[int, np.ndarray, np.ndarray]


class _BoxSearch:
    """Search for a counterexample of properties over boxes of inputs, by attacks, bounds, cuts and branching.

    Methods that return a bool return True if they found a counterexample, which is stored; `undecided` is set where one
    may remain. ``which`` numbers regions of a property.
    """

    def __init__(
        self,
        network: Network,
        run: Callable[[np.ndarray], np.ndarray],
        deadline: Deadline,
        memory: int,
        arithmetic: NetworkArithmetic,
    ) -> None:
        self.network, self.run, self.deadline, self.memory = network, run, deadline, memory
        # what is bounded; equal to the network in the arithmetic that is asked for
        self.bounded = network
        self.arithmetic: NetworkArithmetic = arithmetic
        self.boxes = 0
        total = sum(int(np.prod(network.shape(k))) for k in range(len(network.nodes) + 1))
        self.batch = min(_MOST, max(8, _TOGETHER // total))
        self.attack_batch = min(_TUNING.most_attacked, max(4, _ATTACKED // total))
        self.undecided = False
        # seconds of an input in the first attack, and of the latest bounds of all nodes
        self.seconds_by_input, self.seconds_by_bounds = _TUNING.least_seconds, 0.0
        self.evaluated_inputs = 0
        self.counterexample: tuple[np.ndarray, np.ndarray] = (np.zeros(0), np.zeros(0))

    def decide(self, shared: _SharedProperty) -> bool:
        """Return whether a region has a counterexample, which is stored; sets `undecided` if that stays open."""
        start, self.evaluated_inputs = self.deadline.left, 0
        descent = self.deadline.within(_TUNING.first_share * start)
        if self._attack(shared, np.arange(len(shared.regions)), *_TUNING.first_attack, descent=descent):
            return True
        self.seconds_by_input = max(_TUNING.least_seconds, (start - self.deadline.left) / max(1, self.evaluated_inputs))
        if not all(shared.unsafe.groups):
            # any output is unsafe, and no input could be shown to have one
            self.undecided = True
            return False
        if self.arithmetic == "real":
            middle = torch.from_numpy(0.5 * (shared.lower[0] + shared.upper[0]))
            self.bounded = centred(self.network, middle.reshape(1, *self.network.input_shape))
        if int((shared.upper > shared.lower).sum(1).max()) <= _TUNING.most_to_cut:
            return self._bisect(shared)
        return any(self._branch(shared, which) for which in range(len(shared.regions)))

    # ------------------------------------------------------------ proofs

    def _bisect(self, shared: _SharedProperty) -> bool:
        """Return whether bisection of the regions finds a counterexample; sets `undecided` where it gives up."""
        waiting: list[_Box] = list(zip(range(len(shared.regions)), shared.lower, shared.upper, strict=True))
        most = _WAITING + len(waiting)
        while waiting:
            check_cancelled()
            boxes, waiting = waiting[-self.batch :], waiting[: -self.batch]
            bounds = self._bound(shared, boxes)
            proved = proves(bounds, shared.unsafe.groups)
            self.boxes += len(boxes)
            left = np.flatnonzero(~proved)
            if len(left) and self._probe(shared, [(boxes[k], bounds.a[k]) for k in left]):
                return True
            for k in left:
                halves = _cut(*boxes[k][1:], bounds.a[k])
                if halves is None or len(waiting) > most:
                    self.undecided = True
                    return False
                waiting += [(boxes[k][0], *half) for half in halves]
        return False

    def _branch(self, shared: _SharedProperty, which: int) -> bool:
        """Return whether cuts of inputs and branching on phases (N16) find a counterexample in region ``which``."""
        waiting = [(shared.lower[which], shared.upper[which], shared.unsafe.groups)]
        attacked = False
        while waiting:
            check_cancelled()
            lower, upper, groups = waiting.pop()
            images = self._input_sets(lower[None], upper[None])
            tree, left = self._phase_tree(shared, which, images, 0, groups)
            if left and not attacked:
                if self._attack(shared, np.array([which]), *self._later_attack(len(left)), left):
                    return True
                attacked = True
            halves = self._dominant_halves(lower, upper) if left else None
            if halves is not None:
                # what is proved of the whole holds in both
                waiting += [(*half, left) for half in halves]
            elif not self._prove_by_branching(shared, which, images, tree, left, 1 + len(waiting)):
                self.undecided = True
                return False
        return False

    def _prove_by_branching(
        self,
        shared: _SharedProperty,
        which: int,
        images: ImageSets,
        tree: PhaseTree,
        left: Sequence[tuple[int, ...]],
        boxes: int,
    ) -> bool:
        """Return whether the open groups ``left`` are proved by tighter intermediate bounds and by branching.

        ``boxes``: the number of boxes that share the remaining time.
        """
        by_step = max(_TUNING.least_seconds, _TUNING.step_cost * self.seconds_by_bounds)
        allowed = _TUNING.lines_share * self.deadline.left / boxes
        steps = int(min(1e6, allowed / by_step)) - _TUNING.steps_before
        if farther_steps(steps):
            # with the evaluation that they begin with
            steps -= farther_steps(steps) + 1
        steps = min(_STEPS, steps)
        if left and steps > 0:
            try:
                with self.deadline.within(allowed).enforced():
                    tree, left = self._phase_tree(shared, which, images, steps, left)
            except WorkCancelledError:
                # what is known without goes on
                check_cancelled()
        for group in left:
            result = tree.prove(group, _BRANCHES)
            self.boxes += result.branches
            if not result.proved:
                return False
        return True

    def _dominant_halves(self, lower: np.ndarray, upper: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]] | None:
        """Return two halves of a box [n], cut across the input that moves the neurons most; None if none dominates."""
        if not 0 < int((upper > lower).sum()) <= _TUNING.most_to_rank:
            return None
        parts = input_shares(self.network, lower, upper)
        at = int(parts.argmax())
        return _halves(lower, upper, at) if parts[at] > _TUNING.dominant_share else None

    def _phase_tree(
        self, shared: _SharedProperty, which: int, images: ImageSets, steps: int, groups: Sequence[tuple[int, ...]]
    ) -> tuple[PhaseTree, list[tuple[int, ...]]]:
        """Return a tree of activation phases for region ``which``, and the groups that its root leaves open."""
        start = self.deadline.left
        cells = NetworkBounds(
            self.bounded, images, self.memory, self.arithmetic, 1, intermediate_steps=steps,
            asked=shared.unsafe.rows, coarse=True,
        )  # fmt: skip
        self.seconds_by_bounds = start - self.deadline.left
        tree, left = PhaseTree(cells, shared.unsafe.rows, shared.offset[which]), []
        for group in groups:
            result = tree.prove(group, 1)
            self.boxes += result.branches
            if not result.proved:
                left.append(group)
        return tree, left

    def _input_sets(self, lower: np.ndarray, upper: np.ndarray) -> ImageSets:
        """Return boxes [m, n] as image sets; inputs that vary are the parameters, in order, if they are few."""
        varies = upper > lower
        # the program rounds an input to float32, and rounding keeps the order
        lower = np.minimum(lower, lower.astype(np.float32).astype(np.float64))
        upper = np.maximum(upper, upper.astype(np.float32).astype(np.float64))
        m, n = lower.shape
        d = int(varies.sum(1).max())
        if not 0 < d <= _PARAMETERS:
            none = np.zeros((m, n, 1))
            return ImageSets(none, lower, none, upper, lower, upper)
        middle = 0.5 * (lower + upper)
        half = np.nextafter(np.maximum(upper - middle, middle - lower), np.inf)
        a = np.zeros((m, n, d))
        cell, at = np.nonzero(varies)
        a[cell, at, (np.cumsum(varies, 1) - 1)[cell, at]] = half[cell, at]
        return ImageSets(a, np.where(varies, middle, lower), a, np.where(varies, middle, upper), lower, upper)

    def _bound(self, shared: _SharedProperty, boxes: Sequence[_Box]) -> OutputBounds:
        """Return bounds over boxes, with slopes by all inputs."""
        which, lower, upper = (np.stack(ends) for ends in zip(*boxes, strict=True))
        bounds = bound_outputs(
            self.bounded,
            self._input_sets(lower, upper),
            shared.unsafe.rows,
            shared.offset[which],
            memory=self.memory,
            arithmetic=self.arithmetic,
        )
        varies = upper > lower
        slopes = np.zeros((*bounds.lower.shape, lower.shape[1]))
        cell, at = np.nonzero(varies)
        slopes[cell, :, at] = bounds.a[cell, :, (np.cumsum(varies, 1) - 1)[cell, at]]
        return OutputBounds(bounds.lower, slopes, bounds.b)

    # ------------------------------------------------------------ counterexamples

    def _value(
        self, shared: _SharedProperty, x: torch.Tensor, which: np.ndarray, group: Sequence[int] | None = None
    ) -> torch.Tensor:
        """Return how safe the outputs for inputs ``x`` in regions ``which`` are (`_SharedProperty.value`)."""
        return shared.value(self.network(x.reshape(-1, *self.network.input_shape)), which, group)

    def _attack(
        self,
        shared: _SharedProperty,
        regions: np.ndarray,
        starts: int,
        steps: int,
        groups: Sequence[Sequence[int]] | None = None,
        descent: Deadline | None = None,
    ) -> bool:
        """Return whether signed gradient descent from middles, corners and random inputs finds a counterexample.

        Of several ``groups`` each is attacked alone. Starts after ``descent`` are evaluated only.
        """
        # a few steps where there are many regions: most are tiny
        steps = min(steps, max(3, 4 * self.attack_batch // len(regions)))
        starts = max(2, min(starts, self.attack_batch, _TUNING.most_attacked // len(regions)))
        generator = torch.Generator().manual_seed(0)
        step = max(1, self.attack_batch // starts)
        for first in range(0, len(regions), step):
            which = regions[first : first + step]
            ends = shared.lower[which], shared.upper[which]
            lower, upper = (torch.from_numpy(end).repeat_interleave(starts, 0) for end in ends)
            part = torch.rand((len(which), starts, lower.shape[1]), generator=generator, dtype=torch.float64)
            part[:, 0] = 0.5
            part[:, 1 : starts // 2] = (part[:, 1 : starts // 2] < 0.5).double()
            x = lower + part.flatten(0, 1) * (upper - lower)
            for group in groups or [None]:
                moves = 1 if descent is not None and descent.late else steps
                if self._descend(shared, np.repeat(which, starts), x, (lower, upper), moves, group):
                    return True
        return False

    def _later_attack(self, groups: int) -> tuple[int, int]:
        """Return starts and steps of the second attack: fewer where all would take too much of the remaining time."""
        starts, steps = _TUNING.later_attack
        allowed = _TUNING.later_share * self.deadline.left / (self.seconds_by_input * groups)
        part = min(1.0, max(0.0, allowed) / (starts * steps)) ** 0.5
        return max(_TUNING.least_attack[0], int(part * starts)), max(_TUNING.least_attack[1], int(part * steps))

    def _descend(
        self,
        shared: _SharedProperty,
        which: np.ndarray,
        x: torch.Tensor,
        ends: tuple[torch.Tensor, torch.Tensor],
        steps: int,
        group: Sequence[int] | None,
    ) -> bool:
        """Return whether gradient descent from inputs ``x`` in regions ``which`` finds a counterexample."""
        lower, upper = ends
        size = 0.25
        for left in reversed(range(steps)):
            check_cancelled()
            self.evaluated_inputs += len(x)
            x = x.detach().requires_grad_(left > 0)
            value = self._value(shared, x, which, group)
            if self._confirm(shared, x.detach(), which, value.detach()):
                return True
            if not value.requires_grad:
                break
            (slope,) = torch.autograd.grad(value.sum(), x)
            x = torch.minimum(torch.maximum(x.detach() - size * slope.sign() * (upper - lower), lower), upper)
            size *= 0.001 ** (1.0 / steps)
        return False

    def _probe(self, shared: _SharedProperty, boxes: Sequence[tuple[_Box, np.ndarray]]) -> bool:
        """Return whether the middles of boxes, or the corners where their lower planes are least, are unsafe."""
        x, which = [], []
        for (region, lower, upper), slopes in boxes:
            x.append(0.5 * (lower + upper))
            x += [np.where(row > 0.0, lower, upper) for row in slopes]
            which += [region] * (1 + len(slopes))
        with torch.no_grad():
            tried, regions = torch.from_numpy(np.stack(x)), np.array(which)
            return self._confirm(shared, tried, regions, self._value(shared, tried, regions))

    def _confirm(self, shared: _SharedProperty, x: torch.Tensor, which: np.ndarray, value: torch.Tensor) -> bool:
        """Return whether the runtime, too, finds one of the inputs unsafe; ``which``: the numbers of their regions."""
        order = torch.argsort(value)[:2].tolist()
        for k in order:
            if not float(value[k]) <= _TUNING.nearly_unsafe * (1.0 + abs(float(value[k]))):
                continue
            region = shared.regions[int(which[k])]
            point = np.clip(x[k].numpy(), region.lower, region.upper)
            y = run_once(self.network, self.run, point)
            if bool(np.isfinite(y).all()) and region.holds(y):
                self.counterexample = point, y
                return True
        return False


def _cut(lower: np.ndarray, upper: np.ndarray, slopes: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]] | None:
    """Return two halves of the box, cut across the most influential input by ``slopes`` [k, n]; None if too small."""
    width = upper - lower
    # slopes are by half widths
    score = np.abs(slopes).max(0) + _TUNING.width_share * width
    return _halves(lower, upper, int(np.argmax(np.where(width > 0.0, score, -1.0))))


def _halves(lower: np.ndarray, upper: np.ndarray, at: int) -> list[tuple[np.ndarray, np.ndarray]] | None:
    """Return two halves of the box [n], cut across input ``at``; None if too small. Both hold the face between."""
    middle = 0.5 * (lower[at] + upper[at])
    if not lower[at] < middle < upper[at]:
        return None
    left, right = upper.copy(), lower.copy()
    left[at] = right[at] = middle
    return [(lower, left), (right, upper)]


def run_once(network: Network, run: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Return the runtime's outputs [k] float64 for the float32 numbers nearest to ``x`` [n]."""
    image = np.asarray(x, np.float32).reshape(1, *network.input_shape)
    return np.asarray(run(image), np.float64).reshape(-1)


def proves(bounds: Any, groups: Sequence[Sequence[int]]) -> np.ndarray:
    """Return [m] whether every group has a row that is surely positive; NaN proves nothing."""
    positive = np.asarray(bounds.lower) > 0.0
    proved = np.ones(len(positive), bool)
    for group in groups:
        proved &= positive[:, list(group)].any(1)
    return proved
