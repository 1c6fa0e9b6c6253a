"""Bounds of a field's outputs on parts of a cell, from polynomials and error terms (design.md, F2, F7)."""

from __future__ import annotations

import torch
from torch import Tensor

from ns_abstract.arithmetic.rounding import (
    ACTIVATION_FLOOR,
    ACTIVATION_ROUNDING,
    CHEBYSHEV_ROUNDING,
    COMPOSITE_ROUNDING,
    SOFTPLUS_LINE,
)
from ns_abstract.methods.nerf.layer_polynomials import PreActivation


def greatest(value: PreActivation) -> Tensor:
    """Return upper bounds [B, n] of an affine batch on whole cells."""
    middle, spread = value.poly[:, 0], value.poly[:, 1:].abs().sum(dim=1)
    return middle + spread + (value.radius + CHEBYSHEV_ROUNDING * (middle.abs() + spread))


def bounds_by_part(value: PreActivation, bernstein: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return bounds [B, parts, n] of an affine batch on every part of its cell, and its radius [B, n]."""
    error = value.radius
    (batch, m, n), (parts, k, _) = value.poly.shape, bernstein.shape
    # pieces and outputs side by side
    controls = (bernstein.reshape(parts * k, m) @ value.poly.transpose(0, 1).reshape(m, batch * n)).view(parts, k, -1)
    least, most = (ends.view(parts, batch, n).transpose(0, 1) for ends in (controls.amin(dim=1), controls.amax(dim=1)))
    # on parts that are nearly the whole cell, Bernstein coefficients of high degrees are far from the values
    spread = value.poly[:, 1:].abs().sum(dim=1)[:, None]
    middle = value.poly[:, :1]
    rounding = CHEBYSHEV_ROUNDING * value.poly.abs().sum(dim=1)[:, None]
    rough, slack = rounding * bernstein.abs().amax(), rounding + error[:, None]
    low = torch.maximum(least - rough, middle - spread)
    high = torch.minimum(most + rough, middle + spread)
    return low - slack, high + slack, error


def density(z: Tensor, *, up: bool) -> Tensor:
    """Return a bound of ``softplus(z)``, from above or below (design.md, F7).

    torch returns z itself for the softplus of z > 20, which is less than the function by 2.1e-9.
    """
    softplus = torch.clamp(z, min=0.0) + torch.log1p(torch.exp(-z.abs()))
    if up:
        return softplus * (1.0 + ACTIVATION_ROUNDING)
    return torch.where(z > SOFTPLUS_LINE, z, softplus) * (1.0 - ACTIVATION_ROUNDING)


def opacity(z: Tensor, length: Tensor, *, up: bool) -> Tensor:
    """Return a bound of ``1 - exp(-length softplus(z))``, from above or below (design.md, F7)."""
    alpha = -torch.expm1(-length * density(z, up=up))
    if up:
        return (alpha * (1.0 + ACTIVATION_ROUNDING) + ACTIVATION_FLOOR).clamp(max=1.0)
    return (alpha * (1.0 - ACTIVATION_ROUNDING)).clamp(min=0.0)


def brightness(value: PreActivation, bernstein: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return bounds [B, parts, n] of the sigmoid on every part, [0, 1] for failed pieces, and radii [B, n]."""
    low, high, error = bounds_by_part(value, bernstein)
    bad = value.failed[:, None, None]
    low = torch.where(bad, 0.0, torch.sigmoid(low) * (1.0 - COMPOSITE_ROUNDING))
    high = torch.where(bad, 1.0, (torch.sigmoid(high) * (1.0 + COMPOSITE_ROUNDING)).clamp(max=1.0))
    return low, high, error
