"""Certified cells bounded in weaker ways, too: what shared parameters are worth (docs/design.md, V10)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from ns_abstract.api.cell_search import CellSearch
from ns_abstract.api.certification import Certification
from ns_abstract.execution.ending import AbandonedError, Deadline
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.substitution import MODES, STEP, Comparison, compare, gains, spread_by_volume

#: Cells that are bounded, part of the time for it, and seconds that it may always take.
_COMPARED, SUBSTITUTION_SHARE, _LEAST = 5, 0.03, 1.0


def weaker_bounds(job: Certification, search: CellSearch[Any]) -> dict[str, Any]:
    """Bound a few certified cells in weaker ways as well, in a small part of the search's time.

    Returns:
        The key ``substitution`` of report.json.
    """
    store = search.store
    allowed = max(_LEAST, SUBSTITUTION_SHARE * store.seconds)
    cells = [
        (tally.frame, box)
        for tally in store.tallies()
        for row in store.leaves(tally.frame, "certified")
        if (box := search.box(tally.frame, row)).dimensions
    ]
    if not cells:
        return substitution_entry([], "no cell of more than one pose is certified")
    effort = store.effort
    each = effort["worker_seconds"] / max(1, effort["cells_bounded"]) * len(MODES)
    if each > allowed:
        reason = f"bounding one cell in {len(MODES)} ways takes about {each:.0f} s, {allowed:.0f} s may be used"
        return substitution_entry([], reason)
    found: list[tuple[int, Comparison]] = []
    begin = time.perf_counter()
    deadline = Deadline(allowed)
    with suppress(AbandonedError), deadline.enforced():
        for number in spread_by_volume([_volume(search.grids[frame].box, box) for frame, box in cells], _COMPARED):
            frame, box = cells[number]
            result = compare(job.search(frame, search.grids[frame]), box, deadline.end)
            if result is None:
                break
            found.append((frame, result))
    reason = None if found else f"the time for it, {allowed:.0f} s, was over before one cell was done"
    return substitution_entry(found, reason, time.perf_counter() - begin)


def substitution_entry(
    compared: Sequence[tuple[int, Comparison]], skipped: str | None, seconds: float = 0.0
) -> dict[str, Any]:
    """The key ``substitution`` of report.json.

    Args:
        compared: Frames and cells.
        skipped: Why there are none, or None.
        seconds: Spent on them.
    """

    def entry(frame: int, found: Comparison) -> dict[str, Any]:
        box = found.box
        half = [0.5 * (high - low) for low, high in zip(box.lower, box.upper, strict=True)]
        return {
            "frame": frame,
            "parameters": list(box.names),
            "lower": list(box.lower),
            "upper": list(box.upper),
            "margin": {mode: value if np.isfinite(value) else None for mode, value in found.margins.items()},
            "half_width": {
                mode: None if factor is None else [factor * h for h in half] for mode, factor in found.factors.items()
            },
            "at_least": list(found.open_ended),
        }

    return {
        "modes": dict(MODES),
        "cells": [entry(frame, found) for frame, found in compared],
        "wider_than": gains([found for _, found in compared]),
        "step": STEP,
        "skipped": skipped,
        "seconds": seconds,
    }


def _volume(whole: ParameterBox, part: ParameterBox) -> float:
    """The part of a set that a cell is."""
    sides = zip(part.lower, part.upper, whole.lower, whole.upper, strict=True)
    return float(np.prod([(high - low) / (most - least) for low, high, least, most in sides]))
