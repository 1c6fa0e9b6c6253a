"""Decide whether a network has an unsafe output in a box of inputs: bounds, attacks, bisection, branch and bound.

See docs/dev/design.md, V11.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from ns_abstract.execution.cancellation import WorkCancelledError, cancel_when, check_cancelled
from ns_abstract.verify.network import ImageSets, Network, NetworkArithmetic, OutputBounds, bound_outputs
from ns_abstract.verify.network.branching import branch
from ns_abstract.verify.vnnlib import InputRegion

#: The competitions' words: an unsafe output was found; there is none; not decided; not decided in time.
Verdict = Literal["sat", "unsat", "unknown", "timeout"]

#: Inputs up to which every input is a parameter of its own.
_PARAMETERS = 16
#: Boxes bounded together: as many as have so many numbers of layers between them, and no more than the second number;
#: and the most that wait.
_TOGETHER, _MOST, _WAITING = 1 << 18, 256, 1 << 14
#: Steps towards the best lines for intermediate bounds of such a box.
_STEPS = 12
#: Branches of a box of many inputs, whose halves would hardly be easier.
_BRANCHES = 1 << 14


@dataclass(frozen=True)
class BoxTuning:
    """Preferences of the search over boxes; a verdict needs a proof or a run."""

    #: Starts and steps of the first attack on a region; what is no further from unsafe, relative to one, is run.
    starts: int = 12
    steps: int = 25
    near: float = 1e-5
    #: What the width of an input counts beside its slope.
    width: float = 1e-9


_TUNING = BoxTuning()


@dataclass(frozen=True)
class Decision:
    """The answer to an instance.

    Attributes:
        word: The verdict.
        x, y: With "sat": the input [n] float64 inside a region and the outputs [k] for it in float32.
        boxes: Boxes that were bounded.
    """

    word: Verdict
    x: np.ndarray | None = None
    y: np.ndarray | None = None
    boxes: int = 0


def decide(
    network: Network,
    run: Callable[[np.ndarray], np.ndarray],
    regions: Sequence[InputRegion],
    over: Callable[[], bool],
    *,
    memory: int = 1 << 30,
    arithmetic: NetworkArithmetic = "float32",
) -> Decision:
    """Search the regions for an input with an unsafe output and for a proof that there is none (V11).

    Args:
        network: The network.
        run: The program that counts: outputs [k] for one image [1, *input_shape] float32. Only what it
            computes is a counterexample.
        regions: Boxes of inputs, and what is unsafe there.
        over: Whether time is up.
        memory: Bytes that bounds may take.
        arithmetic: What a proof covers.
    """
    search = _BoxSearch(network, run, memory, arithmetic)
    try:
        with cancel_when(over):
            for region in regions:
                if search.settle(region):
                    return Decision("sat", *search.found, search.boxes)
    except WorkCancelledError:
        return Decision("timeout", boxes=search.boxes)
    return Decision("unknown" if search.undecided else "unsat", boxes=search.boxes)


class _BoxSearch:
    def __init__(
        self, network: Network, run: Callable[[np.ndarray], np.ndarray], memory: int, arithmetic: NetworkArithmetic
    ) -> None:
        self.network, self.run, self.memory = network, run, memory
        self.arithmetic: NetworkArithmetic = arithmetic
        self.boxes = 0
        total = sum(int(np.prod(network.shape(k))) for k in range(len(network.nodes) + 1))
        self.together = min(_MOST, max(8, _TOGETHER // total))
        self.undecided = False
        self.found: tuple[np.ndarray, np.ndarray] = (np.zeros(0), np.zeros(0))

    def settle(self, region: InputRegion) -> bool:
        """Whether the region has a counterexample, which `found` then is; `undecided` if that is not known."""
        if bool((region.lower > region.upper).any()):
            return False
        if self._attack(region):
            return True
        if not all(region.unsafe.groups):
            # any output is unsafe, and no input could be shown to have one
            self.undecided = True
            return False
        if len(region.lower) > _PARAMETERS:
            branching = branch(
                self.network,
                self._images(region.lower[None], region.upper[None]),
                region.unsafe.rows,
                region.unsafe.offset,
                region.unsafe.groups,
                _BRANCHES,
                memory=self.memory,
                arithmetic=self.arithmetic,
                intermediate_steps=_STEPS,
            )
            self.boxes += branching.branches
            self.undecided |= not branching.proved
            return False
        waiting = [(region.lower, region.upper)]
        while waiting:
            check_cancelled()
            boxes, waiting = waiting[-self.together :], waiting[: -self.together]
            bounds = self._bound(region, boxes)
            proved = proves(bounds, region.unsafe.groups)
            self.boxes += len(boxes)
            left = np.flatnonzero(~proved)
            if len(left) and self._probe(region, [(*boxes[k], bounds.a[k]) for k in left]):
                return True
            for k in left:
                halves = _cut(*boxes[k], bounds.a[k])
                if halves is None or len(waiting) > _WAITING:
                    self.undecided = True
                    return False
                waiting += halves
        return False

    # ------------------------------------------------------------ proofs

    def _images(self, lower: np.ndarray, upper: np.ndarray) -> ImageSets:
        """Boxes [m, n]: every input is a parameter, if they are few."""
        # the program rounds an input to float32, and rounding keeps the order
        lower = np.minimum(lower, lower.astype(np.float32).astype(np.float64))
        upper = np.maximum(upper, upper.astype(np.float32).astype(np.float64))
        m, n = lower.shape
        if n > _PARAMETERS:
            none = np.zeros((m, n, 1))
            return ImageSets(none, lower, none, upper, lower, upper)
        middle = 0.5 * (lower + upper)
        half = np.nextafter(np.maximum(upper - middle, middle - lower), np.inf)
        a = half[:, :, None] * np.eye(n)
        return ImageSets(a, middle, a, middle, lower, upper)

    def _bound(self, region: InputRegion, boxes: Sequence[tuple[np.ndarray, np.ndarray]]) -> OutputBounds:
        lower, upper = (np.stack(ends) for ends in zip(*boxes, strict=True))
        return bound_outputs(
            self.network,
            self._images(lower, upper),
            region.unsafe.rows,
            region.unsafe.offset,
            memory=self.memory,
            arithmetic=self.arithmetic,
        )

    # ------------------------------------------------------------ counterexamples

    def _value(self, region: InputRegion, x: torch.Tensor) -> torch.Tensor:
        """[B]; an output is unsafe where it is not positive, differentiable."""
        y = self.network(x.reshape(-1, *self.network.input_shape))
        rows = y @ torch.from_numpy(region.unsafe.rows).T + torch.from_numpy(region.unsafe.offset)
        groups = [rows[:, list(group)].amax(1) for group in region.unsafe.groups if group]
        return torch.stack(groups).amin(0) if groups else torch.zeros(len(x), dtype=x.dtype)

    def _attack(self, region: InputRegion) -> bool:
        """Gradient descent by signs from the middle, from corners and from random inputs."""
        lower, upper = torch.from_numpy(region.lower), torch.from_numpy(region.upper)
        generator = torch.Generator().manual_seed(0)
        part = torch.rand((_TUNING.starts, len(lower)), generator=generator, dtype=torch.float64)
        part[0] = 0.5
        part[1 : _TUNING.starts // 2] = (part[1 : _TUNING.starts // 2] < 0.5).double()
        x = lower + part * (upper - lower)
        step = 0.25
        for _ in range(_TUNING.steps):
            check_cancelled()
            x = x.detach().requires_grad_()
            value = self._value(region, x)
            if self._any(region, x.detach(), value.detach()):
                return True
            if not value.requires_grad:
                break
            (slope,) = torch.autograd.grad(value.sum(), x)
            x = torch.minimum(torch.maximum(x.detach() - step * slope.sign() * (upper - lower), lower), upper)
            step *= 0.85
        return False

    def _probe(self, region: InputRegion, boxes: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> bool:
        """The middles of boxes (lower, upper, slopes of planes below), and the corners where the planes are least."""
        x = []
        for lower, upper, slopes in boxes:
            x.append(0.5 * (lower + upper))
            x += [np.where(row > 0.0, lower, upper) for row in slopes]
        with torch.no_grad():
            tried = torch.from_numpy(np.stack(x))
            return self._any(region, tried, self._value(region, tried))

    def _any(self, region: InputRegion, x: torch.Tensor, value: torch.Tensor) -> bool:
        """Whether one of the inputs that look unsafe is, for the program that counts."""
        order = torch.argsort(value)[:2].tolist()
        for k in order:
            if not float(value[k]) <= _TUNING.near * (1.0 + abs(float(value[k]))):
                continue
            point = np.clip(x[k].numpy(), region.lower, region.upper)
            y = run_once(self.network, self.run, point)
            if bool(np.isfinite(y).all()) and region.holds(y):
                self.found = point, y
                return True
        return False


def _cut(lower: np.ndarray, upper: np.ndarray, slopes: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]] | None:
    """Return two halves of the box, cut across the most influential input by ``slopes`` [k, n]; None if too small."""
    width = upper - lower
    # slopes are by half widths
    score = np.abs(slopes).max(0) + _TUNING.width * width
    at = int(np.argmax(np.where(width > 0.0, score, -1.0)))
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
    """Return [m] whether in every group some row is certainly positive; NaN proves nothing."""
    positive = np.asarray(bounds.lower) > 0.0
    proved = np.ones(len(positive), bool)
    for group in groups:
        proved &= positive[:, list(group)].any(1)
    return proved
