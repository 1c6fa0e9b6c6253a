"""Projected gradient descent of a margin over the poses of a cell."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from ns_abstract.geometry.box import ParameterBox

#: Steps of the descent to a counterexample.
_STEPS = 6
_FIRST_STEP = 0.25


def descend(box: ParameterBox, start: np.ndarray, margin: Callable[[torch.Tensor], torch.Tensor]) -> np.ndarray | None:
    """Return a pose [d] of the cell whose margin is smaller than at ``start`` [d]; None: no step found one.

    Args:
        margin: Of parameter values [d]; differentiable.
    """
    low, high = (torch.tensor(v, dtype=torch.float64) for v in (box.lower, box.upper))

    def evaluate(scaled: torch.Tensor) -> tuple[float, torch.Tensor]:
        scaled = scaled.detach().requires_grad_(True)
        value = margin(low + 0.5 * (scaled + 1.0) * (high - low))
        slope = torch.zeros_like(scaled)
        if value.requires_grad:
            (slope,) = torch.autograd.grad(value, scaled)
        return float(value.detach()), slope

    scaled = (2.0 * (torch.from_numpy(start) - low) / (high - low) - 1.0).clamp(-1.0, 1.0)
    best, slope = evaluate(scaled)
    step, moved = _FIRST_STEP, False
    for _ in range(_STEPS):
        free = torch.where(((scaled <= -1.0) & (slope > 0)) | ((scaled >= 1.0) & (slope < 0)), 0.0, slope)
        length = float(free.norm())
        if not 0.0 < length < math.inf or best <= 0.0:
            break
        trial = (scaled - step * free / length).clamp(-1.0, 1.0)
        value, trial_slope = evaluate(trial)
        if value < best:
            scaled, best, slope, step, moved = trial, value, trial_slope, min(2.0 * step, 1.0), True
        else:
            step *= 0.25
    return box.at(scaled.detach().numpy()) if moved else None
