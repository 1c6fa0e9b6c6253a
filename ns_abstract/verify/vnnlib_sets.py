"""The content of a VNN-LIB file: unsafe sets of outputs, and regions of inputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class UnsafeSet:
    """Outputs y are unsafe if ``rows[g] @ y + offset[g] <= 0`` holds for every row of some group g.

    ``inputs`` is the number of assertions on inputs that are ignored.
    """

    rows: np.ndarray
    offset: np.ndarray
    groups: tuple[tuple[int, ...], ...]
    inputs: int


@dataclass(frozen=True)
class InputRegion:
    """A box [n] of inputs with the outputs that are unsafe there; without rows and groups, any output is."""

    lower: np.ndarray
    upper: np.ndarray
    unsafe: UnsafeSet

    def holds(self, output: np.ndarray) -> bool:
        """Return whether ``output`` is unsafe."""
        value = self.unsafe.rows @ output + self.unsafe.offset
        return any(bool((value[list(group)] <= 0.0).all()) for group in self.unsafe.groups)
