"""Linear sets of pictures over a box of poses, and their hull."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ns_abstract.arithmetic.network_charges import OWN_MARGIN
from ns_abstract.arithmetic.outward import outward
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.protocol import LinearSets


@dataclass(frozen=True)
class HullTuning:
    """Preferences on the slopes of a hull; soundness does not depend on them."""

    #: Parts are taken to be no narrower where their slopes are put together, and no nearer to each other.
    least_share: float = 1e-12


_TUNING = HullTuning()


def sane(linear: Sequence[np.ndarray], lower: np.ndarray, upper: np.ndarray) -> bool:
    """Return whether linear sets and bounds are all finite, and the bounds do not cross."""
    return all(np.isfinite(v).all() for v in (*linear, lower, upper)) and bool((lower <= upper).all())


def flatter_where_better(
    slopes: tuple[np.ndarray, np.ndarray], offsets: tuple[np.ndarray, np.ndarray], least: np.ndarray, most: np.ndarray
) -> tuple[LinearSets, np.ndarray, np.ndarray]:
    """Return linear sets and bounds, rounded outward; a plane is replaced by a bound that is tighter in the middle."""
    # comparisons that a NaN fails keep it, so that it is noticed
    flat = least > offsets[0], most < offsets[1]
    b_lower, b_upper = outward(np.where(flat[0], least, offsets[0]), np.where(flat[1], most, offsets[1]))
    a_lower, a_upper = (np.where(f[..., None], np.float32(0.0), a) for f, a in zip(flat, slopes, strict=True))
    return (a_lower, b_lower, a_upper, b_upper), *outward(least, most)


@dataclass(frozen=True)
class PictureSets:
    """Linear sets of pictures over a box, from `ns_abstract.verify.protocol.FrameImages.linear_sets`."""

    box: ParameterBox
    linear: tuple[np.ndarray, ...]
    lower: np.ndarray
    upper: np.ndarray

    @property
    def sane(self) -> bool:
        """Whether all numbers are finite, and the bounds do not cross."""
        return sane(self.linear, self.lower, self.upper)

    @property
    def widths(self) -> np.ndarray:
        """[H, W, 3] widths of the sets at a p."""
        a_lower, b_lower, a_upper, b_upper = (np.asarray(v, np.float64) for v in self.linear)
        wide = b_upper - b_lower + np.abs(a_upper - a_lower).sum(axis=-1)
        return np.minimum(wide, np.asarray(self.upper, np.float64) - self.lower)


def hull_of_sets(parts: Sequence[PictureSets]) -> PictureSets:
    """Return linear sets over the hull of the boxes of ``parts`` that contain every picture of each (V15)."""
    boxes = [sets.box for sets in parts]
    lower, upper = (np.array([getattr(box, name) for box in boxes]) for name in ("lower", "upper"))
    around = boxes[0].with_ends(lower.min(axis=0), upper.max(axis=0))
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    center, reach = around.middle, 0.5 * (np.array(around.upper) - np.array(around.lower))
    # p of the wider box is ``place + share q`` for q of a part
    place, share = (middle - center) / reach, half / reach
    a_low, b_low, a_high, b_high = (np.array([sets.linear[k] for sets in parts], np.float64) for k in range(4))
    # any slopes will do: these are the least squares' of the parts' middles, each taken by its volume
    weight = np.maximum(share, _TUNING.least_share).prod(axis=1)
    weight /= weight.sum()
    d, ones = around.dimensions, (1,) * (b_low.ndim - 1)
    slope, value = 0.5 * (a_low + a_high), 0.5 * (b_low + b_high)
    # float32's place is enough for what is arbitrary
    at, by = place.reshape(-1, *ones, d), share.reshape(-1, *ones, d)
    value = value - np.tensordot(weight, value, 1)
    moment = (place**2 + share**2 / 3.0) * weight[:, None]
    common = np.tensordot(weight, value[..., None] * at + slope * by / 3.0, 1) / np.maximum(
        moment.sum(axis=0), _TUNING.least_share
    )
    moved = (at * common).sum(axis=-1)
    low = b_low - moved - np.abs(a_low - by * common).sum(axis=-1)
    high = b_high - moved + np.abs(a_high - by * common).sum(axis=-1)
    # rounding of places, shares and the sums above; ends of boxes are rounded relative to themselves, not to widths
    ends = (np.abs(lower) + np.abs(upper)).max(axis=0) / reach
    sizes = np.abs(b_low) + np.abs(b_high) + np.abs(a_low).sum(axis=-1) + np.abs(a_high).sum(axis=-1)
    room = OWN_MARGIN * (sizes + (np.abs(common) * (2.0 + ends)).sum(axis=-1))
    return PictureSets(
        around,
        (common, (low - room).min(axis=0), common, (high + room).max(axis=0)),
        np.min([sets.lower for sets in parts], axis=0),
        np.max([sets.upper for sets in parts], axis=0),
    )
