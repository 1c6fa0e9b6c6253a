"""A claim about a cell is settled by division: until every part is proved, or a pose refutes it."""

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
    """A claim about a cell, or about one channel of one of its pixels; ``pose`` [1, d] may refute it."""

    cell: int
    row: int = 0
    column: int = 0
    channel: int = 0
    pose: Array | None = None


class ClaimMargins(NamedTuple):
    """Bounds of a claim's margin over B boxes of parameters; the claim fails where the margin is negative."""

    #: Lower and upper bounds [B] over all poses.
    least: Array
    most: Array
    #: Which of what was looked at matters [B, n]; None: all of it.
    near: Array | None = None
    #: By how much the parameters move it [d, B]; None: nobody knows.
    motion: Array | None = None


class Claims(ABC):
    """All claims of one kind about the cells of a frame, or of a question about a loop."""

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
    def draw_uniform(self, rng: Any) -> BoxClaim:
        """Return a claim drawn uniformly."""

    @abstractmethod
    def suspicion(self, claim: BoxClaim) -> float:
        """Return a score by which claims are hunted: the larger, the more likely the claim is false."""

    def label(self, claim: BoxClaim) -> dict[str, Any]:
        """Return what identifies the claim in check.json."""
        return {"cell": claim.cell, "parameters": list(self.cells.names)}

    @abstractmethod
    def margins(self, claim: BoxClaim, low: Array, high: Array, near: Array, unit: float) -> ClaimMargins:
        """Return bounds of the margin over boxes [B, d]; only the Gaussians numbered in ``near`` are looked at."""

    @abstractmethod
    def refutation(self, claim: BoxClaim, point: Array) -> dict[str, Any]:
        """Return what check.json says of the pose ``point`` [1, d], at which the claim is false."""

    def candidates(self, claim: BoxClaim, low: Array, high: Array, unit: float) -> Array:
        """Return the numbers of the Gaussians that may matter to the claim over the box [1, d]."""
        return np.zeros(0, np.int64)

    def claimed_margin(self, claim: BoxClaim) -> float:
        """Return the lower bound of the margin that the result claims for every pose of the cell."""
        return 0.0

    def draw(self, rng: Any, hunted: bool) -> BoxClaim:
        """Return a uniform claim, or with ``hunted`` the one of eight that `suspicion` ranks highest."""
        return max([self.draw_uniform(rng) for _ in range(8 if hunted else 1)], key=self.suspicion)

    def box(self, claim: BoxClaim) -> tuple[Array, Array]:
        """Return the lower and upper ends [d] of the claim's cell."""
        return self.cells.arrays["box_lower"][claim.cell], self.cells.arrays["box_upper"][claim.cell]

    def settle(self, claim: BoxClaim, deadline: float) -> tuple[bool | None, bool, dict[str, Any]]:
        """Return True (proved), False (refuted) or None (open), if of all float32 evaluations, and the refutation."""
        begin, (low, high) = time.monotonic(), self.box(claim)
        near, pose = self.candidates(claim, low[None], high[None], self.units[0]), claim.pose
        if pose is not None and self.margins(claim, pose, pose, near, 0.0).most[0] < 0.0:
            return False, False, self.refutation(claim, pose)
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
            some = [0] if fresh and not len(some) and self.claimed_margin(claim) > 0.0 else some
            if len(some):
                at = self.margins(claim, middle[some], middle[some], near, unit)
                wrong = np.flatnonzero(at.most < self.claimed_margin(claim) * (1.0 - 1e-9))
                if len(wrong):
                    return False, self.refutation(claim, middle[some][wrong[:1]])
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
    """Return the parts of a box, cut along the parameter that moves the picture most."""
    width, motion = high - low, np.where(np.isfinite(motion), motion, 0.0)
    if not (width > 0.0).any():
        return [(low, high)]
    weight = motion + 1e-3 * (motion.max(initial=0.0) + 1e-30) * width / np.where(full > 0.0, full, 1.0)
    axis, count = int(np.argmax(np.where(width > 0.0, weight, -1.0))), 4 if len(low) == 1 else 2
    ends, cut = np.linspace(low[axis], high[axis], count + 1), np.arange(len(low)) == axis
    return [(np.where(cut, a, low), np.where(cut, b, high)) for a, b in itertools.pairwise(ends)]
