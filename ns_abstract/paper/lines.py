"""Lines that enclose a function over an interval: ``s x + low <= f(x) <= s x + high``.

For any slope ``s`` the offsets follow from convexity: the chord bounds a convex function from above at the ends of the
interval, a tangent bounds it from below. They are rounded outward, so a slope or point of contact that is only nearly
optimal costs tightness alone (CROWN, Zhang et al. 2018, table 1, gives the same lines for activations).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ns_abstract.paper.interval import Float64Array, Interval


@dataclass(frozen=True)
class ConvexFunction:
    """A convex or concave function of one variable.

    Attributes:
        value: The function on intervals.
        slope: Its derivative on intervals.
        touch: Approximately the point where the derivative takes a given value.
        convex: Convex (else concave) on its whole domain.
    """

    value: Callable[[Interval], Interval]
    slope: Callable[[Interval], Interval]
    touch: Callable[[Float64Array], Float64Array]
    convex: bool = True


EXP = ConvexFunction(Interval.exp, Interval.exp, np.log)
#: On positive numbers.
RECIPROCAL = ConvexFunction(Interval.reciprocal, lambda x: -(x.square().reciprocal()), lambda s: np.sqrt(-1.0 / s))
#: On non-negative numbers; not differentiable at 0.
SQRT = ConvexFunction(Interval.sqrt, lambda x: (x.sqrt() * 2.0).reciprocal(), lambda s: 0.25 / (s * s), convex=False)


def chord_slope(curve: ConvexFunction, x: Interval) -> Float64Array:
    """Return the slope of the chord over ``x``, rounded; that of a tangent where ``x`` is degenerate."""
    ends = [curve.value(Interval(end)).middle for end in x.bounds()]
    with np.errstate(all="ignore"):
        chord = (ends[1] - ends[0]) / (x.upper - x.lower)
    tangent = curve.slope(Interval(x.middle)).middle
    return np.where(np.isfinite(chord), chord, tangent)


def chord_side(curve: ConvexFunction, x: Interval, slope: Float64Array) -> Float64Array:
    """Return the offset on the chord's side: ``high`` of a convex function, ``low`` of a concave one."""
    offsets = [curve.value(Interval(end)) - Interval(end) * slope for end in x.bounds()]
    if curve.convex:
        return np.maximum(offsets[0].upper, offsets[1].upper)
    return np.minimum(offsets[0].lower, offsets[1].lower)


def tangent_side(
    curve: ConvexFunction, x: Interval, slope: Float64Array, at: Float64Array | None = None
) -> Float64Array:
    """Return offset on the other side, from the tangent at ``at`` (by default where it is parallel to ``slope``)."""
    if at is None:
        with np.errstate(all="ignore"):
            at = curve.touch(slope)
    at = np.where(np.isfinite(at), np.clip(at, x.lower, x.upper), x.middle)
    point = Interval(at)
    value, tangent = curve.value(point), curve.slope(point)
    offsets = [value + tangent * (Interval(end) - point) - Interval(end) * slope for end in x.bounds()]
    if curve.convex:
        return np.minimum(offsets[0].lower, offsets[1].lower)
    return np.maximum(offsets[0].upper, offsets[1].upper)


def band(curve: ConvexFunction, x: Interval) -> tuple[Float64Array, Interval]:
    """Return the narrowest band around ``curve`` over the bounded ``x``: its slope, and the interval of its offset."""
    slope = chord_slope(curve, x)
    chord, tangent = chord_side(curve, x, slope), tangent_side(curve, x, slope)
    return slope, Interval(tangent, chord) if curve.convex else Interval(chord, tangent)
