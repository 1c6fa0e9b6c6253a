"""Numbers of pixels that are stated as a fraction of all (docs/dev/design.md, U2, Q4)."""

from __future__ import annotations

import math


def most_within(part: float, count: int) -> int:
    """Return the greatest k whose k / count is at most ``part``: 29 of 100 for 0.29 (U2).

    The product may be rounded across a whole number; the quotient is the number that such a part is written as.
    """
    near = math.floor(part * count)
    return max(k for k in (near - 1, near, near + 1) if k / count <= part)


def fewest_reaching(part: float, count: int) -> int:
    """Return the smallest k whose k / count is at least ``part``: 7 of 100 for 0.07 (Q4)."""
    near = math.ceil(part * count)
    return min(k for k in (near - 1, near, near + 1) if k / count >= part)
