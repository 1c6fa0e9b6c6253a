"""Affine forms in the parameters, and intervals, that enclose a node's values (docs/dev/design.md, N0, N1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import OWN_FEW, UP


class NodeInterval(NamedTuple):
    """Lower and upper bounds of a node's values, [m, *shape]."""

    lower: Tensor
    upper: Tensor

    @property
    def size(self) -> Tensor:
        return torch.maximum(self.lower.abs(), self.upper.abs())

    @property
    def spread(self) -> Tensor:
        """The sum of both bounds' magnitudes."""
        return self.upper.clamp(min=0.0) - self.lower.clamp(max=0.0)


@dataclass
class NodeForm:
    """The affine form ``z = reference + c + a p + e``, |e| <= r, of a node's values in every cell (N1).

    Attributes:
        reference: [m, *shape] near the node's exact values; everything else is relative to it.
        c, r: [m, *shape].
        a: [m, d, *shape].
        lower, upper: [m, *shape] bounds of ``z - reference``.
        active: [m, *shape]; False where z is exactly zero.
    """

    reference: Tensor
    c: Tensor
    a: Tensor
    r: Tensor
    lower: Tensor
    upper: Tensor
    active: Tensor

    @property
    def width(self) -> Tensor:
        """The largest distance of z from the reference."""
        return torch.maximum(self.lower.abs(), self.upper.abs())

    @property
    def interval(self) -> NodeInterval:
        """Lower and upper bounds of z."""
        room = OWN_FEW * self.reference.abs()
        low = self.reference + self.lower - room - OWN_FEW * self.lower.abs()
        return NodeInterval(low, self.reference + self.upper + room + OWN_FEW * self.upper.abs())

    @staticmethod
    def ranged(reference: Tensor, c: Tensor, a: Tensor, r: Tensor, active: Tensor | None = None) -> NodeForm:
        """Return the form whose bounds are the range of its polynomial and radius."""
        radius = (a.abs().sum(1) + r) * UP + c.abs() * OWN_FEW
        active = torch.ones_like(c, dtype=torch.bool) if active is None else active
        return NodeForm(reference, c, a, r, c - radius, c + radius, active)
