"""The penalty that makes a network smooth, and its bounds narrow (design.md, W5)."""

from __future__ import annotations

import torch


def log_lipschitz(module: torch.nn.Module) -> torch.Tensor:
    """Sum over the linear layers of the logarithm of their norm from maximum to maximum.

    The exponential bounds how much a network of these layers and of activations that are no steeper
    than 1 stretches a box, up to skip connections (H.-T. D. Liu et al., "Learning smooth neural
    functions via Lipschitz regularization", 2022, eq. 5); interval bounds widen by just these norms.
    """
    norms = [layer.weight.abs().sum(dim=1).max() for layer in module.modules() if isinstance(layer, torch.nn.Linear)]
    return torch.stack(norms).log().sum()
