"""Max pooling, relaxed by one plane per window (docs/dev/design.md, N12)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ns_abstract.arithmetic.network_charges import OWN_WINDOW
from ns_abstract.verify.network.layers import Shape

#: Steps towards the mixture of a window's numbers whose upper plane is lowest.
_STEPS = 8
#: What no number of a window is: stands for pairs that are left out.
_LARGE = 1e300


@dataclass(frozen=True, eq=False)
class MaxPool:
    """Max pooling over windows of every channel, [C, H, W]; padding never wins. ``pads``: top, left, bottom, right."""

    input_shapes: tuple[Shape]
    shape: Shape
    kernel: tuple[int, int]
    stride: tuple[int, int]
    dilation: tuple[int, int]
    pads: tuple[int, int, int, int]
    mixes: ClassVar[bool] = True

    @cached_property
    def steps(self) -> np.ndarray:
        """[K, 2] int64 rows and columns of a window's inputs, relative to its first."""
        return np.array([[i * self.dilation[0], j * self.dilation[1]] for i, j in np.ndindex(*self.kernel)])

    @cached_property
    def places(self) -> Tensor:
        """[K, windows] int64 flat positions of the inputs in a channel's map; -1 in the padding."""
        _, height, width = self.input_shapes[0]
        first = np.indices(self.shape[1:]).reshape(2, -1) * np.array(self.stride)[:, None]
        at = self.steps[:, :, None] + first - np.array(self.pads[:2])[:, None]
        inside = (at >= 0).all(1) & (at[:, 0] < height) & (at[:, 1] < width)
        return torch.from_numpy(np.where(inside, at[:, 0] * width + at[:, 1], -1))

    @property
    def overlaps(self) -> int:
        """Largest number of windows that one input is in."""
        axes = zip(self.kernel, self.stride, self.dilation, strict=True)
        return int(np.prod([k if d > 1 else -(-k // s) for k, s, d in axes]))

    def taps(self, x: Tensor, padding: float) -> Tensor:
        """Return the inputs [m, C, K, windows] of every window of maps [m, C, H, W]."""
        in_windows = x.flatten(2)[:, :, self.places.clamp(min=0)]
        return torch.where(self.places >= 0, in_windows, torch.full((), padding, dtype=x.dtype))

    def __call__(self, inputs: Sequence[Tensor]) -> Tensor:
        top, left, bottom, right = self.pads
        padded = functional.pad(inputs[0], (left, right, top, bottom), value=-torch.inf)
        return functional.max_pool2d(padded, self.kernel, self.stride, 0, self.dilation)


class WindowInputs(NamedTuple):
    """Bounds of the inputs of B pooling windows, ``z = reference + u``.

    Attributes:
        inside: [B, K] False in the padding, where the other arrays mean nothing.
        reference, middle, radius: [B, K]; u is ``middle + slopes p`` within ``radius``.
        slopes: [B, K, d].
        lower, upper: [B, K] of z.
        winner: [B] number of the input that the lower plane follows.
    """

    inside: Tensor
    reference: Tensor
    middle: Tensor
    radius: Tensor
    slopes: Tensor
    lower: Tensor
    upper: Tensor
    winner: Tensor

    @property
    def size(self) -> Tensor:
        """Upper bounds [B, K] of all magnitudes that are computed with an input."""
        moves = self.middle.abs() + self.radius + self.slopes.abs().sum(2)
        return self.reference.abs() + moves + self.lower.abs() + self.upper.abs()

    def relaxation_gap(self) -> Tensor:
        """Return upper bounds [B, K, K] of input j minus i at (j, i): -1e300 if j is padding, else 1e300 if i is."""

        def less(v: Tensor) -> Tensor:
            return v[:, :, None] - v[:, None, :]

        size = self.size
        room = OWN_WINDOW * (size[:, :, None] + size[:, None, :])
        form = less(self.reference) + less(self.middle) + (self.radius[:, :, None] + self.radius[:, None, :])
        for k in range(self.slopes.shape[2]):
            form = form + less(self.slopes[:, :, k]).abs()
        distances = torch.minimum(form, self.upper[:, :, None] - self.lower[:, None, :]) + room
        distances = torch.where(self.inside[:, None, :], distances, torch.full_like(distances, _LARGE))
        distances = torch.where(self.inside[:, :, None], distances, torch.full_like(distances, -_LARGE))
        distances.diagonal(dim1=1, dim2=2).zero_()
        return distances


class WindowPlanes(NamedTuple):
    """Planes of pooling windows: ``low <= max z - slopes z <= high``; slopes [B, K] >= 0, zero in the padding."""

    slopes: Tensor
    low: Tensor
    high: Tensor


def upper_planes(window: WindowInputs, apart: Tensor) -> WindowPlanes:
    """Return for every window the upper plane that is lowest in the middle (N12), given the gaps ``apart``."""
    at = torch.arange(len(apart))
    winner = window.winner
    middle = torch.where(window.inside, window.reference + window.middle, torch.zeros_like(window.middle))
    size = torch.where(window.inside, window.size, torch.zeros_like(middle))
    # numbers that never are above the winner are not needed
    needed = apart[at, :, winner] > 0.0
    needed[at, winner] = True
    pairs = torch.where(needed[:, None, :], apart, torch.full_like(apart, _LARGE))
    pairs = torch.where(needed[:, :, None], pairs, torch.full_like(apart, -_LARGE))

    def above(s: Tensor) -> Tensor:
        """[B, K]: how far each number may be above the mixture."""
        return (pairs * s[:, None, :]).sum(2)

    # between the winner and what may be farthest above it: the chord of their difference
    rival = pairs[at, :, winner].argmax(1)
    up, down = apart[at, rival, winner].clamp(min=0.0), apart[at, winner, rival].clamp(min=0.0)
    part = torch.where(up > 0.0, up / (up + down), torch.zeros_like(up))
    mixture = torch.zeros_like(middle)
    mixture[at, winner] = 1.0 - part
    mixture[at, rival] += part
    best, low, least = mixture, torch.zeros_like(up), above(mixture)
    high = least.amax(1)
    height = high + (best * middle).sum(1)
    for step in range(_STEPS):
        # a step towards the number that is farthest above the mixture
        mixture = mixture * (1.0 - 1.0 / (step + 3.0))
        mixture[at, least.argmax(1)] += 1.0 / (step + 3.0)
        least = above(mixture)
        new = least.amax(1)
        better = new + (mixture * middle).sum(1) < height
        best = torch.where(better[:, None], mixture, best)
        high = torch.where(better, new, high)
        height = torch.where(better, new + (mixture * middle).sum(1), height)
    room = OWN_WINDOW * (best * size).sum(1)
    low, high = low - room, high + room
    # over a box alone: level with the second or the third largest upper end
    none = torch.full_like(middle, -_LARGE)
    lower, upper = torch.where(window.inside, window.lower, none), torch.where(window.inside, window.upper, none)
    ends = upper.sort(1, descending=True).values
    width = torch.where(window.inside, window.upper - window.lower, torch.ones_like(middle))
    for level in {min(1, ends.shape[1] - 1), min(2, ends.shape[1] - 1)}:
        base = torch.maximum(lower.amax(1), ends[:, level])
        rise = (upper - base[:, None]).clamp(min=0.0)
        s = torch.where(rise > 0.0, rise / width, torch.zeros_like(rise))
        own = torch.where(window.inside, s * window.lower, torch.zeros_like(s)).sum(1)
        new = base - own
        better = new + (s * middle).sum(1) < height
        first = 1.0 - s[at, winner]
        rest = torch.where(window.inside, s * window.upper, torch.zeros_like(s)).sum(1)
        rest = rest - (s * window.upper)[at, winner]
        under = torch.minimum(first * window.lower[at, winner], first * window.upper[at, winner]) - rest
        room = OWN_WINDOW * (base.abs() + (s * size).sum(1) + size[at, winner])
        best = torch.where(better[:, None], s, best)
        low, high = torch.where(better, under - room, low), torch.where(better, new + room, high)
        height = torch.where(better, new + (s * middle).sum(1), height)
    return WindowPlanes(best, low, high)
