"""Linear relaxations and rounding errors that the backward pass applies (docs/dev/design.md, N2, N4, N9, N12)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import FLUSH, OWN_STORED
from ns_abstract.verify.network.coefficients import Coefficients, Float64, Int64, pass_maximum
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.rounding import outward


class MaxPoolPlanes(NamedTuple):
    """Planes of pooling windows as the backward pass applies them (N12).

    Attributes:
        winner: [m, C, H, W] int16, number of the input that the lower plane follows.
        which: [m, C, H, W] int32, rows of ``slopes``; -1 where the winner is surely the maximum.
        slopes: [U, K] of upper planes, in the rows' type, as offsets are.
        offsets: [4, m, C, H, W]: lower and upper for coefficients >= 0, upper and lower for negative ones.
    """

    winner: np.ndarray
    which: np.ndarray
    slopes: np.ndarray
    offsets: np.ndarray

    def forward(self, layer: MaxPool, cell: int, coefficients: Tensor, inputs: list[Tensor]) -> Tensor:
        """Return values at a cell's inputs [R, C, H', W'] of the planes that ``coefficients`` [R, C, H, W] choose."""
        taps = layer.taps(inputs[0], 0.0)
        winner = torch.from_numpy(self.winner[cell].astype(np.int64)).flatten(1)[None, :, None]
        value = taps.gather(2, winner.expand(len(taps), -1, -1, -1))[:, :, 0]
        offsets = torch.from_numpy(self.offsets[:, cell]).flatten(2)
        which = torch.from_numpy(self.which[cell].astype(np.int64)).flatten(1)
        a = coefficients.flatten(2)
        if len(self.slopes):
            slopes = torch.from_numpy(self.slopes)[which.clamp(min=0)].movedim(2, 1)
            value = torch.where((a >= 0.0) | (which < 0), value, (taps * slopes).sum(2))
        return value + torch.where(a >= 0.0, offsets[0], offsets[2])

    def backward(self, coefficients: Coefficients, layer: MaxPool, cell: Int64, total: Float64) -> Coefficients:
        """Return the rows on the input; their constants are added to ``total`` [R, 2]."""
        height, width = coefficients.value.shape[2:]
        (down, right), extent = layer.stride, layer.steps.max(0) + 1
        size = (height - 1) * down + int(extent[0]), (width - 1) * right + int(extent[1])
        target = np.zeros((*coefficients.value.shape[:2], *size), coefficients.value.dtype)
        pass_maximum(
            coefficients.value, coefficients.y, coefficients.x, cell, *self, layer.steps, layer.stride, total, target
        )
        return Coefficients(target, coefficients.y * down - layer.pads[0], coefficients.x * right - layer.pads[1])


class ReusedRelaxation(NamedTuple):
    """The relaxation of an activation around slopes that another cell's coefficients use (N15).

    ``lines`` [6, m, C, H, W] as in `pass_activation`; ``tilts`` [2, m, d, n] are slopes, in the parameters, of the
    middle between the offsets, for coefficients of either sign.
    """

    lines: np.ndarray
    tilts: Float64


@dataclass
class Relaxations:
    """The relaxations of all nodes for coefficients of one float type, with that type's own rounding (N2).

    Attributes:
        dtype, unit: Type of rows, slopes and offsets, and its unit roundoff.
        sums: Relative error of rows' float64 sums of offsets.
        lines: By activation, [6, m, C, H, W] as in `pass_activation`.
        products: By product: the same for its first and its second factor.
        maxima: By max pooling.
        noise: By linear layer: rounding of the network and of rows, [m, *shape] float64.
    """

    dtype: torch.dtype
    unit: float
    sums: float
    lines: dict[int, np.ndarray] = field(default_factory=dict)
    products: dict[int, tuple[np.ndarray, ...]] = field(default_factory=dict)
    maxima: dict[int, MaxPoolPlanes] = field(default_factory=dict)
    noise: dict[int, Tensor] = field(default_factory=dict)

    @property
    def number(self) -> type[np.floating[Any]]:
        """The numpy type."""
        return np.float32 if self.dtype == torch.float32 else np.float64

    def takes(self, coefficients: Coefficients) -> bool:
        """Return whether rows have this type."""
        return coefficients.value.dtype == self.number

    @property
    def moved_out(self) -> tuple[float, float]:
        """The relative and the absolute amount by which a float64 offset is moved outward before it is stored."""
        return (OWN_STORED, FLUSH) if self.dtype == torch.float32 else (self.sums, 0.0)

    def outward(self, value: Tensor, side: float) -> Tensor:
        """Return an offset as stored for rows, moved outward by the errors of their sums of offsets."""
        if self.dtype == torch.float32:
            # half a unit of float32 is more than that, up to 2^26 numbers
            return outward(value, side)
        return value + side * self.sums * value.abs()
