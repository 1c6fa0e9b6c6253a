"""The report on differences of two scenes."""

from __future__ import annotations

from ns_abstract.refine.result import FrameResult


def difference_figures(result: FrameResult) -> dict[str, float]:
    """Largest and mean values over pixels and channels of the bound and of what was rendered."""
    return {
        "largest_upper": float(result.upper.max()),
        "largest_lower": float(result.witness_upper.max()),
        "mean_upper": float(result.upper.mean(dtype="float64")),
        "mean_lower": float(result.witness_upper.mean(dtype="float64")),
    }


def verdict(result: FrameResult, tolerance: float, guarantee: str) -> str:
    """Whether no picture differs by more than the tolerance: "certified", "falsified" or "unknown".

    "falsified" needs a stored pose whose rendered pictures differ by more, "certified" a guarantee.
    """
    if result.largest is not None and result.largest.value > tolerance:
        return "falsified"
    if guarantee != "sampled" and result.bounded and float(result.upper.max()) <= tolerance:
        return "certified"
    return "unknown"
