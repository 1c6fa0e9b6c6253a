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
        """What they are above and below zero, together."""
        return self.upper.clamp(min=0.0) - self.lower.clamp(max=0.0)


@dataclass
class NodeForm:
    """The affine form ``z = reference + c + a p + e``, |e| <= r, of a node's values in every cell (N1).

    Attributes:
        reference: [m, *shape]: the node's exact values are near it; all that follows is relative to it.
        c, r: [m, *shape].
        a: [m, d, *shape].
        lower, upper: [m, *shape]; what ``z - reference`` is at least and at most.
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
        """How far z may be from the reference."""
        return torch.maximum(self.lower.abs(), self.upper.abs())

    @property
    def interval(self) -> NodeInterval:
        """What z is at least and at most."""
        room = OWN_FEW * self.reference.abs()
        low = self.reference + self.lower - room - OWN_FEW * self.lower.abs()
        return NodeInterval(low, self.reference + self.upper + room + OWN_FEW * self.upper.abs())

    @staticmethod
    def ranged(reference: Tensor, c: Tensor, a: Tensor, r: Tensor, active: Tensor | None = None) -> NodeForm:
        """With the range of the form itself."""
        radius = (a.abs().sum(1) + r) * UP + c.abs() * OWN_FEW
        active = torch.ones_like(c, dtype=torch.bool) if active is None else active
        return NodeForm(reference, c, a, r, c - radius, c + radius, active)
