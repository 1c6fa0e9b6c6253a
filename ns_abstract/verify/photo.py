"""A photo as a claim about poses: which pictures may have made it, and which cells cannot (docs/dev/design.md, U).

A picture explains a photo where all but a few of the pixels lie within the noise of the photo's values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ns_abstract.arithmetic.network_charges import QUOTIENT, STEP
from ns_abstract.arithmetic.rounding import BRIGHTNESS_ROUNDING, CUT_ROOM, PHOTO_ROOM, REACH_ROUNDING
from ns_abstract.geometry.box import Float64Array
from ns_abstract.geometry.tiles import in_tiles
from ns_abstract.refine.protocol import FIRST_CHANNELS, SECOND_CHANNELS, LinearSets
from ns_abstract.verify.pixel_parts import most_within

_STEPS = 255.0
#: Rounds in which gain and offset of a picture are fitted.
_FITS = 8


@dataclass(frozen=True)
class Brightness:
    """The set of brightness changes of a camera (U6): it shows ``gain * value + offset``, clipped to [0, 1].

    Gains, above 0, and offsets lie between their ends.
    """

    gain: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)

    @property
    def still(self) -> bool:
        """Whether the camera shows the picture unchanged."""
        return (*self.gain, *self.offset) == (1.0, 1.0, 0.0, 0.0)

    def before(self, low: Float64Array, high: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return ends of the values that some gain and offset map into [low, high], rounded outward (U6).

        A value that is clipped to an end inside may have been anything beyond it.
        """
        ends = []
        for side, sign, offset in ((low, -1.0, self.offset[1]), (high, 1.0, self.offset[0])):
            moved = side - offset
            size = (np.abs(side) + abs(offset)) / self.gain[0]
            values = np.stack([moved / gain for gain in self.gain])
            furthest = values.min(axis=0) if sign < 0.0 else values.max(axis=0)
            ends.append(furthest + sign * BRIGHTNESS_ROUNDING * size)
        return np.where(low <= 0.0, -np.inf, ends[0]), np.where(high >= 1.0, np.inf, ends[1])

    def outside(self, picture: np.ndarray, low: Float64Array, high: Float64Array, counted: np.ndarray) -> np.ndarray:
        """Return which counted pixels of a picture [..., 3] one fitted gain and offset do not map into [low, high].

        Other gains and offsets may leave fewer.
        """
        middle, values = 0.5 * (low + high)[counted].ravel(), picture[counted].astype(np.float64).ravel()
        room = 0.5 * (high - low)[counted].ravel()
        gain, offset = (min(max(value, ends[0]), ends[1]) for value, ends in ((1.0, self.gain), (0.0, self.offset)))
        best: np.ndarray | None = None
        for _ in range(_FITS):
            displayed = np.clip(gain * picture.astype(np.float64) + offset, 0.0, 1.0)
            missed = counted & ~((displayed >= low) & (displayed <= high)).all(axis=-1)
            best = missed if best is None or missed.sum() < best.sum() else best
            weight = 1.0 / np.maximum(np.abs(gain * values + offset - middle), room)
            rows = np.stack([values, np.ones_like(values)], axis=1) * weight[:, None]
            if not np.isfinite(rows).all():
                break
            fitted = np.linalg.lstsq(rows, middle * weight, rcond=None)[0]
            gain = float(np.clip(fitted[0], *self.gain))
            offset = float(np.clip(np.average(middle - gain * values, weights=weight**2), *self.offset))
        assert best is not None
        return best


@dataclass(frozen=True, eq=False)
class Photo:
    """An 8-bit photo, and how far a picture may differ from it.

    Attributes:
        levels: [H, W, 3] uint8.
        noise: Largest difference of a value, in [0, 1], from the picture's before rounding.
        outliers: Fraction of the counted pixels that may show anything.
        counted: [H, W] which pixels count.
        brightness: The camera's brightness changes.
    """

    levels: np.ndarray
    noise: float
    outliers: float
    counted: np.ndarray
    brightness: Brightness = Brightness()

    @property
    def allowed(self) -> int:
        """Number of counted pixels that may show anything."""
        return most_within(self.outliers, int(self.counted.sum()))

    @cached_property
    def shown(self) -> tuple[Float64Array, Float64Array]:
        """Ends [H, W, 3] of the camera's values that explain a pixel (U1)."""
        value = self.levels.astype(np.float64) / _STEPS
        room = self.noise + (0.5 + STEP) / _STEPS + QUOTIENT + PHOTO_ROOM
        return value - room, value + room

    @cached_property
    def ends(self) -> tuple[Float64Array, Float64Array]:
        """Ends [H, W, 3] of a picture's values that explain a pixel, at any brightness (U1, U6)."""
        return self.shown if self.brightness.still else self.brightness.before(*self.shown)

    def outside(self, picture: np.ndarray) -> np.ndarray:
        """Return [H, W] which counted pixels of a picture [H, W, 3] do not explain the photo; NaN explains nothing."""
        if not self.brightness.still:
            return self.brightness.outside(picture, *self.shown, self.counted)
        low, high = self.ends
        return self.counted & ~((picture >= low) & (picture <= high)).all(axis=-1)

    def tiled(self, side: int) -> TiledPhoto:
        """Return the photo in tiles of ``side`` pixels."""
        low, high = self.ends
        ends = None if self.brightness.still else tuple(in_tiles(end, side) for end in self.shown)
        parts = in_tiles(low, side), in_tiles(high, side), in_tiles(self.counted, side)
        return TiledPhoto(*parts, self.allowed, self.brightness, ends)


@dataclass(frozen=True, eq=False)
class TiledPhoto:
    """A photo in tiles, in the layout of bounds.

    Attributes:
        low, high: [T, side, side, 3] ends of values that explain a pixel.
        counted: [T, side, side] which pixels count; false beyond the photo's edges.
        allowed: Number of the photo's pixels that may show anything.
        shown: `Photo.shown` in tiles, if brightness may change.
    """

    low: Float64Array
    high: Float64Array
    counted: np.ndarray
    allowed: int
    brightness: Brightness = Brightness()
    shown: tuple[Float64Array, ...] | None = None

    @cached_property
    def differences(self) -> tuple[Float64Array, Float64Array]:
        """Ends of the `CHANNEL_DIFFERENCES` of a picture that explain a pixel, before it is clamped (U10)."""
        # what shows an end of [0, 1] may have been anything beyond it
        low, high = np.where(self.low <= 0.0, -np.inf, self.low), np.where(self.high >= 1.0, np.inf, self.high)
        least = low[..., FIRST_CHANNELS] - high[..., SECOND_CHANNELS]
        most = high[..., FIRST_CHANNELS] - low[..., SECOND_CHANNELS]
        return np.nextafter(least, -np.inf), np.nextafter(most, np.inf)

    def chosen(self, numbers: Sequence[int]) -> np.ndarray:
        """Return [T, side, side] the pixels with these ``numbers``, in the order of ``counted`` flattened."""
        pixels = np.zeros(self.counted.shape, bool)
        pixels.reshape(-1)[list(numbers)] = True
        return pixels

    def outside(self, picture: np.ndarray) -> np.ndarray:
        """Return [T, side, side] which counted pixels of a picture in tiles do not explain the photo."""
        if self.shown is not None:
            return self.brightness.outside(picture, self.shown[0], self.shown[1], self.counted)
        return self.counted & ~((picture >= self.low) & (picture <= self.high)).all(axis=-1)

    def beyond(self, lower: np.ndarray, upper: np.ndarray, tiles: np.ndarray) -> np.ndarray:
        """Return [t, side, side] which counted pixels of ``tiles`` [t] no picture between the bounds explains (U2).

        The bounds [t, side, side, 3] hold for all pictures of a cell; NaN excludes nothing.
        """
        # bounds that cross bound nothing
        sane = (lower <= upper).all(axis=-1)
        return sane & self.counted[tiles] & ((lower > self.high[tiles]) | (upper < self.low[tiles])).any(axis=-1)

    def _explaining(self, pixels: np.ndarray, differences: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return ends [n, 3], [n, 3] of values that explain the ``n`` ``pixels`` [T, side, side]."""
        low, high = self.low[pixels], self.high[pixels]
        if differences is None or not differences.any():
            return low, high
        ends = zip((low, high), self.differences, strict=True)
        low, high = (np.where(differences[:, None], other[pixels], end) for end, other in ends)
        return low, high

    def goals(self, pixels: np.ndarray, differences: np.ndarray) -> np.ndarray:
        """Return [n, 6] the values beyond which lower, then upper bounds of ``n`` ``pixels`` exclude (U5, U10)."""
        return np.concatenate(self._explaining(pixels, differences)[::-1], axis=-1)

    def excluding(
        self, lower: np.ndarray, upper: np.ndarray, pixels: np.ndarray, differences: np.ndarray | None = None
    ) -> np.ndarray:
        """Return [n, k] which of the ``n`` ``pixels`` [T, side, side] exclude which of ``k`` sub-boxes (U2, U5, U10).

        A pixel excludes a sub-box if its bounds [n, 3, k] lie beyond the values that explain it. They are of channels,
        or, where ``differences`` [n], of `CHANNEL_DIFFERENCES`. NaN, crossed bounds and uncounted pixels exclude
        nothing.
        """
        low, high = (end[:, :, None] for end in self._explaining(pixels, differences))
        beyond = (lower <= upper).all(axis=1) & ((lower > high) | (upper < low)).any(axis=1)
        return beyond & self.counted[pixels][:, None]

    def explained(self, lower: np.ndarray, upper: np.ndarray, tiles: np.ndarray) -> int:
        """Return how many counted pixels of ``tiles`` every picture between the bounds explains."""
        inside = (lower >= self.low[tiles]) & (upper <= self.high[tiles]) & (lower <= upper)
        return int((self.counted[tiles] & inside.all(axis=-1)).sum())

    def reach(self, linear: LinearSets, beyond: np.ndarray, tiles: np.ndarray) -> tuple[Float64Array, Float64Array]:
        """Return ends [d], [d] in [-1, 1] of the scaled parameters outside of which no pose explains the photo (U3).

        Along each parameter, a pixel excludes everything beyond its own end, wherever the other parameters are. Values
        that more pixels exclude than may be outliers are excluded. The ends cross if the whole cell is.

        Args:
            linear: Linear bounds of ``tiles`` over a cell.
            beyond: [t, side, side] pixels that no picture in the cell explains.
            tiles: [t] numbers.
        """
        counted = self.counted[tiles]
        a_lower, b_lower, a_upper, b_upper = (np.asarray(part, np.float64)[counted] for part in linear)
        low, high = self.low[tiles][counted], self.high[tiles][counted]
        # A p <= room where lower bounds A_lower p + b_lower are at most high, and upper bounds at least low
        a = np.concatenate([a_lower, -a_upper], axis=1)
        room = np.concatenate([high - b_lower, b_upper - low], axis=1)
        size = np.concatenate([np.abs(high) + np.abs(b_lower), np.abs(b_upper) + np.abs(low)], axis=1)
        steep = np.abs(a).sum(axis=-1)
        room = room + REACH_ROUNDING * (size + steep)
        usable = np.isfinite(room) & np.isfinite(steep)
        d = a.shape[-1]
        least, most = np.full(d, -1.0), np.full(d, 1.0)
        if counted.sum() <= self.allowed:
            return least, most
        out = beyond[counted]
        for k in range(d):
            slope = a[..., k]
            with np.errstate(all="ignore"):
                reach = (room + (steep - np.abs(slope))) / slope
            up = np.where(usable & (slope > 0.0), reach, np.inf).min(axis=1)
            down = np.where(usable & (slope < 0.0), reach, -np.inf).max(axis=1)
            up[out], down[out] = -np.inf, np.inf
            most[k] = min(1.0, float(np.partition(up, self.allowed)[self.allowed]) + CUT_ROOM)
            least[k] = max(-1.0, -float(np.partition(-down, self.allowed)[self.allowed]) - CUT_ROOM)
        return least, most
