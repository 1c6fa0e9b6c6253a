"""The faces of a rule: intervals, and forms with their ranges; a result has the face of its operands."""

from __future__ import annotations

from typing import TypeVar

from ns_abstract.paper.affine import Enclosure
from ns_abstract.paper.interval import Interval

Face = TypeVar("Face", Interval, Enclosure)


def range_of(x: Interval | Enclosure) -> Interval:
    """The intervals that hold ``x``."""
    return x if isinstance(x, Interval) else x.range


def constant_like(like: Face, values: Interval) -> Face:
    """Return constants that enclose ``values``, in the arithmetic and basis of ``like``."""
    return type(like).lift(values) if isinstance(like, Interval) else type(like).of(like.basis, values)
