"""Bounds of the partial sums of a sum in any order (docs/dev/design.md, N20)."""

from __future__ import annotations

import torch
from torch import Tensor

from ns_abstract.arithmetic.network_charges import UP


def partial_sums(count: Tensor | int, peak: Tensor, squares: Tensor, end: Tensor) -> Tensor:
    """Return an upper bound of the total size of all partial sums, in any order of ``count`` additions.

    Args:
        count: Additions, broadcast like the others.
        peak: The greater of the positive numbers together and the negative ones, or more.
        squares: The same of their squares.
        end: The size of the whole sum, or more.
    """
    number = torch.as_tensor(count, dtype=torch.float64)
    root = squares.sqrt() * UP

    def ordered(leaves: Tensor) -> Tensor:
        """The sum of what one to ``leaves`` numbers of one sign may be together."""
        # the first few by their squares, the others by all of them
        few = torch.minimum(leaves, (peak / root).square().nan_to_num(nan=0.0, posinf=0.0).floor())
        return (2.0 / 3.0 * few * few.sqrt() + few.sqrt()) * root + (leaves - few) * peak

    half = (0.5 * (number + 1.0)).ceil()
    least = torch.minimum(ordered(number + 1.0), 2.0 * ordered(half) + peak + half * end)
    return torch.minimum(number * peak, least * UP)
