"""When a refinement is good enough, what it may use and what it keeps."""

from __future__ import annotations

from dataclasses import dataclass

from ns_abstract.refine.result import TracePoint


@dataclass(frozen=True)
class RefinementGoal:
    """When to stop, and what to keep.

    Attributes:
        ratio: MPG over witness MPG that is good enough.
        seconds: Time budget of the frame.
        cells: Largest number of cells, or None (for reproducible runs).
        leaf_bytes: Memory that open leaves, or the linear sets that are kept of all leaves, may take.
        slack: MPG beyond ``ratio`` times the witness MPG that is good enough, too.
        keep_leaves: Whether the result carries the leaves' linear sets.
    """

    ratio: float = 1.05
    seconds: float = 60.0
    cells: int | None = None
    leaf_bytes: int = 4 << 30
    slack: float = 0.0
    keep_leaves: bool = False

    def excess(self, mpg_witness: float) -> float:
        """MPG beyond the witness MPG that is good enough."""
        return (self.ratio - 1.0) * mpg_witness + self.slack

    def met(self, point: TracePoint) -> bool:
        """Whether the bounds are good enough."""
        return point.mpg <= self.ratio * point.mpg_witness + self.slack
