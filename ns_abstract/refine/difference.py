"""The absolute difference of two scenes' pictures as a frame of its own (docs/dev/design.md, Y1-Y3)."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import DIFFERENCE_ROUNDING, RENDERED_DIGITS, UNIT32
from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.frame_tiles import pixels_inside
from ns_abstract.refine.protocol import (
    COLORS,
    Bounds,
    CellContext,
    CountedFrame,
    Frame,
    LinearSets,
    OrderedFrame,
    PreciseFrame,
)
from ns_abstract.refine.result import RenderedMaximum, greater

#: A preference: pixels above the floor up to which a cell's orders are looked at.
_MOST_PIXELS = 64


@dataclass(frozen=True)
class PairContext:
    """The contexts of both scenes for cells inside one cell."""

    first: CellContext | None
    second: CellContext | None

    @property
    def nbytes(self) -> int:
        """Bytes of both."""
        return sum(context.nbytes for context in (self.first, self.second) if context is not None)

    @property
    def shown(self) -> None:
        """None: elements of two scenes have no common numbers."""
        return None


class DifferenceFrame(Frame):
    """Renders and bounds |A - B| by pixel and channel, for two frames with the same parameters (design.md, Y4).

    Nothing is left out by a tolerance: light that is dim in both pictures may still differ.

    Args:
        first, second: The frames of A and B, of the same set of poses, camera and tiles.
        floor: Smaller values are raised to it, in renders and bounds alike, so that they are not refined.

    Attributes:
        largest: The largest rendered value of the image; None before the first render.
        greatest: [T, side, side, 3] float32, the greatest values rendered by this frame and those made by `above`.
    """

    channels = COLORS

    def __init__(self, first: Frame, second: Frame, floor: float = 0.0) -> None:
        self.first, self.second = first, second
        self.floor = np.float32(floor)
        self.pose_set, self.box, self.camera = first.pose_set, first.box, first.camera
        self.side, self.across, self.down = first.side, first.across, first.down
        self.tilewise, self.tiles_at_once, self.witnesses = first.tilewise, first.tiles_at_once, first.witnesses
        self.stages = tuple(dict.fromkeys((*first.stages, *second.stages)))
        self.compiled = max(
            frame.compiled if isinstance(frame, CountedFrame) else (0, 0.0) for frame in (first, second)
        )
        self.largest: RenderedMaximum | None = None
        self._inside = pixels_inside(first)
        self.greatest = np.zeros((first.tile_count, first.side, first.side, COLORS), np.float32)
        self._shared = first.shared_order(second) if isinstance(first, OrderedFrame) else None

    @property
    def both(self) -> tuple[Frame, Frame]:
        """The two frames."""
        return self.first, self.second

    def above(self, floor: float) -> DifferenceFrame:
        """Return the same frame with another floor."""
        frame = copy.copy(self)
        frame.floor, frame.largest = np.float32(floor), None
        return frame

    @property
    def shares_order(self) -> bool:
        """Whether elements of both scenes are bounded in a common depth order (docs/dev/design.md, Y5)."""
        return self._shared is not None

    def warm_up(self, stage: str | None = None) -> None:
        """Compile the kernels of both frames, with those of linear bounds."""
        for frame in self.both:
            if stage is None or stage in frame.stages:
                frame.warm_up(stage)
        if stage is None:
            # linear bounds may have kernels of their own
            self.bound(self.box, np.arange(1))

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Return tiles [t, side, side, 3] float32 of |A - B| at parameter values [d], rounded down, at least floor."""
        check_cancelled()
        (first, one), (second, other) = (_picture(frame, values, tiles) for frame in self.both)
        difference = np.abs(first - second) * (1.0 - DIFFERENCE_ROUNDING) - (one + other)
        lower, _ = outward(np.maximum(difference, 0.0), difference)
        # tiles may extend past the image
        some = slice(None) if tiles is None else tiles
        lower[~self._inside[some]] = 0.0
        self.greatest[some] = np.maximum(self.greatest[some], lower)
        rendered = RenderedMaximum(float(lower.max(initial=0.0)), tuple(map(float, values)))
        self.largest = greater(self.largest, rendered)
        return np.maximum(lower, self.floor)

    def bound_parts(
        self,
        boxes: Sequence[ParameterBox],
        tiles: np.ndarray,
        within: PairContext | None,
        keep_linear: bool,
        pixels: np.ndarray | None,
    ) -> list[Bounds]:
        contexts = (None, None) if within is None else (within.first, within.second)
        first, second = (
            frame.bound_parts(boxes, tiles, context, True, pixels)
            for frame, context in zip(self.both, contexts, strict=True)
        )
        differences = []
        for box, a, b in zip(boxes, first, second, strict=True):
            difference = self._difference(a, b, pixels)
            if self._shared is not None and self.floor > 0.0:
                self._share_order(box, tiles, difference, (a.context, b.context), pixels)
            differences.append(difference)
        return differences

    def _share_order(
        self,
        box: ParameterBox,
        tiles: np.ndarray,
        difference: Bounds,
        contexts: tuple[CellContext | None, CellContext | None],
        pixels: np.ndarray | None,
    ) -> None:
        """Tighten bounds above the floor where both scenes have one depth order, whichever it is (Y5)."""
        assert self._shared is not None
        wanted = self._inside[tiles] & (difference.upper > self.floor).any(axis=-1)
        wanted &= True if pixels is None else pixels
        if not 0 < wanted.sum() <= _MOST_PIXELS:
            return
        for k in np.flatnonzero(wanted.any(axis=(1, 2))):
            pairs = self._shared.bounds(box, int(tiles[k]), wanted[k], contexts)
            if pairs is None:
                continue
            # what is not a number stays so, and lowers nothing
            upper = np.maximum.reduce([upper_of(a, b)[0] for a, b in pairs])
            _, high = outward(upper, upper)
            lower = wanted[k][..., None] & (high < difference.upper[k])
            difference.upper[k][lower] = np.maximum(high, self.floor)[lower]

    def _difference(self, a: Bounds, b: Bounds, pixels: np.ndarray | None) -> Bounds:
        """Return bounds of one cell from those of both scenes."""
        upper = upper_of(a, b)
        _, high = outward(upper, upper)
        # what is not a number stays so, and is no bound
        high = np.maximum(high, self.floor)
        if pixels is not None:
            # nothing is said of the others
            high[~pixels] = 1.0
        return Bounds(np.full_like(high, self.floor), high, a.slopes + b.slopes, PairContext(a.context, b.context))

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        return self.first.feasible(box)

    def motion(self, box: ParameterBox) -> np.ndarray:
        """Return the estimated motion [d] in pixels of either scene's picture over each parameter's range."""
        return np.maximum(self.first.motion(box), self.second.motion(box))

    def depths(self) -> np.ndarray | None:
        """Return depths of elements of scene A; None where it has none."""
        return self.first.depths()


def _picture(frame: Frame, values: np.ndarray, tiles: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Return the colours of a render in float64, and their rounding error."""
    if isinstance(frame, PreciseFrame):
        return frame.precise(values, tiles)[..., :COLORS], RENDERED_DIGITS
    return frame.render(values, tiles)[..., :COLORS].astype(np.float64), UNIT32


def upper_of(a: Bounds, b: Bounds) -> np.ndarray:
    """Return the least known upper bound [...] of |a - b| over a cell; NaN: none is known."""
    upper = np.maximum(interval_upper(a, b), interval_upper(b, a))
    for more in (linear_upper(a, b), form_upper(a, b, a.slopes.size)):
        upper = np.minimum(upper, more)
    return upper


def interval_upper(a: Bounds, b: Bounds) -> np.ndarray:
    """Return an upper bound [...] of the signed difference a - b by intervals; NaN: none is known (Y1)."""
    return (a.upper.astype(np.float64) - b.lower) * (1.0 + DIFFERENCE_ROUNDING)


def linear_upper(a: Bounds, b: Bounds) -> np.ndarray:
    """Return an upper bound [...] of |a - b| over a cell by linear bounds in the same parameters (Y2)."""
    if a.linear is None or b.linear is None:
        return np.full(a.upper.shape, np.inf)
    return np.maximum(_signed_upper(a.linear, b.linear), _signed_upper(b.linear, a.linear))


def _signed_upper(a: LinearSets, b: LinearSets) -> np.ndarray:
    """Return the largest value over the cell of the upper bound of a minus the lower bound of b."""
    slope_low, low = (part.astype(np.float64) for part in b[:2])
    slope_high, high = (part.astype(np.float64) for part in a[2:])
    # a linear function is largest in a corner of [-1, 1]^d
    most = high - low + np.abs(slope_high - slope_low).sum(axis=-1)
    size = np.abs(high) + np.abs(low) + (np.abs(slope_high) + np.abs(slope_low)).sum(axis=-1)
    return most + DIFFERENCE_ROUNDING * size


def form_upper(a: Bounds, b: Bounds, dimensions: int) -> np.ndarray:
    """Return an upper bound [...] of |a - b| over a cell by polynomials in the same parameters (Y3).

    Equal terms of the two cancel, and the clamp to [0, 1] moves no two values apart.
    """
    if a.forms is None or b.forms is None:
        return np.full(a.upper.shape, np.inf)
    difference, d = a.forms - b.forms, dimensions
    radius = a.forms[..., -1] + b.forms[..., -1]
    size = (np.abs(a.forms) + np.abs(b.forms)).sum(axis=-1)
    # what only one sign of the difference reaches: squares of parameters
    rise, fall = (_polynomial_upper(sign * difference, d) for sign in (1.0, -1.0))
    return np.maximum(rise, fall) + radius + DIFFERENCE_ROUNDING * size


def _polynomial_upper(coefficients: np.ndarray, d: int) -> np.ndarray:
    """Return an upper bound over [-1, 1]^d of polynomials [..., m + 1] without their last column, the radius."""
    most, row = coefficients[..., 0].copy(), 1 + d
    squares = np.zeros((*most.shape, d))
    if coefficients.shape[-1] > d + 2:
        for k in range(d):
            for l in range(k, d):
                if k == l:
                    squares[..., k] = coefficients[..., row]
                else:
                    most += np.abs(coefficients[..., row])
                row += 1
    slope, steep = np.abs(coefficients[..., 1 : 1 + d]), np.abs(squares)
    # s p + q p^2 is largest at an end, or where q < 0 at its vertex
    vertex = (squares < 0.0) & (slope < 2.0 * steep)
    inner = slope * slope / np.where(vertex, 4.0 * steep, 1.0)
    return most + np.where(vertex, inner, slope + squares).sum(axis=-1)
