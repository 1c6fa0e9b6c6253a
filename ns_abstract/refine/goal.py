"""The goal of a refinement: when bounds are tight enough, its limits, and what the result keeps."""

from __future__ import annotations

from dataclasses import dataclass

from ns_abstract.refine.result import TracePoint


@dataclass(frozen=True)
class RefinementGoal:
    """When to stop, and what to keep.

    Attributes:
        ratio: Target of MPG over witness MPG.
        seconds: Time budget of the frame.
        cells: Largest number of cells, or None (for reproducible runs).
        leaf_bytes: Largest memory of open leaves, or of the linear sets of all leaves if they are kept.
        slack: MPG beyond ``ratio`` times the witness MPG that is also accepted.
        keep_leaves: Whether the result keeps the leaves' linear sets.
    """

    ratio: float = 1.05
    seconds: float = 60.0
    cells: int | None = None
    leaf_bytes: int = 4 << 30
    slack: float = 0.0
    keep_leaves: bool = False

    def excess(self, mpg_witness: float) -> float:
        """Return the accepted MPG beyond the witness MPG."""
        return (self.ratio - 1.0) * mpg_witness + self.slack

    def met(self, point: TracePoint) -> bool:
        """Return whether the bounds are tight enough."""
        return point.mpg <= self.ratio * point.mpg_witness + self.slack
