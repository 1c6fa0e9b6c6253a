"""What refinement knows about one frame: an abstract image, its witnesses, and how it got there."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ns_abstract.sets.box import ParameterBox

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]


@dataclass(frozen=True)
class TracePoint:
    """The state after ``seconds`` of work on a frame and ``cells`` bounded cells."""

    seconds: float
    cells: int
    mpg: float
    mpg_witness: float


@dataclass(frozen=True)
class Leaves:
    """Linear sets of the leaf cells of one frame, one row per (cell, tile).

    On a leaf's box, with its parameters scaled to ``p`` in [-1, 1]^d, every pixel and channel of
    every image of the set lies in ``[A_lower p + b_lower, A_upper p + b_upper]``.

    Attributes:
        box_lower, box_upper: [L, d] ends of the leaf's box, in the parameters' units.
        tile: [L, 2] first row and first column of the tile's pixels.
        A_lower, A_upper: [L, side, side, 3, d] float32.
        b_lower, b_upper: [L, side, side, 3] float32.
    """

    box_lower: Float64Array
    box_upper: Float64Array
    tile: NDArray[np.int32]
    A_lower: Float32Array
    b_lower: Float32Array
    A_upper: Float32Array
    b_upper: Float32Array


@dataclass(frozen=True)
class FrameResult:
    """One frame's abstract image.

    Attributes:
        index: Number of the camera path's entry.
        box: The set's parameters.
        lower, upper: [H, W, 3] enclose every image of the set, after background and clamp to [0, 1].
        witness_lower, witness_upper: [H, W, 3] least and largest values that were really rendered.
        image: [H, W, 3] one concrete render, at the middle of the box.
        seconds: Time spent on the frame.
        cells: Number of cells bounded.
        trace: Progress over time, first point first.
        plan: What was left out for this frame and why, one sentence each.
        bounded: False while no bound but [0, 1] is known (the budget ended first).
        leaves: The leaf cells' linear sets, if they were asked for.
    """

    index: int
    box: ParameterBox
    lower: Float32Array
    upper: Float32Array
    witness_lower: Float32Array
    witness_upper: Float32Array
    image: Float32Array
    seconds: float
    cells: int
    trace: tuple[TracePoint, ...] = ()
    plan: tuple[str, ...] = ()
    bounded: bool = True
    leaves: Leaves | None = field(default=None, repr=False)


def gap(lower: NDArray[np.floating], upper: NDArray[np.floating]) -> Float64Array:
    """[H, W] Euclidean length over RGB of ``upper - lower``."""
    return np.linalg.norm(upper.astype(np.float64) - lower, axis=-1)


def mean_pixel_gap(lower: NDArray[np.floating], upper: NDArray[np.floating]) -> float:
    """MPG: the mean of `gap` over the pixels."""
    return float(gap(lower, upper).mean())


def max_pixel_gap(lower: NDArray[np.floating], upper: NDArray[np.floating]) -> float:
    """XPG: the maximum of `gap` over the pixels."""
    return float(gap(lower, upper).max())
