"""Polynomials of a layer's neurons, before and after its activation (design.md, F2-F5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ns_abstract.arithmetic.rounding import FIELD_UP


def column_sums(columns: Tensor, owner: Tensor, pieces: int) -> Tensor:
    """Return [pieces, n] sums of absolute columns [C, n] by owner [C]."""
    out = torch.zeros(pieces, columns.shape[1], dtype=columns.dtype, device=columns.device)
    return out.index_add_(0, owner, columns.abs())


class PostActivation(NamedTuple):
    """A batch of B Chebyshev zonotopes ("pieces") behind an activation: tensors, or arrays for kernels.

    Attributes:
        poly: [B, m, n] Chebyshev coefficients.
        size: [B, n] sum of the absolute coefficients and error terms. 0: the neuron is inactive; then only ``box`` and
            ``spread``, which are 0, are valid.
        spread: [B, n] sum of the absolute error terms.
        box: [B, n] radius of the rest.
        slope: [B, n] factor of a piece's columns.
        failed: [B] whether the piece was given up: its other values mean nothing.
        count: [B] error terms.
        columns, owner: [C, n] error terms, not yet multiplied by ``slope``, and the piece [C] of each, ascending.
        new_owner, new_neuron, new_size: [N] error terms of one neuron each, not yet in ``columns``, likewise.
    """

    poly: Any
    size: Any
    spread: Any
    box: Any
    slope: Any
    failed: Any
    count: Any
    columns: Any
    owner: Any
    new_owner: Any
    new_neuron: Any
    new_size: Any

    def select(self, which: Tensor) -> PostActivation:
        """Return the pieces ``which`` [k] (indices, ascending)."""
        place = torch.full_like(self.failed, -1, dtype=torch.int64)
        place[which] = torch.arange(which.numel(), device=which.device)
        owned, new = place[self.owner] >= 0, place[self.new_owner] >= 0
        pieces = (part[which] for part in self[:7])
        return PostActivation._make((
            *pieces, self.columns[owned], place[self.owner[owned]],
            place[self.new_owner[new]], self.new_neuron[new], self.new_size[new],
        ))  # fmt: skip


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
        """Sum [B, n] of absolute columns and box."""
        return (self.spread * FIELD_UP + self.box) * FIELD_UP

    def without_columns(self, which: Tensor) -> PreActivation:
        """Return the pieces ``which`` [k] without their columns."""
        parts = (self.poly, self.spread, self.box, self.failed, self.count)
        poly, spread, box, failed, count = (part[which] for part in parts)
        return PreActivation(poly, self.columns[:0], self.owner[:0], spread, box, failed, count)
