"""Numbers measured in a picture, its depths or its blending weights, and their bounds (docs/dev/design.md, Q4).

A measure is a mean or an order statistic of the pixels of a region. It grows with every pixel, so bounds of the pixels
bound it, over a cell or over each part of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from ns_abstract.arithmetic.network_charges import OWN_MARGIN
from ns_abstract.io.errors import InputError
from ns_abstract.refine.protocol import WeightPlane
from ns_abstract.verify.network import ImageSets

#: What a measure is read off: the picture's colours, its expected depths, or weights.
Plane = Literal["colors", "depth"] | WeightPlane
#: Luminance of linear RGB (ITU-R BT.709), and the channels by themselves.
CHANNELS = {"luminance": (0.2126, 0.7152, 0.0722), "r": (1.0, 0.0, 0.0), "g": (0.0, 1.0, 0.0), "b": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Region:
    """A set of pixels: a box x0, y0, x1, y1 with exclusive ends, white ones of a mask, or all; ``name`` is its key."""

    box: tuple[int, int, int, int] | None = None
    mask: Path | None = None
    name: str = "region"
    #: [H, W] bool of the mask, read once: its file may change during a search.
    white: np.ndarray | None = field(default=None, compare=False, repr=False)

    def pixels(self, height: int, width: int) -> np.ndarray:
        """Return the region as [H, W] bool."""
        chosen = np.ones((height, width), bool)
        if self.white is not None:
            chosen = self.white.copy()
            if chosen.shape != (height, width):
                raise InputError(
                    f"the mask has {chosen.shape[1]} x {chosen.shape[0]} pixels, the picture {width} x {height}",
                    file=self.mask,
                    field="mask",
                    fix=f"resize it to {width} x {height}, or write preprocess.resize [{chosen.shape[0]}, "
                    f"{chosen.shape[1]}]",
                )
            if not chosen.any():
                raise InputError("no pixel is white", file=self.mask, field="mask", fix="paint what counts white")
        if self.box is not None:
            x0, y0, x1, y1 = self.box
            if x1 > width or y1 > height:
                raise InputError(
                    f"[{x0}, {y0}, {x1}, {y1}] reaches beyond the picture of {width} x {height} pixels",
                    field=self.name,
                    fix="write [x0, y0, x1, y1] inside of it",
                )
            inside = np.zeros_like(chosen)
            inside[y0:y1, x0:x1] = True
            chosen = inside
        return chosen

    def __str__(self) -> str:
        if self.mask is not None:
            return f"the white pixels of {self.mask.name}"
        return "the picture" if self.box is None else f"the pixels {list(self.box)}"


@dataclass(frozen=True, eq=False)
class Measure:
    """A number measured in a picture of known size.

    Attributes:
        plane: The colours, depths or weights that are measured.
        channels: [c] non-negative weights of the plane's channels.
        rank: Takes the rank-th largest of the region's pixels, or smallest where ``least``; None: their mean.
        pixels: [n] flat positions of the region's pixels.
        minus: [k] flat positions of a second region, whose statistic is subtracted; None: there is none.
        cap: Pixels above it count as it.
    """

    plane: Plane
    channels: tuple[float, ...]
    rank: int | None
    pixels: np.ndarray
    least: bool = False
    minus: np.ndarray | None = None
    cap: float = math.inf

    def value(self, planes: torch.Tensor, first: int) -> torch.Tensor:
        """Return values [B] of pictures [B, H, W, C] whose channels ``first`` on are the plane's; differentiable."""
        flat = planes.flatten(1, 2)[..., first : first + len(self.channels)]
        single = (flat * torch.tensor(self.channels, dtype=flat.dtype)).sum(dim=-1).clamp(max=self.cap)
        value = self._statistic(single[:, self.pixels])
        return value if self.minus is None else value - self._statistic(single[:, self.minus])

    def _statistic(self, pixels: torch.Tensor) -> torch.Tensor:
        if self.rank is None:
            return pixels.mean(dim=1)
        return torch.topk(pixels, self.rank, dim=1, largest=not self.least).values[:, -1]

    def bounds(self, planes: PlaneSets, first: int, parts: CellParts) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds [s] of the value over each part of the cell; ``first``: its first channel."""
        low, high = self._statistic_bounds(planes, first, parts, self.pixels)
        if self.minus is not None:
            taken = self._statistic_bounds(planes, first, parts, self.minus)
            low, high = low - taken[1], high - taken[0]
            if self.rank is None:
                # one linear function of the pose: what both regions do together cancels
                both = self._mean_bounds(planes, first, parts, [(self.pixels, 1.0), (self.minus, -1.0)])
                low, high = np.maximum(low, both[0]), np.minimum(high, both[1])
        return low - OWN_MARGIN * (1.0 + np.abs(low)), high + OWN_MARGIN * (1.0 + np.abs(high))

    def _statistic_bounds(
        self, planes: PlaneSets, first: int, parts: CellParts, pixels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds [s] of the statistic of some pixels over each part."""
        low, high = (np.minimum(side, self.cap) for side in planes.over(parts, pixels, first, np.array(self.channels)))
        if self.rank is None:
            rounding = len(pixels) * OWN_MARGIN * np.maximum(np.abs(low).max(axis=1), np.abs(high).max(axis=1))
            low, high = low.mean(axis=1) - rounding, high.mean(axis=1) + rounding
            if math.isinf(self.cap):
                mean = self._mean_bounds(planes, first, parts, [(pixels, 1.0)])
                low, high = np.maximum(low, mean[0]), np.minimum(high, mean[1])
            return low, high
        place = self.rank - 1 if self.least else len(pixels) - self.rank
        return ranked(low, place), ranked(high, place)

    def _mean_bounds(
        self, planes: PlaneSets, first: int, parts: CellParts, regions: list[tuple[np.ndarray, float]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds [s] of a signed sum of means by linear bounds alone; ``first``: its first channel."""
        channels, ends = np.array(self.channels), []
        for sign in (1.0, -1.0):
            slope, value, size, count = np.zeros(parts.dimensions), 0.0, 0.0, 0
            for pixels, weight in regions:
                # the lower side of what is added, the upper side of what is taken away
                side = 0 if sign * weight > 0.0 else 2
                a = planes.linear[side][pixels][:, first : first + len(channels)].astype(np.float64)
                b = planes.linear[side + 1][pixels][:, first : first + len(channels)].astype(np.float64)
                slope = slope + weight * np.tensordot(channels, a, (0, 1)).mean(axis=0)
                value += weight * float((b @ channels).mean())
                size += float((np.abs(b) @ channels).mean() + np.abs(a).sum(axis=-1).dot(channels).mean())
                count += len(pixels)
            center, half = parts.middles @ slope + value, parts.halves @ np.abs(slope)
            ends.append(center - sign * (half + (count + parts.dimensions) * OWN_MARGIN * size))
        return ends[0], ends[1]


def ranked(values: np.ndarray, place: int) -> np.ndarray:
    """Return [s] the entry of rank ``place`` (0: the least) of each row of ``values`` [s, n]."""
    varies = (values != values[0]).any(axis=0)
    count = int(varies.sum())
    # of what is the same in all rows, only as many can be meant as there are others
    same = np.sort(values[0, ~varies])
    first = max(0, place - count)
    some = np.concatenate([values[:, varies], np.tile(same[first : place + 1], (len(values), 1))], axis=1)
    return np.partition(some, place - first, axis=1)[:, place - first]


def shared_counts(effects: np.ndarray, most_parts: int) -> np.ndarray:
    """Return numbers [d] of parts, powers of two, at most ``most_parts`` together; larger ``effects`` get more."""
    counts = np.ones(len(effects), np.int64)
    while effects.size and np.max(effects / counts) > 0.0 and 2 * counts.prod() <= most_parts:
        counts[int(np.argmax(effects / counts))] *= 2
    return counts


@lru_cache(maxsize=64)
def _equal_parts(counts: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return middles and half widths of `CellParts.equal` without overlap."""
    middles, halves = np.zeros((1, 0)), np.zeros((1, 0))
    for count in counts:
        # powers of two: these are exact
        places = (2.0 * np.arange(count) + 1.0) / count - 1.0
        middles = np.concatenate([np.repeat(middles, count, 0), np.tile(places, len(middles))[:, None]], axis=1)
        halves = np.concatenate([np.repeat(halves, count, 0), np.full((len(middles), 1), 1.0 / count)], axis=1)
    return middles, halves


@dataclass(frozen=True)
class CellParts:
    """Equal parts of a cell in its parameters, each scaled to [-1, 1]: middles and half widths [s, d]."""

    middles: np.ndarray
    halves: np.ndarray

    @property
    def dimensions(self) -> int:
        """Number of parameters d."""
        return self.middles.shape[1]

    @classmethod
    def equal(cls, counts: np.ndarray, overlap: float = 0.0) -> CellParts:
        """Return ``counts`` [d] parts along the parameters, powers of two, each longer by ``overlap`` at its ends."""
        middles, halves = _equal_parts(tuple(counts.tolist()))
        return cls(middles, halves + overlap)


@dataclass(frozen=True)
class SubBoxEnds:
    """Bounds of some pixels over equal sub-boxes of one cell, in addition to its linear sets (Q8).

    Attributes:
        counts: [d] numbers of sub-boxes along the parameters, powers of two. Each extends by `SUB_BOX_OVERLAP` of the
            cell's half-widths beyond its ends.
        pixels: [n] flat positions in the picture, each once.
        lower, upper: [s, n, C] of planes; sub-boxes in the order of an array of shape ``counts``.
    """

    counts: np.ndarray
    pixels: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


@dataclass(frozen=True)
class PlaneSets:
    """Linear sets of all planes of one cell's pictures, A_lower [n, C, d], b_lower [n, C], A_upper, b_upper.

    ``ends``: bounds of some pixels over the parts that are passed to `over`; None: there are only the sets.
    """

    linear: tuple[np.ndarray, ...]
    lower: np.ndarray
    upper: np.ndarray
    ends: SubBoxEnds | None = None

    def over(
        self, parts: CellParts, pixels: np.ndarray, first: int, channels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds [s, k] of weighted channels, ``first`` on, of ``pixels`` [k] over each part.

        Pixels are flat positions in the picture, ascending.
        """
        cut = slice(first, first + len(channels))
        ends = []
        for sign, side, interval in ((-1.0, 0, self.lower), (1.0, 2, self.upper)):
            a = np.tensordot(self.linear[side][pixels][:, cut].astype(np.float64), channels, (1, 0))
            b = self.linear[side + 1][pixels][:, cut].astype(np.float64) @ channels
            flat = interval[pixels][:, cut].astype(np.float64) @ channels
            nearer = np.maximum if sign < 0.0 else np.minimum
            size = np.abs(a).sum(axis=1) + np.abs(self.linear[side + 1][pixels][:, cut]) @ channels + np.abs(flat)
            # settled pixels, most of all, are the same in every part
            whole = np.tile(nearer(b, flat), (len(parts.middles), 1))
            varies = a.any(axis=1)
            slopes = a[varies].T
            line = parts.middles @ slopes + b[varies] + sign * (parts.halves @ np.abs(slopes))
            whole[:, varies] = nearer(line, flat[varies])
            ends.append(whole + sign * OWN_MARGIN * size)
        if self.ends is not None:
            place = np.minimum(np.searchsorted(pixels, self.ends.pixels), len(pixels) - 1)
            read = pixels[place] == self.ends.pixels
            for nearer, side, sign in ((np.maximum, self.ends.lower, -1.0), (np.minimum, self.ends.upper, 1.0)):
                own = side[:, read, cut] @ channels
                own += sign * OWN_MARGIN * np.abs(own)
                of_side = ends[0] if sign < 0.0 else ends[1]
                of_side[:, place[read]] = nearer(of_side[:, place[read]], own)
        return ends[0], ends[1]


def planes_of(images: ImageSets, channels: int) -> Iterator[PlaneSets]:
    """Yield the planes of each cell, whose pictures have ``channels`` channels."""
    arrays = (images.a_lower, images.b_lower, images.a_upper, images.b_upper, images.lower, images.upper)
    for a_lower, b_lower, a_upper, b_upper, lower, upper in zip(*arrays, strict=True):
        shape = len(lower) // channels, channels, a_lower.shape[-1]
        flat = [part.reshape(-1, channels) for part in (b_lower, b_upper, lower, upper)]
        yield PlaneSets((a_lower.reshape(shape), flat[0], a_upper.reshape(shape), flat[1]), flat[2], flat[3])
