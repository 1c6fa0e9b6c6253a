"""Concretised bounds of the backward pass, and the criterion that stops it early (design.md, N5, N6, N15, N17)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ns_abstract.arithmetic.network_charges import OWN_FEW, OWN_LINE
from ns_abstract.verify.network.coefficients import Coefficients, Float64, Int64, full


@dataclass
class BackwardBounds:
    """Concretised bounds [R] of backward coefficients, and their planes below and above [R, 2, d + 1]; NaN if unknown.

    ``ended`` [R] is the node at which each ended; 0 is the image.
    """

    plane: Float64
    lower: Float64
    upper: Float64
    ended: Int64

    @staticmethod
    def unknown(count: int, d: int) -> BackwardBounds:
        infinite = np.full(count, np.inf)
        return BackwardBounds(np.full((count, 2, d + 1), np.nan), -infinite, infinite, np.zeros(count, np.int64))

    def put(self, number: Int64, other: BackwardBounds) -> None:
        self.plane[number], self.lower[number], self.upper[number] = other.plane, other.lower, other.upper
        self.ended[number] = other.ended

    def turn(self, mask: np.ndarray) -> None:
        """Negate the rows in ``mask``."""
        self.plane[mask] = -self.plane[mask][:, ::-1]
        self.lower[mask], self.upper[mask] = -self.upper[mask], -self.lower[mask]

    def meet(self, number: Int64, other: BackwardBounds, below: np.ndarray) -> None:
        """Intersect with other bounds of the rows ``number``, taking their planes below or above."""
        side = np.where(below, 0, 1)
        self.plane[number, side] = other.plane[np.arange(len(number)), side]
        self.lower[number] = np.maximum(self.lower[number], other.lower)
        self.upper[number] = np.minimum(self.upper[number], other.upper)

    def middle(self) -> tuple[Tensor, Tensor]:
        """Return the middle plane [R, d + 1], and the largest distance [R] of the two planes from it."""
        low, high = self.plane[:, 0], self.plane[:, 1]
        gap = high - low
        radius = 0.5 * (gap[:, -1] + np.abs(gap[:, :-1]).sum(1))
        radius = np.maximum(radius, 0.0) + OWN_LINE * (np.abs(low).sum(1) + np.abs(high).sum(1))
        return torch.from_numpy(0.5 * (low + high)), torch.from_numpy(radius)

    def improve(self, number: Int64, plane: Float64, box: Float64) -> None:
        """Replace planes by those of a later node, and tighten bounds by the planes' extremes and by the intervals'."""
        slopes = np.abs(plane[:, :, :-1]).sum(-1)
        room = OWN_FEW * (np.abs(plane[:, :, -1]) + slopes)
        self.plane[number] = plane
        least = np.fmax(plane[:, 0, -1] - slopes[:, 0] - room[:, 0], box[:, 0])
        most = np.fmin(plane[:, 1, -1] + slopes[:, 1] + room[:, 1], box[:, 1])
        self.lower[number] = np.fmax(self.lower[number], least)
        self.upper[number] = np.fmin(self.upper[number], most)


class NeuronTarget(NamedTuple):
    """How tight the bounds of a neuron have to be; soundness does not depend on it (N6, N17).

    ``width``: the largest allowed width; None: the sign alone matters. ``kink``: whether the sign has to be known;
    ``cut``: whether a number that is surely not positive may have any bounds.
    """

    width: float | None = None
    kink: bool = True
    cut: bool = True


@dataclass(frozen=True)
class StoppingCriterion:
    """The criterion that stops a neuron's backward pass before it reaches the image.

    ``zero`` [R]: the row's value where its neuron is zero; ``negative`` [R]: whether a row is its neuron's negative.
    """

    goal: NeuronTarget
    zero: Float64
    negative: np.ndarray

    def __getitem__(self, chosen: Any) -> StoppingCriterion:
        return replace(self, zero=self.zero[chosen], negative=self.negative[chosen])

    def done(self, bounds: BackwardBounds, number: Int64) -> np.ndarray:
        """Return which of the rows ``number`` may stop."""
        zero, lower, upper = self.zero[number], bounds.lower[number], bounds.upper[number]
        if self.goal.width is None:
            # the other side is asked for by another row
            return lower >= zero
        tight = upper - lower <= self.goal.width
        if not self.goal.kink:
            return tight
        off = np.where(self.negative[number], lower >= zero, upper <= zero) & self.goal.cut
        return off | (tight & ((lower >= zero) | (upper <= zero)))


class BackwardTrace:
    """Coefficients of one call of `BackwardPass.bound` at the nodes on the way to the image.

    Args:
        count: Rows R.
        short: Whether only the coefficients on the image are stored.

    Attributes:
        by_node: [R, n] float32 coefficients on outputs of nodes whose constants depend on the cell's ranges, and on the
            image (0).
        fixed: [R, 2] constants below and above from all other nodes.
        reached: [R] whether the row reaches the image.
    """

    def __init__(self, count: int, short: bool) -> None:
        self.short = short
        self.by_node: dict[int, NDArray[np.float32]] = {}
        self.fixed = np.zeros((count, 2))
        self.reached = np.zeros(count, bool)

    def keep(self, at: int, coefficients: Coefficients, shape: tuple[int, ...], number: Int64) -> None:
        """Store rows ``number`` on the output of node ``at``."""
        if at not in self.by_node:
            self.by_node[at] = np.zeros((len(self.fixed), int(np.prod(shape))), np.float32)
        whole = full(coefficients, shape, force=True)
        self.by_node[at][number] = whole.value.reshape(len(number), -1)
