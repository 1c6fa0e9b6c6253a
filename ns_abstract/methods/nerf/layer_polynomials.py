"""Polynomials of a layer's neurons, before and after its activation (design.md, F2-F5)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ns_abstract.arithmetic.rounding import (
    FIELD_UP,
)


def column_sums(columns: Tensor, owner: Tensor, pieces: int) -> Tensor:
    """[pieces, n] sums of absolute columns [C, n] by owner [C]."""
    out = torch.zeros(pieces, columns.shape[1], dtype=columns.dtype, device=columns.device)
    return out.index_add_(0, owner, columns.abs())


@dataclass
class PostActivation:
    """A batch of Chebyshev zonotopes behind an activation.

    Attributes:
        poly: [B, m, n] Chebyshev coefficients.
        columns, owner: [C, n] error terms, not yet multiplied by ``slope``, and the piece [C] that each belongs to.
        slope: [B, n] what the columns of a piece are multiplied by.
        new_owner, new_neuron, new_size: [N] error terms that move one neuron only, not yet in ``columns``.
        spread: [B, n] sum of the absolute error terms.
        box: [B, n] radius of the rest.
        size: [B, n] sum of the absolute coefficients and error terms. 0: the neuron is off, and only ``box`` and
            ``spread``, which are 0, say something about it.
        failed: [B] whether the piece was given up: its other values mean nothing.
        count: [B] error terms.
    """

    poly: Tensor
    columns: Tensor
    owner: Tensor
    slope: Tensor
    new_owner: Tensor
    new_neuron: Tensor
    new_size: Tensor
    spread: Tensor
    box: Tensor
    size: Tensor
    failed: Tensor
    count: Tensor

    def select(self, which: Tensor) -> PostActivation:
        """The pieces ``which`` [k] (indices, ascending)."""
        place = torch.full_like(self.failed, -1, dtype=torch.int64)
        place[which] = torch.arange(which.numel(), device=which.device)
        owned, new = place[self.owner] >= 0, place[self.new_owner] >= 0
        return PostActivation(
            self.poly[which],
            self.columns[owned],
            place[self.owner[owned]],
            self.slope[which],
            place[self.new_owner[new]],
            self.new_neuron[new],
            self.new_size[new],
            self.spread[which],
            self.box[which],
            self.size[which],
            self.failed[which],
            self.count[which],
        )


@dataclass
class PreActivation:
    """A batch before an activation: `PostActivation` with all error terms in ``columns``, whose sums are ``spread``."""

    poly: Tensor
    columns: Tensor
    owner: Tensor
    spread: Tensor
    box: Tensor
    failed: Tensor
    count: Tensor

    @property
    def radius(self) -> Tensor:
        """[B, n] columns and box together."""
        return (self.spread * FIELD_UP + self.box) * FIELD_UP

    def without_columns(self, which: Tensor) -> PreActivation:
        """The pieces ``which`` [k], all but their columns."""
        parts = (self.poly, self.spread, self.box, self.failed, self.count)
        poly, spread, box, failed, count = (part[which] for part in parts)
        return PreActivation(poly, self.columns[:0], self.owner[:0], spread, box, failed, count)
