"""A set of pictures as the first layer of a network, for network verifiers."""

from __future__ import annotations

import numpy as np
import torch


class LinearRenderer(torch.nn.Module):
    """Pictures ``A p + b + radius * e`` for parameters ``p`` and slacks ``e`` in [-1, 1].

    ``slope`` is A [H, W, 3, d]; ``offset`` and ``radius`` are [H, W, 3].
    """

    def __init__(self, slope: np.ndarray, offset: np.ndarray, radius: np.ndarray) -> None:
        super().__init__()
        height, width, channels, dimensions = slope.shape
        #: Shape of one picture.
        self.shape = channels, height, width
        weight = np.ascontiguousarray(slope.transpose(2, 0, 1, 3)).reshape(-1, dimensions)
        self.linear = torch.nn.Linear(dimensions, weight.shape[0])
        self.linear.weight = torch.nn.Parameter(torch.from_numpy(weight), requires_grad=False)
        bias = np.ascontiguousarray(offset.transpose(2, 0, 1)).reshape(-1)
        self.linear.bias = torch.nn.Parameter(torch.from_numpy(bias), requires_grad=False)
        self.radius: torch.Tensor
        self.register_buffer("radius", torch.from_numpy(np.ascontiguousarray(radius.transpose(2, 0, 1))[None]))

    def forward(self, parameters: torch.Tensor, slack: torch.Tensor) -> torch.Tensor:
        """Return pictures [n, 3, H, W] for parameters [n, d] and slacks [n, 3, H, W]."""
        return self.linear(parameters).reshape(-1, *self.shape) + self.radius * slack
