"""Projected gradient descent of a function of the pose over a box."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from ns_abstract.geometry.box import ParameterBox

_FIRST_STEP = 0.25


def descend(
    box: ParameterBox,
    start: np.ndarray,
    value: Callable[[torch.Tensor], torch.Tensor],
    steps: int,
    enough: Callable[[float], bool],
) -> np.ndarray | None:
    """Return the pose [d] of the box with the least value found; None: no step was better than ``start`` [d].

    Steps follow the normalised gradient in parameters scaled to [-1, 1]^d; they double where the value fell, and shrink
    to a quarter elsewhere.

    Args:
        box: Limits of the parameters.
        value: Of parameter values [d]; differentiable.
        enough: Whether the least value so far ends the descent.
    """
    low, high = (torch.tensor(v, dtype=torch.float64) for v in (box.lower, box.upper))

    def evaluate(scaled: torch.Tensor) -> tuple[float, torch.Tensor]:
        scaled = scaled.detach().requires_grad_(True)
        result = value(low + 0.5 * (scaled + 1.0) * (high - low))
        slope = torch.zeros_like(scaled)
        if result.requires_grad:
            (slope,) = torch.autograd.grad(result, scaled)
        return float(result.detach()), slope

    scaled = (2.0 * (torch.from_numpy(start) - low) / (high - low) - 1.0).clamp(-1.0, 1.0)
    best, slope = evaluate(scaled)
    step, moved = _FIRST_STEP, False
    for _ in range(steps):
        # directions that leave the box are no use
        free = torch.where(((scaled <= -1.0) & (slope > 0)) | ((scaled >= 1.0) & (slope < 0)), 0.0, slope)
        length = float(free.norm())
        if not 0.0 < length < math.inf or enough(best):
            break
        trial = (scaled - step * free / length).clamp(-1.0, 1.0)
        trial_value, trial_slope = evaluate(trial)
        if trial_value < best:
            scaled, best, slope, step, moved = trial, trial_value, trial_slope, min(2.0 * step, 1.0), True
        else:
            step *= 0.25
    return box.at(scaled.detach().numpy()) if moved else None
