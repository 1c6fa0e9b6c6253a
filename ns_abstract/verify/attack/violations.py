"""Results of attacks on bounds: violations, and several attacks merged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ns_abstract.geometry.box import Float64Array

STRATEGIES = ("given", "corners", "random", "ascent", "jumps")
KEPT = 16


@dataclass(frozen=True)
class Violation:
    """One value outside its bounds, at the parameters ``values`` in the box's order and units.

    Attributes:
        bound: The violated bound: the lower one if ``value`` is less, else the upper one.
        amount: Their distance; NaN where one is not a number.
    """

    values: tuple[float, ...]
    row: int
    column: int
    channel: int
    value: float
    bound: float
    amount: float


@dataclass(frozen=True)
class Attack:
    """The result of an attack: violations, the closest approach, and the work that was done.

    Attributes:
        poses, probes: Numbers of images rendered in full, and of further single pixels.
        comparisons, violations: Pixel channels compared with their bounds; those that failed, or whose bounds are not
            finite.
        not_finite: Values and bounds among these that are not finite.
        worst: The worst violation of at most 16 pixel channels, largest first, NaN before all.
        witness_lower, witness_upper: [H, W, 3] least and largest values rendered; NaN where every image was NaN.
        tried: Poses by strategy.
        closest: [n, d] poses at which a pixel came closest to a bound relative to the gap, at most 8.
    """

    poses: int
    probes: int
    steps: int
    comparisons: int
    violations: int
    not_finite: int
    worst: tuple[Violation, ...]
    witness_lower: Float64Array = field(repr=False)
    witness_upper: Float64Array = field(repr=False)
    tried: dict[str, int]
    closest: Float64Array = field(repr=False)
    seconds: float

    @property
    def amount(self) -> float:
        """Largest distance of a value outside: 0 if all are inside, infinity if something is not a number."""
        if not self.worst:
            return 0.0
        return float("inf") if np.isnan(self.worst[0].amount) else self.worst[0].amount


def _severity(violation: Violation) -> float:
    return np.inf if np.isnan(violation.amount) else violation.amount


def merge(attacks: Sequence[Attack]) -> Attack:
    """Return one result for several attacks on images of one size."""
    worst = sorted((v for a in attacks for v in a.worst), key=_severity, reverse=True)[:KEPT]
    return Attack(
        poses=sum(a.poses for a in attacks),
        probes=sum(a.probes for a in attacks),
        steps=sum(a.steps for a in attacks),
        comparisons=sum(a.comparisons for a in attacks),
        violations=sum(a.violations for a in attacks),
        not_finite=sum(a.not_finite for a in attacks),
        worst=tuple(worst),
        witness_lower=np.fmin.reduce([a.witness_lower for a in attacks]),
        witness_upper=np.fmax.reduce([a.witness_upper for a in attacks]),
        tried={name: sum(a.tried[name] for a in attacks) for name in STRATEGIES},
        closest=np.concatenate([a.closest for a in attacks]),
        seconds=sum(a.seconds for a in attacks),
    )
