"""Selection of samples that are drawn white to bound their blending weights (docs/dev/design.md, Q3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.rounding import POINT_ROUNDING


@dataclass(frozen=True)
class WhiteSamples:
    """Selection, channel by channel, of samples inside a box and nearer than a distance along the ray.

    Attributes:
        lower, upper: [3, 3] corners of each channel's box, infinite where there is none; reversed: a black channel.
        nearer: [3] distances of each channel; infinite where there is none.
    """

    lower: np.ndarray
    upper: np.ndarray
    nearer: np.ndarray

    def at(self, points: Tensor, distances: Tensor) -> Tensor:
        """Return colours [..., 3], 1 if selected, else 0, of samples at ``points`` [..., 3] and ``distances`` [...]."""
        low, high, nearer = (torch.from_numpy(v).to(points) for v in (self.lower, self.upper, self.nearer))
        there = points[..., None, :]
        inside = ((there >= low) & (there <= high)).all(dim=-1)
        return (inside & (distances[..., None] < nearer)).to(points.dtype)

    def between(self, low: np.ndarray, high: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds [k, 3], each 0 or 1, of `at` for points between ``low`` and ``high`` [k, 3].

        A point with NaN bounds may lie anywhere. ``distance`` [k] is along the rays, up to the renderer's rounding.
        """
        low, high = low[:, None], high[:, None]
        surely = ((low >= self.lower) & (high <= self.upper)).all(axis=2)
        never = ((high < self.lower) | (low > self.upper)).any(axis=2)
        room = POINT_ROUNDING * distance
        near, far = (distance + room)[:, None] < self.nearer, (distance - room)[:, None] >= self.nearer
        return (surely & near).astype(np.float64), (~never & ~far).astype(np.float64)
