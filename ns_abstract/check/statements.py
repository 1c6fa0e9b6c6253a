"""Properties of the picture itself: ``visible``, ``clear``, ``picture``, and ``all`` and ``any`` of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import numpy as np

from ns_abstract.check.forms import Affine, Array, U, total
from ns_abstract.check.inputs import FIX, BadInput, check_keys

#: Keys that are read elsewhere, or say nothing; what to do with others.
FREE = ("$schema", "output", "partitions", "preprocess")
_CHANNELS = {"luminance": (0.2126, 0.7152, 0.0722), "r": (1.0, 0.0, 0.0), "g": (0.0, 1.0, 0.0), "b": (0.0, 0.0, 1.0)}


class CombinedMargins(NamedTuple):
    """A conjunction or disjunction of properties: its margin is the least or the largest of theirs (``pick``)."""

    pick: Any
    parts: list[Any]

    def margin(self, picture: Callable[[Any], Affine]) -> tuple[Array, Array]:
        """Return bounds [B] of the margin over B boxes; ``picture`` returns a plane's picture as forms [B, H W, 3]."""
        lower, upper = zip(*(part.margin(picture) for part in self.parts), strict=True)
        return self.pick(lower, axis=0), self.pick(upper, axis=0)


class Measured(NamedTuple):
    """The property that a number measured in a plane lies between ``low`` and ``high``.

    The plane (``paint``) holds colours (None), weights of the Gaussians in a box [2, 3], or of those nearer than a
    distance. A pixel's value is the sum of its channels times ``channels``. The second region's measure is subtracted.
    """

    paint: Any
    channels: tuple[float, ...]
    regions: list[Array]
    #: The pixel that counts, 1 the largest one; 0: the mean; -1: the least.
    rank: int
    low: float
    high: float

    def margin(self, picture: Callable[[Any], Affine]) -> tuple[Array, Array]:
        """Return bounds [B] of the margin; see `CombinedMargins.margin`."""
        plane = picture(self.paint)
        single = total(plane.apply(lambda a, k=k: a[..., k]) * w for k, w in enumerate(self.channels))
        parts = [single.apply(lambda a, k=k: a[..., k]) for k in self.regions]
        if self.rank == 0:
            means = [p.apply(lambda a: a.mean(axis=-1)).wider(2.0 * U * p.size().sum(axis=-1)) for p in parts]
            least, most = (means[0] - means[1] if parts[1:] else means[0]).range()
        else:
            ends = [[np.sort(e, axis=-1)[:, 0 if self.rank < 0 else -self.rank] for e in p.range()] for p in parts]
            (least, most), (off, on) = ends[0], ends[1] if parts[1:] else (0.0, 0.0)
            least, most = least - on, most - off
        room = 4.0 * U * (1.0 + np.abs(least) + np.abs(most))
        lower = np.minimum(least - room - self.low, self.high - most - room)
        upper = np.minimum(most + room - self.low, self.high - least + room)
        # what is not a number says nothing
        return np.where(np.isnan(lower), -np.inf, lower), np.where(np.isnan(upper), np.inf, upper)


def parse_statement(root: dict[str, Any], size: tuple[int, int], scale: float, beside: Collection[str] = FREE) -> Any:
    """Return the property of a JSON object for pictures of ``size`` (height, width); keys ``beside`` are for others."""
    kind, picks = "all" if "all" in root else "any" if "any" in root else root["type"], {"all": np.min, "any": np.max}
    check_keys({k: v for k, v in root.items() if k not in beside and not (k == kind and k in picks)}, str(kind))
    check_keys(root.get("preprocess") or {}, "preprocess")
    if kind in picks:
        return CombinedMargins(picks[kind], [parse_statement(part, size, scale, ()) for part in root[kind]])
    weight, first = float(root.get("weight", 0.5)), _region(root.get("region"), size)
    below, above = (lambda v: float(np.nextafter(v, -np.inf))), (lambda v: float(np.nextafter(v, np.inf)))
    if kind == "visible":
        # as many as are that part of the region, or more
        part = 1 + int((np.arange(1, len(first)) / len(first) < root.get("fraction", 0.0)).sum())
        rank = max(part, root.get("pixels", 1))
        return Measured(np.array(root["select"]["box"], float), (1.0, 0.0, 0.0), [first], rank, below(weight), math.inf)
    if kind == "clear":
        distance = float(root["distance"]) * (scale if root.get("units") == "dataset" else 1.0)
        return Measured(distance, (1.0, 0.0, 0.0), [first], 1, -math.inf, weight)
    rank = {"mean": 0, "least": -1, "greatest": 1}[root.get("statistic", "mean")]
    regions = [first, *([_region(root["minus"], size)] if "minus" in root else [])]
    low, high = below(float(root.get("min", -math.inf))), above(float(root.get("max", math.inf)))
    return Measured(None, _CHANNELS[root.get("channel", "luminance")], regions, rank, low, high)


def _region(box: Any, size: tuple[int, int]) -> Array:
    """Return the numbers of the pixels in the region [x0, y0, x1, y1], or of all."""
    x0, y0, x1, y1 = (0, 0, size[1], size[0]) if box in (None, "all") else box
    if not (x0 < x1 <= size[1] and y0 < y1 <= size[0]):
        raise BadInput("has a region outside of the picture", "report.json", "property", FIX)
    return np.arange(size[0] * size[1]).reshape(size)[y0:y1, x0:x1].ravel()
