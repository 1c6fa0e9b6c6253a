"""Boxes of named parameters, scaled to [-1, 1]^d for the bounds."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterBox:
    """A closed box. ``names`` and ``units`` label the axes; ``lower``, ``upper`` are [d]."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]

    @property
    def dimensions(self) -> int:
        """Number of parameters d."""
        return len(self.names)

    @property
    def middle(self) -> Float64Array:
        """[d] centre."""
        return 0.5 * (np.array(self.lower) + np.array(self.upper))

    def at(self, scaled: Float64Array) -> Float64Array:
        """Return the parameter values [..., d] at ``scaled`` positions in [-1, 1]^d, clipped into the box."""
        low, high = np.array(self.lower), np.array(self.upper)
        weight = 0.5 * (np.asarray(scaled, np.float64) + 1.0)
        return np.clip(low + weight * (high - low), low, high)

    def contains(self, values: Float64Array) -> bool:
        """Whether ``values`` [d] lie in the box, ends included."""
        values = np.asarray(values, np.float64)
        return bool(np.all((values >= np.array(self.lower)) & (values <= np.array(self.upper))))

    def sample(self, count: int, generator: np.random.Generator) -> Float64Array:
        """Return [count, d] values, uniform over the box."""
        return self.at(generator.uniform(-1.0, 1.0, (count, self.dimensions)))

    def corners(self) -> Float64Array:
        """Return [2^d, d] corners."""
        ends = list(zip(self.lower, self.upper, strict=True))
        return np.array(list(itertools.product(*ends)), np.float64).reshape(2**self.dimensions, self.dimensions)

    def without(self, names: Sequence[str]) -> ParameterBox:
        """Return the box without the axes ``names``."""
        remaining = [j for j, name in enumerate(self.names) if name not in names]
        parts = (self.names, self.units, self.lower, self.upper)
        return ParameterBox(*(tuple(part[j] for j in remaining) for part in parts))  # pyright: ignore[reportArgumentType]

    def split(self, axis: int, parts: int = 2) -> list[ParameterBox]:
        """Return ``parts`` boxes of equal width along ``axis`` whose union is this box exactly."""
        low, high = self.lower[axis], self.upper[axis]
        ends = [low + (high - low) * (i / parts) for i in range(parts)] + [high]
        return [self.replace(axis, ends[i], ends[i + 1]) for i in range(parts)]

    def with_ends(self, lower: Float64Array, upper: Float64Array) -> ParameterBox:
        """Return the box of the same parameters with ends [d], [d]."""
        return ParameterBox(self.names, self.units, tuple(lower.tolist()), tuple(upper.tolist()))

    def replace(self, axis: int, low: float, high: float) -> ParameterBox:
        """Return the box with another interval along ``axis``."""
        lower, upper = list(self.lower), list(self.upper)
        lower[axis], upper[axis] = low, high
        return ParameterBox(self.names, self.units, tuple(lower), tuple(upper))


def part_middles(counts: np.ndarray) -> Float64Array:
    """Return [d, k] middles of the k equal parts of [-1, 1]^d, ``counts`` [d] along the axes, in row-major order."""
    along = [(2.0 * np.arange(n) + 1.0) / n - 1.0 for n in counts.tolist()]
    grid = np.array(np.meshgrid(*along, indexing="ij"), np.float64)
    return np.ascontiguousarray(grid.reshape(counts.size, counts.prod()))


def shared_out(weights: np.ndarray, parts: int) -> np.ndarray:
    """Return the numbers of parts [d] along the axes whose product is ``parts`` (a power of two), by ``weights``."""
    counts = np.ones(weights.size, np.int64)
    while counts.prod() < parts:
        counts[np.argmax(weights / counts)] *= 2
    return counts
