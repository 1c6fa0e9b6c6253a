"""The absolute difference of two scenes' pictures as a frame of its own (design.md, Y1-Y3)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import DIFFERENCE_ROUNDING
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.frame_tiles import pixels_inside
from ns_abstract.refine.protocol import COLORS, Bounds, CellContext, Frame, LinearSets, PartsFrame, SceneSample
from ns_abstract.refine.result import RenderedMaximum, greater


@dataclass(frozen=True)
class PairContext:
    """The contexts of both scenes for the cells inside one."""

    first: CellContext | None
    second: CellContext | None

    @property
    def nbytes(self) -> int:
        """Memory that both hold."""
        return sum(context.nbytes for context in (self.first, self.second) if context is not None)

    @property
    def shown(self) -> None:
        """Elements of two scenes have no common numbers."""
        return None


@dataclass(frozen=True)
class DifferenceBounds:
    """Bounds of the absolute difference over one cell; see `ns_abstract.refine.protocol.Bounds`."""

    lower: np.ndarray
    upper: np.ndarray
    slopes: np.ndarray
    context: PairContext
    linear: LinearSets | None = None
    forms: None = None


class DifferenceFrame:
    """Renders and bounds of |A - B| by pixel and channel, for two frames with the same parameters (design.md, Y4).

    Args:
        first, second: The frames of A and B, of the same set of poses, camera and tiles.
        floor: Values up to it are taken for it, in renders and bounds alike, so that nothing below is refined.

    Attributes:
        largest: The largest value of the image that was rendered; None before the first render.
    """

    channels = COLORS

    def __init__(self, first: Frame, second: Frame, floor: float = 0.0) -> None:
        self.first, self.second = first, second
        self.floor = np.float32(floor)
        self.pose_set, self.box, self.camera = first.pose_set, first.box, first.camera
        self.side, self.across, self.down = first.side, first.across, first.down
        self.tilewise, self.tiles_at_once, self.witnesses = first.tilewise, first.tiles_at_once, first.witnesses
        self.largest: RenderedMaximum | None = None
        self._inside = pixels_inside(first)

    @property
    def both(self) -> tuple[Frame, Frame]:
        """The two frames."""
        return self.first, self.second

    def above(self, floor: float) -> DifferenceFrame:
        """The same with another floor."""
        return DifferenceFrame(self.first, self.second, floor)

    @property
    def tile_count(self) -> int:
        """Number of tiles."""
        return self.first.tile_count

    @property
    def stages(self) -> tuple[str, ...]:
        """Stages of both frames that can be compiled apart."""
        return tuple(dict.fromkeys((*self.first.stages, *self.second.stages)))

    def warm_up(self, stage: str | None = None) -> None:
        """Compile what both frames need, with linear bounds."""
        for frame in self.both:
            if stage is None or stage in frame.stages:
                frame.warm_up(stage)
        if stage is None:
            # linear bounds may have kernels of their own
            self.bound(self.box, np.arange(1))

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Tiles [t, side, side, 3] float32 of |A - B| at parameter values [d], rounded down, at least the floor."""
        first, second = (frame.render(values, tiles)[..., :COLORS].astype(np.float64) for frame in self.both)
        difference = np.abs(first - second)
        # values are float32 numbers in [0, 1], whose difference float64 rounds by one unit at most
        lower, _ = outward(difference * (1.0 - DIFFERENCE_ROUNDING), difference)
        # tiles may extend past the image
        lower[~(self._inside if tiles is None else self._inside[tiles])] = 0.0
        found = RenderedMaximum(float(lower.max(initial=0.0)), tuple(map(float, values)))
        self.largest = greater(self.largest, found)
        return np.maximum(lower, self.floor)

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        """Nothing: only poses vary."""
        return iter(())

    def bound(
        self, box: ParameterBox, tiles: np.ndarray, within: PairContext | None = None, keep_linear: bool = False
    ) -> DifferenceBounds:
        """Bounds of ``tiles`` over ``box``."""
        return self.bound_parts([box], tiles, within, keep_linear, None)[0]

    def bound_parts(
        self,
        boxes: Sequence[ParameterBox],
        tiles: np.ndarray,
        within: PairContext | None,
        keep_linear: bool,
        pixels: np.ndarray | None,
    ) -> list[DifferenceBounds]:
        """See `ns_abstract.refine.protocol.PartsFrame`."""
        contexts = (None, None) if within is None else (within.first, within.second)
        first, second = (
            _bounds(frame, boxes, tiles, context, pixels) for frame, context in zip(self.both, contexts, strict=True)
        )
        return [self._difference(a, b, pixels) for a, b in zip(first, second, strict=True)]

    def _difference(self, a: Bounds, b: Bounds, pixels: np.ndarray | None) -> DifferenceBounds:
        """Bounds of one cell from those of both scenes."""
        upper = np.maximum(interval_upper(a, b), interval_upper(b, a))
        for more in (linear_upper(a, b), form_upper(a, b, a.slopes.size)):
            upper = np.minimum(upper, more)
        _, high = outward(upper, upper)
        # what is not a number stays so, and is no bound
        high = np.maximum(high, self.floor)
        if pixels is not None:
            # nothing is said of the others
            high[~pixels] = 1.0
        return DifferenceBounds(
            np.full_like(high, self.floor), high, a.slopes + b.slopes, PairContext(a.context, b.context)
        )

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        """See `Frame.feasible`."""
        return self.first.feasible(box)

    def motion(self, box: ParameterBox) -> np.ndarray:
        """[d] pixels that the picture of either scene moves by over each parameter's range (an estimate)."""
        return np.maximum(self.first.motion(box), self.second.motion(box))

    def depths(self) -> np.ndarray | None:
        """Depths of elements of A."""
        return self.first.depths()

    def observe(self, tiles: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        """Bounds do not depend on what was rendered."""

    def set_tolerance(self, excess: float) -> float:
        """Nothing is left out: what is dim in both pictures is not the same."""
        return 0.0

    def plan(self, visible: int | None, lower: np.ndarray, upper: np.ndarray) -> list[str]:
        """Nothing was left out."""
        return []


def _bounds(
    frame: Frame, boxes: Sequence[ParameterBox], tiles: np.ndarray, within: Any, pixels: np.ndarray | None
) -> Sequence[Bounds]:
    """Linear bounds of one scene over each of ``boxes``."""
    if isinstance(frame, PartsFrame):
        return frame.bound_parts(boxes, tiles, within, True, pixels)
    return [frame.bound(box, tiles, within, True) for box in boxes]


def interval_upper(a: Bounds, b: Bounds) -> np.ndarray:
    """Upper bound [...] of the signed difference a - b from intervals; NaN: nothing is known (design.md, Y1)."""
    return (a.upper.astype(np.float64) - b.lower) * (1.0 + DIFFERENCE_ROUNDING)


def linear_upper(a: Bounds, b: Bounds) -> np.ndarray:
    """Upper bound [...] of |a - b| over a cell from linear bounds in the same parameters (design.md, Y2)."""
    if a.linear is None or b.linear is None:
        return np.full(a.upper.shape, np.inf)
    return np.maximum(_signed_upper(a.linear, b.linear), _signed_upper(b.linear, a.linear))


def _signed_upper(a: LinearSets, b: LinearSets) -> np.ndarray:
    """Largest value over the cell of the upper bound of a minus the lower bound of b."""
    slope_low, low = (part.astype(np.float64) for part in b[:2])
    slope_high, high = (part.astype(np.float64) for part in a[2:])
    # a linear function is largest in a corner of [-1, 1]^d
    most = high - low + np.abs(slope_high - slope_low).sum(axis=-1)
    size = np.abs(high) + np.abs(low) + (np.abs(slope_high) + np.abs(slope_low)).sum(axis=-1)
    return most + DIFFERENCE_ROUNDING * size


def form_upper(a: Bounds, b: Bounds, dimensions: int) -> np.ndarray:
    """Upper bound [...] of |a - b| over a cell from polynomials in the same parameters (design.md, Y3).

    Equal terms of the two cancel, and the clamp to [0, 1] takes no values apart.
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
    """At most the largest value over [-1, 1]^d of polynomials [..., m + 1], whose last column is left out."""
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
