"""Pictures of which everything is known."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ns_abstract.geometry.box import ParameterBox


class Waves:
    """Pictures that fade with d parameters v: ``0.5 + 0.3 a . sin(v)``, bounded by Taylor's formula.

    See `ns_abstract.verify.protocol.FrameImages`.
    """

    def __init__(self, size: tuple[int, int], d: int) -> None:
        self.slopes = np.random.default_rng(0).normal(size=(*size, 3, d)) * 0.2

    def scene_samples(self, seed: int) -> Iterator[Any]:
        return iter(())

    def image(self, values: np.ndarray, scene_sample: Any = None) -> np.ndarray:
        return (0.5 + 0.3 * self.slopes @ np.sin(values)).astype(np.float32)

    def linear_sets(self, box: ParameterBox) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]:
        middle, half = box.middle, 0.5 * (np.array(box.upper) - np.array(box.lower))
        a = 0.3 * self.slopes * (np.cos(middle) * half)
        b = 0.5 + 0.3 * self.slopes @ np.sin(middle)
        room = 0.3 * np.abs(self.slopes) @ (0.5 * half**2) * 1.0001 + 1e-6
        spread = np.abs(a).sum(axis=-1) + room
        return (a, b - room, a, b + room), b - spread, b + spread, np.abs(a).mean(axis=(0, 1, 2))
