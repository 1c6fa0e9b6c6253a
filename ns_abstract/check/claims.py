"""Claims about cells: each is settled by dividing its cell until all parts are proved or a pose refutes it."""

from __future__ import annotations

import itertools
import time
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np

from ns_abstract.check.forms import Array
from ns_abstract.check.results import StoredCells
from ns_abstract.check.splats import FLOAT, ActivatedScene

#: Boxes times Gaussians that are looked at together.
_BATCH = 40_000
#: Part of a claim's time in which every float32 evaluation must be proved; then the picture in real numbers is.
_FIRST = 0.5


class BoxClaim(NamedTuple):
    """What is claimed of a cell; of pictures, for a channel of a pixel, with a pose [1, d] that may refute it."""

    cell: int
    row: int = 0
    column: int = 0
    channel: int = 0
    pose: Array | None = None


class ClaimMargins(NamedTuple):
    """By how much a claim holds over B boxes of parameters; negative: by how much it does not."""

    #: Lower and upper bounds [B] over all poses.
    least: Array
    most: Array
    #: Which of what was looked at matters [B, n]; None: all of it.
    near: Array | None = None
    #: By how much the parameters move it [d, B]; None: nobody knows.
    motion: Array | None = None


class Claims(ABC):
    """Claims of one kind about the cells of a frame, or of a question about a loop."""

    #: Boxes that are looked at together.
    together = 8
    #: Number of claims that are drawn from.
    count: int

    def __init__(self, cells: StoredCells, scene: Any, report: dict[str, Any]) -> None:
        self.cells, self.scene = cells, scene
        splats = isinstance(scene, ActivatedScene) and report.get("guarantee") == "float32-sound"
        # float32 first, where that is claimed and this program has charges
        self.units = (FLOAT, 0.0) if splats else (0.0,)

    @abstractmethod
    def one(self, rng: Any) -> BoxClaim:
        """A claim, uniformly."""

    @abstractmethod
    def interest(self, claim: BoxClaim) -> float:
        """The larger, the more likely to fail."""

    def place(self, claim: BoxClaim) -> dict[str, Any]:
        """What names it in check.json."""
        return {"cell": claim.cell, "parameters": list(self.cells.names)}

    @abstractmethod
    def margins(self, claim: BoxClaim, low: Array, high: Array, near: Array, unit: float) -> ClaimMargins:
        """Over boxes [B, d]; ``near`` are the numbers of what is to be looked at."""

    @abstractmethod
    def detail(self, claim: BoxClaim, point: Array) -> dict[str, Any]:
        """What is wrong at the pose [1, d]."""

    def near(self, claim: BoxClaim, low: Array, high: Array, unit: float) -> Array:
        """Numbers of what has to be looked at over the box [1, d]."""
        return np.zeros(0, np.int64)

    def floor(self, claim: BoxClaim) -> float:
        """The margin that is claimed of every pose."""
        return 0.0

    def draw(self, rng: Any, hunted: bool) -> BoxClaim:
        """A claim that is uniform, or the most telling of eight."""
        return max([self.one(rng) for _ in range(8 if hunted else 1)], key=self.interest)

    def box(self, claim: BoxClaim) -> tuple[Array, Array]:
        """The claim's cell."""
        return self.cells.arrays["box_lower"][claim.cell], self.cells.arrays["box_upper"][claim.cell]

    def settle(self, claim: BoxClaim, deadline: float) -> tuple[bool | None, bool, dict[str, Any]]:
        """True: proved; False: refuted, with the pose; None: open when the time was over; and whether of float32."""
        begin, (low, high) = time.monotonic(), self.box(claim)
        near, pose = self.near(claim, low[None], high[None], self.units[0]), claim.pose
        if pose is not None and self.margins(claim, pose, pose, near, 0.0).most[0] < 0.0:
            return False, False, self.detail(claim, pose)
        for unit in self.units:
            end = begin + (deadline - begin) * (_FIRST if unit else 1.0)
            verdict, detail = self._divide(claim, near, unit, end)
            if verdict is not None:
                return verdict, unit > 0.0, detail
        return None, False, {}

    def _divide(self, claim: BoxClaim, near: Array, unit: float, deadline: float) -> tuple[bool | None, dict[str, Any]]:
        low, high = self.box(claim)
        stack, fresh = [(low, high, near)], True
        while stack:
            if time.monotonic() > deadline:
                return None, {}
            size = min(self.together, len(stack), max(1, _BATCH // max(1, len(stack[-1][2]))))
            parts = [stack.pop() for _ in range(size)]
            first, last = (np.stack([part[k] for part in parts]) for k in (0, 1))
            near = np.unique(np.concatenate([part[2] for part in parts]))
            bounds, middle = self.margins(claim, first, last, near, unit), 0.5 * (first + last)
            open_ = np.flatnonzero(~(bounds.least >= 0.0))
            some = open_[: 1 + self.together // 8]
            some = [0] if fresh and not len(some) and self.floor(claim) > 0.0 else some
            if len(some):
                at = self.margins(claim, middle[some], middle[some], near, unit)
                wrong = np.flatnonzero(at.most < self.floor(claim) * (1.0 - 1e-9))
                if len(wrong):
                    return False, self.detail(claim, middle[some][wrong[:1]])
                if len(open_) and not (at.least >= 0.0).all():
                    # smaller boxes about this point are not proved either
                    return None, {}
            fresh = False
            for k in open_:
                motion = np.ones(len(low)) if bounds.motion is None else bounds.motion[:, k]
                inner = near if bounds.near is None else near[bounds.near[k]]
                stack.extend((a, b, inner) for a, b in _divided(first[k], last[k], motion, high - low))
        return True, {}


def _divided(low: Array, high: Array, motion: Array, full: Array) -> list[tuple[Array, Array]]:
    """Parts of a box: along the side that moves the picture most."""
    width, motion = high - low, np.where(np.isfinite(motion), motion, 0.0)
    if not (width > 0.0).any():
        return [(low, high)]
    weight = motion + 1e-3 * (motion.max(initial=0.0) + 1e-30) * width / np.where(full > 0.0, full, 1.0)
    axis, count = int(np.argmax(np.where(width > 0.0, weight, -1.0))), 4 if len(low) == 1 else 2
    ends, cut = np.linspace(low[axis], high[axis], count + 1), np.arange(len(low)) == axis
    return [(np.where(cut, a, low), np.where(cut, b, high)) for a, b in itertools.pairwise(ends)]
